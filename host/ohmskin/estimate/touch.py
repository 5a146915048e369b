# SPDX-License-Identifier: Apache-2.0
"""`touch`: only the cells that the frame shows to be touched, and no more model than that.

`joint` with the cells at rest and the wires taken out of the fit and into the noise: the answer of
`touched`, where it is enough. It is not where the touches contradict the readings, where a fifth of
the skin is touched, where wires hide how hard, or where a touch may hide: such frames are for
`joint`.
Without rest readings no cell is known to be untouched, so every frame is.
"""

from __future__ import annotations

from typing import ClassVar, Final

from ohmskin.estimate.joint import JointEstimator
from ohmskin.estimate.touched import Touched

MOST_TOUCHED: Final = 0.2  # share of the cells
WIDEST_LOG_STD: Final = 0.3  # of a touched cell: beyond it the circuit is far from linear


class TouchEstimator(JointEstimator):
    """The simplest model that explains a frame. Cells at rest are reported as at rest."""

    name: ClassVar[str] = "touch"

    def _is_enough(self, found: Touched) -> bool:
        few = found.cells.size <= MOST_TOUCHED * found.current.size
        known = found.log_std.max(initial=0.0) <= WIDEST_LOG_STD
        return few and known and not (found.doubtful or found.contradicted)
