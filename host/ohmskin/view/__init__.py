# SPDX-License-Identifier: Apache-2.0
"""The live page of ``ohmskin view``: boards read in threads, shown by a server on loopback.

Takes ports and calibrations, gives a page: `server` and `panel` serve it, `boards` reads the boards
and records them.

May import: `ohmskin.opening` and what is below it. `server` and `panel` need the extra
``ohmskin[view]``: nothing imports them before a page is wanted.
"""
