# SPDX-License-Identifier: Apache-2.0
"""One frame's fit of all 3RC resistances: what `joint` minimises, and what it says of the answer.

Symbols

====== =========== ============================================================== ==========
symbol shape       meaning                                                        unit
====== =========== ============================================================== ==========
x      (3RC,)      log resistances: cells, top wires, bottom wires                log ohm
m      (3RC,)      what the prior expects of x                                    log ohm
P      (3RC, 3RC)  covariance of the prior
y, h   (RC,)       measured and modelled port currents per Vdd, over their noise  1
J      (RC, 3RC)   dh / dx                                                        1
====== =========== ============================================================== ==========

Minimised is |y - h|^2 + (x - m)^T P^-1 (x - m), P of the cells re-weighted for the tails of their
prior at every step. The steps are Gauss-Newton's in the space of the readings (Tarantola 2005,
eq. 3.51),

    x' = m + P J^T (J P J^T + 1)^-1 (y - h(x) + J (x - m)),

and the posterior covariance is P - P J^T (J P J^T + 1)^-1 J P.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg

from ohmskin.circuit import Float, port_sensitivity
from ohmskin.estimators.base import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimators.prior import (
    DOUBT,
    HIDDEN,
    TOUCHED,
    UNLIMITED_STD,
    CellPrior,
    siemens_std,
)
from ohmskin.estimators.wires import LOG_LIMITS, Lesson, WireBelief

MAX_ITERATIONS: Final = 40
MAX_STEP: Final = 1.5  # of a log resistance
# A step that moves no reading and no cell by more than this share of its deviation is the last; so
# is one up to `NEARLY` if the next can be foreseen to be.
CLOSE: Final = 0.3
NEARLY: Final = 3.0
# Wires are in the model for the readings that they can move by this share of the noise.
HEAVY: Final = 0.01
# Chi-square of the wires, per touched cell, above which they are not what they were believed.
BENT: Final = 9.0
CROWDED: Final = 0.3  # share of touched cells
# Wires learn from readings that their uncertainty may move by half the noise, and from the best.
LESSON: Final = 0.25
MAX_LESSON: Final = 32
MAX_HALVINGS: Final = 8
_LOG_CELL_LIMITS: Final = (-np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS))


class JointFit:
    """One frame's fit. cell (RC,), wires (2RC,): log resistances.

    wire_pull: a of wires - mean = P a, which saves an inverse of P in the cost.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        ref_ohm: float,
        prior: CellPrior,
        belief: WireBelief,
        current: Float,
        current_std: Float,
    ) -> None:
        self._shape = shape
        self._ref_ohm = ref_ohm
        self._prior = prior
        self._belief = belief
        self._current = current
        self._weight = 1.0 / current_std
        self.iterations = 0
        self.message = ""

    def run(self, starts: list[Float]) -> None:
        """Minimise from the best of some starts; `message` says if that did not converge."""
        self._minimise(starts)
        self._conclude()

    def _minimise(self, starts: list[Float]) -> None:
        self._moved = 0.0
        self._wire_pull = np.zeros_like(self._belief.mean)
        self.wires = self._belief.mean
        tried = []
        for self.cell in starts:
            self._linearise()
            tried.append((self._cost(), self.cell))
        self.cost, cell = min(tried, key=lambda each: each[0])
        if cell is not self.cell:
            self.cell = cell
            self._linearise()
        for _ in range(MAX_ITERATIONS):
            self.iterations += 1
            here = self.cell, self.wires, self._wire_pull
            if self._step():
                return
            self._linearise()
            cost_before, self.cost = self.cost, self._cost()
            for _ in range(MAX_HALVINGS):
                if self.cost <= cost_before + 1e-9 * abs(cost_before) + 1e-3:
                    break
                # Too far: back half the way. What is lost is one factorisation.
                self.cell, self.wires, self._wire_pull = (
                    0.5 * (now + before)
                    for now, before in zip(
                        (self.cell, self.wires, self._wire_pull), here, strict=True
                    )
                )
                self.iterations += 1
                self._linearise()
                self.cost = self._cost()
        self.message = f"not converged in {MAX_ITERATIONS} iterations"

    def _linearise(self) -> None:
        """h and its slopes at the present state, over the noise: cells times their deviation."""
        top, bottom = np.exp(self.wires).reshape(2, *self._shape)
        circuit = port_sensitivity(np.exp(-self.cell).reshape(self._shape), top, bottom)
        self.modelled = 1.0 / (circuit.port_ohm + self._ref_ohm)
        slope = -self._weight * self.modelled**2
        self._cell_std = np.sqrt(self._prior.variance(self.cell))
        self._by_cell = circuit.by_cell
        self._by_cell *= slope[:, None]
        self._by_cell *= self._cell_std
        self._residual = (self._current - self.modelled) * self._weight
        # All wires in series with a port bound what they can do to it.
        path = np.cumsum(top, axis=1) + np.cumsum(bottom, axis=0)
        move = np.abs(slope) * path.ravel()
        self._heavy = np.flatnonzero(move > HEAVY)
        self._by_wires = circuit.by_wires(self._heavy)
        self._by_wires *= slope[self._heavy, None]

    def _cost(self) -> float:
        """-2 log posterior, up to a constant."""
        cost = float(self._residual @ self._residual) + self.wire_chi2
        return cost + self._prior.cost(self.cell)

    @property
    def wire_chi2(self) -> float:
        """(w - mean)^T P^-1 (w - mean)."""
        return float(self._wire_pull @ (self.wires - self._belief.mean))

    @property
    def wires_contradict(self) -> bool:
        """Whether the wires moved further than was believed possible."""
        touches = int(np.sum(self._prior.expected - self.cell > TOUCHED))
        return self.wire_chi2 > BENT * (1 + touches)

    def _step(self) -> bool:
        """One step; True when it is so small that the linearisation still holds."""
        by_cell, by_wires, heavy = self._by_cell, self._by_wires, self._heavy
        away = self.cell - self._prior.expected
        off = self.wires - self._belief.mean
        wanted = self._residual + by_cell @ (away / self._cell_std)
        wanted[heavy] += by_wires @ off
        self._factor = self._factored()
        left = scipy.linalg.cho_solve((self._factor, True), wanted, check_finite=False)
        cell_step = self._cell_std * (left @ by_cell) - away
        pull = left[heavy] @ by_wires
        wire_step = self._belief.times(pull) - off
        # After this step the linearised residual is `left`.
        moved = max(
            float(np.abs(self._residual - left).max()),
            float(np.abs(cell_step / self._cell_std).max()),
        )
        # Steps shrink faster than by a constant factor: the next one is at most this.
        next_one = moved * moved / self._moved if self._moved else moved
        self._moved = moved
        longest = max(float(np.abs(cell_step).max()), float(np.abs(wire_step).max()))
        share = min(1.0, MAX_STEP / max(longest, MAX_STEP))
        self.cell = np.clip(self.cell + share * cell_step, *_LOG_CELL_LIMITS)
        self.wires = np.clip(self.wires + share * wire_step, *LOG_LIMITS)
        self._wire_pull = self._wire_pull + share * (pull - self._wire_pull)
        return moved < CLOSE or (moved < NEARLY and next_one < CLOSE)

    def _factored(self) -> Float:
        """Lower factor of J P J^T + 1."""
        system: Float = self._by_cell @ self._by_cell.T
        seen = self._belief.seen(self._by_wires)
        self._wires_seen = np.diagonal(seen).copy()
        if self._heavy.size == len(system):
            system += seen
        else:
            system[np.ix_(self._heavy, self._heavy)] += seen
        system.ravel()[:: len(system) + 1] += 1.0
        factor: Float = scipy.linalg.cholesky(
            system, lower=True, overwrite_a=True, check_finite=False
        )
        return factor

    def _learned(self) -> Float:
        """Share of each cell's prior variance that the readings take away, (RC,)."""
        own = scipy.linalg.solve_triangular(
            self._factor, self._by_cell, lower=True, check_finite=False
        )
        return np.asarray(np.einsum("ij,ij->j", own, own))

    @property
    def misfit(self) -> float:
        """Chi-square per port of what is left."""
        return float(self._residual @ self._residual) / self._residual.size

    def _conclude(self) -> None:
        """cell_std (RC,), of the log resistances, and where `elsewhere` the optimum may be.

        A cell is called untouched when the readings ask for less than the prior asks against it.
        Where that may be a touch all the same, small for the readings but not for the cell, it is
        counted as uncertain by so much, and so is what depends on it.
        """
        learned = self._learned()
        distance = self._prior.expected - self.cell
        at_rest = distance**2 < self._prior.tail * self._prior.std**2
        # What the readings alone say of a cell: rise of its conductance over rest, and deviation.
        share = np.maximum(learned, 1e-9)
        rise = distance / share
        rise_std = self._prior.std * np.sqrt(np.maximum(1 - learned, 1e-12) / share)
        # Where most cells are touched, rest is no more likely than a touch.
        least = rise_std if at_rest.mean() > 1 - CROWDED else -2 * rise_std
        self._hidden = at_rest & (rise + 2 * rise_std > HIDDEN) & (rise > least)
        self.elsewhere: Float | None = None
        if self._hidden.any():
            evidence = np.where(self._hidden, rise / rise_std, 0.0)
            likeliest = int(np.argmax(evidence))
            if evidence[likeliest] > DOUBT:
                self.elsewhere = self.cell.copy()
                self.elsewhere[likeliest] = self._prior.expected[likeliest] - np.log1p(
                    rise[likeliest]
                )
            wider = np.where(self._hidden, np.maximum(rise, 0.0) + rise_std, self._cell_std)
            self._by_cell *= wider / self._cell_std
            self._cell_std = wider
            self._factor = self._factored()
            learned = self._learned()
        self.cell_std: Float = self._cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))

    def siemens_std(self) -> Float:
        """Standard deviation of each cell's conductance, (RC,) [S]."""
        # A hidden cell's deviation is one of its conductance, over that at rest.
        linear = np.exp(-self.cell) * self.cell_std
        return np.where(self._hidden, linear, siemens_std(-self.cell, self.cell_std))

    def lesson(self) -> Lesson:
        """Slopes, residual and noise of the readings that wires matter to, for the belief."""
        kept = np.argsort(self._wires_seen)[-MAX_LESSON:]
        kept = kept[self._wires_seen[kept] > LESSON]
        ports = self._heavy[kept]
        slopes = self._by_wires[kept]
        residual = self._residual[ports] + slopes @ (self.wires - self._belief.mean)
        away = np.abs(self.cell - self._prior.expected)
        # A touched cell is noise without limit; one at rest is known to its drift.
        std = np.where(self._hidden | (away > TOUCHED), UNLIMITED_STD, self._prior.std)
        by_cell = self._by_cell[ports] * (std / self._cell_std)
        noise = by_cell @ by_cell.T
        noise.ravel()[:: ports.size + 1] += 1.0
        return slopes, residual, noise
