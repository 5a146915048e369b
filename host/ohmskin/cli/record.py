# SPDX-License-Identifier: Apache-2.0
"""``ohmskin record``, ``export`` and ``estimate``: scans in files."""

import math
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from secrets import token_hex
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.text import Text
from typer import Argument, Option

import ohmskin
from ohmskin.calibrate.guide import OnSkin, pressed_cells
from ohmskin.calibrate.rules import check_complete
from ohmskin.cli.board import (
    REF_STD,
    TERMINAL,
    Port,
    Scans,
    Seconds,
    asked_for,
    warn_of_touched,
)
from ohmskin.cli.stream import DISPLAY_EVERY_S, cell_table
from ohmskin.cli.terminal import Terminal
from ohmskin.ctrl_c import ends_in_time, until_ctrl_c
from ohmskin.errors import DeviceLost, OhmskinError, RecordingError
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import METHODS, make_estimator
from ohmskin.files import check_place, remove_parts
from ohmskin.force import tables
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import DEFAULT_METHOD
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.record import recorder as recording
from ohmskin.record.export import Part
from ohmskin.record.force_sensor import DEFAULT_BAUD, NEWTONS, ForceSensor
from ohmskin.record.readings import estimate_file, load_readings, save_arrays
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Mark

# With a force sensor, the scans of the first so many seconds are a tare [s], unless told. Chosen: a
# person who starts the command may need the first second to take the hand away.
FORCE_TARE_S: Final = 2.0
# A line that was typed becomes a mark, cut to so many characters. Chosen: no mark needs as many; a
# terminal gives up to 4096.
_MOST_TYPED: Final = 1000
# In place of a force sensor's port: the forces that a simulated skin knows.
TRUTH: Final = "truth"
# A sensor's speed, scale, unit and column, where nobody has told them.
NO_OPTIONS: Final = (DEFAULT_BAUD, 1.0, "", "")

ForceBaud = Annotated[int, Option(help="speed of the force sensor's port")]
ForceScale = Annotated[
    float,
    Option(help="the force is so many times what it says: 'ohmskin calibrate scale' finds it"),
]
ForceUnit = Annotated[str, Option(help=f"{' | '.join(NEWTONS)}: where its lines state none")]
ForceColumn = Annotated[str, Option(help="which field of its lines: a name, or a number from 1")]

_errors = Terminal(stderr=True)
_T = TypeVar("_T")


def record(
    port: Port,
    file: Annotated[Path, Argument(help="file to write (.mcap), a new one")],
    scans: Scans = 0,
    seconds: Seconds = 0.0,
    tare_s: Annotated[
        float | None, Option("--tare", min=0, help="touch nothing for so long at first, in s")
    ] = None,
    mark: Annotated[list[str] | None, Option(help="a mark at the beginning")] = None,
    force_port: Annotated[
        str,
        Option(help="a force sensor's serial port: a number a line; of a simulated skin: truth"),
    ] = "",
    force_baud: ForceBaud = DEFAULT_BAUD,
    force_scale: ForceScale = 1.0,
    force_unit: ForceUnit = "",
    force_column: ForceColumn = "",
) -> None:
    """Record every scan at PORT. Ctrl-C ends it; a line typed becomes a mark.

    With a force sensor: press cell after cell, and 'ohmskin calibrate recording' learns from that;
    --tare is 2 then, unless told.
    """
    of_sensor = force_baud, force_scale, force_unit, force_column
    if not force_port and of_sensor != NO_OPTIONS:
        raise ValueError("--force-scale and its like are of a sensor: say --force-port, too")
    if tare_s is None:
        tare_s = FORCE_TARE_S if force_port else 0.0
    with ExitStack() as stack:
        skin = stack.enter_context(ohmskin.open(port, start=False))
        sensor = sensor_at(skin, force_port, *of_sensor) if force_port else None
        if sensor is not None:
            stack.enter_context(sensor).wait()
        if force_port:
            try:
                check_complete(skin.info)
            except ValueError as exc:
                TERMINAL.print(f"no calibration learns from this recording: {exc}")
        recorder = stack.enter_context(Recorder(file, skin.info, lambda: skin.now_s))
        for text in mark or ():
            recorder.add(Mark(text, recorder.now_s()))
        look = None
        if sensor is not None:
            TERMINAL.print(
                f"touch nothing for {tare_s:g} s, then press single cells; Ctrl-C ends it"
            )
            if TERMINAL.is_terminal:
                display = PressDisplay(recorder)
                live = Live(get_renderable=display.picture, console=TERMINAL, transient=True)
                stack.enter_context(live)
                look = display.look
        if sys.stdin is not None and sys.stdin.isatty():
            if hasattr(signal, "SIGTTIN"):
                # In the background of a shell, a terminal that is read stops the whole process.
                # Where the signal is ignored, reading fails there instead, and no marks are taken.
                signal.signal(signal.SIGTTIN, signal.SIG_IGN)
            # A thread, because the end of the recording must not wait for a line.
            threading.Thread(target=_take_marks, args=(recorder,), daemon=True).start()
        try:
            given = _warned(asked_for(until_ctrl_c(skin), scans, seconds), recorder)
            if force_port == TRUTH:
                given = with_truth(given, skin, recorder)
            recording.record(skin, recorder, given, tare_s=tare_s, sensor=sensor, beside=look)
        except DeviceLost as exc:
            raise DeviceLost(f"{exc} (what came before is in {file})") from exc
    done = f"{recorder.scans} scans, missed {recorder.missed}, {recorder.size} bytes"
    if force_port:
        done += f", {recorder.forces} forces"
    TERMINAL.print(f"{file}: {done}{unread(sensor)}")


def _warned(scans: Iterable[Scan], recorder: Recorder) -> Iterator[Scan]:
    """Pass scans on, and warn of cells that seem touched in the tare, when there is one."""
    is_judged = False
    for scan in scans:
        if recorder.tare is not None and not is_judged:
            is_judged = True
            warn_of_touched(recorder.board, recorder.tare.rest_ratio)
        yield scan


def unread(sensor: ForceSensor | None) -> str:
    """A clause about lines of a force sensor that could not be read; none if there are none."""
    if sensor is None or not sensor.damaged:
        return ""
    return f", {sensor.damaged} lines that could not be read"


def sensor_at(
    skin: Device, port: str, baud: int, scale: float, unit: str, column: str
) -> ForceSensor | None:
    """The force sensor at a port; None: the port is `TRUTH`, which this skin knows.

    Raises ValueError where the skin knows no truth, or a sensor's option is given beside it.
    """
    if port == TRUTH and skin.true_force_n is None:
        raise ValueError("--force-port truth: only emulator:// and simavr:// know it")
    of_sensor = baud, scale, unit, column
    if port == TRUTH and of_sensor != NO_OPTIONS:
        raise ValueError("--force-port truth is in newtons: leave --force-scale and its like out")
    return None if port == TRUTH else ForceSensor(port, *of_sensor)


def with_truth(scans: Iterable[Scan], skin: Device, recorder: Recorder) -> Iterator[Scan]:
    """Pass scans on, and record the whole force on the simulated skin beside each.

    Scans and forces get their times from the board's clock, because a scan may arrive late, and the
    board of a simulator may be slower than the host's clock.
    """
    begin_s, before_s = 0.0, math.inf  # of the board's clock, by the host's; the scan before
    assert skin.true_force_n is not None
    for scan in scans:
        board_s = 1e-6 * scan.time_us
        if board_s < before_s:  # the first scan, or the board was reset and counts anew
            begin_s = scan.host_time_s - board_s
        before_s = board_s
        force_n = float(skin.true_force_n(scan).sum())
        recorder.add(ForceSample(force_n, begin_s + board_s, source=TRUTH))
        yield replace(scan, host_time_s=begin_s + board_s)


def progress(what: str) -> Callable[[Iterable[_T]], Iterable[_T]]:
    """Passes things on; in a terminal, a bar says how many have been, and for how long."""

    def watched(things: Iterable[_T]) -> Iterator[_T]:
        with _bar() as bar:
            yield from bar.track(things, description=what)

    return watched


def _bar() -> Progress:
    what = TextColumn("{task.description}", style="progress.description", markup=False)
    columns = (what, *Progress.get_default_columns()[1:], TimeElapsedColumn())
    return Progress(*columns, console=_errors, transient=True, disable=not _errors.is_terminal)


class PressDisplay:
    """Shows a person who presses cells, while they are recorded, which cells are still missing.

    counts: presses of each cell, (R, C): how often it alone was pressed for `CERTAIN_S`.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.counts = np.zeros((recorder.board.rows, recorder.board.columns), dtype=np.intp)
        self._recorder = recorder
        self._estimator: Estimator | None = None  # there is none before the rest is known
        self._on = OnSkin()
        self._looked_s = float("-inf")

    def look(self, scan: Scan) -> None:
        """Look at a scan that was recorded, if the last look was long ago: estimates take time."""
        tare = self._recorder.tare
        if tare is None or scan.host_time_s - self._looked_s < DISPLAY_EVERY_S:
            return
        self._looked_s = scan.host_time_s
        if self._estimator is None:
            knowledge = SkinKnowledge.of(self._recorder.board, tare.rest_ratio)
            self._estimator = make_estimator(DEFAULT_METHOD, knowledge)
        if tare.is_of(scan):
            frame = self._estimator.estimate(scan.ratio)
            pressed = pressed_cells(frame.level - self._estimator.rest_level(), frame.touched)
            if self._on.see(scan.host_time_s, pressed) and len(self._on.cells) == 1:
                self.counts[self._on.cells[0]] += 1

    def picture(self) -> Group:
        """All of it, for a terminal."""
        force, pressed = self._recorder.force, ", ".join(map(str, self._on.cells))
        now = "touch nothing yet" if self._estimator is None else f"pressed: {pressed or 'none'}"
        force_n = float("nan") if force is None else force.force_n
        head = f"{self._recorder.scans} scans   force {force_n:.2f} N   {now}"
        return Group(
            Text(head), cell_table(self.counts.astype(str).tolist(), "presses of each cell")
        )


def _take_marks(recorder: Recorder) -> None:
    """Lines typed at the terminal become marks, for as long as the recording can be written."""
    text = b""
    with suppress(OhmskinError, OSError):  # the file is full: the scans' loop says so
        # `sys.stdin` has a lock, which this thread would hold for ever: Python could not end then.
        while typed := os.read(sys.stdin.fileno(), 4096):
            *lines, text = (text + typed).split(b"\n")
            for line in lines:
                typed_text = line.decode(errors="replace").strip()[:_MOST_TYPED]
                recorder.add(Mark(typed_text, recorder.now_s()))


def export(
    recordings: Annotated[list[Path], Argument(metavar="RECORDING", help="recordings (.mcap)")],
    out: Annotated[
        Path,
        Argument(help=f"file to write: {', '.join(tables.FORMATS)}; or a folder, made before"),
    ],
    begin_s: Annotated[
        float, Option("--begin", min=0, help="from so long after the first scan, in s")
    ] = 0.0,
    end_s: Annotated[float, Option("--end", min=0, help="until then, in s; 0: to the last")] = 0.0,
    calibration: Annotated[Path | None, Option(help="forces in place of readings")] = None,
    force: Annotated[bool, Option("--force", help="take that of another unit")] = False,
    kind: Annotated[str, Option("--format", help="of the files in a folder; default: .npz")] = "",
    backend: Annotated[str, Option(help="joblib's, where a folder is written: dask")] = "loky",
) -> None:
    """Write recordings as .npz or .csv: readings, or forces by a calibration.

    Recordings that go into a folder are read by all cores at once. .parquet needs pyarrow.
    """
    known = None if calibration is None else load_calibration(calibration)
    kind = kind and f".{kind.removeprefix('.')}"
    is_folder, name_end = out.is_dir(), kind or ".npz"
    if not is_folder and kind not in ("", out.suffix):
        raise ValueError(f"--format {kind} is of files in a folder, and {out} is none")
    if name_end not in tables.FORMATS:
        raise ValueError(f"no format '{name_end}': there are {', '.join(tables.FORMATS)}")
    if not is_folder and (len(recordings) > 1 or not out.suffix):
        raise ValueError(f"{out} is no folder: make it first, as 'mkdir {out}' does")
    if (name_end if is_folder else out.suffix) == ".parquet" and known is None:
        raise ValueError(".parquet has forces: say --calibration")
    pairs = [(path, out / f"{path.stem}{name_end}" if is_folder else out) for path in recordings]
    if len({to for _, to in pairs}) < len(pairs):
        raise ValueError(f"{out}: two recordings have one name, and would be one file there")
    for path, to in pairs:
        check_place(to, path, calibration)
    if len(pairs) == 1:
        with ends_in_time(_errors.show_cursor), _bar() as bar:
            size = pairs[0][0].stat().st_size if pairs[0][0].exists() else 0  # its reader says so
            task = bar.add_task(pairs[0][1].name, total=size)

            def watch(size: int) -> None:
                bar.update(task, completed=size)

            done: list[Part | str] = [
                tables.export(*pairs[0], known, begin_s, end_s, watch, force=force)
            ]
    else:
        done = _at_once(pairs, backend, known, begin_s, end_s, force=force)
    for (path, to), written in zip(pairs, done, strict=True):
        if isinstance(written, str):
            continue
        TERMINAL.print(f"{to}: {written.scans} scans")
        if written.cut_off:
            text = f"{path} was cut off: its last second may be missing"
            _errors.print(text, soft_wrap=True, highlight=False)
    if failed := [written for written in done if isinstance(written, str)]:
        *texts, last = dict.fromkeys(failed)
        # One reason that all have in common is the error itself.
        if texts or len(failed) < len(done):
            for text in (*texts, last):
                _errors.print(" ".join(text.split()), soft_wrap=True, highlight=False)
            last = f"not exported: {len(failed)} of {len(done)} recordings"
        raise RecordingError(last)


def _at_once(
    pairs: list[tuple[Path, Path]], backend: str, *told: Any, force: bool
) -> list[Part | str]:
    """Each of these recordings to its file, by all cores, or by a cluster that joblib knows."""
    from concurrent.futures.process import BrokenProcessPool  # takes long to load

    try:
        import joblib

        with ExitStack() as stack:
            # Workers may be killed, as dask's are by Ctrl-C, or go on elsewhere. This comes last.
            run = token_hex(8)
            stack.callback(remove_parts, run, [to for _, to in pairs])
            if backend == "dask":
                from dask.distributed import Client

                # That of the lab, which dask's own configuration names; else one of this machine.
                stack.enter_context(Client(dashboard_address=None))
            stack.enter_context(joblib.parallel_config(backend))
            job = joblib.delayed(tables.export_or_why_not)
            jobs = (job(*pair, *told, force=force, run=run) for pair in pairs)
            parallel = joblib.Parallel(n_jobs=-1, return_as="generator")
            done = stack.enter_context(closing(parallel(jobs)))  # its processes end with it
            bar = stack.enter_context(_bar())
            return list(bar.track(done, total=len(pairs), description="recordings"))
    except ImportError as exc:
        needed = "joblib" if exc.name == "joblib" else "'dask[distributed]'"
        raise OhmskinError(f"this needs {needed}: run pip install {needed}") from exc
    except BrokenProcessPool as exc:
        ended = "a process that wrote one of the files was ended, as a system ends one"
        raise OhmskinError(f"{ended} where memory is short: export fewer at once") from exc


def estimate(
    readings: Annotated[Path, Argument(help="readings file (.npz)")],
    out: Annotated[Path, Option(help="file to write (.npz)")],
    method: Annotated[str, Option(help=" | ".join(METHODS))] = DEFAULT_METHOD,
    cold: Annotated[bool, Option("--cold", help="start every frame afresh")] = False,
    ref_std: Annotated[float | None, REF_STD] = None,
) -> None:
    """Estimate every cell of every frame of a readings file.

    `lsq` and `regularized` are for 64 cells at most, which take 1.9 GB and some minutes a frame.
    """
    check_place(out, readings, ending=".npz")
    with ends_in_time(_errors.show_cursor):
        loaded = load_readings(readings)
        if ref_std is not None:
            loaded = replace(loaded, ref_log_std=ref_std)
        answers = estimate_file(loaded, method, cold=cold, watch=progress(method))
    save_arrays(out, answers)
    frames = len(answers["converged"])
    TERMINAL.print(
        f"{out}: {frames} frames, {int(answers['converged'].sum())} converged, "
        f"median {1e3 * float(np.median(answers['seconds'])):.2f} ms a frame"
    )
    for message, count in Counter(answers["message"].tolist()).most_common(8):
        if message:
            TERMINAL.print(f"  {count} of {frames}: {message}")
