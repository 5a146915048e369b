# SPDX-License-Identifier: Apache-2.0
"""Methods `ohm` and `voltage`: a port's resistance is taken for that of its cell.

This neglects all other paths through the skin, and all wires.

Symbols: I (R, C) port current per Vdd [S], g (R, C) cells [S], R_s = R_top + R_bottom [ohm], both
reference resistors in series.

    g = 1 / (1/I - R_s) = I / (1 - I R_s) ,    std(g) = (dg/dI) std(I) = (1 + g R_s)^2 std(I)

This is the paper's naive estimate. It sees ghosts: three pressed corners of a rectangle make the
fourth look pressed. `voltage` is the paper's baseline for forces: it reads a force from the mean
voltage over the reference resistors. In all else it is `ohm`.
"""

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READING_OFFSET, READING_SIGN
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.port_readings import PortReadings


def conductance_from_current(current_siemens: Float, ref_ohm: float) -> Float:
    """g = I / (1 - I R_s) [S], (R, C). I is first clipped to what cells in their bounds draw."""
    least, most = port_current(MIN_CELL_SIEMENS, ref_ohm), port_current(MAX_CELL_SIEMENS, ref_ohm)
    current = np.clip(current_siemens, least, most)
    return np.clip(current / (1.0 - current * ref_ohm), MIN_CELL_SIEMENS, MAX_CELL_SIEMENS)


def port_current(cell_siemens: float, ref_ohm: float) -> float:
    """I = g / (1 + g R_s) per Vdd [S]: the current through one cell and both references."""
    return cell_siemens / (1.0 + cell_siemens * ref_ohm)


class OhmEstimator(Estimator):
    """Each cell by Ohm's law.

    A port may read more current than a short of its cell allows. Then the cell has the bound of
    1 S, and the large standard deviation that belongs there.
    """

    name = "ohm"

    def _solve(self, ports: PortReadings) -> Solution:
        ref_ohm = self.knowledge.ref_ohm
        cell = conductance_from_current(ports.current, ref_ohm)
        return Solution(
            cell_siemens=cell,
            cell_siemens_std=(1.0 + cell * ref_ohm) ** 2 * ports.current_std,
            chi2=self._chi2(ports, cell / (1.0 + cell * ref_ohm)),
        )


class VoltageEstimator(OhmEstimator):
    """As `ohm`, but `Estimate.level` is the `voltage_level` of the readings [1]."""

    name = "voltage"
    takes_partial = False

    def _level(self, ratio: Float, solution: Solution) -> tuple[Float, Float]:
        level = voltage_level(ratio)
        return level, np.full_like(level, self.knowledge.ratio_std)


def voltage_level(ratio: Float) -> Float:
    """The mean voltage over the reference resistors: (..., 4) [V/Vdd] to (...) [1].

    It is the mean over the configurations of sign (y - offset), and it grows with the cell's
    conductance. All four readings round alike, so its standard deviation is that of one reading
    (`SkinKnowledge.ratio_std`).
    """
    return np.asarray((ratio - READING_OFFSET) @ READING_SIGN / READING_SIGN.size)
