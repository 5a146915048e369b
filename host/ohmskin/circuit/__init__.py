# SPDX-License-Identifier: Apache-2.0
"""From resistances to readings.

`skin` is the network of resistors, `ports` has what each port shows and its slopes, `small` solves
their matrices, and `configurations` has what is read of a current. `plate` is a board of known
resistors in place of a skin.

May import: `ohmskin.link` and what is below it.
"""
