# SPDX-License-Identifier: Apache-2.0
"""Under one fingertip, forces of neighbouring cells differ smoothly: that tells their gains apart.

The total force alone tells little of how gains of neighbours differ. A fingertip covers some ten
cells, and gains that are too large and too small in a checkerboard change its total by nothing.
But press after press, a cell whose gain is too large stands out from its neighbours.

Symbols

====== ========= ==================================================================== =========
symbol shape     meaning                                                              unit
====== ========= ==================================================================== =========
k                number of cells about the hardest one of a press
u      (k,)      logs of the forces on these cells, with the gains as they are        1
W      (k,)      weight of a cell, less if its force is small: diagonal               1
Q      (k, <= 6) orthonormal columns that span W times the quadratics of place        1
g, e   (C,)      changes of the log gains of cells, and of their exponents            1
l      (k,)      log of the rise that an exponent belongs to                          1
s                scatter of a press about its quadratic                               1
a      (2C,)     what stands out for ever, though gain and exponent are right         1
====== ========= ==================================================================== =========

The log pressure of a fingertip is taken for a quadratic of place, of any shape and size, with the
scatter s. So each press is a row of the least squares for g and e, with what the quadratics leave:

    | (1 - Q Q^T) W (u + g + e l) |^2 / s^2 .

s is what the presses themselves show: s^2 is the median of all, and that of this press added to it.
Under a finger with edges, or under two, it is 0.1 to 0.3, and such presses tell little. Nor is a
skin on an uneven plate loaded evenly. So a has a deviation (`OWN_STDS`), however many presses there
are, and is eliminated: with N the sum of the rows above, and D the variances of a,

    N' = (N^-1 + D)^-1 .
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float

# Cells count that are so many rows and columns from the hardest one at most, and have at least this
# share of its force. Chosen: a fingertip is not wider; errors of weaker cells are as large as their
# forces.
REACH, LEAST_SHARE = 2, 0.05
# A cell that has this share of the hardest force has an error of its log that is larger by a
# factor of 1.4. Chosen: hysteresis and force that is not seen matter there.
SMALL_SHARE: Final = 0.1
# A press counts with so many cells or more: a quadratic explains six. As many such presses are
# needed: fewer show no scatter.
LEAST_CELLS: Final = 8
# Quadratics that differ by less than this share on the cells of a press are alike. Chosen: far
# above rounding; where cells tell six quadratics apart, it is 0.005 or more.
ALIKE_SHARE: Final = 1e-9
# Scans of a press count whose force is at least this share of its highest. Chosen: at lower forces,
# other cells seem to be the hardest ones.
LEAST_OF_PRESS: Final = 0.5
# s is not below this: what estimates and hysteresis leave of a log force. Chosen: at least half of
# what simulated fingertips show.
LEAST_SCATTER: Final = 0.01
# Deviations of a, for gains and for exponents. Chosen: gains, and so forces, are not taken for
# better than 2 %; an exponent that is off by 0.005 changes a force by 1 % over a factor of eight.
OWN_STDS: Final = (0.02, 0.005)


class Smoothness(NamedTuple):
    """What presses tell of g and e: precision N', (2C, 2C), and its pull, (2C,)."""

    precision: Float
    pull: Float


def peaks(force_n: Float, press: NDArray[np.intp]) -> NDArray[np.intp]:
    """The scans to look at: of each press, and each cell that is its hardest, the strongest one.

    force_n: force on each cell, (n, C) [N]. press: number of the press that each scan is of, (n,);
        below 0: of none.
    """
    total_n, hardest = force_n.sum(axis=1), force_n.argmax(axis=1)
    highest_n = np.zeros(press.max(initial=0) + 1)
    np.maximum.at(highest_n, press[press >= 0], total_n[press >= 0])
    scans = np.flatnonzero((press >= 0) & (total_n > LEAST_OF_PRESS * highest_n[press]))
    order = scans[np.lexsort((-total_n[scans], hardest[scans], press[scans]))]
    both = np.stack([press[order], hardest[order]])
    is_first = np.any(np.diff(both, prepend=-1) != 0, axis=0)
    return np.asarray(order[is_first])


def smoothness(force_n: Float, log_rise: Float, shape: tuple[int, int]) -> Smoothness | None:
    """What presses tell of gains and exponents. None: too few of them have enough cells.

    force_n: forces at `peaks`, by the present gains, (m, C) [N]; 0 where nothing is pressed.
    log_rise: l of the same scans, (m, C).
    shape: (R, C) of the skin.
    """
    near = np.arange(-REACH, REACH + 1)
    down, right = (one.ravel() for one in np.meshgrid(near, near, indexing="ij"))
    place = np.stack([np.ones(down.size), down, right, down**2, down * right, right**2], axis=-1)
    hardest_row, hardest_column = np.unravel_index(force_n.argmax(axis=1), shape)
    row, column = hardest_row[:, None] + down, hardest_column[:, None] + right
    is_inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    cell = np.where(is_inside, row * shape[1] + column, 0)
    share = np.take_along_axis(force_n, cell, 1) / force_n.max(axis=1, keepdims=True)
    counts = is_inside & (share > LEAST_SHARE)
    some = counts.sum(axis=1) >= LEAST_CELLS
    if np.count_nonzero(some) < LEAST_CELLS:
        return None
    cell, counts, share = cell[some], counts[some], np.where(counts, share, 1.0)[some]
    weight = counts / np.hypot(1.0, SMALL_SHARE / share)
    # Cells on two lines leave some quadratics alike: there, the columns that are left over point
    # wherever rounding does, and count for nothing.
    basis, size, _ = np.linalg.svd(weight[..., None] * place, full_matrices=False)
    spans = size > ALIKE_SHARE * size[:, :1]
    basis *= spans[:, None]
    # W (1 - Q Q^T) W of each press
    left = -np.einsum("mi,mik,mjk,mj->mij", weight, basis, basis, weight, optimize=True)
    np.einsum("mii->mi", left)[:] += weight**2
    pulled = np.einsum("mij,mj->mi", left, np.log(share))
    square = np.einsum("mi,mi->m", pulled, np.log(share)).clip(0.0)
    variance = square / (counts.sum(axis=1) - spans.sum(axis=1))
    per_variance = 1.0 / (max(np.median(variance), LEAST_SCATTER**2) + variance)
    steep = np.take_along_axis(log_rise[some], cell, 1)
    of_both = np.stack([np.ones_like(steep), steep])
    numbers = np.stack([cell, cell + force_n.shape[1]])
    precision = np.zeros((2 * force_n.shape[1],) * 2)
    np.add.at(
        precision,
        (numbers[:, None, :, :, None], numbers[None, :, :, None, :]),
        np.einsum("m,ami,mij,bmj->abmij", per_variance, of_both, left, of_both, optimize=True),
    )
    pull = np.zeros(len(precision))
    np.add.at(pull, numbers, -per_variance[:, None] * of_both * pulled)
    own = np.diag(np.repeat(OWN_STDS, force_n.shape[1]) ** -2.0)
    kept = np.linalg.solve(precision + own, own)  # (1 + D N)^-1
    return Smoothness(precision @ kept, pull @ kept)
