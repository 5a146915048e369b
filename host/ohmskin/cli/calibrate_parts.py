# SPDX-License-Identifier: Apache-2.0
"""What the commands of ``ohmskin calibrate`` have in common: options, and how each ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from ohmskin.arrays import Float
from ohmskin.calibrate.bench import Bench, measure, presses_from_log, presses_from_table
from ohmskin.calibrate.force_log import ForceLog, load_force_log
from ohmskin.calibrate.number_table import naming
from ohmskin.calibrate.press_table import PressTable
from ohmskin.calibrate.presses import Presses
from ohmskin.errors import RecordingError
from ohmskin.estimate.base import WireOhm
from ohmskin.estimate.methods import LEVEL_METHODS
from ohmskin.force.calibration import Calibration
from ohmskin.force.reader import now
from ohmskin.link.messages import Hello
from ohmskin.record.recording import Recording, load_recording

DEFAULT_METHOD: Final = "joint"

Port = Annotated[str, typer.Argument(help="serial port or URL; nothing may touch the skin")]
Out = Annotated[Path, typer.Argument(help="calibration file to write (.json)")]
Method = Annotated[str, typer.Option(help=" | ".join(LEVEL_METHODS))]
Indenter = Annotated[
    float, typer.Option("--indenter-mm2", help="area that the skin is pressed with, in mm2")
]
TopWire = Annotated[
    float | None, typer.Option("--top-wire", help="one wire segment of a row in ohm, if known")
]
BottomWire = Annotated[
    float | None,
    typer.Option("--bottom-wire", help="one wire segment of a column in ohm, if known"),
]

_out = Console(soft_wrap=True)


@dataclass(frozen=True)
class Wanted:
    """What all commands are told of the calibration: where it goes, and what goes into it.

    Raises ValueError for a value that cannot be: before anybody presses anything for an hour.
    """

    out: Path
    method: str
    indenter_mm2: float
    top_wire_ohm: float | None
    bottom_wire_ohm: float | None

    def __post_init__(self) -> None:
        if self.method not in LEVEL_METHODS:
            raise ValueError(f"no method '{self.method}': there are {', '.join(LEVEL_METHODS)}")
        if not (math.isfinite(self.indenter_mm2) and self.indenter_mm2 > 0):
            raise ValueError(f"--indenter-mm2 is {self.indenter_mm2:g}, it must be above 0")
        for name, ohm in (("top", self.top_wire_ohm), ("bottom", self.bottom_wire_ohm)):
            if ohm is not None and not (math.isfinite(ohm) and ohm >= 0):
                raise ValueError(f"--{name}-wire is {ohm:g}, it must be finite and 0 or more")
        if self.out.is_dir() or not self.out.parent.is_dir():
            raise ValueError(f"{self.out}: cannot be written: say a file in a directory there is")

    def bench(self, board: Hello, rest_ratio: Float) -> Bench:
        """The bench, at this board with this untouched skin."""
        return Bench(
            board=board,
            rest_ratio=rest_ratio,
            method=self.method,
            indenter_area_m2=1e-6 * self.indenter_mm2,
            date=now(),
            nominal_wire_ohm=WireOhm(self.top_wire_ohm, self.bottom_wire_ohm),
        )


def from_recording(
    wanted: Wanted, recording: Path, forces: Path | None = None, rest_s: float = 0.0
) -> None:
    """Calibrate with a recording of presses.

    forces: the force sensor's log; None: what was recorded. rest_s: so long nothing touched the
    skin at first; 0: its tare tells.
    """
    given = load_recording(recording)
    log = _force_log(recording, given) if forces is None else load_force_log(forces)
    if not given.scans:
        raise RecordingError(f"{recording}: no scan in it")
    bench = wanted.bench(given.hellos[-1], _rest_ratio(recording, given, rest_s))
    with _progress(bench.method, len(given.scans)) as progress:
        history = measure(bench, given.scans, progress)
    with naming(recording):
        presses, alignment = presses_from_log(history, log)
    notes = [
        f"offset of the clocks {alignment.offset_s:+.3f} s, correlation "
        f"{alignment.correlation:.2f} over {alignment.overlap_s:.0f} s; zero of the force sensor "
        f"{presses.zero_n:+.3f} N"
    ]
    if presses.shared:
        notes.append(f"{presses.shared} scans left out: two cells were pressed")
    finish(bench, presses, recording, wanted.out, notes)


def from_table(bench: Bench, rows: PressTable, source: Path, out: Path) -> None:
    """Calibrate with a table of presses, which is from `source`."""
    with naming(source):
        presses = presses_from_table(bench, rows)
    finish(bench, presses, source, out)


def finish(
    bench: Bench, presses: Presses, source: Path, out: Path, notes: Sequence[str] = ()
) -> None:
    """Write the calibration that the presses from `source` tell, and say what it is worth."""
    with naming(source):
        calibration, message = bench.calibration(presses)
    calibration.save(out)
    for note in notes:
        _out.print(note)
    _out.print(_report(calibration, presses))
    if message:
        _out.print(message)
    if calibration.nominal_wire_ohm.both is None:
        _out.print(
            "wires are not told (--top-wire, --bottom-wire): forces' standard deviations are wide"
        )
    _out.print(f"{out}: calibration of unit {calibration.unit_id}", markup=False)


def _force_log(path: Path, given: Recording) -> ForceLog:
    if not given.forces:
        raise ValueError(f"{path}: no force in it: say --forces LOG.csv")
    time_s = np.array([sample.host_time_s for sample in given.forces])
    force_n = np.array([sample.force_n for sample in given.forces])
    with naming(path):
        return ForceLog(time_s, force_n, given.forces[0].source)


def _rest_ratio(path: Path, given: Recording, rest_s: float) -> Float:
    if rest_s:
        first_s = given.scans[0].host_time_s
        untouched = [scan.ratio for scan in given.scans if scan.host_time_s - first_s <= rest_s]
        return np.asarray(np.mean(untouched, axis=0))
    if not given.tares:
        raise ValueError(
            f"{path}: no tare in it: say --rest 2 if nothing touched the skin for its first 2 s"
        )
    return given.tares[0].rest_ratio


def _report(calibration: Calibration, presses: Presses) -> Table:
    table = Table(box=None, title="held-out error [N], of so many presses; *: no curve of its own")
    table.add_column("", justify="right", style="dim")
    for column in range(calibration.columns):
        table.add_column(str(column), justify="right")
    model = calibration.model
    for row in range(calibration.rows):
        table.add_row(
            str(row),
            *(
                f"{model.held_out_rmse[row, column]:.2f} ({count})"
                f"{'*' if model.pooled[row, column] else ''}"
                for column, count in enumerate(presses.counts[row])
            ),
        )
    return table


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    messages = Console(stderr=True)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)
