# SPDX-License-Identifier: Apache-2.0
"""What whole frames show more of every current than frames of fewer readings.

Symbols, beside those of `port_currents`

======= ======== =============================================================== =========
symbol  shape    meaning                                                         unit
======= ======== =============================================================== =========
h       (R, C)   1 - R_s I: what the sense nodes of a port differ by             Vdd
x       (R, C)   current of a whole frame, less the mean of those of the frames  S
                 of fewer readings before and after it, over h
d       (R, C)   half of what these two differ by, over h                        S
e                excess: what x has in common in all cells                       S
w                one over the variance of the median of x                        1/S^2
======= ======== =============================================================== =========

In a whole frame the converter goes from the node of the row to that of the column and back. Its
sample capacitor brings a part of the voltage between both along, and has little time to lose it. So
each reading is moved towards the other node, by about the same share of h: all four show too much
current, and agree. In mode quick the converter stays at one node, and in mode half it has more
time. Rest is read by whole frames, and what matters is how currents differ from rest. So currents
of fewer readings are given the same excess, I + e h.

A whole frame between two others shows it by the median of x, if the skin stays. Where the skin
changes, these two differ, and cells differ by unlike amounts. Then the frame counts for little:

    e = sum w median(x) / (sum w + 1 / s_e^2) ,
    1 / w = pi / 2 (median |x - median(x)| / 0.6745)^2 / cells + (median |d|)^2 ,

with s_e the deviation of e before any such frame (`EXCESS_STD_RATIO`), and the first square at
least that of the deviation of rounding. Each frame takes a share of 1 / BOARD_FRAMES off both sums.
Only cells with h above 1/2 count, and only frames with enough of them, whose median is within
`_MOST_EXCESS_STDS` s_e.
"""

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_mirror import BOARD_FRAMES, FEW_CELLS

# Deviation of e before any frame has shown it, as a reading [V/Vdd]. Chosen: a code of 10 bits, as
# firmware/sim has it with its preset `desk`.
EXCESS_STD_RATIO: Final = 0.001
# A frame that shows more is left out, in deviations s_e. Chosen: it has another cause, a touch.
_MOST_EXCESS_STDS: Final = 3.0
# Cells with less h do not count. Chosen: they are touched, and most of them change.
_LEAST_APART: Final = 0.5
# Deviation of a normal distribution over the median of what it is off by.
_STD_OVER_MEDIAN: Final = 1.0 / 0.6745


class Excess:
    """Compares each whole frame with the frames of fewer readings before and after it."""

    def __init__(self, knowledge: SkinKnowledge) -> None:
        self._ref_ohm = knowledge.ref_ohm
        self._known = (0.5 * knowledge.ref_ohm / EXCESS_STD_RATIO) ** 2  # 1 / s_e^2
        self._least_var = knowledge.current_std**2
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        self._before: Float | None = None
        self._whole: Float | None = None
        self._kinds: tuple[int, ...] = ()
        self._product = self._weight = 0.0

    def keep(self, current: Float) -> None:
        """Currents of a whole frame (R, C) [S]. Of several in a row, none counts."""
        if self._whole is not None:
            self._before = None
        self._whole = current

    def added(self, current: Float, kinds: tuple[int, ...]) -> Float:
        """Currents (R, C) [S] of a frame of these readings (n,) of each cell, with e h.

        What was not read is NaN, and then the frame shows nothing of e.
        """
        if kinds != self._kinds:
            self.reset()
            self._kinds = kinds
        if self._before is not None and self._whole is not None:
            self._learn(self._before, self._whole, current)
        self._before, self._whole = current, None
        excess = self._product / (self._weight + self._known)
        return np.asarray(current + excess * (1.0 - self._ref_ohm * current))

    def _learn(self, before: Float, whole: Float, after: Float) -> None:
        """From a whole frame, and those around it, (R, C) each."""
        apart = 1.0 - self._ref_ohm * whole
        counts = (apart > _LEAST_APART) & ~np.isnan(before + after)
        if counts.sum() < FEW_CELLS:
            return
        more = ((whole - 0.5 * (before + after)) / apart)[counts]
        change = float(np.median(np.abs(0.5 * (after - before) / apart)[counts]))
        middle = float(np.median(more))
        if abs(middle) * self._known**0.5 > _MOST_EXCESS_STDS:
            return
        spread = _STD_OVER_MEDIAN * float(np.median(np.abs(more - middle)))
        var = 0.5 * np.pi * max(spread**2, self._least_var) / more.size + change**2
        kept = 1.0 - 1.0 / BOARD_FRAMES
        self._product = kept * self._product + middle / var
        self._weight = kept * self._weight + 1.0 / var
