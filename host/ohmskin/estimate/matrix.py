# SPDX-License-Identifier: Apache-2.0
"""Method `matrix`: all cells at once, without wires (the resistance-matrix approach).

Symbols

====== ============ ============================================================== =========
symbol shape        meaning                                                        unit
====== ============ ============================================================== =========
g      (R, C)       cell conductances, the unknowns, within 1e-9..1 S              S
Z      (R+C, R+C)   inverse Laplacian of the stripes (one stripe grounded)         ohm
rho    (R, C)       port resistance, Z[i,i] + Z[j,j] - 2 Z[i,j]                    ohm
v      (RC, RC)     v[p, e]: voltage over cell e for unit current through port p   V/A
I      (R, C)       port current per Vdd, 1 / (rho + R_top + R_bottom)             S
s      (R, C)       standard deviation of I, from that of the readings             S
r      (RC,)        residual (I_read - I(g)) / s                                   1
J      (RC, RC)     -dr/dg in units of the scale of g                              1
====== ============ ============================================================== =========

Without wires, each stripe is one node. So the cells are a network of R+C nodes, with RC unknowns
and as many port resistances. Minimised is |r|^2, the chi-square of the readings, with g within its
bounds. With d rho_p / d g_e = -v_pe^2 (Tellegen's theorem), the slopes are

    dI_p / dg_e = I_p^2 v_pe^2 .

They are exact, and all of them follow from one inverse of size R+C. Steps are those of
Levenberg-Marquardt, on the cells that no bound holds, scaled by max(g, 1e-7 S).

I is far from linear in g, because the reference resistors limit it. The port conductance
G = 1 / rho is nearly linear in g. So far from the solution, the residual of G is used in place of
r. As a current, and over s, it is

    r (1 + G_read R_s) / (1 + G R_s) ,   R_s = R_top + R_bottom .

With it, a skin of a single cell is solved in one step.

The first frame starts from its ports alone (`cells_of_ports`), and each cell is corrected by its
own port, G_read rho g in place of g, `CORRECTIONS` times.

`joint` starts from these cells, after one more step that also takes in what it expects of cells and
wires (`CellFit.nearer`).

Source: the network and its Jacobian are the resistance-matrix approach of Shu et al., IEEE Sensors
Journal 15(1), 2015; the weights, bounds and standard deviations are ours.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import lapack

from ohmskin.arrays import Float
from ohmskin.circuit.ports import cells_of_ports, port_difference, solve_ports
from ohmskin.circuit.small import gram, solve_positive
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS, SkinKnowledge
from ohmskin.estimate.ohm import conductance_from_current, port_current
from ohmskin.estimate.port_faults import MOST_CELLS_RATIO
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import MAX_STEP_LOG

# Most steps in a frame: one that does not converge must end, too. Chosen: twice what the hardest
# frame of the reference takes.
MAX_ITERATIONS: Final = 40
# Converged if an undamped step would lower the chi-square, summed over all ports, by less. Chosen:
# no cell then moves by more than 1/100, the root of this, of its standard deviation.
CHI2_TOLERANCE: Final = 1e-4
# Without a frame before, cells are corrected so often, by no more than this factor at once. Chosen:
# a correction takes a twentieth of the time of a step, and so many save two of three steps.
CORRECTIONS: Final = 8
MOST_CORRECTION: Final = 5.0
# The scale of a cell, in which its steps are counted, is its conductance, or this if that is less
# [S]. Chosen: a tenth of a cell at rest, so that one step can bring back an open cell.
SCALE_FLOOR_SIEMENS: Final = 1e-7
# Precision that a prior adds to each cell [1 / scale^2], so that the system stays definite. Chosen:
# a cell that the readings say nothing of has a deviation of 1000 scales.
_RIDGE: Final = 1e-6
# Above this chi-square per port, the residual of G is used, which leads near the minimum; below it,
# r is used, which leads to the minimum itself. Chosen: ten deviations of each port.
_FAR_CHI2: Final = 100.0
# With damping up to this share of the diagonal, a step is nearly one of Gauss-Newton, and may tell
# that the fit has converged. Chosen.
_LIGHT_DAMPING: Final = 1e-3
# A fit whose steps need more damping than this has failed. Chosen: such a step is lost in rounding.
_LARGEST_DAMPING: Final = 1e12
# A step is solved so often at most, each time with those cells held at their bound that would have
# gone beyond it. Chosen: cells that a few rounds do not find are found by the next step.
_BOUND_ROUNDS: Final = 5


def voltage_squared(impedance: Float, rows: int, scale: Float | float = 1.0) -> Float:
    """v^2 s = -d rho_p / d g_e s, (RC, RC) [ohm^2 s], for the port p = (i, j) and cell e = (k, l).

    v = (Z[i,k] - Z[i,l]) - (Z[j,k] - Z[j,l]), j and l the nodes of the columns; scale: s (RC,).
    """
    by_line = port_difference(impedance, rows).T * np.sqrt(scale)
    voltage = port_difference(by_line, rows)
    voltage *= voltage
    return voltage


class MatrixEstimator(Estimator):
    """No wires, all cells at once. Starts from the previous frame, or afresh if that is nearer.

    A frame has converged if, within `MAX_ITERATIONS`, no step lowers the chi-square any more by
    `CHI2_TOLERANCE`, and if the cells give the readings to within `MOST_CELLS_RATIO`. (That wires
    are neglected makes a tenth of this.)
    Standard deviations are the roots of the diagonal of (J^T J)^-1 at the solution, also for a
    cell that ends on a bound. They are wider by the root of |r|^2 / RC where that exceeds 1.
    """

    name = "matrix"

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._previous: Float | None = None

    def reset(self) -> None:
        """Forget the previous frame: the next one starts afresh."""
        super().reset()
        self._previous = None

    def _solve(self, ports: PortReadings) -> Solution:
        fit = CellFit(ports, self.knowledge.ref_ohm, self._previous)
        # A frame that did not converge is a poor start for the next one.
        cell, message = fit.best.cell, fit.message
        self._previous = None if message else cell
        chi2 = self._chi2(ports, fit.best.current.reshape(cell.shape))
        misfit_ratio = chi2**0.5 * self.knowledge.ratio_std
        if not message and misfit_ratio > MOST_CELLS_RATIO:
            message = f"no cells give these readings: they miss {100 * misfit_ratio:.0f} % of Vdd"
        return Solution(
            cell_siemens=cell,
            cell_siemens_std=fit.cell_std(),
            chi2=chi2,
            iterations=fit.iterations,
            message=message,
        )


class Trial(NamedTuple):
    """Cells, and how they explain the frame.

    cell: g (R, C) [S].
    impedance: Z (R+C, R+C) [ohm].
    current: I of the model (RC,) [S].
    residual: r (RC,) [1].
    chi2: |r|^2, summed over all ports.
    """

    cell: Float
    impedance: Float
    current: Float
    residual: Float
    chi2: float


class CellFit:
    """One frame's minimisation. It starts from the cells of the frame before, or afresh if that is
    nearer, and ends where no step lowers the chi-square by `tolerance`.

    best: the cells with the least chi-square so far; in the end, the answer.
    iterations: how many steps it took.
    message: why it did not converge, or empty.
    """

    def __init__(
        self,
        ports: PortReadings,
        ref_ohm: float,
        before: Float | None,
        tolerance: float = CHI2_TOLERANCE,
    ) -> None:
        self._shape, self._target = ports.current.shape, ports.current.ravel()
        self._current_std = ports.current_std.ravel()
        self._ref_ohm, self._tolerance = ref_ohm, tolerance
        self._far_chi2 = _FAR_CHI2 * self._target.size
        # 1 / (1 + G_read R_s). A larger current than the most conductive cell allows is cut.
        feasible = np.minimum(self._target, port_current(MAX_CELL_SIEMENS, ref_ohm))
        self._target_share = 1.0 - feasible * ref_ohm
        self.iterations = 0
        trial = self._afresh() if before is None else self._try(before)
        # After a sudden change, the frame before is far off.
        if before is not None and trial.chi2 > self._far_chi2:
            trial = min(trial, self._afresh(), key=lambda one: one.chi2)
        self._move_to(trial)
        self.message = self._run()

    def _afresh(self) -> Trial:
        """Cells by the ports of this frame alone."""
        port = conductance_from_current(self._target, self._ref_ohm).reshape(self._shape)
        cell = cells_of_ports(port)
        for _ in range(CORRECTIONS):
            factor = np.clip(port * solve_ports(cell)[0], 1 / MOST_CORRECTION, MOST_CORRECTION)
            cell = np.clip(factor * cell, MIN_CELL_SIEMENS, MAX_CELL_SIEMENS)
        return self._try(cell)

    def _try(self, cell: Float) -> Trial:
        """How these cells (R, C) [S] explain the frame."""
        port_ohm, impedance = solve_ports(cell)
        current = 1.0 / (port_ohm.ravel() + self._ref_ohm)
        residual = (self._target - current) / self._current_std
        return Trial(cell, impedance, current, residual, float(residual @ residual))

    def _move_to(self, trial: Trial) -> None:
        """Go on from these cells. Their slopes are made when they are needed: often never."""
        self.best, self._is_linearised = trial, False
        self._scale = np.maximum(trial.cell.ravel(), SCALE_FLOOR_SIEMENS)

    def _linearise(self) -> None:
        """J, the lower triangle of J^T J, and J^T r at the present cells, unless they are there."""
        if self._is_linearised:
            return
        self._is_linearised, self._unit = True, self._scale
        current, residual = self.best.current, self.best.residual
        jacobian = voltage_squared(self.best.impedance, len(self.best.cell), self._scale)
        jacobian *= (current**2 / self._current_std)[:, None]
        self._gradient: Float = residual @ jacobian
        stretch = (1.0 - current * self._ref_ohm) / self._target_share
        self._far_gradient: Float = (residual * stretch) @ jacobian
        self._jacobian, self._normal = jacobian, gram(jacobian.T)
        self._diagonal = np.diagonal(self._normal).copy()
        # Rounding of J^T J is relative to its largest element: the ridge must not drown in it.
        self._ridge = max(_RIDGE, 1e-14 * float(self._diagonal.max()))

    def _run(self) -> str:
        """Minimise. Returns why it did not converge, or an empty string."""
        damping = 0.0
        is_far = self.best.chi2 > self._far_chi2
        while self.iterations < MAX_ITERATIONS:
            if self.best.chi2 < self._tolerance:  # no step can lower it by more
                return ""
            self.iterations += 1
            self._linearise()
            gradient = self._far_gradient if is_far else self._gradient
            # Only near the solution is it worth the time to find out which cells a bound holds.
            cell = self._stepped(gradient, damping, 1 if is_far else _BOUND_ROUNDS)
            if cell is not None:
                # By so much the step would lower the chi-square if this were quadratic.
                gain = float((cell - self.best.cell).ravel() / self._scale @ self._gradient)
                # Where no cells explain the readings, the chi-square is large, and its rounding is
                # larger than the tolerance.
                tolerance = max(self._tolerance, 1e-9 * self.best.chi2)
                if abs(gain) < tolerance and damping <= _LIGHT_DAMPING and not is_far:
                    return ""
                trial = self._try(cell)
                if trial.chi2 < self.best.chi2:
                    self._move_to(trial)
                    damping = 0.0 if damping <= _LIGHT_DAMPING else damping / 10
                    is_far = is_far and trial.chi2 > self._far_chi2
                    continue
            # A step that did not help is tried again: first with r itself, then with more damping.
            if is_far:
                is_far = False
            else:
                damping = max(10 * _LIGHT_DAMPING, damping * 10)
                if damping > _LARGEST_DAMPING:
                    return "no step lowers the chi-square"
        return f"not converged after {MAX_ITERATIONS} iterations"

    def _stepped(self, gradient: Float, damping: float, rounds: int) -> Float | None:
        """The cells (R, C) [S] at the minimum of the quadratic model, within their bounds.

        (J^T J + damping diag(J^T J) + ridge) step = J^T r, scaled. Cells that the step takes over
        a bound are held there, and the step is solved again for the others, in so many rounds.
        None: the system is not positive definite to working precision.
        """
        cell = self.best.cell.ravel()
        lowest = (MIN_CELL_SIEMENS - cell) / self._scale
        highest = (MAX_CELL_SIEMENS - cell) / self._scale
        added = damping * self._diagonal + self._ridge
        held = ((lowest >= 0) & (gradient <= 0)) | ((highest <= 0) & (gradient >= 0))
        step = np.zeros_like(cell)
        for _ in range(rounds):
            target, free = gradient, ~held
            if not free.any():
                break
            if held.any():  # the steps of the held cells are a part of the solution
                system = self._normal[np.ix_(free, free)]
                by_held = self._jacobian[:, held] @ step[held]
                target = (gradient - by_held @ self._jacobian)[free]
            else:
                system = self._normal.copy(order="F")
            np.einsum("ii->i", system)[:] += added[free]
            _, step[free], failed = lapack.dposv(system, target, lower=1, overwrite_a=1)
            if failed:
                return None
            crossing = ((step < lowest) | (step > highest)) & free
            step = np.clip(step, lowest, highest)
            if not crossing.any():
                break
            held |= crossing
        stepped = np.clip(cell + step * self._scale, MIN_CELL_SIEMENS, MAX_CELL_SIEMENS)
        return np.asarray(stepped.reshape(self.best.cell.shape), dtype=np.float64)

    def nearer(self, centre: Float, variance: Float, lost_ohm: Float) -> Float:
        """Logs of the cells' resistances (RC,) [log ohm] after one more step, to the most probable.

        It is one of Gauss-Newton with the last J. No bound holds a cell, but no log moves by more
        than `MAX_STEP_LOG`.

        centre, variance: what is expected of these logs, a normal, (RC,).
        lost_ohm: what wires and leads add to the resistance of each port, (R, C) [ohm].
        """
        if not self.iterations:
            self._linearise()
        current, cell = self.best.current, self.best.cell.ravel()
        residual = self._target - current / (1.0 + current * lost_ohm.ravel())
        log_ohm, logs = -np.log(cell), self._unit / cell  # of a cell's step, as J has it
        system = self._normal.copy(order="F")
        np.einsum("ii->i", system)[:] += logs * logs / variance
        gradient = (residual / self._current_std) @ self._jacobian
        gradient += logs * (log_ohm - centre) / variance
        step = logs * solve_positive(system, gradient)
        return np.asarray(log_ohm - np.clip(step, -MAX_STEP_LOG, MAX_STEP_LOG))

    def cell_std(self) -> Float:
        """Root of the diagonal of (J^T J + ridge)^-1 [S], shape (R, C)."""
        self._linearise()
        system = self._normal.copy(order="F")
        np.einsum("ii->i", system)[:] += self._ridge
        factor, failed = lapack.dpotrf(system, lower=1, overwrite_a=1)
        if failed:
            return np.full(self.best.cell.shape, MAX_CELL_SIEMENS)  # nothing is known
        inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
        # A residual above the noise says that the model is wrong by that much.
        misfit = max(1.0, self.best.chi2 / len(self._scale)) ** 0.5
        std = misfit * self._scale * np.sqrt(np.diagonal(inverse))
        return np.asarray(std.reshape(self.best.cell.shape), dtype=np.float64)
