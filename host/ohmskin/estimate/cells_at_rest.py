# SPDX-License-Identifier: Apache-2.0
"""What is expected of the cells of a frame, from the readings of the untouched skin.

These readings are fitted like a frame. They show a cell and its wires together: so the cells at
rest follow what is believed of the wires, and are fitted again where it has moved far. Leaks
between neighbouring lines are found here as well.
"""

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    LAYER_STD,
    REST_STD,
    SEGMENT_STD,
    UNKNOWN_REST_STD,
    UNTOUCHED_STD,
    CellPrior,
    rest_level,
)
from ohmskin.estimate.wire_belief import LARGE_MOVE_LOG, WireBelief

# Fits of the rest readings. Each has a prior about the median of the cells that the fit before it
# found. Chosen.
REST_FITS: Final = 3
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
# The untouched skin is solved again if the mean lead has moved by more. Chosen: less moves readings
# by less than their rounding.
LEAD_MOVE_OHM: Final = 20.0
# Slopes of cells at rest hold until logs of cells err by this share of `REST_STD`. Chosen: a tenth
# of what cells drift.
BENT_SHARE: Final = 0.1
# Single segments are learned if a line resists more than this from end to end [ohm], on skins of
# at most so many cells. Chosen: with shorter lines it gains nothing, and larger skins take long.
LEARNED_LINE_OHM: Final = 2400.0
LEARNED_CELLS: Final = 128


class CellsAtRest:
    """What is expected of the cells of each frame, while what is believed of the wires changes.

    rest: what the ports of the untouched skin have shown; None: nobody knows.
    is_damp: whether this shows leaks for sure.
    """

    def __init__(self, rest: PortReadings | None, belief: WireBelief, ref_ohm: float) -> None:
        """ref_ohm: both references in series [ohm]."""
        self.rest, self._belief, self._ref_ohm = rest, belief, ref_ohm
        self._prior: CellPrior | None = None
        self._means: Float  # (n,), at the last fit of the rest readings
        # The means (n,) that the prior has been compared with.
        self._followed: Float | None = None
        # The part of a cell's log deviation at rest that comes from the wires; the largest of all
        # cells.
        self._wires_log_std = 0.0
        self.is_damp = False

    def reset(self) -> None:
        """Forget what frames have shown. What rest readings have shown stays."""
        self._followed = None
        if self.rest is None:
            self._prior = None

    @property
    def are_hidden(self) -> bool:
        """Whether wires resist so much that they hide even the cells at rest."""
        return self._wires_log_std > REST_STD

    @property
    def _should_learn_segments(self) -> bool:
        """Whether single segments matter, and are not being learned yet.

        They are learned from then on, which takes time. So it does not begin while layers are
        assumed: the first touches may make usual lines seem long.
        """
        belief = self._belief
        if any(belief.far) or belief.learns_segments or belief.is_assumed:
            return False
        rows, columns = belief.shape
        return rows * columns <= LEARNED_CELLS and belief.line_ohm() > LEARNED_LINE_OHM

    def of_frame(self, ports: PortReadings) -> CellPrior:
        """What is expected of the cells of this frame, by the rest readings if there are any."""
        if self.rest is None:
            self._prior = self._by_level(ports)
        elif self._prior is None:
            self._prior = self._by_rest(self.rest)
        else:
            self._prior = self._following(self.rest, self._prior)
        return self._prior

    def _following(self, rest: PortReadings, prior: CellPrior) -> CellPrior:
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
            return self._by_rest(rest, prior)
        # Cells at rest follow the layers by slopes, which hold for small moves only. After a larger
        # move, the rest readings are fitted again. (Readings at far ends hardly depend on the
        # layers.)
        near = not any(self._belief.far)
        if near and self._bends_slopes(prior, means):
            return self._by_rest(rest, prior)
        least_log = 0.5 * (LAYER_STD if all(self._belief.far) else SEGMENT_STD)
        least = np.full(means.size, 0.5 * SEGMENT_STD)
        least[:2], least[2] = least_log, LEAD_MOVE_OHM
        least[3 : 3 + sum(self._belief.shape)] = LEAD_MOVE_OHM / max(float(means[2]), LEAD_MOVE_OHM)
        leaks = self._belief.leaks(least)
        leaks[:] = np.maximum(SEGMENT_STD * np.abs(self._belief.leaks(means)), LEAK_MOVE_US)
        return prior.about(means) if (np.abs(means - prior.means) > least).any() else prior

    def _bends_slopes(self, prior: CellPrior, means: Float) -> bool:
        """Whether the layers have moved further than the slopes of cells at rest hold.

        Cells follow the ohms of wires nearly linearly, but slopes are by their logs. So after a
        move by d, a slope errs by e^d - 1 - d.
        """
        move = (means - self._means)[:2]
        if self.are_hidden:  # cells have no slopes then
            return bool(np.abs(move).max() > LARGE_MOVE_LOG)
        off_log = prior.by_means[:, :2] @ (np.expm1(move) - move)
        return bool(np.abs(off_log).max() > BENT_SHARE * REST_STD)

    def _by_level(self, ports: PortReadings) -> CellPrior:
        """All cells at the lowest level that this frame or one before it has shown.

        The level is one number for all cells. If each cell had its own, a cell that has been
        pressed from the beginning would be taken for a cell at rest.
        """
        log_ohm, before = -np.log(rest_level(ports.current, self._ref_ohm)), self._prior
        # Touches only raise the level. So the lowest one, with the most ohms, is nearest to rest.
        if before is not None and log_ohm <= before.expected[0]:
            return before
        return self._alike(ports.current.size, log_ohm, UNKNOWN_REST_STD)

    def _alike(self, cells: int, log_ohm: float, std: float) -> CellPrior:
        """A prior of so many cells, all alike."""
        logs, stds, means = np.full(cells, log_ohm), np.full(cells, std), self._belief.means
        return CellPrior(logs, stds, np.zeros((cells, len(means))), means)

    def _by_rest(self, ports: PortReadings, before: CellPrior | None = None) -> CellPrior:
        """Log resistances of the untouched cells, and how well they are known.

        The rest readings are fitted like a frame, with a prior that has all cells alike, at one
        level. The fit is repeated with the level at the median of the cells that were found: a
        level that is a little wrong for all cells would weigh more than the readings.

        before: the prior for what was believed of the wires until now. Its median is near the new
            one, so that one fit is enough. None: there is none yet.
        """
        if before is None:
            level = rest_level(ports.current, self._ref_ohm)
            log_cells: Float = np.full(ports.current.size, -np.log(level))
            fit = self._fit_rest(ports, log_cells, REST_FITS)
        else:
            fit = self._fit_rest(ports, before.expected, 1)
        if not (self._belief.has_leaks or fit.message):
            gain = leaks_of(fit)[0]
            self.is_damp = gain > DAMP_GAIN
            if gain > LEAK_GAIN:
                fit = self._expect_leaks(ports, fit)
        log_cells = fit.log_cells
        self._means = means = self._belief.means
        by_layers_std = fit.by_means[:, :2] * self._belief.means_std()[:2]
        self._wires_log_std = float(np.hypot(*by_layers_std.T).max())
        self._belief.fix_rest_wires()
        # Where wires hide even cells at rest, cells depend on the wires too strongly for slopes.
        by_means = np.zeros((log_cells.size, len(means)))
        if not self.are_hidden:
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
            fit = FullFit(alike, self._belief, self._ref_ohm, ports, log_cells)
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
