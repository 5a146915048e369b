# SPDX-License-Identifier: Apache-2.0
"""A live skin: a thread reads it, opens it again when it was unplugged, and programs ask at will.

A program may have a pace of its own, such as a robot's control loop of 30 Hz beside 90 scans a
second. If it iterates over a `CalibratedSkin`, it falls behind; if it asks `latest`, it may have to
wait for the next scan. Here it asks for the newest scan, which it gets at once, or for all scans
since it last asked.
"""

import os
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from ohmskin import opening
from ohmskin.ctrl_c import Condition
from ohmskin.errors import DeviceLost, OhmskinError, RecordingEnded
from ohmskin.files import Closing, PathName
from ohmskin.force.calibration import CalibrationLike, loaded
from ohmskin.force.reader import TARE_S, ForceScan, SkinReader
from ohmskin.link.device import LOG, QUEUE_SCANS, SILENCE_TIMEOUT_S, Device, InThreads
from ohmskin.link.messages import Hello, Scan

if TYPE_CHECKING:
    from ohmskin.record.recording import Tare

# A port that is not there is tried again after this time [s]. Chosen: somebody who plugs a board in
# does not wait for long, and to try so often is no effort for a computer.
AGAIN_S: Final = 1.0
# A scan that has waited for longer [s] is passed over. Chosen: where estimates take longer than
# scans, the results are still nearly new; and a short pause of a busy machine costs no scan.
LATE_S: Final = 0.25
# `close` waits at most so long for the thread [s]. Chosen: the thread ends in a tenth of this time,
# unless its port never answers, and such a port must not hold up the end of the program.
_CLOSE_S: Final = 1.0
# Boards that agree in all of these read the same skin in the same way: method, rest and tare stay
# good.
_skin_of: Final = attrgetter(
    "unit_id", "rows", "columns", "reads_far", "ref_top_ohm", "ref_bottom_ohm", "adc_bits"
)


class LiveSkin(Closing):
    """A skin that is read all the time. All methods may be called from any thread.

    A board that is not there, or goes away, is opened again and again. The latest tare stays, and
    so do the wires that were learned. (After a tare, a method learns them anew.)

    Only the newest `QUEUE_SCANS` scans are kept. A recording that is played at speed 0 does not
    wait for the program here: who needs all of a longer one iterates over `ohmskin.open`.

    port, calibration, force: as `ohmskin.open` takes them.
    every: whether every scan is estimated. False: only the newest, whenever the estimate before it
        is done. A program that only shows the skin then shows it as soon as it can be, on a busy
        machine, too.

    >>> with LiveSkin("/dev/ttyACM0", "skin.json") as skin:
    ...     count, scans = skin.since(0, timeout_s=5.0)  # all scans until now
    ...     count, scans = skin.since(count)  # the scans that have come since
    ...     newest = skin.newest()  # None: no scan has come yet

    :raises ValueError: the calibration cannot be read.
    :raises TypeError: the port is no text or path.
    """

    def __init__(
        self,
        port: PathName,
        calibration: CalibrationLike | None,
        *,
        force: bool = False,
        every: bool = True,
    ) -> None:
        self.port = os.fsdecode(port)
        self.failure: Exception | None = None
        """Why there are no scans now; None while they come, and before the port was first tried."""
        self.skipped = 0
        """How many scans were passed over, because this machine is too slow for all of them.
        `Scan.missed` does not count them: it is of the line."""
        self.opened = 0
        """How often the port was opened."""
        self.ended = False
        """Whether the thread has ended: with its recording, by `close`, or by a defect of ours."""
        self.watchers: set[Callable[[], None]] = set()
        """They are called when there is news, from the thread that reads: they must not wait. One
        that raises an error is not called again, and the log has the error."""
        self.closing = threading.Event()
        """Is set when `close` is called."""
        self._calibration = None if calibration is None else loaded(calibration)
        self._force, self._every = force, every
        self._device: Device | None = None
        self._reader: SkinReader | None = None
        self._kept: deque[ForceScan] = deque(maxlen=QUEUE_SCANS)
        self._count = 0
        self._sent = 0  # scans so far with those that were missed before them
        self._changed = Condition()
        # A port that never answers does not hold up the end of the program.
        self._thread = threading.Thread(target=self._work, name=f"live {self.port}", daemon=True)
        self._thread.start()

    def __repr__(self) -> str:
        said = self.status.removeprefix(f"{self.port} ")
        return f"<{type(self).__name__} {self.port}: {said}>"

    @property
    def status(self) -> str:
        """That scans come, or why there are none, in words."""
        said = "gives scans" if self._count and self._device else "is being opened"
        if self.skipped and self._device and not self._count:
            said = "gives scans, all of them too late: end other programs, or ask for a lower rate"
        if self.closing.is_set():
            said = "was closed"
        return str(self.failure or f"{self.port} {said}")

    def newest(self) -> ForceScan | None:
        """The newest scan, at once; None if there is none yet.

        It stays when the board goes away: `failure` says so, and `ForceScan.time_ns` how old it is.
        """
        with self._changed:
            return self._kept[-1] if self._kept else None

    def since(self, count: int, timeout_s: float = 0.0) -> tuple[int, list[ForceScan]]:
        """The count to ask with next, and every scan after the first `count` scans, each once.

        Scans that were passed over (`skipped`) are not among them: their numbers are missing.

        timeout_s: how long to wait [s] if there is no such scan yet.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._count > count or self._is_over, timeout_s)
            begin = max(len(self._kept) - max(self._count - count, 0), 0)
            return self._count, list(islice(self._kept, begin, None))

    def __iter__(self) -> Iterator[ForceScan]:
        """Every scan from now on, until `close`, as `since`; also after the board was away.

        An iterator that falls behind by more than `QUEUE_SCANS` loses the oldest scans, which its
        next one counts as missed.
        """
        return (scan for scan in self._from_now() if scan is not None)

    def _from_now(self) -> Iterator[ForceScan | None]:
        """The same, and None when no scan has come for `SILENCE_TIMEOUT_S`."""
        with self._changed:
            return self._after(self._count, self._sent)

    def _after(self, count: int, sent: int) -> Iterator[ForceScan | None]:
        is_over = False
        while not is_over:
            is_over = self._is_over  # asked first: what came before the end is given, too
            with self._changed:
                count, scans = self.since(count, SILENCE_TIMEOUT_S)
                sent, before = self._sent, sent
            if lost := sent - before - sum(1 + scan.missed for scan in scans):
                scans[0] = replace(scans[0], missed=scans[0].missed + lost)
            yield from scans or (None,)

    def __aiter__(self) -> AsyncIterator[ForceScan]:
        """The same for ``async for``."""
        return InThreads(self._from_now)

    def there(self) -> tuple[Device, SkinReader]:
        """The open board, and the reader of its skin, which knows the tares.

        :raises DeviceLost: the board is not open.
        """
        device, reader, failure = self._device, self._reader, self.failure
        if device is None or reader is None:
            text = "is being opened" if failure is None else f"is not there: {failure}"
            text = "was closed" if self.closing.is_set() else text
            raise DeviceLost(f"{self.port} {text}")
        return device, reader

    def tare(self, seconds: float = TARE_S, *, force: bool = False) -> "Tare":
        """As `CalibratedSkin.tare`. Raises what that raises, and what `there` raises."""
        device, reader = self.there()
        return reader.tare_by(device, seconds, force=force)

    @property
    def _is_over(self) -> bool:
        """Whether nobody needs to wait for more scans."""
        return self.ended or self.closing.is_set()

    def _work(self) -> None:
        """The thread's work: read the port, and open it again whenever it goes away.

        A recording that has been played is at its end, and is not played again. A defect of ours
        ends the thread, too.
        """
        try:
            while not self.closing.is_set():
                try:
                    self._read()
                except RecordingEnded as exc:
                    self.failure = exc
                    return
                except (OhmskinError, ValueError, OSError) as exc:
                    if self.failure is None and not self.closing.is_set():
                        LOG.warning("%s", exc)
                    self._say(exc)
                self.closing.wait(AGAIN_S)
        except Exception as exc:
            self.failure = OhmskinError(f"a defect of this program: {exc!r}")
            raise
        finally:
            self.ended = True
            self._tell()

    def _say(self, failure: Exception | None) -> None:
        self.failure = failure
        self._tell()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()
        for watcher in tuple(self.watchers):
            try:
                watcher()
            except Exception:  # of a program: the skin and the other watchers go on
                LOG.exception("%s: a watcher failed, and is not called any more", self.port)
                self.watchers.discard(watcher)

    def _read(self) -> None:
        """Open the port, and take its scans until `close`. Raises what its device raises."""
        try:
            with opening.open(self.port, start=False) as device:
                reader, board = self._reader, device.info
                if reader is None or _skin_of(reader.board) != _skin_of(board):
                    self._reader = reader = self._new_reader(board)
                    reader.warm_up()
                # Another unit at this port ends the device, and is then opened by this method.
                device.only_unit = board.unit_id
                self._device = device
                self.opened += 1
                for scan in device if self._every else iter(device.latest, None):
                    if self.closing.is_set():
                        return
                    self._take(scan, device, reader)
                    self._say(None)
            raise RecordingEnded(f"{self.port} has been played to its end")
        finally:
            self._device = None
            self._gone()

    def _new_reader(self, board: Hello) -> SkinReader:
        return SkinReader(board, self._calibration, force=self._force)

    def _take(self, scan: Scan, device: Device, reader: SkinReader) -> None:
        waited_s = device.now_s - scan.host_time_s
        if self._every and not device.waits and waited_s > LATE_S:
            self.skipped += 1
            return
        read = reader.read(scan)
        with self._changed:
            self._kept.append(read)
            self._count += 1
            self._sent += 1 + read.missed

    def _gone(self) -> None:
        """Is called when the board is not open any more."""

    def close(self) -> None:
        """End reading. May be called again."""
        if not self.closing.is_set():
            self.closing.set()
            self._tell()  # at once: the thread may never end
        if (device := self._device) is not None:
            device.close()
        if threading.current_thread() is not self._thread:  # a watcher closes the skin
            self._thread.join(_CLOSE_S)
