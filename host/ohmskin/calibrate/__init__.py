# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells to a calibration.

`tables` reads forces, `alignment` finds the clocks' offset, `presses` the presses and the curves.
`guide` leads a person who presses.
"""
