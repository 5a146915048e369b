# SPDX-License-Identifier: Apache-2.0
"""Forces as a stream of the Lab Streaming Layer: python lsl_outlet.py PORT CALIBRATION [SECONDS]

One channel a cell, in newtons, each sample at the time of the middle of its scan; NaN where a cell
has no force. Needs `pip install pylsl`. Without hardware, with presses of six cells of the
emulated skin:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json \
        --indenter-mm2 80 --wires 100,200 --leads 80
    python examples/lsl_outlet.py "emulator://8x8?scene=moving" skin.json
"""

import sys
import time
from contextlib import suppress

import pylsl

import ohmskin


def stream_info(board: ohmskin.Hello) -> pylsl.StreamInfo:
    count = board.rows * board.columns
    source = f"ohmskin-unit-{board.unit_id}"
    info = pylsl.StreamInfo("ohmskin", "Force", count, board.rate_hz, "float32", source)
    channels = info.desc().append_child("channels")
    for row in range(board.rows):
        for column in range(board.columns):
            channel = channels.append_child("channel")
            channel.append_child_value("label", f"row {row} column {column}")
            channel.append_child_value("unit", "newtons")
            channel.append_child_value("type", "Force")
    return info


def main(port: str, calibration: str, seconds: float = float("inf")) -> None:
    with ohmskin.open(port, calibration=calibration) as skin:
        outlet = pylsl.StreamOutlet(stream_info(skin.info))
        offset_s = pylsl.local_clock() - time.time()
        end_s = time.monotonic() + seconds
        for scan in skin:
            time_s = 1e-9 * scan.time_ns + offset_s
            outlet.push_sample(scan.force_n.flatten().tolist(), time_s)
            if time.monotonic() > end_s:
                break


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    try:
        with suppress(KeyboardInterrupt):  # Ctrl-C ends it
            main(sys.argv[1], sys.argv[2], *map(float, sys.argv[3:]))
    except (ohmskin.OhmskinError, ValueError) as exc:
        sys.exit(f"lsl_outlet: {exc}")
