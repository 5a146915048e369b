# SPDX-License-Identifier: Apache-2.0
"""Method `matrix`: all cells at once, wires neglected (the resistance-matrix approach).

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

Each stripe is one node, so g is a bipartite network of R+C nodes and RC unknowns, with as many port
resistances. Minimised is |r|^2, that is the chi-square of the readings, over the bounds of g.
With d rho_p / d g_e = -v_pe^2 [Tellegen's theorem],

    dI_p / dg_e = I_p^2 v_pe^2 ,

exact, and all of it follows from one inverse of size R+C. Steps are Levenberg-Marquardt on the
cells that no bound holds, scaled by max(g, 1e-7 S). Far from the solution r is replaced by

    r (1 + G_read R) / (1 + G R) ,   G = 1 / rho ,   R = R_top + R_bottom ,

the residual of the port conductance G carried over to the current: G is nearly linear in g, I
saturates, and a lone cell is then solved in one step.

Source: the network and its Jacobian are the resistance-matrix approach of Shu et al., IEEE Sensors
Journal 15(1), 2015; the weights, bounds and standard deviations are ours.
"""

from typing import Final

import numpy as np
from scipy.linalg import lapack

from ohmskin.arrays import Float
from ohmskin.circuit.skin import impedance_of, port_difference
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS, SkinKnowledge
from ohmskin.estimate.ohm import conductance_from_current, port_current
from ohmskin.estimate.port_readings import PortReadings

MAX_ITERATIONS: Final = 40
# Converged when an undamped step would lower the chi-square (summed, not per reading) by less:
# no cell then moves by more than 1/100 of its standard deviation.
CHI2_TOLERANCE: Final = 1e-4
# Steps are relative to the conductance, but an open cell must be able to come back in one step.
SCALE_FLOOR_SIEMENS: Final = 1e-7
# Prior precision in scaled units: a cell the readings say nothing of gets std 1000 times its scale.
_RIDGE: Final = 1e-6
# Below this chi-square per port r itself is used: it leads to the minimum, the other to near it.
_FAR_CHI2: Final = 100.0
_LIGHT_DAMPING: Final = 1e-3
_LARGEST_DAMPING: Final = 1e12
_BOUND_ROUNDS: Final = 5


def solve_ports(cell_siemens: Float) -> tuple[Float, Float]:
    """rho (R, C) [ohm] and Z of cells (R, C), all > 0 [S], whose stripes have no resistance."""
    rows, columns = cell_siemens.shape
    laplacian = np.zeros((rows + columns, rows + columns))
    laplacian[:rows, rows:] = -cell_siemens
    laplacian[rows:, :rows] = -cell_siemens.T
    degree = np.concatenate([cell_siemens.sum(axis=1), cell_siemens.sum(axis=0)])
    laplacian.ravel()[:: rows + columns + 1] = degree
    impedance, port_ohm = impedance_of(laplacian, rows)
    return np.maximum(port_ohm, 0.0), impedance


def voltage_squared(impedance: Float, rows: int) -> Float:
    """v^2, shape (RC, RC): row p = (i, j), column e = (k, l), -d rho_p / d g_e [ohm^2].

    v = (Z[i,k] - Z[i,l]) - (Z[j,k] - Z[j,l]) with j, l the nodes of the columns.
    """
    voltage = port_difference(port_difference(impedance, rows).T, rows)
    voltage *= voltage
    return voltage


class MatrixEstimator(Estimator):
    """No wires, all cells at once. Starts from the previous frame, or from `ohm` if that is nearer.

    Converged: within 40 iterations the chi-square cannot fall by more than `CHI2_TOLERANCE`.
    Standard deviations are the roots of the diagonal of (J^T J)^-1 at the solution, also for a
    cell that ends on a bound, times the root of |r|^2 / RC where that exceeds 1.
    """

    name = "matrix"

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._previous: Float | None = None

    def reset(self) -> None:
        """Forget the previous frame: the next one starts from `ohm`."""
        super().reset()
        self._previous = None

    def _solve(self, ports: PortReadings) -> Solution:
        fit = CellFit(ports, self.knowledge.ref_ohm, self._previous)
        # A frame that did not converge is a poor start for the next one.
        self._previous = None if fit.message else fit.cell
        return Solution(
            cell_siemens=fit.cell,
            cell_siemens_std=fit.cell_std(),
            chi2=self._chi2(ports, fit.current.reshape(fit.cell.shape)),
            iterations=fit.iterations,
            message=fit.message,
        )


class CellFit:
    """One frame's minimisation. cell (R, C) [S]; message: why it did not converge, or empty.

    It starts from the cells of the frame `before`, or from those of `ohm` if they are nearer, and
    ends where a step lowers the chi-square by less than `tolerance`.
    """

    def __init__(
        self,
        ports: PortReadings,
        ref_ohm: float,
        before: Float | None,
        tolerance: float = CHI2_TOLERANCE,
    ) -> None:
        self._target = ports.current.ravel()
        self._current_std = ports.current_std.ravel()
        self._ref_ohm, self._tolerance = ref_ohm, tolerance
        self._far_cost = _FAR_CHI2 * self._target.size
        # 1 / (1 + G_read R), of a current that the most conductive cell allows.
        feasible = np.minimum(self._target, port_current(MAX_CELL_SIEMENS, ref_ohm))
        self._target_share = 1.0 - feasible * ref_ohm
        self.iterations = 0
        afresh = conductance_from_current(ports.current, ref_ohm)
        cell = afresh if before is None else before
        trial = self._evaluate(cell)
        # A scene that jumped is nearer to the plain estimate than to the frame before it.
        if before is not None and trial[-1] > self._far_cost:
            other_trial = self._evaluate(afresh)
            if other_trial[-1] < trial[-1]:
                cell, trial = afresh, other_trial
        self._move_to(cell, *trial)
        self.message = self._run()

    def _evaluate(self, cell: Float) -> tuple[Float, Float, Float, float]:
        """Z, currents and residuals of these cells, and the chi-square."""
        port_ohm, impedance = solve_ports(cell)
        current = 1.0 / (port_ohm.ravel() + self._ref_ohm)
        residual = (self._target - current) / self._current_std
        return impedance, current, residual, float(residual @ residual)

    def _move_to(
        self, cell: Float, impedance: Float, current: Float, residual: Float, cost: float
    ) -> None:
        self.cell, self.current, self.cost = cell, current, cost
        self.scale = np.maximum(cell.ravel(), SCALE_FLOOR_SIEMENS)
        self._impedance, self._residual, self._is_linearised = impedance, residual, False

    def _linearise(self) -> None:
        """Slopes at these cells."""
        if self._is_linearised:
            return
        self._is_linearised = True
        jacobian = voltage_squared(self._impedance, len(self.cell))
        jacobian *= (self.current**2 / self._current_std)[:, None]
        jacobian *= self.scale[None, :]
        self.gradient: Float = self._residual @ jacobian
        stretch = (1.0 - self.current * self._ref_ohm) / self._target_share
        self.far_gradient: Float = (self._residual * stretch) @ jacobian
        self.normal: Float = jacobian.T @ jacobian
        self.diagonal = np.diagonal(self.normal).copy()

    def _run(self) -> str:
        """Minimise; returns why not converged, or an empty string."""
        damping = 0.0
        far = self.cost > self._far_cost
        while self.iterations < MAX_ITERATIONS:
            if self.cost < self._tolerance:  # no step lowers it by more
                return ""
            self.iterations += 1
            self._linearise()
            gradient = self.far_gradient if far else self.gradient
            # Which bounds hold is worth finding out near the solution only.
            cell = self._stepped(gradient, damping, 1 if far else _BOUND_ROUNDS)
            if cell is not None:
                promised = float((cell - self.cell).ravel() / self.scale @ self.gradient)
                # Rounding of the chi-square counts where no cells explain the readings.
                tolerance = max(self._tolerance, 1e-9 * self.cost)
                settled = abs(promised) < tolerance and damping <= _LIGHT_DAMPING
                if settled and not far:
                    return ""
                trial = self._evaluate(cell)
                if trial[-1] < self.cost:
                    self._move_to(cell, *trial)
                    damping = 0.0 if damping <= _LIGHT_DAMPING else damping / 10
                    far = far and self.cost > self._far_cost
                    continue
            if far:
                far = False
            else:
                damping = max(10 * _LIGHT_DAMPING, damping * 10)
                if damping > _LARGEST_DAMPING:
                    return "no step lowers the chi-square"
        return f"not converged after {MAX_ITERATIONS} iterations"

    def _stepped(self, gradient: Float, damping: float, rounds: int) -> Float | None:
        """Minimum of the quadratic model within the bounds, shape (R, C) [S].

        (J^T J + damping diag(J^T J) + ridge) step = J^T r, scaled. Cells that the step takes over
        a bound are held there and the step is solved again for the others, in so many rounds.
        None if the system is not positive definite to working precision.
        """
        cell = self.cell.ravel()
        lowest = (MIN_CELL_SIEMENS - cell) / self.scale
        highest = (MAX_CELL_SIEMENS - cell) / self.scale
        normal = self.normal.copy()
        normal.ravel()[:: len(cell) + 1] += damping * self.diagonal + self._ridge()
        held = ((lowest >= 0) & (gradient <= 0)) | ((highest <= 0) & (gradient >= 0))
        step = np.zeros_like(cell)
        for _ in range(rounds):
            system, target = normal, gradient
            if held.any():
                system = normal.copy()
                target = gradient - system @ (step * held)
                system[held, :] = 0.0
                system[:, held] = 0.0
                system.ravel()[:: len(cell) + 1] += held
                target[held] = step[held]
            _, step, failed = lapack.dposv(system, target, lower=1)
            if failed:
                return None
            crossing = ((step < lowest) | (step > highest)) & ~held
            step = np.clip(step, lowest, highest)
            if not crossing.any():
                break
            held |= crossing
        stepped = np.clip(cell + step * self.scale, MIN_CELL_SIEMENS, MAX_CELL_SIEMENS)
        return np.asarray(stepped.reshape(self.cell.shape), dtype=np.float64)

    def _ridge(self) -> float:
        # Rounding of J^T J is relative to its largest element.
        return max(_RIDGE, 1e-14 * float(self.diagonal.max()))

    def cell_std(self) -> Float:
        """Root of the diagonal of (J^T J + ridge)^-1 [S], shape (R, C)."""
        self._linearise()
        system = self.normal.copy()
        system.ravel()[:: len(self.diagonal) + 1] += self._ridge()
        factor, failed = lapack.dpotrf(system, lower=1, overwrite_a=1)
        if failed:
            return np.full(self.cell.shape, MAX_CELL_SIEMENS)
        inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
        # A residual above the noise says that the model is wrong by that much.
        misfit = max(1.0, self.cost / len(self.scale)) ** 0.5
        std = misfit * self.scale * np.sqrt(np.diagonal(inverse))
        return np.asarray(std.reshape(self.cell.shape), dtype=np.float64)
