# SPDX-License-Identifier: Apache-2.0
"""A recording as a source of scans: ``replay://FILE.mcap?speed=1``.

Scans come as they were recorded, with the same codes, numbers, board times and gaps. Each carries
the tare that was in force (``rest_ratio``), if one was recorded before it. ``speed``: 1 as they
came, 2 twice as fast, 0 as fast as they are taken: then nothing is lost however slow the reader is,
and `latest` gives each scan in turn. Nothing comes before somebody first asks for scans. A pause
longer than `LONGEST_PAUSE_S` is shortened.

At the recording's end iterators end, and `latest` raises `RecordingEnded`. Commands other than
start and stop, which let the replay run and pause, raise `CommandRefused`.

``host_time_s`` is the time of the replay. Marks and forces are not played:
`ohmskin.record.recording.load_recording` has them.
"""

import threading
import time
from dataclasses import replace
from typing import Final

from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    OhmskinError,
    PortError,
    RecordingEnded,
    RecordingError,
)
from ohmskin.link import protocol
from ohmskin.link.feed import ScanFeed
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport
from ohmskin.record.recording import Tare, messages

# Longest time between two scans of a replay [s]: shorter than the silence of a lost board.
LONGEST_PAUSE_S: Final = 2.0
# A replay that waits for its readers looks so often whether it was closed [s].
_LOOK_EVERY_S: Final = 0.2


class Replay:
    """Plays the recording `path`, `speed` times as fast as it came; 0: as fast as it is taken.

    It is a `Source` for a `Device`. name: as it was opened.

    :raises RecordingError: it cannot be read.
    :raises PortError: it was made with another converter than this protocol knows.
    :raises ValueError: a negative speed.
    """

    def __init__(self, path: str, speed: float = 1.0, name: str = "") -> None:
        if not 0 <= speed < float("inf"):
            raise ValueError(f"speed must be 0 or more, not {speed}")
        self.feed = ScanFeed(name or f"replay://{path}")
        self.commands = threading.RLock()
        self.report: SelfTestReport | None = None
        self.want_scans = False
        self._speed = speed
        self._messages = messages(path)
        hello = next(self._messages)
        assert isinstance(hello, Hello)
        made = (hello.adc_bits, hello.readings_per_cell)
        if made != (protocol.ADC_BITS, protocol.READINGS_PER_CELL):
            self._messages.close()
            raise PortError(
                f"{path}: {made[0]} bits and {made[1]} readings a cell cannot be replayed: "
                "'ohmskin export' reads it"
            )
        self._hello = hello
        self._stats = BoardStats()
        self._running = False
        self._last: tuple[float, float] | None = None  # when a scan was due, and was recorded [s]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._play, name=f"play {path}", daemon=True)
        self._thread.start()

    @property
    def hello(self) -> Hello:
        """What the recording says of its board, as of the scan that was played last."""
        return self._hello

    def refresh(self) -> Hello:
        """See `hello`."""
        return self._hello

    @property
    def stats(self) -> BoardStats:
        """Counts of the scans that were played, as a copy."""
        with self.feed.changed:
            return replace(self._stats, overflowed=self.feed.overflowed)

    def command(self, name: str, **values: protocol.Value) -> None:
        """Start or stop.

        :raises CommandRefused: a recording can do nothing else.
        """
        if name not in ("start", "stop"):
            reason = f"{self.feed.name} is a recording, which stays as it is"
            raise CommandRefused(name, "recorded", reason)
        with self.feed.changed:
            if self.feed.failure is not None:
                raise self.feed.failure
            self._running, self._last = name == "start", None
            self.feed.changed.notify_all()

    # --------------------------------------------------------------------------- the thread

    def _play(self) -> None:
        rest_ratio, name = None, self.feed.name
        error: OhmskinError = RecordingEnded(f"{name} has been played to where it was cut off")
        try:
            for message in self._messages:
                if isinstance(message, Scan):
                    if not self._wait_for(message):
                        return
                    self._publish(replace(message, rest_ratio=rest_ratio))
                elif isinstance(message, Hello):
                    if not self._wait_for_readers():
                        return
                    self._hello = message
                elif isinstance(message, Tare):
                    rest_ratio = message.rest_ratio
                elif message is None:
                    error = RecordingEnded(f"{name} has been played to its end")
        except RecordingError as exc:
            error = exc
        self.feed.fail(error)

    def _publish(self, scan: Scan) -> None:
        if int(scan.codes.max()) >> protocol.ADC_BITS:
            raise RecordingError(
                f"{self.feed.name}: scan {scan.number} has a code beyond the converter"
            )
        with self.feed.changed:
            self._stats.scans += 1
            self._stats.missed += scan.missed
            self.feed.publish(replace(scan, host_time_s=time.monotonic()))

    def _wait_for_readers(self) -> bool:
        """Wait until a scan may come: whether it may, or the replay was closed."""
        feed = self.feed
        with feed.changed:
            while not self._closing.is_set():
                waits = self._speed == 0 and feed.is_behind
                if self._running and feed.asked and not waits:
                    return True
                feed.changed.wait(_LOOK_EVERY_S)
        return False

    def _wait_for(self, scan: Scan) -> bool:
        """Wait until a scan is due: whether it is, or the replay was closed."""
        while self._wait_for_readers():
            now_s = time.monotonic()
            due_s = now_s
            if self._speed and self._last is not None:
                pause_s = (scan.host_time_s - self._last[1]) / self._speed
                due_s = self._last[0] + min(max(pause_s, 0.0), LONGEST_PAUSE_S)
            if now_s >= due_s:
                self._last = (due_s, scan.host_time_s)
                return True
            self._closing.wait(min(due_s - now_s, _LOOK_EVERY_S))
        return False

    def close(self) -> None:
        """End the replay. May be called again."""
        self._closing.set()
        with self.feed.changed:
            self._running = False
            self.feed.changed.notify_all()
        self._thread.join()
        self._messages.close()
        self.feed.forget_newest()
        if self.feed.failure is None or isinstance(self.feed.failure, RecordingEnded):
            self.feed.fail(DeviceLost(f"{self.feed.name} was closed"))
