#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make vectors.json: golden frames from implementations that are not the project's own.

COBS comes from the `cobs` package on PyPI, the CRC is the textbook's bit-by-bit loop, and payloads
are packed here by hand, so that firmware and host are both compared with a third party. Run it
after a change of the framing, then generate.py:

    python protocol/make_vectors.py && python protocol/generate.py
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from cobs import cobs


def crc16(octets: bytes) -> int:
    """CRC-16/IBM-3740, a bit at a time. Check value: b"123456789" gives 0x29B1."""
    crc = 0xFFFF
    for octet in octets:
        crc ^= octet << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
            crc &= 0xFFFF
    return crc


def wire(content: bytes) -> bytes:
    return b"\0" + bytes(cobs.encode(content + struct.pack("<H", crc16(content)))) + b"\0"


def pack10(codes: list[int]) -> bytes:
    """Codes of 10 bits, least significant bit first, as one long integer."""
    number = sum(code << 10 * i for i, code in enumerate(codes))
    return number.to_bytes(-(-len(codes) * 10 // 8), "little")


def valid(
    name: str, content: bytes, fields: dict[str, Any], codes: list[int] | None = None
) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": name, "fields": fields}
    if codes is not None:
        entry["codes"] = codes
    return {**entry, "content": content.hex(), "wire": wire(content).hex()}


MODES = ("near", "far", "half", "quick")


def scan(
    name: str, sequence: int, rows: int, columns: int, codes: list[int], mode: str = "near"
) -> dict[str, Any]:
    return region(name, sequence, ((1 << rows) - 1, (1 << columns) - 1), codes, mode)


def region(
    name: str, sequence: int, masks: tuple[int, int], codes: list[int], mode: str
) -> dict[str, Any]:
    """A scan of these rows and columns, of a skin that ends with the last of them."""
    fields = {
        "scan": 70000,
        "time_us": 777777777,
        "dropped": 3,
        "rx_errors": 1,
        "rows": masks[0].bit_length(),
        "columns": masks[1].bit_length(),
        "mode": mode,
        "adc_bits": 10,
        "row_mask": masks[0],
        "column_mask": masks[1],
        "slot_cycles": 688,
    }
    values = [MODES.index(value) if name == "mode" else value for name, value in fields.items()]
    header = struct.pack("<IIHHBBBBIIH", *values)
    return valid(name, bytes([0x02, sequence]) + header + pack10(codes), fields, codes)


def all_valid() -> list[dict[str, Any]]:
    hello_fields = {
        "layout_crc": 0x3C72,
        "version_major": 0,
        "version_minor": 1,
        "version_patch": 0,
        "board": "uno",
        "wiring": 0,
        "unit_id": 0xC0FFEE,
        "rows_max": 16,
        "columns_max": 16,
        "rows": 8,
        "columns": 8,
        "adc_bits": 10,
        "ref_top_ohm": 30000,
        "ref_bottom_ohm": 30000,
        "rate_asked_mhz": 90000,
        "scan_cycles": 177762,
        "slot_cycles": 689,
        "whole_scan_cycles": 176816,
        "clock_hz": 16000000,
        "settle_asked_us": 0,
        "settle_us": 36,
        "accuracy": "usual",
        "mode": "far",
        "row_mask": 0xFF,
        "column_mask": 0x3C,
        "whole_mode": "near",
        "whole_every": 12,
        "baud": 500000,
        "settings": "defaults_blank",
        "reset_cause": ["external"],
        "scanning": 0,
        "dropped": 513,
        "late": 7,
    }
    numbers = {"board": b"uno", "accuracy": 0, "mode": 1, "whole_mode": 0, "settings": 1}
    numbers["reset_cause"] = 2
    hello = struct.pack(
        "<HBBB16sHIBBBBBIIIIIIIHHBBIIBHIBBBHH",
        *(numbers.get(name, value) for name, value in hello_fields.items()),
    )
    ramp = [(37 * i + 5) % 1024 for i in range(8 * 8 * 4)]
    report = struct.pack("<H16H", 0b100100100, *range(8), *range(1016, 1024))
    of_region = struct.pack("<IIIHBBH", 0xFE, 0x800, 90000, 20, 3, 0, 300)
    region_fields = {
        "row_mask": 0xFE,
        "column_mask": 0x800,
        "rate_mhz": 90000,
        "settle_us": 20,
        "mode": "quick",
        "whole_mode": "near",
        "whole_every": 300,
    }
    return [
        valid("get_hello", bytes([0x81, 0]), {}),
        valid("start", bytes([0x83, 7]), {}),
        valid("stop, sequence 255", bytes([0x84, 255]), {}),
        valid(
            "configure",
            bytes([0x82, 9, 8, 12, 1]) + of_region,
            {"rows": 8, "columns": 12, "accuracy": "fine"} | region_fields,
        ),
        valid("set_region", bytes([0x8A, 3]) + of_region, region_fields),
        valid("set_unit_id", bytes([0x85, 1]) + b"\xff\x00\xff\x00", {"unit_id": 0x00FF00FF}),
        valid("set_baud", bytes([0x89, 2]) + struct.pack("<I", 1000000), {"baud": 1000000}),
        valid(
            "ack ok",
            bytes([0x03, 4, 0x83, 7, 0]) + struct.pack("<II", 123456789, 0),
            {"command": 0x83, "command_sequence": 7, "result": "ok"}
            | {"time_us": 123456789, "rate_mhz": 0},
        ),
        valid(
            "ack too_fast",
            bytes([0x03, 5, 0x82, 9, 9]) + struct.pack("<II", 5, 90843),
            {"command": 0x82, "command_sequence": 9, "result": "too_fast"}
            | {"time_us": 5, "rate_mhz": 90843},
        ),
        valid("hello", bytes([0x01, 0]) + hello, hello_fields),
        valid(
            "self_test_report",
            bytes([0x04, 6]) + report,
            {
                "findings": ["top_reference_missing", "bottom_reference_missing", "far_top_open"],
                "code_min": list(range(8)),
                "code_max": list(range(1016, 1024)),
            },
        ),
        scan("scan 1x1", 10, 1, 1, [994, 29, 993, 30]),
        scan("scan 2x3, all codes zero", 11, 2, 3, [0] * 24),
        scan("scan 3x1, all codes 1023", 12, 3, 1, [1023] * 12),
        scan("scan 8x8", 13, 8, 8, ramp, "far"),
        scan("scan 5x2 half", 17, 5, 2, [(53 * i + 9) % 1024 for i in range(20)], "half"),
        region("region of 2x3 quick", 18, (0b10100, 0b1011), [1, 1023, 0, 2, 512, 77], "quick"),
        # COBS's blocks end after 254 bytes without a zero: once past it, once exactly there.
        scan("scan 16x4, long run without zeros", 14, 16, 4, [1023] * 256),
        # The eighth byte of the codes is the last zero: 252 bytes and the CRC follow it.
        scan(
            *("scan 13x4, last run of 254", 15, 13, 4),
            [*(5 * [1023]), 63, 1008, *(201 * [1023])],
        ),
    ]


def all_damaged(good: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    scan_wire = bytes.fromhex(good["scan 8x8"]["wire"])
    start_wire = bytes.fromhex(good["start"]["wire"])
    flipped = bytearray(scan_wire)
    flipped[100] ^= 0x10
    pointer = bytearray(scan_wire)
    pointer[1] += 1
    wrong_crc = bytes(cobs.encode(bytes([0x83, 7]) + b"\x00\x00")) + b"\0"
    cases = [
        ("one bit flipped", bytes(flipped)),
        ("COBS code byte off by one", bytes(pointer)),
        ("a byte lost", scan_wire[:50] + scan_wire[51:]),
        ("the end lost", scan_wire[:-40] + b"\0"),
        ("the start lost", scan_wire[40:]),
        ("two frames whose delimiters were lost", start_wire[:-1] + scan_wire[1:]),
        ("COBS block longer than the frame", b"\x20\x01\x02\0"),
        ("only a CRC", bytes(cobs.encode(struct.pack("<H", crc16(b"")))) + b"\0"),
        ("shorter than a CRC", b"\x02\x81\0"),
        ("wrong CRC", wrong_crc),
    ]
    return [{"name": name, "wire": octets.hex()} for name, octets in cases]


def main() -> None:
    assert crc16(b"123456789") == 0x29B1
    good = all_valid()
    assert bytes.fromhex(good[-1]["wire"])[-256] == 0xFF, "no full block at the end"
    vectors = {
        "provenance": "made by protocol/make_vectors.py with the cobs package from PyPI, "
        "a bitwise CRC and hand-packed payloads; content = type, sequence, payload",
        "valid": good,
        "damaged": all_damaged({v["name"]: v for v in good}),
    }
    path = Path(__file__).with_name("vectors.json")
    path.write_text(json.dumps(vectors, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
