# SPDX-License-Identifier: Apache-2.0
"""Scans of a recording for other programs: a readings file (.npz) or a table (.csv).

They are read and written one by one, so that an hour takes no more memory than a second.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from operator import attrgetter
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any, BinaryIO, Final
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy

from ohmskin.errors import RecordingError
from ohmskin.estimate.knowledge import REF_LOG_STD
from ohmskin.files import PathName, save_table, whole_file
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.readings import MAX_ARRAY_BYTES, MAX_FRAMES
from ohmskin.record.recording import Tare, messages

FORMATS: Final = (".npz", ".csv")
# What both formats have of each scan, besides its readings: attributes of `Scan`, and their types.
_OF_SCAN: Final = {"number": "q", "time_us": "q", "host_time_s": "d", "missed": "q"}
# Readings of a readings file: single precision has 24 bits, so codes are exact in it.
_RATIO: Final = np.dtype("<f4")


@dataclass
class Part:
    """The scans of a part of a recording, one by one. What else was read is here after the last.

    begin_s, end_s: the part's first and last moment [s after the first scan].
    scans: how many there were.
    cut_off: whether the recording was not ended properly, so that its last second may be missing.
    boards: what the board says of itself at first.
    tares: the newest of each size and mode.

    :raises RecordingError: as `messages`; there are no scans, or they have not all the same size.
    """

    path: PathName
    begin_s: float
    end_s: float
    scans: int = 0
    cut_off: bool = True
    boards: list[Hello] = field(default_factory=list)
    tares: dict[object, Tare] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Scan]:
        first = kind = None
        for message in messages(self.path):
            self.cut_off = message is not None
            match message:
                case Hello() if not self.boards:
                    self.boards.append(message)
                case Tare():
                    self.tares[message.rest_ratio.shape, message.mode] = message
                case Scan():
                    first = first or message
                    after_s = message.host_time_s - first.host_time_s
                    if self.begin_s <= after_s <= self.end_s:
                        kind = kind or message.kind
                        if message.kind != kind:
                            change = f"cells or mode change after {after_s:.3f} s"
                            raise self.error(f"{change}: export each part by itself")
                        self.scans += 1
                        yield message
        if not self.scans:
            raise RecordingError(f"{self.path}: no scans, neither in it nor in this part of it")

    def error(self, text: str) -> RecordingError:
        """That these scans do not make one file."""
        return RecordingError(f"{self.path}: {text}, --begin and --end")


def export(path: PathName, out: Path, begin_s: float = 0.0, end_s: float = 0.0) -> Part:
    """Write the scans from `begin_s` to `end_s` [s after the first; 0: to the last] to `out`.

    The file is complete or not there. Returns what was written.

    :raises RecordingError: as `Part`, or they are too many for a readings file.
    :raises ValueError: an unknown format, or `out` cannot be written.
    """
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(FORMATS)}")
    part = Part(path, begin_s, end_s or float("inf"))
    if out.suffix == ".csv":
        _save_csv(iter(part), out)
    else:
        with whole_file(out) as file, TemporaryFile(dir=out.parent) as ratios:
            _save_npz(part, file, ratios)
    return part


def _save_npz(part: Part, file: BinaryIO, ratios: Any) -> None:
    """A readings file, and the arrays of `_OF_SCAN` besides. ratios: to keep readings meanwhile.

    `rest_ratio` is the last tare of this size and mode.
    """
    columns = {name: array(kind) for name, kind in _OF_SCAN.items()}
    for scan in part:
        if part.scans > min(MAX_FRAMES, MAX_ARRAY_BYTES // (_RATIO.itemsize * scan.codes.size)):
            many = f"{part.scans} scans are more than a readings file holds"
            raise part.error(f"{many}: export a part of them")
        ratios.write(ratio_from_codes(scan.codes, part.boards[0].adc_bits).astype(_RATIO))
        for name, column in columns.items():
            column.append(getattr(scan, name))
    board = part.boards[0]
    arrays: dict[str, Any] = {
        "reading_names": scan.reading_names,
        "ref_top_ohm": float(board.ref_top_ohm),
        "ref_bottom_ohm": float(board.ref_bottom_ohm),
        "ref_log_std": REF_LOG_STD,
        "adc_bits": board.adc_bits,
        **columns,
    }
    if tare := part.tares.get(scan.kind):
        arrays["rest_ratio"] = tare.rest_ratio
    shape = (part.scans, *scan.codes.shape)
    ratios.seek(0)
    with ZipFile(file, "w") as archive:
        with archive.open("ratio.npy", "w", force_zip64=True) as member:
            header = {"descr": _RATIO.str, "fortran_order": False, "shape": shape}
            npy.write_array_header_1_0(member, header)
            copyfileobj(ratios, member)
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                npy.write_array(member, np.array(values), allow_pickle=False)


def _save_csv(scans: Iterator[Scan], out: Path) -> None:
    """A row a scan: its times, then the codes of each cell, named by row, column and reading."""
    first = next(scans)
    cells = np.ndindex(*first.codes.shape)
    names = [f"r{row}c{column}{first.reading_names[k]}" for row, column, k in cells]
    times = attrgetter(*_OF_SCAN)
    rows = ([*times(scan), *scan.codes.reshape(-1).tolist()] for scan in chain([first], scans))
    save_table(out, [*_OF_SCAN, *names], rows)
