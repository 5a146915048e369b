# SPDX-License-Identifier: Apache-2.0
"""`joint`: every resistance of the skin at once, from one circuit for all readings.

RC readings do not determine 3RC resistances, so a prior does the rest, and the answer carries a
standard deviation that says how much of it is prior:

- a cell is near its rest resistance, or touched (`prior`). This is what removes ghosts that the
  readings do not exclude.
- a wire segment is near what is believed of it (`wires`): at first the nominal value of its layer,
  later what the frames before have revealed.

The maximum of the posterior is found from the simplest model that explains the frame (`touched`),
in one or two steps (`joint_fit`). Where the answer leaves a doubt, other explanations are tried:
other wires than believed, a touch that hides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.base import MIN_CELL_SIEMENS, Estimator, SkinKnowledge, Solution
from ohmskin.estimate.joint_fit import JointFit
from ohmskin.estimate.ohm import conductance_from_current
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    REST_STD,
    TAIL,
    TOUCHED,
    UNKNOWN_REST_STD,
    UNTOUCHED_OHM,
    UNTOUCHED_STD,
    CellPrior,
    rest_level,
    siemens_std,
)
from ohmskin.estimate.touched import Touched, TouchedFit
from ohmskin.estimate.wires import Lesson, WireBelief

LOWER_LEVEL: Final = 0.8  # a frame of so much less conductance shows rest better than those before
MAX_DOUBTS: Final = 4
MISFIT: Final = 1.5  # chi-square per port; at the truth, rounding alone has 1
BENT_MESSAGE: Final = "the wires changed since they were learned: they are learned anew"
LOSS: Final = 0.5  # log: a cell that conducts so much less than at rest is at fault, not touched
LOSS_STDS: Final = 6.0  # of the prior
NEWS: Final = 0.5  # change of a log resistance that makes a frame news of the wires
CLEAR: Final = 12.0  # deviations of the prior: a cell is at rest, or touched beyond doubt
HIGHEST_START_SIEMENS: Final = 1e-2


class JointEstimator(Estimator):
    """Gauss-Newton on all 3RC log resistances; learns the wires from frame to frame."""

    name: ClassVar[str] = "joint"

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._shape = (knowledge.rows, knowledge.columns)
        self._belief = WireBelief(*self._shape, *knowledge.nominal_wire_ohm)
        self._prior: CellPrior | None = None
        self._finder: TouchedFit | None = None
        self._before: Float | None = None
        self._learned_from: Float | None = None
        self._bent = False

    def reset(self) -> None:
        """Forget the frames before, and what they revealed of the wires."""
        self._before = self._learned_from = None
        self._belief.reset()
        if self.knowledge.rest_ratio is None:
            self._prior = self._finder = None

    def _solve(self, ports: PortReadings) -> Solution:
        current, current_std = ports.current.ravel(), ports.current_std.ravel()
        self._bent = False
        prior = self._prior_of(current)
        found = self._finder.find(current, current_std) if self._finder is not None else None
        known_rest = self.knowledge.rest_ratio is not None
        if found is not None and known_rest and self._is_enough(found):
            return self._simple_solution(found, ports)
        fit = self._best_fit(prior, current, current_std, self._starts(prior, current, found))
        usual = not (ports.fault or fit.message)
        self._before = fit.cell if usual else None
        if usual and not fit.is_crowded:
            self._learn(fit.cell, fit.lesson)
        return self._solution(fit, ports)

    def _is_enough(self, found: Touched) -> bool:
        """Whether the touched cells alone are the answer."""
        return False

    def _simple_solution(self, found: Touched, ports: PortReadings) -> Solution:
        assert self._prior is not None
        log_siemens, log_std = -self._prior.expected, self._prior.std.copy()
        log_siemens[found.cells], log_std[found.cells] = found.log_siemens, found.log_std
        if found.cells.size > 1 and not ports.fault:
            self._learn(-log_siemens, lambda: found.lesson)
        siemens = np.exp(log_siemens).reshape(self._shape)
        top, bottom = np.exp(self._belief.mean).reshape(2, *self._shape)
        paths = self._belief.paths(self._belief.mean, self._shape)
        std, std_down = siemens_std(log_siemens, log_std, *paths, self.knowledge.ref_ohm)
        return Solution(
            cell_siemens=siemens,
            cell_siemens_std=std.reshape(self._shape),
            cell_siemens_std_down=std_down.reshape(self._shape),
            chi2=self._chi2(ports.ratio, found.current.reshape(self._shape)),
            iterations=found.steps,
            message=BENT_MESSAGE if self._bent else "",
            top_wire_ohm=top,
            bottom_wire_ohm=bottom,
        )

    def _best_fit(
        self, prior: CellPrior, current: Float, current_std: Float, starts: list[Float]
    ) -> JointFit:
        """The best fit that can be found: other wires and other touched cells are tried if the
        first leaves a doubt.
        """

        def run(starts: list[Float]) -> JointFit:
            fit = JointFit(
                self._shape, self.knowledge.ref_ohm, prior, self._belief, current, current_std
            )
            fit.run(starts)
            return fit

        best = run(starts)
        if best.wires_contradict and not self._belief.is_fresh:
            self._belief.forget()
            self._bent = True
            best = run([best.cell])
        iterations = best.iterations
        for _ in range(MAX_DOUBTS):
            if best.elsewhere is None:
                break
            other = run([best.elsewhere])
            iterations += other.iterations
            if other.cost >= best.cost:
                break
            best = other
        best.iterations = iterations
        if not best.message and best.misfit > MISFIT:
            best.message = f"no resistances explain the readings: chi-square {best.misfit:.1f}"
        loss = best.cell - prior.expected - np.maximum(LOSS, LOSS_STDS * prior.std)
        worst = int(loss.argmax())
        known_rest = self.knowledge.rest_ratio is not None
        if known_rest and not best.message and loss[worst] > 0:
            row, column = divmod(worst, self._shape[1])
            best.message = f"cell ({row}, {column}): conducts less than at rest, is a line open?"
        return best

    def _solution(self, fit: JointFit, ports: PortReadings) -> Solution:
        cells = fit.cell.size
        siemens = np.exp(-fit.cell)
        std, std_down = fit.siemens_std()
        misfit = max(1.0, fit.misfit) ** 0.5
        return Solution(
            cell_siemens=siemens.reshape(self._shape),
            cell_siemens_std=misfit * std.reshape(self._shape),
            cell_siemens_std_down=misfit * std_down.reshape(self._shape),
            chi2=self._chi2(ports.ratio, fit.modelled.reshape(self._shape)),
            iterations=fit.iterations,
            message=fit.message or (BENT_MESSAGE if self._bent else ""),
            top_wire_ohm=np.exp(fit.wires[:cells]).reshape(self._shape),
            bottom_wire_ohm=np.exp(fit.wires[cells:]).reshape(self._shape),
        )

    def _starts(self, prior: CellPrior, current: Float, found: Touched | None) -> list[Float]:
        """Log resistances of the cells to start from: one, or two if it takes trying."""
        if found is not None:
            start = prior.expected.copy()
            if self._before is not None:
                # Cells at rest are where rounding put them before.
                near = np.abs(prior.rise(self._before)) < TOUCHED
                start[near] = self._before[near]
            start[found.cells] = -found.log_siemens
            return [start]
        siemens = conductance_from_current(current, self.knowledge.ref_ohm)
        log_ohm = -np.log(np.clip(siemens, MIN_CELL_SIEMENS, HIGHEST_START_SIEMENS))
        afresh = np.minimum(log_ohm, prior.expected)
        return [afresh] if self._before is None else [self._before, afresh]

    def _learn(self, cell: Float, lesson: Callable[[], Lesson]) -> None:
        """Let the wires learn from a plain frame that is not like the last one learned from."""
        assert self._prior is not None
        if not self._is_plain(self._prior.rise(cell).reshape(self._shape)):
            return
        before = self._learned_from
        if before is not None and np.abs(cell - before).max() < NEWS:
            return
        self._learned_from = cell
        self._bent |= self._belief.learn(*lesson())

    @staticmethod
    def _is_plain(rise: Float) -> bool:
        """Whether cells (R, C) are at rest or touched beyond doubt, and no finger covers several.

        Around a finger that covers several cells others are pressed so lightly that they pass for
        rest, all of them in the same direction: the wires would have to explain it.
        """
        touched = rise > TOUCHED
        light = touched & (rise < CLEAR)
        beside = np.sum(touched[1:] & touched[:-1]) + np.sum(touched[:, 1:] & touched[:, :-1])
        return not light.any() and bool(beside <= 1)

    def _prior_of(self, current: Float) -> CellPrior:
        """From the rest readings; without them from the level of this frame, or of a lower one.

        A level is one number for all cells: what has always been pressed is not taken for rest, as
        it would be cell by cell.
        """
        if self._prior is not None and self.knowledge.rest_ratio is not None:
            return self._prior
        if self.knowledge.rest_ratio is not None:
            expected, std = self._at_rest(self._reader.read(self.knowledge.rest_ratio))
        else:
            level = rest_level(current.reshape(self._shape), self.knowledge.ref_ohm)
            if self._prior is not None and level > LOWER_LEVEL * np.exp(-self._prior.expected[0]):
                return self._prior
            expected = np.full(current.size, -np.log(level))
            std = np.full(current.size, UNKNOWN_REST_STD)
        self._prior = CellPrior(expected, std, TAIL)
        self._finder = TouchedFit(self._shape, self._prior, self._belief, self.knowledge.ref_ohm)
        return self._prior

    def _at_rest(self, ports: PortReadings) -> tuple[Float, Float]:
        """Log resistances of the untouched cells, and how well they are known: the same fit."""
        cells = ports.current.size
        wide = CellPrior(
            np.full(cells, np.log(UNTOUCHED_OHM)), np.full(cells, UNTOUCHED_STD), np.inf
        )
        current, current_std = ports.current.ravel(), ports.current_std.ravel()
        fit = JointFit(
            self._shape, self.knowledge.ref_ohm, wide, self._belief, current, current_std
        )
        fit.run(self._starts(wide, current, None))
        return fit.cell, np.hypot(np.minimum(fit.cell_std, UNTOUCHED_STD), REST_STD)
