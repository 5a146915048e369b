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
Nothing is guessed, because a wrong guess would make a calibration that is wrong and looks right. A
file that is not plainly so raises a ValueError of one line, which names the file, the row (the
header is row 1) and the column, and says what to do.
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

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.rules import require_forces, require_rows
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS
from ohmskin.files import PathName, naming, read_bounded, save_table
from ohmskin.force.calibration import MAX_NUMBER
from ohmskin.record.readings import MAX_LINES

# A larger file is not read. Chosen: an hour of a sensor at 1 kHz, with columns of other things.
MAX_TABLE_BYTES: Final = 100_000_000
# A message shows so many characters of what stands in the file. Chosen: one line of a terminal.
_SHOWN_CHARS: Final = 60

# Fewer samples of a force are no session of presses. Chosen: a fast sensor makes more in a press.
MIN_SAMPLES: Final = 10
# A step between two samples is a gap, in which the force is not known, if it is longer than this
# and than `GAP_STEPS`. Chosen: a fast sensor's hiccups are shorter, and no gaps.
GAP_S: Final = 0.5
# A gap is also longer than so many median steps. Chosen: the steps of slow sensors are long, and
# are no gaps.
GAP_STEPS: Final = 10.0
# A force may be negative by this, which is a sensor's noise about zero. Chosen: a load cell that
# was zeroed stays within.
NEGATIVE_N: Final = 0.05
# A force may also be negative by this share of the largest force. Chosen: the zero of a load cell
# moves with the force that it has borne.
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
    """Forces by the sensor's clock.

    time_s: of each sample, (n,) [s], increasing.
    force_n: (n,) [N]. Noise about zero may be negative: see `NEGATIVE_N`.
    rows: where in a file each sample stands, (n,), for the texts of errors; None: not in a file.
    any_zero: whether its zero is found later, so that it may be anything.

    Raises ValueError for fewer than `MIN_SAMPLES`, for times that do not increase, for a force that
    never changes, and for presses that are negative.
    """

    time_s: Float
    force_n: Float
    rows: InitVar[NDArray[np.int64] | None] = None
    any_zero: InitVar[bool] = False

    def __post_init__(self, rows: NDArray[np.int64] | None, any_zero: bool) -> None:
        time_s, force_n = self.time_s, self.force_n
        if time_s.size < MIN_SAMPLES:
            raise ValueError(f"too few samples: {time_s.size}, {MIN_SAMPLES} are needed")
        later = np.diff(time_s, prepend=-np.inf) > 0
        require_rows("time_s", time_s, later, "later than the one before", rows)
        if np.ptp(force_n) == 0:
            raise ValueError(f"force_n is {force_n[0]:g} throughout: does the sensor measure?")
        if any_zero:
            return
        limit = max(NEGATIVE_N, NEGATIVE_SHARE * float(force_n.max()))
        # A sensor mounted upside down has more samples below zero than above it.
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

    NaN outside of `time_s`, and inside its gaps (`gaps`).
    """
    at_s = np.asarray(at_s, dtype=np.float64)
    interpolated = np.asarray(np.interp(at_s, time_s, values, left=np.nan, right=np.nan))
    after = np.searchsorted(time_s, at_s).clip(1, time_s.size - 1)
    inside = (at_s > time_s[after - 1]) & (at_s < time_s[after])
    return np.where(inside & gaps(time_s)[after - 1], np.nan, interpolated)


def gaps(time_s: Float) -> Bool:
    """Which steps of times (n,) are gaps, (n-1,): above `GAP_S` and `GAP_STEPS` median steps."""
    steps_s = np.diff(time_s)
    return np.asarray((steps_s > GAP_S) & (steps_s > GAP_STEPS * np.median(steps_s)))


def load_force_log(path: PathName, *, any_zero: bool = False) -> ForceLog:
    """Read a force log. any_zero: as for it. Raises ValueError: see the module."""
    with naming(path):
        columns, rows = _read(path, ("time_s", "force_n"), None)
        return ForceLog(**columns, rows=rows, any_zero=any_zero)


def load_press_table(path: PathName) -> PressTable:
    """Read a table of presses, (n,) of `PRESS`, at least one. Raises ValueError: see the module."""
    with naming(path):
        columns, rows = _read(path, _NEEDED, _COLUMNS[len(_NEEDED) :])
        if not rows.size:
            raise ValueError("no press is in it")
        table = np.zeros(rows.size, PRESS)
        for name, values in columns.items():
            if name == "force_n":
                require_forces(values, rows)
            elif name in _CELL:  # which cells there are, the skin knows: see `check_cell`
                whole = (values >= 0) & (values < MAX_LINES) & (values == np.floor(values))
                must = f"a whole number from 0 to {MAX_LINES - 1}"
                require_rows(name, values, whole, must, rows)
            else:
                # Estimators state no more: a larger conductance is a number in another unit.
                of_cell = (values >= 0) & (values <= MAX_CELL_SIEMENS)
                must = "0 to 1 S: of microsiemens, write 1e-6 times as much"
                require_rows(name, values, of_cell, must, rows)
            table[name] = values
        return table


def save_press_table(path: PathName, table: PressTable) -> None:
    """Write a file that is either complete or not there, and is read back bit for bit.

    Raises ValueError if it cannot be written.
    """
    save_table(path, _COLUMNS, table.tolist())


def _read(
    path: PathName, needed: Sequence[str], optional: Sequence[str] | None
) -> tuple[dict[str, Float], NDArray[np.int64]]:
    """Columns (n,) by name, and the number (n,) in the file of each row.

    Empty rows count, but hold nothing. Names of columns are matched whatever their case.

    needed: names of columns that must be there.
    optional: names of columns that may be there, while others are refused; None: all others may,
        and are ignored. Then they may hold what is no UTF-8.
    """
    octets = read_bounded(path, MAX_TABLE_BYTES)
    if octets.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError("it is UTF-16: save it as UTF-8")
    lines = _rows(io.TextIOWrapper(io.BytesIO(octets), "utf-8-sig", errors="replace", newline=""))
    _, header = next(lines, (1, []))
    places = _places(header, needed, optional)
    columns = {name: array("d") for name in places}  # a quarter of the memory of lists
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
    return {name: np.array(column) for name, column in columns.items()}, np.array(rows, np.int64)


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
            shown = ",".join(header)[:_SHOWN_CHARS]
            hint = ": separate columns by commas" if re.search("[;\t]", shown) else ""
            must = f"row 1 must be the header {','.join(needed)}, it is {shown!r}{hint}"
            raise ValueError(f"no column {name}{_UNITS.get(name, '')}: {must}")
    for title, name in zip(header, names, strict=True):
        if name not in ours and optional is not None:
            named = f"unknown column {title[:_SHOWN_CHARS]!r}"
            raise ValueError(f"{named}: leave it out; known are {', '.join(ours)}")
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
        raise ValueError(f"row {row}: {name} is {cell[:_SHOWN_CHARS]!r}: {must}")
    return number
