# SPDX-License-Identifier: Apache-2.0
"""From resistances to readings.

`skin` is the network of resistors, `small` solves its matrices, and `plate` is a board of known
resistors in place of a skin.

May import: `ohmskin.link` and what is below it.
"""
