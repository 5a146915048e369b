# SPDX-License-Identifier: Apache-2.0
"""The boards of the page: what a `LiveSkin` reads is shown, recorded and commanded."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from importlib import import_module
from itertools import count, takewhile
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

from ohmskin.arrays import Bool, Float, numbers
from ohmskin.circuit.configurations import as_near
from ohmskin.emulate.urls import is_stepped
from ohmskin.errors import OhmskinError
from ohmskin.estimate.base import ASSUMED, ASSUMED_WIRES
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import METHODS, kind_of, make_estimator
from ohmskin.files import Closing
from ohmskin.force.calibration import Calibration
from ohmskin.force.reader import TARE_S, SkinReader
from ohmskin.link.device import Device
from ohmskin.link.messages import Hello, Scan
from ohmskin.live import LiveSkin
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import Mark, Tare
from ohmskin.view.kneaded import KneadedBoard
from ohmskin.view.shown import Shown, of_board

# The methods that the page offers: all but those of the paper, which take minutes for an 8x8 frame.
LIVE_METHODS: Final = tuple(name for name in METHODS if name not in ("lsq", "regularized"))
# Modules that boards, estimates and contacts need later: see `load_all`.
_NEEDED_LATER: Final = (
    *("ohmskin.record.replay", "scipy.ndimage", "scipy.optimize", "scipy.sparse.csgraph"),
)
# A page has at most so many boards. Chosen: each has a thread that may use a good part of a core.
MOST_BOARDS: Final = 16
# A text that is typed at the page, a port or a mark, has at most so many characters. Chosen: far
# longer than anybody types, and short enough for a line of an error.
LONGEST_TEXT_CHARS: Final = 1000
# `ViewedBoard.close` waits at most so long for the end of the focus [s]. Chosen: a board answers in
# a tenth of this time.
_FOCUS_ENDS_S: Final = 0.5
# Numbers of a `Contact` that the page shows.
_numbers_of: Final = attrgetter("identity", "row", "column", "force_n", "force_n_std")


class _Recording(Closing):
    """Records `skin` in a thread of its own, until it is closed or the board is gone.

    ended: is called when the file is whole, from the thread of the recording.
    text: how the recording went; empty while it goes on.
    """

    def __init__(self, skin: Device, recorder: Recorder, ended: Callable[[], None]) -> None:
        self.text = ""
        self.recorder = recorder
        self._until_s = float("inf")
        self._thread = threading.Thread(target=self._work, args=(skin, ended))
        self._thread.start()

    def _work(self, skin: Device, ended: Callable[[], None]) -> None:
        trouble = ""
        try:
            with self.recorder as recorder:
                # Scans that came before `close` was called are kept, even if they still wait.
                in_time = takewhile(lambda scan: scan.host_time_s <= self._until_s, skin)
                record(skin, recorder, in_time)
        except OhmskinError as exc:
            trouble = f"; {exc}"
        counts = f"{recorder.scans} scans, missed {recorder.missed}"
        self.text = f"{recorder.path}: {counts}{trouble}"
        ended()

    def close(self) -> None:
        """End with the scans that have come until now. Returns when the file is whole."""
        self._until_s = min(self._until_s, time.monotonic())
        self._thread.join()


class ViewedBoard(LiveSkin):
    """The board at `port`, whether it is there or not, as the page shows and commands it.

    The page calls the methods from its own threads; all but `state` may wait for the board. A
    method that is a command returns a text that says what was done, and raises an error that says
    why it was not.

    port: a serial port or a URL.
    calibrations: the first that fits the board gives its forces.
    folder: where recordings are written.
    force: a calibration of another unit fits, too.
    """

    def __init__(
        self, port: str, calibrations: Sequence[Calibration], folder: Path, *, force: bool = False
    ) -> None:
        self.shown: Shown | None = None
        """The newest scan as it is shown; None if no page showed this board when it came."""
        self._calibrations, self._folder = calibrations, folder
        self._note = ""  # why there are no forces, although calibrations were given
        self._recording: _Recording | None = None
        # Held by each command that reads or changes the rest or the recording: a recording begins
        # with the tare that is in force, and gets each later tare.
        self._commands = threading.Lock()
        super().__init__(port, None, force=force, every=False)

    def state(self) -> dict[str, Any]:
        """What the page shows besides the scans, as values for JSON."""
        reader, recording, running = self._reader, self._recording, self._running()
        board = None if reader is None else reader.board
        rest = None if reader is None else reader.rest
        status = "scanning" if self.opened else "opening"
        if self.ended or self.failure is not None:
            status = "ended" if self.ended else "gone"
        return {
            "port": self.port,
            "status": status,
            "text": " ".join(str(self.failure or "").split()),
            "note": self._note,
            "board": board and of_board(board),
            "methods": [] if reader is None else _methods(reader),
            "method": "" if reader is None else reader.method,
            "force_method": None if reader is None else reader.force_method,
            "rest_date": rest and rest.date,
            "tared": reader is not None and reader.is_tared,
            "focus": reader is not None and reader.focus is not None,
            "recording": "" if running is None else str(running.recorder.path),
            "recorded": "" if recording is None else recording.text,
        }

    def use(self, method: str) -> str:
        """Estimate by another method."""
        _, reader = self.there()
        if method not in (*LIVE_METHODS, reader.force_method):
            raise ValueError(f"no method '{method[:40]}': there are {', '.join(_methods(reader))}")
        reader.use(method)
        self._tell()
        return f"method {method}"

    def take_rest(self, *, force: bool = False) -> str:
        """Take the mean of the coming second for the skin's rest.

        :raises TareRefused: something touches the skin.
        """
        with self._one_at_a_time():
            _, reader = self.there()
            self._add(self.tare(TARE_S, force=force))
        lasts = "; 'ohmskin tare' makes one that lasts" if reader.force_method else ""
        return f"tared, until this program ends{lasts}"

    def undo_tare(self) -> str:
        """Return to the rest before the last tare."""
        with self._one_at_a_time():
            if (rest := self.there()[1].undo_tare()) is not None:
                self._add(rest)
        return "the tare is undone: rest is as it was before"

    def follow(self, on: bool) -> str:
        """Read contacts often and the rest now and then, or all of the skin again."""
        with self._one_at_a_time():
            device, reader = self.there()
            self._end_focus()
            if on:
                reader.focus = reader.focus_on(device)
        return "contacts are read often" if on else "the whole skin is read in every scan"

    def _end_focus(self) -> None:
        if (reader := self._reader) is not None and (focus := reader.focus) is not None:
            reader.focus = None
            focus.close()

    def record(self) -> str:
        """Record every scan to a new file."""
        with self._one_at_a_time():
            skin, reader = self.there()
            if (running := self._running()) is not None:
                raise OhmskinError(f"{running.recorder.path} is being recorded already")
            recorder = Recorder(self._new_file(reader.board.unit_id), skin.info)
            # With the rest that is in force now, so that a replay begins with the same rest.
            if reader.is_tared and reader.rest is not None:
                recorder.add(Tare.of(reader.rest.ratio, reader.board, time.monotonic()))
            self._recording = _Recording(skin, recorder, self._tell)
        return "recording: every scan, whatever is shown"

    def stop_recording(self) -> str:
        """End the recording; its file is whole then."""
        recording = self._running()
        if recording is None:
            raise OhmskinError("nothing is being recorded")
        recording.close()
        return "the recording is whole"

    def mark(self, text: str) -> str:
        """Set a mark in the recording."""
        text = text.strip()
        if not 0 < len(text) <= LONGEST_TEXT_CHARS:
            raise OhmskinError(f"a mark is a text of 1 to {LONGEST_TEXT_CHARS} characters")
        if not self._add(Mark(text, time.monotonic())):
            raise OhmskinError("a mark goes into a recording: start one first")
        return f"marked: {text}"

    @contextmanager
    def _one_at_a_time(self) -> Iterator[None]:
        """Let the body run, unless another command is running: then raise, and do not wait."""
        if not self._commands.acquire(blocking=False):
            raise OhmskinError("one thing at a time: the last one is not done yet")
        try:
            yield
        finally:
            self._commands.release()
            self._tell()

    def _running(self) -> _Recording | None:
        """The recording that is going on; None: the last one has ended, or none was begun."""
        recording = self._recording
        return None if recording is None or recording.text else recording

    def _add(self, kept: Tare | Mark) -> bool:
        """Add a message to the recording that is going on. Returns whether there is one."""
        if (recording := self._running()) is not None:
            recording.recorder.add(kept)
        return recording is not None

    def _new_file(self, unit_id: int) -> Path:
        """A new file, named by date, time and unit; a second one of the same second gets "-2"."""
        name = f"ohmskin-{datetime.now():%Y%m%d-%H%M%S}-unit{unit_id}"
        paths = (self._folder / f"{name}{f'-{n}' if n > 1 else ''}.mcap" for n in count(1))
        return next(path for path in paths if not path.exists())

    def _new_reader(self, board: Hello) -> SkinReader:
        """A reader with the first calibration that fits the board.

        If none fits, there are no forces, and the page says why the last calibration does not.
        """
        self._raw = make_estimator("ohm", SkinKnowledge.of(replace(board, mode="near")))
        self._note = note = ""
        for calibration in self._calibrations:
            try:
                reader = SkinReader(board, calibration, force=self._force)
            except ValueError as exc:
                note = f"no forces: {exc}"
                continue
            if reader.method in _methods(reader):
                return reader
            note = (
                f"no forces: '{reader.method}' takes whole scans, the board scans in mode "
                f"{board.mode}: 'ohmskin configure PORT --mode near --save'"
            )
        self._note = note
        return SkinReader(board)

    def _take(self, scan: Scan, device: Device, reader: SkinReader) -> None:
        if not self.watchers and reader.focus is None:
            # An estimate takes a good part of a core: none is made while nobody looks.
            self.shown = None
            return
        # The scan is read first: the method of the reader may be another one after that.
        read, running = reader.read(scan), self._running()
        estimate = read.estimate
        content = {
            "method": reader.method,
            "missed": device.stats.missed,
            "rate_hz": device.info.rate_hz,
            "recorded": 0 if running is None else running.recorder.scans,
            "chi2": numbers(estimate.chi2),
            "estimate_s": estimate.seconds,
            "text": estimate.message,
            "wires": ASSUMED_WIRES if estimate.wires == ASSUMED else "",
            "contacts": numbers([_numbers_of(contact) for contact in read.contacts]),
        }
        # It has ghosts, and the page shows it beside the scan's own estimate.
        raw = self._raw.estimate(as_near(scan.ratio, scan.reading_names))
        planes: dict[str, Float | Bool] = {
            "raw": raw.cell_siemens,
            "raw_touched": raw.touched,
            "siemens": estimate.cell_siemens,
            "siemens_std": estimate.cell_siemens_std,
            "touched": estimate.touched,
        }
        if reader.has_forces:
            planes |= {"force": read.force_n, "force_std": read.force_n_std}
        self.shown = Shown.of(read, content, planes)

    def _gone(self) -> None:
        self._end_focus()
        if (recording := self._recording) is not None:
            recording.close()

    def close(self) -> None:
        """End reading. A recording is whole after that. May be called again."""
        # A board that has fallen silent lets this thread wait until its port is closed.
        ends = threading.Thread(target=self._end_focus, daemon=True)
        ends.start()
        ends.join(_FOCUS_ENDS_S)
        super().close()
        self._gone()


def load_all() -> None:
    """Import what would otherwise be imported when it is first needed, which may fail then.

    To import a module, Python opens its file, and a program with many connections may have no file
    descriptor left.
    """
    for method in LIVE_METHODS:
        kind_of(method)
    for name in _NEEDED_LATER:
        import_module(name)


def _methods(reader: SkinReader) -> tuple[str, ...]:
    """The methods that the page offers: those that take what the board reads.

    The method of the calibration is one of them, because no other gives newtons.
    """
    board, live = reader.board, dict.fromkeys([*LIVE_METHODS, *filter(None, [reader.force_method])])
    kinds = {name: kind_of(name) for name in live}
    if board.reads_far:
        return tuple(name for name, kind in kinds.items() if kind.takes_far)
    return tuple(name for name, kind in kinds.items() if kind.takes_partial or board.mode == "near")


class ViewedBoards(Closing, dict[int, ViewedBoard | KneadedBoard]):
    """The boards of one page, by number, from 0. `ViewedBoard` says what the arguments are."""

    def __init__(
        self,
        ports: Sequence[str] = (),
        calibrations: Sequence[Calibration] = (),
        folder: Path = Path(),
        *,
        force: bool = False,
    ) -> None:
        self._calibrations, self._folder, self._force = calibrations, folder.resolve(), force
        self._numbers = count()
        for port in ports:
            self.add(port)

    def add(self, port: str) -> int:
        """The number of the board at `port`, which is opened if it is new.

        :raises ValueError: there are `MOST_BOARDS` already, or time stands still at this port.
        """
        for number, board in tuple(self.items()):  # another thread may close one
            if board.port == port:
                return number
        if is_stepped(port):
            # Its scans have times of their own clock, by which a recording would never end.
            raise ValueError("a page has real time: leave out speed=0")
        if len(self) >= MOST_BOARDS:
            raise ValueError(f"there are {MOST_BOARDS} boards: close one first")
        number = next(self._numbers)
        self[number] = ViewedBoard(port, self._calibrations, self._folder, force=self._force)
        return number

    def remove(self, number: int) -> None:
        """Close a board; nothing happens if there is none of that number."""
        if (board := self.pop(number, None)) is not None:
            board.close()

    def close(self) -> None:
        """Close all. May be called again."""
        with ThreadPoolExecutor(MOST_BOARDS) as pool:  # at once: some boards take time to close
            list(pool.map(self.remove, tuple(self)))
