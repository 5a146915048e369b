# SPDX-License-Identifier: Apache-2.0
"""Frames of a board as tests send them to the host, without a board."""

from typing import Any

import numpy as np

from ohmskin.link import protocol


def scan_fields(rows: int, columns: int, **given: Any) -> dict[str, Any]:
    """All fields of a `scan` frame: of a whole scan in mode near, unless given."""
    masks = {
        "row_mask": protocol.all_lines(rows),
        "column_mask": protocol.all_lines(columns),
    }
    counters = dict.fromkeys(("scan", "time_us", "dropped", "rx_errors"), 0)
    rest = {"rows": rows, "columns": columns, "mode": "near", "adc_bits": 10, "slot_cycles": 689}
    return counters | masks | rest | given


def scan_payload(codes: np.ndarray, **given: Any) -> bytes:
    """The payload of a whole scan with these codes (rows, columns, readings)."""
    fields = scan_fields(*codes.shape[:2], **given)
    per_pass = protocol.PER_PASS.get(fields["mode"], 2)
    tail = protocol.pack_codes(codes, per_pass, fields["adc_bits"])
    return protocol.FRAMES["scan"].pack(**fields) + tail
