# SPDX-License-Identifier: Apache-2.0
"""One frame's fit of all resistances: what `joint` minimises, and how certain the answer is.

Symbols

====== ============== ============================================================= ==========
symbol shape          meaning                                                       unit
====== ============== ============================================================= ==========
n                     number of means: the logs of the mean segment of each layer,
                      the mean lead and what each line's differs from it by, two
                      leaks if there are any, and what each segment differs from
                      its mean by, if that is learned (`wire_belief`)
x      (RC + n,)      log resistances of cells, and the means                       log ohm,
                                                                                    ohm, 1, uS
m      (RC + n,)      what the prior expects of x                                   as x
P      (RC+n, RC+n)   covariance of the prior
u      (RC + n,)      deviations from the prior: x = m + P^1/2 u                    1
y, h   (RC,)          measured and modelled port currents per Vdd, over their noise 1
J      (RC, RC + n)   dh / du                                                       1
W      (RC, k)        dh / dw times s, where w are the logs of those k segments     1
                      that matter (`LEAST_SEGMENT_STDS`), and s the deviation of
                      each from its mean; 0 if x has that
N      (RC, RC)       covariance of y by its noise and by W: by all that x lacks    1
S      (RC, RC)       covariance of y by all that is not certain, N + J J^T         1
O      (RC, RC + n)   J whitened: L^-1 J, with L L^T = S                            1
====== ============== ============================================================= ==========

Minimised is (y - h)^T N^-1 (y - h) + |u|^2. The prior of the cells has tails, and P is that of a
normal: so P of the cells is made anew for these tails at every step (`CellPrior.normal`). What each
segment differs by from its mean is small. So it is not in x until it is learned, but is taken for
noise, N = 1 + W W^T; after the fit, W^T S^-1 (y - h(u) + J u) is the most probable value of it,
over s. The steps are those of Gauss-Newton in the space of the readings (Tarantola 2005, eq. 3.51),

    u' = J^T S^-1 (y - h(u) + J u) ,   S = J J^T + N ,

and the posterior covariance of u is 1 - J^T S^-1 J = 1 - O^T O. To make J, N and S takes most of
the time. So each step is first tried with those of the step before. They are made anew only if it
is not the last one (`FullFit._is_last`). N only weighs readings, so it is kept for longer.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.small import cholesky, gram, gram_factor, solve, solve_lower
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    HIDDEN_LOG,
    LEFT_OUT_STDS,
    MAX_ITERATIONS,
    MAX_STEP_LOG,
    TOUCHED_STDS,
    UNLIMITED_STD,
    CellPrior,
)
from ohmskin.estimate.wire_belief import Lesson, WireBelief, without_means

# Most fits take fewer steps. Later ones are shortened where they go back and forth (`_damped`).
USUAL_ITERATIONS: Final = 12
# At least this share of a step is taken. Chosen: so that a fit that has been slow goes on.
LEAST_SHARE: Final = 0.1
# A fit ends after `USUAL_ITERATIONS` if its chi-square per port is larger than this: no skin gives
# these readings, and on large skins each step takes long. Chosen: in the tests, 140 of 16,400 fits
# had a larger one after 12 steps, and none of them converged.
HOPELESS_MISFIT: Final = 100.0
# A step is not the last one if a log resistance would have moved by more since J was made. Chosen:
# slopes, and so deviations, are off by some 15 %.
OLD_LOG: Final = 0.15
# A step is not the last one if the log of a deviation in J would change by more (`_is_last`).
# Chosen: then it changes by half as much again.
FOLLOWS_LOG: Final = 0.4
# N is made anew if a log resistance may have moved by more since. Chosen: N only weighs readings.
OLD_NOISE_LOG: Final = 0.5
# A segment matters if what it differs from its mean by may move a reading by more deviations of
# this reading's noise. Chosen: most segments carry next to no current, and all that do not matter
# add 1 % to the variance of a reading.
LEAST_SEGMENT_STDS: Final = 0.05
# Skins of at most so many cells have all segments in W. Chosen: to find out which matter takes
# longer there than it saves.
SMALL_CELLS: Final = 128
# What explains a frame better by less does not count (`FullFit.gains_of_shorts`). Chosen: half of a
# normal residual gains as much by chance.
LEAST_PULL: Final = 2.0
# Limits of a cell's log resistance [log ohm].
_LEAST_LOG_OHM, _MOST_LOG_OHM = -np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS)


class FullFit:
    """One frame's fit.

    log_cells: log resistances of the cells, (RC,) [log ohm].
    log_cells_std: their posterior deviation, (RC,).
    own_log_std: the part of it that does not come from the means of the layers and leads, (RC,).
    by_means: how much these logs follow the means of the top and of the bottom layer [log ohm], and
        the mean lead [ohm], up or down, (RC, 3).
    means: those of the wires (`wire_belief`), (n,).
    wires: logs of the segments, then the leads [ohm], (2RC + R+C,).
    iterations: steps taken.
    message: why it did not converge, or empty.
    """

    def __init__(
        self,
        prior: CellPrior,
        belief: WireBelief,
        ref_ohm: float,
        ports: PortReadings,
        start: Float,
        *,
        holds_wires: bool = False,
    ) -> None:
        """Minimise from these log resistances of the cells, `start` (RC,).

        ref_ohm: both references in series [ohm].
        holds_wires: the means stay as they are believed: only cells are fitted.
        """
        self._prior, self._belief, self._ref_ohm = prior, belief, ref_ohm
        self._current, self._weight = ports.current.ravel(), 1.0 / ports.current_std.ravel()
        self._holds_wires, self.iterations, self.message = holds_wires, 0, ""
        self.log_cells: Float = start
        self._mean_stds = np.zeros(len(belief.means))  # u of the means
        # The most that a log resistance can have moved since J was made.
        self._moved_log = 0.0
        self._moved_since_noise = np.inf  # since N was made
        self._evaluate()
        self._minimise()
        self._conclude()
        # Now: a lesson would move the belief.
        self.means: Float = self._belief.means_off(self._mean_stds)
        self.wires: Float = self._find_wires()

    def _evaluate(self) -> None:
        """The circuit at the present state."""
        self._means = self._belief.means_off(self._mean_stds)
        self._circuit = self._belief.circuit(self.log_cells, self._means, PortCircuit)
        leads_ohm = self._belief.leads_of_ports @ self._belief.lead_ohm(self._means)
        # A step may make the mean lead negative. Half of the references is far below what any port
        # has in series, and keeps the current finite.
        series_ohm = np.maximum(self._ref_ohm + leads_ohm, 0.5 * self._ref_ohm)
        self._modelled = 1.0 / (self._circuit.port_ohm + series_ohm)
        self._residual = (self._current - self._modelled) * self._weight
        self._prior = self._prior.about(self._means)
        self._centre, self._variance = self._prior.normal(self.log_cells)

    def _weighted(self, slopes: Float) -> Float:
        """Slopes of h from those of rho, (RC, ...), which are overwritten.

        h = weight / (rho + series): rho is the port resistance, series the references and leads. So
        dh / d rho is -weight times the modelled current squared.
        """
        slopes *= (-self._weight * self._modelled**2)[:, None]
        return slopes

    def _linearise(self) -> None:
        """Make J, N and S for the present state."""
        self._moved_log = 0.0
        wants_noise = self._moved_since_noise > OLD_NOISE_LOG
        wants_all = wants_noise and self._weight.size <= SMALL_CELLS
        wants_all |= self._belief.learns_segments
        by_wires = self._circuit.by_wires() if wants_all else self._circuit.by_layers()
        by_leaks = 1e-6 * self._circuit.by_leaks() if self._belief.has_leaks else None  # by uS
        direct = self._belief.by_means(by_wires, self._means, by_leaks=by_leaks)
        self._by_cell = self._weighted(self._circuit.by_cell())
        # Cells at rest follow the means of the wires.
        by_rest = self._by_cell @ self._prior.by_means
        self._by_mean = self._weighted(direct) + by_rest
        if wants_noise:
            self._make_noise(by_wires if wants_all else None)
        moving = np.zeros_like(self._by_mean) if self._holds_wires else self._by_mean
        self._per_mean_std = self._belief.per_mean_std(moving)
        self._cell_std = np.sqrt(self._variance)
        cells = self._cell_std.size
        self._slopes = slopes = np.empty((cells, cells + self._mean_stds.size))  # J
        np.multiply(self._by_cell, self._cell_std, out=slopes[:, :cells])
        slopes[:, cells:] = self._per_mean_std
        self._factor = gram_factor(slopes, self._noise)  # L

    def _make_noise(self, by_wires: Float | None) -> None:
        """Make N, and W without s, for the present state.

        by_wires: slopes of rho by all segments, (RC, 2RC), which are overwritten; None: W is made
            of those that matter.
        """
        self._moved_since_noise = 0.0
        own_std = self._belief.unlearned_std
        self._segments: NDArray[np.intp] | slice = slice(None)
        if by_wires is None:
            most = self._circuit.most_by_wires(self._weight * self._modelled**2)
            self._segments = np.flatnonzero(own_std * most > LEAST_SEGMENT_STDS)
            by_wires = self._circuit.by_wires(self._segments)
        self._by_segment = self._weighted(by_wires)
        self._noise = np.eye(self._weight.size, order="F")
        if own_std and self._by_segment.size:
            self._noise = gram(own_std * self._by_segment, self._noise)

    def _minimise(self) -> None:
        """Take steps until one leaves out next to nothing (`_is_last`).

        Each step is first tried with J and S of the step before. From `USUAL_ITERATIONS` on,
        steps that turn back are shortened. The circuit is not evaluated after the last move: the
        residual, `modelled`, `misfit` and `wires` are as the last step has forecast them.
        """
        self._linearise()
        step, is_last = self._step()
        before, share = np.zeros_like(step), 1.0
        while self.iterations < MAX_ITERATIONS:
            self.iterations += 1
            if self.iterations >= USUAL_ITERATIONS:
                share = _damped(step, before, share)
            self._move(step if is_last else share * step)
            if is_last:
                self._residual = self._residual - self._slopes @ step
                return
            before = step
            self._evaluate()
            is_last = False
            if self._moved_log < OLD_LOG:  # else `_is_last` would say no
                step, is_last = self._step()
            if not is_last:
                self._linearise()
                step, is_last = self._step()
            if self.iterations >= USUAL_ITERATIONS and self.misfit > HOPELESS_MISFIT:
                break
        self.message = f"not converged in {self.iterations} iterations"

    def _step(self) -> tuple[Float, bool]:
        """The step u' - u, and whether no further step would matter after it (`_is_last`).

        The columns of J are per deviation that the cells had at the last linearisation. The prior
        of the cells, a normal that follows the tail (`CellPrior.normal`), is that of the present
        state: the slope of its -log p is (x - centre) / present variance. So that the step has this
        slope in it, u of a cell is the slope times the older deviation.
        """
        cell_stds = (self.log_cells - self._centre) * self._cell_std / self._variance
        present = np.concatenate([cell_stds, self._mean_stds])
        # S^-1 (y - h + J u), over the noise's deviation.
        self._probable_noise = solve(self._factor, self._residual + self._slopes @ present)
        step = np.asarray(self._probable_noise @ self._slopes - present)
        return step, self._is_last(step)

    def _is_last(self, step: Float) -> bool:
        """Whether no further step would matter after this one.

        What it leaves out must be less than `LEFT_OUT_STDS`: the move of the readings times that of
        logs since J was made. J must not become older than `OLD_LOG`. And J has the deviations of
        normals that stand for the priors of cells. As these follow the tail, the step would change
        them, but by no more than `FOLLOWS_LOG`.
        """
        cells_step = self._cell_std * step[: self.log_cells.size]
        from_rest = self.log_cells - self._centre + cells_step
        variance_ratio = np.maximum(self._prior.std**2, from_rest * from_rest) / self._cell_std**2
        if max(variance_ratio.max(), 1.0 / variance_ratio.min()) > math.exp(2.0 * FOLLOWS_LOG):
            return False
        layers_step = (self._belief.means_off(step[cells_step.size :]) - self._belief.means)[:2]
        moved_log = self._moved_log + max(np.abs(cells_step).max(), np.abs(layers_step).max())
        left_out_stds = moved_log * np.abs(self._slopes @ step).max()
        return bool(moved_log < OLD_LOG and left_out_stds < LEFT_OUT_STDS)

    def _move(self, step: Float) -> None:
        """Take a step; less of it if a log resistance would move by more than `MAX_STEP_LOG`."""
        step, stds_step = step[: self.log_cells.size], step[self.log_cells.size :]
        means_step = self._belief.means_off(stds_step) - self._belief.means
        # A cell that would leave its limits goes to the limit, and does not shorten the whole step.
        log_cells = self.log_cells + self._cell_std * step + self._prior.by_means @ means_step
        logs_step = np.minimum(np.maximum(log_cells, _LEAST_LOG_OHM), _MOST_LOG_OHM)
        logs_step -= self.log_cells
        most = max(np.abs(logs_step).max(), np.abs(means_step[:2]).max(), 1e-9)
        share = min(1.0, MAX_STEP_LOG / most)
        self._moved_log += share * most
        self._moved_since_noise += share * most
        self.log_cells = self.log_cells + share * logs_step
        self._mean_stds = self._mean_stds + share * stds_step

    def _find_wires(self) -> Float:
        """`wires`, (2RC + R+C,): their means, and how much segments differ from these.

        In the fit, these differences were noise of covariance W W^T. In a residual whose whole
        covariance is S, the most probable differences, over s, are W^T S^-1 times the residual.
        """
        own_std = self._belief.unlearned_std
        segments_stds = np.zeros(2 * self._weight.size)
        segments_stds[self._segments] = own_std * (self._probable_noise @ self._by_segment)
        self._wires_square = float(segments_stds @ segments_stds)
        return self._belief.wires_off(self._mean_stds, own_std * segments_stds)

    @property
    def modelled(self) -> Float:
        """Port currents of the model, (RC,) [S], with each wire as `wires` has it.

        The noise of the readings has the covariance 1. So, by the rule of `wires`, the most
        probable noise is S^-1 times the residual. The model is the measured current less this
        noise.
        """
        return self._current - self._probable_noise / self._weight

    @property
    def misfit(self) -> float:
        """Chi-square per port: the mean square of the most probable noise of the readings."""
        return float(self._probable_noise @ self._probable_noise) / self._current.size

    @property
    def surprise(self) -> float:
        """Chi-square over what this model expects of it: about 1 or less if the model holds.

        If v = S^-1 (y - h + J u), the most probable noise of covariance N is N v, and its
        chi-square is v^T N v. As the residual has the covariance S, that is expected to be the
        trace of S^-1 N, which is that of 1 - O O^T: the number of readings that cells and means
        leave free. Where these are free to explain the readings, that is much less than the number
        of ports, and the misfit alone does not show whether the model holds.
        """
        return (self.misfit * self._current.size + self._wires_square) / self._free

    def _conclude(self) -> None:
        """Posterior deviations of the cells by the last J and S: log_cells_std and its parts.

        With c the deviation of a cell's prior, that of its posterior is c (1 - l)^1/2. (c is that
        of the normal in use: for a touched cell, its distance from rest.) l is the cell's diagonal
        element of O^T O, the share of c^2 that the readings have removed. The fit is linear: it
        finds O^T O times the true u. So a mean that is truly one deviation off moves the fitted u
        of a cell by the element (cell, mean) of O^T O: its part of the cell's deviation is c times
        that. The u of the means are independent, so the parts of the first two are added as
        variances. (Two things are left out: that cells at rest follow the means besides, and that
        each u moves all means after its own.)

        This holds for cells whose prior can be believed. Cells that may be touched unnoticed
        (`_find_unnoticed`) get a wider deviation c' instead of c. The fit itself stays as it is. S
        grows by these cells: with H the columns of O of these cells, each times
        (c'^2 / c^2 - 1)^1/2, it becomes S' = L (1 + H H^T) L^T. So their neighbours, which are in
        the same readings, become less certain, too (Woodbury):

            J^T S'^-1 J = O^T O - O^T H (1 + H^T H)^-1 H^T O .

        The last term is `correction`^T `correction`. After it, the columns of J of these cells grow
        by c' / c.
        """
        cell_std, cells = self._cell_std, slice(self._cell_std.size)
        whitened = solve_lower(self._factor, self._slopes)
        learned = np.einsum("ij,ij->j", whitened, whitened)
        self._free: float = max(self._current.size - float(learned.sum()), 1e-9)
        learned = learned[cells]
        # O^T O of cells, and of layers and the mean lead.
        shared = slice(cell_std.size, cell_std.size + 3)
        with_means = whitened[:, cells].T @ whitened[:, shared]
        self._unnoticed, unnoticed_std = self._find_unnoticed(learned)
        if self._unnoticed.any():
            wider = np.where(self._unnoticed, unnoticed_std / cell_std, 1.0)
            added = np.sqrt(wider[self._unnoticed] ** 2 - 1.0)  # (c'^2 / c^2 - 1)^1/2
            coupling = (whitened[:, cells][:, self._unnoticed] * added).T @ whitened  # H^T O
            system = np.eye(len(added)) + coupling[:, cells][:, self._unnoticed] * added
            correction = solve_lower(cholesky(system), coupling)
            learned = learned - np.einsum("ij,ij->j", correction, correction)[cells]
            with_means -= correction[:, cells].T @ correction[:, shared]
            learned = wider**2 * learned
            with_means *= wider[:, None]
            cell_std = wider * cell_std
        self.log_cells_std: Float = cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))
        by_means_std = cell_std[:, None] * with_means
        parts = without_means(self.log_cells_std, by_means_std, self._belief)
        self.own_log_std, self.by_means = parts

    def _find_unnoticed(self, learned: Float) -> tuple[NDArray[np.bool_], Float]:
        """Which cells may be touched although the prior holds them at rest; and c', both (RC,).

        A cell counts as at rest if the fit leaves it within one deviation of rest: there the prior
        is the narrow normal, and not its tail. Such a cell may be touched all the same. Where much
        else conducts beside it, the touch hardly changes the readings, but it may still be large
        for the cell.

        learned: l, the share of the prior's variance that the readings have removed, (RC,).
        """
        prior = self._prior
        fitted_log = prior.expected - self.log_cells  # rise of the log conductance in the fit
        at_rest = np.abs(fitted_log) < prior.std
        # What do the readings alone say of the cell? The fit is the product of two normals, that of
        # the prior and that of the readings. So it has moved the cell by l times the rise that the
        # readings show, and the variance of this rise is c^2 (1 - l) / l.
        share = np.maximum(learned, 1e-9)
        rise_log = fitted_log / share
        rise_std = prior.std * np.sqrt(np.maximum(1 - learned, 1e-12) / share)
        if prior.is_crowded(self.log_cells):
            # Between many touched cells, a cell at rest carries hardly any of the current. That it
            # is at rest is then said by the prior alone, and there may be any force on it.
            unnoticed, rise_log = at_rest, np.maximum(rise_log, UNLIMITED_STD)
        else:
            # A touch may be unnoticed under two conditions: the rise that the readings show, with
            # two deviations more, would matter; and this rise is larger than its deviation, and so
            # not mere noise.
            unnoticed = at_rest & (rise_log + 2 * rise_std > HIDDEN_LOG) & (rise_log > rise_std)
        # c' reaches from rest to the rise that the readings show, and one deviation of the rise
        # further. Where the readings show next to nothing of the cell, c' is very wide.
        unnoticed_std = rise_log + rise_std
        # No cell gets a narrower deviation than it had.
        return unnoticed & (unnoticed_std > self._cell_std), unnoticed_std

    def cells_by_means(self) -> Float:
        """How fitted cells follow the means, for the same readings, (RC, n): d log r / d mean."""
        return self._cells_by(self._by_mean, self._by_cell)

    def cells_by_leaks(self) -> Float:
        """How they follow the leaks between neighbouring rows, and columns, (RC, 2) [1/uS].

        The slopes are those of cells that are all alike. A cell that resists more than others also
        follows leaks more: with slopes at the fitted cells, how cells differ by themselves would
        look like leaks.
        """
        alike = np.full_like(self.log_cells, self.log_cells.mean())
        circuit = self._belief.circuit(alike, self._means, PortCircuit)
        by_leaks = self._weighted(1e-6 * circuit.by_leaks())
        return self._cells_by(by_leaks, self._weighted(circuit.by_cell()))

    def _cells_by(self, slopes: Float, by_cell: Float) -> Float:
        """How cells follow something else, for the same readings, (RC, k).

        slopes, by_cell: dh by this, (RC, k), and by the log resistances of cells, (RC, RC).

        The residual changes by -`slopes`. Only the cells follow, to keep h as it is, as far as
        their prior lets them. With J the columns of the cells alone, their u change by
        -J^T (N + J J^T)^-1 `slopes`.
        """
        by_cell = by_cell * self._cell_std
        factor = gram_factor(by_cell, self._noise)
        return -self._cell_std[:, None] * (by_cell.T @ solve(factor, slopes))

    def gains_of_shorts(self, first: NDArray[np.intp], short_ohm: float) -> Float:
        """How much better shorts explain the frame (`staying_faults`).

        first, short_ohm: as `PortCircuit.shorted_port_ohm` has them, (k,).
        Returns the gains in twice the log likelihood, (k,).
        """
        changed_ohm = (
            self._circuit.shorted_port_ohm(first, short_ohm) - self._circuit.port_ohm[:, None]
        )
        modelled = self._modelled[:, None]
        return self._gains((1 / (1 / modelled + changed_ohm) - modelled) * self._weight[:, None])

    def gains_of_yarns(self) -> Float:
        """How much better a broken yarn of each line explains the frame, (R+C,): as for shorts."""
        return self._gains(self._weighted(self._circuit.by_lines()))

    def _gains(self, changes: Float) -> Float:
        """How much better the frame is explained if h changes so, (k,), from (RC, k).

        It is not worked out where the residual pulls the other way, or hardly at all: a gain is no
        more than this pull.
        """
        pull = np.asarray(2 * self._probable_noise @ changes)
        some = pull > LEAST_PULL
        whitened = solve_lower(self._factor, changes[:, some])
        gains = np.minimum(pull, 0.0)
        gains[some] = pull[some] - np.einsum("ij,ij->j", whitened, whitened)
        return gains

    @property
    def lesson(self) -> Lesson:
        """What the readings say of the means, however hard the touches are."""
        # The belief takes the residual at its own means, and not at those that the fit has found.
        residual = self._residual + self._per_mean_std @ self._mean_stds
        # A touched cell is noise of nearly any size; a cell at rest is known to its drift.
        touched = np.abs(self._prior.rise_stds(self.log_cells)) > TOUCHED_STDS
        cell_std = np.where(self._unnoticed | touched, UNLIMITED_STD, self._prior.std)
        odd_leads = self._weighted(self._belief.odd_lead_ohm() * self._belief.leads_of_ports)
        unlike = np.hstack([self._by_cell * cell_std, odd_leads])
        factor = gram_factor(unlike, self._noise)
        return Lesson(self._per_mean_std, residual, factor)


def _damped(step: Float, before: Float, share: float) -> float:
    """The share of a step to take, if `share` of the step before was taken.

    Along the step before, this step is r times as long (`turned`). If steps change linearly from
    place to place, there is a place where they are 0: after the share `share` / (1 - r) of this
    step. Where wires and cells can explain the same readings, whole steps would go back and forth
    for ever, with r of -1 and less.
    """
    square = before @ before
    turned = float(step @ before) / max(float(square), 1e-12)
    return min(1.0, max(LEAST_SHARE, share / max(1.0 - turned, 1e-12)))
