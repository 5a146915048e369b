# SPDX-License-Identifier: Apache-2.0
"""What is expected of a skin's resistances before a frame is read: cells here, wires in `wires`.

RC readings do not determine 3RC resistances; these numbers are what decides the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float

# Deviations are of the log. Untouched cells are around 1 MOhm, before they are read.
UNTOUCHED_OHM: Final = 1e6
UNTOUCHED_STD: Final = 1.0
UNKNOWN_REST_STD: Final = 0.3  # of a cell whose rest readings are not known, about all cells' level
REST_QUANTILE: Final = 0.2  # of the ports, taken for untouched ones where rest is not known
REST_STD: Final = 0.05  # drift since the rest readings
TAIL: Final = 1.0  # exponent of the density of touched cells

UNKNOWN_WIRE_OHM: Final = 150.0
UNKNOWN_LAYER_STD: Final = 1.5
LAYER_STD: Final = 0.25  # what all segments of a layer share: stretch, temperature
SEGMENT_STD: Final = 0.1  # what each has of its own

HIGHEST_TOUCH_SIEMENS: Final = 1 / 300.0  # the hardest touch
HARDEST_LOG_OHM: Final = float(np.log(300.0))
WALL_STD: Final = 0.3  # log: how far beyond it a cell may be
# A cell that the prior holds at rest may be touched all the same, where readings say little of it.
TOUCHED: Final = 2.0  # deviations of the prior: further from rest, a cell's force is unknown
UNLIMITED_STD: Final = 3.0  # what is not known of it
HIDDEN: Final = 0.3  # log: a rise that must not go unnoticed
DOUBT: Final = 2.0  # evidence of such a rise, in its deviation, that is followed up


@dataclass(frozen=True, eq=False)
class CellPrior:
    """Log resistance of the cells: normal near rest, heavy-tailed further away.

    With d the distance from `expected` over `std`, -2 log p is d^2 up to d^2 = `tail`, and goes on
    with the same slope as tail (1 + log(d^2 / tail)): the density falls as d^-tail. Cells at rest
    are a quadratic problem, which costs no iterations; being touched is unlikely, but how hard,
    once a cell is, costs little, up to the hardest touch; beyond, it costs.
    expected, std: (RC,) [log ohm]. tail: inf for a normal.
    """

    expected: Float
    std: Float
    tail: float

    def rise(self, log_ohm: Float) -> Float:
        """How far a cell conducts more than at rest, in deviations."""
        return (self.expected - log_ohm) / self.std

    def cost(self, log_ohm: Float) -> float:
        """-2 log p, up to a constant."""
        square = ((log_ohm - self.expected) / self.std) ** 2
        if self.tail == np.inf:
            return float(square.sum())
        beyond = np.maximum(square / self.tail, 1.0)
        wall = np.maximum(HARDEST_LOG_OHM - log_ohm, 0.0) / WALL_STD
        near_and_tail = np.minimum(square, self.tail) + self.tail * np.log(beyond)
        return float((near_and_tail + wall * wall).sum())

    def normal(
        self, log_ohm: Float, cells: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[Float, Float]:
        """Mean and variance of the normal that has this prior's slope there."""
        expected = self.expected[cells]
        away = log_ohm - expected
        variance = np.maximum(self.std[cells] ** 2, away * away / self.tail)
        if self.tail < np.inf and (log_ohm < HARDEST_LOG_OHM).any():
            precision = 1.0 / variance
            wall = np.where(log_ohm < HARDEST_LOG_OHM, WALL_STD**-2, 0.0)
            variance = 1.0 / (precision + wall)
            expected = (precision * expected + wall * HARDEST_LOG_OHM) * variance
        return expected, variance


def rest_level(current_siemens: Float, ref_ohm: float) -> float:
    """Conductance of untouched cells, all alike, from port currents per Vdd (R, C) [S].

    A port of R x C equal cells g, without wires, is (R + C - 1) / (R C g). Touches make every port
    conduct more, so this goes by ports that conduct little.
    """
    rows, columns = current_siemens.shape
    current = float(np.quantile(current_siemens, REST_QUANTILE))
    port_ohm = max(1.0 / max(current, 1e-12) - ref_ohm, 1.0)
    level = (rows + columns - 1) / (rows * columns * port_ohm)
    return float(np.clip(level, 0.01 / UNTOUCHED_OHM, 100 / UNTOUCHED_OHM))


def siemens_std(
    log_siemens: Float, log_std: Float, path_ohm: Float, wire_std: Float, ref_ohm: float
) -> tuple[Float, Float]:
    """Standard deviations of conductances, upwards and downwards [S]: quarters of four deviations.

    log_std: of the log conductance, to first order. path_ohm, wire_std: wires between each cell and
    its electrodes, and the deviation of their log. ref_ohm: both references. All (RC,).
    Errors are normal in the current u = 1 / (r + series), not in g = 1 / r, and the wires' in their
    log: upwards, behind much series resistance, a cell may be anything that a touch makes of it.
    """
    siemens = np.exp(log_siemens)
    cell_ohm = 1.0 / siemens
    by_wires = np.minimum(path_ohm * wire_std * siemens, log_std)
    wider = np.expm1(4.0 * wire_std) / (4.0 * wire_std)
    up_std = np.sqrt(log_std**2 + (wider**2 - 1.0) * by_wires**2)
    series_ohm = path_ohm + ref_ohm
    loop_ohm = cell_ohm + series_ohm
    share = cell_ohm / loop_ohm
    lowest_ohm = loop_ohm / (1.0 + 4.0 * up_std * share) - series_ohm
    highest_ohm = loop_ohm / np.maximum(1.0 - 4.0 * log_std * share, 1e-6) - series_ohm
    highest = 1.0 / np.maximum(lowest_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS)
    up = np.maximum(siemens * log_std, 0.25 * (highest - siemens))
    return np.asarray(up), np.asarray(0.25 * (siemens - 1.0 / highest_ohm))
