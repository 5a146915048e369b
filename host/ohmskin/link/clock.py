# SPDX-License-Identifier: Apache-2.0
"""From a board's clock to the host's, by when its scans arrived.

Symbols

====== ===================================================================================== ====
symbol meaning                                                                               unit
====== ===================================================================================== ====
u      a time on the board's clock                                                           s
t      when the host knew of it, on its monotonic clock                                      s
q      rate: seconds of the host in a second of the board                                    1
h(u)   host time of u: h(u) = t_0 + q (u - u_0)                                              s
====== ===================================================================================== ====

What lies between a board and a program (a USB bridge's latency timer, buffers, a busy machine) only
ever delays: t >= h(u). Hence h is the line below all points (u, t) whose distances to them have the
least sum [Moon1999]. It is the edge of their lower convex hull above or below the mean of u
[Zhang2002]: late points, however many and however late, change nothing as long as some are on time.
A mean, as least squares is one, moves with the load of the machine.

A delay that all scans have cannot be seen from here, and is in h.

[Moon1999]: S. B. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from network
delay measurements", INFOCOM 1999. [Zhang2002]: L. Zhang, Z. Liu, C. H. Xia, "Clock synchronization
algorithms for network measurements", INFOCOM 2002.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.link.messages import Scan

# A ceramic resonator warms: by 10 ppm a second it bends the line by 1 ms in so long.
WINDOW_S: Final = 30.0
# A ceramic resonator is 0.5 % off, a crystal 0.01 %.
MAX_RATE_ERROR: Final = 0.006
# Earlier than this, or later for so long, and one of the clocks has stepped.
STEP_S: Final = 0.05
STEP_AFTER_S: Final = 2.0
# Of so much board time one point is kept, the earliest: the others are on no hull.
_BLOCK_S: Final = 0.25
# How fast a better line takes effect: times never go back, and never jump.
_SLEW_S: Final = 1.0
_JITTER_SCANS: Final = 2048
_JITTER_PERCENT: Final = 95

_Point = tuple[float, float]


@dataclass(frozen=True)
class _Line:
    """h. rate: q; u_s, t_s: a point of it."""

    rate: float
    u_s: float
    t_s: float

    def at(self, u_s: float) -> float:
        return self.t_s + self.rate * (u_s - self.u_s)


def _below(points: Sequence[_Point], rate: float) -> _Line:
    """The line below points (u, t), u rising [Zhang2002]. rate: where one point tells none."""
    hull: list[_Point] = []
    for u_s, t_s in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], (u_s, t_s)):
            hull.pop()
        hull.append((u_s, t_s))
    mean_s = math.fsum(u_s for u_s, _ in points) / len(points)
    for (u_s, t_s), (next_u_s, next_t_s) in pairwise(hull):
        rate = (next_t_s - t_s) / (next_u_s - u_s)
        if next_u_s >= mean_s:
            break
    rate = min(max(rate, 1 - MAX_RATE_ERROR), 1 + MAX_RATE_ERROR)
    u_s, t_s = min(hull, key=lambda point: point[1] - rate * point[0])
    return _Line(rate, u_s, t_s)


def _turns_right(a: _Point, b: _Point, c: _Point) -> bool:
    """Whether b is on or above the line from a to c."""
    return (b[0] - a[0]) * (c[1] - a[1]) <= (c[0] - a[0]) * (b[1] - a[1])


class BoardClock:
    """Learns the clock of a board from scan after scan.

    A board that restarts is followed at once, and so is a clock that steps, unless it makes scans
    late: then after `STEP_AFTER_S`. Else times are smooth: what is learned later shifts coming
    times alone, over a second.
    """

    def __init__(self) -> None:
        self._line: _Line | None = None
        self._rate = 1.0
        self._points: deque[_Point] = deque()  # the earliest of each block
        self._earliest = (0.0, 0.0)  # of the block that began at _block_u_s
        self._block_u_s = self._last_u_s = 0.0
        self._slew_s, self._slew_from_s = 0.0, 0.0
        self._late_since_s: float | None = None
        self._lates_s: deque[float] = deque(maxlen=_JITTER_SCANS)
        self._jitter_s = math.nan

    def add(self, time_us: float, host_time_s: float) -> None:
        """Something that was at `time_us` of the board was known here at `host_time_s`, or earlier.

        Pairs come in the order of the board's clock; where it goes back, the board has restarted.
        """
        u_s, t_s = 1e-6 * time_us, host_time_s
        if self._line is None or u_s <= self._last_u_s or self._steps(u_s, t_s):
            self._restart(u_s, t_s)
            return
        self._last_u_s = u_s
        late_s = t_s - self._line.at(u_s)
        self._lates_s.append(max(late_s, 0.0))
        ends_block = u_s - self._block_u_s >= _BLOCK_S
        if ends_block:
            self._points.append(self._earliest)
            while self._points and u_s - self._points[0][0] > WINDOW_S:
                self._points.popleft()
            self._block_u_s, self._earliest = u_s, (u_s, t_s)
        elif late_s < self._earliest[1] - self._line.at(self._earliest[0]):
            self._earliest = (u_s, t_s)
        if ends_block or late_s < 0:
            self._learn(u_s)
        if ends_block:
            self._jitter_s = float(np.percentile(self._lates_s, _JITTER_PERCENT))

    def host_s(self, time_us: float) -> float:
        """Host time at which the board's clock showed `time_us`, on `time.monotonic()` [s].

        Meant for times about that of the last `add`. Raises ValueError before the first.
        """
        if self._line is None:
            raise ValueError("no scan has been added: its arrival tells the time")
        u_s = 1e-6 * time_us
        left = 1 - max(u_s - self._slew_from_s, 0.0) / _SLEW_S
        return self._line.at(u_s) + self._slew_s * max(left, 0.0)

    @property
    def jitter_s(self) -> float:
        """95 % of the last 2048 scans were no later than this after h [s]; NaN for 0.25 s."""
        return self._jitter_s

    def _restart(self, u_s: float, t_s: float) -> None:
        self._line = _Line(self._rate, u_s, t_s)  # the rate is the crystal's: it stays
        self._points.clear()
        self._earliest = (u_s, t_s)
        self._last_u_s = self._block_u_s = u_s
        self._slew_s = 0.0
        self._late_since_s = None

    def _steps(self, u_s: float, t_s: float) -> bool:
        assert self._line is not None
        late_s = t_s - self._line.at(u_s)
        if late_s < STEP_S:
            self._late_since_s = None
            return late_s < -STEP_S
        if self._late_since_s is None:
            self._late_since_s = t_s
        return t_s - self._late_since_s > STEP_AFTER_S

    def _learn(self, u_s: float) -> None:
        before_s = self.host_s(1e6 * u_s)
        self._line = _below([*self._points, self._earliest], self._rate)
        self._rate = self._line.rate
        # So little that times still rise while it is made up for.
        self._slew_s = min(max(before_s - self._line.at(u_s), -STEP_S), STEP_S)
        self._slew_from_s = u_s


def scan_times_s(scans: list[Scan]) -> Float:
    """Times of recorded scans on the host's clock [s], (n,), without the jitter of their arrival.

    All late by the same: about the time that a scan takes. For each run of the board's clock, h of
    30 s about each of its points; between these points, linear.
    """
    host_s = np.array([scan.host_time_s for scan in scans])
    board_s = 1e-6 * np.array([scan.time_us for scan in scans])
    times_s = np.empty_like(host_s)
    restarts = np.flatnonzero(np.diff(board_s) <= 0) + 1
    for part in np.split(np.arange(host_s.size), restarts):
        u_s, t_s = board_s[part], host_s[part]
        count = 2 + int((u_s[-1] - u_s[0]) / (WINDOW_S / 2))
        knots: list[_Point] = []
        for knot_s in np.linspace(u_s[0], u_s[-1], count).tolist():
            first, last = np.searchsorted(u_s, [knot_s - WINDOW_S / 2, knot_s + WINDOW_S / 2])
            points = list(zip(u_s[first:last].tolist(), t_s[first:last].tolist(), strict=True))
            if points:
                knots.append((knot_s, _below(points, 1.0).at(knot_s)))
        times_s[part] = np.interp(u_s, *np.array(knots).T)
    return times_s
