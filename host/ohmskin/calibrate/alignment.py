# SPDX-License-Identifier: Apache-2.0
"""The offset between a force sensor's clock and the scans', from what both saw of the presses.

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

Edges: conductance grows with force, but by another power and gain in each cell, and creeps on
while the force rests. Hence both are compressed, log(1 + z / (0.2 z_99)) with their own 99th
percentile z_99, so that strong and weak presses count alike, and then differentiated: creep, drift
and the zero are slow, and presses begin and end in both at once. The derivative is that of a
Gaussian of 50 ms: a shorter one sees more noise, a longer one more creep.

r is normalised at each lag by what is shared there, gaps left out: no lag wins by a large press.
G is the log-likelihood ratio of "x is a multiple of y and noise" to "x is noise": by r alone the
chance likeness of two short stretches would win. A parabola through G about its maximum gives the
offset between grid points.

`tests/calibrate/test_alignment.py` prints the error for simulated skins that creep.
What lags in the force sensor, such as its filter, is part of the offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import correlate

from ohmskin.arrays import Float
from ohmskin.calibrate.force_log import MIN_SAMPLES, ForceLog, between_gaps

STEP_S: Final = 0.01
SMOOTHING_S: Final = 0.05
COMPRESSION: Final = 0.2
MAX_SPAN_S: Final = 6 * 3600.0
# Shorter stretches are alike by chance.
MIN_OVERLAP_S: Final = 15.0
MIN_OVERLAP_SHARE: Final = 0.5
MIN_CORRELATION: Final = 0.6
# The next best offset's G, as a share of the best's, from which on neither can be trusted.
MAX_SECOND: Final = 0.7


@dataclass(frozen=True)
class Alignment:
    """log time + offset_s = scan time.

    correlation: r there, of edges. overlap_s: for how long both measured at that offset [s].
    """

    offset_s: float
    correlation: float
    overlap_s: float


def align(scan_time_s: ArrayLike, rise: ArrayLike, log: ForceLog) -> Alignment:
    """The offset at which the skin's edges are most like the force's.

    scan_time_s (n,): of the middles of scans [s], increasing; their host's clock or any other. rise
    (n,): of the whole skin above rest, summed over cells [S]. Both must run for at least 15 s
    together, and for half of the shorter one. Two clocks whose rates differ are aligned on average.

    Raises ValueError for bad arrays; where nothing was pressed; where nothing fits (r < 0.6); and
    where another offset fits nearly as well, as with presses that repeat evenly.
    """
    time_s, rises = (np.asarray(each, dtype=np.float64) for each in (scan_time_s, rise))
    _check(time_s, rises)
    x, in_x = _edges(time_s, rises, "the skin's rise")
    y, in_y = _edges(log.time_s, log.force_n, "the force")
    shorter = min(np.count_nonzero(in_x), np.count_nonzero(in_y)) * STEP_S
    if shorter < MIN_OVERLAP_S:
        raise ValueError(
            f"{shorter:.1f} s without gaps are too short: scans and force log need "
            f"{MIN_OVERLAP_S:g} s each"
        )
    r, shared = _correlations(x, in_x, y, in_y)
    enough = shared * STEP_S >= max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shorter)
    if not enough.any():
        raise ValueError("at no offset do scans and force log overlap enough: their gaps are long")
    likeness = np.where(enough, r, 0.0).clip(0.0, 1 - 1e-12)
    score = -0.5 * shared * np.log1p(-(likeness**2))
    best = int(np.argmax(score))
    if likeness[best] < MIN_CORRELATION:
        raise ValueError(
            f"fit at no offset: the best correlation is {likeness[best]:.2f}, less than "
            f"{MIN_CORRELATION:g}: are scans and force log of the same session?"
        )
    _check_unique(r, score, best)
    lag = best + _vertex(score, best) - (y.size - 1)
    return Alignment(
        offset_s=float(time_s[0] - log.time_s[0] + lag * STEP_S),
        correlation=float(r[best]),
        overlap_s=float(shared[best] * STEP_S),
    )


def _check(time_s: Float, rises: Float) -> None:
    if time_s.ndim != 1 or time_s.shape != rises.shape:
        raise ValueError(
            f"scan_time_s has shape {time_s.shape}, rise {rises.shape}: they must be (n,) both"
        )
    if time_s.size < MIN_SAMPLES:
        raise ValueError(f"{time_s.size} scans are too few: {MIN_SAMPLES} are needed")
    for name, values in (("scan_time_s", time_s), ("rise", rises)):
        bad = ~np.isfinite(values)
        if bad.any():
            raise ValueError(f"{name} of scan {int(np.argmax(bad))} is not finite: leave it out")
    back = np.diff(time_s) <= 0
    if back.any():
        raise ValueError(f"scan_time_s does not increase at scan {int(np.argmax(back)) + 1}")


def _edges(time_s: Float, values: Float, name: str) -> tuple[Float, NDArray[np.bool_]]:
    """Edges on a grid that begins with `time_s`, 0 in gaps; and where there is no gap."""
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
    inside = known.copy()
    inside[1:] &= known[:-1]
    inside[:-1] &= known[1:]
    inside[[0, -1]] = False
    return np.where(inside, np.gradient(smooth, STEP_S), 0.0), inside


def _correlations(
    x: Float, in_x: NDArray[np.bool_], y: Float, in_y: NDArray[np.bool_]
) -> tuple[Float, Float]:
    """r and n of all lags, the first being 1 - Y; r is 0 where either does not vary."""
    mask_x, mask_y = in_x.astype(np.float64), in_y.astype(np.float64)
    # Without their means first, the differences below would lose digits.
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
    # Below this share of all its edges a stretch holds none, only the rounding of the FFT.
    varies = (square_x > 1e-9 * np.sum(x * x)) & (square_y > 1e-9 * np.sum(y * y))
    squares = np.where(varies, square_x * square_y, 1.0)
    return np.where(varies, product / np.sqrt(squares), 0.0).clip(-1.0, 1.0), shared


def _check_unique(r: Float, score: Float, best: int) -> None:
    """Raise ValueError where a peak beside the best one, which ends at half its r, is as good."""
    low = np.flatnonzero(r < 0.5 * r[best])
    end = int(np.searchsorted(low, best))
    first = int(low[end - 1]) if end else 0
    last = int(low[end]) if end < low.size else r.size
    others = score.copy()
    others[first:last] = 0.0
    second = int(np.argmax(others))
    if others[second] > MAX_SECOND * score[best]:
        raise ValueError(
            f"an offset {abs(second - best) * STEP_S:.2f} s away fits nearly as well, with "
            f"correlation {r[second]:.2f} for {r[best]:.2f}: the presses repeat so evenly, or are "
            "so few, that none tells the time: press at irregular intervals, and begin and end "
            "both recordings with the skin untouched"
        )


def _vertex(score: Float, best: int) -> float:
    """Where the parabola through the maximum and its neighbours is highest, -0.5 to 0.5."""
    if not 0 < best < score.size - 1:
        return 0.0
    before, peak, after = score[best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0
