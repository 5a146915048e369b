# SPDX-License-Identifier: Apache-2.0
"""Columns of numbers from a CSV that somebody else wrote: comma, decimal point, a header.

Nothing is guessed: a table that is not plainly this is a ValueError that says which row is not.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import os
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float

MAX_FILE_BYTES: Final = 100_000_000
# No force, time or conductance in any unit, and sums of squares do not overflow.
MAX_NUMBER: Final = 1e60
_SHOWN: Final = 40  # characters of a cell or a header in a message


@dataclass(frozen=True, eq=False)
class NumberTable:
    """columns: name to numbers (n,), finite. rows (n,): where in the file, its header being 1."""

    columns: Mapping[str, Float]
    rows: NDArray[np.int64]


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the file's name before whatever ValueError comes from inside, and keep it one line."""
    try:
        yield
    except ValueError as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{os.fspath(path)}: {reason}") from error


def read_numbers(
    path: str | os.PathLike[str],
    needed: Sequence[str],
    *,
    optional: Sequence[str] = (),
    others: bool,
    instead: Mapping[str, tuple[str, str]],
) -> NumberTable:
    """The columns `needed`, and those `optional` that are there, of a CSV of at most 100 MB.

    Names are matched whatever their case. others: further columns are ignored, else refused.
    instead: by a column's name, in lower case with `_` for all but letters and digits, which of
    ours it stands for, and what to do: {"time_ms": ("time_s", "divide it by 1000")}.

    Empty lines count as rows but hold nothing. Bytes that are no UTF-8 may stand in columns that
    are ignored. Raises ValueError, without the path: see `naming`.
    """
    return _parse(_octets(path), needed, optional, others, instead)


def other_units(
    ours: str, quantities: Sequence[str], factors: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """What `read_numbers` says `instead` of columns such as time_ms, by what makes them ours."""
    return {
        f"{quantity}_{unit}": (ours, "rename it" if factor == "1" else f"multiply it by {factor}")
        for quantity in quantities
        for unit, factor in factors.items()
    }


def _octets(path: str | os.PathLike[str]) -> bytes:
    try:
        with open(path, "rb") as file:
            octets = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    if len(octets) > MAX_FILE_BYTES:
        raise ValueError(f"more than {MAX_FILE_BYTES} bytes: cut it into parts")
    if octets.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError("it is UTF-16: save it as UTF-8")
    return octets


def _parse(
    octets: bytes,
    needed: Sequence[str],
    optional: Sequence[str],
    others: bool,
    instead: Mapping[str, tuple[str, str]],
) -> NumberTable:
    text = io.TextIOWrapper(io.BytesIO(octets), "utf-8-sig", errors="replace", newline="")
    reader = csv.reader(text, strict=True)
    header: list[str] = []
    taken: list[tuple[int, str, array[float]]] = []
    rows = array("q")
    while True:
        row = reader.line_num + 1
        try:
            fields = next(reader, None)
        except csv.Error as error:
            raise ValueError(f"row {row} is damaged: {error}: mend it, or leave it out") from error
        if fields is None:
            break
        if len(fields) < 2 and not "".join(fields).strip():
            continue
        if not header:
            header = fields
            places = _places(header, needed, optional, others, instead)
            taken = [(place, name, array("d")) for name, place in places.items()]
            continue
        if len(fields) != len(header):
            hint = ", and a point, no comma, in numbers" if len(fields) > len(header) else ""
            raise ValueError(
                f"row {row} has {len(fields)} fields, the header {len(header)}: "
                f"give each column one field{hint}"
            )
        rows.append(row)
        for place, name, numbers in taken:
            numbers.append(_number(fields[place], name, row))
    if not header:
        raise ValueError(f"it is empty: it needs the header {','.join(needed)}")
    return NumberTable(
        {name: np.array(numbers, dtype=np.float64) for _, name, numbers in taken},
        np.array(rows, dtype=np.int64),
    )


def _places(
    header: list[str],
    needed: Sequence[str],
    optional: Sequence[str],
    others: bool,
    instead: Mapping[str, tuple[str, str]],
) -> dict[str, int]:
    """In which field each of our columns stands."""
    names = [name.strip().lower() for name in header]
    wanted = ",".join(needed)
    places: dict[str, int] = {}
    for place, name in enumerate(names):
        if name in needed or name in optional:
            if name in places:
                raise ValueError(f"column {name} stands twice")
            places[name] = place
    missing = [name for name in needed if name not in places]
    if missing:
        if all(_is_number(name) for name in names):
            raise ValueError(f"row 1 holds numbers: put the header {wanted} above it")
        for separator, called in ((";", "semicolons"), ("\t", "tabs")):
            if any(separator in name for name in names):
                raise ValueError(
                    f"{called} separate its columns: use commas, and a point in numbers"
                )
    for place, name in enumerate(names):
        ours, advice = instead.get(_plain(name), ("", ""))
        if place not in places.values() and (ours in missing or (ours and not others)):
            raise ValueError(f"column {header[place][:_SHOWN]!r}: {ours} is wanted: {advice}")
    if missing:
        there = ", ".join(repr(name[:_SHOWN]) for name in header[:8])
        raise ValueError(f"no column {missing[0]}: the header must hold {wanted}, it is {there}")
    if not others:
        for place, name in enumerate(header):
            if place not in places.values():
                raise ValueError(f"unknown column {name[:_SHOWN]!r}: leave it out")
    return places


def _plain(name: str) -> str:
    micro = name.replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    ohm = micro.replace("\N{GREEK SMALL LETTER OMEGA}", "ohm")  # the capital's lower case, too
    # What was no UTF-8 stays: it may be the micro of a unit.
    return re.sub("[^a-z0-9\N{REPLACEMENT CHARACTER}]+", "_", ohm).strip("_")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _number(cell: str, name: str, row: int) -> float:
    try:
        number = float(cell)
    except ValueError:
        if not cell.strip():
            raise ValueError(f"row {row}: {name} is empty: give a number") from None
        hint = ": use a point, no comma" if re.fullmatch(r"[-+\d.]*,[\d,.]*", cell.strip()) else ""
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN]!r}, not a number{hint}") from None
    if not math.isfinite(number):
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN]!r}, not finite: leave the row out")
    if abs(number) > MAX_NUMBER:
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN]!r}, beyond {MAX_NUMBER:g}")
    if "_" in cell:  # Python's own way to group digits
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN]!r}, not a number")
    return number
