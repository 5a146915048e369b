# SPDX-License-Identifier: Apache-2.0
"""What has come from a source of scans, for the threads that read it.

One thread publishes. Any number of threads read, in two ways: a queue gives every scan in order,
`latest` gives the newest scan and skips the rest. All of them wait on one condition, `changed`.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

from ohmskin.errors import DeviceLost, OhmskinError, RecordingEnded
from ohmskin.link.messages import Scan

# Scans that are kept for an iterator that is slower than the board: 11 s at 90 Hz.
QUEUE_SCANS = 1024


class ScanFeed:
    """The scans of the source called `name`.

    failure: why no more scans come; None while they do. asked: somebody has begun to read.
    overflowed: scans that were lost to iterators which were slower than the source.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.changed = threading.Condition()
        self.failure: OhmskinError | None = None
        self.asked = False
        self.overflowed = 0
        self._newest: Scan | None = None
        self._newest_taken = False
        # Weak: an iterator that is dropped unused takes its queue along.
        self._queues: weakref.WeakSet[_Queue] = weakref.WeakSet()

    # ------------------------------------------------------------------------- for the source

    def publish(self, scan: Scan) -> None:
        """Give a scan to all who read."""
        with self.changed:
            self._newest, self._newest_taken = scan, False
            for queue in self._queues:
                self.overflowed += queue.put(scan)
            self.changed.notify_all()

    def fail(self, error: OhmskinError) -> None:
        """Say why no more scans come. Whoever waits, now or later, gets this error."""
        with self.changed:
            self.failure = error
            self.changed.notify_all()

    def forget_newest(self) -> None:
        """Make `latest` wait for the next scan: the newest one is of another configuration."""
        with self.changed:
            self._newest = None

    @property
    def is_behind(self) -> bool:
        """Whether the readers have not yet taken what was published. Read it holding `changed`."""
        if self._queues:
            return any(len(queue.scans) >= QUEUE_SCANS // 2 for queue in self._queues)
        return self._newest is not None and not self._newest_taken

    # ------------------------------------------------------------------------ for the readers

    def wait(self, ready: Callable[[], bool], limit_s: float) -> None:
        """Wait, holding `changed`, until `ready()`.

        :raises DeviceLost: that takes longer than `limit_s`, or the source has failed meanwhile.
        """
        self.changed.wait_for(lambda: ready() or self.failure is not None, limit_s)
        if ready():
            return
        if self.failure is not None:
            raise self.failure
        raise DeviceLost(f"{self.name} has said nothing for {limit_s:.1f} s: unplug and plug it")

    def latest(self, limit_s: float) -> Scan:
        """The newest scan. Each scan is given once: waits if this one was given already."""
        with self.changed:
            self._ask()
            self.wait(lambda: self._newest is not None and not self._newest_taken, limit_s)
            assert self._newest is not None
            self._newest_taken = True
            self.changed.notify_all()
            return self._newest

    def scans(self, limit_s: Callable[[], float]) -> Iterator[Scan]:
        """Every scan from now on. limit_s: gives how long to wait for the next [s].

        Ends with a recording.
        """
        queue = _Queue()
        with self.changed:
            self._queues.add(queue)
            self._ask()
        return self._taken(queue, limit_s)

    def _taken(self, queue: _Queue, limit_s: Callable[[], float]) -> Iterator[Scan]:
        while True:
            with self.changed:
                try:
                    self.wait(lambda: bool(queue.scans), limit_s())
                except RecordingEnded:
                    return
                scan = queue.take()
                self.changed.notify_all()
            yield scan

    def _ask(self) -> None:
        self.asked = True
        self.changed.notify_all()


class _Queue:
    """The scans that an iterator has not taken yet."""

    def __init__(self) -> None:
        self.scans: deque[Scan] = deque()
        self._lost = 0

    def put(self, scan: Scan) -> int:
        """Append a scan; returns how many old scans had to go for it."""
        self.scans.append(scan)
        if len(self.scans) <= QUEUE_SCANS:
            return 0
        oldest = self.scans.popleft()
        self._lost += 1 + oldest.missed
        return 1

    def take(self) -> Scan:
        """The oldest scan; what was lost before it is added to its ``missed``."""
        scan, lost = self.scans.popleft(), self._lost
        self._lost = 0
        return replace(scan, missed=scan.missed + lost) if lost else scan
