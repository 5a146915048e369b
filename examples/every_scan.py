# SPDX-License-Identifier: Apache-2.0
"""Print one reading of every scan: python every_scan.py PORT [SCANS]"""

import sys
from contextlib import suppress

import ohmskin

if len(sys.argv) < 2:
    sys.exit(__doc__)
port, scans = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "0"
if not scans.isdecimal():
    sys.exit(f"every_scan: SCANS is a whole number, such as 100, not '{scans}'")
try:
    with suppress(KeyboardInterrupt), ohmskin.open(port) as skin:  # Ctrl-C ends it
        for count, scan in enumerate(skin, start=1):
            print(scan.number, scan.missed, scan.ratio[0, 0])
            if count == int(scans):
                break
except (ohmskin.OhmskinError, ValueError) as exc:
    sys.exit(f"every_scan: {exc}")
