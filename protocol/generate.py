#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write frames.h, FRAMES.md and the C++ copy of the golden vectors from their definitions.

python protocol/generate.py            write the files
python protocol/generate.py --check    change nothing, exit 1 when one is stale
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "host"))

from ohmskin.link.protocol import (  # noqa: E402
    CONSTANTS,
    DEFINITION,
    ENUMS,
    FRAMES,
    LAYOUT_CRC,
    MODES,
    PER_PASS,
    Field,
    Frame,
)

C_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "text": "char"}


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def _c_type(value: int) -> str:
    return "uint8_t" if value < 1 << 8 else "uint16_t" if value < 1 << 16 else "uint32_t"


def _hex(value: int) -> str:
    return f"0x{value:04X}" if value > 0xFF else f"0x{value:02X}"


def header() -> str:
    """frames.h: the definition for the firmware, without run-time cost."""
    framing = DEFINITION["framing"]
    out = [
        "// SPDX-License-Identifier: Apache-2.0",
        "// Written by protocol/generate.py from protocol/frames.toml; do not edit.",
        "#pragma once",
        "#include <stdint.h>",
        "",
        "namespace ohmskin {",
        "namespace frames {",
        "",
        f"constexpr uint16_t LAYOUT_CRC = 0x{LAYOUT_CRC:04X};",
        f"constexpr uint8_t DELIMITER = {_hex(framing['delimiter'])};",
        f"constexpr uint16_t CRC_POLYNOMIAL = {_hex(framing['crc_polynomial'])};",
        f"constexpr uint16_t CRC_INITIAL = {_hex(framing['crc_initial'])};",
        "",
    ]
    for name, value in CONSTANTS.items():
        out.append(f"// {DEFINITION['constants'][name]['doc']}")
        out.append(f"constexpr {_c_type(value)} {name.upper()} = {value};")
    for name, enum in ENUMS.items():
        width = _c_type(max(enum.values.values()))
        out += ["", f"// {' '.join(DEFINITION['enums'][name]['doc'].split())}"]
        out.append(f"enum class {_camel(name)} : {width} {{")
        out += [f"    {_camel(n)} = {v},  // {enum.docs[n]}" for n, v in enum.values.items()]
        out.append("};")
    out += ["", "// Readings of each mode, in scan order: how many, how many a pass, and which."]
    out.append("struct ModeReadings {")
    out.append("    uint8_t count, per_pass;")
    out.append("    Reading readings[READINGS_MAX];")
    out.append("};")
    out.append("constexpr ModeReadings MODE_READINGS[] = {")
    for mode, names in MODES.items():
        readings = ", ".join(f"Reading::{_camel(name)}" for name in names)
        out.append(f"    {{{len(names)}, {PER_PASS[mode]}, {{{readings}}}}},  // {mode}")
    out.append("};")
    out += ["", "enum class Type : uint8_t {"]
    out += [f"    {_camel(f.name)} = {_hex(f.id)}," for f in FRAMES.values()]
    out.append("};")
    for frame in FRAMES.values():
        if not frame.fields:
            continue
        sender = "board to host" if frame.sender == "board" else "host to board"
        out += ["", f"// {sender}: {' '.join(frame.doc.split())}"]
        out.append(f"struct __attribute__((packed)) {_camel(frame.name)} {{")
        out += [f"    {_member(f)}  // {_field_doc(f)}" for f in frame.fields]
        if frame.tail:
            out.append(f"    // followed by {frame.tail['name']}: {frame.tail['doc']}")
        out.append("};")
        out.append(
            f'static_assert(sizeof({_camel(frame.name)}) == {frame.struct.size}, "wire size");'
        )
    out += ["", "}  // namespace frames", "}  // namespace ohmskin", ""]
    return "\n".join(out)


def _member(field: Field) -> str:
    array = f"[{field.count}]" if field.count > 1 else ""
    return f"{C_TYPES[field.type]} {field.name}{array};"


def _field_doc(field: Field) -> str:
    return (f"[{field.unit}] " if field.unit else "") + field.doc


def page() -> str:
    """FRAMES.md: the definition for people."""
    out = [
        "# The link between board and host",
        "",
        "Written by `protocol/generate.py` from `protocol/frames.toml`; do not edit.",
        "",
        DEFINITION["framing"]["doc"].strip(),
        "",
        f"Layout CRC of this definition: `0x{LAYOUT_CRC:04X}`.",
        "",
        "## Frames",
    ]
    for frame in FRAMES.values():
        sender = "board to host" if frame.sender == "board" else "host to board"
        out += ["", f"### `{frame.name}` (0x{frame.id:02X}, {sender})", ""]
        out += [" ".join(frame.doc.split()).rstrip(".") + ".", ""]
        out.append(f"Payload: {_size(frame)}.")
        if frame.fields:
            out += ["", "| offset | field | type | unit | meaning |", "|---|---|---|---|---|"]
            out += _rows(frame)
    out += ["", "## Enums"]
    for name, enum in ENUMS.items():
        out += [
            "",
            f"### `{name}`",
            "",
            " ".join(DEFINITION["enums"][name]["doc"].split()) + ".",
            "",
        ]
        out += ["| value | name | meaning |", "|---|---|---|"]
        for n, v in enum.values.items():
            readings = _passes(n) + ": " if name == "mode" else ""
            out.append(f"| {v} | `{n}` | {readings}{enum.docs[n]} |")
    out += ["", "## Constants", "", "| name | value | unit | meaning |", "|---|---|---|---|"]
    for name, entry in DEFINITION["constants"].items():
        out.append(f"| `{name}` | {entry['value']} | {entry.get('unit', '')} | {entry['doc']} |")
    return "\n".join(out) + "\n"


def _passes(mode: str) -> str:
    """The readings of a mode, a bar between its passes."""
    names, size = MODES[mode], PER_PASS[mode]
    return " / ".join(" ".join(names[i : i + size]) for i in range(0, len(names), size))


def _size(frame: Frame) -> str:
    if frame.tail:
        return f"{frame.struct.size} bytes and `{frame.tail['name']}`"
    return f"{frame.struct.size} bytes" if frame.fields else "none"


def _rows(frame: Frame) -> list[str]:
    rows, offset = [], 0
    for f in frame.fields:
        kind = f.type + (f"[{f.count}]" if f.count > 1 else "")
        link = f" (`{f.enum or f.flags}`)" if f.enum or f.flags else ""
        rows.append(f"| {offset} | `{f.name}` | {kind} | {f.unit or ''} | {f.doc}{link} |")
        offset += f.size
    if frame.tail:
        rows.append(f"| {offset} | `{frame.tail['name']}` | packed | | {frame.tail['doc']} |")
    return rows


def vectors_header() -> str:
    """firmware/test/vectors.h: vectors.json as C arrays, in flash on an AVR."""
    vectors = json.loads((ROOT / "protocol" / "vectors.json").read_text(encoding="utf-8"))
    out = [
        "// SPDX-License-Identifier: Apache-2.0",
        "// Written by protocol/generate.py from protocol/vectors.json; do not edit.",
        "// clang-format off",
        "#pragma once",
        "#include <stdint.h>",
        "#ifdef __AVR__",
        "#include <avr/pgmspace.h>",
        "#else",
        "#define PROGMEM",
        "#define pgm_read_byte(address) (*(address))",
        "#endif",
        "",
        "namespace vectors {",
        "",
        "struct Vector {",
        "    const char *name;",
        "    const uint8_t *content;  // type, sequence, payload; in flash",
        "    uint16_t content_size;   // 0: the wire bytes hold no valid frame",
        "    const uint8_t *wire;     // in flash",
        "    uint16_t wire_size;",
        "};",
        "",
    ]
    entries = []
    every = [*vectors["valid"], *vectors["damaged"]]
    for i, v in enumerate(every):
        content, wire = bytes.fromhex(v.get("content", "")), bytes.fromhex(v["wire"])
        if content:
            out.append(_array(f"content_{i}", content))
        out.append(_array(f"wire_{i}", wire))
        pointer = f"content_{i}" if content else "nullptr"
        entries.append(f'    {{"{v["name"]}", {pointer}, {len(content)}, wire_{i}, {len(wire)}}},')
    out += ["", "const Vector ALL[] = {", *entries, "};"]
    out += ["", "}  // namespace vectors", ""]
    return "\n".join(out)


def _array(name: str, octets: bytes) -> str:
    return f"const uint8_t {name}[] PROGMEM = {{" + ", ".join(f"0x{o:02X}" for o in octets) + "};"


OUTPUTS = {
    ROOT / "protocol" / "frames.h": header,
    ROOT / "protocol" / "FRAMES.md": page,
    ROOT / "firmware" / "test" / "vectors.h": vectors_header,
}


def main(arguments: list[str]) -> int:
    """Write or check every output; the exit code."""
    if arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    stale = []
    for path, make in OUTPUTS.items():
        text = make()
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        if arguments:
            stale.append(str(path.relative_to(ROOT)))
        else:
            path.write_text(text, encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")
    if stale:
        print(f"stale: {', '.join(stale)}: run protocol/generate.py", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
