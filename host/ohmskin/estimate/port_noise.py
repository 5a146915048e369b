# SPDX-License-Identifier: Apache-2.0
"""How noisy readings are, by how far the readings of a cell disagree, and by what changes.

Symbols; variances are of one reading, in V^2/Vdd^2

======== ========= ==============================================================
symbol   shape     meaning
======== ========= ==============================================================
n                  readings of a cell at near ends: 4, or 2 in mode far
s^2                variance of rounding to a code, from the converter's bits
v_cell   (R, C)    variance of a cell's residuals
v                  that of the usual cell
v_n                variance of noise: of what changes from frame to frame
v_I      (R, C)    what counts as error of a current
R_k      (n,)      reference resistor that reading k senses [ohm]
s_I      (R, C)    standard deviation of a port's current per Vdd [S]
======== ========= ==============================================================

**From residuals.** n readings of a cell show one current, so n - 1 of the residuals are free. The
offsets of the board are fitted, too, one for two readings: n / 2 of them, shared by all RC cells,

    v_cell = sum_k residual_k^2 / (n - 1 - n / (2 RC)) .

**Noise, and what stays.** Residuals have three causes: noise; lines that charge; a converter that
is not linear. Noise changes from frame to frame, the other two stay while nothing moves. The
difference of the residuals of two frames has twice the variance of noise, and nothing of what
stays. Where v_n, so measured, is much less than v, most of a disagreement stays. What stays is
taken from the current for the most part (`port_currents`). A share of it counts as error:

    v_I = v_n + STAYING_SHARE^2 max(0, v_cell - v_n) .

Otherwise, all of a disagreement counts as noise: v_I = max(v_cell, v).

**The current.** Without noise, the four readings of a cell round alike, because D is 1 - A and C is
1 - B. Then they agree, and their mean is no better than one of them. Noise makes them disagree, and
round independently as soon as it has the variance of rounding: v = 2 s^2. Between both,

    s_I^2 = v_I / sum R_k^2 + max(0, s^2 - v / 2) (sum R_k / sum R_k^2)^2 .

This is exact at both ends; between them, s_I is 1.0 to 1.2 times too large. (The code has
`Variances.noise` in place of v. They differ only where v_n is used for noise. There both are above
2 s^2, and the last term is 0.)
"""

from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge

# Median of chi-square, by its degrees of freedom: from tables of the distribution.
MEDIAN_CHI2: Final = {1: 0.455, 3: 2.366}
# A cell is usual if its readings disagree by less than so many standard deviations, of the median
# cell or of rounding. Chosen: noise hardly ever exceeds it; what does has a cause of its own.
USUAL_STDS: Final = 3.0
# If the variance of noise is less than this share of the usual cell's variance, most of a
# disagreement stays. Chosen: then noise has half of the deviation, and what stays is larger.
NOISE_SHARE: Final = 0.25
# Share of a staying disagreement that is still in the current after what floating lines draw is
# taken from it. Measured in firmware/sim with its preset `desk`, as `make bench-desk` does.
STAYING_SHARE: Final = 0.12


class Spread(NamedTuple):
    """How far the readings of the cells of one frame disagree.

    rms: root of the mean square of a cell's residuals, over n - 1 (R, C) [V/Vdd].
    median_rms: that of the median cell [V/Vdd].
    by_cell: v_cell (R, C).
    usual: v, the mean over all usual cells.
    """

    rms: Float
    median_rms: float
    by_cell: Float
    usual: float


class Variances(NamedTuple):
    """Variances of a reading, from one frame and the one before it.

    noise: v_n, or v where v_n is not known, or not much less than v.
    error: v_I, what counts as error of a current (R, C).
    """

    noise: float
    error: Float


class ReadingNoise:
    """Measures the noise of readings, frame after frame."""

    def __init__(self, knowledge: SkinKnowledge, per_cell: int, square_ohm: float) -> None:
        """per_cell: n. square_ohm: sum_k R_k^2 [ohm^2]."""
        self._degrees = per_cell - 1
        cells = knowledge.rows * knowledge.columns
        # What v_cell divides by. A single cell in mode far has nothing left but its offset: 0.
        # Chosen: half a degree, so that nothing is divided by 0.
        self._mean_degrees = max(self._degrees - per_cell / (2.0 * cells), 0.5)
        self._ratio_std, self._rounding = knowledge.ratio_std, knowledge.ratio_std**2
        # v where readings round independently: rounding, and as much noise.
        self._independent = 2.0 * self._rounding
        self._square_ohm, self._alike_std = square_ohm, knowledge.current_std
        self._staying_share = np.full((knowledge.rows, knowledge.columns), STAYING_SHARE)
        if per_cell == 2:
            # Mode far reads a and e of all ports in one pass, and b and f in the next. Before the
            # first pass the board waits for the scan to begin, and meanwhile the lines settle at
            # the first port. Before the second pass they have no time to. So the charging lines
            # move b of the first port, but not its a, and nothing cancels in its current: all of
            # its disagreement counts.
            self._staying_share[0, 0] = 1.0
        self.reset()

    def reset(self) -> None:
        """Forget the frame before."""
        self._residual: Float | None = None

    def keep(self, residual: Float) -> None:
        """The next frame's residuals will be compared with these (R, C, n)."""
        self._residual = residual

    def spread(self, residual: Float) -> Spread:
        """How far readings of these residuals (R, C, n) disagree."""
        square = np.einsum("ijk,ijk->ij", residual, residual)
        median = _median(square)
        by_cell = square / self._mean_degrees
        # The limit goes by the median cell, because one cell that is far off does not move it. The
        # median cell itself is always within the limit, so there is always a usual cell.
        level = max(self._rounding, median / MEDIAN_CHI2[self._degrees])
        usual = by_cell[by_cell <= USUAL_STDS**2 * level]
        return Spread(
            rms=np.sqrt(square / self._degrees),
            median_rms=(median / self._degrees) ** 0.5,
            by_cell=by_cell,
            usual=float(usual.sum()) / usual.size,  # faster than mean
        )

    def shows_nothing_staying(self, spread: Spread) -> bool:
        """Whether v is so small that nothing can be recognised as staying, whatever v_n is.

        `variances` takes v_n for 2 s^2 at least, and something stays only where v_n is less than
        `NOISE_SHARE` of v. So nothing can where v is up to 2 s^2 / `NOISE_SHARE`.
        """
        return self._independent >= NOISE_SHARE * spread.usual

    def of_change(self, residual: Float) -> float:
        """v_n by the change of the residuals since the frame before; inf if there is none."""
        if self._residual is None:
            return np.inf
        change = residual - self._residual
        square = np.einsum("ijk,ijk->ij", change, change)
        return _median(square) / (2.0 * MEDIAN_CHI2[self._degrees])

    def of_mean(self, ratio: Float) -> float:
        """v_n of readings (R, C, n) at rest: 0 in a mean of many scans, inf (unknown) in one scan.

        Readings of one scan are codes; a mean of many lies between codes.
        """
        code = ratio / (self._ratio_std * 12**0.5) - 0.5  # a step of width w has variance w^2 / 12
        return 0.0 if np.abs(code - np.rint(code)).max() > 0.01 else np.inf

    def variances(self, spread: Spread, v_n: float) -> Variances:
        """Noise, and what counts as error. v_n: as measured; inf where it is not known."""
        # Codes that do not change are no proof of readings without error: they are rounded.
        noise = max(v_n, self._independent)
        if noise < NOISE_SHARE * spread.usual:
            staying = np.maximum(spread.by_cell - noise, 0.0)
            return Variances(noise, noise + self._staying_share**2 * staying)
        return Variances(spread.usual, np.maximum(spread.by_cell, spread.usual))

    def current_std(self, variances: Variances) -> Float:
        """s_I (R, C) [S]."""
        alike = max(0.0, 1.0 - variances.noise / self._independent)
        return np.sqrt(variances.error / self._square_ohm + alike * self._alike_std**2)

    def between_ends(self, variances: Variances) -> Float:
        """Variance of the difference between both ends of a line in mode far, (R, C) [V^2/Vdd^2].

        Noise of both ends adds up. What stays moves both near readings of a cell by the same d. So
        their two residuals are d, and with one degree of freedom v_cell has 2 d^2 of it. Of that,
        `error` - `noise` is the share that counts (`STAYING_SHARE`; all of it at port (0, 0)). The
        far reading may be moved by d as well, but not the potential of the near end, which
        `port_currents` takes from the current. So the difference has d once: half of that share.
        It has at least the rounding of two readings.
        """
        staying = np.maximum(variances.error - variances.noise, 0.0)
        return np.maximum(2.0 * variances.noise + 0.5 * staying, 2.0 * self._rounding)

    def offset_std(self, spread: Spread, offset_ratio: float) -> float:
        """Standard deviation of the offset that far ends may have against near ends [V/Vdd].

        What near ends a and b have in common, `offset_ratio`, may be an offset of all readings,
        which far ends have as well, or be of lines that charge, which far ends have not. This
        covers both. v is added because this offset is the median of the cells. A single cell
        disagrees with it by its own, and its far ends may do so as well.
        """
        return float((spread.usual + offset_ratio * offset_ratio) ** 0.5)


def _median(square: Float) -> float:
    """The median cell; of an even number, the upper one of the two: faster than np.median."""
    middle = square.size // 2
    return float(np.partition(square, middle, axis=None)[middle])
