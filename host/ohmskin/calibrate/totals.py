# SPDX-License-Identifier: Apache-2.0
"""Learns the force curves of a skin from the total force on it, whatever presses it.

Symbols

======== ======== ===================================================================== ==========
symbol   shape    meaning                                                               unit
======== ======== ===================================================================== ==========
n, m, C           number of scans, of numbers that the scale shows, of cells
x        (n, C)   rise of a cell above rest, 0 where it is not pressed                  S, or 1
x0                a usual rise, so that k and b are nearly independent                  as x
k, b              log of the force at x0, and exponent, of all cells
c                 what lies in series with a contact, times a hard x1, the quantile     1
                  `HARD_QUANTILE` of all x; x' is the contact alone                     S, or 1
g        (C,)     log of each cell's gain about that
P        (n, C)   force on each cell                                                    N
w        (2,)     logs of a top and of a bottom segment, less those that x is of        1
S                 the scale's filter (`scale`): (n,) to (m,)
z        (q,)     zero of the scale at times `KNOT_S` apart; B (m, q) is straight       N
                  between them
y, r     (m,)     what the scale shows; y - S sum(P) - B z                              N
s0, s1            scatter of y at no force; its share of the force                      N, 1
======== ======== ===================================================================== ==========

    P = exp(k + g) (x' / x0)^b ,    1 / x' = 1 / x - c / x1 ,    y = S sum(P) + B z + scatter ,
    variance of y = s0^2 + s1^2 ((S sum P)^2 + F0^2) where the skin is pressed, F0 = max / 2 .

F0 is large, because what is wrong at little force, such as cells that have not come back yet, is as
large in newtons at any force. The fit is least squares (Gauss-Newton) with priors: gains have the
deviation `GAIN_STD` about one curve, which the fit corrects by what cells show; b is about
`EXPONENT`; the zero wanders by `ZERO_STEP_N` from knot to knot; w is what was told of the wires.

Errors of one press have few causes, so its rows count as `PRESS_ROWS` together, and it is kept or
left out as a whole: at first only those count that fit best, and cells hardly differ; then all but
those that are off by more than `OUTLIER_STDS` robust deviations. Such a press is one whose force
does not go through the skin: a finger beside it, a hand on the plate.

c is 0 but while the wires are looked for: what no force lowers bends the curve as wires do, and so
does hysteresis. Wires are learned with a row a press, because errors of presses look like them.

A cell's force is wrong by more than the sum, where errors average out. With r of the sum from s1 of
each cell, r^2 = s1^2 sum(P^2): this s1 is the `residual_share` of the model.
"""

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.rules import MIN_PRESSES
from ohmskin.calibrate.scale import Scale, fit_scale
from ohmskin.force.curve import LINEAR, MAX_EXPONENT, MIN_EXPONENT, POWER, ForceModel

# Prior deviation of log gains. Chosen: cells of one skin scatter by some ten percent, and knitted
# by hand by more.
GAIN_STD: Final = 0.25
# That while it is not known yet which presses are beside the skin. Chosen: so the gains of cells
# that few presses reach do not follow these.
FIRST_GAIN_STD: Final = 0.05
# That deviation counts as much as so many cells that show it.
GAIN_CELLS: Final = 4.0
# Exponent of F by x: contacts conduct by F^1 to F^2.
EXPONENT, EXPONENT_STD = 0.67, 0.3
# c: its prior, the deviation of that, and the most. Chosen: 350 ohm at 280 microsiemens.
SERIES, SERIES_STD, MOST_SERIES = 0.1, 0.1, 0.8
# x1 is this quantile of all rises.
HARD_QUANTILE: Final = 0.99
# A contact seems worse by its series by at most this factor.
LEAST_OF_SERIES: Final = 0.1
# The zero is known at times so far apart [s], and wanders by so much from one to the next [N].
# Chosen: a load cell that warms up drifts by a gram in seconds.
KNOT_S, ZERO_STEP_N = 15.0, 0.05
# The rows of a press count as so many; and while the wires are looked for. Chosen: from no force to
# its highest and back; see the module.
PRESS_ROWS, WIRE_PRESS_ROWS = 4.0, 1.0
# F0 as a share of the largest total. Chosen: see the module.
FLOOR_SHARE: Final = 0.5
# A press that is off by more robust standard deviations is left out. Chosen: by chance, one normal
# error of 16,000 is larger, and presses are not quite normal.
OUTLIER_STDS: Final = 4.0
# At first only this share of the presses counts: those that fit best.
SURE_SHARE: Final = 0.7
# A press is never left out that is off by less than this share, or by less than this force [N].
LEAST_OFF: Final = 0.15
LEAST_OFF_N: Final = 0.15
# Rounds of the fit: robust ones, then ones with outliers left out; the filter is fitted after some.
ROBUST_ROUNDS, TRIMMED_ROUNDS = 5, 5
SCALE_ROUNDS: Final = (0, 4, 7)
# A gain whose deviation is still so much of the prior's is not the cell's own.
POOLED_SHARE: Final = 0.7
# Cells whose forces scatter by more than this share follow no curve.
MOST_SHARE: Final = 0.7
# A median of |r| is so much of a normal standard deviation.
_MEDIAN_STD: Final = 0.6745


class Totals(NamedTuple):
    """What a skin and the scale under it have shown.

    time_s: of the scans, (n,) [s]. rise: x (n, C). press: number of the press that each scan is of,
    (n,), below 0: of none.
    shown_s, shown_n: when the scale has shown what, (m,) [s], [N]. lags: whether its filter, zero
    and drift are to be found; else it shows the force at its time.
    """

    time_s: Float
    rise: Float
    press: NDArray[np.intp]
    shown_s: Float
    shown_n: Float
    lags: bool = True


class WireSlopes(NamedTuple):
    """How the rises follow the wires: d log x / dw, (2, n, C); prior of w, centre and std (2,)."""

    slopes: Float
    centre: Float
    std: Float


class TotalFit:
    """The fit of the module's equations.

    scale: the scale's filter; None: it is found. After `fit`: `scale_`; `covariance_` of k, b, c,
    w, g, z.
    """

    def __init__(
        self, totals: Totals, wires: WireSlopes | None = None, scale: Scale | None = None
    ) -> None:
        self._totals, self._wires, self._seeks_scale = totals, wires, scale is None
        cells = totals.rise.shape[1]
        offsets = 0 if wires is None else wires.centre.size
        self.scale_ = scale or Scale()
        self._on = (totals.rise > 0) & (totals.press >= 0)[:, None]
        if np.unique(totals.press[self._on.any(axis=1)]).size < MIN_PRESSES:
            raise ValueError(f"fewer than {MIN_PRESSES} presses of the skin while it was weighed")
        self._unit = float(np.exp(np.mean(np.log(totals.rise[self._on]))))  # x0
        self._hard = float(np.quantile(totals.rise[self._on], HARD_QUANTILE))
        self._log_x = np.log(np.where(self._on, totals.rise, self._unit) / self._unit)
        self._set_zero()
        # p: k, b, c, w, g, z
        size = 3 + offsets + cells
        self._of_wires = slice(3, 3 + offsets)
        self._of_gains, self._of_zero = slice(3 + offsets, size), slice(size, None)
        self._p = np.zeros(size + self._basis.shape[1])
        self._p[1:3] = self._law = EXPONENT, SERIES if wires else 0.0
        self._gain_std = FIRST_GAIN_STD
        self._group()
        self._out: Bool = np.zeros(self._groups, dtype=bool)

    def _set_zero(self) -> None:
        """B, and the precision of z."""
        totals = self._totals
        if not totals.lags:
            self._basis, self._zero_precision = np.zeros((totals.shown_n.size, 0)), np.zeros((0, 0))
            return
        first_s, last_s = totals.shown_s[[0, -1]]
        knots_s = np.linspace(first_s, last_s, 2 + int((last_s - first_s) / KNOT_S))
        hats = [np.interp(totals.shown_s, knots_s, one) for one in np.eye(knots_s.size)]
        self._basis = np.transpose(hats)
        steps = np.diff(np.eye(knots_s.size), axis=0) / ZERO_STEP_N
        self._zero_precision = steps.T @ steps + 1e-6 * np.eye(knots_s.size)

    def _group(self) -> None:
        """Which press, or pause between presses, each row is of, after the scale's lag."""
        totals = self._totals
        number = np.cumsum(np.diff(totals.press, prepend=totals.press[0]) != 0)
        scan = np.searchsorted(totals.time_s, totals.shown_s - self.scale_.lag_s)
        scan = scan.clip(0, totals.time_s.size - 1)
        self._of_scan, self._of_row, self._groups = number, number[scan], int(number[-1]) + 1
        self._pressed = totals.press[scan] >= 0
        self._is_press = np.bincount(number, totals.press >= 0) > 0

    def _contact(self) -> tuple[Float, Float, Float]:
        """log(x' / x0), and its slopes by log x and by c, each (n, C)."""
        log_x = self._log_x
        if self._wires is not None:
            log_x = log_x + np.tensordot(self._p[self._of_wires], self._wires.slopes, 1)
        u = np.exp(log_x) * self._unit / self._hard
        steeper = 1 / np.maximum(1 - self._p[2] * u, LEAST_OF_SERIES)
        return log_x + np.log(steeper), steeper, u * steeper

    def _parts(self, log_contact: Float) -> Float:
        """P (n, C)."""
        k, b = self._p[:2]
        return np.where(self._on, np.exp(k + self._p[self._of_gains] + b * log_contact), 0.0)

    def _shown(self, forces: Float) -> Float:
        """S of forces (n, k): (m, k)."""
        totals = self._totals
        if not totals.lags:
            return forces
        return self.scale_.shown(totals.time_s, forces, totals.shown_s)

    def fit(self) -> "TotalFit":
        """Fit. Raises ValueError where the force does not follow the skin."""
        totals, parts = self._totals, self._parts(self._contact()[0]).sum(axis=1)
        shown = self._shown(parts[:, None])[:, 0]
        spreads = (np.quantile(n, 0.9) - np.quantile(n, 0.1) for n in (totals.shown_n, shown))
        self._p[0] = np.log(next(spreads) / next(spreads))
        for number in range(ROBUST_ROUNDS + TRIMMED_ROUNDS):
            if totals.lags and self._seeks_scale and number in SCALE_ROUNDS:
                self._fit_scale()
            self._step()
            self._judge(trims=number >= ROBUST_ROUNDS)
        if not self._residual_share() < MOST_SHARE:
            raise ValueError("the total force does not follow the skin: is this its scale?")
        return self

    def _fit_scale(self) -> None:
        totals = self._totals
        weight = 1.0 * ~self._out[self._of_row]
        force_n = self._parts(self._contact()[0]).sum(axis=1)
        shown_n = totals.shown_n - self._basis @ self._p[self._of_zero]
        self.scale_ = fit_scale(totals.time_s, force_n, totals.shown_s, shown_n, weight)
        self._group()

    def _step(self) -> None:
        """One step of Gauss-Newton."""
        log_contact, steeper, by_series = self._contact()
        parts, b = self._parts(log_contact), self._p[1]
        slopes = [np.ones_like(parts), log_contact, b * by_series]
        if self._wires is not None:
            slopes += list(b * steeper * self._wires.slopes)
        columns = [(parts * slope).sum(axis=1) for slope in slopes]
        jacobian = np.hstack([self._shown(np.column_stack([*columns, parts])), self._basis])
        self.total_n_ = jacobian[:, 0].copy()
        self.off_n_ = self._totals.shown_n - self.total_n_ - self._basis @ self._p[self._of_zero]
        weight = self._weights()
        precision, pull = self._prior()
        weighted = jacobian * weight[:, None]
        precision = precision + weighted.T @ jacobian
        step = np.linalg.solve(precision, weighted.T @ self.off_n_ + pull)
        farthest = np.abs(step[: self._of_zero.start]).max()
        self._p += step * min(1.0, 1.0 / farthest)
        self._p[1] = np.clip(self._p[1], MIN_EXPONENT, MAX_EXPONENT)
        self._p[2] = np.clip(self._p[2], 0.0, MOST_SERIES)
        self.covariance_ = np.linalg.inv(precision)

    def _weights(self) -> Float:
        """What each row weighs, (m,) [1/N^2], by how far rows are off now."""
        off_n, total_n, kept = np.abs(self.off_n_), self.total_n_, ~self._out[self._of_row]
        self._floor_n = FLOOR_SHARE * float(total_n.max())
        size_n = np.hypot(total_n, self._floor_n)
        pressed, still = kept & self._pressed, kept & ~self._pressed
        s1 = _robust_std(off_n[pressed] / size_n[pressed], 0.005)
        s0 = _robust_std(off_n[still], 0.005) if still.sum() > 10 else 0.005
        moves = self._pressed | (total_n > s0)
        variance = s0**2 + np.where(moves, (s1 * size_n) ** 2, 0.0)
        rows = np.bincount(self._of_row, minlength=self._groups)[self._of_row]
        press_rows = PRESS_ROWS if self._wires is None else WIRE_PRESS_ROWS
        share = np.where(self._pressed, np.minimum(1.0, press_rows / rows), 1.0)
        return np.asarray(kept * share / variance)

    def _prior(self) -> tuple[Float, Float]:
        """Precision of p, and its pull."""
        p = self._p
        centre, std = np.zeros(p.size), np.full(p.size, self._gain_std)
        centre[:3], std[:3] = (
            (p[0], *self._law),
            (10.0, EXPONENT_STD, SERIES_STD if self._wires else 1e-9),
        )
        if self._wires is not None:
            centre[self._of_wires], std[self._of_wires] = self._wires.centre, self._wires.std
        precision = np.diag(std**-2.0)
        precision[self._of_zero, self._of_zero] = self._zero_precision
        return precision, precision @ (centre - p)

    def _judge(self, *, trims: bool) -> None:
        """Leave out groups by how far each is off. trims: outliers alone; cells may differ then."""
        size_n = self.total_n_ + self._floor_n
        weight = np.bincount(self._of_row, size_n, self._groups) + 1e-12
        off_n = np.bincount(self._of_row, size_n * self.off_n_, self._groups) / weight
        force_n = np.bincount(self._of_row, size_n * self.total_n_, self._groups) / weight
        scale_n = np.hypot(force_n, np.where(self._is_press, self._floor_n, 0.0))
        seen, off = weight > 1e-9, np.abs(off_n)
        presses, pauses = seen & self._is_press, seen & ~self._is_press
        s1 = _robust_std(off[presses] / scale_n[presses], 0.01)
        s0 = _robust_std(off[pauses], 0.01) if pauses.sum() > 5 else 0.01
        stds = off / np.hypot(s0, np.where(self._is_press, s1 * scale_n, 0.0))
        if not trims:
            most = np.quantile(stds[presses], SURE_SHARE)
            self._out = stds > np.where(self._is_press, most, OUTLIER_STDS)
            return
        least_n = np.maximum(LEAST_OFF_N, LEAST_OFF * force_n)
        self._out = (stds > OUTLIER_STDS) & (off > least_n)
        self._largest_n = float(self._parts(self._contact()[0]).max())
        gains = self._of_gains
        square = np.sum(self._p[gains] ** 2 + self.covariance_.diagonal()[gains])
        cells = GAIN_CELLS + self._totals.rise.shape[1]
        self._gain_std = float(np.sqrt((GAIN_CELLS * GAIN_STD**2 + square) / cells))

    # ------------------------------------------------------------------------------ the answer

    @property
    def w(self) -> tuple[Float, Float]:
        """w and its standard deviations, (2,)."""
        of_wires = self._of_wires
        return self._p[of_wires], np.sqrt(self.covariance_.diagonal()[of_wires])

    @property
    def presses(self) -> int:
        """How many presses were learned from."""
        return int(np.count_nonzero(self._is_press & ~self._out))

    @property
    def left_out(self) -> list[tuple[float, float]]:
        """From when to when a press, or force where nothing is pressed, was left out [s]."""
        spans: list[tuple[float, float]] = []
        time_s, out = self._totals.time_s, self._out[self._of_scan]
        edges = np.flatnonzero(np.diff(np.where(out, self._of_scan, -1), prepend=-1, append=-1))
        for first, end in pairwise(edges.tolist()):
            if out[first]:
                spans.append((float(time_s[first]), float(time_s[end - 1])))
        return spans

    def gain_std(self) -> Float:
        """Standard deviation of the log of each cell's gain, (C,)."""
        return np.asarray(np.sqrt(self.covariance_.diagonal()[self._of_gains]))

    def model(self, shape: tuple[int, int]) -> ForceModel:
        """The curves of all cells."""
        k, b = self._p[:2]
        covariance, gains = self.covariance_, self._of_gains
        variance = covariance[0, 0] + covariance.diagonal()[gains] + 2 * covariance[0, gains]
        with_b, b_std = covariance[0, 1] + covariance[1, gains], float(np.sqrt(covariance[1, 1]))
        if abs(b - 1) < b_std:  # a line will do
            kind, b, b_std, with_b = LINEAR, 1.0, 0.0, 0 * with_b
        else:
            kind = POWER
        # a = exp(k + g) x0^-b, so d log(a) = d(k + g) - log(x0) db.
        log_unit = np.log(self._unit)
        slope = np.exp(k + self._p[self._of_gains] - b * log_unit)
        variance = variance - 2 * log_unit * with_b + (log_unit * b_std) ** 2
        slope_log_std = np.sqrt(np.maximum(variance, 1e-12))
        correlation = np.zeros_like(slope)
        if b_std:
            correlation = (with_b - log_unit * b_std**2) / (slope_log_std * b_std)
        share = self._residual_share()
        every = np.ones(shape)
        return ForceModel(
            kind=np.full(shape, kind),
            slope=slope.reshape(shape),
            slope_std=(slope * slope_log_std).reshape(shape),
            exponent=b * every,
            exponent_std=b_std * every,
            correlation=correlation.clip(-1, 1).reshape(shape),
            residual_std=0.1 * share * self._largest_n * every,
            residual_share=share * every,
            pooled=(self.gain_std() > POOLED_SHARE * self._gain_std).reshape(shape),
            held_out_rmse=np.nan * every,
        )

    def _residual_share(self) -> float:
        """s1 of each cell, from how far sums are off."""
        parts = self._parts(self._contact()[0])
        root = np.sqrt((parts**2).sum(axis=1))[:, None]
        size_n = self._shown(root)[:, 0]
        good = self._pressed & ~self._out[self._of_row] & (size_n > 0.25 * size_n.max())
        return float(np.sqrt(np.mean((self.off_n_[good] / size_n[good]) ** 2)))


def _robust_std(off: Float, least: float) -> float:
    """Standard deviation of what is off by so much, (n,), by its median; `least` at least."""
    return max(least, float(np.median(np.abs(off))) / _MEDIAN_STD) if off.size else least
