# SPDX-License-Identifier: Apache-2.0
"""What gives scans, as programs see it: a board, or a recording that is played."""

import logging
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from numbers import Integral
from typing import TYPE_CHECKING, Final, Self, TypeVar
from weakref import WeakValueDictionary

import numpy as np

from ohmskin.arrays import Float
from ohmskin.ctrl_c import Condition
from ohmskin.errors import DeviceLost, OhmskinError, RecordingEnded
from ohmskin.files import Closing
from ohmskin.link import protocol
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport, missing_attribute

if TYPE_CHECKING:
    from asyncio import Future

# What a program may want in its log: restarts and boards that go are warnings, missed scans infos.
LOG = logging.getLogger("ohmskin")
LOG.addHandler(logging.NullHandler())
# A board or a force sensor that is silent for so long counts as lost [s]; a board that should scan
# has the time of two scans more. Chosen: an Arduino that was reset, as by opening its port, is in
# its boot loader for 2 to 3 s. Then a board has to be started, and a sensor's sketch zeroes the
# sensor.
SILENCE_TIMEOUT_S: Final = 5.0
# So many scans are kept for an iterator that is slower than the board. Chosen: 11 s at 90 Hz, which
# is longer than a program's pause for a file or a picture.
QUEUE_SCANS: Final = 1024
# A command is sent so often before the board counts as lost. Chosen: where a line damages one frame
# in a hundred, one command in fifty, or its answer, is lost, and three in a row are 8 in a million.
COMMAND_TRIES: Final = 3
# A mean is of this share of the time that was asked for, at least. Chosen: clocks of boards differ
# by less.
_LEAST_SHARE: Final = 0.9
_S = TypeVar("_S", bound=Scan)


@dataclass(frozen=True)
class Region:
    """A part of a skin, and how to scan it.

    rows, columns: which ones; None: all.
    mode: which readings a scan takes, a name of the enum `mode`.
    rate_hz: scans a second; 0: as fast as readings settle, and as line and processor keep up.
    settle_us: least settle time; 0: as long as the rate allows.
    whole_every: one of so many scans is a whole one, of all cells; 0: none is.
    whole_mode: which readings a whole scan takes.
    """

    rows: Collection[int] | None = None
    columns: Collection[int] | None = None
    mode: str = "quick"
    rate_hz: float = 0.0
    settle_us: int = 0
    whole_every: int = 0
    whole_mode: str = "near"

    @classmethod
    def of(cls, board: Hello) -> Self:
        """What this board scans now."""
        rows = protocol.lines_of(board.row_mask, board.rows)
        columns = protocol.lines_of(board.column_mask, board.columns)
        rate_hz, settle_us = board.rate_asked_mhz / 1000, board.settle_asked_us
        whole = board.whole_every, board.whole_mode
        return cls(rows, columns, board.mode, rate_hz, settle_us, *whole)

    def fields(self, board: Hello) -> dict[str, protocol.Value]:
        """The fields of the command `set_region`. Raises ValueError for what cannot be sent."""
        masks = {}
        for name, lines, count in (
            ("row_mask", self.rows, board.rows),
            ("column_mask", self.columns, board.columns),
        ):
            masks[name] = protocol.all_lines(count) if lines is None else 0
            kind = name.partition("_")[0]
            for line in () if lines is None else lines:
                if isinstance(line, bool) or not isinstance(line, Integral):
                    raise ValueError(f"a {kind} is told by its number, not as {line!r}")
                if not 0 <= line < count:
                    raise ValueError(f"no {kind} {line}: there are {count}")
                masks[name] |= 1 << int(line)  # NumPy's numbers have as few bits as their type
        same = ("settle_us", "mode", "whole_every", "whole_mode")
        of_same = {name: getattr(self, name) for name in same}
        return masks | of_same | {"rate_mhz": protocol.rate_mhz(self.rate_hz)}


class Device(Closing):
    """A source of scans: a board, or a recording that is played. Made by `ohmskin.open`.

    There are two ways to read, for two needs. Iterating gives every scan, in order, and counts
    those that are missing. `latest` gives the newest scan and skips the others. Both may be used at
    once, from several threads. ``with`` closes a device, and so does `close`.
    """

    # `Session` and `Replay` do commands, each in its way, and begin the one thread that publishes
    # scans. All other threads wait on `_changed`, which also guards what is shared with it.

    def __init__(self, name: str, stats: BoardStats) -> None:
        self.name = name
        """The port's name."""
        self.true_force_n: Callable[[Scan], Float] | None = None
        """Gives the force on each cell (R, C) [N] at a scan, where a simulation knows it."""
        self.put: Callable[[tuple[tuple[float, float], float] | None], None] | None = None
        """Presses a cell by a force [N], or none, where a simulated skin lets a program do so."""
        self.only_unit: int | None = None
        """The unit that is meant: another that says hello ends the device. None: any may come."""
        self.waits = False
        """Whether scans wait until they are taken: a recording that is played at speed 0."""
        self._stats = stats
        self._changed = Condition()
        self._hello: Hello | None = None
        self._report: SelfTestReport | None = None  # of the last self-test
        self._failure: OhmskinError | None = None  # why no more scans come
        self._newest: Scan | None = None  # until `latest` gives it
        # Of each iterator, by id. Weak, so that the queue of an iterator that nobody has any more
        # goes with it, and is not filled for ever.
        self._queues: WeakValueDictionary[int, deque[Scan]] = WeakValueDictionary()
        self._asked = False  # whether somebody has begun to read: a replay waits for that
        # Held while commands that belong together are done, such as stop, configure and start.
        self._commands = threading.RLock()
        self._want_scans = False
        self._late_before = 0  # what the board counted as late when scanning began
        # The fields of the last `configure`, which a board that is reset forgets.
        self._wanted: dict[str, protocol.Value] | None = None
        self._publisher: threading.Thread | None = None

    if not TYPE_CHECKING:  # a type checker would take any name for an attribute

        def __getattr__(self, name: str) -> object:
            return missing_attribute(self, name, ("calibration", "tare", "undo_tare"), "skins")

    @property
    def info(self) -> Hello:
        """What the board has last said of itself."""
        assert self._hello is not None
        return self._hello

    @property
    def stats(self) -> BoardStats:
        """Counts since the connection was made, as a copy."""
        with self._changed:
            return replace(self._stats, line=replace(self._stats.line))

    @property
    def now_s(self) -> float:
        """The time by the clock of `Scan.host_time_s` [s]: `time.monotonic()`, unless stepped."""
        return time.monotonic()

    def __repr__(self) -> str:
        board = self._hello
        if board is None:
            return f"<{type(self).__name__} {self.name}>"
        size = f"{board.rows}x{board.columns} cells at {board.rate_hz:.1f} Hz"
        return f"<{type(self).__name__} {self.name}: unit {board.unit_id}, {size}>"

    def __aiter__(self) -> AsyncIterator[Scan]:
        """The same as iterating, for ``async for``."""
        return InThreads(self.__iter__)

    def __iter__(self) -> Iterator[Scan]:
        """Every scan from now on; ``missed`` of each counts what was lost before it.

        An iterator that falls behind by more than `QUEUE_SCANS` loses the oldest scans, which are
        counted too. It ends with the recording at a ``replay://`` port.

        :raises DeviceLost: the board went away, or said nothing for `SILENCE_TIMEOUT_S`.
        """
        queue: deque[Scan] = deque()
        with self._changed:  # before the start: on a busy machine, scans may come before it returns
            self._queues[id(queue)] = queue
            self._asked = True
            self._changed.notify_all()
        self.start()
        return self._taken(queue)

    def _taken(self, queue: deque[Scan]) -> Iterator[Scan]:
        while True:
            with self._changed:
                try:
                    self._wait_for_scan(lambda: bool(queue))
                except RecordingEnded:
                    return
                scan = queue.popleft()
            yield scan

    def latest(self, timeout_s: float | None = None) -> Scan:
        """The newest scan. Each is given once: waits for the next if this one was given already.

        timeout_s: how long to wait [s], by default `SILENCE_TIMEOUT_S`, or longer for slow scans.

        :raises DeviceLost: the board went away, or no scan came in time.
        """
        self.start()
        with self._changed:
            self._asked = True
            self._changed.notify_all()
            self._wait_for_scan(lambda: self._newest is not None, timeout_s)
            scan, self._newest = self._newest, None
        assert scan is not None
        return scan

    def _wait_for_scan(self, ready: Callable[[], bool], limit_s: float | None = None) -> None:
        patience_s = SILENCE_TIMEOUT_S + 2 / self.info.rate_hz
        limit_s = patience_s if limit_s is None else limit_s
        if not self._wait(ready, limit_s):
            silent = f"{self.name} has sent no scan for {limit_s:.2g} s"
            # A silent board has been asked for its hello. After a reset, it counts from 0 again.
            if (late := self.info.late) not in (0, self._late_before):
                # Slots for a settle time that was asked are as short at any rate.
                longer = "longer settle time, or for 0" if self.info.settle_asked_us else ""
                remedy = f"ask for a {longer or 'lower rate'}"
                raise DeviceLost(f"{silent}: {late} conversions late", remedy)
            if not limit_s >= patience_s:  # so short a silence is no sign of a board that is gone
                raise DeviceLost(silent, "wait for longer: a larger timeout_s, or none")
            silent = f"{self.name} has said nothing for {limit_s:.1f} s"
            raise DeviceLost(f"{silent}: unplug and plug it")
        self._changed.notify_all()  # a replay may go on

    def mean_ratio(self, seconds: float) -> Float:
        """`mean_ratio` of the scans of the coming seconds.

        :raises DeviceLost: the board went away, or there are no more whole scans.
        :raises ValueError: seconds are below 0, infinite or no number; or a recording ends before.
        """
        if not 0 <= seconds < float("inf"):
            raise ValueError(f"no mean of {seconds:g} seconds: say 0 or more, 0 for one scan")
        scans = [*scans_for(self, seconds)]
        # From the first of n scans to the last is one period less than they take.
        times_us, count = [scan.time_us for scan in scans], len(scans)
        passed_us = np.diff(times_us).clip(0).sum() * count / max(count - 1, 1)
        if scans and passed_us < _LEAST_SHARE * 1e6 * seconds:
            raise ValueError(f"no mean of {seconds:g} seconds: {self.name} ends before")
        return mean_ratio(scans)

    def start(self) -> None:
        """Start scanning. Does nothing when the device scans already.

        :raises DeviceLost: the board went away, or does not scan as it was told.
        """
        with self._commands:
            if self._want_scans:
                return
            for _ in range(COMMAND_TRIES):
                self._restore()
                with self._changed:
                    self._newest = None  # it may be of another configuration
                self._command("start")
                # If the board was reset since `_restore`, it scans as it did when it was switched
                # on. Its hello came before the answer to "start", so `info` says that by now.
                if self._is_as_wanted():
                    break
                self._command("stop")
            else:
                problem = f"{self.name} does not keep how it was told to scan"
                raise DeviceLost(problem, "unplug and plug it again")
            self._late_before = self.info.late
            self._want_scans = True

    def stop(self) -> None:
        """Stop scanning, after a whole scan."""
        with self._commands:
            self._want_scans = False
            self._command("stop")

    def configure(
        self,
        *,
        rows: int | None = None,
        columns: int | None = None,
        rate_hz: float | None = None,
        settle_us: int | None = None,
        accuracy: str | None = None,
        mode: str | None = None,
    ) -> Hello:
        """Change how the board scans; what is not given stays. Returns what the board now keeps.

        rate_hz: scans per second; 0: as fast as readings settle. settle_us: least time from a
        multiplexer change to the sample; 0: as long as the rate allows. accuracy: a name of
        the enum `accuracy`. mode: which readings a scan takes, a name of the enum `mode`. A region
        (`set_region`) stays, unless rows or columns are given.

        :raises ValueError: a value that no board could be sent.
        :raises CommandRefused: a value out of range, or too much for the rate; nothing changes.
            A recording refuses this and all commands below.
        """
        given = {
            "rows": rows,
            "columns": columns,
            "settle_us": settle_us,
            "mode": mode,
            "rate_mhz": None if rate_hz is None else protocol.rate_mhz(rate_hz),
            "accuracy": accuracy,
        }
        changes = {name: value for name, value in given.items() if value is not None}
        for lines, mask in (("rows", "row_mask"), ("columns", "column_mask")):
            count = changes.get(lines)
            if isinstance(count, int) and count > 0:  # the region was one of other cells
                changes[mask] = protocol.all_lines(count)
        return self._configure(configuration(self.info) | changes)

    def configure_as(self, board: Hello) -> Hello:
        """Scan as a board did that said `board`. Returns and raises as `configure`."""
        return self._configure(configuration(board))

    def _configure(self, wanted: dict[str, protocol.Value]) -> Hello:
        with self._paused():
            self._command("configure", **wanted)
            self._wanted = _as_said(wanted)
            self._refresh()
            self._restore()
            return self.info

    def set_region(self, region: Region) -> Hello:
        """Scan a part of the skin, from the next scan on. Returns what the board now keeps.

        The board goes on scanning. Scans say which cells they have read (`Scan.read`). A board that
        is reset comes back to the region.

        :raises ValueError: a value that no board could be sent.
        :raises CommandRefused: the region is empty or beyond the skin, or it is too much for the
            rate; nothing changes. Firmware of before there were regions refuses all of them.
        """
        with self._commands:
            asked = region.fields(self.info)
            self._command("set_region", **asked)
            self._wanted = _as_said(configuration(self.info) | asked)
            return self._refresh()

    def set_unit_id(self, unit_id: int) -> None:
        """Name this skin; `save` makes the name last."""
        with self._commands:
            self._command("set_unit_id", unit_id=unit_id)
            if self.only_unit is not None:
                self.only_unit = unit_id
            self._refresh()

    def save(self) -> None:
        """Keep configuration and unit id in the board's EEPROM.

        :raises CommandRefused: the EEPROM is worn out.
        """
        self._command("save")

    def load_defaults(self) -> Hello:
        """Return to the built-in configuration; the EEPROM keeps what it holds until `save`."""
        with self._paused():
            self._command("load_defaults")
            self._wanted = None
            return self._refresh()

    def self_test(self) -> SelfTestReport:
        """Read both sense nodes with each drive at all multiplexer inputs, and judge them."""
        with self._paused():
            self._report = None
            self._command("self_test")
            if self._report is None:
                raise DeviceLost(f"{self.name}: the report of the self-test was lost: try again")
            return self._report

    @contextmanager
    def _paused(self) -> Iterator[None]:
        """Stop scanning for commands that a scanning board refuses, and go on however they end."""
        with self._commands:
            was_scanning = self._want_scans
            try:
                if was_scanning:
                    self.stop()
                yield
            finally:
                if was_scanning and self._failure is None:
                    self.start()

    def _is_as_wanted(self) -> bool:
        return self._wanted is None or configuration(self.info) == self._wanted

    def _restore(self) -> None:
        """Configure a board again that was reset while it did not scan, and so has forgotten it."""
        for _ in range(COMMAND_TRIES):
            if self._wanted is not None and not self._is_as_wanted():
                self._command("configure", **self._wanted)
                self._refresh()

    @abstractmethod
    def _command(self, name: str, **values: protocol.Value) -> None:
        """Do a command; it is done on return. Raises CommandRefused, DeviceLost."""

    def _refresh(self) -> Hello:
        """Ask for `hello`. It comes before the answer to the command, so `info` is new then.

        Where it is not, the line has lost the hello alone: it is asked for again.
        """
        for _ in range(COMMAND_TRIES):
            before = self._hello
            self._command("get_hello")
            if self._hello is not before:
                break
        return self.info

    def _check_unit(self, hello: Hello) -> None:
        """Raise DeviceLost if this is not `only_unit`.

        Behind an adapter that stays plugged, boards may change, and no port goes away.
        """
        if self.only_unit not in (None, hello.unit_id):
            came = f"unit {hello.unit_id} has come in place of unit {self.only_unit}"
            remedy = "open it again, with a calibration of this unit's skin"
            raise DeviceLost(f"{self.name}: {came}", remedy)

    def close(self) -> None:
        """Stop the board and give the port back. May be called again."""
        if self._publisher is not None:
            self._publisher.join()
        with self._changed:
            self._newest = None
            if self._failure is None or isinstance(self._failure, RecordingEnded):
                self._fail(DeviceLost(f"{self.name} was closed"))

    def _publish(self, scan: Scan) -> None:
        """Give a scan to all who read.

        An iterator that is too slow loses its oldest scan, which its next one counts as missed.
        """
        if scan.missed:
            LOG.info("%s: missed %d scans before scan %d", self.name, scan.missed, scan.number)
        with self._changed:
            scan = replace(scan, board=self._hello)  # it may change before the scan is taken
            self._newest = scan
            for queue in self._queues.values():
                queue.append(scan)
                if len(queue) > QUEUE_SCANS:
                    lost = 1 + queue.popleft().missed
                    queue[0] = replace(queue[0], missed=queue[0].missed + lost)
                    self._stats.overflowed += 1
            self._changed.notify_all()

    def _begin_thread(self, work: Callable[[], None], name: str) -> None:
        """Begin the thread that publishes. Its work must end soon after `close` was called."""
        self._publisher = threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
        self._publisher.start()

    def _run(self, work: Callable[[], None]) -> None:
        """Do the work of the thread that publishes. An error that ends it reaches all who wait."""
        try:
            work()
        except Exception as exc:
            defect = DeviceLost(f"{self.name}: a defect of this program, report it: {exc!r}")
            defect.__cause__ = exc
            self._fail(exc if isinstance(exc, OhmskinError) else defect)

    def _fail(self, error: OhmskinError) -> None:
        """Say why no more scans come. Whoever waits, now or later, gets this error."""
        with self._changed:
            self._failure = error
            self._changed.notify_all()

    def _wait(self, ready: Callable[[], bool], limit_s: float) -> bool:
        """Wait for `ready()`: whether it is so within `limit_s`.

        :raises OhmskinError: the device has failed meanwhile.
        """
        with self._changed:
            self._changed.wait_for(lambda: ready() or self._failure is not None, limit_s)
            if self._failure is not None and not ready():
                raise self._failure
            return ready()


_CONFIGURE: Final = protocol.FRAMES["configure"]


def _as_said(asked: dict[str, protocol.Value]) -> dict[str, protocol.Value]:
    """The fields of `configure` as a hello says them: names, where a program gave their numbers."""
    return _CONFIGURE.unpack(_CONFIGURE.pack(**asked))


def configuration(board: Hello) -> dict[str, protocol.Value]:
    """The fields of the command `configure` that make a board scan as this one does."""
    names = [field.name for field in _CONFIGURE.fields]
    return {name: getattr(board, protocol.ASKED.get(name, name)) for name in names}


class InThreads(AsyncIterator[_S]):
    """The scans of a skin for ``async for``: threads wait for them, and the event loop goes on.

    Whoever stops waiting, as by a timeout, loses nothing: the scan that comes is given next.

    begin: begins to iterate. What it gives may be None where a thread has waited for long: if
        nobody waits for it any more, it then ends, and does not hold up the end of the program.
    """

    def __init__(self, begin: Callable[[], Iterator[_S | None]]) -> None:
        self._begin = begin
        self._scans: Iterator[_S | None] | None = None
        self._taking: Future[list[_S | None]] | None = None

    async def __anext__(self) -> _S:
        from asyncio import ensure_future, shield, to_thread  # only these programs need it

        while True:
            if self._taking is None:
                self._taking = ensure_future(to_thread(self._take))
            taken = await shield(self._taking)
            if not taken:
                raise StopAsyncIteration
            self._taking = None
            if taken[0] is not None:
                return taken[0]

    def _take(self) -> list[_S | None]:
        """The next one, as a list; it is empty at the end."""
        if self._scans is None:
            self._scans = self._begin()
        return list(islice(self._scans, 1))


def scans_for(scans: Iterable[Scan], seconds: float) -> Iterator[Scan]:
    """The first of these scans, up to the one that comes `seconds` after the first: at least one.

    The board's clock counts, because it says when the skin was read. The host's clock says when a
    scan arrived: late and in bunches where the host is busy, and at any pace where a recording is
    played. A board that was reset begins its clock anew: the time of its reset is not counted.
    """
    passed_us, before_us = 0, None
    for scan in scans:
        if before_us is not None:
            passed_us += max(scan.time_us - before_us, 0)
        before_us = scan.time_us
        yield scan
        if passed_us >= 1e6 * seconds:
            return


def mean_ratio(scans: Iterable[Scan]) -> Float:
    """Mean readings (R, C, n) of whole scans, at least one: how a skin at rest is measured.

    Somebody may configure the board meanwhile, or scans of fewer readings may come in between.
    Readings of two sizes or modes have no mean. So only the scans of the same size and mode as the
    last complete scan count.

    :raises DeviceLost: there is no whole scan.
    """
    whole = [scan for scan in scans if scan.is_whole]
    if not whole:
        remedy = "'ohmskin info PORT' says which cells are scanned"
        raise DeviceLost("the port gives no more scans, or none of all cells", remedy)
    last = next((scan for scan in reversed(whole) if scan.is_complete), whole[-1])
    alike = [scan.ratio for scan in whole if scan.kind == last.kind]
    return np.asarray(np.mean(alike, axis=0))
