# SPDX-License-Identifier: Apache-2.0
"""The live page of ``ohmskin view``: `boards` reads and records, `server` and `panel` serve.

`server` and `panel` need the extra ``ohmskin[view]``: nothing imports them before a page is wanted.
"""
