# SPDX-License-Identifier: Apache-2.0
"""Print the contacts of a calibrated skin: python forces.py PORT CALIBRATION

Without hardware, with a calibration from presses that are made up:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json --indenter-mm2 80
    python examples/forces.py "emulator://8x8?scene=moving" skin.json
"""

import sys

import ohmskin

with ohmskin.open(sys.argv[1], calibration=sys.argv[2]) as skin:
    for scan in skin:
        for each in scan.contacts:
            print(f"{each.force_n:.2f} N at ({each.row:.1f}, {each.column:.1f})", flush=True)
