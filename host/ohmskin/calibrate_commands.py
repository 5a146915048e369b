# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate``: with a force sensor, with weights, from a table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import ohmskin
from ohmskin.calibrate import Bench, measure, presses_from_log, presses_from_table
from ohmskin.calibrated_device import TARE_S, now
from ohmskin.calibration import Calibration
from ohmskin.circuit import Float
from ohmskin.errors import RecordingError
from ohmskin.force_log import ForceLog, load_force_log
from ohmskin.levels import LEVEL_METHODS
from ohmskin.number_table import naming
from ohmskin.press_table import load_press_table
from ohmskin.presses import Presses
from ohmskin.recording import Recording, load_recording

calibrate = typer.Typer(
    no_args_is_help=True,
    help="Learn each cell's force from presses of single cells: a calibration file (.json).",
)
_out = Console(soft_wrap=True)
_DEFAULT_METHOD = "joint"

Out = Annotated[Path, typer.Argument(help="calibration file to write (.json)")]
Method = Annotated[str, typer.Option(help=" | ".join(LEVEL_METHODS))]
Indenter = Annotated[
    float, typer.Option("--indenter-mm2", help="area that the skin is pressed with [mm2]")
]
TopWire = Annotated[
    float | None, typer.Option("--top-wire", help="one wire segment of a row [ohm], if known")
]
BottomWire = Annotated[
    float | None, typer.Option("--bottom-wire", help="one wire segment of a column [ohm], if known")
]


@calibrate.command()
def recording(
    recording: Annotated[Path, typer.Argument(help="recording (.mcap) of presses of single cells")],
    out: Out,
    indenter_mm2: Indenter,
    forces: Annotated[
        Path | None,
        typer.Option(help="force sensor's log (.csv: time_s, force_n); default: the recording's"),
    ] = None,
    rest_s: Annotated[
        float,
        typer.Option("--rest", help="so long nothing touched the skin at first; 0: its tare [s]"),
    ] = 0.0,
    method: Method = _DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a recording of presses, and a force sensor's log of the same time.

    The two clocks may differ: they are aligned by what both saw.
    """
    given = load_recording(recording)
    log = _force_log(recording, given) if forces is None else load_force_log(forces)
    if not given.scans:
        raise RecordingError(f"{recording}: no scan in it")
    bench = Bench(
        board=given.hellos[-1],
        rest_ratio=_rest_ratio(recording, given, rest_s),
        method=method,
        indenter_area_m2=1e-6 * indenter_mm2,
        date=now(),
        nominal_top_wire_ohm=top_wire_ohm,
        nominal_bottom_wire_ohm=bottom_wire_ohm,
    )
    with _progress(method, len(given.scans)) as progress:
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
    _finish(bench, presses, recording, out, notes)


@calibrate.command()
def table(
    port: Annotated[str, typer.Argument(help="serial port or URL; nothing may touch the skin")],
    table: Annotated[Path, typer.Argument(help="row,column,force_n,conductance (.csv)")],
    out: Out,
    indenter_mm2: Indenter,
    rest_s: Annotated[
        float, typer.Option("--rest", help="so long the untouched skin is measured [s]")
    ] = TARE_S,
    method: Method = _DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a table of presses (conductance in siemens), and the untouched skin at PORT."""
    rows = load_press_table(table)
    with ohmskin.open(port) as skin:
        bench = Bench(
            board=skin.info,
            rest_ratio=skin.mean_ratio(rest_s),
            method=method,
            indenter_area_m2=1e-6 * indenter_mm2,
            date=now(),
            nominal_top_wire_ohm=top_wire_ohm,
            nominal_bottom_wire_ohm=bottom_wire_ohm,
        )
    with naming(table):
        presses = presses_from_table(bench, rows)
    _finish(bench, presses, table, out)


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


def _finish(
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
    _out.print(f"{out}: calibration of unit {calibration.unit_id}", markup=False)


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
