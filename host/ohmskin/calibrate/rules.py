# SPDX-License-Identifier: Apache-2.0
"""What presses must be, so that curves can be learned from them: one set of rules for all.

=============================================================== ==================================
rule                                                            checked by
=============================================================== ==================================
scans are complete                                              `check_complete`
a cell is on the skin                                           `check_cell`
a force pushes: 0 N or more                                     `require_forces`
no number is beyond `MAX_NUMBER`                                each reader of files
there are `MIN_PRESSES` at least, with different forces         `check_enough`
they are on two cells at least, if the skin has more than one   `check_cells_differ`
=============================================================== ==================================

Whoever asks somebody for presses checks them before, so that nobody presses cells for an hour in
vain. Whoever learns from presses checks them again.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.link.messages import Hello

# A cell with fewer presses has no curve of its own. A curve has 2 coefficients, and 4 presses would
# leave 2 degrees of freedom, for which Student's t has no finite variance.
MIN_PRESSES: Final = 5


def check_complete(board: Hello) -> None:
    """Raise ValueError if scans of this board do not have all readings of all cells."""
    if not board.is_complete:
        region = "" if board.is_whole else f" --rows {board.rows} --columns {board.columns}"
        mode = board.mode if board.mode in ("near", "far") else "near"
        raise ValueError(
            "a skin is calibrated in mode near or far, all of it, and this board is in mode "
            f"{board.mode}{', of a region' if region else ''}: "
            f"'ohmskin configure PORT --mode {mode}{region} --save'"
        )


def check_cell(row: int, column: int, shape: tuple[int, int]) -> tuple[int, int]:
    """The cell. Raises ValueError if it is not on a skin of this shape."""
    if row >= shape[0] or column >= shape[1]:
        skin = f"{shape[0]}x{shape[1]} skin, whose first is (0, 0)"
        raise ValueError(f"cell ({row}, {column}) is not on this {skin}")
    return row, column


def require_forces(force_n: Float, rows: NDArray[np.int64] | None = None) -> None:
    """Raise ValueError, as `require_rows`, if a force (n,) [N] pulls."""
    must = "0 or more: zero the force sensor, or leave the row out"
    require_rows("force_n", force_n, force_n >= 0, must, rows)


def check_enough(presses: int, force_n: ArrayLike) -> None:
    """Raise ValueError if so many presses, of these forces (n,) [N], tell no curve at all."""
    forces_n = np.asarray(force_n)
    if presses < MIN_PRESSES:
        raise ValueError(f"too few presses: {presses}, {MIN_PRESSES} are needed")
    if np.ptp(forces_n) == 0:
        forces = f"all {forces_n.size} forces are {forces_n[0]:g} N"
        raise ValueError(f"{forces}: press with different forces")


def check_cells_differ(cells: set[tuple[int, int]], shape: tuple[int, int]) -> None:
    """Raise ValueError if the only cell that is pressed is not the only one of the skin."""
    if len(cells) == 1 and shape != (1, 1):
        remedy = "press at least one more, which tells how much cells differ"
        raise ValueError(f"all presses are on cell {min(cells)}: {remedy}")


def require_rows(
    name: str, values: NDArray[Any], good: Bool, must: str, rows: NDArray[np.int64] | None = None
) -> None:
    """Raise ValueError, naming the first row that is not good and its value. Arrays (n,).

    must: what the value has to be. rows: by which number each row is named; None: its index.
    """
    if not good.all():
        at = int(np.argmin(good))
        row = at if rows is None else rows[at]
        raise ValueError(f"row {row}: {name} is {values[at]:.12g}, it must be {must}")
