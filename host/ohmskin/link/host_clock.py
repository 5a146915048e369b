# SPDX-License-Identifier: Apache-2.0
"""The clock of the host: the machine's, or one that a program steps.

What waits for a board does not read the machine's clock itself; it is given a clock. So the same
code runs against a real board, and against an emulated one whose minutes pass at once.
"""

import math
import threading
import time


class HostClock:
    """The machine's monotonic clock. Its time passes by itself."""

    def now_s(self) -> float:
        """Time [s], as `time.monotonic()` gives it."""
        return time.monotonic()

    def wait(self, changed: threading.Condition, limit_s: float) -> None:
        """Wait, holding `changed`, until it is notified, or for `limit_s`."""
        changed.wait(limit_s)


class SteppedClock(HostClock):
    """A clock that begins at 0 and stands still, except in `wait`, which returns at once."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        """Time [s] since this clock was made."""
        return self._now_s

    def wait(self, changed: threading.Condition, limit_s: float) -> None:
        """Let `limit_s` pass."""
        # A step that is smaller than the resolution of a float must not leave the clock where it
        # is: who waits for a time in a loop would wait for ever.
        self._now_s = max(self._now_s + limit_s, math.nextafter(self._now_s, math.inf))
