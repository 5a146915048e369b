# SPDX-License-Identifier: Apache-2.0
"""From presses to a calibration.

`tables` reads forces from files, `alignment` finds the offset between two clocks, and `presses`
finds the presses. `wires` finds the wires of the skin from them, and `regression` the curves.
`guide` leads a person who presses, and `rules` says what presses must be.

Where a skin is pressed anywhere, and the total force is known, `kneading` leads from scans to the
calibration: `scale` takes the filter of a scale out, and `totals` finds the curves, to which
`smoothness` adds what the pressure of fingertips tells. `coverage` says meanwhile how well each
cell is known, and `sessions` joins recordings of several days.
"""
