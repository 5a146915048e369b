# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells to a calibration.

`tables` reads forces from files, `alignment` finds the offset between two clocks, and `presses`
finds the presses. `wires` finds the wires of the skin from them, and `regression` the curves.
`guide` leads a person who presses, and `rules` says what presses must be.
"""
