# SPDX-License-Identifier: Apache-2.0
"""Methods `lsq` and `regularized`: the paper's Algorithm 1, up to its step 3 and up to its end.

    step 2   R^t, R^b = 0, R^c from Ohm's law, V^t, V^b from a circuit simulation;
             again with R^c of the method `matrix` if Ipopt does not succeed from there
    step 3   minimise Cost_lsq = 1e6 Cost_f + 1e6 Cost_c
    step 4   minimise Cost_reg = Cost_f + Cost_c + 1e9 Cost_r, from the result of step 3

Symbols (inside: megohm, microsiemens, and volts per Vdd)

============== ============ ==================================================================
symbol         shape        meaning
============== ============ ==================================================================
N              RC           cells
k                           configuration A, B, C or D
kP             5N           circuit state of one measurement: log R^t, log R^b, log R^c, V^t, V^b
R^t, R^b, R^c  (R, C)       top wire, bottom wire, cell resistance                [megohm]
V^t, V^b       (R, C)       potential of the top and the bottom node of each cell [Vdd]
x              20 N^2       all states: cells in column-major order, A to D for each cell
y              4N           the readings in the order of the states
============== ============ ==================================================================

Each state has 2N + 1 equality constraints: Kirchhoff's current law at 2N nodes, and its reading,

    A:  (y - V^t[i,0]) / R^t[i,0] = (1 - y) / R_top ,

B, C and D likewise, with the electrode and the supply exchanged. The other selected electrode is
reached through R^b[0,j] + R_bottom. All constraints are multiplied by the reference resistor, so
that they are ratios to Vdd.

The costs are in megohm. Only the variables are logarithms, so that no resistance can be negative.
The answer is the mean of the resistances over all 4N states. Source: sections IV.D to IV.G of the
paper. docs/paper.md defines the costs, and says how the text is interpreted and what can be
expected of the answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import zip_longest
from typing import Any, ClassVar, Final, NamedTuple

import casadi
import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import (
    READING_OFFSET,
    READING_SENSES_TOP,
    READINGS_PER_CELL,
    ratio_from_current,
)
from ohmskin.circuit.ports import port_difference, solve_ports
from ohmskin.circuit.skin import Skin, readings
from ohmskin.ctrl_c import ctrl_c_kept
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, SkinKnowledge
from ohmskin.estimate.matrix import CellFit
from ohmskin.estimate.port_faults import FAULT_STDS, cell_of
from ohmskin.estimate.port_readings import PortReadings

# Ohms in a megohm, by definition: the costs of the paper are in megohm (docs/paper.md says why).
OHM_PER_MEGOHM: Final = 1e6
# In which configurations the top pin is high. Where no current flows, a reading is 1 if its node is
# at the pin that is high. So the top pin is high if the top node reads 1, or the bottom node 0.
TOP_IS_HIGH: Final = (READING_OFFSET > 0) == READING_SENSES_TOP

# Most cells. Chosen: there are 20 N^2 variables, and 64 cells take 1.9 GB and 25 s a step
# (docs/paper.md).
MAX_CELLS: Final = 64
# Highest of any resistance; the least is that of `MAX_CELL_SIEMENS`, an ohm. Chosen: twenty cells
# at rest in series.
MAX_MEGOHM: Final = 20.0
# Most iterations of Ipopt in a step. Chosen: the frames of docs/paper.md that converge take fewer.
MAX_ITERATIONS: Final = 300
# Ipopt's `tol`, of the optimality error. Chosen: what Ipopt calls acceptable by default.
_TOLERANCE: Final = 1e-6
# How well Kirchhoff's and Ohm's laws hold, over Vdd. Chosen: a millionth of a code of 10 bits.
_CIRCUIT_TOLERANCE: Final = 1e-9
# Least and highest cell that step 2 starts from. Chosen: inside the bounds, because an interior
# point method begins poorly on a bound.
_START_CELL_MEGOHM: Final = (2e-6, 15.0)
# A port of less resistance has no solution inside the bounds. Chosen: a few times the least
# resistance, because it is that of several resistances in series.
_LEAST_PORT_MEGOHM: Final = 1e-5
# Ports of cells of more resistance have no solution inside the bounds, either. Chosen: a tenth less
# than the highest resistance.
_MOST_CELL_MEGOHM: Final = 18.0
# The mean of the states must give the readings to this root mean square, over Vdd. Else the states
# are different circuits, and their mean is none of them. Chosen: a code of 10 bits.
MISFIT_RATIO: Final = 1e-3
# A solution that has a higher resistance is a poor start for the next frame. Chosen: half of the
# highest resistance, because Ipopt leaves a bound slowly.
_POOR_START_MEGOHM: Final = 10.0
# If a reading has changed by more, over Vdd, a frame starts afresh. Chosen: 20 codes of 10 bits,
# which is far above noise.
_JUMP_RATIO: Final = 0.02

# Ipopt's options in all steps; its documentation explains each.
_IPOPT: Final[dict[str, Any]] = {
    "print_level": 0,
    "sb": "yes",
    "tol": _TOLERANCE,
    "constr_viol_tol": _CIRCUIT_TOLERANCE,
    "mu_strategy": "adaptive",
    "mu_oracle": "probing",
    # The constraints are ratios and the costs as weighted by the paper: nothing to rescale.
    "nlp_scaling_method": "none",
}
# More options, by where a solution starts from. "circuit": a simulated circuit; the barrier of the
# bounds is weak, so that the answer stays near this circuit. "step": the solution of the step
# before. "before": the solution of the frame before, with its multipliers; those of bounds that do
# not hold stay as weak as they were there, because else the states drift.
_STARTS: Final[dict[str, dict[str, Any]]] = {
    "circuit": {"bound_mult_init_val": 1e-6},
    "step": {},
    "before": {"warm_start_init_point": "yes", "warm_start_mult_bound_push": 1e-6},
}


class Step(NamedTuple):
    """One step of Algorithm 1.

    number: as in the paper.
    weights: of Cost_f, Cost_c and Cost_r.
    start: where it starts from if no frame was before: "circuit" or "step", see `_STARTS`.
    """

    number: int
    weights: tuple[float, float, float]
    start: str


STEP_3: Final = Step(3, (1e6, 1e6, 0.0), "circuit")
STEP_4: Final = Step(4, (1.0, 1.0, 1e9), "step")


@dataclass(frozen=True, eq=False)
class _Answer:
    """One frame, solved.

    ratio: its readings (R, C, 4) [V/Vdd].
    optima: what each step ended in.
    skin: the mean circuit of all states of the last step.
    model_ratio: the readings of this mean circuit (R, C, 4) [V/Vdd].
    """

    ratio: Float
    optima: Sequence[Optimum]
    skin: Skin
    model_ratio: Float

    @property
    def misfit_ratio(self) -> float:
        """How far the mean circuit misses the readings, root of the mean square [V/Vdd]."""
        return float(np.sqrt(np.mean((self.ratio - self.model_ratio) ** 2)))

    @property
    def is_good_start(self) -> bool:
        """Whether the next frame may start from this one."""
        return self.misfit_ratio < MISFIT_RATIO and all(
            optimum.success and optimum.megohm.max() < _POOR_START_MEGOHM for optimum in self.optima
        )


class PaperEstimator(Estimator):
    """Algorithm 1, in these `steps`.

    Each step starts from its own solution of the frame before, if that was good and no reading has
    changed by more than 0.02 of Vdd since. Otherwise it starts as Algorithm 1 says. A solution is
    good if it converged and all its resistances are below 10 megohm. If a warm start does not end
    in a good solution, the frame is solved again from step 2, and if that fails too, from the cells
    that `matrix` finds.

    A frame has converged if Ipopt succeeded in the last step, some circuit of the allowed
    resistances gives the readings, and the reported mean circuit gives them to 1e-3 of Vdd.
    `iterations` counts those of all attempts. Standard deviations are NaN. Raises ValueError for
    more than 64 cells.
    """

    takes_partial: ClassVar[bool] = False
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
        top_ohm, bottom_ohm = knowledge.ref_top_ohm, knowledge.ref_bottom_ohm
        self._reference_megohm = top_ohm / OHM_PER_MEGOHM, bottom_ohm / OHM_PER_MEGOHM
        self._previous: _Answer | None = None

    def reset(self) -> None:
        """Forget the previous frame: the next one starts from step 2."""
        super().reset()
        self._previous = None

    def _solve(self, ports: PortReadings) -> Solution:
        knowledge = self.knowledge
        current, message = self._feasible(ports.current)
        # The four readings of a cell are taken as its one current gives them. The paper's states
        # have no noise: if four readings disagree by a fraction of a code, no circuit gives them.
        ratio = ratio_from_current(current, knowledge.ref_top_ohm, knowledge.ref_bottom_ohm)
        before, answers = self._previous, []
        if before is not None and np.abs(ratio - before.ratio).max() < _JUMP_RATIO:
            answers.append(self._answer(ratio, before.optima[0].x, before.optima))
        if not answers or not answers[0].is_good_start:
            answers.append(self._afresh(ratio, 1.0 / current - knowledge.ref_ohm))
            if not answers[-1].is_good_start:
                fit = CellFit(replace(ports, current=current), knowledge.ref_ohm, None)
                answers.append(self._afresh(ratio, 1.0 / fit.best.cell))
        # A good one if there is any; of several, the one that gives the readings best.
        answer = min(answers, key=lambda one: (not one.is_good_start, one.misfit_ratio))
        self._previous = answer if answer.is_good_start else None
        last = answer.optima[-1]
        if not last.success:
            message = f"step {self.steps[-1].number}: Ipopt ends with {last.status}"
        elif not message and answer.misfit_ratio >= MISFIT_RATIO:
            message = (
                f"Ipopt ends with {last.status}, but in states of different circuits: their mean "
                f"misses the readings by {answer.misfit_ratio:.2g} of Vdd"
            )
        residual = (ports.ratio - answer.model_ratio) / knowledge.ratio_std
        skin = answer.skin
        return Solution(
            cell_siemens=skin.cell_siemens,
            cell_siemens_std=np.full(skin.shape, np.nan),
            chi2=float(np.mean(residual**2)),
            iterations=sum(optimum.iterations for one in answers for optimum in one.optima),
            message=message,
            wire_ohm=np.stack([skin.top_wire_ohm, skin.bottom_wire_ohm]),
        )

    def _afresh(self, ratio: Float, cell_ohm: Float) -> _Answer:
        """Algorithm 1 from step 2 on, with these cells."""
        cell_megohm = cell_ohm / OHM_PER_MEGOHM
        x = initial_states(cell_megohm, self._reference_megohm, self.start_wire_megohm)
        return self._answer(ratio, x)

    def _answer(self, ratio: Float, x: Float, before: Sequence[Optimum] = ()) -> _Answer:
        """Solve all steps.

        x: the states (4N, 5N) that the first step starts from. Each of the others starts where the
        step before it ended.
        before: the optima of the frame before, one for each step. If there are any, each step
        starts from its own instead.
        """
        optima: list[Optimum] = []
        for step, previous in zip_longest(self.steps, before):
            x = x if previous is None else previous.x
            optima.append(self._program.solve(ratio, self._reference_megohm, step, x, previous))
            x = optima[-1].x
        knowledge = self.knowledge
        layers = optima[-1].megohm.mean(axis=0).reshape(3, knowledge.columns, knowledge.rows)
        top, bottom, cell = (OHM_PER_MEGOHM * layer.T for layer in layers)
        skin = Skin(1.0 / cell, top, bottom, knowledge.ref_top_ohm, knowledge.ref_bottom_ohm)
        return _Answer(ratio, optima, skin, readings(skin))

    def _feasible(self, current: Float) -> tuple[Float, str]:
        """The currents (R, C) [S], within what some circuit allows, and in words which was not."""
        knowledge = self.knowledge
        rows, columns = knowledge.rows, knowledge.columns
        # The port of a skin without wires, whose cells are all alike, in shares of a cell.
        share = (rows + columns - 1) / (rows * columns)
        ports_ohm = OHM_PER_MEGOHM * np.array([_MOST_CELL_MEGOHM * share, _LEAST_PORT_MEGOHM])
        feasible = np.clip(current, *1.0 / (ports_ohm + knowledge.ref_ohm))
        excess = np.abs(current - feasible)
        if excess.max() <= FAULT_STDS * knowledge.current_std:
            return feasible, ""
        allowed = f"from {ports_ohm[1]:.0f} to {ports_ohm[0]:.3g} ohm"
        cell = cell_of(excess.argmax(), excess)
        return feasible, f"the current of {cell} is none of a port {allowed}"


class LsqEstimator(PaperEstimator):
    """Algorithm 1 without regularization: Cost_lsq alone, so the answer depends on the start."""

    name = "lsq"
    steps = (STEP_3,)


class RegularizedEstimator(PaperEstimator):
    """Algorithm 1 to the end: wires as small as the circuit's laws allow."""

    name = "regularized"
    steps = (STEP_3, STEP_4)


def initial_states(
    cell_megohm: Float, reference_megohm: tuple[float, float], wire_megohm: float
) -> Float:
    """Step 2: the states (4N, 5N) of these cells (R, C), all wires alike, by a simulation.

    The simulation has no wires, so all nodes of a stripe have the potential of its electrode.
    """
    cell = np.clip(cell_megohm, *_START_CELL_MEGOHM)
    rows, columns = cell.shape
    ports = np.arange(cell.size)
    port_megohm, impedance = solve_ports(1.0 / cell)
    current = 1.0 / (port_megohm.ravel() + sum(reference_megohm))
    potential = port_difference(impedance, rows) * current[:, None]
    ground = potential[ports, rows + ports % columns]
    # The column's electrode is above ground by what the bottom reference loses.
    potential += (reference_megohm[1] * current - ground)[:, None]
    potential = potential[ports.reshape(rows, columns).T.ravel()]  # by column-major selected cell
    top, bottom = np.hsplit(potential, [rows])
    high_top = np.hstack([np.tile(top, columns), np.repeat(bottom, rows, axis=1)])
    wire = np.full(cell.size, wire_megohm)
    states = np.empty((cell.size, READINGS_PER_CELL, 5 * cell.size))
    states[..., : 3 * cell.size] = np.log(np.concatenate([wire, wire, cell.T.ravel()]))
    # Exchanging high and low mirrors every potential.
    for k in range(READINGS_PER_CELL):
        states[:, k, 3 * cell.size :] = high_top if TOP_IS_HIGH[k] else 1.0 - high_top
    return states.reshape(READINGS_PER_CELL * cell.size, 5 * cell.size)


@dataclass(frozen=True, eq=False)
class Optimum:
    """What Ipopt returned.

    x: the states (4N, 5N), one a row.
    multipliers: of bounds and of constraints, as Ipopt takes them for a warm start.
    iterations: how many Ipopt took.
    status: how it ended, in Ipopt's words.
    success: whether Ipopt calls that a success, and all numbers are finite.
    """

    x: Float
    multipliers: dict[str, Float]
    iterations: int
    status: str
    success: bool

    @property
    def megohm(self) -> Float:
        """R^t, R^b, R^c of all states [megohm], shape (4N, 3N)."""
        resistances: Float = np.exp(self.x[:, : 3 * (self.x.shape[1] // 5)])
        return resistances


class Program:
    """The nonlinear program for one size of skin.

    Readings, references and weights are its parameters, so it is built once for all frames.
    """

    @ctrl_c_kept()
    def __init__(self, rows: int, columns: int) -> None:
        cells = rows * columns
        y = casadi.SX.sym("y", READINGS_PER_CELL * cells)
        references = casadi.SX.sym("ref", 2)
        weights = casadi.SX.sym("weights", 3)
        states = [
            _State(rows, columns, number, y[number], references) for number in range(y.shape[0])
        ]
        # States that should agree: of one cell, and of consecutive cells.
        cost_f = sum(
            casadi.sumsqr(getattr(first, values) - getattr(second, values))
            for first, second in zip(states[::2], states[1::2], strict=True)
            for values in ("resistances", "potentials")
        )
        cost_c = sum(
            casadi.sumsqr(before.resistances - after.resistances)
            for before, after in zip(states, states[READINGS_PER_CELL:], strict=False)
        )
        cost_r = sum(casadi.sumsqr(state.wires) for state in states)
        problem = {
            "x": casadi.vertcat(*(state.variables for state in states)),
            "f": weights[0] * cost_f + weights[1] * cost_c + weights[2] * cost_r,
            "g": casadi.vertcat(*(state.laws for state in states)),
            "p": casadi.vertcat(y, references, weights),
        }
        self._solvers = {
            start: _make_solver(problem, more | {"max_iter": MAX_ITERATIONS})
            for start, more in _STARTS.items()
        }
        # Bounds of the variables: resistances have some, potentials none. All laws must be zero.
        is_resistance = np.tile(np.arange(5 * cells) < 3 * cells, len(states))
        least = np.where(is_resistance, -np.log(OHM_PER_MEGOHM * MAX_CELL_SIEMENS), -np.inf)
        most = np.where(is_resistance, np.log(MAX_MEGOHM), np.inf)
        self._bounds = {"lbx": least, "ubx": most, "lbg": 0.0, "ubg": 0.0}

    @ctrl_c_kept()
    def solve(
        self,
        ratio: Float,
        reference_megohm: tuple[float, float],
        step: Step,
        x: Float,
        previous: Optimum | None = None,
    ) -> Optimum:
        """Minimise, from the states x (4N, 5N). They are also the answer if Ipopt finds no numbers.

        ratio: readings (R, C, 4) [V/Vdd]. reference_megohm: top, bottom. previous: the optimum that
        x is from, if it is of the frame before.
        """
        multipliers = {} if previous is None else previous.multipliers
        solver = self._solvers[step.start if previous is None else "before"]
        # Column-major: rows run fastest, then columns.
        y = ratio.transpose(1, 0, 2).ravel()
        parameters = np.concatenate([y, reference_megohm, step.weights])
        result = solver(x0=x.ravel(), p=parameters, **self._bounds, **multipliers)
        report = solver.stats()
        states = np.array(result["x"]).reshape(x.shape)
        is_finite = bool(np.isfinite(states).all())
        return Optimum(
            x=states if is_finite else x,
            multipliers={f"{name}0": np.array(result[name]).ravel() for name in ("lam_x", "lam_g")},
            iterations=int(report["iter_count"]),
            status=str(report["return_status"]) or "Invalid_Number_Detected",
            success=bool(report["success"]) and is_finite,
        )


# The program for a size, built once in a process, because building takes long.
program_for = lru_cache(maxsize=4)(Program)


def _make_solver(problem: dict[str, Any], more: dict[str, Any]) -> Any:
    options = {f"ipopt.{name}": value for name, value in (_IPOPT | more).items()}
    # Sensitivities to the parameters (lam_p) are not needed, and warn where Ipopt gave up.
    for name in ("print_time", "show_eval_warnings", "error_on_fail", "calc_lam_p"):
        options[name] = False
    return casadi.nlpsol("paper", "ipopt", problem, options)


class _State:
    """The circuit of one measurement.

    variables: what Ipopt changes (5N,): logs of resistances, then potentials.
    resistances: R^t, R^b, R^c (3N,) [megohm]. potentials: V^t, V^b (2N,) [Vdd].
    wires: R^t, R^b (2N,) [megohm].
    laws: 2N + 1 expressions that are zero where Kirchhoff's and Ohm's laws hold.
    """

    def __init__(self, rows: int, columns: int, number: int, y: Any, references: Any) -> None:
        cells = rows * columns
        cell, k = divmod(number, READINGS_PER_CELL)
        column, row = divmod(cell, rows)
        self.variables = casadi.SX.sym(f"P{number}", 5 * cells)
        logarithms, self.potentials = casadi.vertsplit(self.variables, [0, 3 * cells, 5 * cells])
        self.resistances = casadi.exp(logarithms)
        self.wires = self.resistances[: 2 * cells]

        def layers(values: Any) -> list[Any]:
            parts = casadi.vertsplit(values, cells)
            return [casadi.reshape(part, rows, columns) for part in parts]

        # The paper's constraints use the inverse of resistance.
        by_top, by_bottom, by_cell = layers(casadi.exp(-logarithms))
        top, bottom = layers(self.potentials)
        of_top, of_bottom, _ = layers(self.resistances)  # R^t and R^b
        # Each pair is that of the row and that of the column: the first wire segment, the potential
        # behind it, and the supply.
        first, inner = (of_top[row, 0], of_bottom[0, column]), (top[row, 0], bottom[0, column])
        supply = (1.0, 0.0) if TOP_IS_HIGH[k] else (0.0, 1.0)
        sensed, other = (0, 1) if READING_SENSES_TOP[k] else (1, 0)
        # Currents from the row's electrode and from the column's into the skin. That of the sensed
        # electrode follows from the reading, and the same current flows through its reference.
        into: list[Any] = [0.0, 0.0]
        into[sensed] = (y - inner[sensed]) / first[sensed]
        into[other] = (supply[other] - inner[other]) / (first[other] + references[other])
        measured = into[sensed] - (supply[sensed] - y) / references[sensed]
        # Kirchhoff's law: the currents into each node are zero together. Their terms must stay in
        # this order: `lsq` has no unique answer, and rounding decides where it ends.
        through = by_cell * (top - bottom)
        into_top, into_bottom = -through, casadi.SX(through)
        into_top[row, 0] += into[0]
        into_bottom[0, column] += into[1]
        into_top[:, 1:] += by_top[:, 1:] * (top[:, :-1] - top[:, 1:])
        into_top[:, :-1] += by_top[:, 1:] * (top[:, 1:] - top[:, :-1])
        into_bottom[1:, :] += by_bottom[1:, :] * (bottom[:-1, :] - bottom[1:, :])
        into_bottom[:-1, :] += by_bottom[1:, :] * (bottom[1:, :] - bottom[:-1, :])
        nodes = casadi.horzcat(casadi.vec(into_top.T), casadi.vec(into_bottom.T))
        self.laws = references[0] * casadi.vertcat(casadi.vec(nodes.T), measured)
