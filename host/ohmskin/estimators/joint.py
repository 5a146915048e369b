# SPDX-License-Identifier: Apache-2.0
"""`joint`: every resistance of the skin at once, from one circuit for all readings.

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

RC readings do not determine 3RC resistances, so a prior does the rest, and the answer carries a
standard deviation that says how much of it is prior:

- a cell is near its rest resistance, with the tails of a Student t: being touched is unlikely, but
  once it is, how hard costs little. This is what removes ghosts that the readings do not exclude.
- a wire segment is log-normal around the nominal value of its layer, with a part that all segments
  of the layer share (a skin that is stretched) and a part of its own.

The maximum of the posterior is found by Gauss-Newton steps in the space of the readings
(Tarantola 2005, eq. 3.51), with P of the cells re-weighted for the tails at every step:

    x' = m + P J^T (J P J^T + 1)^-1 (y - h(x) + J (x - m)),

and the posterior covariance is P - P J^T (J P J^T + 1)^-1 J P.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
import scipy.linalg

from ohmskin.circuit import Float, Sensitivity, port_sensitivity
from ohmskin.estimators.base import (
    MAX_CELL_SIEMENS,
    MIN_CELL_SIEMENS,
    Estimator,
    SkinKnowledge,
    Solution,
)
from ohmskin.estimators.ohm import conductance_from_current

# Prior of the cells. Without rest readings they are expected around 1 MOhm.
REST_OHM: Final = 1e6
UNKNOWN_REST_STD: Final = 1.0
REST_STD: Final = 0.05  # drift since the rest readings
TAIL: Final = 1.0  # degrees of freedom of the Student t
# Prior of the wires.
UNKNOWN_WIRE_OHM: Final = 150.0
UNKNOWN_LAYER_STD: Final = 1.5
LAYER_STD: Final = 0.3
SEGMENT_STD: Final = 0.1

MAX_ITERATIONS: Final = 40
MAX_STEP: Final = 1.5  # of a log resistance
# A step that moves no reading and no cell by more than this share of its deviation is the last.
CLOSE: Final = 0.1
_LOG_CELL_LIMITS: Final = (-np.log(MAX_CELL_SIEMENS), -np.log(MIN_CELL_SIEMENS))
_LOG_WIRE_LIMITS: Final = (np.log(1e-6), np.log(1e7))


@dataclass(frozen=True, eq=False)
class Prior:
    """What is expected of the log resistances. cell: (RC,), `tail` None: normal, not Student t."""

    cell: Float
    cell_std: float
    tail: float | None
    top: float
    bottom: float
    layer_std: float
    segment_std: float

    def cell_variance(self, cell: Float) -> Float:
        """Of the normal with the Student t's slope at `cell`: (nu s^2 + d^2) / (nu + 1)."""
        if self.tail is None:
            return np.full_like(cell, self.cell_std**2)
        away = cell - self.cell
        variance: Float = (self.tail * self.cell_std**2 + away * away) / (self.tail + 1)
        return variance


class JointEstimator(Estimator):
    """Gauss-Newton on all 3RC log resistances, warm-started from the previous frame."""

    name: ClassVar[str] = "joint"

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._prior: Prior | None = None
        self._before: Float | None = None

    def reset(self) -> None:
        """Forget the previous frame."""
        self._before = None

    def _solve(self, ratio: Float) -> Solution:
        if self._prior is None:
            self._prior = self._first_prior()
        fit = _Fit(self, ratio, self._prior)
        found = fit.run(self._before)
        self._before = fit.state if not found.message else None
        return found

    def _first_prior(self) -> Prior:
        """The prior from what is known; the rest readings go through the same fit, tails off."""
        known = self.knowledge
        nominal = (known.nominal_top_wire_ohm, known.nominal_bottom_wire_ohm)
        told = None not in nominal
        top, bottom = (np.log(max(ohm or UNKNOWN_WIRE_OHM, 1e-3)) for ohm in nominal)
        unknown = Prior(
            cell=np.full(known.rows * known.columns, np.log(REST_OHM)),
            cell_std=UNKNOWN_REST_STD,
            tail=None,
            top=float(top),
            bottom=float(bottom),
            layer_std=LAYER_STD if told else UNKNOWN_LAYER_STD,
            segment_std=SEGMENT_STD,
        )
        if known.rest_ratio is None:
            return Prior(**{**vars(unknown), "tail": TAIL})
        rest = _Fit(self, known.rest_ratio, unknown).run(None)
        return Prior(
            **{
                **vars(unknown),
                "cell": -np.log(rest.cell_siemens).ravel(),
                "cell_std": REST_STD,
                "tail": TAIL,
            }
        )


class _Fit:
    """One frame's fit. `state`: log resistances (3, RC), cells, top wires, bottom wires."""

    def __init__(self, estimator: JointEstimator, ratio: Float, prior: Prior) -> None:
        known = estimator.knowledge
        self._estimator = estimator
        self._ratio = ratio
        self._shape = (known.rows, known.columns)
        self._ref_ohm = known.ref_ohm
        self._prior = prior
        current, std = estimator._port_current(ratio)
        self._current = current.ravel()
        self._weight = 1.0 / std.ravel()
        cells = current.size
        self._expected = np.stack(
            [prior.cell, np.full(cells, prior.top), np.full(cells, prior.bottom)]
        )
        self.state = self._expected

    def run(self, start: Float | None) -> Solution:
        self.state = self._first_guess() if start is None else start
        before, cost_before = self.state, np.inf
        for iteration in range(1, MAX_ITERATIONS + 1):
            self._linearise()
            cost = self._cost()
            if cost > cost_before + 1e-9 * abs(cost_before) + 1e-3:
                # Too far: back half the way. What is lost is one factorisation.
                self.state = 0.5 * (self.state + before)
                continue
            before, cost_before = self.state, cost
            if self._step():
                return self._solution(iteration, "")
        return self._solution(MAX_ITERATIONS, f"not converged in {MAX_ITERATIONS} iterations")

    def _first_guess(self) -> Float:
        siemens = conductance_from_current(self._current, self._ref_ohm)
        guess = self._expected.copy()
        guess[0] = np.minimum(-np.log(np.clip(siemens, MIN_CELL_SIEMENS, 1e-2)), guess[0])
        return guess

    def _linearise(self) -> None:
        """h, and B = J P^(1/2) so that J P J^T = B B^T, at the present state."""
        cell, top, bottom = (log_ohm.reshape(self._shape) for log_ohm in self.state)
        circuit: Sensitivity = port_sensitivity(np.exp(-cell), np.exp(top), np.exp(bottom))
        self._modelled = 1.0 / (circuit.port_ohm + self._ref_ohm)
        slope = (-self._weight * self._modelled**2)[:, None]
        prior = self._prior
        self._cell_std = np.sqrt(prior.cell_variance(self.state[0]))
        cells = self._current.size
        root = np.empty((cells, 3 * cells + 2))
        np.multiply(circuit.by_cell, slope * self._cell_std, out=root[:, :cells])
        np.multiply(circuit.by_top, slope * prior.segment_std, out=root[:, cells : 2 * cells])
        np.multiply(circuit.by_bottom, slope * prior.segment_std, out=root[:, 2 * cells : -2])
        layers = root[:, cells:-2].reshape(cells, 2, cells).sum(axis=2)
        root[:, -2:] = layers * (prior.layer_std / prior.segment_std)
        self._root = root
        self._residual = (self._current - self._modelled) * self._weight

    def _cost(self) -> float:
        """-2 log posterior: residuals, tails of the cells, wires about their layer's mean."""
        prior = self._prior
        cost = float(self._residual @ self._residual)
        away = (self.state[0] - prior.cell) / prior.cell_std
        if prior.tail is None:
            cost += float(away @ away)
        else:
            cost += float((prior.tail + 1) * np.log1p(away * away / prior.tail).sum())
        own, shared = prior.segment_std**2, prior.layer_std**2
        for wires in self.state[1:] - self._expected[1:]:
            total = wires.sum()
            square = wires @ wires - total * total * shared / (own + wires.size * shared)
            cost += float(square) / own
        return cost

    def _step(self) -> bool:
        """One step; True when it is so small that the linearisation still holds."""
        prior, cells = self._prior, self._current.size
        root = self._root
        away = self.state - self._expected
        wanted = self._residual + root[:, :cells] @ (away[0] / self._cell_std)
        wanted += root[:, cells:-2] @ (away[1:].ravel() / prior.segment_std)
        system = root @ root.T
        system[np.diag_indices_from(system)] += 1.0
        self._factor = scipy.linalg.cholesky(
            system, lower=True, overwrite_a=True, check_finite=False
        )
        left = scipy.linalg.cho_solve((self._factor, True), wanted, check_finite=False)
        pulled = left @ root
        step = np.empty_like(self.state)
        step[0] = self._cell_std * pulled[:cells]
        step[1:] = prior.segment_std * pulled[cells:-2].reshape(2, cells)
        step[1:] += prior.layer_std * pulled[-2:, None]
        step -= away
        # After this step the linearised residual is `left`.
        moved = max(
            float(np.abs(self._residual - left).max()),
            float(np.abs(step[0] / self._cell_std).max()),
        )
        longest = float(np.abs(step).max())
        self.state = self.state + step * min(1.0, MAX_STEP / max(longest, MAX_STEP))
        np.clip(self.state[0], *_LOG_CELL_LIMITS, out=self.state[0])
        np.clip(self.state[1:], *_LOG_WIRE_LIMITS, out=self.state[1:])
        return moved < CLOSE

    def _solution(self, iterations: int, message: str) -> Solution:
        rows, columns = self._shape
        siemens = np.exp(-self.state[0])
        own = scipy.linalg.solve_triangular(
            self._factor,
            self._root[:, : siemens.size],
            lower=True,
            overwrite_b=False,
            check_finite=False,
        )
        learned = np.einsum("ij,ij->j", own, own)
        std = self._cell_std * np.sqrt(np.maximum(1.0 - learned, 1e-12))
        return Solution(
            cell_siemens=siemens.reshape(rows, columns),
            cell_siemens_std=(siemens * std).reshape(rows, columns),
            chi2=self._estimator._chi2(self._ratio, self._modelled.reshape(rows, columns)),
            iterations=iterations,
            message=message,
            top_wire_ohm=np.exp(self.state[1]).reshape(rows, columns),
            bottom_wire_ohm=np.exp(self.state[2]).reshape(rows, columns),
        )
