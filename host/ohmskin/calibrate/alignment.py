# SPDX-License-Identifier: Apache-2.0
"""The offset between a force sensor's clock and that of the scans, from the presses both saw.

Symbols

====== ======= ========================================================================= ==========
symbol shape   meaning                                                                   unit
====== ======= ========================================================================= ==========
x, y   (X,)    edges of the skin's rise and of the force, each on a grid of its own       1/s
       (Y,)
m      alike   1 where there are edges, 0 in gaps                                         1
k                lag: x[l + k] is compared with y[l]                                      grid steps
n      (K,)    grid points that x and y share at each lag                                 1
r      (K,)    Pearson's correlation of x and y over those points                         1
G      (K,)    score, -n/2 log(1 - r^2) where r > 0, else 0                               1
====== ======= ========================================================================= ==========

Edges: both are compressed, log(1 + z / (0.2 z_99)) with their own 99th percentile z_99, so that
strong and weak presses count alike. Then both are differentiated by a Gaussian of 50 ms: creep,
drift and the zero are slow, while a press begins and ends in both at once.

At each lag r is normalised by what both share there, without gaps. So a large press does not win at
a wrong lag by its size. By r alone, two short stretches could win that are alike by chance. G is
the log-likelihood ratio of "x is a multiple of y and noise" to "x is noise", which grows with n. A
delay inside the force sensor, such as that of its filter, is part of the offset.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.tables import ForceLog, between_gaps

# The recording and the force log are compared on a grid of this step. Chosen: as fine as the scans
# of most boards.
GRID_STEP_S: Final = 0.01
# Standard deviation of the Gaussian that differentiates. Chosen: longer than a scan takes, shorter
# than a press begins.
SMOOTHING_S: Final = 0.05
# A rise of this share of the 99th percentile is where the logarithm begins to compress. Chosen: a
# press of a fifth of the force then counts 0.4 of a strong one.
COMPRESSION_SHARE: Final = 0.2
# A longer recording or log is refused. Chosen: it would take memory that no session needs.
MAX_SPAN_S: Final = 6 * 3600.0
# The recording and the force log must have measured together for so long. Chosen: shorter stretches
# are alike by chance.
MIN_OVERLAP_S: Final = 15.0
# They must also have measured together for this share of the shorter one. Chosen: a short part of
# two long sessions is alike by chance, too.
MIN_OVERLAP_SHARE: Final = 0.5
# A smaller r is that of sessions that have nothing in common (tests/calibrate/test_alignment.py).
MIN_CORRELATION: Final = 0.6
# Where another offset has more than this share of the best G, neither can be trusted. In simulated
# sessions (tests/calibrate/test_alignment.py) the second-best offset has up to 0.14 of it where
# presses are irregular, and from 0.74 on where they repeat evenly.
MAX_SECOND_SHARE: Final = 0.7
# Two sums of products that differ by less than this share are the same but for the FFT's rounding.
# Chosen: a double has sixteen digits, and a sum of many products loses a few of them.
_ROUNDING_SHARE: Final = 1e-9


@dataclass(frozen=True)
class Alignment:
    """How the force sensor's clock and that of the scans belong together.

    offset_s: log time + offset_s = scan time [s].
    correlation: r at that offset.
    overlap_s: for how long both measured there [s].
    """

    offset_s: float
    correlation: float
    overlap_s: float


def align(time_s: Float, rise: Float, log: ForceLog) -> Alignment:
    """The offset at which the skin's edges are most like the force's.

    time_s (n,): the middle of each scan by any clock [s], increasing. rise (n,): of the whole skin
    above rest, summed over cells [S]. Two clocks whose rates differ are aligned on average.

    Raises ValueError for bad arrays; if nothing was pressed; if both ran together for too short; if
    nothing fits; and if another offset fits nearly as well, as with presses that repeat evenly.
    """
    good = np.isfinite(rise) & (np.diff(time_s, prepend=-np.inf) > 0)
    if not good.all():
        scan = int(np.argmin(good))
        raise ValueError(f"scan {scan}: its rise is not finite, or its time not after the last")
    x, in_x = _edges(time_s, rise, "the skin's rise")
    y, in_y = _edges(log.time_s, log.force_n, "the force")
    r, shared = correlations(x, in_x, y, in_y)
    shorter_s = min(np.count_nonzero(in_x), np.count_nonzero(in_y)) * GRID_STEP_S
    enough = shared * GRID_STEP_S >= max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shorter_s)
    if not enough.any():
        needed = f"{MIN_OVERLAP_S:g} s, and for half of the shorter one, gaps left out"
        raise ValueError(f"scans and force log overlap at no offset for {needed}")
    likeness = np.where(enough, r, 0.0).clip(0.0, 1 - 1e-12)  # log1p(-1) is infinite
    score = -0.5 * shared * np.log1p(-(likeness**2))
    best = int(np.argmax(score))
    if likeness[best] < MIN_CORRELATION:
        least = f"their best correlation is {likeness[best]:.2f}, less than {MIN_CORRELATION:g}"
        raise ValueError(f"scans and force log fit at no offset: {least}: are they of one session?")
    _check_unique(r, score, best)
    lag = best + _vertex(score, best) - (y.size - 1)  # the first one is 1 - Y
    return Alignment(
        offset_s=float(time_s[0] - log.time_s[0] + lag * GRID_STEP_S),
        correlation=float(r[best]),
        overlap_s=float(shared[best] * GRID_STEP_S),
    )


def _edges(time_s: Float, values: Float, name: str) -> tuple[Float, Bool]:
    """Edges on a grid that begins with `time_s`, 0 in gaps; and where there is no gap.

    Raises ValueError, naming the values, where they last too short or too long, or do not rise.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter1d

    span_s = float(time_s[-1] - time_s[0])
    if span_s < MIN_OVERLAP_S:
        raise ValueError(
            f"{name} lasts {span_s:.3g} s, {MIN_OVERLAP_S:g} s are needed: record longer"
        )
    if span_s > MAX_SPAN_S:
        span = f"{name} lasts {span_s / 3600:.1f} h, more than 6"
        raise ValueError(f"{span}: are its times in seconds? If so, cut it into parts")
    strong = float(np.percentile(values, 99))
    if values.min() == values.max() or values.max() <= 0:
        raise ValueError(f"{name} does not rise: nothing was pressed")
    if strong <= 0:
        raise ValueError(
            f"{name} rises during less than 1 % of the time: cut away what is before and after the "
            "presses, or press more often"
        )
    # A sensor's glitch counts no more than a press twice as strong as all others.
    compressed = np.log1p(np.clip(values, 0.0, 2 * strong) / (COMPRESSION_SHARE * strong))
    grid_s = np.arange(int(span_s / GRID_STEP_S) + 1) * GRID_STEP_S
    level = between_gaps(grid_s, time_s - time_s[0], compressed)
    is_level = np.isfinite(level)
    blurred = partial(gaussian_filter1d, sigma=SMOOTHING_S / GRID_STEP_S, mode="constant")
    # Gaps are left out of the Gaussian's weights: nothing is made up inside them.
    weight = np.where(is_level, blurred(is_level.astype(np.float64)), 1.0)
    smooth = blurred(np.where(is_level, level, 0.0)) / weight
    inside = binary_erosion(is_level, np.ones(3))  # a difference needs both neighbours
    return np.where(inside, np.gradient(smooth, GRID_STEP_S), 0.0), inside


def correlations(x: Float, in_x: Bool, y: Float, in_y: Bool) -> tuple[Float, Float]:
    """r and n (K,) of all lags, the first being 1 - Y; r is 0 where either does not vary.

    x, y: edges; in_x, in_y: where there are edges, not gaps.
    """
    from scipy.signal import correlate

    mask_x, mask_y = in_x.astype(np.float64), in_y.astype(np.float64)
    # All lags at once, by FFT: r of each from sums over the points that x and y share there. The
    # differences below would lose digits if the means were not taken off first.
    x = (x - x[in_x].mean()) * mask_x
    y = (y - y[in_y].mean()) * mask_y
    sums = partial(correlate, method="fft")
    shared = np.maximum(np.rint(sums(mask_x, mask_y)), 0.0)
    count = np.maximum(shared, 1.0)
    sum_x, sum_y = sums(x, mask_y), sums(mask_x, y)
    square_x = sums(x * x, mask_y) - sum_x**2 / count
    square_y = sums(mask_x, y * y) - sum_y**2 / count
    product = sums(x, y) - sum_x * sum_y / count
    # A stretch without edges has only the rounding of the FFT.
    varies = square_x > _ROUNDING_SHARE * np.sum(x * x)
    varies &= square_y > _ROUNDING_SHARE * np.sum(y * y)
    squares = np.where(varies, square_x * square_y, 1.0)
    return np.where(varies, product / np.sqrt(squares), 0.0).clip(-1.0, 1.0), shared


def _check_unique(r: Float, score: Float, best: int) -> None:
    """Raise ValueError if another peak is nearly as good as that of the best lag.

    The peak of the best lag reaches, on both sides, to the next lag whose r is below half of its r.
    """
    ends = np.concatenate([[0], np.flatnonzero(r < 0.5 * r[best]), [r.size]])
    after = int(np.searchsorted(ends, best, side="right"))
    others = score.copy()
    others[ends[after - 1] : ends[after]] = 0.0  # the peak itself
    second = int(np.argmax(others))
    if others[second] > MAX_SECOND_SHARE * score[best]:
        away_s = abs(second - best) * GRID_STEP_S
        raise ValueError(
            f"an offset {away_s:.2f} s away fits nearly as well: the presses are too even or too "
            "few: press at irregular intervals, and begin and end untouched"
        )


def _vertex(score: Float, best: int) -> float:
    """Where the parabola through the maximum and its neighbours is highest, in -0.5..0.5.

    It has neighbours: where both overlap for long enough, the first and the last lag are far.
    """
    before, peak, after = score[best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0
