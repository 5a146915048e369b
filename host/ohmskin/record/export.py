# SPDX-License-Identifier: Apache-2.0
"""From a recording to other programs: a readings file (.npz) for `ohmskin estimate`, or CSV."""

import csv
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.errors import RecordingError
from ohmskin.files import whole_file
from ohmskin.link.codes import ratio_from_codes
from ohmskin.record.readings import MAX_ARRAY_BYTES, save_arrays
from ohmskin.record.recording import Recording

FORMATS: Final = (".npz", ".csv")
_READINGS: Final = "abcd"


def export(recording: Recording, out: Path, begin_s: float = 0.0, end_s: float = 0.0) -> int:
    """Write the scans from `begin_s` to `end_s` [s after the first; 0: to the last] to `out`.

    The file is complete or not there. Returns the number of scans.

    :raises RecordingError: there are none, or they have not all the same size.
    :raises ValueError: an unknown format, or `out` cannot be written.
    """
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(FORMATS)}")
    part = _between(recording, begin_s, end_s)
    if out.suffix == ".csv":
        _save_csv(part, out)
    else:
        arrays = readings_arrays(part)
        if arrays["ratio"].nbytes > MAX_ARRAY_BYTES:
            raise RecordingError(
                f"{len(part.scans)} scans are more than a readings file holds: export a part "
                "of them, --begin and --end"
            )
        save_arrays(out, arrays)
    return len(part.scans)


def _between(recording: Recording, begin_s: float, end_s: float) -> Recording:
    scans = recording.scans
    first_s = scans[0].host_time_s if scans else 0.0
    last_s = first_s + end_s if end_s else float("inf")
    scans = [scan for scan in scans if first_s + begin_s <= scan.host_time_s <= last_s]
    if not scans:
        raise RecordingError("no scans: neither in the recording nor in this part of it")
    size = scans[0].codes.shape
    for scan in scans:
        if scan.codes.shape != size:
            at_s = scan.host_time_s - first_s
            raise RecordingError(
                f"{size[0]}x{size[1]} cells become {scan.rows}x{scan.columns} after {at_s:.3f} s: "
                "export each part by itself, --begin and --end"
            )
    return Recording(recording.hellos, scans, recording.tares, recording.marks, recording.forces)


def readings_arrays(recording: Recording) -> dict[str, NDArray[Any]]:
    """The arrays of a readings file (`readings`), and besides for each scan its `number`,
    `time_us`, `host_time_s` and `missed`.

    `rest_ratio` is the last tare of this size. `ratio` in single precision is exact.
    """
    board, scans = recording.hellos[0], recording.scans
    codes = np.array([scan.codes for scan in scans])
    arrays: dict[str, NDArray[Any]] = {
        "ratio": ratio_from_codes(codes, board.adc_bits).astype(np.float32),
        "ref_top_ohm": np.array(float(board.ref_top_ohm)),
        "ref_bottom_ohm": np.array(float(board.ref_bottom_ohm)),
        "adc_bits": np.array(board.adc_bits),
        "number": np.array([scan.number for scan in scans]),
        "time_us": np.array([scan.time_us for scan in scans]),
        "host_time_s": np.array([scan.host_time_s for scan in scans]),
        "missed": np.array([scan.missed for scan in scans]),
    }
    for tare in recording.tares:
        if tare.rest_ratio.shape == codes.shape[1:]:
            arrays["rest_ratio"] = tare.rest_ratio
    return arrays


def _save_csv(recording: Recording, out: Path) -> None:
    """A row a scan: times, then the codes of each cell, named by row, column and reading."""
    scans = recording.scans
    cells = np.ndindex(*scans[0].codes.shape)
    names = [f"r{row}c{column}{_READINGS[reading]}" for row, column, reading in cells]
    with whole_file(out) as file:
        text = TextIOWrapper(file, encoding="ascii", newline="", write_through=True)
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["number", "time_us", "host_time_s", "missed", *names])
        for scan in scans:
            times = (scan.number, scan.time_us, scan.host_time_s, scan.missed)
            table.writerow([*times, *scan.codes.reshape(-1).tolist()])
        text.detach()
