# SPDX-License-Identifier: Apache-2.0
"""``ohmskin record`` and ``ohmskin export``."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

import ohmskin
from ohmskin.arrays import Float
from ohmskin.errors import OhmskinError, RecordingError
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.record.export import FORMATS
from ohmskin.record.export import export as export_recording
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Mark, Tare, load_recording

_out = Console(soft_wrap=True)
_TYPED_EVERY_S = 0.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def record(
    port: Annotated[str, typer.Argument(help="serial port or URL")],
    file: Annotated[Path, typer.Argument(help="file to write (.mcap), a new one")],
    scans: Annotated[int, typer.Option(help="stop after so many; 0: never")] = 0,
    seconds: Annotated[float, typer.Option(help="stop after so long; 0: never")] = 0.0,
    tare_s: Annotated[
        float, typer.Option("--tare", help="so long nothing touches the skin, in seconds: its tare")
    ] = 0.0,
    mark: Annotated[list[str] | None, typer.Option(help="a mark at the beginning")] = None,
) -> None:
    """Record every scan at PORT. Ctrl-C ends it; a line typed meanwhile becomes a mark."""
    with ohmskin.open(port, start=False) as skin, Recorder(file, skin.info) as recorder:
        for text in mark or ():
            recorder.add(Mark(text, time.monotonic()))
        with _marks_typed(recorder):
            record_scans(skin, recorder, scans, seconds, tare_s)
    size = file.stat().st_size
    _out.print(
        f"{file}: {recorder.scans} scans, missed {recorder.missed}, {size} bytes", markup=False
    )


def record_scans(
    skin: Device,
    recorder: Recorder,
    count: int,
    seconds: float,
    tare_s: float,
    beside: Callable[[Scan], None] = lambda scan: None,
) -> None:
    """Record every scan until Ctrl-C or SIGTERM, so many scans, or so many seconds (0: never).

    tare_s: of so many seconds at first a tare is recorded. beside: is called after each scan.
    """
    with stop_signals() as (may_interrupt, is_stopped):
        _record(skin, recorder, count, seconds, tare_s, beside, may_interrupt, is_stopped)


def _record(
    skin: Device,
    recorder: Recorder,
    count: int,
    seconds: float,
    tare_s: float,
    beside: Callable[[Scan], None],
    may_interrupt: Callable[[bool], None],
    is_stopped: Callable[[], bool],
) -> None:
    board, first_s = skin.info, float("nan")
    untouched: list[Float] = []
    may_interrupt(True)
    try:
        for scan in skin:
            may_interrupt(False)
            if not recorder.scans:
                first_s = scan.host_time_s
            elapsed_s = scan.host_time_s - first_s
            if skin.info is not board:
                board = skin.info
                recorder.add(board)
            recorder.add(scan)
            if tare_s and elapsed_s <= tare_s:
                untouched.append(scan.ratio)
            elif untouched:
                recorder.add(_tare(untouched))
            beside(scan)
            if is_stopped() or recorder.scans == count or (seconds and elapsed_s >= seconds):
                return
            may_interrupt(True)
    finally:
        may_interrupt(False)
        if untouched:
            recorder.add(_tare(untouched))


def _tare(untouched: list[Float]) -> Tare:
    newest = untouched[-1].shape  # somebody may have configured the board meanwhile
    tare = Tare(
        np.mean([ratio for ratio in untouched if ratio.shape == newest], axis=0), time.monotonic()
    )
    untouched.clear()
    return tare


@contextmanager
def stop_signals() -> Iterator[tuple[Callable[[bool], None], Callable[[], bool]]]:
    """Ctrl-C and SIGTERM end the ``with`` between two scans, never amid a write.

    Gives two functions: one says whether they may interrupt from now on, as while a scan is waited
    for; the other whether one has come.
    """
    stopped = interruptible = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        if interruptible:
            raise KeyboardInterrupt

    def may_interrupt(may: bool) -> None:
        nonlocal interruptible
        interruptible = may
        if may and stopped:
            raise KeyboardInterrupt

    before = [signal.signal(number, handle) for number in _SIGNALS]
    try:
        with suppress(KeyboardInterrupt):
            yield may_interrupt, lambda: stopped
    finally:
        interruptible = False
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


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
