# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate``: with weights, from a recording, from a table of presses."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

import ohmskin
from ohmskin.arrays import Float
from ohmskin.calibrate.alignment import align
from ohmskin.calibrate.guide import Cells, Guide, Press, State, Step, still_wanted
from ohmskin.calibrate.presses import Calibrator, Presses, find_presses
from ohmskin.calibrate.tables import (
    PRESS,
    ForceLog,
    PressTable,
    load_force_log,
    load_press_table,
    save_press_table,
)
from ohmskin.cli.record import until_stopped
from ohmskin.cli.stream import cell_table
from ohmskin.errors import RecordingError
from ohmskin.estimate.base import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import LEVEL_METHODS, VOLTAGE
from ohmskin.files import naming
from ohmskin.force.reader import DEFAULT_METHOD, TARE_S, now
from ohmskin.force.regression import MIN_PRESSES
from ohmskin.link.device import Device
from ohmskin.link.messages import Hello
from ohmskin.record.recording import Recording, load_recording

# Standard gravity [m/s^2].
GRAVITY: Final = 9.80665
# What a shell says of a command that Ctrl-C ended.
_INTERRUPTED: Final = 130

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

calibrate = typer.Typer(
    no_args_is_help=True,
    help="Learn each cell's force from presses of single cells: a calibration file (.json).",
)
_out = Console(soft_wrap=True)


# -------------------------------------------------------------------------------- the commands


@calibrate.command()
def weights(
    port: Port,
    out: Out,
    grams: Annotated[str, typer.Option(help="the weights you have, in gram, such as 50,100")],
    indenter_mm2: Indenter,
    repeats: Annotated[int, typer.Option(help="times each weight is put on each cell")] = 2,
    cells: Annotated[str, typer.Option(help="row,column of each, '0,0 0,1'; default: all")] = "",
    redo: Annotated[
        list[str] | None, typer.Option(help="row,column: drop this cell's presses first")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="presses so far (.csv); default: OUT with .presses.csv")
    ] = None,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """With weights: says which to put on which cell of the skin at PORT, and when it has read it.

    Every press is kept at once: after Ctrl-C the same command goes on.
    """
    calibrator_of = _options(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    if method == VOLTAGE:
        raise ValueError(f"presses are kept as conductances, which '{VOLTAGE}' knows nothing of")
    forces_n = [1e-3 * mass_g * GRAVITY for mass_g in _grams(grams)]
    if repeats < 1:
        raise ValueError(f"--repeats is {repeats}, it must be 1 or more")
    only, again = _cells(cells), _cells(" ".join(redo or ()))
    kept = _KeptPresses(table or out.with_suffix(".presses.csv"))
    with ohmskin.open(port) as skin:
        shape = skin.info.rows, skin.info.columns
        _check_cells([*only, *again], shape)
        wanted = [
            Press(cell, force_n)
            for cell in only or np.ndindex(shape)
            for _ in range(repeats)
            for force_n in forces_n
        ]
        read = [press for press in kept.presses if press.cell not in again]
        missing = still_wanted(wanted, read)
        _check_enough([*read, *missing], shape)
        _out.print(f"take everything off the skin: its rest is measured, {TARE_S:g} s")
        calibrator = calibrator_of(skin.info, skin.mean_ratio(TARE_S))
        with naming(kept.path):
            calibrator.presses_in_table(kept.table)  # raises ValueError for another skin's
        if again:
            kept.drop(again)
        rest_us = 1e6 * calibrator.estimator().rest_level()
        _out.print(f"rest: {rest_us.min():.2f} to {rest_us.max():.2f} microsiemens")
        left = _guided(skin, calibrator, kept, missing, len(wanted)) if missing else 0
    if left:
        command = "the same command without --redo" if again else "the same command"
        done = f"{len(wanted) - left} of {len(wanted)} presses are in {kept.path}"
        _out.print(f"{done}: {command} goes on", markup=False)
        raise typer.Exit(_INTERRUPTED)
    _from_table(calibrator, kept.table, kept.path, out)


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
        typer.Option("--rest", help="so long nothing touched the skin at first, in s; 0: its tare"),
    ] = 0.0,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a recording of presses, with the forces in it or a force sensor's log of the same time.

    The two clocks may differ: they are aligned by what both saw.
    """
    calibrator_of = _options(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    given = load_recording(recording)
    if not given.scans:
        raise RecordingError(f"{recording}: no scan in it")
    log = None if forces is None else load_force_log(forces)
    with naming(recording), _progress(method, len(given.scans)) as progress:
        log = log or _force_log(given)
        calibrator = calibrator_of(given.hellos[-1], _rest_ratio(given, rest_s))
        history = calibrator.measure(given.scans, progress)
        alignment = align(history.time_s, history.of_skin, log)
        presses = find_presses(history, log, alignment.offset_s)
    notes = [
        f"offset of the clocks {alignment.offset_s:+.3f} s, correlation "
        f"{alignment.correlation:.2f} over {alignment.overlap_s:.0f} s; zero of the force sensor "
        f"{presses.zero_n:+.3f} N"
    ]
    if presses.shared:
        notes.append(f"{presses.shared} scans left out: two cells were pressed")
    _finish(calibrator, presses, recording, out, notes)


@calibrate.command()
def table(
    port: Port,
    table: Annotated[Path, typer.Argument(help="row,column,force_n,conductance (.csv)")],
    out: Out,
    indenter_mm2: Indenter,
    rest_s: Annotated[
        float, typer.Option("--rest", help="so long the untouched skin is measured, in s")
    ] = TARE_S,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a table of presses (conductance in siemens), and the untouched skin at PORT."""
    calibrator_of = _options(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    rows = load_press_table(table)
    with ohmskin.open(port) as skin:
        calibrator = calibrator_of(skin.info, skin.mean_ratio(rest_s))
    _from_table(calibrator, rows, table, out)


# ---------------------------------------------------------------------- what they have in common


def _options(
    out: Path,
    method: str,
    indenter_mm2: float,
    top_wire_ohm: float | None,
    bottom_wire_ohm: float | None,
) -> Callable[[Hello, Float], Calibrator]:
    """Check what all commands are told, before anybody presses cells for an hour.

    Returns what makes the calibrator of a board and the readings (R, C, 4) of its untouched skin.
    """
    wires = WireOhm(top_wire_ohm, bottom_wire_ohm)
    wires.check()
    if method not in LEVEL_METHODS:
        raise ValueError(f"no method '{method}': there are {', '.join(LEVEL_METHODS)}")
    if not (math.isfinite(indenter_mm2) and indenter_mm2 > 0):
        raise ValueError(f"--indenter-mm2 is {indenter_mm2:g}, it must be above 0")
    if out.is_dir() or not out.parent.is_dir():
        raise ValueError(f"{out}: cannot be written: say a file in a directory there is")

    def calibrator_of(board: Hello, rest_ratio: Float) -> Calibrator:
        knowledge = SkinKnowledge.of(board, rest_ratio, wires)
        return Calibrator(knowledge, method, 1e-6 * indenter_mm2, board.unit_id, now())

    return calibrator_of


def _force_log(given: Recording) -> ForceLog:
    """The forces of a recording, whose scans have the same clock."""
    if not given.forces:
        raise ValueError("no force in it: say --forces LOG.csv")
    time_s, force_n = np.array([(each.host_time_s, each.force_n) for each in given.forces]).T
    return ForceLog(time_s, force_n)


def _rest_ratio(given: Recording, rest_s: float) -> Float:
    """Mean readings (R, C, 4) of so many first seconds; 0: the recorded tare."""
    if rest_s:
        first_s = given.scans[0].host_time_s
        untouched = [scan.ratio for scan in given.scans if scan.host_time_s - first_s <= rest_s]
        return np.asarray(np.mean(untouched, axis=0))
    if not given.tares:
        raise ValueError("no tare in it: say --rest 2 if nothing touched the skin for 2 s at first")
    return given.tares[0].rest_ratio


def _from_table(calibrator: Calibrator, table: PressTable, source: Path, out: Path) -> None:
    with naming(source):
        presses = calibrator.presses_in_table(table)
    _finish(calibrator, presses, source, out)


def _finish(
    calibrator: Calibrator, presses: Presses, source: Path, out: Path, notes: Sequence[str] = ()
) -> None:
    """Write the calibration that the presses from `source` tell, and say what it is worth."""
    with naming(source):
        calibration, message = calibrator.calibration(presses)
    calibration.save(out)
    for note in notes:
        _out.print(note)
    model = calibration.model
    table = [
        [
            f"{rmse_n:.2f} ({count}){'*' if pooled else ''}"
            for rmse_n, count, pooled in zip(*row, strict=True)
        ]
        for row in zip(model.held_out_rmse, presses.counts, model.pooled, strict=True)
    ]
    title = "held-out error [N], of so many presses; *: no curve of its own"
    _out.print(cell_table(table, title))
    if message:
        _out.print(message)
    if calibration.nominal_wire_ohm.both is None:
        _out.print(
            "wires are not told (--top-wire, --bottom-wire): forces' standard deviations are wide"
        )
    _out.print(f"{out}: calibration of unit {calibration.unit_id}", markup=False)


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    messages = Console(stderr=True)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


# -------------------------------------------------------------------------------- with weights


class _KeptPresses:
    """A table of presses and its file, which is whole after each change."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table: PressTable = load_press_table(path) if path.exists() else np.empty(0, PRESS)

    @property
    def presses(self) -> list[Press]:
        """Cell and force of each."""
        return [Press((row, column), force_n) for row, column, force_n, *_ in self.table.tolist()]

    def add(self, press: Press, conductance: float, std: float) -> None:
        """Keep one more press, under which the cell had this conductance [S]."""
        # The table has no conductance below 0.
        one = np.array([(*press.cell, press.force_n, max(conductance, 0.0), std)], PRESS)
        self._keep(np.concatenate([self.table, one]))

    def drop(self, cells: Cells) -> None:
        """Forget all presses of these cells."""
        self._keep(self.table[[press.cell not in cells for press in self.presses]])

    def _keep(self, table: PressTable) -> None:
        if table.size:
            save_press_table(self.path, table)
        else:
            self.path.unlink(missing_ok=True)
        self.table = table


def _guided(
    skin: Device, calibrator: Calibrator, kept: _KeptPresses, missing: list[Press], total: int
) -> int:
    """Ask for what is missing. Returns how much still is, after an interruption."""
    guide, estimator, left = Guide(missing), calibrator.estimator(), len(missing)
    rest = estimator.rest_level()
    voice = _Voice(total)
    with voice.bar:
        for scan in until_stopped(iter(skin.latest, None)):
            found = estimator.estimate(scan.ratio)
            step = guide.feed(1e-6 * scan.time_us, found.level - rest, found.touched)
            if step.wanted is not None and step.rise is not None:
                kept.add(step.wanted, step.rise + rest[step.wanted.cell], step.rise_std)
                left -= 1
            voice.say(step, total - left)
            if step.state is State.DONE:
                break
    return left


class _Voice:
    """Says what to do next, by lines; in a terminal also by a bar, and a bell for each press."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._said = ""
        self.bar = Progress(
            BarColumn(20),
            MofNCompleteColumn(),
            TextColumn("{task.description}", markup=False),
            console=_out,
            transient=True,
            disable=not _out.is_terminal,
        )
        self._task = self.bar.add_task("", total=total)

    def say(self, step: Step, done: int) -> None:
        """Say what a scan has led to; nothing twice."""
        line, press = "", step.wanted
        if step.rise is not None:
            _out.bell()
            line = (
                f"{done} of {self._total}: {1e6 * step.rise:.2f} +- {1e6 * step.rise_std:.2f} "
                "microsiemens above rest: take it off"
            )
        elif press is not None and step.state is State.PUT:
            weight = f"{1e3 * press.force_n / GRAVITY:.6g} g ({press.force_n:.3f} N)"
            row, column = press.cell
            line = f"put {weight} on cell {press.cell}, row {row}, column {column}"
        elif press is not None and step.state is State.WRONG:
            cells = ", ".join(map(str, step.cells))
            pressed = f"cells {cells} are" if len(step.cells) > 1 else f"cell {cells} is"
            line = f"{pressed} pressed: put the weight on {press.cell} alone"
        if line and line != self._said:
            _out.print(line, markup=False, highlight=False)
            self._said = line
        now = "" if step.state is State.DONE else step.state.value
        if step.state is State.HOLD:
            now = "reading"
            if step.change is not None:
                now = f"not steady yet: changes by {100 * step.change:.0f} % in half a second"
        self.bar.update(self._task, completed=done, description=now)


def _grams(text: str) -> list[float]:
    try:
        masses_g = [float(part) for part in text.split(",")]
    except ValueError:
        masses_g = []
    if not masses_g or not all(math.isfinite(mass_g) and mass_g > 0 for mass_g in masses_g):
        raise ValueError(f"--grams {text!r:.60}: give weights above 0, such as 50,100,200")
    if len(set(masses_g)) < len(masses_g):
        raise ValueError(f"--grams {text!r:.60}: a weight stands twice: say --repeats instead")
    return masses_g


def _cells(text: str) -> Cells:
    cells = []
    for part in text.split():
        row, comma, column = part.partition(",")
        if not (comma and row.isdecimal() and column.isdecimal()):
            raise ValueError(f"'{part:.40}' is no cell: write row,column, such as 0,1")
        cells.append((int(row), int(column)))
    return tuple(dict.fromkeys(cells))


def _check_cells(cells: Sequence[tuple[int, int]], shape: tuple[int, int]) -> None:
    for row, column in cells:
        if row >= shape[0] or column >= shape[1]:
            raise ValueError(
                f"cell ({row}, {column}) is not on this {shape[0]}x{shape[1]} skin, whose first "
                "is (0, 0)"
            )


def _check_enough(presses: list[Press], shape: tuple[int, int]) -> None:
    """Raise ValueError if all of these could tell no curve: before anybody makes them."""
    if len(presses) < MIN_PRESSES:
        raise ValueError(f"{len(presses)} presses are too few: {MIN_PRESSES} are needed")
    if len({press.force_n for press in presses}) == 1:
        raise ValueError("one weight tells no curve: give two or more in --grams")
    if len({press.cell for press in presses}) == 1 and math.prod(shape) > 1:
        raise ValueError("one cell does not tell how much cells differ: give two or more")
