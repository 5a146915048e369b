# SPDX-License-Identifier: Apache-2.0
"""What whole frames of near ends show of the board, beside the skin: offsets, a bow, noise.

Symbols, beside those of `port_currents`

======= ========== ============================================================== =========
symbol  shape      meaning                                                        unit
======= ========== ============================================================== =========
e       (2, R, C)  what the two readings of a node are off by, their mean         V/Vdd
o       (2,)       offset of each node                                            V/Vdd
c       (R, C)     what floating lines draw from a port, as residuals show it     V/Vdd
kappa              what of it is in the difference of both e                      1
q       (R, C)     share of it that the row gives, less that of the column        1
m       (R, C)     what all four readings have in common                          V/Vdd
phi     (R, C)     mean of 4 y_k (1 - y_k) over the readings                      1
beta               bow of the converter, in the middle of its scale               V/Vdd
v                  variance of the noise of a reading                             V^2/Vdd^2
======= ========== ============================================================== =========

The two readings of a node, A and D of the row's, B and C of the column's, are mirror images: one is
x, the other 1 - x. The current of the skin moves them by as much in opposite directions, so it is
not in e. Lines that charge are: A and C are read first after the multiplexers have moved, and B and
D a slot later. What lines draw is drawn from the row and from the column in the shares (1 + q) / 2
and (1 - q) / 2 (`port_currents`), and so is what that slot changes of it. c shows how much lines
charge at each cell. Over all cells, by least squares,

    e_row - e_column = o_row - o_column + kappa c ,

and what is left when lines and the nodes' difference are taken away is

    m = (e_row + e_column) / 2 - q (e_row - e_column - o_row + o_column) / 2
      = (o_row + o_column) / 2 + beta phi + noise .

What moves x and 1 - x alike is a function of (2 x - 1)^2, and the first term of it beside an offset
is a bow: it is beta where x is 1/2, and 0 at both ends of the scale. Four readings of a cell cancel
it; one does not. It belongs to the converter, so all frames tell the same beta,

    beta = sum w m (phi - mean phi) / (sum w (phi - mean phi)^2 + v / BOW_STD_RATIO^2) ,

but it is at most _MOST_BOW_STDS BOW_STD_RATIO, either way. Other causes make m depend on phi, too.
So that they are forgotten, each frame takes a share off both sums over the frames before,

    i / (1 + i) / BOARD_FRAMES ,  i = BOW_STD_RATIO^2 / v sum w (phi - mean phi)^2 of this frame.

A frame with i far below 1 shows hardly anything of beta, as one of an untouched skin: it takes
hardly anything off.

m has the variance v / w of noise, w = 4 / (1 + q^2). So v is, over usual cells of several frames,

    v = sum w (m - beta phi - its median)^2 / (cells - h) ,

with h what is fitted to each frame: 1 for its median, and its share in the sum that beta divides
by. A skin with a single cell has no other to compare it with. There v is by how the residuals
change from frame to frame, and in the first frame by what is left of them without both offsets.
The offsets are o = (their mean) +- (their difference) / 2, of variances v / sum w and v / cells.
(A median has up to pi / 2 of the former. Where that is much, cells are few, and it has less.)
"""

from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_currents import MOST_OFFSET_RATIO, NearReadings, row_share
from ohmskin.estimate.port_noise import MEDIAN_CHI2, USUAL_STDS

# Deviation of beta before any frame [V/Vdd]. Chosen: a code of 10 bits. The ATmega328P's data sheet
# gives 0.5 LSB as typical, at an ADC clock of 200 kHz, and nothing for faster ones.
BOW_STD_RATIO: Final = 0.001
# Largest bow that is believed, in deviations. Chosen: a larger one has another cause.
_MOST_BOW_STDS: Final = 3.0
# Frames taken whose noise is averaged, and after which a bow that they show has mostly replaced the
# one before. Chosen: v is then known to some percent, and a bow to a tenth of an LSB of 10 bits.
BOARD_FRAMES: Final = 30
# With fewer cells, all are usual. Chosen: so few hardly show which of them has a cause of its own.
FEW_CELLS: Final = 16
# Sign of the difference of both offsets in that of each reading.
APART_SIGN: Final = np.array([1.0, -1.0, -1.0, 1.0])


def bow_shape(ratio: Float) -> Float:
    """phi of readings."""
    return 4.0 * ratio * (1.0 - ratio)


class BoardShown(NamedTuple):
    """What the whole frames that were taken have shown of the board so far.

    offset_ratio: of the node of each reading, where phi is 0 (4,) [V/Vdd].
    bow_ratio: beta [V/Vdd].
    noise: v; 0: not known.
    offset_share: variances of the offsets' mean and of their difference, over v.
    """

    offset_ratio: Float
    bow_ratio: float = 0.0
    noise: float = 0.0
    offset_share: tuple[float, float] = (0.0, 0.0)


class MirrorReadings:
    """Takes whole frames of a skin in mode near, one after the other."""

    def __init__(self, knowledge: SkinKnowledge) -> None:
        self._rounding, self._ref_ohm = knowledge.ratio_std**2, knowledge.ref_ohm
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        self._misfit, self._degrees, self._frames = 0.0, 0.0, 0
        self._product = self._square = 0.0
        self._residual: Float | None = None

    def take(self, near: NearReadings, *, is_live: bool) -> BoardShown:
        """One more frame, and what all that were taken have shown with it.

        is_live: False for readings at rest, which may be a mean that has no noise.
        """
        residual = near.residual + near.offset_ratio
        row, column = 0.5 * (residual[..., 0] + residual[..., 3]), 0.5 * residual[..., 1:3].sum(-1)
        apart, charge = row - column, near.residual @ np.array([-1.0, -1.0, 1.0, 1.0])
        # What is off by more is a fault.
        sound = (np.abs(near.residual) < MOST_OFFSET_RATIO).all(axis=2)
        if not sound.any():
            return BoardShown(near.offset_ratio, self._bow_ratio, self._noise)
        by_charge = charge - charge[sound].mean()
        kappa = float((apart * by_charge)[sound].sum())
        kappa /= max(float((by_charge[sound] ** 2).sum()), 1e-30)
        nodes_apart = float((apart - kappa * charge)[sound].mean())
        share = row_share(near.current, self._ref_ohm)
        common = 0.5 * (row + column - share * (apart - nodes_apart))
        weight = 4.0 / (1.0 + share**2)
        shape = bow_shape(near.ratio).mean(axis=2)
        bow_share = self._learn_bow(shape[sound], common[sound], weight[sound])
        flat = common - self._bow_ratio * shape
        middle = float(np.median(flat[sound]))
        if is_live and sound.size > 1:
            self._learn_noise((weight * (flat - middle) ** 2)[sound], 1.0 + bow_share)
        elif is_live:
            self._learn_noise_of_one(near.residual, residual)
        offset = middle + 0.5 * nodes_apart * APART_SIGN
        offset = np.clip(offset, -MOST_OFFSET_RATIO, MOST_OFFSET_RATIO)
        shares = 1.0 / float(weight[sound].sum()), 1.0 / int(sound.sum())
        return BoardShown(offset, self._bow_ratio, self._noise, shares)

    @property
    def _noise(self) -> float:
        """v, or 0."""
        return self._misfit / self._degrees if self._degrees else 0.0

    @property
    def _bow_ratio(self) -> float:
        """beta [V/Vdd]."""
        bow = self._product / (self._square + self._unknown_bow)
        return min(max(bow, -_MOST_BOW_STDS * BOW_STD_RATIO), _MOST_BOW_STDS * BOW_STD_RATIO)

    @property
    def _unknown_bow(self) -> float:
        """v / BOW_STD_RATIO^2."""
        return max(self._noise, 2.0 * self._rounding) / BOW_STD_RATIO**2

    def _learn_bow(self, shape: Float, common: Float, weight: Float) -> float:
        """From phi, m and w of k cells. Returns the share of beta that this frame decides."""
        away = shape - np.average(shape, weights=weight)
        square = float(np.sum(weight * away**2))
        kept = 1.0 - square / (square + self._unknown_bow) / BOARD_FRAMES
        self._product = kept * self._product + float(np.sum(weight * common * away))
        self._square = kept * self._square + square
        return square / (self._square + self._unknown_bow)

    def _learn_noise(self, square: Float, fitted: float) -> None:
        """From w (m - beta phi - its median)^2 of k cells; fitted: h."""
        level = max(self._rounding, float(np.median(square)) / MEDIAN_CHI2[1])
        if square.size >= FEW_CELLS:
            square = square[square <= USUAL_STDS**2 * level]
        if square.size > fitted:
            self._average(float(square.sum()), square.size - fitted)

    def _learn_noise_of_one(self, residual: Float, with_offset: Float) -> None:
        """From the residuals of a single cell (1, 1, 4), without offsets and with them."""
        if self._residual is None:
            self._average(float(np.sum(residual**2)), 1.0)
        else:
            self._average(0.5 * float(np.sum((with_offset - self._residual) ** 2)), 3.0)
        self._residual = with_offset

    def _average(self, misfit: float, degrees: float) -> None:
        """One more frame counts to v."""
        self._frames = min(self._frames + 1, BOARD_FRAMES)
        self._misfit += (misfit - self._misfit) / self._frames
        self._degrees += (degrees - self._degrees) / self._frames
