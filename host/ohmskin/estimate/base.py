# SPDX-License-Identifier: Apache-2.0
"""What every estimator answers, and the steps they share.

A method derives from `Estimator` and writes `_solve`. Checking the readings, timing, and deciding
which cells are touched happen here, so that all methods do them alike.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import FULL_SCALE_USIEMENS, Bool, Float, heat_map
from ohmskin.circuit.configurations import NEAR, is_near, ratio_from_current
from ohmskin.circuit.small import one_blas_thread
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm, check_ratio
from ohmskin.estimate.port_readings import PortReader, PortReadings
from ohmskin.estimate.prior import HIGHEST_TOUCH_SIEMENS, REACH_STDS

# The conductance of a touched cell has risen by more than this. Chosen: half of what a cell of one
# megohm conducts at rest, so that a drift by some percent is no touch.
TOUCH_SIEMENS: Final = 0.5e-6
# The conductance of a touched cell has also risen by more than so many standard deviations. Chosen:
# by chance, one normal error of 32,000 is larger.
TOUCH_STDS: Final = 4.0
# Deviation of a cell over its conductance, if it may be that of another line, shorted to its own.
# Chosen: then all of it is an error of three deviations.
DOUBT_STD: Final = 0.3
# What `Estimate.wires` says of wires that nobody told, and what people read of that.
ASSUMED: Final = "assumed"
ASSUMED_WIRES: Final = (
    "wires not known: touches may be harder than shown; calibrate, or press corners"
)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The answer for one frame, with its evidence.

    cell_siemens: conductance of each cell (R, C) [S].
    cell_siemens_std: its standard deviation (R, C) [S], NaN where the method gives none. It covers
        the noise of the readings and the error of both references (`SkinKnowledge.ref_log_std`),
        not what the method neglects. By noise alone, about 58 % of cells lie within one, 98 %
        within two, because rounding is uniform.
    level: what a force is read from (R, C): cell_siemens; for `voltage`, a voltage over Vdd [1];
        for `joint` and `touch`, the cell in series with its hidden wires [S]: what single wires
        differ from the means of their layers by, and what the means were told wrongly by. A press
        alone shows nothing of these, so the curve of a cell that was pressed has them in.
    level_std: its standard deviation (R, C), by noise alone: a calibration was learned through the
        same references.
    touched: which cells are touched (R, C); `Estimator.estimate` says by which rule.
    top_wire_ohm: each segment of the top layer (R, C) [ohm], NaN where wires are not estimated.
    bottom_wire_ohm: the same of the bottom layer.
    top_wire_ohm_std: standard deviation of top_wire_ohm (R, C) [ohm].
    bottom_wire_ohm_std: standard deviation of bottom_wire_ohm (R, C) [ohm].
    chi2: mean square of the residuals of readings, over the variance of a reading; where far ends
        or a region are read, the same of the currents of ports. It is about 1 or less if the model
        holds.
    iterations: steps of the method, 1 where it has none.
    converged: whether the method converged and the readings can be trusted: message is empty.
    message: why not, in words.
    wires: "known", they are told or measured; "learned", by frames of several touches; "assumed",
        usual ones (`ASSUMED_WIRES`); empty where the method takes none into account.
    seconds: wall time of this frame [s].
    """

    cell_siemens: Float
    cell_siemens_std: Float
    level: Float
    level_std: Float
    touched: Bool
    top_wire_ohm: Float
    bottom_wire_ohm: Float
    top_wire_ohm_std: Float
    bottom_wire_ohm_std: Float
    chi2: float
    iterations: int
    converged: bool
    message: str
    wires: str
    seconds: float

    def __repr__(self) -> str:
        rows, columns = self.touched.shape
        how = self.message or f"converged, chi-square {self.chi2:.2f}"
        return f"<Estimate of {rows}x{columns} cells: {self.touched.sum()} touched, {how}>"

    def _repr_html_(self) -> str:
        """A heat map of the conductances, in a notebook."""
        text = f"{self!r} [microsiemens]"
        return heat_map(1e6 * self.cell_siemens, FULL_SCALE_USIEMENS, text)

    @property
    def cell_ohm(self) -> Float:
        """1 / cell_siemens [ohm], shape (R, C); inf where the conductance is 0."""
        with np.errstate(divide="ignore"):
            return 1.0 / self.cell_siemens


class Solution(NamedTuple):
    """What a method finds in one frame. `Estimator.estimate` makes an `Estimate` of it.

    cell_siemens: conductance of each cell (R, C) [S].
    cell_siemens_std: its standard deviation (R, C) [S]; where errors upwards are larger than errors
        downwards, that of errors upwards. NaN: not known.
    chi2, iterations, message: as in `Estimate`; message is empty if the method converged.
    wire_ohm: segments of top and bottom layer (2, R, C) [ohm]; None: not estimated.
    wire_ohm_std: their standard deviation (2, R, C) [ohm]; None: not known.
    cell_siemens_std_down: standard deviation of errors downwards (R, C) [S]; None: as upwards.
    level, level_std: as in `Estimate`; None: cell_siemens and its deviation.
    """

    cell_siemens: Float
    cell_siemens_std: Float
    chi2: float
    iterations: int = 1
    message: str = ""
    wire_ohm: Float | None = None
    wire_ohm_std: Float | None = None
    cell_siemens_std_down: Float | None = None
    level: Float | None = None
    level_std: Float | None = None


def in_series(cell_ohm: Float, hidden_ohm: Float | float) -> Float:
    """Conductance [S] of cells in series with wires that are a part of their curves.

    Such wires may be below 0, if more were told. No touch conducts more than the hardest for that.
    """
    least_ohm = np.minimum(cell_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS)
    return np.asarray(1.0 / np.maximum(cell_ohm + hidden_ohm, least_ohm))


class Estimator(ABC):
    """One method for one skin, frame after frame. Raises ValueError for readings it cannot take.

    name: what the method is called. takes_far: whether it takes readings at far ends.
    takes_partial: whether it takes frames of which not all was read. takes_leads: whether what is
    told of the leads counts.
    """

    name: ClassVar[str]
    takes_far: ClassVar[bool] = False
    takes_partial: ClassVar[bool] = True
    takes_leads: ClassVar[bool] = False

    def __init__(self, knowledge: SkinKnowledge) -> None:
        if knowledge.checked_names != NEAR and not self.takes_far:
            raise ValueError(
                f"'{self.name}' takes the readings {' '.join(NEAR)}, not "
                f"{' '.join(knowledge.reading_names)}: use 'joint' or 'touch', or scan with "
                "'ohmskin configure PORT --mode near --save'"
            )
        self.knowledge = knowledge
        told = knowledge if self.takes_leads else replace(knowledge, own_lead_ohm=None)
        self._reader = PortReader(told)
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

    def wires_are(self) -> str:
        """`Estimate.wires` of the last frame."""
        return ""

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

    @classmethod
    def check_takes(cls, ratio: Float) -> None:
        """Raise ValueError if readings of which some are NaN are none for this method."""
        if not cls.takes_partial and np.isnan(ratio).any():
            raise ValueError(f"'{cls.name}' takes whole scans of a b c d: use 'joint' or 'touch'")

    def estimate(self, ratio: ArrayLike, reading_names: Sequence[str] = ()) -> Estimate:
        """Estimate the cells from one frame of readings (R, C, 4), each V/Vdd in 0..1.

        Readings that were not taken are NaN: those of some configurations, or of cells outside of a
        region of rows and columns. Their ports are as they were, and less certain with each frame.
        reading_names: of this frame, if they are others than those of the skin: some of a to d.

        A cell is touched if its conductance g has risen, and by more than noise,

            g - g_rest > 0.5e-6 S ,   1 / (1 / g + 4 std_ohm) > g_rest ,

            std_ohm = (1 / (g - 2 s) - 1 / g) / 2 ,   s = sqrt(std^2 + std_rest^2) ,

        std that of errors downwards, and 0 where it is not known. Errors are normal in the
        resistance: behind wires that are not known, a hard touch may well be a light one, but not
        none. g_rest is this method's own answer to the rest readings that it was told. It never
        follows the frames: a cell that stays pressed stays touched.

        Without rest readings, g_rest is one number for all cells, and taken anew from each frame:
        the median of its cells, with std_rest = 0. This supposes that less than half of the cells
        are touched, and that they conduct alike at rest.

        Raises ValueError for another shape, or for a reading that is no number in 0..1.
        """
        knowledge = self.knowledge
        shape = knowledge.rows, knowledge.columns
        names = tuple(reading_names) or knowledge.reading_names
        if names != knowledge.reading_names and not is_near({*names, *knowledge.reading_names}):
            raise ValueError(f"these readings are {names}, this skin's {knowledge.reading_names}")
        readings = check_ratio(ratio, *shape, of=names)
        self.check_takes(readings)
        self.rest()
        started = time.perf_counter()
        with one_blas_thread:
            ports = self._reader.read(readings, in_order=True)
            solution = self._solve(ports)
        message = "; ".join(filter(None, dict.fromkeys((ports.fault, solution.message))))
        touched = self._touched(solution)
        level, level_std = self._level(readings, solution)
        wires, wires_std = (
            np.full((2, *shape), np.nan) if known is None else known
            for known in (solution.wire_ohm, solution.wire_ohm_std)
        )
        wires_std = np.hypot(wires_std, knowledge.ref_log_std * wires)
        siemens, siemens_std = solution.cell_siemens, solution.cell_siemens_std
        relative_std = np.hypot(knowledge.ref_log_std, DOUBT_STD * ports.doubt)
        siemens_std = np.hypot(siemens_std, relative_std * siemens)
        return Estimate(
            cell_siemens=siemens,
            cell_siemens_std=siemens_std,
            level=level,
            level_std=level_std,
            touched=touched,
            top_wire_ohm=wires[0],
            bottom_wire_ohm=wires[1],
            top_wire_ohm_std=wires_std[0],
            bottom_wire_ohm_std=wires_std[1],
            chi2=solution.chi2,
            iterations=solution.iterations,
            converged=not message,
            message=message,
            wires=self.wires_are(),
            seconds=time.perf_counter() - started,
        )

    def _level(self, ratio: Float, solution: Solution) -> tuple[Float, Float]:
        """`Estimate.level` of readings (R, C, 4) that gave this solution, and its deviation."""
        if solution.level is None or solution.level_std is None:
            return solution.cell_siemens, solution.cell_siemens_std
        return solution.level, solution.level_std

    def _touched(self, solution: Solution) -> Bool:
        """Which cells are touched, by the rule of `estimate`.

        Errors downwards decide: the question is whether the cell may as well be as low as at rest.
        """
        siemens, down = solution.cell_siemens, solution.cell_siemens_std_down
        std = solution.cell_siemens_std if down is None else down
        if self._rest is None:
            rest_siemens = np.full_like(siemens, np.median(siemens))
        else:
            rest_siemens = self._rest.cell_siemens
            std = np.hypot(std, self._rest.cell_siemens_std)
        known_std = np.where(np.isnan(std), 0.0, std)
        # Stated deviations reach to this limit. The rule's resistance goes `over` times as far.
        lower, over = np.maximum(siemens - REACH_STDS * known_std, 0.0), TOUCH_STDS / REACH_STDS
        # 1 / (1 / g + over (1 / lower - 1 / g)) > g_rest, times g, lower and its denominator.
        is_above = siemens * lower > rest_siemens * (over * siemens + (1.0 - over) * lower)
        return np.asarray((siemens - rest_siemens > TOUCH_SIEMENS) & is_above)

    def _chi2(self, ports: PortReadings, current_siemens: Float) -> float:
        """`Estimate.chi2` of a model that gives these currents of ports (R, C) [S]."""
        knowledge = self.knowledge
        if knowledge.checked_names != NEAR or ports.region is not None:
            off = ((ports.current - current_siemens) / ports.current_std).ravel()[ports.region]
            return float(off.ravel() @ off.ravel()) / off.size
        own_ohm = knowledge.own_lead_of_ports
        if self.takes_leads and own_ohm is not None:  # the readings have them, and the model not
            current_siemens = current_siemens / (1.0 + current_siemens * own_ohm)
        references = knowledge.ref_top_ohm, knowledge.ref_bottom_ohm
        model = ratio_from_current(current_siemens, *references)
        residual = ((ports.ratio - model) / knowledge.ratio_std).ravel()
        if np.isnan(residual @ residual):
            residual = residual[~np.isnan(residual)]  # of what was read
        return float(residual @ residual) / residual.size
