# SPDX-License-Identifier: Apache-2.0
"""What a scale shows of the force on it: later, and smoothed by its filter.

Symbols

====== ======= ==================================================== ====
symbol shape   meaning                                              unit
====== ======= ==================================================== ====
F(t)   (n,)    force on the scale, straight between its times       N
y      (m,)    what the scale shows                                 N
d              delay, by its electronics and its line               s
w              time constant of the pole, or length of the average  s
====== ======= ==================================================== ====

    pole     T dG/dt = F - G  with T = w,             y(s) = G(s - d)
    average  G(t) = 1/w (integral of F from t - w to t),  y(s) = G(s - d)

Whoever only shifts forces by a lag has them wrong wherever they change faster than w.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.link.clock import without_delays_s

# Filters begin the search from all pairs of these [s]. Chosen: from a fast load cell to a kitchen
# scale.
DELAYS_S: Final = (0.0, 0.1, 0.2, 0.4)
LENGTHS_S: Final = (0.02, 0.1, 0.3)
# The delay may be negative down to this [s], since a force may reach the scale before the scan that
# sees it has ended. Chosen: a scan takes no longer.
EARLIEST_S: Final = -0.1
# Filters are computed on a grid of half a scan, or of this, the longer [s].
LEAST_STEP_S: Final = 0.01
# A longer pause of the scans counts as so long on the grid [s]. Chosen: no filter remembers a force
# for longer.
LONGEST_PAUSE_S: Final = 10.0
# The grid has at most so many points for each scan, however many pauses make it longer. Chosen:
# twenty times as many as scans without a pause have.
MOST_POINTS: Final = 40
# So many columns of forces are filtered at once. Chosen: a fit of 16x16 cells has 500 columns, and
# all of them on the grid took half a gigabyte.
COLUMNS: Final = 32


# A scale that prints nothing for so long has made a pause [s].
SILENCE_S: Final = 2.0
# Numbers before and after a pause are so far apart at least [s]. Chosen: no scale is as fast.
LEAST_BETWEEN_S: Final = 1e-4
# Numbers were lost between two windows of so many seconds if the earliest number of the second one
# is later, by half a step or more, than that of the first [s]. Chosen: no machine is too busy for
# so long.
LOST_WINDOW_S: Final = 5.0
# A number is wrong if it is far from the median of so many around it: by more than these medians
# span, and by so many times what only this share of the numbers exceeds. Chosen: two wrong ones may
# follow each other, and a scale that shows each press once or twice keeps them all.
AROUND, WRONG_TIMES, WRONG_SHARE = 5, 2.0, 0.02
# Fewer numbers than this tell no step. If the median number is late by more than a step and by more
# than this [s], the scale does not print at equal steps.
LEAST_NUMBERS, MOST_LATE_S = 20, 0.05


def printed_s(arrival_s: Float) -> Float:
    """When a scale printed what arrived at these times, (m,) [s].

    Arrival can only be late, by a buffer, a latency timer or a busy machine, so the earliest of the
    numbers tell when all were printed, at equal steps (`link.clock`). Where a scale prints at
    other times, such as when it is stable, the times stay.
    """
    pauses = np.flatnonzero(np.diff(arrival_s) > SILENCE_S) + 1
    parts: list[Float] = []
    for part in np.split(arrival_s, pauses):
        times_s = _in_steps(part)
        if parts:  # numbers that waited for the end of a pause may seem to be from before it
            first_s = parts[-1][-1] + LEAST_BETWEEN_S
            times_s = np.maximum(times_s, first_s + LEAST_BETWEEN_S * np.arange(part.size))
        parts.append(times_s)
    return np.concatenate(parts)


def wrong_numbers(shown_n: Float) -> Bool:
    """Which numbers of a scale, (m,), no force explains: a damaged line may read as a number."""
    from scipy.ndimage import median_filter

    around_n = median_filter(shown_n, AROUND, mode="mirror")
    off_n = np.abs(shown_n - around_n)
    usual_n = float(np.quantile(off_n, 1 - WRONG_SHARE))
    return np.asarray(off_n > max(float(np.ptp(around_n)), WRONG_TIMES * usual_n))


def _in_steps(arrival_s: Float) -> Float:
    """`printed_s` of numbers between two pauses."""
    half = arrival_s.size // 2
    if arrival_s.size < LEAST_NUMBERS:
        return arrival_s
    step_s = max(float(np.median(arrival_s[half:] - arrival_s[:-half])) / half, 1e-6)
    number = np.arange(arrival_s.size)
    late_s = arrival_s - step_s * number
    blocks = np.array_split(number, max(1, int(np.ptp(arrival_s) / LOST_WINDOW_S)))
    earliest = [int(block[np.argmin(late_s[block])]) for block in blocks]
    lost = np.zeros_like(number)
    for first, last in pairwise(earliest):
        more = round(float(late_s[last] - late_s[first]) / step_s)
        # Delays that begin look like lost numbers, and are counted, too. Where they end, nothing is
        # taken back: numbers would then be earlier than those before them. A count that stays too
        # high does no harm, because only changes of the count move the lines fitted below.
        if more > 0:
            lost[first + 1 + int(np.argmax(np.diff(arrival_s[first : last + 1]))) :] += more
    times_s = without_delays_s(np.asarray(step_s * (number + lost)), arrival_s)
    is_even = np.median(arrival_s - times_s) < max(step_s, MOST_LATE_S)
    return times_s if is_even else arrival_s


@dataclass(frozen=True)
class Scale:
    """One scale's filter: d, w, and whether it averages (else it has one pole)."""

    delay_s: float = 0.0
    length_s: float = 0.0
    averages: bool = False

    @property
    def lag_s(self) -> float:
        """By how much it is late on the whole: where its answer to an impulse has its mean."""
        return self.delay_s + (0.5 if self.averages else 1.0) * self.length_s

    def shown(self, time_s: Float, force_n: Float, at_s: Float) -> Float:
        """y at some times (m,), of forces (n, k) at increasing times (n,): (m, k)."""
        firsts = range(0, force_n.shape[1], COLUMNS)
        parts = (force_n[:, first : first + COLUMNS] for first in firsts)
        return np.hstack([self._shown(time_s, part, at_s) for part in parts])

    def _shown(self, time_s: Float, force_n: Float, at_s: Float) -> Float:
        """`shown` of all columns at once."""
        from scipy.signal import lfilter

        # Nothing is known of the force in a pause, so the grid shall not be coarser for its sake.
        cut_s = np.cumsum(np.maximum(np.diff(time_s, prepend=time_s[0]) - LONGEST_PAUSE_S, 0.0))
        at_s = at_s - np.interp(at_s, time_s, cut_s)
        time_s = time_s - cut_s
        longest_s = float(time_s[-1] - time_s[0]) / (MOST_POINTS * time_s.size)
        step_s = max(LEAST_STEP_S, 0.5 * float(np.median(np.diff(time_s))), longest_s)
        grid_s = np.arange(time_s[0], time_s[-1] + step_s, step_s)
        force = between(time_s, force_n, grid_s)
        if self.length_s < 1e-3:
            return between(grid_s, force, at_s - self.delay_s)
        if self.averages:
            steps = 0.5 * step_s * (force[1:] + force[:-1])
            area = np.concatenate([np.zeros_like(force[:1]), np.cumsum(steps, axis=0)])
            ends = (between(grid_s, area, at_s - self.delay_s - w) for w in (0.0, self.length_s))
            return np.asarray((next(ends) - next(ends)) / self.length_s)
        stays = np.exp(-step_s / self.length_s)
        bends = self.length_s / step_s * (1 - stays)  # exact where the force is straight
        smooth = lfilter([1 - bends, bends - stays], [1, -stays], force, axis=0)
        return between(grid_s, smooth, at_s - self.delay_s)


def between(time_s: Float, values: Float, at_s: Float) -> Float:
    """Values (n, k) of times (n,), interpolated at others (m,): (m, k). At both ends they stay."""
    after = np.searchsorted(time_s, at_s).clip(1, time_s.size - 1)
    before = after - 1
    share = ((at_s - time_s[before]) / (time_s[after] - time_s[before])).clip(0.0, 1.0)
    return np.asarray(values[before] + share[:, None] * (values[after] - values[before]))


def fit_scale(
    time_s: Float, force_n: Float, shown_s: Float, shown_n: Float, weight: Float
) -> Scale:
    """The filter that makes `shown_n` (m,) of forces (n,), but for a factor and a zero.

    weight: of each that is shown, (m,).
    """
    from scipy.optimize import minimize

    forces = force_n[:, None]

    def misfit(pair: Sequence[float], averages: bool) -> float:
        delay_s, length_s = pair
        if delay_s < EARLIEST_S or length_s < 0:
            return np.inf
        shown = Scale(delay_s, length_s, averages).shown(time_s, forces, shown_s)[:, 0]
        terms = np.column_stack([shown, np.ones_like(shown)])
        weighted = terms * weight[:, None]
        normal = weighted.T @ terms + 1e-12 * np.eye(2)
        off = shown_n - terms @ np.linalg.solve(normal, weighted.T @ shown_n)
        return float(weight @ off**2)

    found = []
    for averages in (False, True):
        pairs = product(DELAYS_S, LENGTHS_S)
        delay_s, length_s = min(pairs, key=lambda pair: misfit(pair, averages))
        corners = [(delay_s, length_s), (delay_s + 0.03, length_s), (delay_s, 1.5 * length_s)]
        options = {"initial_simplex": corners, "xatol": 1e-3, "fatol": 1e-9, "maxfev": 50}
        best = minimize(misfit, corners[0], (averages,), "Nelder-Mead", options=options)
        delay_s, length_s = best.x.tolist()
        found.append((best.fun, Scale(delay_s, length_s, averages)))
    return min(found, key=lambda one: one[0])[1]
