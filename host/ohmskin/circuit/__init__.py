# SPDX-License-Identifier: Apache-2.0
"""From resistances to readings: the skin as a network of resistors.

Takes the conductances of all cells and the resistances of all wire segments (`skin`), gives port
resistances, their derivatives, and the four readings of every cell. `small` solves matrices of
this size fast.

May import: `ohmskin.link` and what is below it.
"""
