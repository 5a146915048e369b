# SPDX-License-Identifier: Apache-2.0
"""Methods `lsq` and `regularized`: the paper's Algorithm 1, after step 3 and to its end.

    step 2   R^t, R^b = 0, R^c from Ohm's law, V^t, V^b from a circuit simulation
    step 3   minimise Cost_lsq = 1e6 Cost_f + 1e6 Cost_c
    step 4   minimise Cost_reg = Cost_f + Cost_c + 1e9 Cost_r, from the result of step 3

`paper_program` has the symbols, the costs and the constraints; docs/paper.md what can be expected
of them. Every state has resistances of its own: reported is their mean over all 4RC states.
Resistances are megohm, conductances microsiemens, potentials volts per Vdd.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import (
    CONFIGURATIONS,
    READINGS_PER_CELL,
    Skin,
    current_from_ratio,
    ratio_from_current,
    readings,
)
from ohmskin.estimate.base import Estimator, SkinKnowledge, Solution
from ohmskin.estimate.paper_program import TOP_IS_HIGH, Optimum, Start, program_for
from ohmskin.estimate.port_readings import PortReadings

OHM_PER_MEGOHM: Final = 1e6

# 20 N^2 variables: 64 cells take 1.9 GB and 25 s a step.
MAX_CELLS: Final = 64
_START_CELL_MEGOHM: Final = (2e-6, 15.0)
# Ports whose resistance is outside have no solution within the bounds, or none but on them.
_LEAST_PORT_MEGOHM: Final = 1e-5
_MOST_CELL_MEGOHM: Final = 18.0
# Beyond such a port by this many standard deviations a reading is at fault.
_FAULT_STDS: Final = 5.0
# The states' mean must give back the readings to this (root mean square): if not, the states are
# different circuits, and their mean is none of them.
MISFIT_RATIO: Final = 1e-3
# A solution with a resistance near its bound is a poor start for the next frame.
_POOR_START_MEGOHM: Final = 10.0
# A frame any of whose readings changed by more than this starts afresh.
_JUMP_RATIO: Final = 0.02


@dataclass(frozen=True)
class Step:
    """One step of Algorithm 1: its number and the weights of its objective."""

    number: int
    alpha: float
    beta: float
    lambda_: float
    start: Start


STEP_3: Final = Step(3, 1e6, 1e6, 0.0, Start.CIRCUIT)
STEP_4: Final = Step(4, 1.0, 1.0, 1e9, Start.STEP_3)


@dataclass(frozen=True, eq=False)
class _Answer:
    """One frame solved: its readings, each step's optimum, the mean circuit and its readings."""

    ratio: Float
    optima: tuple[Optimum, ...]
    skin: Skin
    model_ratio: Float

    @property
    def iterations(self) -> int:
        return sum(optimum.iterations for optimum in self.optima)

    @property
    def misfit_ratio(self) -> float:
        return float(np.sqrt(np.mean((self.ratio - self.model_ratio) ** 2)))

    @property
    def is_good_start(self) -> bool:
        return self.misfit_ratio < MISFIT_RATIO and all(
            optimum.success and optimum.megohm.max() < _POOR_START_MEGOHM for optimum in self.optima
        )


class PaperEstimator(Estimator):
    """Algorithm 1 through `steps`.

    Each step starts from its own solution of the frame before, where that was good and no reading
    changed by more than 0.02 since, and otherwise as Algorithm 1 says. Good: converged, and all
    resistances are below 10 megohm. A frame whose warm start ends otherwise is solved again from
    step 2.
    Converged: Ipopt succeeded in the last step (300 iterations, tolerance 1e-6, circuit laws to
    1e-9 of Vdd), the readings are such that some circuit of the allowed resistances gives them, and
    the reported mean circuit gives them to 1e-3 of Vdd. `iterations` is the sum over all that was
    solved. The paper gives no uncertainty: standard deviations are NaN.
    Raises ValueError for more than 64 cells.
    """

    steps: ClassVar[tuple[Step, ...]]
    # Step 2's "zero": a logarithm cannot be zero. The least wire of the paper's simulations.
    start_wire_megohm: ClassVar[float] = 1e-4

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        if knowledge.rows * knowledge.columns > MAX_CELLS:
            raise ValueError(
                f"method '{self.name}' is for {MAX_CELLS} cells at most, as its unknowns grow "
                f"with the square: choose another for {knowledge.rows}x{knowledge.columns}"
            )
        # Built here, not in the first frame's time.
        self._program = program_for(knowledge.rows, knowledge.columns)
        self._reference_megohm = (
            knowledge.ref_top_ohm / OHM_PER_MEGOHM,
            knowledge.ref_bottom_ohm / OHM_PER_MEGOHM,
        )
        self._previous: _Answer | None = None

    def reset(self) -> None:
        """Forget the previous frame: the next one starts from step 2."""
        self._previous = None

    def _solve(self, ports: PortReadings) -> Solution:
        ratio = ports.ratio
        known = self.knowledge
        feasible, message = self._feasible(ratio)
        answer: _Answer | None = None
        iterations = 0
        before = self._previous
        if before is not None and np.abs(feasible - before.ratio).max() < _JUMP_RATIO:
            answer = self._answer(feasible, before.optima)
            iterations = answer.iterations
        if answer is None or not answer.is_good_start:
            answer = self._answer(feasible, ())
            iterations += answer.iterations
        self._previous = answer if answer.is_good_start else None
        last = answer.optima[-1]
        if not last.success:
            message = f"step {self.steps[-1].number}: Ipopt ends with {last.status}"
        elif not message and answer.misfit_ratio >= MISFIT_RATIO:
            message = (
                f"Ipopt ends with {last.status}, but in states of different circuits: their mean "
                f"misses the readings by {answer.misfit_ratio:.2g} of Vdd"
            )
        residual = (ratio - answer.model_ratio) / known.ratio_std
        found = answer.skin
        return Solution(
            cell_siemens=found.cell_siemens,
            cell_siemens_std=np.full(found.shape, np.nan),
            chi2=float(np.mean(residual**2)),
            iterations=iterations,
            message=message,
            top_wire_ohm=found.top_wire_ohm,
            bottom_wire_ohm=found.bottom_wire_ohm,
        )

    def _answer(self, ratio: Float, previous: tuple[Optimum, ...]) -> _Answer:
        known = self.knowledge
        optima = self._run(ratio, previous)
        layers = optima[-1].megohm.mean(axis=0).reshape(3, known.columns, known.rows)
        top, bottom, cell = (OHM_PER_MEGOHM * layer.T for layer in layers)
        skin = Skin(1.0 / cell, top, bottom, known.ref_top_ohm, known.ref_bottom_ohm)
        return _Answer(ratio, optima, skin, readings(skin))

    def _run(self, ratio: Float, previous: tuple[Optimum, ...]) -> tuple[Optimum, ...]:
        """Steps 2 to the last one, or without step 2 if there is a previous frame."""
        optima: list[Optimum] = []
        for place, step in enumerate(self.steps):
            before = previous[place] if previous else None
            start = Start.PREVIOUS if before is not None else step.start
            if before is not None:
                x = before.x
            elif optima and np.isfinite(optima[-1].x).all():
                x = optima[-1].x
            else:
                x = initial_states(ratio, self._reference_megohm, self.start_wire_megohm)
            weights = (step.alpha, step.beta, step.lambda_)
            optimum = self._program.solve(ratio, self._reference_megohm, weights, x, start, before)
            if not np.isfinite(optimum.x).all():
                optimum = _given_up(optimum, x)
            optima.append(optimum)
        return tuple(optima)

    def _feasible(self, ratio: Float) -> tuple[Float, str]:
        """The readings within what some circuit within the bounds allows; what was wrong, if."""
        known = self.knowledge
        cells = known.rows * known.columns
        # The port of a skin whose cells are all alike and whose wires are zero.
        most_megohm = _MOST_CELL_MEGOHM * (known.rows + known.columns - 1) / cells
        ports_ohm = OHM_PER_MEGOHM * np.array([_LEAST_PORT_MEGOHM, most_megohm])
        limits = ratio_from_current(
            1.0 / (ports_ohm + known.ref_ohm), known.ref_top_ohm, known.ref_bottom_ohm
        )
        feasible = np.clip(ratio, limits.min(axis=0), limits.max(axis=0))
        excess = np.abs(ratio - feasible)
        if excess.max() <= _FAULT_STDS * known.ratio_std:
            return feasible, ""
        row, column, k = (int(n) for n in np.unravel_index(int(np.argmax(excess)), excess.shape))
        return feasible, (
            f"reading {CONFIGURATIONS[k]} of cell ({row}, {column}) is none of a port from "
            f"{ports_ohm[0]:.0f} ohm to {most_megohm:.3g} megohm"
        )


class LsqEstimator(PaperEstimator):
    """Algorithm 1 without regularization: Cost_lsq alone, so the answer depends on the start."""

    name = "lsq"
    steps = (STEP_3,)


class RegularizedEstimator(PaperEstimator):
    """Algorithm 1 to the end: wires as small as the circuit's laws allow."""

    name = "regularized"
    steps = (STEP_3, STEP_4)


def initial_states(
    ratio: Float, reference_megohm: tuple[float, float], wire_megohm: float
) -> Float:
    """Step 2: the states (4N, 5N) of wires all alike and cells by Ohm's law, simulated.

    ratio: readings (R, C, 4), each within what a port of positive resistance gives.
    """
    rows, columns, _ = ratio.shape
    cells = rows * columns
    current = current_from_ratio(ratio, *reference_megohm)
    cell = np.clip(1.0 / current - sum(reference_megohm), *_START_CELL_MEGOHM)
    wire = np.full(cells, wire_megohm)
    resistances = np.concatenate([wire, wire, cell.T.ravel()])
    states = np.empty((cells, READINGS_PER_CELL, 5 * cells))
    states[..., : 3 * cells] = np.log(resistances)
    high_top = _simulate(cell, reference_megohm, wire_megohm)
    # Exchanging high and low mirrors every potential.
    for k in range(READINGS_PER_CELL):
        states[:, k, 3 * cells :] = high_top if TOP_IS_HIGH[k] else 1.0 - high_top
    return states.reshape(READINGS_PER_CELL * cells, 5 * cells)


def _simulate(cell: Float, reference_megohm: tuple[float, float], wire_megohm: float) -> Float:
    """Node potentials V^t, V^b with the top pin high, shape (N, 2N), cells in column-major order.

    Solves the 2N-node Laplacian [microsiemens] once for each selected cell.
    """
    rows, columns = cell.shape
    cells = rows * columns
    laplacian = np.zeros((2, columns, rows, 2, columns, rows))

    def join(first: tuple[int, int, int], second: tuple[int, int, int], siemens: float) -> None:
        for a, b in ((first, second), (second, first)):
            laplacian[a + a] += siemens
            laplacian[a + b] -= siemens

    for i in range(rows):
        for j in range(columns):
            join((0, j, i), (1, j, i), 1.0 / cell[i, j])
            if j:
                join((0, j, i), (0, j - 1, i), 1.0 / wire_megohm)
            if i:
                join((1, j, i), (1, j, i - 1), 1.0 / wire_megohm)
    system = np.repeat(laplacian.reshape(1, 2 * cells, 2 * cells), cells, axis=0)
    injected = np.zeros((cells, 2 * cells, 1))
    selected = np.arange(cells)
    column, row = np.divmod(selected, rows)
    by_top, by_bottom = (1.0 / (wire_megohm + ohm) for ohm in reference_megohm)
    at_top, at_bottom = row, cells + column * rows
    system[selected, at_top, at_top] += by_top
    system[selected, at_bottom, at_bottom] += by_bottom
    injected[selected, at_top, 0] = by_top
    return np.asarray(np.linalg.solve(system, injected)[..., 0], dtype=np.float64)


def _given_up(optimum: Optimum, x: Float) -> Optimum:
    """The start in place of a solution that is not a number."""
    return Optimum(
        x=x,
        bound_multipliers=np.zeros_like(optimum.bound_multipliers),
        constraint_multipliers=np.zeros_like(optimum.constraint_multipliers),
        iterations=optimum.iterations,
        status=optimum.status or "Invalid_Number_Detected",
        success=False,
    )
