# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells to a calibration.

Takes a recording or a table of presses and the forces of the same time, gives a
`ohmskin.force.calibration.Calibration`.

May import: `ohmskin.force` and what is below it.
"""
