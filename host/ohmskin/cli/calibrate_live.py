# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate weights`` and ``sensor``: a person presses, and is told what and when."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

import ohmskin
from ohmskin.calibrate.alignment import MIN_OVERLAP_S
from ohmskin.calibrate.bench import Bench, presses_from_table
from ohmskin.calibrate.force_sensor import DEFAULT_BAUD, ForceSensor
from ohmskin.calibrate.guide import Ask, Cells, Event, Guide, State, Steady, still_asked
from ohmskin.calibrate.number_table import naming
from ohmskin.calibrate.press_table import PressTable, load_press_table, save_press_table
from ohmskin.calibrate.press_watch import PressWatch
from ohmskin.cli.calibrate_parts import (
    DEFAULT_METHOD,
    BottomWire,
    Indenter,
    Method,
    Out,
    Port,
    TopWire,
    Wanted,
    from_recording,
    from_table,
)
from ohmskin.cli.record import record_scans, stop_signals
from ohmskin.errors import DeviceLost, RecordingError
from ohmskin.estimate.methods import VOLTAGE
from ohmskin.force.reader import TARE_S
from ohmskin.force.regression import MIN_PRESSES
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.record.recorder import Recorder

GRAVITY: Final = 9.80665  # standard [m/s^2]
_INTERRUPTED: Final = 130

_out = Console(soft_wrap=True)


# ------------------------------------------------------------------------------------- weights


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
    wanted = Wanted(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    if method == VOLTAGE:
        raise ValueError(f"presses are kept as conductances, which '{VOLTAGE}' knows nothing of")
    forces_n = [1e-3 * mass_g * GRAVITY for mass_g in _grams(grams)]
    if repeats < 1:
        raise ValueError(f"--repeats is {repeats}, it must be 1 or more")
    only, again = _cells(cells), [cell for text in redo or () for cell in _cells(text)]
    kept = _KeptPresses(table or out.with_suffix(".presses.csv"))
    with ohmskin.open(port) as skin:
        shape = skin.info.rows, skin.info.columns
        _check_cells([*only, *again], shape)
        asked = [
            Ask(row, column, force_n)
            for row, column in only or np.ndindex(shape)
            for _ in range(repeats)
            for force_n in forces_n
        ]
        others = [press for press in kept.presses if (press.row, press.column) not in again]
        missing = still_asked(asked, others)
        _check_enough([*others, *missing], shape)
        _out.print(f"take everything off the skin: its rest is measured, {TARE_S:g} s")
        bench = wanted.bench(skin.info, skin.mean_ratio(TARE_S))
        if kept.table is not None:
            with naming(kept.path):
                presses_from_table(bench, kept.table)  # raises for another skin's
        kept.drop(again)
        rest_us = 1e6 * bench.estimator().rest_level()
        _out.print(f"rest: {rest_us.min():.2f} to {rest_us.max():.2f} microsiemens")
        left = _guided(skin, bench, kept, missing, len(asked)) if missing else 0
    if left:
        what = "the same command without --redo" if again else "the same command"
        done = f"{len(asked) - left} of {len(asked)} presses are in {kept.path}"
        _out.print(f"{done}: {what} goes on", markup=False)
        raise typer.Exit(_INTERRUPTED)
    assert kept.table is not None
    from_table(bench, kept.table, kept.path, out)


def _guided(skin: Device, bench: Bench, kept: _KeptPresses, missing: list[Ask], total: int) -> int:
    """Ask for what is missing; returns how much still is when it was interrupted."""
    guide, estimator = Guide(missing), bench.estimator()
    rest, left = estimator.rest_level(), len(missing)
    with stop_signals() as (may_interrupt, is_stopped), _Voice(total).speaking() as voice:
        while not is_stopped():
            may_interrupt(True)
            scan = skin.latest()
            may_interrupt(False)
            found = estimator.estimate(scan.ratio)
            event = guide.feed(1e-6 * scan.time_us, found.level - rest, found.touched)
            if event.had is not None:
                kept.add(event.had, float(rest[event.had.ask.row, event.had.ask.column]))
                left -= 1
            voice.say(event, total - left)
            if event.state is State.DONE:
                break
    return left


class _KeptPresses:
    """The table of presses in its file: whole after each of them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table: PressTable | None = load_press_table(path) if path.exists() else None

    @property
    def presses(self) -> list[Ask]:
        """Cell and force of each."""
        if self.table is None:
            return []
        columns = (self.table.row, self.table.column, self.table.force_n)
        return [Ask(*values) for values in zip(*(c.tolist() for c in columns), strict=True)]

    def add(self, had: Steady, rest: float) -> None:
        """Keep one more press, of a cell with this conductance at rest."""
        # The table has no conductance below 0.
        conductance = max(had.rise + rest, 0.0)
        values = (had.ask.row, had.ask.column, had.ask.force_n, conductance, had.rise_std)
        one = PressTable(*(np.array([value]) for value in values))
        if self.table is not None:
            one = PressTable(
                *(
                    np.append(getattr(self.table, field.name), getattr(one, field.name))
                    for field in fields(PressTable)
                )
            )
        save_press_table(self.path, one)
        self.table = one

    def drop(self, cells: list[tuple[int, int]]) -> None:
        """Forget all presses of these cells."""
        keep = [(press.row, press.column) not in cells for press in self.presses]
        if self.table is None or all(keep):
            return
        if not any(keep):
            self.table = None
            self.path.unlink()
            return
        self.table = PressTable(
            *(getattr(self.table, field.name)[keep] for field in fields(PressTable))
        )
        save_press_table(self.path, self.table)


class _Voice:
    """Says what to do next: lines, and in a terminal a bar, and the bell when a press is had."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._said = ""
        self._bar = Progress(
            BarColumn(20),
            MofNCompleteColumn(),
            TextColumn("{task.description}", markup=False),
            console=_out,
            transient=True,
            disable=not _out.is_terminal,
        )
        self._task = self._bar.add_task("", total=total)

    @contextmanager
    def speaking(self) -> Iterator[_Voice]:
        """Shows the bar meanwhile."""
        with self._bar:
            yield self

    def say(self, event: Event, done: int) -> None:
        """Say what a scan has led to; nothing twice."""
        if event.had is not None:
            _out.bell()
            self._line(
                f"{done} of {self._total}: {1e6 * event.had.rise:.2f} +- "
                f"{1e6 * event.had.rise_std:.2f} microsiemens above rest: take it off"
            )
        elif event.ask is not None and event.state is State.PUT:
            self._line(f"put {_weight(event.ask)} on {_place(event.ask)}")
        elif event.ask is not None and event.state is State.WRONG:
            asked = (event.ask.row, event.ask.column)
            pressed = ", ".join(map(str, event.cells))
            is_are = "cells {} are" if len(event.cells) > 1 else "cell {} is"
            self._line(f"{is_are.format(pressed)} pressed: put the weight on {asked} alone")
        self._bar.update(self._task, completed=done, description=self._now(event))

    def _line(self, text: str) -> None:
        if text != self._said:
            _out.print(text, markup=False, highlight=False)
        self._said = text

    def _now(self, event: Event) -> str:
        if event.state is State.HOLD:
            if event.change is None:
                return "reading"
            return f"not steady yet: changes by {100 * event.change:.0f} % in half a second"
        return "" if event.state is State.DONE else event.state.value


def _weight(ask: Ask) -> str:
    return f"{1e3 * ask.force_n / GRAVITY:.6g} g ({ask.force_n:.3f} N)"


def _place(ask: Ask) -> str:
    return f"cell ({ask.row}, {ask.column}), row {ask.row}, column {ask.column}"


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


def _check_cells(cells: list[tuple[int, int]], shape: tuple[int, int]) -> None:
    for row, column in cells:
        if row >= shape[0] or column >= shape[1]:
            raise ValueError(
                f"cell ({row}, {column}) is not on this {shape[0]}x{shape[1]} skin, whose first "
                "is (0, 0)"
            )


def _check_enough(presses: list[Ask], shape: tuple[int, int]) -> None:
    """Raise ValueError if all of these could tell no curve: before anybody makes them."""
    if len(presses) < MIN_PRESSES:
        raise ValueError(f"{len(presses)} presses are too few: {MIN_PRESSES} are needed")
    if len({press.force_n for press in presses}) == 1:
        raise ValueError("one weight tells no curve: give two or more in --grams")
    if len({(press.row, press.column) for press in presses}) == 1 and math.prod(shape) > 1:
        raise ValueError("one cell does not tell how much cells differ: give two or more")


# -------------------------------------------------------------------------------------- sensor


def sensor(
    port: Port,
    sensor: Annotated[str, typer.Argument(help="force sensor's serial port: one number a line")],
    out: Out,
    indenter_mm2: Indenter,
    baud: Annotated[int, typer.Option(help="speed of the force sensor's port")] = DEFAULT_BAUD,
    scale: Annotated[
        float, typer.Option(help="newtons for one unit of its numbers; of grams: 0.00980665")
    ] = 1.0,
    recording: Annotated[
        Path | None, typer.Option(help="file to record into (.mcap), a new one; default: by OUT")
    ] = None,
    seconds: Annotated[float, typer.Option(help="stop after so long; 0: never")] = 0.0,
    rest_s: Annotated[
        float, typer.Option("--rest", help="so long nothing touches the skin at first, in s")
    ] = 2.0,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """With a force sensor at SENSOR: press cell after cell of the skin at PORT. Ctrl-C ends it.

    Everything is recorded; what 'calibrate recording' makes of it is the calibration.
    """
    wanted = Wanted(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    if not (math.isfinite(rest_s) and rest_s > 0):
        raise ValueError(f"--rest is {rest_s:g}, it must be above 0: the skin's rest is needed")
    if 0 < seconds < MIN_OVERLAP_S:
        raise ValueError(f"--seconds is {seconds:g}, {MIN_OVERLAP_S:g} are needed to align clocks")
    file = recording or out.with_suffix(".mcap")
    if file.exists():
        raise RecordingError(f"{file} is there already: choose another name with --recording")
    with (
        ohmskin.open(port, start=False) as skin,
        ForceSensor(sensor, baud, scale) as force,
    ):
        force.wait()
        with Recorder(file, skin.info) as recorder:
            try:
                _record_presses(skin, force, recorder, seconds, rest_s)
            except DeviceLost as exc:
                raise DeviceLost(
                    f"{exc} (what came before is in {file}, for 'ohmskin calibrate recording')"
                ) from exc
    notes = f"{file}: {recorder.scans} scans, missed {recorder.missed}"
    if force.damaged:
        notes += f"; {force.damaged} lines of {sensor} were no numbers"
    _out.print(notes, markup=False)
    from_recording(wanted, file)


def _record_presses(
    skin: Device, force: ForceSensor, recorder: Recorder, seconds: float, rest_s: float
) -> None:
    _out.print(
        f"touch nothing for {rest_s:g} s, then press single cells; Ctrl-C ends it", highlight=False
    )
    with Live(console=_out, transient=True, auto_refresh=False) as live:
        watch = PressWatch(skin.info, rest_s) if _out.is_terminal else None

        def beside(scan: Scan) -> None:
            samples = force.take()
            for sample in samples:
                recorder.add(sample)
            if watch is not None and watch.see(scan, samples[-1].force_n if samples else None):
                live.update(watch.table(), refresh=True)

        record_scans(skin, recorder, 0, seconds, rest_s, beside)
