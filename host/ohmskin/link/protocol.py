# SPDX-License-Identifier: Apache-2.0
"""The link's definition, read from ``protocol/frames.toml``: the only source of its numbers.

``FRAMES`` maps names to `Frame`. A `Frame` packs and unpacks payloads as dictionaries, in which the
value of an enum field is a name. How a frame is put into bytes is in `framing`, above this module.

The definition is read when the module is imported. No number of it is written in Python, so board
and host cannot drift apart: a host of another definition sees that at the board's `hello`.
"""

import binascii
import json
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PACKAGE_DIR = Path(__file__).parents[1]
# A wheel carries the definition in the package; a checkout has it in protocol/.
_IN_PACKAGE = _PACKAGE_DIR / "frames.toml"
_IN_CHECKOUT = _PACKAGE_DIR.parents[1] / "protocol" / "frames.toml"
_STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I"}  # by the names of types in frames.toml

Value = int | str | tuple[str, ...] | tuple[int, ...]


@dataclass(frozen=True)
class Field:
    """One integer, or `count` of them, in a payload. All but `count` as in ``frames.toml``.

    name: of the field.
    type: of an integer: "u8", "u16" or "u32".
    doc: what the field means, a sentence.
    count: integers in the field.
    enum: the `Enum` one of whose members the integer is; the field's value is that member's name.
    flags: the `Enum` whose members are bits of the integer; the value is a tuple of the names of
        all members whose bit is set.
    unit: of the integer.
    """

    name: str
    type: str
    doc: str
    count: int = 1
    enum: str | None = None
    flags: str | None = None
    unit: str | None = None

    @property
    def span(self) -> int:
        """How many values an integer of this type has: a counter goes on with 0 after them."""
        return 1 << int(self.type.removeprefix("u"))

    @property
    def size(self) -> int:
        """Bytes of the whole field."""
        return self.count * struct.calcsize(_STRUCT_CODES[self.type])

    def integers(self, value: Value) -> tuple[int, ...]:
        """The integers that stand for a value.

        :raises ValueError: no member has this name, or a number does not fit the type.
        """
        if self.enum and isinstance(value, str):
            members = ENUMS[self.enum].values
            if value not in members:
                raise ValueError(f"{self.name}: {value!r} is none of {', '.join(members)}")
            value = members[value]
        elif self.flags and isinstance(value, tuple):
            value = sum(ENUMS[self.flags].values[str(name)] for name in value)
        given = value if isinstance(value, tuple) else (value,)
        integers = tuple(int(number) for number in given if isinstance(number, int | np.integer))
        if self.count == len(given) == sum(0 <= number < self.span for number in integers):
            return integers
        what = f"{self.count} whole numbers" if self.count > 1 else "a whole number"
        raise ValueError(f"{self.name} is {value!r}: must be {what} from 0 to {self.span - 1}")

    def value(self, integers: tuple[int, ...]) -> Value:
        """The value that integers of a payload stand for.

        An integer that is no member of the enum is ``"unknown_<integer>"``, because a damaged or
        odd board must not raise here: who uses the value decides what to do.
        """
        if self.enum:
            names = {value: name for name, value in ENUMS[self.enum].values.items()}
            return names.get(integers[0], f"unknown_{integers[0]}")
        if self.flags:
            return tuple(
                name for name, bit in ENUMS[self.flags].values.items() if integers[0] & bit
            )
        return integers if self.count > 1 else integers[0]


@dataclass(frozen=True)
class Enum:
    """Names for the values of a field.

    name: of the enum.
    values: the integer of each member, by its name.
    docs: what each member means, by its name.
    """

    name: str
    values: dict[str, int]
    docs: dict[str, str]


class Frame:
    """A kind of frame: what ``frames.toml`` says of it.

    name, id, doc: of this kind.
    sender: "board" or "host".
    fields: of the payload, in order.
    tail: what follows the fields, of any length; None for most kinds.
    struct: packs the integers of the fields.
    """

    def __init__(self, entry: Mapping[str, Any]) -> None:
        self.name: str = entry["name"]
        self.id: int = entry["id"]
        self.sender: str = entry["from"]
        self.doc: str = entry["doc"]
        self.tail: Mapping[str, str] | None = entry.get("tail")
        self.fields = tuple(
            Field(**{**field, "count": CONSTANTS[field["count"]] if "count" in field else 1})
            for field in entry["fields"]
        )
        codes = (f"{f.count if f.count > 1 else ''}{_STRUCT_CODES[f.type]}" for f in self.fields)
        self.struct = struct.Struct("<" + "".join(codes))

    def span(self, name: str) -> int:
        """`Field.span` of the field with this name."""
        return next(field.span for field in self.fields if field.name == name)

    def pack(self, **values: Value) -> bytes:
        """The payload (without tail) of this frame; every field must be given.

        :raises ValueError: an unknown or missing field, enum name, or a value outside the type.
        """
        names = {f.name for f in self.fields}
        if values.keys() != names:
            odd = ", ".join(sorted(values.keys() ^ names))
            raise ValueError(f"{self.name}: missing or unknown field: {odd}")
        return self.struct.pack(*(n for f in self.fields for n in f.integers(values[f.name])))

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """The fields of a payload by name; a tail is left alone.

        :raises ValueError: the payload has the wrong length for this frame.
        """
        size = self.struct.size
        if len(payload) < size or (self.tail is None and len(payload) != size):
            raise ValueError(f"{self.name}: payload of {len(payload)} bytes, {size} expected")
        flat = iter(self.struct.unpack_from(payload))
        return {f.name: f.value(tuple(islice(flat, f.count))) for f in self.fields}


def crc16(octets: bytes) -> int:
    """CRC-16/IBM-3740 of `octets`, as ``framing`` in ``frames.toml`` defines it.

    The library's function is fixed to this polynomial: tests fail if the definition says another.
    """
    return binascii.crc_hqx(octets, _CRC_INITIAL)


_PLACE = _IN_PACKAGE if _IN_PACKAGE.is_file() else _IN_CHECKOUT
DEFINITION: dict[str, Any] = tomllib.loads(_PLACE.read_text(encoding="utf-8"))
_CRC_INITIAL: int = DEFINITION["framing"]["crc_initial"]
DELIMITER = bytes([DEFINITION["framing"]["delimiter"]])
CONSTANTS: dict[str, int] = {k: v["value"] for k, v in DEFINITION["constants"].items()}
ENUMS: dict[str, Enum] = {
    name: Enum(
        name,
        {m["name"]: m["value"] for m in e["members"]},
        {m["name"]: m["doc"].format(**CONSTANTS) for m in e["members"]},
    )
    for name, e in DEFINITION["enums"].items()
}
# The names of each mode's readings, in the order of a cell.
MODES = {m["name"]: tuple(m["readings"]) for m in DEFINITION["enums"]["mode"]["members"]}
FRAMES: dict[str, Frame] = {e["name"]: Frame(e) for e in DEFINITION["frames"]}
FRAMES_BY_ID: dict[int, Frame] = {f.id: f for f in FRAMES.values()}
# The definition as far as it decides what bytes mean: its CRC may stay when a text is improved.
_LAYOUT = json.loads(
    json.dumps(DEFINITION),
    object_hook=lambda node: {k: v for k, v in node.items() if k not in ("doc", "unit")},
)
LAYOUT_CRC = crc16(json.dumps(_LAYOUT, sort_keys=True, separators=(",", ":")).encode())

READINGS_PER_CELL = CONSTANTS["readings_per_cell"]
# A scan passes over all cells so often, and takes `readings_per_pass` of each cell every time.
_PASSES = READINGS_PER_CELL // CONSTANTS["readings_per_pass"]
ADC_BITS = CONSTANTS["adc_bits"]
# The converter's largest code, for a voltage of Vdd (adc_bits of frames.toml).
LARGEST_CODE = (1 << ADC_BITS) - 1
# What each bit of a code counts, the least significant one first.
_BIT_VALUES = 1 << np.arange(ADC_BITS, dtype=np.uint16)


def rate_mhz(rate_hz: float) -> int:
    """A scan rate in the unit of the link [mHz].

    :raises ValueError: it is negative or not finite, or so small that it would be rounded to 0,
        which means as fast as possible.
    """
    if not 0 <= rate_hz * 1000 < float("inf") or (rate_hz and not round(rate_hz * 1000)):
        raise ValueError(f"no board scans {rate_hz} times a second")
    return round(rate_hz * 1000)


def codes_size(rows: int, columns: int) -> int:
    """Bytes that the packed codes of a rows x columns scan take."""
    return -(-rows * columns * READINGS_PER_CELL * ADC_BITS // 8)


def unpack_codes(packed: bytes, rows: int, columns: int) -> NDArray[np.uint16]:
    """Codes of a scan, shape (rows, columns, readings), from the tail of a `scan` frame.

    :raises ValueError: `packed` has the wrong length for rows x columns.
    """
    if len(packed) != codes_size(rows, columns):
        raise ValueError(f"{len(packed)} bytes of codes do not make {rows}x{columns} cells")
    bits = np.unpackbits(
        np.frombuffer(packed, dtype=np.uint8),
        count=rows * columns * READINGS_PER_CELL * ADC_BITS,
        bitorder="little",
    )
    codes: NDArray[np.uint16] = bits.reshape(-1, ADC_BITS) @ _BIT_VALUES
    return from_scan_order(codes, rows, columns)


def in_scan_order(readings: NDArray[Any]) -> NDArray[Any]:
    """Readings (rows, columns, readings) one after the other, as a board takes and sends them.

    Two readings of each cell, rows running fastest, then the other two of each cell.
    """
    passes = readings.reshape(*readings.shape[:2], _PASSES, -1)
    return passes.transpose(2, 1, 0, 3).ravel()


def from_scan_order(in_order: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """The inverse of `in_scan_order`: shape (rows, columns, readings)."""
    passes = in_order.reshape(_PASSES, columns, rows, -1)
    return passes.transpose(2, 1, 0, 3).reshape(rows, columns, READINGS_PER_CELL)


def pack_codes(codes: NDArray[np.uint16]) -> bytes:
    """The tail of a `scan` frame from codes of shape (rows, columns, readings).

    :raises ValueError: a code does not fit adc_bits.
    """
    if codes.size and int(codes.max()) > LARGEST_CODE:
        raise ValueError(f"code above {LARGEST_CODE}")
    in_order = in_scan_order(codes).astype("<u2").reshape(-1, 1)
    bits = np.unpackbits(in_order.view(np.uint8), axis=1, count=ADC_BITS, bitorder="little")
    return np.packbits(bits, bitorder="little").tobytes()
