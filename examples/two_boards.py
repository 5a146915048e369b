# SPDX-License-Identifier: Apache-2.0
"""Print the scans of several boards on one clock: python two_boards.py [PORT ...]

Without ports, of all boards at this machine. Each needs a unit id of its own:

    ohmskin configure /dev/ttyACM1 --unit-id 1 --save

Without hardware:

    python examples/two_boards.py "emulator://8x8?unit=1" "emulator://8x8?unit=2"
"""

import sys
from contextlib import suppress

import ohmskin

try:
    with suppress(KeyboardInterrupt), ohmskin.open_all(sys.argv[1:] or None) as skins:
        print(f"units {', '.join(map(str, skins))}", flush=True)
        for unit_id, scan in skins.scans():
            at = f"{1e-9 * scan.time_ns:.4f} s: unit {unit_id}"
            text = f"{at}, scan {scan.number}, missed {scan.missed}, "
            b = scan.ratio[0, 0, scan.reading_names.index("b")]
            print(f"{text}{b:.3f}", flush=True)
except (ohmskin.OhmskinError, ValueError) as exc:
    sys.exit(f"two_boards: {exc}")
