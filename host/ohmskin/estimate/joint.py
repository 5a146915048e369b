# SPDX-License-Identifier: Apache-2.0
"""`joint`: every resistance of the skin at once, from one circuit for all readings.

RC readings do not determine 3RC resistances. A prior decides what they leave open, and the standard
deviations of the answer say how much of it comes from the prior:

- a cell is near its rest resistance (`cells_at_rest`), or touched. This is what removes ghosts that
  the readings do not exclude.
- a wire segment is near what is believed of it: at first the nominal value of its layer, later what
  the frames before have revealed.

The maximum of the posterior is found by a few Gauss-Newton steps (`full_fit`). They begin at the
few touches that `sparse_fit` finds. If touches are many, as under a fingertip, they begin near the
cells that `matrix` finds; under a palm, at rest.

`touch` takes the cells at rest and the wires out of the fit and into the noise: its answer is those
few touches. Where they do not explain the frame, or lie as under a fingertip, its answer is that of
`joint`. Without rest readings no cell is known to be untouched, so every frame is for `joint`.
"""

from typing import ClassVar, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.base import ASSUMED, Estimator, Solution, in_series
from ohmskin.estimate.cells_at_rest import CellsAtRest
from ohmskin.estimate.far_wires import MeasuredWires
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, SkinKnowledge, WireOhm
from ohmskin.estimate.matrix import CellFit
from ohmskin.estimate.near_wires import LearnedWires
from ohmskin.estimate.ohm import conductance_from_current
from ohmskin.estimate.port_faults import LOSS_TEXT, worst_cell
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    CLEAR_LOG,
    HIGHEST_TOUCH_SIEMENS,
    LEAST_TIP,
    MAX_CHI2,
    CellPrior,
    rest_level,
    siemens_std,
)
from ohmskin.estimate.region_fit import Answer, RegionFit, WholeFrame
from ohmskin.estimate.sparse_fit import Cells, FewTouches, SparseFit, Touched, most_touches
from ohmskin.estimate.staying_faults import StayingFaults
from ohmskin.estimate.wire_belief import MOST_FITS, WireBelief

# A cell that conducts less than at rest by more deviations of its prior is at fault. Chosen:
# `make ablate` tries other ones.
LOSS_STDS: Final = 10.0
# And the frame must show it: by more deviations of its conductance after the fit. Chosen: beside
# fingertips on 16x16, cells at rest seem to conduct less by up to 3, and open ones by 5 and more.
SHOWN_STDS: Final = 4.0
# Under a palm, the median port shows cells that conduct so many times as much as at rest. Chosen:
# up to 4 times under fingertips, and 12 times and more under the lightest palms.
PALM_TIMES: Final = 10.0
# A line that resists more than this from end to end is long [ohm]: to find where a fit starts, its
# wire must not be neglected, and it may hide touches behind it. Chosen: 8 segments of 3 kOhm. From
# there on, a fit that starts at rest takes fewer steps.
LONG_LINE_OHM: Final = 24e3
# Where a fit starts from cells of `matrix`, `matrix` ends below this chi-square per port. Chosen:
# one step is enough, and with less the answers are the same.
START_CHI2: Final = 4.0
# Why such a frame is no answer.
BEYOND_REGION: Final = "something has changed outside of the region: read the whole skin"


class JointEstimator(Estimator):
    """Finds all 3RC resistances: cells and means of wires by steps, single segments as noise.

    Where wires are long, single segments are among these means (`learn_segments`).

    It learns the wires from frame to frame.
    """

    name: ClassVar[str] = "joint"
    takes_far: ClassVar[bool] = True
    takes_leads: ClassVar[bool] = True

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._shape = (knowledge.rows, knowledge.columns)
        far = self._reader.far
        believe = MeasuredWires if any(far) else LearnedWires
        wires, bent = knowledge.nominal_wire_ohm, knowledge.may_be_bent
        self._belief: WireBelief = believe(self._shape, wires, far, may_be_bent=bent)
        self._told_share = wires.told_share
        rest = knowledge.rest_ratio
        rest_ports = None if rest is None else self._reader.read(rest)
        self._at_rest = CellsAtRest(rest_ports, self._belief, knowledge.ref_ohm)
        self._finder: SparseFit | None = None
        # Of the last whole frame, and of the regions since, (RC,).
        self._hidden_ohm: Float
        self.reset()

    def wires(self) -> WireOhm:
        """The wires that were told, until a frame has taught more of them."""
        learned = self._belief.learned()
        return super().wires() if learned is None else learned

    def leak_ohm(self) -> tuple[float, float] | None:
        """Resistance of the leaks between rows, and between columns, at each crossing [ohm].

        None: the rest readings do not show leaks for sure, or nobody has told rest readings.
        """
        self.rest()
        if not self._at_rest.is_damp:
            return None
        by_row, by_column = np.maximum(self._belief.leak_siemens(self._belief.means), 1e-9)
        return 1 / float(by_row), 1 / float(by_column)

    def wires_are(self) -> str:
        """Layers that were told are "known"; others are "assumed" until frames have taught them."""
        if self._belief.untold:
            return ASSUMED if self._belief.is_assumed else "learned"
        return "known"

    def reset(self) -> None:
        """Forget the frames before, and what they revealed of the wires.

        Whether single segments are learned stays (`learn_segments`). So if frames have begun that,
        answers may differ from those of a new estimator, by a small part of their deviations.
        """
        super().reset()
        self._touches = 0  # touched cells in the last fit
        self._staying = StayingFaults(self._shape)
        # The last whole frame, for regions of the frames after it; and the last region.
        self._whole: FullFit | Touched | WholeFrame | None = None
        self._whole_message = ""  # why that frame is no answer, in words, or empty
        self._region: RegionFit | None = None
        self._belief.reset()
        self._at_rest.reset()

    def _solve(self, ports: PortReadings) -> Solution:
        """The answer for one frame.

        Where a fit moves what is believed of the wires too far for its slopes, the frame is fitted
        again, and the last fit is the answer.
        """
        again = False
        try:
            for _ in range(MOST_FITS):
                solution, again = self._fitted(ports, again=again)
                if not again:
                    break
            return solution
        except np.linalg.LinAlgError:
            # Impossible readings of far ends that are told to be exact do this: only a noise above
            # 0 keeps `far_wires` from dividing by 0. No other readings are known that do it. The
            # answer takes each cell for the only one of its port. No model was fitted, so chi2 only
            # compares readings with their own current.
            return Solution(
                cell_siemens=conductance_from_current(ports.current, self.knowledge.ref_ohm),
                cell_siemens_std=np.full(self._shape, MAX_CELL_SIEMENS),
                chi2=self._chi2(ports, ports.current),
                message="the circuit that these readings lead to cannot be solved",
            )

    def _fitted(self, ports: PortReadings, *, again: bool) -> tuple[Solution, bool]:
        """One fit of a frame, and whether the frame has to be fitted again.

        A frame of a region is fitted by `RegionFit` if this explains it, or by `_beyond_region`;
        nothing is learned from it. Another frame is fitted by a few touches where these are the
        answer, as they may be for `touch`. Else it is the fit of all resistances.

        again: the frame has been fitted before. What this fit teaches takes the place of what the
            last one has taught.
        """
        prior = self._at_rest.of_frame(ports)
        if ports.region is not None and self._whole is not None:
            if part := self._of_region(prior, ports, self._whole):
                return self._solution(ports, part, self._whole_message), False
            return self._solution(ports, self._beyond_region(prior, ports), BEYOND_REGION), False
        touches = self._few_touches(prior, ports)
        if touches is not None and (touched := self._explained_by(prior, touches)):
            return self._of_few(ports, touched, again=again)
        return self._of_all(prior, ports, touches, again=again)

    def _of_few(
        self, ports: PortReadings, touched: Touched, *, again: bool
    ) -> tuple[Solution, bool]:
        """`_fitted` of a few touches. The belief about the wires learns from it."""
        solution = self._solution(ports, touched)
        again = not ports.fault and self._belief.after_fit(touched, ports, again=again)
        self._whole_message = self._belief.fault
        # The cells are by what was believed before; the wires have learned from this frame.
        wires = self._belief.believed_wires()
        taught = solution._replace(
            message=self._whole_message,
            wire_ohm=wires.segment_ohm,
            wire_ohm_std=wires.segment_std_ohm,
        )
        return taught, again

    def _of_all(
        self, prior: CellPrior, ports: PortReadings, touches: FewTouches | None, *, again: bool
    ) -> tuple[Solution, bool]:
        """`_fitted` of all resistances. Damages, and the belief about the wires, learn from it."""
        is_palm = touches is None and self._shows_palm(prior, ports)
        fit, is_tip = self._fit_all(prior, ports, touches, is_palm=is_palm)
        self._touches = prior.touches(fit.log_cells)
        rise_log, message = prior.expected - fit.log_cells, self._doubt(prior, fit)
        if not ports.fault:
            # A palm tells of no damage: that so many cells are pressed is a surprise by itself.
            if not (again or is_palm):
                knows_rest = not self._at_rest.are_hidden
                self._staying.ask(fit, rise_log, is_doubted=bool(message), knows_rest=knows_rest)
            message = self._staying.named or message or self._staying.unnamed
        solution = self._solution(ports, fit, message)  # now: a lesson moves the belief
        # Soft fingertips teach nothing: other forces explain them as well as other wires do.
        if ports.fault or message or prior.is_soft(fit.log_cells, self._shape):
            again = False
        else:
            tip_log = rise_log if is_tip else None
            again = self._belief.after_fit(fit, ports, tip_log, again=again)
        self._belief.expect_usual(True)
        return solution, again

    def _fit_all(
        self, prior: CellPrior, ports: PortReadings, touches: FewTouches | None, *, is_palm: bool
    ) -> tuple[FullFit, bool]:
        """The fit of all resistances, with the prior that suits these touches.

        Returns whether it has expected fingertips or a palm, too.

        It starts from the few touches that `SparseFit.find` found, even if `FewTouches.explain`
        rejected these. Where `find` found none, it starts from cells of `matrix`. `matrix` neglects
        wires, and what is expected of cells. So one more step goes towards both, by the slopes that
        `matrix` had. Under a palm, and where far ends show that wires resist too much to be
        neglected, cells start at rest.
        """
        ref_ohm, cells = self.knowledge.ref_ohm, None
        is_long = all(self._belief.far) and self._belief.line_ohm() > LONG_LINE_OHM
        if touches is not None:
            start = touches.log_cells
        elif is_palm or is_long:
            start = prior.expected
        else:
            cells = CellFit(ports, ref_ohm, None, START_CHI2 * ports.current.size)
            start = _between(-np.log(cells.best.cell.ravel()), prior)
        self._belief.before_fit(start, ports)
        if is_palm:
            # On a large skin, cells that conduct less behind shorter wires explain a palm nearly as
            # well. A fit that moves both at once ends there. So cells move first.
            self._belief.expect_usual(True)
            held = FullFit(prior, self._belief, ref_ohm, ports, start, holds_wires=True)
            start = held.log_cells
        fit_prior = prior
        if prior.is_soft(start, self._shape):
            fit_prior = prior.for_soft_touches()
        elif not self._knows_wires:
            fit_prior = prior.for_fingertips(start, self._shape)
        is_tip = is_palm or fit_prior is not prior
        self._belief.expect_usual(is_tip or prior.is_crowded(start))
        if cells is not None:
            expected = fit_prior.about(self._belief.means).normal(start)
            lost_ohm = self._belief.lost_ohm(cells.best.impedance, cells.best.cell)
            start = _between(cells.nearer(*expected, lost_ohm), prior)
        return FullFit(fit_prior, self._belief, ref_ohm, ports, start), is_tip

    def _shows_palm(self, prior: CellPrior, ports: PortReadings) -> bool:
        """Whether the median port shows that a palm is on the skin, or something flat."""
        level = rest_level(ports.current, self.knowledge.ref_ohm)
        return bool(level > PALM_TIMES * np.exp(-prior.expected.mean()))

    def _few_touches(self, prior: CellPrior, ports: PortReadings) -> FewTouches | None:
        """The touched cells, if they are few; else None.

        To look for few touches takes time, and under a finger that stays on the skin no frame has
        few. So after a fit with many touches nothing is looked for. Nor is it where wires hide even
        the cells at rest: there nobody can be sure that touches are few.
        """
        if self._at_rest.are_hidden or self._touches > most_touches(self._shape):
            return None
        if self._finder is None or self._finder.prior is not prior:
            self._finder = SparseFit(prior, self._belief, self.knowledge.ref_ohm)
        return self._finder.find(ports)

    def _of_region(
        self, prior: CellPrior, ports: PortReadings, whole: Answer | WholeFrame
    ) -> RegionFit | None:
        """A fit of the cells that were read; the others stay as in the last whole frame.

        None: this fit does not explain the readings.
        """
        assert ports.region is not None
        if not isinstance(whole, WholeFrame):
            self._whole = whole = self._as_whole(prior, whole)
            self._region = RegionFit(whole, ports.region)
        assert self._region is not None
        if not np.array_equal(self._region.region, ports.region):
            self._move_region(prior, ports.region)
        explains = self._region.fit(ports)
        if explains and self._region.has_left():
            self._region.age -= 1
            self._move_region(prior, ports.region)
            explains = self._region.fit(ports)
        return self._region if explains else None

    def _move_region(self, prior: CellPrior, region: Cells) -> None:
        """Go on with this region, about the cells as the last region has left them."""
        assert self._region is not None
        self._whole = whole = self._as_whole(prior, self._region)
        self._region = RegionFit(whole, region, self._region.age)

    def _beyond_region(self, prior: CellPrior, ports: PortReadings) -> FullFit:
        """The fit of a frame that its region does not explain: something outside has changed.

        A port that was not read says less and less of its cells, and the prior says that they are
        at rest. So they stay as they were, but no better known than what this fit makes of them.
        """
        assert self._region is not None
        fit, _ = self._fit_all(prior, ports, None, is_palm=False)
        self._region.keep_others(fit)
        return fit

    def _as_whole(self, prior: CellPrior, answer: Answer) -> WholeFrame:
        """This answer, as what regions of later frames are fitted about."""
        return WholeFrame(prior, self._belief, self.knowledge.ref_ohm, answer)

    def _explained_by(self, prior: CellPrior, touches: FewTouches) -> Touched | None:
        """The answer of these few touches, if they are all that the frame shows.

        For `joint` it is always None: `joint` fits all resistances of every frame.
        """
        return None

    def _solution(
        self, ports: PortReadings, fit: FullFit | Touched | RegionFit, message: str = ""
    ) -> Solution:
        """The answer that this fit gives. A whole frame is kept for the regions after it."""
        belief = self._belief
        if not isinstance(fit, RegionFit):
            self._whole, self._whole_message = fit, message
        wires = belief.believed_wires()
        if isinstance(fit, FullFit):
            wires = belief.wires(fit.wires, fit.means)
        series_ohm = wires.path_ohm + self.knowledge.ref_ohm
        means_std, upper = belief.means_std()[:3], belief.upper_limits()

        def stds(by_means: Float) -> tuple[Float, Float]:
            parts = fit.own_log_std, by_means, means_std
            return siemens_std(-fit.log_cells, *parts, upper, series_ohm)

        std, std_down = stds(fit.by_means)
        # Where the model misses the readings by more than their noise, or by more than it expects
        # to, it is wrong somewhere. So all variances are widened by the ratio.
        wider = max(1.0, fit.misfit, fit.surprise) ** 0.5
        cell_ohm = np.exp(fit.log_cells)
        if isinstance(fit, RegionFit):  # outside, all stays as in the whole frame
            self._hidden_ohm = self._hidden_ohm.copy()
            self._hidden_ohm[ports.region] = wires.hidden_path_ohm[ports.region]
        else:
            self._hidden_ohm = wires.hidden_path_ohm
        level = in_series(cell_ohm, self._hidden_ohm)
        level_std = std
        if told_share := self._told_share:  # of the means, this share is in curves of presses
            level_std, _ = stds((1.0 - told_share) ** 0.5 * fit.by_means)
        level_std = level_std * (level * cell_ohm) ** 2  # cell and level have the same error in ohm
        return Solution(
            cell_siemens=(1.0 / cell_ohm).reshape(self._shape),
            cell_siemens_std=wider * std.reshape(self._shape),
            cell_siemens_std_down=wider * std_down.reshape(self._shape),
            chi2=self._chi2(ports, fit.modelled.reshape(self._shape)),
            iterations=fit.iterations,
            message=message,
            wire_ohm=wires.segment_ohm,
            wire_ohm_std=wires.segment_std_ohm,
            level=level.reshape(self._shape),
            level_std=wider * level_std.reshape(self._shape),
        )

    def _doubt(self, prior: CellPrior, fit: FullFit) -> str:
        """Why this fit cannot be the answer; empty if it can."""
        if message := self._belief.fault or fit.message:
            return message
        # On a leaky skin, short lines hide cells at rest as well. That is no reason to doubt: a
        # touch conducts more than a cell at rest, and short lines do not hide it.
        if self._at_rest.are_hidden and self._belief.line_ohm() > LONG_LINE_OHM:
            return "wires resist too much: even cells at rest are uncertain"
        if fit.misfit > MAX_CHI2:
            return f"no resistances explain the readings: chi-square {fit.misfit:.1f}"
        gain = -np.log(HIGHEST_TOUCH_SIEMENS) - fit.log_cells.reshape(self._shape)
        short = worst_cell(gain, "conducts more than any touch, is it a short?")
        if short or self.knowledge.rest_ratio is None:
            return short
        # Beside fingertips on a large skin, readings say little of a cell at rest: it may seem to
        # conduct half as much. The conductance that it lost is counted in its deviation: the log of
        # an open cell is hardly known, and its conductance is.
        shown_log = np.log1p(SHOWN_STDS * fit.log_cells_std)
        loss = fit.log_cells - prior.expected - np.maximum(LOSS_STDS * prior.std, shown_log)
        return worst_cell(loss.reshape(self._shape), LOSS_TEXT)

    @property
    def _knows_wires(self) -> bool:
        """Whether weak cells at the edge of a fingertip cannot pass for wires or for a lead."""
        return self.knowledge.are_wires_sure or all(self._belief.far)


def _between(log_cells: Float, prior: CellPrior) -> Float:
    """These logs, none above rest, nor below that of the hardest touch [log ohm]."""
    softest = np.maximum(log_cells, -np.log(HIGHEST_TOUCH_SIEMENS))
    return np.asarray(np.minimum(softest, prior.expected))


class TouchEstimator(JointEstimator):
    """The simplest model that explains a frame. Cells at rest are reported as at rest."""

    name: ClassVar[str] = "touch"

    def _explained_by(self, prior: CellPrior, touches: FewTouches) -> Touched | None:
        """The answer of these few touches.

        None: they do not explain the frame, or leave one of the touched cells uncertain. Or they
        lie as under a fingertip, at whose edge cells seem untouched that are not.
        """
        # Where wires are assumed, the fit of all resistances teaches them sooner.
        if self.knowledge.rest_ratio is None or self._belief.is_assumed:
            return None
        may_be_tip = touches.cells.size >= LEAST_TIP and not self._knows_wires
        if may_be_tip and prior.fingertips(touches.log_cells, self._shape).any():
            return None
        touched = touches.explain()
        if touched and touched.log_cells_std[touched.cells].max(initial=0.0) <= CLEAR_LOG:
            return touched
        return None
