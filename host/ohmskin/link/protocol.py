# SPDX-License-Identifier: Apache-2.0
"""The link's definition, read from ``protocol/frames.toml``: the only source of its numbers.

A `Definition` maps names to `Frame`. A `Frame` packs and unpacks payloads as dictionaries, in which
the value of an enum field is a name. `framing` puts such payloads into frames.

No number of the link is written in Python, so board and host cannot drift apart: a board says by
the CRC of its layout which definition it was built from. `NOW` is that of this host, whose contents
are also names of this module. `definition` has those of boards that were flashed before
(``protocol/layouts``).
"""

import binascii
import json
import math
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PACKAGE_DIR = Path(__file__).parents[1]
# A wheel carries the definitions in the package; a checkout has them in protocol/.
_IN_PACKAGE = _PACKAGE_DIR / "protocol"
_IN_CHECKOUT = _PACKAGE_DIR.parents[1] / "protocol"
_PLACE = _IN_PACKAGE if _IN_PACKAGE.is_dir() else _IN_CHECKOUT
_TEXT = "text"  # the type whose integers are letters
# By the names of types in frames.toml.
_STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I", _TEXT: "s"}

Value = int | str | tuple[str, ...] | tuple[int, ...]


@dataclass(frozen=True)
class Field:
    """One integer, or `count` of them, in a payload. All but `members` as in ``frames.toml``.

    name: of the field.
    type: of an integer: "u8", "u16" or "u32"; "text": of letters, which are bytes.
    doc: what the field means, a sentence.
    members: the integers of the `Enum` of `enum` or `flags`, by their names; empty without one.
    count: integers in the field.
    enum: the `Enum` one of whose members the integer is; the field's value is that member's name.
    flags: the `Enum` whose members are bits of the integer; the value is a tuple of the names of
        all members whose bit is set.
    unit: of the integer.
    """

    name: str
    type: str
    doc: str
    members: Mapping[str, int]
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
        return struct.calcsize(self.code)

    @property
    def code(self) -> str:
        """The field in the words of the module `struct`."""
        return f"{self.count}{_STRUCT_CODES[self.type]}"

    def packed(self, value: Value) -> tuple[int | bytes, ...]:
        """What `struct` packs for a value.

        :raises ValueError: no member has this name, or a number does not fit the type.
        """
        if self.type == _TEXT:
            letters = str(value).encode("ascii", "replace")
            if len(letters) > self.count:
                raise ValueError(f"{self.name} is {value!r:.40}: {self.count} letters at most")
            return (letters,)
        if self.enum and isinstance(value, str):
            if value not in self.members:
                raise ValueError(f"{self.name}: {value!r} is none of {', '.join(self.members)}")
            value = self.members[value]
        elif self.flags and isinstance(value, tuple):
            value = sum(self.members[str(name)] for name in value)
        given = value if isinstance(value, tuple) else (value,)
        integers = tuple(int(number) for number in given if isinstance(number, int | np.integer))
        if self.count == len(given) == sum(0 <= number < self.span for number in integers):
            return integers
        what = f"{self.count} whole numbers" if self.count > 1 else "a whole number"
        raise ValueError(f"{self.name} is {value!r}: must be {what} from 0 to {self.span - 1}")

    def value(self, unpacked: tuple[Any, ...]) -> Value:
        """The value that integers, or the letters, of a payload stand for.

        An integer that is no member of the enum is ``"unknown_<integer>"``, because a damaged or
        odd board must not raise here: who uses the value decides what to do. A letter that cannot
        be printed is ``?``.
        """
        if self.type == _TEXT:
            text = unpacked[0].rstrip(b"\0").decode("ascii", "replace")
            return "".join(letter if letter.isprintable() else "?" for letter in text)
        if self.enum:
            names = {value: name for name, value in self.members.items()}
            return names.get(unpacked[0], f"unknown_{unpacked[0]}")
        if self.flags:
            return tuple(name for name, bit in self.members.items() if unpacked[0] & bit)
        return unpacked if self.count > 1 else int(unpacked[0])


@dataclass(frozen=True)
class Enum:
    """Names for the values of a field.

    values: the integer of each member, by its name.
    docs: what each member means, by its name.
    """

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

    def __init__(
        self, entry: Mapping[str, Any], constants: Mapping[str, int], enums: Mapping[str, Enum]
    ) -> None:
        self.name: str = entry["name"]
        self.id: int = entry["id"]
        self.sender: str = entry["from"]
        self.doc: str = entry["doc"]
        self.tail: Mapping[str, str] | None = entry.get("tail")
        self.fields = tuple(
            Field(
                **{**field, "count": constants[field["count"]] if "count" in field else 1},
                members=enums[of].values if (of := field.get("enum") or field.get("flags")) else {},
            )
            for field in entry["fields"]
        )
        self.struct = struct.Struct("<" + "".join(field.code for field in self.fields))

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
        return self.struct.pack(*(n for f in self.fields for n in f.packed(values[f.name])))

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """The fields of a payload by name; a tail is left alone.

        :raises ValueError: the payload has the wrong length for this frame.
        """
        size = self.struct.size
        if len(payload) < size or (self.tail is None and len(payload) != size):
            raise ValueError(f"{self.name}: payload of {len(payload)} bytes, {size} expected")
        flat = iter(self.struct.unpack_from(payload))
        counts = ((f, 1 if f.type == _TEXT else f.count) for f in self.fields)
        return {f.name: f.value(tuple(islice(flat, count))) for f, count in counts}


class Definition:
    """All that a ``frames.toml`` says.

    content: of the file, as `tomllib` reads it.
    constants: by their names.
    enums: by their names.
    modes: names of each mode's readings, in the order of a cell.
    per_pass: how many readings of a cell follow each other in each mode; a scan passes over all
        cells for each such group.
    frames, frames_by_id: kinds of frames, by name and by id.
    layout_crc: of the definition as far as it decides what bytes mean: texts may be improved.
    """

    def __init__(self, content: dict[str, Any]) -> None:
        self.content = content
        self.constants: dict[str, int] = {k: v["value"] for k, v in content["constants"].items()}
        self.enums = {
            name: Enum(
                {m["name"]: m["value"] for m in enum["members"]},
                {m["name"]: m["doc"].format(**self.constants) for m in enum["members"]},
            )
            for name, enum in content["enums"].items()
        }
        modes = content["enums"]["mode"]["members"]
        self.modes = {m["name"]: tuple(m["readings"]) for m in modes}
        of_all = self.constants.get("readings_per_pass", 0)  # in definitions before `per_pass`
        self.per_pass = {m["name"]: int(m.get("per_pass", of_all)) for m in modes}
        self.frames = {
            entry["name"]: Frame(entry, self.constants, self.enums) for entry in content["frames"]
        }
        self.frames_by_id = {frame.id: frame for frame in self.frames.values()}
        layout = json.loads(
            json.dumps(content),
            object_hook=lambda node: {k: v for k, v in node.items() if k not in ("doc", "unit")},
        )
        octets = json.dumps(layout, sort_keys=True, separators=(",", ":")).encode()
        self.layout_crc = binascii.crc_hqx(octets, content["framing"]["crc_initial"])


def _read(path: Path) -> Definition:
    return Definition(tomllib.loads(path.read_text(encoding="utf-8")))


@cache
def definition(layout_crc: int) -> Definition | None:
    """What a board with this layout was built from; None if this host has no such definition."""
    if layout_crc == LAYOUT_CRC:
        return NOW
    path = _PLACE / "layouts" / f"{layout_crc:04X}.toml"
    return _read(path) if path.is_file() else None


def crc16(octets: bytes) -> int:
    """CRC-16/IBM-3740 of `octets`, as ``framing`` in ``frames.toml`` defines it.

    The library's function is fixed to this polynomial: tests fail if the definition says another.
    """
    return binascii.crc_hqx(octets, _CRC_INITIAL)


NOW = _read(_PLACE / "frames.toml")
DEFINITION, CONSTANTS, ENUMS = NOW.content, NOW.constants, NOW.enums
MODES, PER_PASS = NOW.modes, NOW.per_pass
FRAMES, FRAMES_BY_ID, LAYOUT_CRC = NOW.frames, NOW.frames_by_id, NOW.layout_crc
_CRC_INITIAL: int = DEFINITION["framing"]["crc_initial"]
DELIMITER = bytes([DEFINITION["framing"]["delimiter"]])
# Fields of `configure` that `hello` says by another name.
ASKED = {"rate_mhz": "rate_asked_mhz", "settle_us": "settle_asked_us"}
# Bits of a code where nobody says otherwise: those of an AVR's converter, and of emulated boards.
ADC_BITS = 10
# The largest code of such a converter, for a voltage of Vdd.
LARGEST_CODE = (1 << ADC_BITS) - 1


def rate_mhz(rate_hz: float) -> int:
    """A scan rate in the unit of the link [mHz].

    :raises ValueError: it is negative or not finite, or so small that it would be rounded to 0,
        which means as fast as possible.
    """
    if not 0 <= rate_hz * 1000 < float("inf") or (rate_hz and not round(rate_hz * 1000)):
        raise ValueError(f"no board scans {rate_hz} times a second")
    return round(rate_hz * 1000)


def codes_size(count: int, bits: int = ADC_BITS) -> int:
    """Bytes that so many packed codes take."""
    return -(-count * bits // 8)


def unpack_codes(
    packed: bytes, shape: tuple[int, int, int], per_pass: int = 2, bits: int = ADC_BITS
) -> NDArray[np.uint16]:
    """Codes of this shape (rows, columns, readings) from the tail of a `scan` frame.

    per_pass: readings of a cell that follow each other (`Definition.per_pass`). bits: of a code.

    :raises ValueError: `packed` has the wrong length for them.
    """
    count = math.prod(shape)
    if len(packed) != codes_size(count, bits):
        size = " x ".join(map(str, shape))
        raise ValueError(f"{len(packed)} bytes of codes do not make {size} codes of {bits} bits")
    in_bits = np.unpackbits(
        np.frombuffer(packed, dtype=np.uint8), count=count * bits, bitorder="little"
    )
    # What each bit of a code counts, the least significant one first.
    codes: NDArray[np.uint16] = in_bits.reshape(-1, bits) @ (1 << np.arange(bits, dtype=np.uint16))
    return from_scan_order(codes, shape, per_pass)


def in_scan_order(readings: NDArray[Any], per_pass: int = 2) -> NDArray[Any]:
    """Readings (rows, columns, readings) one after the other, as a board takes and sends them.

    The first `per_pass` readings of each cell, rows running fastest, then the next of each cell.
    """
    passes = readings.reshape(*readings.shape[:2], -1, per_pass)
    return passes.transpose(2, 1, 0, 3).ravel()


def from_scan_order(
    in_order: NDArray[Any], shape: tuple[int, int, int], per_pass: int = 2
) -> NDArray[Any]:
    """The inverse of `in_scan_order`: of this shape (rows, columns, readings)."""
    rows, columns, readings = shape
    passes = in_order.reshape(readings // per_pass, columns, rows, per_pass)
    return passes.transpose(2, 1, 0, 3).reshape(shape)


def pack_codes(codes: NDArray[np.uint16], per_pass: int = 2, bits: int = ADC_BITS) -> bytes:
    """The tail of a `scan` frame from codes of shape (rows, columns, readings).

    :raises ValueError: a code does not fit its bits.
    """
    if codes.size and int(codes.max()) >> bits:
        raise ValueError(f"code above {(1 << bits) - 1}")
    in_order = in_scan_order(codes, per_pass).astype("<u2").reshape(-1, 1)
    in_bits = np.unpackbits(in_order.view(np.uint8), axis=1, count=bits, bitorder="little")
    return np.packbits(in_bits, bitorder="little").tobytes()


@lru_cache
def all_lines(count: int) -> int:
    """The mask of the first `count` rows or columns, of as many as a mask has bits for."""
    return (1 << min(count, CONSTANTS["rows_max"])) - 1


def whole_masks(rows: int, columns: int) -> dict[str, Any]:
    """The fields `row_mask` and `column_mask` of all of so many rows and columns."""
    return {"row_mask": all_lines(rows), "column_mask": all_lines(columns)}


@lru_cache
def lines_of(mask: int, count: int) -> tuple[int, ...]:
    """The numbers of the rows or columns that are in a mask, rising; there are `count` of them.

    :raises ValueError: others are in it.
    """
    if mask > all_lines(count):
        raise ValueError(f"a mask has lines beyond the {count} that there are")
    return tuple(line for line in range(mask.bit_length()) if mask >> line & 1)
