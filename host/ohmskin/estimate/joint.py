# SPDX-License-Identifier: Apache-2.0
"""`joint`: every resistance of the skin at once, from one circuit for all readings.

RC readings do not determine 3RC resistances, so a prior does the rest, and the answer carries a
standard deviation that says how much of it is prior:

- a cell is near its rest resistance, or touched. This is what removes ghosts that the readings do
  not exclude.
- a wire segment is near what is believed of it: at first the nominal value of its layer, later what
  the frames before have revealed.

The maximum of the posterior is found by a few Gauss-Newton steps (`full_fit`). They begin at the
few touches that explain the frame (`sparse_fit`). If no few touches do, as under a fingertip, they
begin at the cells that `matrix` finds.

`touch` takes the cells at rest and the wires out of the fit and into the noise: its answer is those
few touches. Where they do not explain the frame, its answer is that of `joint`. Without rest
readings no cell is known to be untouched, so every frame is for `joint`.
"""

from typing import ClassVar, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.far_wires import MeasuredWires
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.matrix import CellFit
from ohmskin.estimate.port_faults import cell_of
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    CROWDED,
    HIDDEN,
    HIGHEST_TOUCH_SIEMENS,
    MAX_STEP,
    MISFIT,
    REST_STD,
    UNKNOWN_REST_STD,
    UNTOUCHED_STD,
    CellPrior,
    WireBelief,
    path_ohm,
    rest_level,
    siemens_std,
)
from ohmskin.estimate.sparse_fit import FewTouches, SparseFit, Touched

REST_FITS: Final = 3
LOSS: Final = 10.0  # deviations of the prior below rest: a cell that conducts less is at fault


class JointEstimator(Estimator):
    """Gauss-Newton on all 3RC log resistances; learns the wires from frame to frame."""

    name: ClassVar[str] = "joint"
    takes_far: ClassVar[bool] = True

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._shape = (knowledge.rows, knowledge.columns)
        wires = knowledge.nominal_wire_ohm
        self._measured: MeasuredWires | None = None
        self._belief = WireBelief(*self._shape, wires)
        if any(self._reader.far):
            self._belief = self._measured = MeasuredWires(*self._shape, wires)
        self._prior: CellPrior | None = None
        self._finder: SparseFit | None = None
        self._rest_by_wires = 0.0
        self.reset()

    def wires(self) -> WireOhm:
        """As told, until a frame has taught more."""
        return super().wires() if self._learned_from is None else self._belief.learned()

    def reset(self) -> None:
        """Forget the frames before, and what they revealed of the wires."""
        super().reset()
        self._learned_from: Float | None = None
        self._lesson_noise = 0.0  # of the frame that was learned from
        # What follows from the wires as they are believed, for `touch`.
        self._believed: tuple[Float, tuple[Float, Float, Float]] | None = None
        self._without_wires: Float | None = None
        self._touches = 0  # of the last fit
        self._belief.reset()
        if self.knowledge.rest_ratio is None:
            self._prior = self._finder = None

    def _solve(self, ports: PortReadings) -> Solution:
        prior = self._prior_of(ports)
        touches = None
        # Under a finger that stays, few touches explain no frame: trying costs time.
        if self._finder is not None and self._touches <= self._finder.most:
            touches = self._finder.find(ports)
        if touches is not None and (found := self._explained_by(touches, ports)):
            return self._solution(ports, found)
        start = self._start(prior, ports, touches)
        if self._measured is not None:
            self._measured.measure(self._circuit(start), ports)
        expected = prior.unsure() if prior.is_soft(start, self._shape) else prior
        fit = FullFit(expected, self._belief, self.knowledge.ref_ohm, ports, start)
        self._touches = prior.touches(fit.cell)
        message = self._doubt(expected, fit)
        if not (ports.fault or message or self._touches > CROWDED * start.size):
            self._learn(fit, ports)
        return self._solution(ports, fit, message)

    def _explained_by(self, touches: FewTouches, ports: PortReadings) -> Touched | None:
        """The answer, if these few touches are all that the frame shows: never, for `joint`."""
        return None

    def _solution(self, ports: PortReadings, fit: FullFit | Touched, message: str = "") -> Solution:
        wires, wires_std, series_ohm = self._wires_of(fit)
        layer_std, wider = self._belief.std(), max(1.0, fit.misfit) ** 0.5
        std, down = siemens_std(-fit.cell, fit.cell_std, fit.by_layers, layer_std, series_ohm)
        return Solution(
            cell_siemens=np.exp(-fit.cell).reshape(self._shape),
            cell_siemens_std=wider * std.reshape(self._shape),
            cell_siemens_std_down=wider * down.reshape(self._shape),
            chi2=self._chi2(ports, fit.modelled.reshape(self._shape)),
            iterations=fit.iterations,
            message=message,
            wire_ohm=wires,
            wire_ohm_std=wires_std,
        )

    def _wires_of(self, fit: FullFit | Touched) -> tuple[Float, Float, Float]:
        """Segments and their deviations (2, R, C), and what is in series with each cell [ohm]."""
        of = self._belief.log_layers
        if isinstance(fit, FullFit) or self._believed is None or self._believed[0] is not of:
            wires = self._belief.layers(fit.wires)
            series_ohm = path_ohm(*wires, far=self._reader.far) + self.knowledge.ref_ohm
            found = wires, wires * self._belief.segment_std(), series_ohm
            if isinstance(fit, FullFit):
                return found
            for each in found:
                each.setflags(write=False)  # they are in more than one estimate
            self._believed = of, found
        return self._believed[1]

    def _doubt(self, prior: CellPrior, fit: FullFit) -> str:
        """Why this fit cannot be the answer; empty if it can."""
        if fit.message:
            return fit.message
        if self._rest_by_wires > REST_STD:
            return "wires resist too much: even cells at rest are uncertain"
        if fit.misfit > MISFIT:
            return f"no resistances explain the readings: chi-square {fit.misfit:.1f}"
        cell = fit.cell.reshape(self._shape)
        if cell.min() < -np.log(HIGHEST_TOUCH_SIEMENS):
            return f"{cell_of(cell.argmin(), cell)}: conducts more than any touch, is it a short?"
        loss = fit.cell - prior.expected - LOSS * prior.std
        if self.knowledge.rest_ratio is not None and loss.max() > 0:
            return f"{cell_of(loss.argmax(), cell)}: conducts less than at rest, is a line open?"
        return ""

    def _start(self, prior: CellPrior, ports: PortReadings, touches: FewTouches | None) -> Float:
        """Log resistances of the cells to start from, (RC,).

        They are the touched cells that explain the frame. Where these do not, they are what
        `matrix` finds: without wires, cells come out a little too soft, and from there a fit does
        not reach the distant answer of one hard touch behind long wires.
        """
        if touches is not None:
            return touches.cell
        near = float(ports.current.size)  # to start from, a deviation of every reading will do
        fit = CellFit(ports, self.knowledge.ref_ohm, self._without_wires, near)
        self._without_wires = None if fit.message else fit.cell
        siemens = np.minimum(fit.cell.ravel(), HIGHEST_TOUCH_SIEMENS)
        return np.minimum(-np.log(siemens), prior.expected)

    def _circuit(self, cell: Float) -> PortCircuit:
        """Of these log resistances of the cells (RC,), with wires as they are believed."""
        wires = np.exp(self._belief.log_layers)
        return PortCircuit(np.exp(-cell).reshape(self._shape), *wires, far=self._reader.far)

    def _learn(self, fit: FullFit | Touched, ports: PortReadings) -> None:
        """Let the wires learn from a frame that is news: frames alike have errors alike.

        A frame that is alike, but calmer, takes the place of the one that was news.
        """
        before, noise = self._learned_from, float(ports.current_std.mean())
        news = before is None or np.abs(fit.cell - before).max() >= MAX_STEP
        if not news and (self._measured is not None or noise >= self._lesson_noise):
            return
        self._learned_from, self._lesson_noise = fit.cell, noise
        if self._measured is None:
            self._belief.learn(*fit.lesson, instead=not news)
        else:
            self._measured.keep(self._circuit(fit.cell), ports)

    def _prior_of(self, ports: PortReadings) -> CellPrior:
        """From the rest readings; without them from the level of this frame, or of a lower one.

        A level is one number for all cells: what has always been pressed is not taken for rest, as
        it would be cell by cell.
        """
        known = self.knowledge
        if known.rest_ratio is None:
            log_ohm, before = -np.log(rest_level(ports.current, known.ref_ohm)), self._prior
            if before is not None and log_ohm <= before.expected[0]:
                return before
            cells = ports.current.size
            expected, std = np.full(cells, log_ohm), np.full(cells, UNKNOWN_REST_STD)
        elif self._prior is not None:
            return self._prior
        else:
            expected, std = self._at_rest(self._reader.read(known.rest_ratio))
        self._prior = CellPrior(expected, std)
        if self._rest_by_wires <= REST_STD:
            self._finder = SparseFit(self._prior, self._belief, known.ref_ohm, self._reader.far)
        return self._prior

    def _at_rest(self, ports: PortReadings) -> tuple[Float, Float]:
        """Log resistances of the untouched cells, and how well they are known: the same fit.

        Made again about their median: many cells a little wrong would weigh more than readings.
        """
        level = rest_level(ports.current, self.knowledge.ref_ohm)
        cell: Float = np.full(ports.current.size, -np.log(level))
        for _ in range(REST_FITS):
            std = np.full(cell.size, UNTOUCHED_STD)
            if self._measured is not None:
                self._measured.measure(self._circuit(cell), ports)
            wide = CellPrior(np.full(cell.size, np.median(cell)), std)
            fit = FullFit(wide, self._belief, self.knowledge.ref_ohm, ports, cell)
            cell = fit.cell
        if self._measured is not None:
            self._measured.settle(ports.far)
        self._rest_by_wires = float(fit.by_layers.max())
        return cell, np.hypot(np.minimum(fit.cell_std, UNTOUCHED_STD), REST_STD)


class TouchEstimator(JointEstimator):
    """The simplest model that explains a frame. Cells at rest are reported as at rest."""

    name: ClassVar[str] = "touch"

    def _explained_by(self, touches: FewTouches, ports: PortReadings) -> Touched | None:
        found = None if self.knowledge.rest_ratio is None else touches.explain()
        if found is None or found.cell_std[found.cells].max(initial=0.0) > HIDDEN:
            return None
        if not ports.fault:
            self._learn(found, ports)
        return found
