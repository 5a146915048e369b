# SPDX-License-Identifier: Apache-2.0
"""What every estimator answers, and the steps they share.

A method derives from `Estimator` and writes `_solve`. Checking the readings, timing, and deciding
which cells are touched happen here, so that all methods do them alike.
"""

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import NEAR, ratio_from_current
from ohmskin.circuit.small import one_blas_thread
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm, check_ratio
from ohmskin.estimate.port_readings import PortReader, PortReadings

TOUCH_SIEMENS: Final = 0.5e-6
TOUCH_STDS: Final = 4.0


@dataclass(frozen=True, eq=False)
class Estimate:
    """The answer for one frame, with its evidence.

    cell_siemens, cell_siemens_std (R, C) [S]: the deviation covers the readings' noise, not what
    the method neglects: about 58 % of cells lie within one, 98 % within two, because rounding is
    uniform. It is NaN where the method gives none.
    level, level_std (R, C): what a force is read from: the same, but for `voltage` [1].
    touched (R, C). top_wire_ohm, bottom_wire_ohm (R, C), and their deviations: of each segment, NaN
    where the method estimates no wires.
    chi2: mean of the squared residuals of all readings over the variance of one (at far ends: of
    the ports' currents). It is about 1 or less when the model holds.
    message: empty if the method converged and the readings can be trusted, else why not.
    seconds: wall time of this frame.
    """

    cell_siemens: Float
    cell_siemens_std: Float
    level: Float
    level_std: Float
    touched: NDArray[np.bool_]
    top_wire_ohm: Float
    bottom_wire_ohm: Float
    top_wire_ohm_std: Float
    bottom_wire_ohm_std: Float
    chi2: float
    iterations: int
    converged: bool
    message: str
    seconds: float

    @property
    def cell_ohm(self) -> Float:
        """1 / cell_siemens [ohm], shape (R, C); inf where the conductance is 0."""
        with np.errstate(divide="ignore"):
            return 1.0 / self.cell_siemens


@dataclass(frozen=True, eq=False)
class Solution:
    """What a method finds; `Estimator.estimate` adds the rest.

    wire_ohm, wire_ohm_std (2, R, C): top, bottom; None: not estimated.
    cell_siemens_std_down: where an error downwards is not as likely as upwards.
    """

    cell_siemens: Float
    cell_siemens_std: Float
    chi2: float
    iterations: int = 1
    message: str = ""
    wire_ohm: Float | None = None
    wire_ohm_std: Float | None = None
    cell_siemens_std_down: Float | None = None


class Estimator(ABC):
    """One method for one skin, frame after frame. Raises ValueError for readings it cannot take."""

    name: ClassVar[str]
    takes_far: ClassVar[bool] = False  # readings at far ends

    def __init__(self, knowledge: SkinKnowledge) -> None:
        if knowledge.reading_names != NEAR and not self.takes_far:
            raise ValueError(
                f"'{self.name}' takes the readings {' '.join(NEAR)}, not "
                f"{' '.join(knowledge.reading_names)}: use 'joint' or 'touch', or scan with "
                "'ohmskin configure PORT --mode near'"
            )
        self.knowledge = knowledge
        self._reader = PortReader(knowledge)
        self._rest: Solution | None = None

    @abstractmethod
    def _solve(self, ports: PortReadings) -> Solution:
        """Answer for one frame, started from the previous frame if there is one.

        Must return finite values with an honest standard deviation (NaN: none is known), or set
        `message`.
        """

    def wires(self) -> WireOhm:
        """What is known of the wires: what was told, and what a method has learned since."""
        return self.knowledge.nominal_wire_ohm

    def reset(self) -> None:
        """Forget the previous frame: the next one starts afresh. What is known of rest stays."""
        self._reader.reset()

    def rest(self) -> Solution | None:
        """This method's own answer to the rest readings; None where they are not known."""
        if self._rest is None and self.knowledge.rest_ratio is not None:
            with one_blas_thread:
                self._rest = self._solve(self._reader.read(self.knowledge.rest_ratio))
            self.reset()
        return self._rest

    def rest_level(self) -> Float:
        """`Estimate.level` of the rest readings, (R, C). Raises ValueError if none are known."""
        rest = self.rest()
        if rest is None or self.knowledge.rest_ratio is None:
            raise ValueError("the readings of the untouched skin are not known")
        return self._level(self.knowledge.rest_ratio, rest)[0]

    def estimate(self, ratio: ArrayLike) -> Estimate:
        """Estimate the cells from one frame of readings (R, C, 4), each V/Vdd in 0..1.

        A cell is touched when g - g_rest > max(0.5e-6 S, 4 sqrt(std^2 + std_rest^2)), std the one
        downwards, NaN as 0. g_rest is this method's own answer to `rest_ratio`; without one it is
        the median of this frame, which supposes that less than half of the cells are touched.
        Raises ValueError for another shape, or for a reading that is no number in 0..1.
        """
        known = self.knowledge
        readings = check_ratio(ratio, known.rows, known.columns, of=known.reading_names)
        self.rest()
        started = time.perf_counter()
        with one_blas_thread:
            ports = self._reader.read(readings, in_order=True)
            found = self._solve(ports)
        message = "; ".join(filter(None, (ports.fault, found.message)))
        touched = self._touched(found)
        level, level_std = self._level(readings, found)
        unknown = np.full((2, known.rows, known.columns), np.nan)
        wires = unknown if found.wire_ohm is None else found.wire_ohm
        wires_std = unknown if found.wire_ohm_std is None else found.wire_ohm_std
        return Estimate(
            cell_siemens=found.cell_siemens,
            cell_siemens_std=found.cell_siemens_std,
            level=level,
            level_std=level_std,
            touched=touched,
            top_wire_ohm=wires[0],
            bottom_wire_ohm=wires[1],
            top_wire_ohm_std=wires_std[0],
            bottom_wire_ohm_std=wires_std[1],
            chi2=found.chi2,
            iterations=found.iterations,
            converged=not message,
            message=message,
            seconds=time.perf_counter() - started,
        )

    def _level(self, ratio: Float, found: Solution) -> tuple[Float, Float]:
        """`Estimate.level` of readings (R, C, 4) that gave this solution, and its deviation."""
        return found.cell_siemens, found.cell_siemens_std

    def _touched(self, found: Solution) -> NDArray[np.bool_]:
        down = found.cell_siemens_std_down
        rise_std = found.cell_siemens_std if down is None else down
        if self._rest is None:
            rise = found.cell_siemens - np.median(found.cell_siemens)
        else:
            rise = found.cell_siemens - self._rest.cell_siemens
            rise_std = np.hypot(rise_std, self._rest.cell_siemens_std)
        return np.asarray(rise > np.fmax(TOUCH_SIEMENS, TOUCH_STDS * rise_std))

    def _chi2(self, ports: PortReadings, current_siemens: Float) -> float:
        """chi2 per reading, or at far ends per port, of a model of these currents (R, C) [S]."""
        known, ratio = self.knowledge, ports.ratio
        if known.reading_names != NEAR:
            return float(np.mean(((ports.current - current_siemens) / ports.current_std) ** 2))
        model = ratio_from_current(current_siemens, known.ref_top_ohm, known.ref_bottom_ohm)
        residual = (ratio - model).ravel() / known.ratio_std
        return float(residual @ residual) / residual.size
