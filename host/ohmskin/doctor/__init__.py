# SPDX-License-Identifier: Apache-2.0
"""From scans of an untouched skin to what is wrong with it.

Takes scans and what the board says of itself, gives findings as data; no port, no clock.

May import: `ohmskin.estimate` and what is below it.
"""
