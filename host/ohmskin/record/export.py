# SPDX-License-Identifier: Apache-2.0
"""Scans of a recording for other programs: a readings file (.npz) or a table (.csv).

They are read and written one by one, so that an hour takes no more memory than a second.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from itertools import chain
from math import prod
from operator import attrgetter
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any, BinaryIO, Final
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from ohmskin.errors import RecordingError
from ohmskin.files import Closing, PathName, save_table, whole_file
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.readings import MAX_ARRAY_BYTES, MAX_FRAMES
from ohmskin.record.recording import Mark, Tare, messages

FORMATS: Final = (".npz", ".csv")
# What both formats have of each scan, besides its readings: attributes of `Scan`, and their types.
_OF_SCAN: Final = {"number": "<i8", "time_us": "<i8", "host_time_s": "<f8", "missed": "<i8"}
# Readings of a readings file: single precision has 24 bits, so codes are exact in it.
_RATIO: Final = np.dtype("<f4")


class Stacks(Closing):
    """Arrays that grow row by row: in a folder, or in memory where none is given.

    forms: type and shape of a row of each array, by its name.
    """

    def __init__(self, forms: dict[str, tuple[str, tuple[int, ...]]], folder: Path | None) -> None:
        self._forms = {name: (np.dtype(kind), shape) for name, (kind, shape) in forms.items()}
        new = BytesIO if folder is None else partial(TemporaryFile, dir=folder)
        self._files: dict[str, Any] = {name: new() for name in forms}

    def add(self, rows: Mapping[str, ArrayLike]) -> None:
        """Add a row to each of these arrays."""
        for name, row in rows.items():
            self._files[name].write(np.asarray(row, dtype=self._forms[name][0]).tobytes())

    def _shape(self, name: str) -> tuple[int, ...]:
        kind, shape = self._forms[name]
        return self._files[name].tell() // (kind.itemsize * prod(shape)), *shape

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays, of stacks in memory."""
        return {
            name: np.frombuffer(self._files[name].getbuffer(), kind).reshape(self._shape(name))
            for name, (kind, _) in self._forms.items()
        }

    def save(self, file: BinaryIO, more: Mapping[str, Any]) -> None:
        """Write an .npz of all arrays, and of these others."""
        with ZipFile(file, "w") as archive:
            for name, (kind, _) in self._forms.items():
                header = {"descr": kind.str, "fortran_order": False, "shape": self._shape(name)}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    npy.write_array_header_1_0(member, header)
                    self._files[name].seek(0)
                    copyfileobj(self._files[name], member)
            for name, values in more.items():
                with archive.open(f"{name}.npy", "w") as member:
                    npy.write_array(member, np.array(values), allow_pickle=False)

    def close(self) -> None:
        """Let go what was kept. May be called again."""
        for file in self._files.values():
            file.close()


@dataclass
class Part:
    """The scans of a part of a recording, one by one. What else was read is here after the last.

    begin_s, end_s: the part's first and last moment [s after the first scan].
    scans: how many there were.
    cut_off: whether the recording was not ended properly, so that its last second may be missing.
    boards: what the board says of itself at first.
    tares: the newest of each size and mode.
    marks: all that were read.
    timed, watch: as `messages` takes them.

    :raises RecordingError: as `messages`; there are no scans, or they have not all the same size.
    """

    path: PathName
    begin_s: float
    end_s: float
    scans: int = 0
    cut_off: bool = True
    boards: list[Hello] = field(default_factory=list)
    tares: dict[object, Tare] = field(default_factory=dict)
    marks: list[Mark] = field(default_factory=list)
    timed: bool = False
    watch: Callable[[int], object] | None = None

    def __iter__(self) -> Iterator[Scan]:
        first = kind = None
        for message in messages(self.path, timed=self.timed, watch=self.watch):
            self.cut_off = message is not None
            match message:
                case Hello() if not self.boards:
                    self.boards.append(message)
                case Tare():
                    self.tares[message.rest_ratio.shape, message.mode] = message
                case Mark():
                    self.marks.append(message)
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


def export(
    path: PathName,
    out: Path,
    begin_s: float = 0.0,
    end_s: float = 0.0,
    watch: Callable[[int], object] | None = None,
) -> Part:
    """Write the scans from `begin_s` to `end_s` [s after the first; 0: to the last] to `out`.

    The file is complete or not there. watch: is told how many bytes of the recording were read.
    Returns what was written.

    :raises RecordingError: as `Part`, or they are too many for a readings file.
    :raises ValueError: an unknown format, or `out` cannot be written.
    """
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(FORMATS)}")
    part = Part(path, begin_s, end_s or float("inf"), watch=watch)
    if out.suffix == ".csv":
        _save_csv(iter(part), out)
    else:
        _save_npz(part, out)
    return part


def _save_npz(part: Part, out: Path) -> None:
    """A readings file, and the arrays of `_OF_SCAN` besides.

    `rest_ratio` is the last tare of this size and mode.
    """
    scans = iter(part)
    first = next(scans)
    forms = {"ratio": (_RATIO.str, first.codes.shape), **{n: (k, ()) for n, k in _OF_SCAN.items()}}
    with whole_file(out) as file, Stacks(forms, out.parent) as stacks:
        for scan in chain([first], scans):
            if part.scans > min(MAX_FRAMES, MAX_ARRAY_BYTES // (_RATIO.itemsize * scan.codes.size)):
                many = f"{part.scans} scans are more than a readings file holds"
                raise part.error(f"{many}: export a part of them")
            ratio = ratio_from_codes(scan.codes, part.boards[0].adc_bits)
            stacks.add({"ratio": ratio, **{name: getattr(scan, name) for name in _OF_SCAN}})
        board, tare = part.boards[0], part.tares.get(first.kind)
        more = {
            "reading_names": first.reading_names,
            "ref_top_ohm": float(board.ref_top_ohm),
            "ref_bottom_ohm": float(board.ref_bottom_ohm),
            "adc_bits": board.adc_bits,
        }
        stacks.save(file, more if tare is None else more | {"rest_ratio": tare.rest_ratio})


def _save_csv(scans: Iterator[Scan], out: Path) -> None:
    """A row a scan: its times, then the codes of each cell, named by row, column and reading."""
    first = next(scans)
    cells = np.ndindex(*first.codes.shape)
    names = [f"r{row}c{column}{first.reading_names[k]}" for row, column, k in cells]
    times = attrgetter(*_OF_SCAN)
    rows = ([*times(scan), *scan.codes.reshape(-1).tolist()] for scan in chain([first], scans))
    save_table(out, [*_OF_SCAN, *names], rows)
