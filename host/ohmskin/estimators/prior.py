# SPDX-License-Identifier: Apache-2.0
"""What is expected of a skin's resistances before a frame is read: cells here, wires in `wires`.

RC readings do not determine 3RC resistances; these numbers are what decides the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.circuit import Float

# A cell whose rest readings are not known is expected around 1 MOhm. Deviations are of the log.
REST_OHM: Final = 1e6
UNKNOWN_REST_STD: Final = 1.0
REST_STD: Final = 0.05  # drift since the rest readings
TAIL: Final = 1.0  # exponent of the density of touched cells

UNKNOWN_WIRE_OHM: Final = 150.0
UNKNOWN_LAYER_STD: Final = 1.5
LAYER_STD: Final = 0.3  # what all segments of a layer share: stretch, temperature
SEGMENT_STD: Final = 0.1  # what each has of its own

HIGHEST_TOUCH_SIEMENS: Final = 1 / 300.0  # the hardest touch
# A cell that the prior holds at rest may be touched all the same, where readings say little of it.
TOUCHED: Final = 0.1  # log: further from rest, a cell's force is unknown
UNLIMITED_STD: Final = 3.0  # what is not known of it
HIDDEN: Final = 0.3  # log: a rise that must not go unnoticed
DOUBT: Final = 2.0  # evidence of such a rise, in its deviation, that is followed up


@dataclass(frozen=True, eq=False)
class CellPrior:
    """Log resistance of the cells: normal near rest, heavy-tailed further away.

    With d the distance from `expected` over `std`, -2 log p is d^2 up to d^2 = `tail`, and goes on
    with the same slope as tail (1 + log(d^2 / tail)): the density falls as d^-tail. Cells at rest
    are a quadratic problem, which costs no iterations; being touched is unlikely, but how hard,
    once a cell is, costs little. expected, std: (RC,) [log ohm]. tail: inf for a normal.
    """

    expected: Float
    std: Float
    tail: float

    def cost(self, log_ohm: Float) -> float:
        """-2 log p, up to a constant."""
        square = ((log_ohm - self.expected) / self.std) ** 2
        if self.tail == np.inf:
            return float(square.sum())
        beyond = np.maximum(square / self.tail, 1.0)
        return float((np.minimum(square, self.tail) + self.tail * np.log(beyond)).sum())

    def variance(self, log_ohm: Float, cells: NDArray[np.intp] | slice = slice(None)) -> Float:
        """Of the normal that has this prior's slope there: std^2, or beyond d^2 = tail more."""
        away = log_ohm - self.expected[cells]
        return np.asarray(np.maximum(self.std[cells] ** 2, away * away / self.tail))


def siemens_std(
    log_siemens: Float, log_std: Float, series_ohm: Float | float
) -> tuple[Float, Float]:
    """Standard deviations of conductances, upwards and downwards [S]: quarters of four deviations.

    log_std: of the log conductance, to first order. series_ohm: wires and references in series with
    each cell. Errors are normal in the current u = 1 / (r + series), not in g = 1 / r: upwards,
    behind much series resistance, a cell may be anything up to the most a touch makes of it.
    """
    siemens = np.exp(log_siemens)
    cell_ohm = 1.0 / siemens
    loop_ohm = cell_ohm + series_ohm
    far = 4.0 * log_std * cell_ohm / loop_ohm
    lowest_ohm = loop_ohm / (1.0 + far) - series_ohm
    highest_ohm = loop_ohm / np.maximum(1.0 - far, 1e-6) - series_ohm
    highest = 1.0 / np.maximum(lowest_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS)
    up = np.maximum(siemens * log_std, 0.25 * (highest - siemens))
    return np.asarray(up), np.asarray(0.25 * (siemens - 1.0 / highest_ohm))
