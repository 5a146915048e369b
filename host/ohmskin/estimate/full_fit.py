# SPDX-License-Identifier: Apache-2.0
"""One frame's fit of all 3RC resistances: what `joint` minimises, and what it says of the answer.

Symbols

====== ============ ============================================================= ==========
symbol shape        meaning                                                       unit
====== ============ ============================================================= ==========
x      (RC + 2,)    log resistances: cells, mean segments of both layers          log ohm
m      (RC + 2,)    what the prior expects of x                                   log ohm
P      (RC+2, RC+2) covariance of the prior
u      (RC + 2,)    what is off: x = m + P^1/2 u                                  1
y, h   (RC,)        measured and modelled port currents per Vdd, over noise       1
J      (RC, RC + 2) dh / du                                                       1
W      (RC, 2RC)    dh / dw s, w the log segments, s what each has of its own     1
N      (RC, RC)     covariance of y: of its noise and of what is not in x         1
====== ============ ============================================================= ==========

Minimised is (y - h)^T N^-1 (y - h) + |u|^2, P of the cells re-weighted for the tails of their prior
at every step. What segments have of their own is small: it is noise, N = 1 + W W^T, and afterwards
W^T S^-1 (y - h(u) + J u) says what it has been. The steps are Gauss-Newton's in the space of the
readings (Tarantola 2005, eq. 3.51),

    u' = J^T S^-1 (y - h(u) + J u) ,   S = J J^T + N ,

and the posterior covariance of u is 1 - J^T S^-1 J. J, N and S are made anew only where those of
the step before, used once more, would still move something.
"""

from functools import cached_property

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit
from ohmskin.circuit.small import cholesky, gram, solve, solve_lower
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    CLOSE,
    CROWDED,
    HIDDEN,
    MAX_ITERATIONS,
    MAX_STEP,
    SEGMENT_STD,
    TOUCHED,
    UNLIMITED_STD,
    CellPrior,
    Lesson,
    WireBelief,
)

_LEAST_LOG, _MOST_LOG = -np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS)  # of a cell


class FullFit:
    """One frame's fit: log resistances of cell (RC,), their cell_std, and of wires (2RC,)."""

    def __init__(
        self,
        prior: CellPrior,
        belief: WireBelief,
        ref_ohm: float,
        ports: PortReadings,
        start: Float,
    ) -> None:
        """Minimise from these cells (RC,); `message` says if that did not converge."""
        self._prior, self._belief, self._ref_ohm = prior, belief, ref_ohm
        self._far = ports.far
        self._current, self._weight = ports.current.ravel(), 1.0 / ports.current_std.ravel()
        self.iterations, self.message = 0, ""
        self.cell: Float = start
        self._off_layers = np.zeros(2)  # u of the layers
        self._moved = np.inf  # of a log resistance, since N was made
        self._evaluate()
        self._minimise()
        self._conclude()

    def _evaluate(self) -> None:
        """The circuit at the present state."""
        cell_siemens = np.exp(-self.cell).reshape(self._belief.shape)
        wires = np.exp(self._belief.away(self._off_layers))
        self._circuit = PortCircuit(cell_siemens, *wires, far=self._far)
        self._modelled = 1.0 / (self._circuit.port_ohm + self._ref_ohm)
        self._residual = (self._current - self._modelled) * self._weight
        self._centre, self._variance = self._prior.normal(self.cell)

    def _weighted(self, slopes: Float, share: float = 1.0) -> Float:
        """Slopes of h from those of rho, (RC, ...), which are overwritten."""
        slopes *= (-share * self._weight * self._modelled**2)[:, None]
        return slopes

    def _linearise(self) -> None:
        """Slopes and S at the present state, and N if that has moved by more than N is about."""
        if self._moved > SEGMENT_STD:
            self._moved = 0.0
            self._by_segment = self._weighted(self._circuit.by_wires(), SEGMENT_STD)
            self._noise = gram(self._by_segment)
            np.einsum("ii->i", self._noise)[:] += 1.0
        self._by_cell = self._weighted(self._circuit.by_cell())
        self._by_layers = self._belief.by_layers(self._weighted(self._circuit.by_layers()))
        self._cell_std = np.sqrt(self._variance)
        self._slopes, self._factor = self._factorised(self._cell_std)

    def _factorised(self, cell_std: Float) -> tuple[Float, Float]:
        """J for cells of these deviations, and the factor of S."""
        slopes = np.empty((len(cell_std), len(cell_std) + 2))
        np.multiply(self._by_cell, cell_std, out=slopes[:, :-2])
        slopes[:, -2:] = self._by_layers
        return slopes, cholesky(gram(slopes, onto=self._noise.copy(order="F")))

    def _minimise(self) -> None:
        self._linearise()
        step, moved = self._step()
        while self.iterations < MAX_ITERATIONS:
            self.iterations += 1
            self._move(step)
            if moved < CLOSE:
                return
            self._evaluate()
            step, moved = self._step()
            if moved >= 0.5 * CLOSE:
                self._linearise()
                step, moved = self._step()
        self.message = f"not converged in {MAX_ITERATIONS} iterations"

    def _step(self) -> tuple[Float, float]:
        """Step of u by the slopes there are; the most that it moves of a reading, or of a cell."""
        from_rest = (self.cell - self._centre) * self._cell_std / self._variance
        off = np.concatenate([from_rest, self._off_layers])
        self._left = solve(self._factor, self._residual + self._slopes @ off)
        step = self._left @ self._slopes - off
        read = self._slopes @ step
        return step, float(max(np.abs(read).max(), np.abs(step[:-2]).max()))

    def _move(self, step: Float) -> None:
        # What would leave its limits goes there, and holds up nothing else.
        cell = self.cell + self._cell_std * step[:-2]
        cell_step = np.minimum(np.maximum(cell, _LEAST_LOG), _MOST_LOG) - self.cell
        layers_step = self._belief.away(step[-2:]) - self._belief.log_layers
        most = max(np.abs(cell_step).max(), np.abs(layers_step).max(), 1e-9)
        share = min(1.0, MAX_STEP / most)
        self._moved += share * most
        self.cell = self.cell + share * cell_step
        self._off_layers = self._off_layers + share * step[-2:]

    @cached_property
    def wires(self) -> Float:
        """Log resistances of the segments, (2RC,): their layer's, and their own share."""
        return self._belief.log_wires(self._off_layers, self._left @ self._by_segment)

    @property
    def modelled(self) -> Float:
        """Port currents of the model, (RC,) [S]."""
        return self._current - self._left / self._weight

    @property
    def misfit(self) -> float:
        """Chi-square per port of what is left."""
        return float(self._left @ self._left) / self._left.size

    def _conclude(self) -> None:
        """cell_std, and what the uncertain layers have in it, by the last S.

        A cell is called untouched when the readings ask for less than the prior asks against it.
        Where that may be a touch all the same, small for the readings but not for the cell, it is
        counted as uncertain by so much, and so is what depends on it: S grows by those cells, of
        deviation s' for s, and with L L^T = S, O = L^-1 J, H = O sqrt(s'^2 / s^2 - 1) of these,

            J^T S'^-1 J = O^T (1 - H (1 + H^T H)^-1 H^T) O .
        """
        prior, cell_std = self._prior, self._cell_std
        own = solve_lower(self._factor, self._slopes)
        learned = np.einsum("ij,ij->j", own, own)[:-2]
        distance = prior.expected - self.cell
        at_rest = np.abs(distance) < prior.std
        # What the readings alone say of a cell: rise of its conductance over rest, and deviation.
        share = np.maximum(learned, 1e-9)
        rise = distance / share
        rise_std = prior.std * np.sqrt(np.maximum(1 - learned, 1e-12) / share)
        hidden = at_rest & (rise + 2 * rise_std > HIDDEN) & (rise > rise_std)
        if prior.touches(self.cell) > CROWDED * rise.size:
            hidden, rise = at_rest, np.maximum(rise, UNLIMITED_STD)
        self._hidden = hidden = hidden & (rise + rise_std > cell_std)
        by_layers = own[:, :-2].T @ own[:, -2:]
        if hidden.any():
            wider = np.where(hidden, (rise + rise_std) / cell_std, 1.0)
            more = np.sqrt(wider[hidden] ** 2 - 1.0)
            seen = (own[:, :-2][:, hidden] * more).T @ own
            system = np.eye(len(more)) + seen[:, :-2][:, hidden] * more
            less = solve_lower(cholesky(system), seen)
            learned = wider**2 * (learned - np.einsum("ij,ij->j", less, less)[:-2])
            by_layers -= less[:, :-2].T @ less[:, -2:]
            by_layers *= wider[:, None]
            cell_std = wider * cell_std
        self.by_layers: Float = cell_std * np.linalg.norm(by_layers, axis=1)
        self.cell_std: Float = cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))

    @property
    def lesson(self) -> Lesson:
        """What the readings say of the layers."""
        residual = self._residual + self._by_layers @ self._off_layers
        # A touched cell is noise without limit; one at rest is known to its drift.
        unknown = self._hidden | (np.abs(self._prior.rise(self.cell)) > TOUCHED)
        _, factor = self._factorised(np.where(unknown, UNLIMITED_STD, self._prior.std))
        return self._by_layers, residual, factor
