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
h, t     (n, C)   half the width of a contact's hysteresis, a log of x; where in it a   1
                  cell is: 1 if its force grows, -1 if it falls
v, M     (n,)     force on a cell that is pressed too little to be seen; number of      N, 1
                  cells that seem untouched, beside touched ones
g, e     (C,)     log of each cell's gain about the curve of k and b; its exponent about b  1
P        (n, C)   force on each cell                                                    N
w        (2,)     change of a top and of a bottom segment, as a share of those of x     1
S                 the scale's filter (`scale`): (n,) to (m,); its delay is learned here
z        (q,)     zero of the scale at times `KNOT_S` apart; B (m, q) is straight       N
                  between them
y, r     (m,)     what the scale shows; y - S sum(P) - B z                              N
s0, s1            scatter of y at no force; its share of the total force                N, 1
======== ======== ===================================================================== ==========

    P = exp(k + g) (x' exp(h t) / x0)^(b + e) ,    1 / x' = 1 / x - c / x1 ,
    y = S (sum(P) + v M) + B z + scatter ,
    variance of y = s0^2 + s1^2 ((S sum P)^2 + F0^2) where the skin is pressed, F0 = max / 2 .

F0 is large because some errors are as large in newtons at a small force as at a large one: those of
cells that have not come back yet from the press before. The fit is least squares (Gauss-Newton)
with these priors: gains scatter by `GAIN_STD` about the curve of all cells, which the fit corrects
by the scatter that it sees; b is near `EXPONENT`; the zero changes by about `ZERO_STEP_N` from knot
to knot; w is what was told of the wires. x is that of the wires that are held in a trial, so the
fit has no w in it, and is asked for w after it (`TotalFit.wires`).

A fingertip covers some ten cells, so sums tell little of how gains of neighbours differ. That the
forces under a fingertip are smooth tells more of it (`smoothness`): g and e follow that, too. Not
while wires are looked for, which came out no better with it.

All rows of one press have nearly the same error. So they count as `PRESS_ROWS` rows together, and a
press is kept or left out as a whole. In the first rounds, only the presses that fit best count, and
the gains of cells may hardly differ. After these, all presses count but those that are off by more
than `OUTLIER_STDS` robust deviations. The force of such a press does not go through the skin: a
finger is beside it, or a hand on the plate. Of presses that stay, the farther one is off, the less
it counts, as if errors were those of Student's t. A hard press whose cells are estimated wrong
would else be explained by other wires: one of 240 that was off by 18 % made them 40 % too large.

Three things bend the curve in the same way as wires do: a resistance that no force lowers (c);
hysteresis (h), because the largest force of each press comes while the force grows; and force on
cells that are pressed too little to be seen (v), because that is a larger share of a small force.
Without h and v, wires come out 20 to 50 % too large. Hysteresis also looks like a scale that shows
forces too early, so the delay of the scale is found together with h. Errors of presses look like
wires, too. So while wires are looked for, all rows of a press count as one (`WIRE_PRESS_ROWS`).

Whoever reads forces later does not know t. So the curves that are kept are those of t = 0, and b h
is added to their scatter. A calibration holds power laws: it gets those that are off from the
curves by the fewest newtons.

In the sum, the errors of single cells partly cancel, so one cell's force is wrong by a larger share
than the sum is. If each cell is wrong by the share s1 of its own force, and all by chance, the sum
is off by r with r^2 = s1^2 sum(P^2). The s1 of this equation is the `residual_share` of the model.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.rules import MIN_PRESSES
from ohmskin.calibrate.scale import EARLIEST_S, Scale, fit_scale
from ohmskin.calibrate.smoothness import Smoothness, peaks, smoothness
from ohmskin.calibrate.tables import gaps
from ohmskin.force.curve import MAX_EXPONENT, MIN_EXPONENT, POWER, ForceModel

# Standard deviation of the log gains of cells, before any press. Chosen: cells of one skin scatter
# by some ten percent, and by more where it is knitted by hand.
GAIN_STD: Final = 0.25
# The same in the first rounds, when nobody knows yet which presses are beside the skin. Chosen: so
# small that the gains of cells with few presses do not follow presses beside the skin.
FIRST_GAIN_STD: Final = 0.05
# `GAIN_STD` counts as much as so many cells of the skin, when the fit makes a scatter of both.
GAIN_CELLS: Final = 4.0
# Exponent b, of force by rise, and its standard deviation: contacts conduct by F^1 to F^2.
EXPONENT, EXPONENT_STD = 0.67, 0.3
# Standard deviation of e, of cells' exponents about b. Chosen: as those of single presses.
BEND_STD: Final = 0.02
# c before any press. Chosen: 350 ohm at 140 microsiemens, a hard x1 of fingertips.
SERIES: Final = 0.05
# t goes from -1 to 1 while log x rises by this. Chosen: the noise of a pressed cell is less.
TURN_LOG: Final = 0.1
# Standard deviations of k, b, c, h and v [N] before any press. Chosen: k is free, half of the cells
# have no series resistance to speak of, and 0.1 N on one cell is seen.
FIRST_STD: Final = (10.0, EXPONENT_STD, 0.1, 0.1, 0.1)
# Least and most of b, c, h. Chosen: only a fit that goes astray gets there. c and h may be below 0,
# because a limit at 0 would pull the parameters that go with them; their priors keep them near 0.
LIMITS: Final = ((MIN_EXPONENT, -0.4, -0.2), (MAX_EXPONENT, 0.8, 0.2))
# In one step, the delay of the scale changes by about the first number. Its slopes are differences
# over the second [s].
DELAY_STD_S, DELAY_STEP_S = 0.1, 0.005
# The power law of the model is fitted from the first share of the largest rise up to that rise,
# which is the second quantile of all. Chosen: from a tenth of the force on; what is above the
# largest rise is not known.
LEAST_RISE, MOST_RISE_QUANTILE = 0.03, 0.999
# x1 is this quantile of all rises.
HARD_QUANTILE: Final = 0.99
# x / x' is at least this. Chosen: far below what contacts have; x' must stay above 0.
LEAST_OF_SERIES: Final = 0.1
# The zero is found at times so far apart [s], and changes by about so much from one to the next
# [N]. Chosen: a load cell that warms up drifts by a gram in seconds.
KNOT_S, ZERO_STEP_N = 15.0, 0.05
# There are so many of these times at most: those of an hour. In a longer recording they are farther
# apart, so that a clock that jumps does not fill the memory.
MOST_KNOTS: Final = 240
# The rows of a press count as so many rows together: usually, and while wires are looked for.
# Chosen: a press goes from no force to its highest and back; the module says why wires take one.
PRESS_ROWS, WIRE_PRESS_ROWS = 4.0, 1.0
# Rows so many scans before and after a press are neither of the press nor of a pause. Chosen: there
# the model takes forces for straight between scans, which those of a finger are not.
NEAR_SCANS: Final = 2
# F0 as a share of the largest total force. Chosen: the module says why it is large.
FLOOR_SHARE: Final = 0.5
# A press that is off by more robust standard deviations is left out. Chosen: by chance, one normal
# error of 16,000 is larger, and presses are not quite normal.
OUTLIER_STDS: Final = 4.0
# In the first rounds only this share of the presses counts: those that fit best. Chosen: fewer
# presses are beside the skin.
SURE_SHARE: Final = 0.7
# Errors of presses scatter as Student's t of so many degrees of freedom. Chosen: the usual number
# for errors that are normal but for a few.
FREEDOM: Final = 4.0
# So often is the width of Student's t corrected. Chosen: it changes by less than 1 % then.
WIDTH_ROUNDS: Final = 20
# A press is never left out that is off by less than this share, or by less than this force [N].
LEAST_OFF: Final = 0.15
LEAST_OFF_N: Final = 0.15
# Rounds of the fit: first only the surest presses count, then outliers alone are left out. The
# filter of the scale is fitted before the rounds of these numbers.
ROBUST_ROUNDS, TRIMMED_ROUNDS = 5, 8
SCALE_ROUNDS: Final = (0, 3)
# A cell has no gain of its own if the standard deviation of its log gain is still above this share
# of what it was before the presses. Chosen: its presses have told half of the variance.
POOLED_SHARE: Final = 0.7
# Cells whose forces scatter by more than this share follow no curve.
MOST_SHARE: Final = 0.7
STRANGE: Final = "the total force does not follow the skin: is this its scale, and its rest?"
# A median of |r| is so much of a normal standard deviation.
_MEDIAN_STD: Final = 0.6745


class Totals(NamedTuple):
    """What a skin and the scale under it have shown.

    shape: (R, C) of the skin.
    time_s: time of each scan, (n,) [s].
    rise: x, (n, C).
    press: number of the press that each scan is of, (n,); below 0: it is of none.
    margin: M, (n,).
    shown_s: when the scale has shown its numbers, (m,) [s].
    shown_n: these numbers, (m,) [N].
    lags: whether the scale has a filter, a zero and a drift, which are to be found; else each
        number is the force at its time.
    """

    shape: tuple[int, int]
    time_s: Float
    rise: Float
    press: NDArray[np.intp]
    margin: Float
    shown_s: Float
    shown_n: Float
    lags: bool = True


class TotalFit:
    """The fit of the module's equations.

    scale: the scale's filter; None: it is found. for_wires: whether wires are looked for. After
    `fit`: `scale_`; `covariance_` of k, b, c, h, v, g, e, z and the delay; `largest_n`, the largest
    force of all cells together [N].
    """

    def __init__(
        self, totals: Totals, scale: Scale | None = None, *, for_wires: bool = False
    ) -> None:
        self._totals, self._for_wires, self._seeks_scale = totals, for_wires, scale is None
        cells = totals.rise.shape[1]
        self.scale_ = scale or Scale()
        self._on = (totals.rise > 0) & (totals.press >= 0)[:, None]
        check_weighed(np.unique(totals.press[self._on.any(axis=1)]).size)
        self._unit = float(np.exp(np.mean(np.log(totals.rise[self._on]))))  # x0
        self._hard = float(np.quantile(totals.rise[self._on], HARD_QUANTILE))
        self._log_x = np.log(np.where(self._on, totals.rise, self._unit) / self._unit)
        self._set_zero()
        self._turn = _turns(self._log_x, self._on)
        sizes = (5, cells, cells, self._basis.shape[1], int(totals.lags))
        ends = np.cumsum(sizes).tolist()
        parts = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        # p: k, b, c, h, v; g; e; z; delay
        self._of_gains, self._of_bends, self._of_zero, self._of_delay = parts[1:]
        self._p = np.zeros(ends[-1])
        self._p[1:3] = EXPONENT, SERIES
        self._gain_std = FIRST_GAIN_STD
        self._group()
        check_weighed(int(np.count_nonzero(self._is_press)))
        self._out: Bool = np.zeros(self._groups, dtype=bool)
        self._trust: Float = np.ones(self._groups)

    def _set_zero(self) -> None:
        """B, and the precision of z."""
        totals = self._totals
        if not totals.lags:
            self._basis, self._zero_precision = np.zeros((totals.shown_n.size, 0)), np.zeros((0, 0))
            return
        first_s, last_s = totals.shown_s[[0, -1]]
        steps = min((last_s - first_s) / KNOT_S, MOST_KNOTS)
        knots_s = np.linspace(first_s, last_s, 2 + int(steps))
        hats = [np.interp(totals.shown_s, knots_s, one) for one in np.eye(knots_s.size)]
        self._basis = np.transpose(hats)
        steps = np.diff(np.eye(knots_s.size), axis=0) / ZERO_STEP_N
        self._zero_precision = steps.T @ steps + 1e-6 * np.eye(knots_s.size)

    def _group(self) -> None:
        """Which press, or pause between presses, each row is of, after the scale's lag.

        Both end at a gap of the scans.
        """
        totals = self._totals
        ends = np.diff(totals.press) != 0
        if totals.lags:
            ends |= gaps(totals.time_s)
        number = np.concatenate([[0], np.cumsum(ends)])
        scan = np.searchsorted(totals.time_s, totals.shown_s - self.scale_.lag_s)
        scan = scan.clip(0, totals.time_s.size - 1)
        self._of_scan, self._of_row, self._groups = number, number[scan], int(number[-1]) + 1
        pressed = totals.press >= 0
        near = np.convolve(pressed, np.ones(2 * NEAR_SCANS + 1), "same") > 0
        self._pressed, self._ends = pressed[scan], near[scan] & ~pressed[scan]
        is_weighed = np.bincount(self._of_row, minlength=self._groups) > 0
        self._is_press = is_weighed & (np.bincount(number, pressed) > 0)

    def _contact(self) -> tuple[Float, Float, Float]:
        """log(x' / x0), and its slopes by log x and by c, each (n, C)."""
        u = np.exp(self._log_x) * self._unit / self._hard
        steeper = 1 / self._loss(u)
        return self._log_x + np.log(steeper) + self._p[3] * self._turn, steeper, u * steeper

    def _loss(self, u: Float) -> Float:
        """x / x' of rises u = x / x1."""
        return np.asarray(np.maximum(1 - self._p[2] * u, LEAST_OF_SERIES))

    def _parts(self, log_contact: Float) -> Float:
        """P (n, C)."""
        p = self._p
        b = p[1] + p[self._of_bends]
        return np.where(self._on, np.exp(p[0] + p[self._of_gains] + b * log_contact), 0.0)

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
        shown_spread_n, spread_n = spreads
        if not (shown_spread_n > 0 and spread_n > 0):
            raise ValueError(STRANGE)
        self._p[0] = np.log(shown_spread_n / spread_n)
        for number in range(ROBUST_ROUNDS + TRIMMED_ROUNDS):
            if totals.lags and self._seeks_scale and number in SCALE_ROUNDS:
                self._fit_scale()
            self._step()
            self._judge(trims=number >= ROBUST_ROUNDS)
        if not self.presses or not (self._for_wires or self.residual_share() < MOST_SHARE):
            raise ValueError(STRANGE)
        return self

    def _fit_scale(self) -> None:
        totals = self._totals
        weight = 1.0 * ~self._out[self._of_row]
        force_n = self._parts(self._contact()[0]).sum(axis=1) + self._p[4] * totals.margin
        shown_n = totals.shown_n - self._basis @ self._p[self._of_zero]
        self._take_scale(fit_scale(totals.time_s, force_n, totals.shown_s, shown_n, weight))

    def _take_scale(self, scale: Scale) -> None:
        self.scale_, self._p[self._of_delay] = scale, scale.delay_s
        self._group()

    def _step(self) -> None:
        """One step of Gauss-Newton."""
        precision, pull = self._equations(self._jacobian(), *self._prior())
        if not self._for_wires and (smooth := self._smoothness()):
            of_both = slice(self._of_gains.start, self._of_bends.stop)
            precision[of_both, of_both] += smooth.precision
            pull[of_both] += smooth.pull
        step = np.linalg.solve(precision, pull)
        farthest = np.abs(step[: self._of_zero.start]).max()
        p = self._p = self._p + step * min(1.0, 1.0 / farthest)
        p[1:4] = p[1:4].clip(*LIMITS)
        self.covariance_ = np.linalg.inv(precision)
        if self._totals.lags:
            self._take_scale(replace(self.scale_, delay_s=max(float(p[-1]), EARLIEST_S)))

    def _equations(self, jacobian: Float, precision: Float, pull: Float) -> tuple[Float, Float]:
        """These priors, with what the rows add to them; sets `off_n_`."""
        self.off_n_ = self._totals.shown_n - self.total_n_ - self._basis @ self._p[self._of_zero]
        weighted = jacobian * self._weights()[:, None]
        return precision + weighted.T @ jacobian, pull + weighted.T @ self.off_n_

    def _smoothness(self) -> Smoothness | None:
        """What the presses that are kept tell of gains and exponents by being smooth."""
        log_contact = self._contact()[0]
        forces = self._parts(log_contact)
        kept = np.where(self._out[self._of_scan], -1, self._totals.press)
        scans = peaks(forces, kept)
        return smoothness(forces[scans], log_contact[scans], self._totals.shape)

    def _jacobian(self) -> Float:
        """How what the scale shows follows p, (m, p); sets `total_n_`, what it is to show."""
        totals, b, v = self._totals, self._p[1] + self._p[self._of_bends], self._p[4]
        log_contact, _, by_series = self._contact()
        parts = self._parts(log_contact)
        slopes = [np.ones_like(parts), log_contact, b * by_series, b * self._turn]
        columns = [(parts * slope).sum(axis=1) for slope in slopes]
        shown = self._shown(np.column_stack([*columns, totals.margin, parts, parts * log_contact]))
        self.total_n_ = shown[:, 0] + v * shown[:, 4]
        by_delay = np.zeros((totals.shown_n.size, 0))
        if totals.lags:
            total_n = (columns[0] + v * totals.margin)[:, None]
            around_s = totals.shown_s + DELAY_STEP_S * np.array([[-1.0], [1.0]])
            around_n = self.scale_.shown(totals.time_s, total_n, around_s.ravel())
            by_delay = -np.diff(around_n.reshape(2, -1), axis=0).T / (2 * DELAY_STEP_S)
        return np.hstack([shown, self._basis, by_delay])

    def _weights(self) -> Float:
        """What each row weighs, (m,) [1/N^2], by how far rows are off now."""
        off_n, total_n, kept = np.abs(self.off_n_), self.total_n_, ~self._out[self._of_row]
        self._floor_n = FLOOR_SHARE * float(total_n.max())
        size_n = np.hypot(total_n, self._floor_n)
        pressed, still = kept & self._pressed, kept & ~(self._pressed | self._ends)
        s1 = _robust_std(off_n[pressed] / size_n[pressed], 0.005)
        s0 = _robust_std(off_n[still], 0.005) if still.sum() > 10 else 0.005
        moves = self._pressed | self._ends | (total_n > s0)
        variance = s0**2 + np.where(moves, (s1 * size_n) ** 2, 0.0)
        rows = np.bincount(self._of_row, minlength=self._groups)[self._of_row]
        press_rows = WIRE_PRESS_ROWS if self._for_wires else PRESS_ROWS
        share = np.where(self._pressed, np.minimum(1.0, press_rows / rows), 1.0)
        return np.asarray(kept * share * self._trust[self._of_row] / variance)

    def _prior(self) -> tuple[Float, Float]:
        """Precision of p, and its pull."""
        p = self._p
        centre, std = np.zeros(p.size), np.full(p.size, self._gain_std)
        centre[:3], std[:5] = (p[0], EXPONENT, SERIES), FIRST_STD
        std[self._of_bends] = BEND_STD
        centre[self._of_delay], std[self._of_delay] = p[self._of_delay], DELAY_STD_S
        precision = np.diag(std**-2.0)
        precision[self._of_zero, self._of_zero] = self._zero_precision
        return precision, precision @ (centre - p)

    def _judge(self, *, trims: bool) -> None:
        """Decide what counts in the next round, and how much, by how far each press is off.

        trims: leave out outliers alone, and let the gains of cells scatter as far as they do; else
            keep only the presses that fit best.
        """
        size_n = np.where(self._ends, 0.0, self.total_n_ + self._floor_n)
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
            if not presses.any():
                raise ValueError(STRANGE)
            most = np.quantile(stds[presses], SURE_SHARE)
            self._out = stds > np.where(self._is_press, most, OUTLIER_STDS)
            return
        trust = (FREEDOM + 1) / (FREEDOM + stds**2)
        self._trust = np.where(self._is_press, trust, 1.0)
        least_n = np.maximum(LEAST_OFF_N, LEAST_OFF * force_n)
        self._out = (stds > OUTLIER_STDS) & (off > least_n)
        parts = self._parts(self._contact()[0])
        self.largest_n = float(parts.sum(axis=1).max())
        self._largest_part_n = float(parts.max())
        gains = self._of_gains
        square = np.sum(self._p[gains] ** 2 + self.covariance_.diagonal()[gains])
        cells = GAIN_CELLS + self._totals.rise.shape[1]
        self._gain_std = float(np.sqrt((GAIN_CELLS * GAIN_STD**2 + square) / cells))

    # ------------------------------------------------------------------------------ the answer

    def wires(self, slopes: Float, centre: Float, std: Float) -> tuple[Float, Float]:
        """The change w of the wires that fits best, (k,), and its covariance, (k, k).

        slopes: how the rises follow the wires, d log x / dw, (k, n, C).
        centre, std: the prior of w, (k,).

        It is one step of Gauss-Newton of p and w together. More steps would follow the slopes to
        wires for which they do not hold.
        """
        from scipy.linalg import block_diag

        log_contact, steeper, _ = self._contact()
        b = self._p[1] + self._p[self._of_bends]
        forces = np.sum(self._parts(log_contact) * b * steeper * slopes, axis=2)
        precision, pull = self._prior()
        of_wires = std**-2.0
        precision, pull = self._equations(
            np.hstack([self._shown(forces.T), self._jacobian()]),
            block_diag(np.diag(of_wires), precision),
            np.concatenate([of_wires * centre, pull]),
        )
        covariance = np.asarray(np.linalg.inv(precision)[: std.size, : std.size])
        return np.asarray(np.linalg.solve(precision, pull)[: std.size]), covariance

    @property
    def presses(self) -> int:
        """How many presses were learned from."""
        return int(np.count_nonzero(self._is_press & ~self._out))

    @property
    def presses_left_out(self) -> int:
        """How many presses were not; `left_out` has pauses, too."""
        return int(np.count_nonzero(self._is_press & self._out))

    @property
    def left_out(self) -> list[tuple[float, float]]:
        """From when to when a press, or force where nothing is pressed, was left out [s]."""
        time_s, out = self._totals.time_s, np.flatnonzero(self._out)
        first = np.searchsorted(self._of_scan, out)
        last = np.searchsorted(self._of_scan, out, "right") - 1
        return list(zip(time_s[first].tolist(), time_s[last].tolist(), strict=True))

    def gain_std(self) -> Float:
        """Standard deviation of the log of each cell's gain, (C,)."""
        return np.asarray(np.sqrt(self.covariance_.diagonal()[self._of_gains]))

    def model(self) -> ForceModel:
        """The curves of all cells: power laws as near to those of the fit as there are."""
        p, shape = self._p, self._totals.shape
        level, steeper = self._straight()
        by_exponent = level - steeper * np.log(self._unit)
        # log(slope) = k + g + (b + e) by_exponent, exponent = (b + e) steeper
        of_law = np.array([[1.0, by_exponent, 1.0, by_exponent], [0.0, steeper, 0.0, steeper]])
        gains, bends = np.arange(p.size)[self._of_gains], np.arange(p.size)[self._of_bends]
        chosen = np.stack(np.broadcast_arrays(0, 1, gains, bends), axis=-1)
        log_slope, exponent = of_law @ p[chosen].T
        covariance = self.covariance_[chosen[:, :, None], chosen[:, None, :]]
        (slope_var, both), (_, exponent_var) = np.moveaxis(of_law @ covariance @ of_law.T, 0, -1)
        share, slope = self.residual_share(), np.exp(log_slope)
        every = np.ones(shape)
        return ForceModel(
            kind=np.full(shape, POWER),
            slope=slope.reshape(shape),
            slope_std=(slope * np.sqrt(slope_var)).reshape(shape),
            exponent=exponent.clip(MIN_EXPONENT, MAX_EXPONENT).reshape(shape),
            exponent_std=np.sqrt(exponent_var).reshape(shape),
            correlation=(both / np.sqrt(slope_var * exponent_var)).clip(-1, 1).reshape(shape),
            residual_std=0.1 * share * self._largest_part_n * every,
            residual_share=share * every,
            pooled=(self.gain_std() > POOLED_SHARE * self._gain_std).reshape(shape),
            held_out_rmse=np.nan * every,
        )

    def _straight(self) -> tuple[float, float]:
        """Level and steepness of the line that is most like log(x' / x0) by log(x / x0)."""
        rises = self._totals.rise[self._on]
        top = float(np.quantile(rises, MOST_RISE_QUANTILE))
        x = top * np.geomspace(LEAST_RISE, 1.0, 50)
        log_contact = np.log(x / self._unit / self._loss(x / self._hard))
        # Shares of a force count by that force: so the law is off by few newtons.
        force = np.exp(self._p[1] * log_contact)
        steeper, level = np.polyfit(np.log(x / self._unit), log_contact, 1, w=force)
        return float(level), float(steeper)

    def misfit(self) -> float:
        """-log of how likely rows and p are, for each press, but for a constant. All presses count.

        Errors of rows, as shares of the force, scatter as Student's t, whose width fits them best.
        """
        rows = self._pressed
        square = (self.off_n_[rows] / np.hypot(self.total_n_[rows], self._floor_n)) ** 2
        weight = 1.0 / np.bincount(self._of_row, minlength=self._groups)[self._of_row[rows]]
        width = float(np.median(square))
        for _ in range(WIDTH_ROUNDS):
            pull = (FREEDOM + 1) / (FREEDOM + square / width)
            width = float(weight @ (pull * square) / weight.sum())
        unlikely = 0.5 * (np.log(width) + (FREEDOM + 1) * np.log1p(square / (FREEDOM * width)))
        precision, pull = self._prior()
        of_p = 0.5 * pull @ np.linalg.solve(precision, pull)
        gains = self._totals.rise.shape[1] * np.log(self._gain_std)
        return float((weight @ unlikely + of_p + gains) / weight.sum())

    def residual_share(self) -> float:
        """s1 of each cell, from how far sums are off."""
        parts = self._parts(self._contact()[0])
        root = np.sqrt((parts**2).sum(axis=1))[:, None]
        size_n = self._shown(root)[:, 0]
        good = self._pressed & ~self._out[self._of_row] & (size_n > 0.25 * size_n.max())
        by_play = self._p[1] * self._p[3]
        return float(np.sqrt(np.mean((self.off_n_[good] / size_n[good]) ** 2) + by_play**2))


def check_weighed(presses: int) -> None:
    """Raise ValueError where these are too few."""
    if presses < MIN_PRESSES:
        raise ValueError(f"fewer than {MIN_PRESSES} presses of the skin while it was weighed")


def _turns(log_x: Float, on: Bool) -> Float:
    """t of each cell, (n, C).

    It follows log x as a gear with play follows another one: it moves with log x between -1 and 1,
    and stays at these ends. A press begins with growing force, at 1.
    """
    turns, now = np.ones_like(log_x), np.ones(log_x.shape[1])
    steps = 2 / TURN_LOG * np.diff(log_x, axis=0)
    begins = ~(on[1:] & on[:-1])
    for n, step in enumerate(steps):
        now = np.where(begins[n], 1.0, (now + step).clip(-1.0, 1.0))
        turns[n + 1] = now
    return turns


def _robust_std(off: Float, least: float) -> float:
    """Standard deviation of errors (n,) by the median of their sizes; `least` at least."""
    return max(least, float(np.median(np.abs(off))) / _MEDIAN_STD) if off.size else least
