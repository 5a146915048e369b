# SPDX-License-Identifier: Apache-2.0
"""``ohmskin record`` and ``ohmskin export``."""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Annotated, Final, TypeVar

import numpy as np
import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

import ohmskin
from ohmskin.calibrate.guide import OnSkin, pressed_cells
from ohmskin.errors import DeviceLost, OhmskinError, RecordingError
from ohmskin.force.reader import SkinReader
from ohmskin.link.messages import Scan
from ohmskin.record import recorder as recording
from ohmskin.record.force_sensor import DEFAULT_BAUD, ForceSensor
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import FORMATS, Mark, load_recording
from ohmskin.record.recording import export as export_recording

# With a force sensor the first scans are a tare of so many seconds, unless told.
FORCE_TARE_S: Final = 2.0
# A display looks at ten scans a second [s].
_SEE_EVERY_S: Final = 0.1
# How long the end of a recording may wait for the thread that reads typed lines [s].
_TYPED_EVERY_S: Final = 0.2
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

_out = Console(soft_wrap=True)
_T = TypeVar("_T")


def record(
    port: Annotated[str, typer.Argument(help="serial port or URL")],
    file: Annotated[Path, typer.Argument(help="file to write (.mcap), a new one")],
    scans: Annotated[int, typer.Option(help="stop after so many; 0: never")] = 0,
    seconds: Annotated[float, typer.Option(help="stop after so long; 0: never")] = 0.0,
    tare_s: Annotated[
        float | None,
        typer.Option(
            "--tare",
            help="so long nothing touches the skin at first, in seconds: its tare "
            "[default: 0; with a force sensor 2]",
        ),
    ] = None,
    mark: Annotated[list[str] | None, typer.Option(help="a mark at the beginning")] = None,
    force_port: Annotated[
        str, typer.Option(help="also record a force sensor at this serial port: a number a line")
    ] = "",
    force_baud: Annotated[int, typer.Option(help="speed of that port")] = DEFAULT_BAUD,
    force_scale: Annotated[
        float, typer.Option(help="newtons for one unit of its numbers; of grams: 0.00980665")
    ] = 1.0,
) -> None:
    """Record every scan at PORT. Ctrl-C ends it; a line typed meanwhile becomes a mark.

    With a force sensor: press cell after cell, and 'ohmskin calibrate recording' learns from that.
    """
    if tare_s is None:
        tare_s = FORCE_TARE_S if force_port else 0.0
    with ExitStack() as stack:
        skin, sensor = stack.enter_context(ohmskin.open(port, start=False)), None
        if force_port:
            sensor = stack.enter_context(ForceSensor(force_port, force_baud, force_scale))
            sensor.wait()
        recorder = stack.enter_context(Recorder(file, skin.info))
        for text in mark or ():
            recorder.add(Mark(text, time.monotonic()))
        see = None
        if sensor is not None:
            _out.print(f"touch nothing for {tare_s:g} s, then press single cells; Ctrl-C ends it")
            if _out.is_terminal:
                display = PressDisplay(recorder)
                live = Live(get_renderable=display.picture, console=_out, transient=True)
                stack.enter_context(live)
                see = display.see
        stack.enter_context(_marks_typed(recorder))
        watched = stack.enter_context(until_stopped())
        try:
            recording.record(
                *(skin, recorder, watched(skin)),
                count=scans,
                seconds=seconds,
                tare_s=tare_s,
                sensor=sensor,
                beside=see,
            )
        except DeviceLost as exc:
            raise DeviceLost(f"{exc} (what came before is in {file})") from exc
    done = f"{recorder.scans} scans, missed {recorder.missed}, {file.stat().st_size} bytes"
    if sensor is not None:
        done += f", {recorder.forces} forces"
        done += f", {sensor.damaged} lines that are no numbers" if sensor.damaged else ""
    _out.print(f"{file}: {done}", markup=False)


@contextmanager
def until_stopped() -> Iterator[Callable[[Iterable[_T]], Iterator[_T]]]:
    """Ctrl-C and SIGTERM end what is inside between two scans, never amid a write.

    Gives a function that passes scans on until such a signal has come. The signal interrupts the
    wait for the next scan, and nothing else.
    """
    is_stopped = waits = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_stopped
        is_stopped = True
        if waits:
            raise KeyboardInterrupt

    def watched(scans: Iterable[_T]) -> Iterator[_T]:
        nonlocal waits
        source = iter(scans)
        while True:
            try:
                waits = True
                if is_stopped:
                    return
                scan = next(source)
            except (KeyboardInterrupt, StopIteration):
                return
            finally:
                waits = False
            yield scan

    before = [signal.signal(number, handle) for number in _SIGNALS]
    try:
        with suppress(KeyboardInterrupt):
            yield watched
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


class PressDisplay:
    """What a person sees who presses cells while they are recorded, and so which are missing.

    counts: presses of each cell (R, C), of one cell alone, for `CERTAIN_S`.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.counts = np.zeros((recorder.board.rows, recorder.board.columns), dtype=np.intp)
        self._recorder = recorder
        self._reader: SkinReader | None = None
        self._on = OnSkin()
        self._seen_s = float("-inf")

    def see(self, scan: Scan) -> None:
        """Look at a scan that was recorded; at some of them, for estimates take time."""
        tare = self._recorder.tare
        if tare is None or scan.host_time_s - self._seen_s < _SEE_EVERY_S:
            return
        self._seen_s = scan.host_time_s
        if self._reader is None:
            self._reader = SkinReader(self._recorder.board, rest_ratio=tare.rest_ratio)
        if scan.codes.shape == tare.rest_ratio.shape:
            found = self._reader.estimate(scan.ratio)
            pressed = pressed_cells(self._reader.rise(found), found.touched)
            if self._on.see(scan.host_time_s, pressed) and len(self._on.cells) == 1:
                self.counts[self._on.cells[0]] += 1

    def picture(self) -> Group:
        """All of it, for a terminal."""
        force, on = self._recorder.force, self._on.cells
        now = "touch nothing yet"
        if self._reader is not None:
            now = f"pressed: {', '.join(map(str, on)) or 'none'}"
        force_n = float("nan") if force is None else force.force_n
        head = f"{self._recorder.scans} scans   force {force_n:.2f} N   {now}"
        styled = [
            [
                Text(str(count), "reverse" * ((row, column) in on))
                for column, count in enumerate(counts)
            ]
            for row, counts in enumerate(self.counts)
        ]
        return Group(Text(head), cell_table(styled, "presses of each cell"))


def cell_table(cells: Sequence[Sequence[str | Text]], title: str) -> Table:
    """A text for each cell, row by row, beside the numbers of rows and columns."""
    table = Table(box=None, title=title)
    for heading in ("", *map(str, range(len(cells[0])))):
        table.add_column(heading, justify="right")
    for row, texts in enumerate(cells):
        table.add_row(str(row), *texts)
    return table


@contextmanager
def _marks_typed(recorder: Recorder) -> Iterator[None]:
    """Lines typed at a terminal become marks; a file or pipe at stdin is left alone."""
    if os.name != "posix" or sys.stdin is None or not sys.stdin.isatty():
        yield  # elsewhere a wait for a line cannot be ended
        return
    done = threading.Event()

    def work() -> None:
        number, text = sys.stdin.fileno(), b""
        with suppress(OhmskinError, OSError):  # the file is full: the scans' loop says so
            while not done.is_set():
                if not select.select([number], [], [], _TYPED_EVERY_S)[0]:
                    continue
                typed = os.read(number, 4096)
                if not typed:
                    return
                *lines, text = (text + typed).split(b"\n")
                for line in lines:
                    recorder.add(Mark(line.decode(errors="replace").strip(), time.monotonic()))

    thread = threading.Thread(target=work, name="marks")
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def export(
    recording: Annotated[Path, typer.Argument(help="recording (.mcap)")],
    out: Annotated[Path, typer.Argument(help=f"file to write: {' or '.join(FORMATS)}")],
    begin_s: Annotated[
        float, typer.Option("--begin", help="from so long after the first scan, in seconds")
    ] = 0.0,
    end_s: Annotated[
        float, typer.Option("--end", help="until then, in seconds; 0: to the last")
    ] = 0.0,
) -> None:
    """Write a recording's scans as readings (.npz, for 'ohmskin estimate') or as a table (.csv)."""
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: no format '{out.suffix}': there are {', '.join(FORMATS)}")
    given = load_recording(recording)
    try:
        scans = export_recording(given, out, begin_s, end_s)
    except RecordingError as exc:
        raise RecordingError(f"{recording}: {exc}") from exc
    _out.print(f"{out}: {scans} scans", markup=False)
    if given.cut_off:
        print(f"{recording} was cut off: its last second may be missing", file=sys.stderr)  # noqa: T201
