# SPDX-License-Identifier: Apache-2.0
"""What whole frames of near ends show of the board, beside the skin: offsets and noise.

Symbols, beside those of `port_currents`

======= ========== ============================================================== =========
symbol  shape      meaning                                                        unit
======= ========== ============================================================== =========
e       (2, R, C)  what the two readings of a node are off by, their mean         V/Vdd
o       (2,)       offset of each node                                            V/Vdd
c       (R, C)     what floating lines draw from a port, as residuals show it     V/Vdd
kappa              what of it is in the difference of both e                      1
m       (R, C)     what all four readings have in common                          V/Vdd
v                  variance of the noise of a reading                             V^2/Vdd^2
======= ========== ============================================================== =========

The two readings of a node, A and D of the row's, B and C of the column's, are mirror images: one is
x, the other 1 - x. The current of the skin moves them by as much in opposite directions, so it is
not in e. Lines that charge are: A and C are read first after the multiplexers have moved, and B and
D a slot later. c shows how much lines charge at each cell. Over all cells, by least squares,

    e_row - e_column = o_row - o_column + kappa c .

The mean of both e has little of this. So it is

    m = (e_row + e_column) / 2 = (o_row + o_column) / 2 + noise ,

of variance v / 4, and v is, over usual cells of several frames,

    v = sum 4 (m - its median)^2 / (cells - 1) .

A skin with a single cell has no other to compare it with. There v is by how the residuals change
from frame to frame, and in the first frame by what is left of them without both offsets. The
offsets are o = (their mean) +- (their difference) / 2, of variances v / (4 cells) and v / cells.
(A median has up to pi / 2 of the former. Where that is much, cells are few, and it has less.)
"""

from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_currents import MOST_OFFSET_RATIO, NearReadings
from ohmskin.estimate.port_noise import MEDIAN_CHI2, USUAL_STDS

# Frames taken whose noise is averaged. Chosen: v is then known to some percent.
BOARD_FRAMES: Final = 30
# With fewer cells, all are usual. Chosen: so few hardly show which of them has a cause of its own.
FEW_CELLS: Final = 16
# Sign of the difference of both offsets in that of each reading.
APART_SIGN: Final = np.array([1.0, -1.0, -1.0, 1.0])


class BoardShown(NamedTuple):
    """What the whole frames that were taken have shown of the board so far.

    offset_ratio: of the node of each reading (4,) [V/Vdd].
    noise: v; 0: not known.
    offset_share: variances of the offsets' mean and of their difference, over v.
    """

    offset_ratio: Float
    noise: float = 0.0
    offset_share: tuple[float, float] = (0.0, 0.0)


class MirrorReadings:
    """Takes whole frames of a skin in mode near, one after the other."""

    def __init__(self, knowledge: SkinKnowledge) -> None:
        self._rounding = knowledge.ratio_std**2
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        self._misfit, self._degrees, self._frames = 0.0, 0.0, 0
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
            return BoardShown(near.offset_ratio, self._noise)
        by_charge = charge - charge[sound].mean()
        kappa = float((apart * by_charge)[sound].sum())
        kappa /= max(float((by_charge[sound] ** 2).sum()), 1e-30)
        nodes_apart = float((apart - kappa * charge)[sound].mean())
        common = 0.5 * (row + column)[sound]
        middle = float(np.median(common))
        if is_live and sound.size > 1:
            self._learn_noise(4.0 * (common - middle) ** 2)
        elif is_live:
            self._learn_noise_of_one(near.residual, residual)
        offset = middle + 0.5 * nodes_apart * APART_SIGN
        offset = np.clip(offset, -MOST_OFFSET_RATIO, MOST_OFFSET_RATIO)
        return BoardShown(offset, self._noise, (0.25 / common.size, 1.0 / common.size))

    @property
    def _noise(self) -> float:
        """v, or 0."""
        return self._misfit / self._degrees if self._degrees else 0.0

    def _learn_noise(self, square: Float) -> None:
        """From 4 (m - its median)^2 of k cells."""
        level = max(self._rounding, float(np.median(square)) / MEDIAN_CHI2[1])
        if square.size >= FEW_CELLS:
            square = square[square <= USUAL_STDS**2 * level]
        if square.size > 1:
            self._average(float(square.sum()), square.size - 1.0)

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
