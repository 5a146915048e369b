# SPDX-License-Identifier: Apache-2.0
"""Frames of a region: its cells alone are fitted, the others stay as the last whole frame has them.

Symbols are those of `sparse_fit`, but for S. The k cells of the region are also its ports, by the
same numbers. The skin of the last whole frame takes the place of the untouched one, with cells g0
and ports rho0. So d = exp(x) - g0 may be negative:

    v = (1 + M_kk diag(d))^-1 H_kk ,   rho = rho0 - sum_k H d v ,   d rho / d g_e = -v_e^2 .

Gauss-Newton steps on x minimise (I_read - I)^T S^-1 (I_read - I) and the prior of the cells, that
of whole frames. S [S^2] is the covariance of I_read by noise of readings, by the wires, and by what
the last whole frame left open of the cells outside, or has changed since: these are noise here.

A whole frame takes milliseconds, and a frame of a region about a tenth of that: a region may be
read a thousand times a second.
"""

from typing import Final, TypeAlias

import numpy as np
from scipy.linalg import lapack

from ohmskin.arrays import Float
from ohmskin.circuit.small import cholesky, gram, solve_lower, solve_positive
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.port_partial import STALE_SHARE
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import LEFT_OUT_STDS, MAX_CHI2, MAX_STEP_LOG, CellPrior
from ohmskin.estimate.sparse_fit import NO_CELLS, Cells, RestNetwork, Touched, TouchedNetwork
from ohmskin.estimate.wire_belief import LARGE_MOVE_LOG, WireBelief, without_means

# Most steps of a frame; one that needs more is fitted as a whole. Chosen: a frame begins at the
# frame before, and after a hard touch most steps are as long as `MAX_STEP_LOG` lets them.
MOST_STEPS: Final = 9


class WholeFrame:
    """What has been shown so far, for regions of the frames that come: g0 and its deviations."""

    def __init__(
        self, prior: CellPrior, belief: WireBelief, ref_ohm: float, answer: "Answer"
    ) -> None:
        about = prior.about(belief.means)
        is_soft = about.is_soft(answer.log_cells, belief.shape)
        self.prior, self.belief = about.for_soft_touches() if is_soft else about, belief
        self.log_cells, self.log_cells_std = answer.log_cells, answer.log_cells_std
        self.own_log_std, self.by_means = answer.own_log_std, answer.by_means
        if isinstance(answer, RegionFit):
            self.log_cells_std, self.own_log_std = answer.fitted_std, answer.fitted_own_std
        self.misfit, self.surprise = answer.misfit, answer.surprise
        self.series_ohm = ref_ohm + belief.leads_of_ports @ belief.lead_ohm(belief.means)
        self.net = belief.circuit(answer.log_cells, belief.means, RestNetwork)
        self.untouched = TouchedNetwork(self.net, NO_CELLS, np.zeros(0))


class RegionFit:
    """Fits frames of one region, one after the other.

    log_cells, log_cells_std: of all cells, those outside as in the whole frame, (RC,).
    own_log_std, by_means: as those of a `FullFit`.
    modelled: port currents of the model, (RC,) [S]; outside of the region, those that are kept.
    iterations: steps of the last frame.
    misfit, surprise: of the whole frame, because a frame that does not fit gets no answer here.
    age: for how many frames the cells outside have not been read, this one included.
    fitted_std, fitted_own_std: log_cells_std and own_log_std without what cells outside may have
        changed by since, (RC,).
    """

    def __init__(self, whole: WholeFrame, region: Cells, age: int = 0) -> None:
        self.region, self._whole, net = region, whole, whole.net
        self.misfit: float = whole.misfit
        self.surprise: float = whole.surprise
        self.log_cells: Float = whole.log_cells
        self.by_means: Float = whole.by_means
        self.fitted_std: Float = whole.log_cells_std
        self.fitted_own_std: Float = whole.own_log_std
        self.log_cells_std: Float = self.fitted_std
        self.own_log_std: Float = self.fitted_own_std
        self._x = -whole.log_cells[region]
        self._before = net.cell_siemens[region]
        self._port_volt = net.port_volt[region[:, None], region]
        self._cell_volt = net.cell_volt[region[:, None], region]
        self._rho = net.port_ohm[region]
        self._eye = np.eye(region.size)
        self._right = np.empty((region.size, region.size + 1), order="F")
        by_cell, by_wires = whole.untouched.slopes(region, whole.prior, whole.belief, region)
        self._series_ohm = whole.series_ohm[region]
        square = ((self._rho + self._series_ohm) ** -2.0)[:, None]
        self._by_wires = square * by_wires
        by_cell *= square
        # S, but for readings: with the last whole frame, and what comes to it with age squared.
        self._by_age = STALE_SHARE**2 * gram(by_cell)
        by_cell *= whole.log_cells_std
        self._model_covariance = gram(np.hstack([self._by_wires, by_cell]))
        self.age = age

    def fit(self, ports: PortReadings) -> bool:
        """Fit this frame. Returns whether the fit explains it.

        Only then are all attributes those of this frame.
        """
        region, whole, x = self.region, self._whole, self._x
        self.age += 1
        measured = ports.current.ravel()[region]
        reading_variance = ports.current_std.ravel()[region] ** 2
        system = self._model_covariance + self.age**2 * self._by_age
        system.ravel(order="F")[:: region.size + 1] += reading_variance
        factor = cholesky(system)
        for self.iterations in range(1, MOST_STEPS + 1):
            siemens = np.exp(x)
            added = siemens - self._before
            # LAPACK's code, the last, is 0: as every cell conducts, the determinant is above 0.
            _, _, volt, _ = lapack.dgesv(self._eye + self._cell_volt * added, self._port_volt)
            rho = self._rho - added @ (self._port_volt * volt)
            current = 1.0 / (rho + self._series_ohm)
            # The slopes by each cell, and the residual, whitened.
            self._right[:, :-1] = (volt * volt).T * siemens * (current * current)[:, None]
            self._right[:, -1] = measured - current
            whitened = solve_lower(factor, self._right)
            by_cell, residual = whitened[:, :-1], whitened[:, -1]
            centre, variance = whole.prior.normal(-x, region)
            system = by_cell.T @ by_cell
            system.ravel()[:: region.size + 1] += 1.0 / variance
            move = solve_positive(system, residual @ by_cell - (x + centre) / variance)
            is_last = (move**4 * system.diagonal()).max() < LEFT_OUT_STDS**2
            move = np.minimum(np.maximum(move, -MAX_STEP_LOG), MAX_STEP_LOG)  # faster than np.clip
            x = x + move
            if is_last:
                break
        residual = residual - by_cell @ move
        self._x = x
        # Written so that NaN is rejected, too.
        if not is_last or not residual @ residual <= MAX_CHI2 * region.size:
            return False
        whitened_means = solve_lower(factor, self._by_wires[:, -whole.belief.means.size :])
        covariance = solve_positive(system, self._eye.copy(order="F"))
        self._answer(covariance, covariance @ (by_cell.T @ whitened_means))
        # The most probable noise, as in `FullFit.modelled`: the variance times S^-1 r.
        noise = reading_variance * solve_lower(factor, residual, transposed=True)
        self.modelled = ports.current.ravel().copy()
        self.modelled[region] -= noise
        return True

    def _answer(self, covariance: Float, by_means: Float) -> None:
        """Logs of all cells, from the covariance of those of the region, (k, k) and (k, means)."""
        whole, region = self._whole, self.region
        self.log_cells = whole.log_cells.copy()
        self.log_cells[region] = -self._x
        self.fitted_std = whole.log_cells_std.copy()
        self.fitted_std[region] = np.sqrt(covariance.diagonal())
        # A cell outside changes by the same share as the current of a port that is not read.
        self.log_cells_std = np.hypot(self.fitted_std, STALE_SHARE * self.age)
        self.log_cells_std[region] = self.fitted_std[region]
        self.fitted_own_std, self.by_means = whole.own_log_std.copy(), whole.by_means.copy()
        of_region = without_means(self.fitted_std[region], by_means[:, :3], whole.belief)
        self.fitted_own_std[region], self.by_means[region] = of_region
        self.own_log_std = np.hypot(self.fitted_own_std, STALE_SHARE * self.age)
        self.own_log_std[region] = self.fitted_own_std[region]

    def keep_others(self, fit: FullFit) -> None:
        """Let cells outside of the region stay, in the fit of a whole frame, as they were.

        The fit may move them: by that much, too, they are uncertain then.
        """
        whole, others = self._whole, np.ones(fit.log_cells.size, dtype=bool)
        others[self.region] = False
        moved = np.abs(fit.log_cells - whole.log_cells)[others]
        stale = np.hypot(moved, STALE_SHARE * self.age)
        for name in ("log_cells_std", "own_log_std"):
            std, before = getattr(fit, name), np.hypot(getattr(whole, name)[others], stale)
            std[others] = np.maximum(std[others], before)
        fit.log_cells = np.where(others, whole.log_cells, fit.log_cells)

    def has_left(self) -> bool:
        """Whether the fitted cells have moved too far from g0 for S."""
        moved = self.log_cells[self.region] - self._whole.log_cells[self.region]
        return bool(np.abs(moved).max() > LARGE_MOVE_LOG)


# What is known of the cells after a frame.
Answer: TypeAlias = FullFit | Touched | RegionFit
