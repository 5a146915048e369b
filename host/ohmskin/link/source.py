# SPDX-License-Identifier: Apache-2.0
"""What gives scans: a board's `Session`, or a recording's `ohmskin.record.replay.Replay`.

One thread publishes scans. Any number of threads read them, in two ways: an iterator gets every
scan in order, `latest` gets the newest one and skips the rest. All wait on one condition.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from weakref import WeakValueDictionary

from ohmskin.errors import DeviceLost, OhmskinError, RecordingEnded
from ohmskin.link import protocol
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport

# Scans that are kept for an iterator that is slower than the board: 11 s at 90 Hz.
QUEUE_SCANS = 1024


class Source(ABC):
    """The source of scans called `name`.

    stats: its counts, which others may count in too. changed: condition of all that is here.
    commands: is held for as long as one command, or a few that belong together, take. report: of
    the last self-test. want_scans: it is to scan. asked: somebody has begun to read. failure: why
    no more scans come; None while they do.
    """

    def __init__(self, name: str, stats: BoardStats) -> None:
        self.name = name
        self.changed = threading.Condition()
        self.commands = threading.RLock()
        self.report: SelfTestReport | None = None
        self.want_scans = self.asked = False
        self.failure: OhmskinError | None = None
        self._stats = stats
        self._hello: Hello | None = None
        self._newest: Scan | None = None  # until `latest` gives it
        # By id, and weak: an iterator that is dropped unused takes its queue along.
        self._queues: WeakValueDictionary[int, deque[Scan]] = WeakValueDictionary()

    @property
    def hello(self) -> Hello:
        """What the board has last said of itself."""
        assert self._hello is not None
        return self._hello

    @property
    def stats(self) -> BoardStats:
        """Counts since the connection was made, as a copy."""
        with self.changed:
            return replace(self._stats, line=replace(self._stats.line))

    @abstractmethod
    def command(self, name: str, **values: protocol.Value) -> None:
        """Do a command; it is done on return.

        :raises CommandRefused: it cannot be done.
        :raises DeviceLost: the source has gone.
        """

    def refresh(self) -> Hello:
        """Ask for `hello`, which comes before the answer."""
        self.command("get_hello")
        return self.hello

    def close(self) -> None:
        """Give the port or file back. May be called again."""
        with self.changed:
            self._newest = None
            if self.failure is None or isinstance(self.failure, RecordingEnded):
                self.failure = DeviceLost(f"{self.name} was closed")
            self.changed.notify_all()

    # ----------------------------------------------------------------- for the thread that reads

    def publish(self, scan: Scan) -> None:
        """Give a scan to all who read; what a slow iterator loses is missed before its next."""
        with self.changed:
            self._newest = scan
            for queue in self._queues.values():
                queue.append(scan)
                if len(queue) > QUEUE_SCANS:
                    lost = 1 + queue.popleft().missed
                    queue[0] = replace(queue[0], missed=queue[0].missed + lost)
                    self._stats.overflowed += 1
            self.changed.notify_all()

    def fail(self, error: OhmskinError) -> None:
        """Say why no more scans come. Whoever waits, now or later, gets this error."""
        with self.changed:
            self.failure = error
            self.changed.notify_all()

    @property
    def is_behind(self) -> bool:
        """Whether the readers have not yet taken what was published. Read it holding `changed`."""
        if self._queues:
            return any(len(queue) >= QUEUE_SCANS // 2 for queue in self._queues.values())
        return self._newest is not None

    # ------------------------------------------------------------------------- for the readers

    def wait(self, ready: Callable[[], bool], limit_s: float) -> bool:
        """Wait, holding `changed`, for `ready()`: whether it is so within `limit_s`.

        :raises OhmskinError: the source has failed meanwhile.
        """
        self.changed.wait_for(lambda: ready() or self.failure is not None, limit_s)
        if self.failure is not None and not ready():
            raise self.failure
        return ready()

    def forget_newest(self) -> None:
        """Make `latest` wait for the next scan: the newest one is of another configuration."""
        with self.changed:
            self._newest = None

    def latest(self, limit_s: float) -> Scan:
        """The newest scan, as `Device.latest`."""
        with self.changed:
            self._ask()
            self._wait_for_scan(lambda: self._newest is not None, limit_s)
            scan, self._newest = self._newest, None
            self.changed.notify_all()
        assert scan is not None
        return scan

    def scans(self, limit_s: Callable[[], float]) -> Iterator[Scan]:
        """Every scan from now on, to a recording's end. limit_s: waits so long for each [s]."""
        queue: deque[Scan] = deque()
        with self.changed:
            self._queues[id(queue)] = queue
            self._ask()
        return self._taken(queue, limit_s)

    def _taken(self, queue: deque[Scan], limit_s: Callable[[], float]) -> Iterator[Scan]:
        while True:
            with self.changed:
                try:
                    self._wait_for_scan(lambda: bool(queue), limit_s())
                except RecordingEnded:
                    return
                scan = queue.popleft()
                self.changed.notify_all()
            yield scan

    def _ask(self) -> None:
        self.asked = True
        self.changed.notify_all()

    def _wait_for_scan(self, ready: Callable[[], bool], limit_s: float) -> None:
        if not self.wait(ready, limit_s):
            raise DeviceLost(
                f"{self.name} has said nothing for {limit_s:.1f} s: unplug and plug it"
            )
