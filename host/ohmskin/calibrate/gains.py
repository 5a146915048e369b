# SPDX-License-Identifier: Apache-2.0
"""The gains of cells whose presses are too few for a curve of their own.

All cells share a curve f from what a cell shows to the force on it. Each has a gain of its own:

    F = (1 + g) f + noise ,   g ~ N(0, t^2) ,   noise ~ N(0, s^2) .

Symbols, for n rows of N presses on C cells

====== ======= ============================================================ ======
symbol shape   meaning                                                      unit
====== ======= ============================================================ ======
F, f   (n,)    force; the curve                                             N
m      ()      rows of a press, n / N. They are alike, and count as one     1
ff     (C,)    sum of f^2 / m over the rows of a cell                       N^2
fr     (C,)    sum of f (F - f) / m over them                               N^2
rr     ()      sum of (F - f)^2 / m over all rows                           N^2
s      ()      scatter of a press about the curve times the gain            N
t      ()      scatter of the gains                                         1
q      ()      (t / s)^2                                                    N^-2
====== ======= ============================================================ ======

The most probable gain of a cell, and its variance, are

    g = q fr / (1 + q ff) ,   t^2 / (1 + q ff) .

So a cell that nobody pressed has the gain 0 +- t. The most probable s and t minimise

    N log s^2 + sum of log(1 + q ff) + R / s^2 + k (log t^2 + GAIN_STD^2 / t^2) ,

    R = rr - sum of q fr^2 / (1 + q ff) ,   k = GAIN_CELLS .

The last term is what is expected of gains before any press: an inverse gamma distribution of t^2.
For each q, the best s is known, so q alone is searched:

    s^2 = (R + k GAIN_STD^2 / q) / (N + k) .
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.totals import GAIN_CELLS, GAIN_STD

# A gain is at least this. Chosen: no cell of a skin conducts ten times as much as the others.
LEAST_GAIN: Final = 0.1
# s is at least this share of the largest force, times t. Chosen: far below what any force sensor
# resolves.
LEAST_SCATTER: Final = 1e-6


class Gains(NamedTuple):
    """gain: 1 + g, (C,). std: its deviation, (C,). scatter_n: s [N].

    held_out_rmse: root mean square error of each cell's presses, (C,) [N], each of which is
        foreseen by the gain that the other presses of its cell tell; of a cell that has none, that
        of all presses, foreseen without a gain.
    """

    gain: Float
    std: Float
    scatter_n: float
    held_out_rmse: Float


def find_gains(
    press: NDArray[np.intp],
    cell: NDArray[np.intp],
    force_n: Float,
    curve_n: Float,
    held_out_n: Float,
    cells: int,
) -> Gains:
    """The gains of so many cells, by rows (n,).

    press, cell: number of its press, and flat index of its cell.
    force_n, curve_n: F and f.
    held_out_n: f of a curve that was fitted without this cell.
    """
    from scipy.optimize import minimize_scalar

    _, first, of_row = np.unique(press, return_index=True, return_inverse=True)
    presses, of_press = first.size, cell[first]

    def sums(values: Float) -> tuple[Float, Float]:
        """Of each press, and of each cell, over m."""
        by_press = np.asarray(np.bincount(of_row, values) * (presses / of_row.size))
        return by_press, np.asarray(np.bincount(of_press, by_press, cells), np.float64)

    off_n = force_n - curve_n
    (_, ff), (_, fr), (rr, _) = map(sums, (curve_n**2, curve_n * off_n, off_n**2))

    def scatter(q: float) -> float:
        """s."""
        square = rr.sum() - np.sum(q * fr**2 / (1 + q * ff)) + GAIN_CELLS * GAIN_STD**2 / q
        return float(np.sqrt(square / (presses + GAIN_CELLS)))

    def unlikely(log_q: float) -> float:
        """What s and t minimise, but for a constant."""
        q = float(np.exp(log_q))
        of_s = 2 * (presses + GAIN_CELLS) * np.log(scatter(q))
        return float(of_s + np.log1p(q * ff).sum() + GAIN_CELLS * log_q)

    # From presses that tell nothing of a gain, to presses that tell all.
    bounds = tuple(2 * np.log(np.array([1e-3, 1 / LEAST_SCATTER]) / force_n.max()))
    q = float(np.exp(minimize_scalar(unlikely, bounds=bounds, method="bounded").x))
    s = scatter(q)
    gain = np.maximum(1 + q * fr / (1 + q * ff), LEAST_GAIN)
    # Each press is taken out of what its cell tells.
    error_n = force_n - held_out_n
    (f_ff, c_ff), (f_fr, c_fr) = map(sums, (held_out_n**2, held_out_n * error_n))
    others = q * (c_fr[of_press] - f_fr) / (1 + q * (c_ff[of_press] - f_ff))
    left_n = error_n - others[of_row] * held_out_n
    rows, square = np.bincount(cell, minlength=cells), np.bincount(cell, left_n**2, cells)
    mean_square = np.where(rows > 0, square / np.maximum(rows, 1), np.mean(error_n**2))
    return Gains(gain, s * np.sqrt(q / (1 + q * ff)), s, np.sqrt(mean_square))
