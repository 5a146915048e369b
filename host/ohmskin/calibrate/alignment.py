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

At each lag r is normalised by what both share there, without gaps, so a large press wins at no lag
by its size. G is the log-likelihood ratio of "x is a multiple of y and noise" to "x is noise": by r
alone, two short stretches that are alike by chance would win. A delay inside the force sensor, such
as that of its filter, is part of the offset.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.tables import ForceLog, between_gaps

# Both are compared on a grid of this step [s]: as fine as the scans of most boards.
STEP_S: Final = 0.01
# Standard deviation of the Gaussian that differentiates [s]: see the module.
SMOOTHING_S: Final = 0.05
# A rise of this share of the 99th percentile is where the logarithm begins to compress.
COMPRESSION: Final = 0.2
# A longer recording or log [s] takes more memory than a session of presses needs.
MAX_SPAN_S: Final = 6 * 3600.0
# Both must have measured together for so long [s]: shorter stretches are alike by chance.
MIN_OVERLAP_S: Final = 15.0
# They must have measured together for this share of the shorter one.
MIN_OVERLAP_SHARE: Final = 0.5
# A smaller r is that of two sessions which have nothing in common (test_alignment.py).
MIN_CORRELATION: Final = 0.6
# Where another offset has more than this share of the best G, neither can be trusted.
MAX_SECOND: Final = 0.7


@dataclass(frozen=True)
class Alignment:
    """log time + offset_s = scan time.

    correlation: r at that offset, of edges. overlap_s: for how long both measured there [s].
    """

    offset_s: float
    correlation: float
    overlap_s: float


def align(scan_time_s: ArrayLike, rise: ArrayLike, log: ForceLog) -> Alignment:
    """The offset at which the skin's edges are most like the force's.

    scan_time_s (n,): the middle of each scan by any clock [s], increasing. rise (n,): of the whole
    skin above rest, summed over cells [S]. Two clocks whose rates differ are aligned on average.

    Raises ValueError for bad arrays; if nothing was pressed; if both ran together for too short; if
    nothing fits; and if another offset fits nearly as well, as with presses that repeat evenly.
    """
    time_s, rises = (np.asarray(each, dtype=np.float64) for each in (scan_time_s, rise))
    good = np.isfinite(rises) & (np.diff(time_s, prepend=-np.inf) > 0)
    if not good.all():
        scan = int(np.argmin(good))
        raise ValueError(f"scan {scan}: its rise is not finite, or its time not after the last")
    x, in_x = _edges(time_s, rises, "the skin's rise")
    y, in_y = _edges(log.time_s, log.force_n, "the force")
    r, shared = correlations(x, in_x, y, in_y)
    shorter_s = min(np.count_nonzero(in_x), np.count_nonzero(in_y)) * STEP_S
    enough = shared * STEP_S >= max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shorter_s)
    if not enough.any():
        needed = f"{MIN_OVERLAP_S:g} s, and for half of the shorter one, gaps left out"
        raise ValueError(f"scans and force log overlap at no offset for {needed}")
    likeness = np.where(enough, r, 0.0).clip(0.0, 1 - 1e-12)
    score = -0.5 * shared * np.log1p(-(likeness**2))
    best = int(np.argmax(score))
    if likeness[best] < MIN_CORRELATION:
        found = f"their best correlation is {likeness[best]:.2f}, less than {MIN_CORRELATION:g}"
        raise ValueError(f"scans and force log fit at no offset: {found}: are they of one session?")
    _check_unique(r, score, best)
    lag = best + _vertex(score, best) - (y.size - 1)
    return Alignment(
        offset_s=float(time_s[0] - log.time_s[0] + lag * STEP_S),
        correlation=float(r[best]),
        overlap_s=float(shared[best] * STEP_S),
    )


def _edges(time_s: Float, values: Float, name: str) -> tuple[Float, Bool]:
    """Edges on a grid that begins with `time_s`, 0 in gaps; and where there is no gap."""
    from scipy.ndimage import binary_erosion, gaussian_filter1d

    span_s = float(time_s[-1] - time_s[0])
    if span_s < MIN_OVERLAP_S:
        raise ValueError(f"{name} lasts {span_s:.3g} s, {MIN_OVERLAP_S:g} s are needed")
    if span_s > MAX_SPAN_S:
        raise ValueError(f"{name} lasts {span_s / 3600:.1f} h, more than 6: cut it into parts")
    strong = float(np.percentile(values, 99))
    if values.min() == values.max() or strong <= 0:
        raise ValueError(f"{name} does not rise: nothing was pressed")
    # A sensor's glitch counts no more than a press twice as strong as all others.
    compressed = np.log1p(np.clip(values, 0.0, 2 * strong) / (COMPRESSION * strong))
    grid_s = np.arange(int(span_s / STEP_S) + 1) * STEP_S
    level = between_gaps(grid_s, time_s - time_s[0], compressed)
    known = np.isfinite(level)
    # Gaps are left out of the Gaussian's weights: nothing is made up inside them.
    weighted, weight = (
        gaussian_filter1d(each, SMOOTHING_S / STEP_S, mode="constant")
        for each in (np.where(known, level, 0.0), known.astype(np.float64))
    )
    smooth = weighted / np.where(known, weight, 1.0)
    inside = binary_erosion(known, np.ones(3))
    return np.where(inside, np.gradient(smooth, STEP_S), 0.0), inside


def correlations(x: Float, in_x: Bool, y: Float, in_y: Bool) -> tuple[Float, Float]:
    """r and n (K,) of all lags, the first being 1 - Y; r is 0 where either does not vary.

    x, y: edges; in_x, in_y: where there are edges, not gaps.
    """
    from scipy.signal import correlate

    mask_x, mask_y = in_x.astype(np.float64), in_y.astype(np.float64)
    # The differences below would lose digits if the means were not taken off first.
    x = (x - x[in_x].mean()) * mask_x
    y = (y - y[in_y].mean()) * mask_y

    def sums(one: Float, other: Float) -> Float:
        return np.asarray(correlate(one, other, method="fft"))

    shared = np.maximum(np.rint(sums(mask_x, mask_y)), 0.0)
    count = np.maximum(shared, 1.0)
    sum_x, sum_y = sums(x, mask_y), sums(mask_x, y)
    square_x = sums(x * x, mask_y) - sum_x**2 / count
    square_y = sums(mask_x, y * y) - sum_y**2 / count
    product = sums(x, y) - sum_x * sum_y / count
    # A stretch with less than this share of all edges holds none, only the rounding of the FFT.
    varies = (square_x > 1e-9 * np.sum(x * x)) & (square_y > 1e-9 * np.sum(y * y))
    squares = np.where(varies, square_x * square_y, 1.0)
    return np.where(varies, product / np.sqrt(squares), 0.0).clip(-1.0, 1.0), shared


def _check_unique(r: Float, score: Float, best: int) -> None:
    """Raise ValueError if there is a peak as good beside the best one, which ends at half its r."""
    ends = np.concatenate([[0], np.flatnonzero(r < 0.5 * r[best]), [r.size]])
    after = int(np.searchsorted(ends, best, side="right"))
    others = score.copy()
    others[ends[after - 1] : ends[after]] = 0.0
    second = int(np.argmax(others))
    if others[second] > MAX_SECOND * score[best]:
        raise ValueError(
            f"an offset {abs(second - best) * STEP_S:.2f} s away fits nearly as well: the presses "
            "are too even or too few: press at irregular intervals, and begin and end untouched"
        )


def _vertex(score: Float, best: int) -> float:
    """Where the parabola through the maximum and its neighbours is highest, in -0.5..0.5."""
    if not 0 < best < score.size - 1:
        return 0.0
    before, peak, after = score[best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0
