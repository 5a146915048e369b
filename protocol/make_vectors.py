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


def scan(
    name: str, sequence: int, rows: int, columns: int, codes: list[int], mode: str = "near"
) -> dict[str, Any]:
    header = struct.pack("<IIHHBBB", 70000, 777777777, 3, 1, rows, columns, mode == "far")
    fields = {
        "scan": 70000,
        "time_us": 777777777,
        "dropped": 3,
        "rx_errors": 1,
        "rows": rows,
        "columns": columns,
        "mode": mode,
    }
    return valid(name, bytes([0x02, sequence]) + header + pack10(codes), fields, codes)


def all_valid() -> list[dict[str, Any]]:
    hello = struct.pack(
        "<HBBBBIBBBBIIIIHIHHBBIBBB",
        *(0x3C72, 0, 1, 0, 1, 0xC0FFEE, 8, 8, 4, 10, 30000, 30000),
        *(90000, 177762, 689, 16000000, 0, 36, 32, 1, 500000, 1, 2, 0),
    )
    hello_fields = {
        "layout_crc": 0x3C72,
        "version_major": 0,
        "version_minor": 1,
        "version_patch": 0,
        "board": "uno",
        "unit_id": 0xC0FFEE,
        "rows": 8,
        "columns": 8,
        "readings_per_cell": 4,
        "adc_bits": 10,
        "ref_top_ohm": 30000,
        "ref_bottom_ohm": 30000,
        "rate_asked_mhz": 90000,
        "scan_cycles": 177762,
        "slot_cycles": 689,
        "clock_hz": 16000000,
        "settle_asked_us": 0,
        "settle_us": 36,
        "adc_prescaler": "clock_500khz",
        "mode": "far",
        "baud": 500000,
        "settings": "defaults_blank",
        "reset_cause": ["external"],
        "scanning": 0,
    }
    ramp = [(37 * i + 5) % 1024 for i in range(8 * 8 * 4)]
    report = struct.pack("<H16H", 0b100100100, *range(8), *range(1016, 1024))
    configure = struct.pack("<BBIHBB", 8, 12, 90000, 20, 64, 1)
    return [
        valid("get_hello", bytes([0x81, 0]), {}),
        valid("start", bytes([0x83, 7]), {}),
        valid("stop, sequence 255", bytes([0x84, 255]), {}),
        valid(
            "configure",
            bytes([0x82, 9]) + configure,
            {
                "rows": 8,
                "columns": 12,
                "rate_mhz": 90000,
                "settle_us": 20,
                "adc_prescaler": "clock_250khz",
                "mode": "far",
            },
        ),
        valid("set_unit_id", bytes([0x85, 1]) + b"\xff\x00\xff\x00", {"unit_id": 0x00FF00FF}),
        valid("set_baud", bytes([0x89, 2]) + struct.pack("<I", 1000000), {"baud": 1000000}),
        valid(
            "ack ok",
            bytes([0x03, 4, 0x83, 7, 0]),
            {"command": 0x83, "command_sequence": 7, "result": "ok"},
        ),
        valid(
            "ack too_fast",
            bytes([0x03, 5, 0x82, 9, 9]),
            {"command": 0x82, "command_sequence": 9, "result": "too_fast"},
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
