# SPDX-License-Identifier: Apache-2.0
"""When, within a scan, each reading is taken: readings come one a slot, cells column by column."""

from __future__ import annotations

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.link.messages import Hello

# From a hold to the change of pins, and half the microsecond that `settle_us` is rounded down by.
SELECT_S: Final = 8e-6


def slot_s(board: Hello) -> float:
    """Time from one reading to the next [s]; to 1 us where the board fills the rest with nothing.

    A settle time that was asked for is kept and the scan's rest is idle; otherwise the readings
    fill the scan, but for very slow ones.
    """
    readings = board.rows * board.columns * board.readings_per_cell
    settled_s = 1e-6 * board.settle_us + SELECT_S
    filled_s = 1.0 / (board.rate_hz * readings)
    if board.settle_asked_us == 0 and filled_s < 1.2 * settled_s:
        return filled_s
    return min(settled_s, filled_s)


def reading_offsets_s(board: Hello) -> Float:
    """Time of each reading since the first of its scan [s], shape (rows, columns, readings)."""
    shape = (board.columns, board.rows, board.readings_per_cell)
    order = np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
    return np.asarray(slot_s(board) * order.transpose(1, 0, 2))
