# SPDX-License-Identifier: Apache-2.0
"""`joint`: every resistance of the skin at once, from one circuit for all readings.

RC readings do not determine 3RC resistances. A prior decides what they leave open, and the standard
deviations of the answer say how much of it comes from the prior:

- a cell is near its rest resistance, or touched. This is what removes ghosts that the readings do
  not exclude.
- a wire segment is near what is believed of it: at first the nominal value of its layer, later what
  the frames before have revealed.

The maximum of the posterior is found by a few Gauss-Newton steps (`full_fit`). They begin at the
few touches that `sparse_fit` finds. If touches are many, as under a fingertip, they begin at the
cells that `matrix` finds.

`touch` takes the cells at rest and the wires out of the fit and into the noise: its answer is those
few touches. Where they do not explain the frame, or lie as under a fingertip, its answer is that of
`joint`. Without rest readings no cell is known to be untouched, so every frame is for `joint`.
"""

from dataclasses import replace
from typing import ClassVar, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.base import ASSUMED, Estimator, Solution, in_series
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
    LAYER_STD,
    MAX_CHI2,
    PALM_SHARE,
    REST_STD,
    SEGMENT_STD,
    UNKNOWN_REST_STD,
    UNTOUCHED_STD,
    CellPrior,
    rest_level,
    siemens_std,
)
from ohmskin.estimate.region_fit import Answer, RegionFit, WholeFrame
from ohmskin.estimate.sparse_fit import FewTouches, SparseFit, Touched, most_touches
from ohmskin.estimate.staying_faults import StayingFaults
from ohmskin.estimate.wire_belief import LARGE_MOVE_LOG, MOST_FITS, WireBelief

# Fits of the rest readings. Each has a prior about the median of the cells that the fit before it
# found. Chosen.
REST_FITS: Final = 3
# A cell that conducts less than at rest by more deviations of its prior is at fault. Chosen:
# `make ablate` tries other ones.
LOSS_STDS: Final = 10.0
# And the frame must show it: by more deviations of its conductance after the fit. Chosen: beside
# fingertips on 16x16, cells at rest seem to conduct less by up to 3, and open ones by 5 and more.
SHOWN_STDS: Final = 4.0

# Fits expect leaks if these explain so much of how cells differ at rest: it is the gain in twice
# the log likelihood. Chosen: few sound skins gain as much by chance, and it costs them some time
# and next to no accuracy. Leaks of 10 MOhm gain more, and neglected they spoil most frames.
LEAK_GAIN: Final = 6.0
# A skin is said to be damp if leaks explain so much. Chosen: by chance, one sound skin of 270,000
# gains as much, exp(-25 / 2) by the F distribution.
DAMP_GAIN: Final = 25.0
# Fits of the leaks, each from the one before. Chosen: the last one moves the leaks by less than
# their deviation.
LEAK_FITS: Final = 8
# The largest leak at each crossing [uS]. Chosen: 10 kOhm, as of a wet skin.
MOST_LEAK_US: Final = 100.0
# Deviation of the leaks while they are being found [uS]. Chosen: a gigohm, so they stay as told.
SEARCHED_LEAK_STD_US: Final = 1e-3
# Cells at rest are taken anew if a leak has moved by more, and by more than 10 %. Chosen: 200 MOhm,
# which no reading shows.
LEAK_MOVE_US: Final = 5e-3
# Standard deviation of a leak, as a share of it: leaks differ from crossing to crossing, and become
# less while the skin dries. Chosen.
LEAK_STD: Final = 0.2
# A frame whose touch is spread over a larger share of the cells tells of no fault that stays.
# Chosen: two of the widest fingertips have 0.38 of 8x8 cells, and palms that no fit finds had 0.42
# and more.
TELLING_SHARE: Final = 0.4
# Skins of fewer ports are told no such fault. Chosen: on 3x3, a few odd readings spoil a whole
# frame.
LEAST_STAYING_PORTS: Final = 16
# The untouched skin is solved again if the mean lead has moved by more. Chosen: less moves readings
# by less than their rounding.
LEAD_MOVE_OHM: Final = 20.0
# A line that resists more than this from end to end is long [ohm]: to find where a fit starts, its
# wire must not be neglected, and it may hide touches behind it. Chosen: 8 segments of 3 kOhm. From
# there on, a fit that starts at rest takes fewer steps.
LONG_LINE_OHM: Final = 24e3
# Single segments are learned if a line resists more than this from end to end [ohm], on skins of
# at most so many cells. Chosen: with shorter lines it gains nothing, and larger skins take long.
LEARNED_LINE_OHM: Final = 2400.0
LEARNED_CELLS: Final = 128


class JointEstimator(Estimator):
    """Finds all 3RC resistances: cells and means of wires by steps, single segments as noise.

    Where wires are long, single segments are among these means (`learn_segments`).

    It learns the wires from frame to frame.
    """

    name: ClassVar[str] = "joint"
    takes_far: ClassVar[bool] = True

    def __init__(self, knowledge: SkinKnowledge) -> None:
        super().__init__(knowledge)
        self._shape = (knowledge.rows, knowledge.columns)
        far = self._reader.far
        believe = MeasuredWires if any(far) else LearnedWires
        wires, bent = knowledge.nominal_wire_ohm, knowledge.may_be_bent
        self._belief: WireBelief = believe(self._shape, wires, far, may_be_bent=bent)
        self._prior: CellPrior | None = None
        # The rest readings as they were read, and the means (n,) at their last fit. Both come with
        # the first prior, if rest readings are known.
        self._rest_ports: PortReadings
        self._rest_means: Float
        self._finder: SparseFit | None = None
        # The means (n,) that the prior has been compared with.
        self._followed: Float | None = None
        # The part of a cell's log deviation at rest that comes from the wires; the largest of all
        # cells.
        self._rest_wires_log_std = 0.0
        self._is_damp = False
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
        if not self._is_damp:
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
        # (R, C) [S]: what `matrix` found in the last frame that it was asked about.
        self._cells_before: Float | None = None
        self._touches = 0  # touched cells in the last fit
        self._staying = StayingFaults(self._shape)
        # The last whole frame, for regions of the frames after it; and the last region.
        self._whole: FullFit | Touched | WholeFrame | None = None
        self._whole_message = ""  # why that frame is no answer, in words, or empty
        self._region: RegionFit | None = None
        self._belief.reset()
        self._followed = None
        if self.knowledge.rest_ratio is None:
            self._prior = self._finder = None

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

        The fit is that of a few touches where these are the answer, as they may be for `touch`;
        else it is the fit of all resistances. The belief about the wires learns from it. A frame of
        a region is fitted by `RegionFit` if this explains it; nothing is learned from it.

        again: the frame has been fitted before. What this fit teaches takes the place of what the
            last one has taught.
        """
        prior = self._prior_of(ports)
        if ports.region is not None and (part := self._of_region(prior, ports)):
            return self._solution(ports, part, self._whole_message), False
        touches = self._few_touches(prior, ports)
        if touches is not None and (touched := self._explained_by(touches)):
            solution = self._solution(ports, touched)
            again = not ports.fault and self._belief.after_fit(touched, ports, again=again)
            self._whole_message = self._belief.fault
            # The cells are by what was believed before; the wires have learned from this frame.
            wires = self._belief.believed_wires()
            return replace(
                solution,
                message=self._whole_message,
                wire_ohm=wires.segment_ohm,
                wire_ohm_std=wires.segment_std_ohm,
            ), again
        start = self._start(prior, ports, touches)
        self._belief.before_fit(start, ports)
        is_soft, fit_prior = prior.is_soft(start, self._shape), prior
        if is_soft:
            fit_prior = prior.for_soft_touches()
        elif not self._knows_wires:
            fit_prior = prior.for_fingertips(start, self._shape)
        self._belief.expect_usual(prior.is_crowded(start) or fit_prior is not prior)
        fit = FullFit(fit_prior, self._belief, self.knowledge.ref_ohm, ports, start)
        spread_share = prior.spread_share(fit.log_cells)
        if spread_share > PALM_SHARE and fit_prior is not prior:
            # So many cells are not the few hard touches that the narrow prior would prefer. It
            # knows better which cells are at rest.
            fit = FullFit(prior, self._belief, self.knowledge.ref_ohm, ports, fit.log_cells)
        self._touches = prior.touches(fit.log_cells)
        message, rise_log = self._doubt(prior, fit), prior.expected - fit.log_cells
        # A palm tells of no fault: that so many cells are pressed is a surprise by itself.
        silent = ports.fault or again or spread_share > TELLING_SHARE
        if not silent and ports.current.size >= LEAST_STAYING_PORTS:
            self._staying.count(fit, is_doubted=bool(message))
            if not self._hides_rest:
                self._staying.compare(fit, rise_log)
        if not ports.fault:
            message = self._staying.named or message or self._staying.unnamed
        solution = self._solution(ports, fit, message)  # now: a lesson moves the belief
        # Soft fingertips teach nothing: other forces explain them as well as other wires do.
        if ports.fault or message or prior.is_soft(fit.log_cells, self._shape):
            again = False
        else:
            tip_log = None if fit_prior is prior else rise_log
            again = self._belief.after_fit(fit, ports, tip_log, again=again)
        self._belief.expect_usual(True)
        return solution, again

    def _few_touches(self, prior: CellPrior, ports: PortReadings) -> FewTouches | None:
        """The touched cells, if they are few; else None.

        To look for few touches takes time, and under a finger that stays on the skin no frame has
        few. So after a fit with many touches nothing is looked for. Nor is it where wires hide even
        the cells at rest: there nobody can be sure that touches are few.
        """
        if self._hides_rest or self._touches > most_touches(self._shape):
            return None
        if self._finder is None or self._finder.prior is not prior:
            self._finder = SparseFit(prior, self._belief, self.knowledge.ref_ohm)
        return self._finder.find(ports)

    def _of_region(self, prior: CellPrior, ports: PortReadings) -> RegionFit | None:
        """A fit of the cells that were read; the others stay as in the last whole frame.

        None: there is no whole frame yet, or this fit does not explain the readings.
        """
        assert ports.region is not None
        if self._whole is None:
            return None
        if not isinstance(self._whole, WholeFrame):
            self._whole, self._region = self._as_whole(prior, self._whole), None
        if self._region is None or not np.array_equal(self._region.region, ports.region):
            self._region = RegionFit(self._whole, ports.region)
        explains = self._region.fit(ports)
        if explains and self._region.has_left():
            self._whole = self._as_whole(prior, self._region)
            self._region = RegionFit(self._whole, ports.region, self._region.age - 1)
            explains = self._region.fit(ports)
        return self._region if explains else None

    def _as_whole(self, prior: CellPrior, answer: Answer) -> WholeFrame:
        """This answer, as what regions of later frames are fitted about."""
        return WholeFrame(prior, self._belief, self.knowledge.ref_ohm, answer)

    def _explained_by(self, touches: FewTouches) -> Touched | None:
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
        if told_share := belief.told.told_share:  # of the means, this share is in curves of presses
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
        if self._hides_rest and self._line_ohm() > LONG_LINE_OHM:
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
    def _hides_rest(self) -> bool:
        """Whether wires resist so much that they hide even the cells at rest."""
        return self._rest_wires_log_std > REST_STD

    @property
    def _knows_wires(self) -> bool:
        """Whether weak cells at the edge of a fingertip cannot pass for wires or for a lead."""
        return self.knowledge.are_wires_sure or all(self._belief.far)

    def _line_ohm(self) -> float:
        """Resistance of the wire of a row or of a column, whichever is more, end to end [ohm]."""
        return float((np.exp(self._belief.means[:2]) * self._shape[::-1]).max())

    @property
    def _should_learn_segments(self) -> bool:
        """Whether single segments matter, and are not being learned yet.

        They are learned from then on, which takes time. So it does not begin while layers are
        assumed: the first touches may make usual lines seem long.
        """
        belief = self._belief
        if any(belief.far) or belief.learns_segments or belief.is_assumed:
            return False
        rows, columns = self._shape
        return rows * columns <= LEARNED_CELLS and self._line_ohm() > LEARNED_LINE_OHM

    def _start(self, prior: CellPrior, ports: PortReadings, touches: FewTouches | None) -> Float:
        """Log resistances of the cells to start from, (RC,).

        They are those of the few touches that `SparseFit.find` found, even if
        `FewTouches.explain` rejected these. Where `find` found none, they are what `matrix` finds.
        `matrix` neglects wires, so its cells come out a little too soft. This is wanted: from
        softer cells, the fit does not fall into the wrong minimum of one hard touch behind long
        wires. Where far ends show that wires resist too much to be neglected, the cells start at
        rest.
        """
        if touches is not None:
            return touches.log_cells
        if all(self._belief.far) and self._line_ohm() > LONG_LINE_OHM:
            return prior.expected
        # `matrix` may end early: cells that miss each reading by one deviation are a good start.
        tolerance = float(ports.current.size)
        fit = CellFit(ports, self.knowledge.ref_ohm, self._cells_before, tolerance)
        self._cells_before = None if fit.message else fit.best.cell
        siemens = np.minimum(fit.best.cell.ravel(), HIGHEST_TOUCH_SIEMENS)
        # No cell starts at more resistance than at rest.
        return np.minimum(-np.log(siemens), prior.expected)

    def _prior_of(self, ports: PortReadings) -> CellPrior:
        """What is expected of the cells of this frame, by the rest readings if there are any."""
        before, rest_ratio = self._prior, self.knowledge.rest_ratio
        if rest_ratio is None:
            prior = self._prior_by_level(ports)
        elif before is None:
            self._rest_ports = self._reader.read(rest_ratio)
            prior = self._prior_by_rest(self._rest_ports)
        else:
            prior = self._prior_followed(before)
        self._prior = prior
        return prior

    def _prior_followed(self, prior: CellPrior) -> CellPrior:
        """This prior, or a new one if what is believed of the wires has moved too far from it.

        Or a first one with single segments, from where these are to be learned.

        `SparseFit` solves its network once for each prior, with the mean wires that this prior is
        about. Each frame corrects small changes of the mean wires to first order; larger ones need
        a new prior and network. Where rows and columns are both sensed at far ends, no reading has
        the wires of its own lines in it. So there a change has to be larger before it matters.
        """
        means = self._belief.means
        if means is self._followed:  # as after most frames: this saves some percent of their time
            return prior
        self._followed = means
        if self._should_learn_segments:
            self._belief.learn_segments()
            return self._prior_by_rest(self._rest_ports, prior)
        # Cells at rest follow the layers by slopes, which hold for small moves only. After a larger
        # move, the rest readings are fitted again. (Readings at far ends hardly depend on the
        # layers.)
        near = not any(self._belief.far)
        if near and np.abs(means - self._rest_means)[:2].max() > LARGE_MOVE_LOG:
            return self._prior_by_rest(self._rest_ports, prior)
        least_log = 0.5 * (LAYER_STD if all(self._belief.far) else SEGMENT_STD)
        least = np.full(means.size, 0.5 * SEGMENT_STD)
        least[:2], least[2] = least_log, LEAD_MOVE_OHM
        least[3 : 3 + sum(self._shape)] = LEAD_MOVE_OHM / max(float(means[2]), LEAD_MOVE_OHM)
        leaks = self._belief.leaks(least)
        leaks[:] = np.maximum(SEGMENT_STD * np.abs(self._belief.leaks(means)), LEAK_MOVE_US)
        return prior.about(means) if (np.abs(means - prior.means) > least).any() else prior

    def _prior_by_level(self, ports: PortReadings) -> CellPrior:
        """All cells at the lowest level that this frame or one before it has shown.

        The level is one number for all cells. If each cell had its own, a cell that has been
        pressed from the beginning would be taken for a cell at rest.
        """
        log_ohm, before = -np.log(rest_level(ports.current, self.knowledge.ref_ohm)), self._prior
        # Touches only raise the level. So the lowest one, with the most ohms, is nearest to rest.
        if before is not None and log_ohm <= before.expected[0]:
            return before
        cells = ports.current.size
        return self._alike(cells, log_ohm, UNKNOWN_REST_STD)

    def _alike(self, cells: int, log_ohm: float, std: float) -> CellPrior:
        """A prior of so many cells, all alike."""
        logs, stds, means = np.full(cells, log_ohm), np.full(cells, std), self._belief.means
        return CellPrior(logs, stds, np.zeros((cells, len(means))), means)

    def _prior_by_rest(self, ports: PortReadings, before: CellPrior | None = None) -> CellPrior:
        """Log resistances of the untouched cells, and how well they are known.

        The rest readings are fitted like a frame, with a prior that has all cells alike, at one
        level. The fit is repeated with the level at the median of the cells that were found: a
        level that is a little wrong for all cells would weigh more than the readings.

        before: the prior for what was believed of the wires until now. Its median is near the new
            one, so that one fit is enough. None: there is none yet.
        """
        if before is None:
            level = rest_level(ports.current, self.knowledge.ref_ohm)
            log_cells: Float = np.full(ports.current.size, -np.log(level))
            fit = self._fit_rest(ports, log_cells, REST_FITS)
        else:
            fit = self._fit_rest(ports, before.expected, 1)
        if not (self._belief.has_leaks or fit.message):
            gain = leaks_of(fit)[0]
            self._is_damp = gain > DAMP_GAIN
            if gain > LEAK_GAIN:
                fit = self._expect_leaks(ports, fit)
        log_cells = fit.log_cells
        self._rest_means = means = self._belief.means
        by_layers_std = fit.by_means[:, :2] * self._belief.means_std()[:2]
        self._rest_wires_log_std = float(np.hypot(*by_layers_std.T).max())
        self._belief.fix_rest_wires()
        # Where wires hide even cells at rest, cells depend on the wires too strongly for slopes.
        by_means = np.zeros((log_cells.size, len(means)))
        if not self._hides_rest:
            by_means = fit.cells_by_means()
        std = np.hypot(np.minimum(fit.log_cells_std, UNTOUCHED_STD), REST_STD)
        return CellPrior(log_cells, std, by_means, means)

    def _expect_leaks(self, ports: PortReadings, fit: FullFit) -> FullFit:
        """Find the leaks, and let the belief expect them. Returns `_fit_rest` with these leaks.

        fit: of the rest readings, without leaks.
        """
        leaks_us = np.zeros(2)
        for _ in range(LEAK_FITS):
            _, more_us, stds_us = leaks_of(fit)
            # Only half of each step is taken: cells do not follow leaks linearly, and whole steps
            # would go back and forth.
            leaks_us = np.clip(leaks_us + 0.5 * more_us, 0.0, MOST_LEAK_US)
            self._belief.expect_leaks(leaks_us, np.full(2, SEARCHED_LEAK_STD_US))
            fit = self._fit_rest(ports, fit.log_cells, REST_FITS)
            if fit.message:
                break
        # A single line leaks into none, and nothing says so to its slopes.
        stds_us = np.maximum(np.hypot(stds_us, LEAK_STD * leaks_us), SEARCHED_LEAK_STD_US)
        self._belief.expect_leaks(leaks_us, stds_us)
        return self._fit_rest(ports, fit.log_cells, 1)  # to expect leaks has reset the wires

    def _fit_rest(self, ports: PortReadings, log_cells: Float, fits: int) -> FullFit:
        """The last of so many fits of the rest readings, from these cells (RC,)."""
        for _ in range(fits):
            self._belief.before_fit(log_cells, ports)
            alike = self._alike(log_cells.size, float(np.median(log_cells)), UNTOUCHED_STD)
            fit = FullFit(alike, self._belief, self.knowledge.ref_ohm, ports, log_cells)
            if fit.message:  # no skin gives these readings: more fits would only take more time
                break
            log_cells = fit.log_cells
        return fit


def leaks_of(fit: FullFit) -> tuple[float, Float, Float]:
    """What neighbouring rows, and columns, leak into each other beyond what a rest fit supposes.

    Where leaks are neglected, the cells of the lines at the edge seem to conduct less than others,
    because these lines have one neighbour alone. So the leaks are found, by least squares, as those
    with which the cells at rest are most alike.

    Returns three things: the gain in twice the log likelihood, which no negative leak counts for,
    the leaks, and their deviations, each (2,) [uS].
    """
    off, by_leaks = fit.log_cells - fit.log_cells.mean(), fit.cells_by_leaks()
    by_leaks = by_leaks - by_leaks.mean(axis=0)
    inverse = np.linalg.pinv(by_leaks.T @ by_leaks)  # a single line leaks into none
    leaks_us = -inverse @ by_leaks.T @ off
    left = off + by_leaks @ leaks_us
    # `drift` keeps cells that differ by less than they drift from telling of leaks. Three numbers
    # are fitted: the mean and two leaks.
    square, drift, free = left @ left, off.size * REST_STD**2, max(off.size - 3, 0)
    stds_us = np.sqrt(inverse.diagonal() * (square + drift) / max(free, 1))
    left = off + by_leaks @ np.maximum(leaks_us, 0.0)
    gain = free * float(np.log((off @ off + drift) / (left @ left + drift)))
    return gain, leaks_us, stds_us


class TouchEstimator(JointEstimator):
    """The simplest model that explains a frame. Cells at rest are reported as at rest."""

    name: ClassVar[str] = "touch"

    def _explained_by(self, touches: FewTouches) -> Touched | None:
        """The answer of these few touches.

        None: they do not explain the frame, or leave one of the touched cells uncertain. Or they
        lie as under a fingertip, at whose edge cells seem untouched that are not.
        """
        # Where wires are assumed, the fit of all resistances teaches them sooner.
        if self.knowledge.rest_ratio is None or self._belief.is_assumed:
            return None
        assert self._prior is not None
        if not self._knows_wires and self._prior.fingertips(touches.log_cells, self._shape).any():
            return None
        touched = touches.explain()
        if touched and touched.log_cells_std[touched.cells].max(initial=0.0) <= CLEAR_LOG:
            return touched
        return None
