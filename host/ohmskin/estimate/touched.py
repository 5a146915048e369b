# SPDX-License-Identifier: Apache-2.0
"""Which cells were touched while the rest of a skin was measured, and how that is said."""

from typing import Final

import numpy as np

from ohmskin.arrays import Bool
from ohmskin.estimate.base import TOUCH_SIEMENS
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator

# The method that judges a rest. Chosen: it shows no ghosts.
_METHOD: Final = "joint"
# At least this share of the cells is taken to be untouched at rest. Chosen: so three touched cells
# of four are found.
UNTOUCHED_SHARE: Final = 0.25
# A cell that conducts more than untouched ones by this factor at rest is touched. Chosen: untouched
# cells scatter by tens of percent, and a touch of 100 kOhm is a factor of eleven.
TOUCHED_TIMES: Final = 8.0
# An error names so many touched cells, and counts the others. Chosen: so many fit into a line.
_NAMED_CELLS: Final = 4


def touched_at_rest(knowledge: SkinKnowledge) -> Bool:
    """Which cells (R, C) seem to have been touched while the rest was measured.

    There is no earlier rest to compare with. So these are cells that conduct far more than most
    others: g > `TOUCHED_TIMES` max(quantile of g, 0.5e-6 S), a limit that wires and the scatter of
    cells do not reach.
    """
    at_rest = make_estimator(_METHOD, knowledge).rest()
    assert at_rest is not None  # the readings are known
    siemens = at_rest.cell_siemens
    untouched = float(np.quantile(siemens, UNTOUCHED_SHARE, method="lower"))
    return np.asarray(siemens > TOUCHED_TIMES * max(untouched, TOUCH_SIEMENS))


def touched_cells(touched: Bool) -> str:
    """Which cells are touched, in words."""
    cells = [f"({row}, {column})" for row, column in np.argwhere(touched)]
    more = len(cells) - _NAMED_CELLS
    text = ", ".join(cells[:_NAMED_CELLS]) + (f" and {more} more" if more > 0 else "")
    return f"cell {text} is touched" if len(cells) == 1 else f"cells {text} are touched"
