# SPDX-License-Identifier: Apache-2.0
"""Scans of a recording for other programs: a readings file (.npz) or a table (.csv).

Scans are read and written one by one, so that an hour takes no more memory than a second. A file
has the readings of all modes of its scans; where a scan has not taken a reading, it is NaN in the
readings file, and empty in the table.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any, Final
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ohmskin.errors import RecordingError
from ohmskin.files import PathName, save_table, whole_file
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import MODES
from ohmskin.record.readings import MAX_ARRAY_BYTES, MAX_FRAMES
from ohmskin.record.recording import Mark, Tare, messages, tare_of

# Attributes of `Scan` that both formats have besides the readings, and their types.
_OF_SCAN: Final = {"number": "<i8", "time_us": "<i8", "host_time_s": "<f8", "missed": "<i8"}
# What a readings file has of the board.
_OF_BOARD: Final = {"ref_top_ohm": "<f8", "ref_bottom_ohm": "<f8", "adc_bits": "<i8"}
# Type of the readings in a readings file: codes are exact in the 24 bits of single precision.
_RATIO: Final = np.dtype("<f4")
# What a code means, by what a board says of itself.
_means: Final = attrgetter(*_OF_BOARD)


def save_stacked(out: Path, parts: Iterable[Mapping[str, NDArray[Any]]]) -> None:
    """Write an .npz, as `whole_file`, of arrays that come some rows (n, ...) at a time, by name.

    All rows of an array are of one type and shape; a number comes once. What has come waits in
    files without a name beside `out`. (`np.savez` takes whole arrays. Even one that is mapped from
    a file would fill the memory, page by page.)
    """
    files: dict[str, tuple[NDArray[Any], Any]] = {}  # first rows, which say the form, and all rows
    with whole_file(out) as file, ExitStack() as stack:
        for part in parts:
            for name, rows in part.items():
                if name not in files:
                    files[name] = rows, stack.enter_context(TemporaryFile(dir=out.parent))
                files[name][1].write(rows.tobytes())
        with ZipFile(file, "w") as archive:
            for name, (first, stacked) in files.items():
                of_row = first.shape[1:]
                count = stacked.tell() // (first.itemsize * math.prod(of_row))
                shape = (count, *of_row) if first.ndim else ()
                header = {"descr": first.dtype.str, "fortran_order": False, "shape": shape}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    npy.write_array_header_1_0(member, header)
                    stacked.seek(0)
                    copyfileobj(stacked, member)


@dataclass
class Part:
    """The scans of a part of a recording, one by one.

    The attributes say what else was read; they are complete after the last scan. Each iteration
    reads the file anew.

    begin_s, end_s: the part's first and last moment [s after the first scan]; 0: of the recording.
    scans: how many scans there were.
    after_s: when the newest of them was [s after the first scan of the recording].
    cut_off: whether the recording was not ended properly, so that its last second may be missing.
    boards: what the board had said of itself at the part's first scan, and then at each scan before
        which it said something new.
    tares: all that were read so far.
    marks: those of the part.
    timed, watch: as `messages` takes them.

    :raises ValueError: the part ends before it begins.
    :raises RecordingError: as `messages`; there are no scans, or they have not all the same size,
        or are not all of one unit.
    """

    path: PathName
    begin_s: float = 0.0
    end_s: float = 0.0
    scans: int = 0
    after_s: float = 0.0
    cut_off: bool = True
    boards: list[Hello] = field(default_factory=list)
    tares: list[Tare] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    timed: bool = False
    watch: Callable[[int], object] | None = None

    def __post_init__(self) -> None:
        if self.end_s and self.end_s < self.begin_s:
            text = f"a part cannot end after {self.end_s:g} s, and begin after {self.begin_s:g} s"
            raise ValueError(f"{text}: say --begin below --end")

    def __iter__(self) -> Iterator[Scan]:
        self.scans, size, first_s, unit_id = 0, None, math.inf, None
        for of_file in (self.boards, self.tares, self.marks):
            of_file.clear()
        for message in messages(self.path, timed=self.timed, watch=self.watch):
            self.cut_off = message is not None
            match message:
                case Hello():
                    if message.unit_id != unit_id:
                        self.tares.clear()  # they are of another skin
                    board, unit_id = message, message.unit_id
                case Tare():
                    self.tares.append(message)
                case Mark() if self._holds(message.host_time_s - first_s):
                    self.marks.append(message)
                case Scan():
                    first_s = message.host_time_s if first_s == math.inf else first_s
                    after_s = message.host_time_s - first_s
                    if not self._holds(after_s):
                        continue
                    size = size or message.codes.shape[:2]
                    if message.codes.shape[:2] != size:
                        change = f"the cells change after {after_s:.3f} s"
                        raise self.error(f"{change}: export each part by itself")
                    if self.boards[-1:] != [board]:
                        self.boards.append(board)
                        self._check_same(self.boards[0], board, after_s)
                    self.scans, self.after_s = self.scans + 1, after_s
                    yield message
        if not self.scans:
            raise RecordingError(f"{self.path}: no scans, neither in it nor in this part of it")

    def _check_same(self, first: Hello, board: Hello, after_s: float) -> None:
        """Raise RecordingError if codes of both boards do not mean the same of one skin."""
        change = f"unit {board.unit_id} has come in place of unit {first.unit_id}"
        if board.unit_id == first.unit_id:
            if _means(board) == _means(first):
                return
            change = "the board has other reference resistors or another converter"
        raise self.error(f"after {after_s:.3f} s {change}: export each part by itself")

    def _holds(self, after_s: float) -> bool:
        """Whether this is a moment of the part [s after the first scan]."""
        return (self.begin_s or after_s) <= after_s <= (self.end_s or after_s)

    def error(self, text: str) -> RecordingError:
        """An error whose remedy is to choose a smaller part: `text` ends before those options."""
        return RecordingError(f"{self.path}: {text}, --begin and --end")


def save_readings(part: Part, out: Path) -> None:
    """Write the readings of these scans to `out`, .npz or .csv, complete or not at all.

    :raises RecordingError: as `Part`, or they are too many for a readings file.
    :raises ValueError: `out` cannot be written.
    """
    first = next(iter(part))
    size, names = first.codes.shape[:2], {*first.reading_names}
    while True:
        in_order = next((of for of in MODES.values() if {*of} == names), tuple(sorted(names)))
        try:
            if out.suffix == ".csv":
                return _save_csv(part, out, size, in_order)
            return save_stacked(out, _arrays(part, size, in_order))
        except _MoreNames as more:
            names |= {*more.args}


class _MoreNames(Exception):
    """A scan has readings of these names, which the file does not have: it is begun anew."""


def _of_names(
    scan: Scan, values: NDArray[Any], names: tuple[str, ...], not_read: float | None = np.nan
) -> NDArray[Any]:
    """Values (R, C, n) of a scan, in the order of the file's names (R, C, m).

    not_read: stands where nothing was read. None, which is empty in a table, keeps codes whole.

    :raises _MoreNames: the scan has readings of other names.
    """
    if scan.reading_names == names and scan.is_whole:
        return values
    if missing := {*scan.reading_names} - {*names}:
        raise _MoreNames(*missing)
    widened = np.full((*values.shape[:2], len(names)), not_read)
    widened[..., [names.index(name) for name in scan.reading_names]] = values
    widened[~scan.read] = not_read
    return widened


def _arrays(
    part: Part, size: tuple[int, ...], names: tuple[str, ...]
) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of a readings file, with those of `_OF_SCAN`, scan by scan.

    Its `rest_ratio` is the last tare before the last scan that is good for it.
    """
    scan_bytes = _RATIO.itemsize * math.prod(size) * len(names)
    most = min(MAX_FRAMES, MAX_ARRAY_BYTES // scan_bytes)
    for scan in part:
        if part.scans > most:
            many = f"{part.scans} scans are more than a readings file holds"
            raise part.error(f"{many}: export a part of them")
        of_scan = {name: np.array([getattr(scan, name)], _OF_SCAN[name]) for name in _OF_SCAN}
        yield of_scan | {"ratio": _of_names(scan, scan.ratio, names)[None].astype(_RATIO)}
        tare = tare_of(scan, part.tares)  # now: tares that come after the part are read, too
    yield {name: np.array(getattr(part.boards[0], name), _OF_BOARD[name]) for name in _OF_BOARD}
    yield {"reading_names": np.array(names)}
    if tare is not None:
        at_rest = replace(scan, mode=tare.mode, row_mask=0, column_mask=0)
        yield {"rest_ratio": _of_names(at_rest, tare.rest_ratio, names)}


def _save_csv(part: Part, out: Path, size: tuple[int, ...], names: tuple[str, ...]) -> None:
    """Write a table with a row for each scan: its times, then the codes of its cells.

    Columns of codes are named by row, column and reading.
    """
    columns = [f"r{row}c{column}{name}" for row, column in np.ndindex(size) for name in names]
    times = attrgetter(*_OF_SCAN)

    def row(scan: Scan) -> list[Any]:
        return [*times(scan), *_of_names(scan, scan.codes, names, None).ravel().tolist()]

    save_table(out, [*_OF_SCAN, *columns], map(row, part))
