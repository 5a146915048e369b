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

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import port_sensitivity
from ohmskin.circuit.small import cholesky, gram, solve, solve_lower
from ohmskin.estimate.base import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.prior import (
    HIDDEN,
    LOG_LIMITS,
    TOUCHED,
    UNLIMITED_STD,
    CellPrior,
    Lesson,
    WireBelief,
)

MAX_ITERATIONS: Final = 40
MAX_HALVINGS: Final = 8  # of a step that goes too far
MAX_STEP: Final = 1.5  # of a log resistance
CLOSE: Final = 0.3  # deviations of a reading or cell: a step that moves none by more is the last
CROWDED: Final = 0.3  # share of touched cells: above it, no other cell is known to be at rest
LIGHT_TOUCH: Final = 10.0  # rise over the conductance at rest that such a cell may have
_LOG_CELL_LIMITS: Final = (-np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS))


@dataclass(frozen=True, eq=False)
class _Slopes:
    """The residual y - h, and J, at one state. by_cell: (RC, RC), times the cells' deviations.

    centre, cell_std: the normal that stands for the prior of the cells there. by_wires: (RC, 2RC).
    """

    residual: Float
    centre: Float
    cell_std: Float
    by_cell: Float
    by_wires: Float

    def factor(self, belief: WireBelief) -> Float:
        """Cholesky factor of J P J^T + 1, (RC, RC)."""
        seen = belief.seen(self.by_wires, gram(self.by_cell))
        np.einsum("ii->i", seen)[:] += 1.0
        return cholesky(seen)

    def learned(self, factor: Float) -> Float:
        """Share of each cell's prior variance that the readings take away, (RC,)."""
        own = solve_lower(factor, self.by_cell)
        return np.asarray(np.einsum("ij,ij->j", own, own))


class FullFit:
    """One frame's fit: log resistances of cell (RC,), their cell_std, and of wires (2RC,)."""

    def __init__(
        self,
        prior: CellPrior,
        belief: WireBelief,
        ref_ohm: float,
        current: Float,
        current_std: Float,
        start: Float,
    ) -> None:
        """Minimise from these cells (RC,); `message` says if that did not converge."""
        self._prior, self._belief, self._ref_ohm = prior, belief, ref_ohm
        self._current, self._weight = current, 1.0 / current_std
        self.iterations, self.message = 0, ""
        self.cell: Float = start
        self.wires = belief.mean
        self._minimise()
        self._conclude()

    def _evaluate(self) -> None:
        """Slopes and cost at the present state."""
        cell_siemens = np.exp(-self.cell).reshape(self._belief.shape)
        circuit = port_sensitivity(cell_siemens, *self._belief.layers(self.wires))
        modelled = 1.0 / (circuit.port_ohm + self._ref_ohm)
        slope = -self._weight * modelled**2
        centre, variance = self._prior.normal(self.cell)
        cell_std = np.sqrt(variance)
        by_cell = circuit.by_cell
        by_cell *= slope[:, None]
        by_cell *= cell_std
        by_wires = circuit.by_wires()
        by_wires *= slope[:, None]
        residual = (self._current - modelled) * self._weight
        self._here = _Slopes(residual, centre, cell_std, by_cell, by_wires)
        wire_chi2 = float(self._wire_pull @ (self.wires - self._belief.mean))
        self._cost = float(residual @ residual) + wire_chi2 + self._prior.cost(self.cell)

    def _minimise(self) -> None:
        # a of wires - mean = P a, which saves an inverse of P in the cost
        self._wire_pull = np.zeros_like(self.wires)
        self._evaluate()
        for _ in range(MAX_ITERATIONS):
            self.iterations += 1
            before, cost_before = (self.cell, self.wires, self._wire_pull), self._cost
            if self._step():
                return
            self._evaluate()
            for _ in range(MAX_HALVINGS):
                if self._cost <= cost_before + 1e-9 * abs(cost_before) + 1e-3:
                    break
                # Too far: back half the way. What is lost is one factorisation.
                now = self.cell, self.wires, self._wire_pull
                halves = (0.5 * (here + there) for here, there in zip(now, before, strict=True))
                self.cell, self.wires, self._wire_pull = halves
                self.iterations += 1
                self._evaluate()
        self.message = f"not converged in {MAX_ITERATIONS} iterations"

    @property
    def modelled(self) -> Float:
        """Port currents of the model, (RC,) [S]."""
        return self._current - self._residual / self._weight

    @property
    def misfit(self) -> float:
        """Chi-square per port of what is left."""
        return float(self._residual @ self._residual) / self._residual.size

    @property
    def is_crowded(self) -> bool:
        """Whether so many cells are touched that rest is no more likely than a touch."""
        return bool(np.mean(self._prior.rise(self.cell) > TOUCHED) > CROWDED)

    def _step(self) -> bool:
        """One step; True when the next would not matter."""
        here = self._here
        away = self.cell - here.centre
        off = self.wires - self._belief.mean
        wanted = here.residual + here.by_cell @ (away / here.cell_std) + here.by_wires @ off
        self._factored, self._factor = here, here.factor(self._belief)
        left = solve(self._factor, wanted)
        cell_step = here.cell_std * (left @ here.by_cell) - away
        pull = left @ here.by_wires
        wire_step = self._belief.times(pull) - off
        # After this step the linearised residual is `left`.
        moved = max(
            float(np.abs(here.residual - left).max()),
            float(np.abs(cell_step / here.cell_std).max()),
        )
        # What would leave its limits goes there, and holds up nothing else.
        cell_step = np.clip(self.cell + cell_step, *_LOG_CELL_LIMITS) - self.cell
        wire_step = np.clip(self.wires + wire_step, *LOG_LIMITS) - self.wires
        longest = max(float(np.abs(cell_step).max()), float(np.abs(wire_step).max()))
        share = min(1.0, MAX_STEP / max(longest, MAX_STEP))
        self.cell = self.cell + share * cell_step
        self.wires = self.wires + share * wire_step
        self._wire_pull = self._wire_pull + share * (pull - self._wire_pull)
        self._residual = left if share == 1.0 else here.residual
        return moved < CLOSE

    def _conclude(self) -> None:
        """cell_std, from the last factor that was made.

        A cell is called untouched when the readings ask for less than the prior asks against it.
        Where that may be a touch all the same, small for the readings but not for the cell, it is
        counted as uncertain by so much, and so is what depends on it.
        """
        at, prior = self._factored, self._prior
        learned = at.learned(self._factor)
        distance = prior.expected - self.cell
        at_rest = distance**2 < prior.tail * prior.std**2
        # What the readings alone say of a cell: rise of its conductance over rest, and deviation.
        share = np.maximum(learned, 1e-9)
        rise = distance / share
        rise_std = prior.std * np.sqrt(np.maximum(1 - learned, 1e-12) / share)
        hidden = at_rest & (rise + 2 * rise_std > HIDDEN) & (rise > rise_std)
        if self.is_crowded:
            hidden, rise = at_rest, np.maximum(rise, LIGHT_TOUCH)
        self._hidden = hidden
        if hidden.any() or self.is_crowded:
            wider = np.where(hidden, rise + rise_std, at.cell_std)
            at = replace(at, cell_std=wider, by_cell=at.by_cell * (wider / at.cell_std))
            learned = at.learned(at.factor(self._belief))
        self.cell_std: Float = at.cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))

    def lesson(self) -> Lesson:
        """Slopes, residual and noise of the readings, for the belief."""
        here = self._here
        residual = here.residual + here.by_wires @ (self.wires - self._belief.mean)
        # A touched cell is noise without limit; one at rest is known to its drift.
        unknown = self._hidden | (np.abs(self._prior.rise(self.cell)) > TOUCHED)
        std = np.where(unknown, UNLIMITED_STD, self._prior.std)
        by_cell = here.by_cell * (std / here.cell_std)
        noise = by_cell @ by_cell.T
        noise.ravel()[:: residual.size + 1] += 1.0
        return here.by_wires, residual, noise
