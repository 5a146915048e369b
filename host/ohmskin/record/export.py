# SPDX-License-Identifier: Apache-2.0
"""From a recording to other programs: a readings file (.npz) for `ohmskin estimate`, or CSV."""

from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.errors import RecordingError
from ohmskin.files import save_table
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.record.readings import MAX_ARRAY_BYTES, save_arrays
from ohmskin.record.recording import Recording

FORMATS: Final = (".npz", ".csv")
# What both formats have of each scan, besides its readings.
_OF_SCAN: Final = ("number", "time_us", "host_time_s", "missed")


def export(recording: Recording, out: Path, begin_s: float = 0.0, end_s: float = 0.0) -> int:
    """Write the scans from `begin_s` to `end_s` [s after the first; 0: to the last] to `out`.

    The file is complete or not there. Returns the number of scans.

    :raises RecordingError: there are none, or they have not all the same size.
    :raises ValueError: an unknown format, or `out` cannot be written.
    """
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(FORMATS)}")
    scans = _between(recording.scans, begin_s, end_s)
    if out.suffix == ".csv":
        _save_csv(scans, out)
        return len(scans)
    arrays = _arrays(recording, scans)
    if arrays["ratio"].nbytes > MAX_ARRAY_BYTES:
        raise RecordingError(
            f"{len(scans)} scans are more than a readings file holds: export a part of them, "
            "--begin and --end"
        )
    save_arrays(out, arrays)
    return len(scans)


def _between(scans: list[Scan], begin_s: float, end_s: float) -> list[Scan]:
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
    return scans


def _arrays(recording: Recording, scans: list[Scan]) -> dict[str, NDArray[Any]]:
    """The arrays of a readings file, and besides those of `_OF_SCAN`.

    `rest_ratio` is the last tare of this size. `ratio` in single precision is exact.
    """
    board = recording.hellos[0]
    codes = np.array([scan.codes for scan in scans])
    arrays: dict[str, Any] = {
        "ratio": ratio_from_codes(codes, board.adc_bits).astype(np.float32),
        "ref_top_ohm": float(board.ref_top_ohm),
        "ref_bottom_ohm": float(board.ref_bottom_ohm),
        "adc_bits": board.adc_bits,
        **{name: [getattr(scan, name) for scan in scans] for name in _OF_SCAN},
    }
    for tare in recording.tares:
        if tare.rest_ratio.shape == codes.shape[1:]:
            arrays["rest_ratio"] = tare.rest_ratio
    return {name: np.array(each) for name, each in arrays.items()}


def _save_csv(scans: list[Scan], out: Path) -> None:
    """A row a scan: its times, then the codes of each cell, named by row, column and reading."""
    cells = np.ndindex(*scans[0].codes.shape)
    names = [f"r{row}c{column}{'abcd'[reading]}" for row, column, reading in cells]
    times = attrgetter(*_OF_SCAN)
    rows = ([*times(scan), *scan.codes.reshape(-1).tolist()] for scan in scans)
    save_table(out, [*_OF_SCAN, *names], rows)
