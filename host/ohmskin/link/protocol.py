# SPDX-License-Identifier: Apache-2.0
"""The link's definition, read from ``protocol/frames.toml``: the only source of its numbers.

``FRAMES`` maps names to `Frame`; a `Frame` packs and unpacks payloads as dictionaries whose enum
fields are names. Nothing here knows about framing (`ohmskin.link.framing`) or ports.
"""

from __future__ import annotations

import binascii
import json
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PACKAGE_DIR = Path(__file__).parents[1]
# A wheel carries the definition in the package; a checkout has it in protocol/.
_PLACES = (_PACKAGE_DIR / "frames.toml", _PACKAGE_DIR.parents[1] / "protocol" / "frames.toml")
_STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I"}

Value = int | str | tuple[str, ...] | tuple[int, ...]


@dataclass(frozen=True)
class Field:
    """One integer, or `count` of them, in a payload.

    ``enum``: the value is one member's name; ``flags``: the names of the members whose bit is set.
    """

    name: str
    type: str
    count: int
    enum: str | None
    flags: str | None
    unit: str | None
    doc: str


@dataclass(frozen=True)
class Enum:
    """Names for the values of a field."""

    name: str
    values: dict[str, int]
    docs: dict[str, str]
    flags: bool

    def name_of(self, value: int) -> str:
        """The member's name, or ``"unknown_<value>"`` for a value of a newer definition."""
        return next((n for n, v in self.values.items() if v == value), f"unknown_{value}")

    def names_in(self, bits: int) -> tuple[str, ...]:
        """The names of the members whose bit is set in `bits`."""
        return tuple(n for n, v in self.values.items() if bits & v)


class Frame:
    """A frame type: its id, direction and payload fields."""

    def __init__(self, entry: Mapping[str, Any], constants: Mapping[str, int]) -> None:
        self.name: str = entry["name"]
        self.id: int = entry["id"]
        self.sender: str = entry["from"]
        self.doc: str = entry["doc"]
        self.tail: Mapping[str, str] | None = entry.get("tail")
        self.fields = tuple(
            Field(
                name=f["name"],
                type=f["type"],
                count=constants[f["count"]] if "count" in f else 1,
                enum=f.get("enum"),
                flags=f.get("flags"),
                unit=f.get("unit"),
                doc=f["doc"],
            )
            for f in entry["fields"]
        )
        codes = (f"{f.count if f.count > 1 else ''}{_STRUCT_CODES[f.type]}" for f in self.fields)
        self.struct = struct.Struct("<" + "".join(codes))

    def pack(self, **values: Value) -> bytes:
        """The payload (without tail) of this frame; every field must be given.

        :raises ValueError: an unknown or missing field, enum name, or a value outside the type.
        """
        names = {f.name for f in self.fields}
        if values.keys() != names:
            odd = ", ".join(sorted(values.keys() ^ names))
            raise ValueError(f"{self.name}: missing or unknown field: {odd}")
        flat: list[int] = []
        for f in self.fields:
            integers = _integers(f, values[f.name])
            most = (1 << 8 * struct.calcsize(_STRUCT_CODES[f.type])) - 1
            if not all(0 <= n <= most for n in integers):
                raise ValueError(f"{f.name} is {values[f.name]}: must be from 0 to {most}")
            flat.extend(integers)
        try:
            return self.struct.pack(*flat)
        except struct.error as exc:
            raise ValueError(f"{self.name}: a value does not fit its field: {exc}") from None

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """The fields of a payload by name; a tail is left alone.

        :raises ValueError: the payload has the wrong length for this frame.
        """
        size = self.struct.size
        if len(payload) < size or (self.tail is None and len(payload) != size):
            raise ValueError(f"{self.name}: payload of {len(payload)} bytes, {size} expected")
        flat = self.struct.unpack_from(payload)
        values: dict[str, Any] = {}
        at = 0
        for f in self.fields:
            part = flat[at : at + f.count]
            at += f.count
            if f.enum:
                values[f.name] = ENUMS[f.enum].name_of(part[0])
            elif f.flags:
                values[f.name] = ENUMS[f.flags].names_in(part[0])
            else:
                values[f.name] = part if f.count > 1 else part[0]
        return values


def _integers(field: Field, value: Value) -> tuple[int, ...]:
    if field.enum and isinstance(value, str):
        members = ENUMS[field.enum].values
        if value not in members:
            raise ValueError(f"{field.name}: {value!r} is none of {', '.join(members)}")
        return (members[value],)
    if field.flags and isinstance(value, tuple):
        return (sum(ENUMS[field.flags].values[str(name)] for name in value),)
    if isinstance(value, tuple):
        return tuple(int(v) for v in value)
    return (int(value),)


def _load() -> dict[str, Any]:
    for place in _PLACES:
        if place.is_file():
            return tomllib.loads(place.read_text(encoding="utf-8"))
    raise FileNotFoundError(f"protocol definition not found: {' or '.join(map(str, _PLACES))}")


def crc16(octets: bytes) -> int:
    """CRC-16/IBM-3740 (polynomial 0x1021, start 0xFFFF, not reflected) of `octets`."""
    return binascii.crc_hqx(octets, _CRC_INITIAL)


def _without_docs(node: Any) -> Any:
    """The definition as far as it decides what bytes mean."""
    if isinstance(node, dict):
        return {k: _without_docs(v) for k, v in node.items() if k not in ("doc", "unit")}
    if isinstance(node, list):
        return [_without_docs(v) for v in node]
    return node


DEFINITION = _load()
_CRC_INITIAL: int = DEFINITION["framing"]["crc_initial"]
DELIMITER = bytes([DEFINITION["framing"]["delimiter"]])
CONSTANTS: dict[str, int] = {k: v["value"] for k, v in DEFINITION["constants"].items()}
ENUMS: dict[str, Enum] = {
    name: Enum(
        name,
        {m["name"]: m["value"] for m in e["members"]},
        {m["name"]: m["doc"] for m in e["members"]},
        e.get("flags", False),
    )
    for name, e in DEFINITION["enums"].items()
}
FRAMES: dict[str, Frame] = {e["name"]: Frame(e, CONSTANTS) for e in DEFINITION["frames"]}
FRAMES_BY_ID: dict[int, Frame] = {f.id: f for f in FRAMES.values()}
LAYOUT_CRC = crc16(
    json.dumps(_without_docs(DEFINITION), sort_keys=True, separators=(",", ":")).encode()
)

READINGS_PER_CELL = CONSTANTS["readings_per_cell"]
ADC_BITS = CONSTANTS["adc_bits"]
_CODE_MASK = (1 << ADC_BITS) - 1
# Four codes fill this many whole bytes whatever adc_bits is (10 bits: 5 bytes).
_GROUP_CODES = 4
_GROUP_BYTES = _GROUP_CODES * ADC_BITS // 8
_SHIFTS = np.arange(_GROUP_CODES, dtype=np.uint64) * np.uint64(ADC_BITS)


def rate_mhz(rate_hz: float) -> int:
    """A scan rate in the unit of the link [mHz].

    :raises ValueError: it is not finite, or so small that it would become 0: as fast as possible.
    """
    if not abs(rate_hz) < float("inf") or (rate_hz and not round(rate_hz * 1000)):
        raise ValueError(f"no board scans {rate_hz} times a second")
    return round(rate_hz * 1000)


def codes_size(rows: int, columns: int) -> int:
    """Bytes that the packed codes of a rows x columns scan take."""
    return -(-rows * columns * READINGS_PER_CELL * ADC_BITS // 8)


def unpack_codes(packed: bytes, rows: int, columns: int) -> NDArray[np.uint16]:
    """Codes of a scan, shape (rows, columns, readings), from the tail of a `scan` frame.

    On the wire cells are column-major and rows run fastest, see frames.toml.

    :raises ValueError: `packed` has the wrong length for rows x columns.
    """
    if len(packed) != codes_size(rows, columns):
        raise ValueError(f"{len(packed)} bytes of codes do not make {rows}x{columns} cells")
    count = rows * columns * READINGS_PER_CELL
    groups = -(-count // _GROUP_CODES)
    words = np.zeros((groups, 8), dtype=np.uint8)
    octets = np.frombuffer(packed, dtype=np.uint8)
    if len(octets) < groups * _GROUP_BYTES:
        octets = np.pad(octets, (0, groups * _GROUP_BYTES - len(octets)))
    words[:, :_GROUP_BYTES] = octets.reshape(groups, _GROUP_BYTES)
    spread = (words.view("<u8") >> _SHIFTS) & np.uint64(_CODE_MASK)
    codes: NDArray[np.uint16] = spread.astype(np.uint16).reshape(-1)[:count]
    return codes.reshape(columns, rows, READINGS_PER_CELL).transpose(1, 0, 2)


def pack_codes(codes: NDArray[np.uint16]) -> bytes:
    """The tail of a `scan` frame from codes of shape (rows, columns, readings).

    :raises ValueError: a code does not fit adc_bits.
    """
    if codes.size and int(codes.max()) > _CODE_MASK:
        raise ValueError(f"code above {_CODE_MASK}")
    rows, columns, _ = codes.shape
    flat = codes.transpose(1, 0, 2).reshape(-1).astype(np.uint64)
    flat = np.pad(flat, (0, -len(flat) % _GROUP_CODES))
    words = (flat.reshape(-1, _GROUP_CODES) << _SHIFTS).sum(axis=1, dtype=np.uint64)
    octets: NDArray[np.uint8] = words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :_GROUP_BYTES]
    return octets.tobytes()[: codes_size(rows, columns)]
