# SPDX-License-Identifier: Apache-2.0
"""Print the contacts of a calibrated skin: python forces.py PORT CALIBRATION

A line is "1.23 +- 0.10 N at (2.0, 5.0)", with the standard deviation of the force. Where that is
larger than the force, the line is "uncertain at (2.0, 5.0)".

Without hardware, with presses of six cells of the emulated skin:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json \
        --indenter-mm2 80 --wires 100,200 --leads 80
    python examples/forces.py "emulator://8x8?scene=moving" skin.json
"""

import sys
from contextlib import suppress

import ohmskin

if len(sys.argv) != 3:
    sys.exit(__doc__)
port, calibration = sys.argv[1:]
try:
    with suppress(KeyboardInterrupt), ohmskin.open(port, calibration=calibration) as skin:
        for scan in skin:
            for each in scan.contacts:
                print(f"{each.force_text} at ({each.row:.1f}, {each.column:.1f})", flush=True)
except (ohmskin.OhmskinError, ValueError) as exc:
    sys.exit(f"forces: {exc}")
