# SPDX-License-Identifier: Apache-2.0
"""One frame's fit of all 3RC resistances: what `joint` minimises, and what it says of the answer.

Symbols

====== ============= ============================================================ ==========
symbol shape         meaning                                                      unit
====== ============= ============================================================ ==========
x      (3RC,)        log resistances: cells, top wires, bottom wires              log ohm
m      (3RC,)        what the prior expects of x                                  log ohm
P      (3RC, 3RC)    covariance of the prior
u      (3RC + 2,)    what is off: x = m + P^1/2 u; the wires' layers have two     1
y, h   (RC,)         measured and modelled port currents per Vdd, over noise      1
J      (RC, 3RC + 2) dh / du                                                      1
====== ============= ============================================================ ==========

Minimised is |y - h|^2 + |u|^2, P of the cells re-weighted for the tails of their prior at every
step. The steps are Gauss-Newton's in the space of the readings (Tarantola 2005, eq. 3.51),

    u' = J^T (J J^T + 1)^-1 (y - h(u) + J u),

and the posterior covariance of u is 1 - J^T (J J^T + 1)^-1 J.
"""

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import port_sensitivity
from ohmskin.circuit.small import cholesky, gram, solve, solve_lower
from ohmskin.estimate.base import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.prior import (
    HIDDEN,
    MAX_STEP,
    TOUCHED,
    UNLIMITED_STD,
    CellPrior,
    Lesson,
    WireBelief,
)

MAX_ITERATIONS: Final = 40
MAX_HALVINGS: Final = 8  # of a step that goes too far
CLOSE: Final = 0.5  # deviations of a reading or cell: a step that moves none by more is the last
CROWDED: Final = 0.3  # share of touched cells: above it, no other cell is known to be at rest
LIGHT_TOUCH: Final = 10.0  # rise over the conductance at rest that such a cell may have
_LEAST_LOG, _MOST_LOG = -np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS)  # of a cell


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
        self._off_wires = np.zeros(2 * start.size + 2)  # u of the wires
        self._minimise()
        self._conclude()

    def _evaluate(self) -> None:
        """Slopes and cost at the present state."""
        self.wires = self._belief.log_wires(self._off_wires)
        cell_siemens = np.exp(-self.cell).reshape(self._belief.shape)
        circuit = port_sensitivity(cell_siemens, *self._belief.layers(self.wires))
        modelled = 1.0 / (circuit.port_ohm + self._ref_ohm)
        slope = (-self._weight * modelled**2)[:, None]
        residual = (self._current - modelled) * self._weight
        centre, variance = self._prior.normal(self.cell)
        self._by_cell = circuit.by_cell * slope  # per log ohm
        self._by_wires = self._belief.root(circuit.by_wires * slope)
        self._residual, self._centre, self._cell_std = residual, centre, np.sqrt(variance)
        chi2 = float(residual @ residual + self._off_wires @ self._off_wires)
        self._cost = chi2 + self._prior.cost(self.cell)

    def _minimise(self) -> None:
        self._evaluate()
        for _ in range(MAX_ITERATIONS):
            self.iterations += 1
            cell_before, off_before, cost_before = self.cell, self._off_wires, self._cost
            if self._step():
                return
            self._evaluate()
            for _ in range(MAX_HALVINGS):
                if self._cost <= cost_before + 1e-9 * abs(cost_before) + 1e-3:
                    break
                # Too far: back half the way. What is lost is one factorisation.
                self.cell = 0.5 * (self.cell + cell_before)
                self._off_wires = 0.5 * (self._off_wires + off_before)
                self.iterations += 1
                self._evaluate()
        self.message = f"not converged in {MAX_ITERATIONS} iterations"

    @property
    def modelled(self) -> Float:
        """Port currents of the model, (RC,) [S]."""
        return self._current - self._left / self._weight

    @property
    def misfit(self) -> float:
        """Chi-square per port of what is left."""
        return float(self._left @ self._left) / self._left.size

    @property
    def touches(self) -> int:
        """Number of touched cells."""
        return int(np.count_nonzero(self._prior.rise(self.cell) > TOUCHED))

    @property
    def is_crowded(self) -> bool:
        """Whether so many cells are touched that rest is no more likely than a touch."""
        return self.touches > CROWDED * self.cell.size

    def _factorised(self, cell_std: Float) -> tuple[Float, Float]:
        """J for cells of these deviations, (RC, 3RC + 2), and the factor of J J^T + 1."""
        slopes = np.hstack([self._by_cell * cell_std, self._by_wires])
        seen = gram(slopes)
        np.einsum("ii->i", seen)[:] += 1.0
        return slopes, cholesky(seen)

    def _step(self) -> bool:
        """One step; True when the next would not matter."""
        residual, cell_std = self._residual, self._cell_std
        off = np.concatenate([(self.cell - self._centre) / cell_std, self._off_wires])
        slopes, self._factor = self._factorised(cell_std)
        left = solve(self._factor, residual + slopes @ off)
        cell_step, wire_step = np.split(left @ slopes - off, [len(left)])
        # After this step the linearised residual is `left`.
        moved = max(np.abs(residual - left).max(), np.abs(cell_step).max())
        # What would leave its limits goes there, and holds up nothing else.
        cell = np.minimum(np.maximum(self.cell + cell_std * cell_step, _LEAST_LOG), _MOST_LOG)
        wires = self._belief.log_wires(self._off_wires + wire_step)
        longest = max(np.abs(cell - self.cell).max(), np.abs(wires - self.wires).max())
        share = min(1.0, MAX_STEP / max(longest, MAX_STEP))
        self.cell = self.cell + share * (cell - self.cell)
        self._off_wires = self._off_wires + share * wire_step
        self.wires = self._belief.log_wires(self._off_wires)
        self._left = left if share == 1.0 else residual
        return bool(moved < CLOSE)

    def _deviations(self, factor: Float, cell_std: Float) -> tuple[Float, Float]:
        """Share of each cell's prior variance that readings take away; what layers do to cells."""
        own = solve_lower(factor, self._by_cell * cell_std)
        by_layers = own.T @ solve_lower(factor, self._by_wires[:, -2:])
        share = np.einsum("ij,ij->j", own, own)
        return np.asarray(share), cell_std * np.linalg.norm(by_layers, axis=1)

    def _conclude(self) -> None:
        """cell_std, and what the uncertain layers have in it, from the last factor that was made.

        A cell is called untouched when the readings ask for less than the prior asks against it.
        Where that may be a touch all the same, small for the readings but not for the cell, it is
        counted as uncertain by so much, and so is what depends on it.
        """
        prior, cell_std = self._prior, self._cell_std
        learned, self.by_layers = self._deviations(self._factor, cell_std)
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
            cell_std = np.where(hidden, rise + rise_std, cell_std)
            _, factor = self._factorised(cell_std)
            learned, self.by_layers = self._deviations(factor, cell_std)
        self.cell_std: Float = cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))

    @property
    def lesson(self) -> Lesson:
        """Slopes, residual and noise of the readings, for the belief."""
        residual = self._residual + self._by_wires @ self._off_wires
        # A touched cell is noise without limit; one at rest is known to its drift.
        unknown = self._hidden | (np.abs(self._prior.rise(self.cell)) > TOUCHED)
        std = np.where(unknown, UNLIMITED_STD, self._prior.std)
        by_cell = self._by_cell * std
        noise = by_cell @ by_cell.T
        noise.ravel()[:: residual.size + 1] += 1.0
        return self._by_wires, residual, noise
