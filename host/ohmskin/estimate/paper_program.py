# SPDX-License-Identifier: Apache-2.0
"""The paper's optimization program as a CasADi expression, solved by Ipopt.

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

Each state has 2N + 1 equality constraints. With currents written as voltage differences over
resistances (Ohm's law), Kirchhoff's current law holds at each of the 2N nodes; and the measurement:
the sensed electrode is at y, and the current through its reference resistor enters the skin,

    A:  (y - V^t[i,0]) / R^t[i,0] = (1 - y) / R_top ,

B, C and D alike with the electrode and the supply exchanged. The other selected electrode is
reached through R^b[0,j] + R_bottom. All are multiplied by the reference resistor: they are ratios.

    Cost_f = sum over cells   |AP - BP|^2 + |CP - DP|^2
    Cost_c = sum over consecutive cells and over k   |kQ - kQ'|^2 ,   Q = R^t, R^b, R^c
    Cost_r = sum over states   |R^t|^2 + |R^b|^2
    minimised: alpha Cost_f + beta Cost_c + lambda Cost_r

The costs are in megohm as the paper has them; only the variables are logarithms. Source: section
IV.D to IV.G of the paper. docs/paper.md says which readings of the text were taken and why.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Final

import casadi
import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READING_OFFSET, READING_SENSES_TOP, READINGS_PER_CELL

# Resistances are believed to lie within [megohm].
MIN_MEGOHM: Final = 1e-6
MAX_MEGOHM: Final = 20.0

MAX_ITERATIONS: Final = 300
# Of the optimality error, and of Kirchhoff's and Ohm's laws as a ratio to Vdd.
TOLERANCE: Final = 1e-6
CIRCUIT_TOLERANCE: Final = 1e-9

# The top pin is high where the sensed electrode is the top one and on the source side, or neither.
TOP_IS_HIGH: Final = (READING_OFFSET > 0) == READING_SENSES_TOP


class Start(Enum):
    """Where a solution starts from, which decides how Ipopt's barrier starts."""

    CIRCUIT = "a simulated circuit: a weak barrier, so that the answer stays near it"
    STEP_3 = "another program's solution: the usual barrier"
    PREVIOUS = "this program's solution of the frame before, with its multipliers"


_IPOPT: Final[dict[str, Any]] = {
    "print_level": 0,
    "sb": "yes",
    "max_iter": MAX_ITERATIONS,
    "tol": TOLERANCE,
    "constr_viol_tol": CIRCUIT_TOLERANCE,
    "mu_strategy": "adaptive",
    "mu_oracle": "probing",
    # The constraints are ratios and the costs as weighted by the paper: nothing to rescale.
    "nlp_scaling_method": "none",
}
# What Ipopt ends with on Ctrl-C, which CasADi takes for itself. Nothing else throws in a program
# without callbacks: numbers that are none end as Invalid_Number_Detected.
_INTERRUPTED: Final = ("User_Requested_Stop", "NonIpopt_Exception_Thrown")
_IPOPT_START: Final[dict[Start, dict[str, Any]]] = {
    Start.CIRCUIT: {"bound_mult_init_val": 1e-6},
    Start.STEP_3: {},
    # The multipliers of bounds that do not hold stay as weak as they were, or the states drift.
    Start.PREVIOUS: {"warm_start_init_point": "yes", "warm_start_mult_bound_push": 1e-6},
}


@dataclass(frozen=True, eq=False)
class Optimum:
    """What Ipopt returned. x: shape (4N, 5N), a state per row. Multipliers serve a warm start."""

    x: Float
    bound_multipliers: Float
    constraint_multipliers: Float
    iterations: int
    status: str
    success: bool

    @property
    def megohm(self) -> Float:
        """R^t, R^b, R^c of all states [megohm], shape (4N, 3N)."""
        resistances: Float = np.exp(self.x[:, : 3 * (self.x.shape[1] // 5)])
        return resistances


class Program:
    """The program for one size of skin; readings, references and weights are its parameters."""

    def __init__(self, rows: int, columns: int) -> None:
        self.rows, self.columns = rows, columns
        cells = rows * columns
        readings = casadi.SX.sym("y", READINGS_PER_CELL * cells)
        references = casadi.SX.sym("ref", 2)
        weights = casadi.SX.sym("weights", 3)
        states = [
            _State(rows, columns, number, readings[number], references)
            for number in range(READINGS_PER_CELL * cells)
        ]
        cost_f, cost_c = _discrepancies(states)
        cost_r = sum(casadi.sumsqr(state.wires) for state in states)
        problem = {
            "x": casadi.vertcat(*(state.variables for state in states)),
            "f": weights[0] * cost_f + weights[1] * cost_c + weights[2] * cost_r,
            "g": casadi.vertcat(*(law for state in states for law in state.laws)),
            "p": casadi.vertcat(readings, references, weights),
        }
        self._solvers = {start: _make_solver(problem, start) for start in Start}
        is_resistance = np.arange(5 * cells) < 3 * cells
        least = np.where(is_resistance, np.log(MIN_MEGOHM), -np.inf)
        most = np.where(is_resistance, np.log(MAX_MEGOHM), np.inf)
        self._bounds = {
            "lbx": np.tile(least, len(states)),
            "ubx": np.tile(most, len(states)),
            "lbg": 0.0,
            "ubg": 0.0,
        }

    def solve(
        self,
        ratio: Float,
        reference_megohm: tuple[float, float],
        weights: tuple[float, float, float],
        x: Float,
        start: Start,
        previous: Optimum | None = None,
    ) -> Optimum:
        """Minimise from the states x (4N, 5N). ratio: (R, C, 4); references: top, bottom;
        weights: alpha, beta, lambda. `previous`, for `Start.PREVIOUS`, brings the multipliers."""
        arguments = dict(self._bounds)
        if previous is not None:
            arguments["lam_x0"] = previous.bound_multipliers
            arguments["lam_g0"] = previous.constraint_multipliers
        solver = self._solvers[start]
        # Column-major: rows run fastest, then columns.
        readings = ratio.transpose(1, 0, 2).ravel()
        parameters = np.concatenate([readings, reference_megohm, weights])
        found = solver(x0=x.ravel(), p=parameters, **arguments)
        report = solver.stats()
        if report["return_status"] in _INTERRUPTED:
            raise KeyboardInterrupt
        return Optimum(
            x=np.array(found["x"]).reshape(x.shape),
            bound_multipliers=np.array(found["lam_x"]).ravel(),
            constraint_multipliers=np.array(found["lam_g"]).ravel(),
            iterations=int(report["iter_count"]),
            status=str(report["return_status"]),
            success=bool(report["success"]),
        )


@lru_cache(maxsize=4)
def program_for(rows: int, columns: int) -> Program:
    """The program for this size, built once in a process."""
    return Program(rows, columns)


def _make_solver(problem: dict[str, Any], start: Start) -> Any:
    options = {f"ipopt.{name}": value for name, value in (_IPOPT | _IPOPT_START[start]).items()}
    quiet = {"print_time": False, "show_eval_warnings": False, "error_on_fail": False}
    # Sensitivities to the parameters are not needed, and warn where Ipopt gave up.
    quiet["calc_lam_p"] = False
    return casadi.nlpsol(f"paper_{start.name.lower()}", "ipopt", problem, options | quiet)


class _State:
    """One measurement's circuit: its variables, its resistances [megohm] and its laws."""

    def __init__(self, rows: int, columns: int, number: int, y: Any, references: Any) -> None:
        cells = rows * columns
        cell, k = divmod(number, READINGS_PER_CELL)
        self.variables = casadi.SX.sym(f"P{number}", 5 * cells)
        logarithms, self.potentials = casadi.vertsplit(self.variables, [0, 3 * cells, 5 * cells])
        self.resistances = casadi.exp(logarithms)
        self.wires = self.resistances[: 2 * cells]

        def layers(values: Any) -> list[Any]:
            parts = casadi.vertsplit(values, cells)
            return [casadi.reshape(part, rows, columns) for part in parts]

        # The paper's constraints use the inverse of resistance.
        conductances = layers(casadi.exp(-logarithms))
        top, bottom = layers(self.potentials)
        column, row = divmod(cell, rows)
        of_top, of_bottom, _ = layers(self.resistances)
        entering, leaving, measured = _electrodes(
            k,
            y,
            references,
            first=(of_top[row, 0], of_bottom[0, column]),
            inner=(top[row, 0], bottom[0, column]),
        )
        currents_in = {("top", row, 0): entering, ("bottom", 0, column): -leaving}
        laws = _kirchhoff(conductances, top, bottom, currents_in)
        self.laws = [law * references[0] for law in [*laws, measured]]


def _electrodes(
    k: int, y: Any, references: Any, first: tuple[Any, Any], inner: tuple[Any, Any]
) -> tuple[Any, Any, Any]:
    """Current into the row electrode, current out of the column electrode, and the measurement.

    first, inner: the first wire segment of the row and of the column, the potential behind it.
    """
    supply = (1.0, 0.0) if TOP_IS_HIGH[k] else (0.0, 1.0)
    sensed, other = (0, 1) if READING_SENSES_TOP[k] else (1, 0)
    into: list[Any] = [0.0, 0.0]
    into[sensed] = (y - inner[sensed]) / first[sensed]
    into[other] = (supply[other] - inner[other]) / (first[other] + references[other])
    measured = into[sensed] - (supply[sensed] - y) / references[sensed]
    return into[0], -into[1], measured


def _kirchhoff(
    conductances: list[Any], top: Any, bottom: Any, currents_in: dict[tuple[str, int, int], Any]
) -> list[Any]:
    """The sum of the currents into each node, top and bottom, all zero in a circuit."""
    of_top, of_bottom, of_cell = conductances
    rows, columns = top.shape
    laws = []
    for i in range(rows):
        for j in range(columns):
            through = of_cell[i, j] * (top[i, j] - bottom[i, j])
            into_top = currents_in.get(("top", i, j), 0.0) - through
            into_bottom = currents_in.get(("bottom", i, j), 0.0) + through
            if j > 0:
                into_top += of_top[i, j] * (top[i, j - 1] - top[i, j])
            if j + 1 < columns:
                into_top += of_top[i, j + 1] * (top[i, j + 1] - top[i, j])
            if i > 0:
                into_bottom += of_bottom[i, j] * (bottom[i - 1, j] - bottom[i, j])
            if i + 1 < rows:
                into_bottom += of_bottom[i + 1, j] * (bottom[i + 1, j] - bottom[i, j])
            laws += [into_top, into_bottom]
    return laws


def _discrepancies(states: list[_State]) -> tuple[Any, Any]:
    """Cost_f and Cost_c: states that should agree, of one cell and of consecutive cells."""
    cost_f: Any = 0.0
    cost_c: Any = 0.0
    for number in range(0, len(states), 2):
        first, second = states[number], states[number + 1]
        cost_f += casadi.sumsqr(first.resistances - second.resistances)
        cost_f += casadi.sumsqr(first.potentials - second.potentials)
    for before, after in zip(states, states[READINGS_PER_CELL:], strict=False):
        cost_c += casadi.sumsqr(before.resistances - after.resistances)
    return cost_f, cost_c
