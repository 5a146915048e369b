# SPDX-License-Identifier: Apache-2.0
"""A recording as a source of scans: ``replay://FILE.mcap?speed=1``.

Scans come as they were recorded, with the same codes, numbers, board times and gaps. Each carries
the tare that was in force (``rest_ratio``): the last before it that is good for it (`tare_of`).
With speed 1 they come at the pace at which they were recorded, with 2 twice as fast. With speed 0
they come as fast as they are taken: then nothing is lost however slow the reader is, and `latest`
gives each in turn. Nothing is played before somebody first asks for scans. A pause longer than
`LONGEST_PAUSE_S` is shortened to it.

At the recording's end iterators end, and `latest` raises `RecordingEnded`. The commands start and
stop let the replay run and pause; all others raise `CommandRefused`.

``host_time_s`` is the time of the replay, ``time_ns`` that of the recording. Marks and forces are
not played: `ohmskin.record.recording.load_recording` has them.
"""

import time
from dataclasses import replace
from typing import Final

from ohmskin.errors import CommandRefused, RecordingEnded
from ohmskin.link import protocol
from ohmskin.link.device import QUEUE_SCANS, Device
from ohmskin.link.messages import BoardStats, Hello, Scan
from ohmskin.link.serial_port import READ_TIMEOUT_S
from ohmskin.record.recording import Tare, messages, tare_of

# Longest time between two scans of a replay. Chosen: shorter than `SILENCE_TIMEOUT_S`, after which
# readers would take the board for lost.
LONGEST_PAUSE_S: Final = 2.0


class Replay(Device):
    """Plays the recording `path`, `speed` times as fast as it came; 0: as fast as it is taken.

    name: the URL by which it was opened. The attribute `info` is what the board had said of itself
    when the newest scan came.

    :raises RecordingError: it cannot be read.
    :raises ValueError: a negative speed.
    """

    def __init__(self, path: str, speed: float, name: str) -> None:
        if not 0 <= speed < float("inf"):
            raise ValueError(f"speed must be 0 or more, not {speed}")
        super().__init__(name, BoardStats())
        self._speed = speed
        self.waits = speed == 0
        self._messages = messages(path, timed=True)
        hello = next(self._messages)
        assert isinstance(hello, Hello)
        self._hello = hello
        self._running = self._closing = False
        # When the scan before was due here, and when it had been recorded [s].
        self._last: tuple[float, float] | None = None
        self._begin_thread(self._play, f"play {path}")

    def start(self) -> None:
        """Let it run. A scan that was played and that nobody has taken yet stays."""
        with self._commands:
            if not self._want_scans:
                self._command("start")
                self._want_scans = True

    def _command(self, name: str, **values: protocol.Value) -> None:
        """Start or stop.

        :raises CommandRefused: a recording can do nothing else.
        """
        if name not in ("start", "stop"):
            reason = f"{self.name} is a recording, which stays as it is"
            raise CommandRefused(name, "recorded", reason)
        with self._changed:
            if self._failure is not None and not isinstance(self._failure, RecordingEnded):
                raise self._failure
            self._running, self._last = name == "start", None
            self._changed.notify_all()

    def close(self) -> None:
        """End the replay. May be called again."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        super().close()
        self._messages.close()

    def _play(self) -> None:
        """The work of the replay's thread: publish one message after the other, each when due."""
        tares: list[Tare] = []
        for message in self._messages:
            if isinstance(message, Hello | Scan) and not self._wait_for(message):
                return
            match message:
                case Scan():
                    tare = tare_of(message, tares)
                    rest_ratio = None if tare is None else tare.rest_ratio
                    with self._changed:
                        self._stats.scans += 1
                        self._stats.missed += message.missed
                        now_s = time.monotonic()
                        self._publish(replace(message, rest_ratio=rest_ratio, host_time_s=now_s))
                case Hello():
                    self._check_unit(message)
                    if message.unit_id != self.info.unit_id:
                        tares.clear()  # they are of another skin
                    self._hello = message
                case Tare():
                    tares.append(message)
        raise RecordingEnded(f"{self.name} has been played to its end")

    def _wait_for(self, message: Hello | Scan) -> bool:
        """Wait until somebody reads, and until the message is due. False: the replay was closed."""
        with self._changed:
            while not self._closing:
                now_s = time.monotonic()
                due_s = self._due_s(message, now_s)
                if due_s <= now_s:
                    if isinstance(message, Scan):
                        self._last = (due_s, message.host_time_s)
                    return True
                # Readers notify when they take a scan. One that goes away says nothing, so the
                # replay looks again now and then.
                self._changed.wait(min(due_s - now_s, READ_TIMEOUT_S))
        return False

    def _due_s(self, message: Hello | Scan, now_s: float) -> float:
        """When a message is due on the host's clock [s]; infinite while nobody wants it."""
        if not (self._running and self._asked) or (self.waits and self._readers_are_behind()):
            return float("inf")
        if isinstance(message, Hello) or self.waits or self._last is None:
            return now_s
        pause_s = (message.host_time_s - self._last[1]) / self._speed
        return self._last[0] + min(max(pause_s, 0.0), LONGEST_PAUSE_S)

    def _readers_are_behind(self) -> bool:
        """Whether readers have not yet taken what was published.

        An iterator has a queue, and is behind if half of it is full: so it and the replay can both
        work. `latest` has none, and is behind until it has taken the newest scan.
        """
        if self._queues:
            return any(len(queue) >= QUEUE_SCANS // 2 for queue in self._queues.values())
        return self._newest is not None
