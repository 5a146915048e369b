# SPDX-License-Identifier: Apache-2.0
"""What is expected of a skin's resistances before a frame is read: of its cells, and of its wires.

RC readings do not determine 3RC resistances; these numbers decide what they leave open. What is
believed of the wires is corrected by what frames show of them (`wire_belief`).
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float

# All numbers are chosen. `make ablate` tries half and twice of each, and none where that is
# possible; the table "What each number earns" of docs/estimate.md says what came of it.
# Names that end in _STD and _LOG are a deviation and a difference of the log of a resistance, where
# 0.1 is about 10 %. Names that end in _STDS are numbers of standard deviations.

# Deviation of a cell from the level of all cells, while its rest readings are being fitted.
UNTOUCHED_STD: Final = 1.0
# Deviation of a cell from the level of all cells, where nobody has rest readings.
UNKNOWN_REST_STD: Final = 0.3
# Deviation of a cell from its rest readings, because it drifts.
REST_STD: Final = 0.05
# The hardest touch, of 300 ohm: a cell that conducts more is a short.
HIGHEST_TOUCH_SIEMENS: Final = 1 / 300.0

# A cell further from rest than so many deviations of its prior is touched.
TOUCHED_STDS: Final = 2.0
# Deviation of a touched cell before it is read, because nobody knows how hard the touch is: a
# factor of twenty, either way.
UNLIMITED_STD: Final = 3.0
# A rise of a cell that must not go unnoticed: where a cell that seems to be at rest may have risen
# by more, `joint` widens its deviation.
HIDDEN_LOG: Final = 0.3
# If `touch` knows a touched cell less well than this, it lets `joint` answer: `touch` is less
# precise, because it takes all other cells to be at rest.
CLEAR_LOG: Final = 0.1
# Under fingertips a larger share of the cells is touched: the frame is crowded.
CROWDED_SHARE: Final = 0.3
# A frame of fingertips has at least so many touched cells. And it has more pairs of touched
# neighbours than by chance, by so many deviations of a Poisson distribution.
LEAST_TIP: Final = 3
CHANCE_STDS: Final = 3.0
# Under soft fingertips, the rises of neighbours in a crowded frame correlate by more.
SOFT_CORRELATION: Final = 0.5

# A wire segment of a layer whose nominal value nobody has told.
UNKNOWN_WIRE_OHM: Final = 150.0
# Deviation that all segments share, of a layer whose nominal value nobody has told: wires of 10 ohm
# to some kilohms are not unlikely.
UNKNOWN_LAYER_STD: Final = 1.5
# The same for usual layers: a factor of two. A bend changes layers by no more.
USUAL_LAYER_STD: Final = 0.7
# Deviation that all segments share, of a layer whose nominal value is told: stretch, temperature.
LAYER_STD: Final = 0.3
# Deviation of each segment from the mean of its layer, and of each lead from the mean lead, as a
# share of the mean.
SEGMENT_STD: Final = 0.1
# A lead that nobody has told: the switch of a CD74HC4067 at 5 V (data sheet: 70 typically, 160 at
# most), and a crimp.
UNKNOWN_LEAD_OHM: Final = 100.0
# Deviation that all leads share, if nobody has told them: a margin of yarn makes kilohms.
UNKNOWN_LEAD_STD_OHM: Final = 2000.0
# Deviation that all leads share, if they are usual ones: a switch and a crimp.
USUAL_LEAD_STD_OHM: Final = 150.0
# Deviation that all leads share, if they are told, as a share of them.
LEAD_STD: Final = 0.05
# Share of what is known of the layers that fades from one touch to the next, because wires drift.
STEADY_FADE: Final = 0.003
# Odds that the wires have changed altogether from one touch to the next, because skins bend.
CHANGED_ODDS: Final = 0.04
# Odds, before any touch, that wires change as suddenly as that, and do not only drift.
WARY_ODDS: Final = 2.0
# Touches tell which of the two fits better, by a score for each. At each further touch, this share
# of a score is kept.
MEMORY: Final = 0.8

# A fit gives up after so many steps, so that the time of a frame is bounded.
MAX_ITERATIONS: Final = 40
# A step of a fit is the last one if it leaves out less, in deviations: of a reading in `full_fit`,
# of a touched cell in `sparse_fit` and `region_fit`. Slopes change by about the share by which
# resistances do. So a step that moves something by n deviations, and logs by m since the slopes
# were made, leaves out about n m.
LEFT_OUT_STDS: Final = 0.25
# With a larger chi-square per port, no resistances explain the readings.
MAX_CHI2: Final = 1.5
# No step of a fit moves a log resistance by more, which is a factor of 4.5. And a frame in which a
# cell differs from the last lesson by as much may teach more of the wires.
MAX_STEP_LOG: Final = 1.5
# Where errors are skewed, the limit of so many deviations is computed. The deviation that is stated
# is the distance to this limit, divided by so many.
REACH_STDS: Final = 2.0
# Where nobody has told the wires and no frame has taught them, their upper limits count as so many
# deviations away. Chosen: few skins have wires near these limits. With 4, deviations under
# fingertips would be an eighth wider, and with 5, wires of 1 kohm would hide more of what they do
# (docs/estimate.md, "What the standard deviation covers").
UNTOLD_REACH_STDS: Final = 4.5
# Where wires are longer than the fit has them, they take at most this share of a cell's resistance.
# Chosen: all of it, and what slopes err by.
MOST_LOST_SHARE: Final = 1.05


@dataclass(frozen=True, eq=False)
class CellPrior:
    """Log resistance of the cells: normal near rest, heavy-tailed further away.

    With d the distance from `expected` over `std`, -2 log p is d^2 up to d = 1. From there it goes
    on as 1 + log(d^2), with the same slope at d = 1: the density falls slowly there, as 1 / d. For
    cells at rest the problem is quadratic, and needs few steps. That a cell is touched is unlikely;
    but once it is, a hard touch costs little more than a soft one.

    The rest readings show a cell and its wires together. So `expected` is right for one value of
    the means of the wires (`wire_belief`) alone; for other values, `about` corrects it.

    expected: log resistances at rest, (RC,) [log ohm].
    std: deviation of a cell that is not touched, (RC,).
    by_means: how `expected` follows the means, (RC, n).
    means: those for which `expected` is right, (n,).
    """

    expected: Float
    std: Float
    by_means: Float
    means: Float

    def about(self, means: Float) -> "CellPrior":
        """This prior for other means of the wires, (n,)."""
        expected = self.expected + self.by_means @ (means - self.means)
        return CellPrior(expected, self.std, self.by_means, means)

    def rise_stds(self, log_ohm: Float) -> Float:
        """How far a cell conducts more than at rest, in deviations."""
        return (self.expected - log_ohm) / self.std

    def touches(self, log_ohm: Float) -> int:
        """Number of touched cells."""
        return int(np.count_nonzero(self.rise_stds(log_ohm) > TOUCHED_STDS))

    def is_crowded(self, log_ohm: Float) -> bool:
        """Whether as many of these cells (RC,) are touched as under fingertips."""
        return self.touches(log_ohm) > CROWDED_SHARE * log_ohm.size

    def is_soft(self, log_ohm: Float, shape: tuple[int, int]) -> bool:
        """Whether cells (RC,) rise as under soft fingertips: many of them, neighbours alike.

        If two numbers have the correlation c, the variance of their difference is 2 (1 - c) times
        the variance of each. So if the differences of neighbours are smaller than this with c =
        `SOFT_CORRELATION`, neighbours correlate by more.
        """
        if not self.is_crowded(log_ohm):
            return False
        rise = (self.expected - log_ohm).reshape(shape)
        apart = np.concatenate([np.diff(rise, axis=axis).ravel() for axis in (0, 1)])
        return bool(apart @ apart < 2.0 * (1.0 - SOFT_CORRELATION) * rise.var() * apart.size)

    def for_soft_touches(self) -> "CellPrior":
        """The prior under soft fingertips, where rest is no more likely than a touch.

        The deviation about rest is wide for every cell. With the narrow one, a few hard touches
        behind long wires would seem more likely than many soft touches, because fewer cells have
        to leave rest.
        """
        return replace(self, std=np.maximum(self.std, UNTOUCHED_STD))

    def fingertips(self, log_ohm: Float, shape: tuple[int, int]) -> Bool:
        """Which cells (RC,) are within reach of a fingertip, if these are the cells' logs (RC,).

        Under fingertips, touched cells are neighbours more often than by chance: n touched cells of
        RC, anywhere, make each pair of neighbours a touched one with the probability n (n - 1) /
        RC / (RC - 1). The cells around such pairs may be touched as well. On skins of fewer than
        5x5 cells, no touches lie together so surely.
        """
        touched = self.rise_stds(log_ohm) > TOUCHED_STDS
        count, cells = np.count_nonzero(touched), touched.size
        if count < LEAST_TIP:  # as in most frames: this saves a tenth of their time
            return np.zeros_like(touched)
        on = touched.reshape(shape)
        in_rows, in_columns = on[:, 1:] & on[:, :-1], on[1:] & on[:-1]
        chance = (in_rows.size + in_columns.size) * count * (count - 1) / cells / (cells - 1)
        if in_rows.sum() + in_columns.sum() <= chance + CHANCE_STDS * chance**0.5:
            return np.zeros_like(touched)
        pairs = np.zeros((shape[0] + 2, shape[1] + 2), dtype=bool)  # with a margin
        inside = pairs[1:-1, 1:-1]
        inside[:, 1:] |= in_rows
        inside[:, :-1] |= in_rows
        inside[1:] |= in_columns
        inside[:-1] |= in_columns
        rows = pairs[:-2] | pairs[1:-1] | pairs[2:]
        return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]).ravel()

    def for_fingertips(self, log_ohm: Float, shape: tuple[int, int]) -> "CellPrior":
        """The prior where cells (RC,) are touched as by fingertips: there, rest is no likelier.

        The deviation about rest is wide for all cells within reach of a fingertip. With the narrow
        one, a large lead, or long wires, would seem more likely than several weak touches beside a
        hard one, because fewer cells have to leave rest.
        """
        near = self.fingertips(log_ohm, shape)
        if not near.any():
            return self
        return replace(self, std=np.where(near, np.maximum(self.std, UNTOUCHED_STD), self.std))

    def normal(
        self, log_ohm: Float, cells: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[Float, Float]:
        """Mean and variance of the normal that has this prior's slope at these cells' logs.

        log_ohm: of these cells (k,); cells: their numbers; by default all.

        A normal of mean m and variance V has the slope 2 (x - m) / V of -2 log p. With m `expected`
        and the distance D = x - m, the tail's slope is 2 / D: so V is D^2 there, and `std`^2 near
        rest.
        """
        expected = self.expected[cells]
        distance = log_ohm - expected
        return expected, np.maximum(self.std[cells] ** 2, distance * distance)


def rest_level(current_siemens: Float, ref_ohm: float) -> float:
    """Conductance of untouched cells, all alike, from port currents per Vdd (R, C) [S].

    A port of R x C equal cells g, without wires, has (R + C - 1) / (R C g) ohm. Touches make every
    port conduct more, and most of all the ports of touched cells. So the median port is taken.
    """
    rows, columns = current_siemens.shape
    current = float(np.median(current_siemens))
    port_ohm = max(1.0 / max(current, 1e-9) - ref_ohm, 1.0)  # finite, whatever is read
    level = (rows + columns - 1) / (rows * columns * port_ohm)
    return float(min(level, HIGHEST_TOUCH_SIEMENS))


def likeness(rise_log: Float, before: Float) -> float:
    """How alike the touches of two frames are: 1 if one is the other, harder or softer; else less.

    It is the cosine of the angle between both rises; 0 if there is no touch.

    rise_log, before: how far their cells conduct more than at rest, (RC,) [log S].
    """
    one, other = np.maximum(rise_log, 0.0), np.maximum(before, 0.0)
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-9))


class UpperLimits(NamedTuple):
    """How large the means of both layers and of the lead may be.

    reach: how far above each mean its upper limit is: of layers in shares of it, of the lead in
        ohms, (3,).
    stds: what of this is stated as one deviation, (3,).
    """

    reach: Float
    stds: Float


def siemens_std(
    log_siemens: Float,
    own_std: Float,
    by_means: Float,
    means_std: Float,
    upper: UpperLimits,
    series_ohm: Float,
) -> tuple[Float, Float]:
    """Standard deviations of conductances, upwards and downwards [S], both (RC,).

    log_siemens: logs of the conductances, (RC,) [log S].
    own_std: deviation of the log conductance without what comes from the means, (RC,).
    by_means: how much it follows the means of both layers and the mean lead, up or down, (RC, 3).
    means_std: deviations of the means that the fit took, (3,).
    upper: of the means.
    series_ohm: leads and wires to the cell, and references, (RC,) [ohm].

    The error of the port current I = 1 / (r + series) is normal, and that of g = 1 / r is not. So
    the limits of `REACH_STDS` deviations are found for I, and carried over to g. The deviation is
    the distance to the limit, divided by so many.

    Upwards, what comes from the means is added for itself, as a variance: at their upper limits,
    wires and leads take resistance from the cells. The limits are far away where nobody has told
    the wires. But from no cell can they take more than all. So for each mean, the cell that loses
    most to it is looked at: what this cell can lose bounds what the others lose. A cell conducts at
    most as much as the hardest touch.
    """
    siemens = np.exp(log_siemens)
    cell_ohm = 1.0 / siemens
    whole_ohm = cell_ohm + series_ohm
    # d log I = - r / (r + series) d log r. So at the limits the current is (1 +- off) I, and the
    # whole resistance is (r + series) / (1 +- off). The cell's is this less `series_ohm`.
    reach_per_std = REACH_STDS * cell_ohm / whole_ohm
    square = by_means * by_means
    log_std = np.sqrt(own_std * own_std + square @ means_std**2)
    off_up, off_down = reach_per_std * own_std, np.minimum(reach_per_std * log_std, 1.0 - 1e-6)
    own_ohm = whole_ohm * off_up / (1.0 + off_up)
    lowest_siemens = (1.0 - off_down) / (cell_ohm + off_down * series_ohm)
    highest, stated = np.sqrt(np.array([upper.reach, upper.stds]) ** 2 @ square.T)
    # The share of all that a cell can lose that each mean takes, per rise. The cell that loses most
    # to a mean bounds it; of the three such cells, each bounds what all means take as well.
    share, lost = highest, by_means / (MOST_LOST_SHARE + REACH_STDS * own_std)[:, None]
    if (lost.max(axis=0) * upper.reach).max() > 3**-0.5:  # else all three take less than all
        bounds, most = lost.argmax(axis=0), 1.0 / np.maximum(lost, 1e-12)
        reach = np.minimum(upper.reach, most[bounds, range(3)])
        together = (by_means[:, None] * most[bounds]).max(axis=2).min(axis=1)
        share = np.minimum(np.sqrt(square @ reach**2), together)
    # As how many deviations the limits count.
    count = np.maximum(highest / np.maximum(stated, 1e-30), REACH_STDS)

    def rise_siemens(less_ohm: Float) -> Float:
        return 1.0 / np.maximum(cell_ohm - less_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS) - siemens

    up_own, up_means = rise_siemens(own_ohm) / REACH_STDS, rise_siemens(cell_ohm * share) / count
    # A cell may conduct nearly as much as the hardest touch, or more. Then the distance to the
    # limit is too small, or below 0. So no less than the deviation to first order is stated.
    up = np.maximum(siemens * log_std, np.hypot(up_own, up_means))
    return np.asarray(up), np.asarray((siemens - lowest_siemens) / REACH_STDS)
