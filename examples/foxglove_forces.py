# SPDX-License-Identifier: Apache-2.0
"""The forces of a recording, for Foxglove: python foxglove_forces.py IN.mcap CALIBRATION OUT.mcap

examples/foxglove.md says which panels show them. Without hardware, with made-up presses:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json --indenter-mm2 80
    ohmskin record "emulator://8x8?scene=moving" recording.mcap --seconds 10
    python examples/foxglove_forces.py recording.mcap skin.json forces.mcap
"""

import base64
import json
import sys

import numpy as np
from mcap.writer import Writer

import ohmskin

PITCH_M = 0.01
# Foxglove knows this schema by its name; of its text it needs what is base64.
GRID = {"type": "object", "properties": {"data": {"type": "string", "contentEncoding": "base64"}}}
CELLS = {
    "type": "object",
    "properties": {
        name: {"type": "array", "items": {"type": "number"}} for name in ("force_n", "force_n_std")
    },
}
ORIGIN = {
    "position": {"x": 0.0, "y": 0.0, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}


def grid(force_n: np.ndarray, time_ns: int) -> dict:
    """A foxglove.Grid of forces (rows, columns) [N]: x along columns, y along rows."""
    return {
        "timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9},
        "frame_id": "skin",
        "pose": ORIGIN,
        "column_count": force_n.shape[1],
        "cell_size": {"x": PITCH_M, "y": PITCH_M},
        "row_stride": 4 * force_n.shape[1],
        "cell_stride": 4,
        "fields": [{"name": "force", "offset": 0, "type": 7}],  # FLOAT32
        "data": base64.b64encode(force_n.astype("<f4").tobytes()).decode(),
    }


def main(recording: str, calibration: str, out: str) -> None:
    with (
        ohmskin.open(f"replay://{recording}?speed=0", calibration=calibration) as skin,
        open(out, "xb") as file,
    ):
        writer = Writer(file)
        writer.start()
        channels = [
            writer.register_channel(
                topic, "json", writer.register_schema(name, "jsonschema", json.dumps(text).encode())
            )
            for topic, name, text in (
                ("/skin/grid", "foxglove.Grid", GRID),
                ("/skin/cells", "ohmskin.cells", CELLS),
            )
        ]
        for scan in skin:
            force_n = np.nan_to_num(scan.force_n)
            cells = {"force_n": force_n, "force_n_std": scan.force_n_std}
            # JSON has no NaN: what the method does not tell is left out.
            content = {
                name: values.flatten().round(4).tolist()
                for name, values in cells.items()
                if not np.isnan(values).any()
            }
            messages = (grid(force_n, scan.time_ns), content)
            for channel, message in zip(channels, messages, strict=True):
                octets = json.dumps(message).encode()
                writer.add_message(channel, scan.time_ns, octets, scan.time_ns)
        writer.finish()


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(f"{sys.argv[3]} is not whole")
