# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells to a calibration.

Takes scans and the forces of the same time, from a recording or a log (`tables`), or a table of
presses. Finds the clocks' offset (`alignment`) and the presses, and gives a
`ohmskin.force.calibration.Calibration` (`presses`). `guide` leads a person who presses.

May import: `ohmskin.force` and what is below it.
"""
