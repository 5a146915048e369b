# SPDX-License-Identifier: Apache-2.0
"""The forces of a recording as arrays, and in files for other programs (.npz, .csv, .parquet).

====================== ========== ==============================================================
array                  shape      meaning
====================== ========== ==============================================================
number, missed         F          as of `Scan`, of each of F scans
time_ns                F          the middle of the scan, since 1970 [ns]
force_n, force_n_std   F, R, C    forces of the cells and their standard deviations [N]
contact_scan           K          which scan each of all K contacts is in: an index from 0
contact_identity, ...  K          as of `Contact`: row, column, force_n, force_n_std
contact_position_m     K, 3       where the contact is [m]; NaN where the calibration does not say
contact_normal         K, 3       its normal there, likewise
mark_text, mark_time_ns  M        what was noted, and when, since 1970 [ns]
====================== ========== ==============================================================

A .csv has a row a scan without its contacts; a .parquet has a row a scan with a list of them, and
the marks in the file's metadata. Files are written some scans at a time: hours need no more memory.
"""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.errors import OhmskinError
from ohmskin.files import RUN, PathName, naming, save_table, whole_file
from ohmskin.force.calibration import Calibration, CalibrationLike, loaded
from ohmskin.force.reader import ForceScan, SkinReader, check_mode
from ohmskin.link.messages import Scan
from ohmskin.record.export import Part, save_readings, save_stacked
from ohmskin.record.recording import tare_of

OF_READINGS: Final = (".npz", ".csv")
FORMATS: Final = (*OF_READINGS, ".parquet")
# What is told of scans and cells, and of which type it is.
_OF_SCAN: Final = dict.fromkeys(("number", "missed", "time_ns"), "<i8")
_OF_CELLS: Final = dict.fromkeys(("force_n", "force_n_std"), "<f4")
# What is told of contacts, and of which type it is. numpy makes NaN of a place that is None.
_OF_CONTACT: Final = {
    "identity": "<i8",
    **dict.fromkeys(("row", "column", "force_n", "force_n_std"), "<f8"),
    **dict.fromkeys(("position_m", "normal"), "(3,)<f8"),
}
# So many scans are read at once. Chosen: with more, `SkinReader.read_all` takes as long.
_READ_SCANS: Final = 64
# A group of rows in a .parquet has so many scans. Chosen: programs read whole groups, and these are
# 1 MB of an 8x8 skin.
_GROUP_SCANS: Final = 2048


def load_forces(
    path: PathName,
    calibration: CalibrationLike,
    begin_s: float = 0.0,
    end_s: float = 0.0,
    *,
    force: bool = False,
) -> dict[str, NDArray[Any]]:
    """The arrays of the module's table, of the scans from `begin_s` to `end_s` [s after the first].

    calibration: a `Calibration` or the path of its file.
    end_s = 0: to the last scan. An hour of 8x8 at 90 Hz takes 200 MB; `export` needs less memory.
    force: take the calibration even if it is of another unit.

    :raises RecordingError: the recording cannot be read; the part has scans of two units or modes.
    :raises ValueError: the calibration cannot be read, or is of another unit, size or mode.
    """
    part = Part(path, begin_s, end_s, timed=True)
    groups = list(_groups(part, loaded(calibration), force=force))
    # Each group gives up its share of an array, so that no more than one array is there twice.
    return {
        name: np.concatenate([group.pop(name) for group in groups]) for name in list(groups[0])
    } | next(_marks(part))


def export(
    path: PathName,
    out: Path,
    calibration: Calibration | None = None,
    begin_s: float = 0.0,
    end_s: float = 0.0,
    watch: Callable[[int], object] | None = None,
    *,
    force: bool = False,
) -> Part:
    """Write what `load_forces` gives to `out`, complete or not at all: one of `FORMATS`.

    calibration: None: readings are written (`ohmskin.record.export`), as .npz or .csv.
    watch: is told how many bytes of the recording were read.
    force: take the calibration even if it is of another unit.

    Returns what was written.

    :raises RecordingError: as `load_forces`; they are too many for a readings file.
    :raises ValueError: as `load_forces`; an unknown format, or `out` cannot be written.
    :raises OhmskinError: pyarrow is missing.
    """
    formats = OF_READINGS if calibration is None else FORMATS
    if out.suffix not in formats:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(formats)}")
    part = Part(path, begin_s, end_s, timed=calibration is not None, watch=watch)
    if calibration is None:
        save_readings(part, out)
    elif out.suffix == ".csv":
        _save_csv(read_forces(part, calibration, force=force), calibration, out)
    elif out.suffix == ".parquet":
        _save_parquet(part, calibration, out, force=force)
    else:
        save_stacked(out, chain(_groups(part, calibration, force=force), _marks(part)))
    return part


def export_or_why_not(path: Path, *told: Any, force: bool, run: str) -> Part | str:
    """`export`, or why it failed in words: of many recordings, the others are still wanted.

    run: whoever ends this process may `remove_parts` of this run.
    """
    RUN.set(run)
    try:
        return export(path, *told, force=force)
    except (OhmskinError, ValueError, OSError) as exc:
        return str(exc)


def read_forces(
    part: Part, calibration: Calibration, *, force: bool = False
) -> Iterator[ForceScan]:
    """The scans of a part of a recording with their forces, each with the tare before it.

    force: take the calibration even if it is of another unit.

    Before an error comes, all scans before it are given.

    :raises RecordingError: as `load_forces`.
    :raises ValueError: as `load_forces`.
    """
    scans, reader, failure = _tared(part), None, None
    while failure is None:
        group: list[Scan] = []
        try:
            group += islice(scans, _READ_SCANS)
        except OhmskinError as exc:
            failure = exc
        if not group:
            break
        if reader is None:
            with naming(part.path):
                reader = SkinReader(part.boards[0], calibration, force=force)
        yield from reader.read_all(group)
    if failure is not None:
        raise failure


def _tared(part: Part) -> Iterator[Scan]:
    """The scans, each with the tare before it, as long as one reader can read them."""
    for scan in part:
        try:
            check_mode(part.boards[0], scan.mode)
        except ValueError as exc:
            remedy = "export each part by its own calibration"
            raise part.error(f"after {part.after_s:.3f} s, {exc}: {remedy}") from exc
        tare = tare_of(scan, part.tares)
        yield scan if tare is None else replace(scan, rest_ratio=tare.rest_ratio)


def _groups(
    part: Part, calibration: Calibration, scans: int = _READ_SCANS, *, force: bool
) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of `load_forces`, without the marks, of each so many scans."""
    all_scans, begin = read_forces(part, calibration, force=force), 0
    while group := list(islice(all_scans, scans)):
        contacts = [(k, each) for k, scan in enumerate(group, begin) for each in scan.contacts]
        arrays = {"contact_scan": np.array([k for k, _ in contacts], np.int64)}
        for name, kind in (_OF_SCAN | _OF_CELLS).items():
            arrays[name] = np.array([getattr(scan, name) for scan in group], kind)
        told = [attrgetter(*_OF_CONTACT)(contact) for _, contact in contacts]
        rows = np.array(told, [*_OF_CONTACT.items()])
        arrays |= {f"contact_{name}": rows[name] for name in _OF_CONTACT}
        yield arrays
        begin += len(group)


def _marks(part: Part) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of the marks: an iterator, because they are known only after the last scan."""
    yield {
        "mark_text": np.array([mark.text for mark in part.marks], dtype=np.str_),
        "mark_time_ns": np.array([mark.time_ns for mark in part.marks], dtype=np.int64),
    }


def _save_csv(scans: Iterator[ForceScan], calibration: Calibration, out: Path) -> None:
    cells = list(np.ndindex(calibration.rows, calibration.columns))
    names = [f"r{row}c{column}_{name}" for name in _OF_CELLS for row, column in cells]
    of_scan, of_cells = attrgetter(*_OF_SCAN), attrgetter(*_OF_CELLS)
    rows = ([*of_scan(scan), *np.ravel(of_cells(scan)).tolist()] for scan in scans)
    save_table(out, [*_OF_SCAN, *names], rows)


def _save_parquet(part: Part, calibration: Calibration, out: Path, *, force: bool) -> None:
    try:
        import pyarrow as pa
        from pyarrow.parquet import ParquetWriter
    except ImportError as exc:
        raise OhmskinError(f".parquet needs {exc.name}: run pip install pyarrow") from exc
    sizes, begin = {"rows": str(calibration.rows), "columns": str(calibration.columns)}, 0

    def column(array: NDArray[Any]) -> Any:
        flat, size = pa.array(array.ravel()), math.prod(array.shape[1:])
        return flat if array.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, size)

    with whole_file(out) as file, ExitStack() as stack:
        writer: Any = None  # its schema is that of the first group
        for arrays in _groups(part, calibration, _GROUP_SCANS, force=force):
            columns = {name: column(arrays[name]) for name in _OF_SCAN | _OF_CELLS}
            ends = begin + np.arange(1 + len(arrays["number"]))
            offsets = np.searchsorted(arrays["contact_scan"], ends).astype(np.int32)
            told = [column(arrays[f"contact_{name}"]) for name in _OF_CONTACT]
            contacts = pa.StructArray.from_arrays(told, list(_OF_CONTACT))
            columns["contacts"] = pa.ListArray.from_arrays(offsets, contacts)
            table, begin = pa.table(columns, metadata=sizes), ends[-1]
            writer = writer or stack.enter_context(ParquetWriter(file, table.schema))
            writer.write_table(table)
        marks = [{"text": mark.text, "time_ns": mark.time_ns} for mark in part.marks]
        writer.add_key_value_metadata({"marks": json.dumps(marks)})
