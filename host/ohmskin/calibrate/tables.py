# SPDX-License-Identifier: Apache-2.0
"""Numbers from CSV files: what a force sensor logged, and presses of cells by known forces.

A force log has the columns time_s [s], by any clock, and force_n [N], a press being positive. Its
further columns are ignored.

A table of presses has these columns and no others, for a misspelt name would lose a column:

=============== ============================================================
column          meaning
=============== ============================================================
row, column     the cell, counted from 0
force_n         force on it [N]
conductance     of the cell meanwhile [S]
conductance_std standard deviation of that [S]; the column may be absent: 0
=============== ============================================================

Columns stand in any order under a header, with commas between them and points in their numbers.
Nothing is guessed: a file that is not plainly so raises a ValueError of one line, which names the
file, the row (the header is row 1) and the column, and says what to do.
"""

import codecs
import csv
import io
import math
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import InitVar, dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.files import PathName, naming, read_bounded, save_table
from ohmskin.force.curve import require_rows
from ohmskin.record.readings import MAX_CELLS

# An hour of a sensor at 1 kHz, with columns of other things.
MAX_FILE_BYTES: Final = 100_000_000
# No force, time or conductance in any unit is larger, and sums of squares do not overflow.
MAX_NUMBER: Final = 1e60
# A cell of 1 ohm has less resistance than its wires [S]: more is a number in another unit.
MAX_CONDUCTANCE: Final = 1.0
# A message shows so many characters of what stands in the file.
_SHOWN: Final = 60

# Fewer samples of a force are no session of presses.
MIN_SAMPLES: Final = 10
# A step between two samples is a gap if it is longer than this [s], and than so many median steps:
# slow sensors have long steps, fast ones have short hiccups.
GAP_S: Final = 0.5
GAP_STEPS: Final = 10.0
# Noise about zero goes below it by so much [N], or by this share of the largest force.
NEGATIVE_N: Final = 0.05
NEGATIVE_SHARE: Final = 0.02

_CELL: Final = ("row", "column")
_NEEDED: Final = (*_CELL, "force_n", "conductance")
_COLUMNS: Final = (*_NEEDED, "conductance_std")
# Type of one press; columns and units as above.
PRESS: Final = np.dtype([(name, np.int64 if name in _CELL else np.float64) for name in _COLUMNS])
# Presses (n,), each of the type `PRESS`.
PressTable = NDArray[np.void]
# What to do with a column of another unit, by the column that is missing.
_UNITS: Final = {
    "time_s": " (seconds: 0.001 times milliseconds)",
    "force_n": " (newtons: 0.00980665 times grams)",
    "conductance": " (siemens: 1e-6 times microsiemens, or 1 / ohms)",
}


@dataclass(frozen=True, eq=False)
class ForceLog:
    """Forces by the sensor's clock: time_s (n,) [s], increasing; force_n (n,) [N].

    Raises ValueError for fewer than 10 samples, for times that do not increase, for a force that
    never changes, and for presses that are negative. Sensor noise about zero may be negative: down
    to 0.05 N, or 2 % of the largest force. rows: where in a file each sample stands, for the texts
    of errors.
    """

    time_s: Float
    force_n: Float
    rows: InitVar[NDArray[np.int64] | None] = None

    def __post_init__(self, rows: NDArray[np.int64] | None) -> None:
        time_s, force_n = self.time_s, self.force_n
        if time_s.size < MIN_SAMPLES:
            raise ValueError(f"too few samples: {time_s.size}, {MIN_SAMPLES} are needed")
        later = np.diff(time_s, prepend=-np.inf) > 0
        require_rows("time_s", time_s, later, "later than the one before", rows)
        if np.ptp(force_n) == 0:
            raise ValueError(f"force_n is {force_n[0]:g} throughout: does the sensor measure?")
        limit = max(NEGATIVE_N, NEGATIVE_SHARE * float(force_n.max()))
        if np.count_nonzero(force_n < -limit) > np.count_nonzero(force_n > limit):
            least = float(force_n.min())
            raise ValueError(f"forces go down to {least:g} N, a press is negative: turn the sign")
        must = f"-{limit:.2g} N or more: zero the sensor"
        require_rows("force_n", force_n, force_n >= -limit, must, rows)

    def at(self, time_s: ArrayLike) -> Float:
        """Force [N] at these times of the sensor's clock, of any shape: linear between samples.

        NaN before the first sample, after the last, and inside gaps.
        """
        return between_gaps(time_s, self.time_s, self.force_n)


def between_gaps(at_s: ArrayLike, time_s: Float, values: Float) -> Float:
    """`values` (n,) of increasing times `time_s` (n,), interpolated at `at_s` of any shape.

    NaN outside of `time_s`, and inside its gaps: steps above `GAP_S` and `GAP_STEPS` median steps.
    """
    wanted = np.asarray(at_s, dtype=np.float64)
    found = np.asarray(np.interp(wanted, time_s, values, left=np.nan, right=np.nan))
    steps = np.diff(time_s)
    is_gap = (steps > GAP_S) & (steps > GAP_STEPS * np.median(steps))
    after = np.searchsorted(time_s, wanted).clip(1, time_s.size - 1)
    inside = (wanted > time_s[after - 1]) & (wanted < time_s[after])
    return np.where(inside & is_gap[after - 1], np.nan, found)


def load_force_log(path: PathName) -> ForceLog:
    """Read a force log. Raises ValueError: see the module."""
    with naming(path):
        columns, rows = _read(path, ("time_s", "force_n"))
        return ForceLog(**columns, rows=rows)


def load_press_table(path: PathName) -> PressTable:
    """Read a table of presses, (n,) of `PRESS`, at least one. Raises ValueError: see the module."""
    with naming(path):
        columns, rows = _read(path, _NEEDED, _COLUMNS[len(_NEEDED) :])
        if not rows.size:
            raise ValueError("no press is in it")
        table = np.zeros(rows.size, PRESS)
        for name, values in columns.items():
            most, must = MAX_CONDUCTANCE, "0 to 1 S: of microsiemens, write 1e-6 times as much"
            if name in _CELL:
                most, must = MAX_CELLS - 1, f"a whole number from 0 to {MAX_CELLS - 1}"
            elif name == "force_n":
                most, must = MAX_NUMBER, "0 or more: zero the force sensor, or leave the row out"
            good = (values >= 0) & (values <= most)
            good &= (name not in _CELL) | (values == np.floor(values))
            require_rows(name, values, good, must, rows)
            table[name] = values
        return table


def save_press_table(path: PathName, table: PressTable) -> None:
    """Write a file that is either complete or not there, and is read back bit for bit.

    Raises ValueError if it cannot be written.
    """
    save_table(path, _COLUMNS, table.tolist())


def _read(
    path: PathName, needed: Sequence[str], optional: Sequence[str] | None = None
) -> tuple[dict[str, Float], NDArray[np.int64]]:
    """Columns (n,) by name, and the number (n,) in the file of each row.

    needed, optional: names, matched whatever their case. Further columns are refused; where no
    optional ones are told they are ignored, and may hold what is no UTF-8. Empty rows count, but
    hold nothing.
    """
    octets = read_bounded(path, MAX_FILE_BYTES)
    if octets.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError("it is UTF-16: save it as UTF-8")
    lines = _rows(io.TextIOWrapper(io.BytesIO(octets), "utf-8-sig", errors="replace", newline=""))
    _, header = next(lines, (1, []))
    places = _places(header, needed, optional)
    columns = {name: array("d") for name in places}
    rows = array("q")
    for row, cells in lines:
        if len(cells) != len(header):
            remedy = "give each column one field, and write a point, no comma, in numbers"
            raise ValueError(
                f"row {row} has {len(cells)} fields, the header {len(header)}: {remedy}"
            )
        rows.append(row)
        for name, place in places.items():
            columns[name].append(_number(cells[place], name, row))
    return {name: np.array(each) for name, each in columns.items()}, np.array(rows, np.int64)


def _rows(text: io.TextIOWrapper) -> Iterator[tuple[int, list[str]]]:
    """The rows that are not empty, each with its number."""
    reader, row = csv.reader(text, strict=True), 1
    try:
        for cells in reader:
            if len(cells) > 1 or "".join(cells).strip():
                yield row, cells
            row = reader.line_num + 1
    except csv.Error as error:
        raise ValueError(f"row {row} is damaged: {error}: mend it, or leave it out") from error


def _places(
    header: list[str], needed: Sequence[str], optional: Sequence[str] | None
) -> dict[str, int]:
    """In which field of a row each of our columns stands."""
    names = [name.strip().lower() for name in header]
    ours = [*needed, *(optional or ())]
    for name in needed:
        if name not in names:
            shown = ",".join(header)[:_SHOWN]
            hint = ": separate columns by commas" if re.search("[;\t]", shown) else ""
            must = f"row 1 must be the header {','.join(needed)}, it is {shown!r}{hint}"
            raise ValueError(f"no column {name}{_UNITS.get(name, '')}: {must}")
    for title, name in zip(header, names, strict=True):
        if name not in ours and optional is not None:
            known = ", ".join(ours)
            raise ValueError(f"unknown column {title[:_SHOWN]!r}: leave it out; known are {known}")
        if name in ours and names.count(name) > 1:
            raise ValueError(f"column {name} stands twice")
    return {name: names.index(name) for name in ours if name in names}


def _number(cell: str, name: str, row: int) -> float:
    try:
        number = math.nan if "_" in cell else float(cell)  # Python takes 1_000 for a number
    except ValueError:
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        must = "write a finite number, with a point and no comma, or leave the row out"
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN]!r}: {must}")
    return number
