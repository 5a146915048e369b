# SPDX-License-Identifier: Apache-2.0
"""The live page of ``ohmskin view``: boards read in threads, shown by a server on loopback.

Imports point one way: server -> access, panel -> viewed_boards, viewed_board -> skin_reader,
board_recording -> shown. `server`, `access` and `panel` need the extra ``ohmskin[view]``: nothing
imports them before a page is wanted.
"""
