# SPDX-License-Identifier: Apache-2.0
"""Methods `ohm` and `voltage`: a port's resistance is that of its cell.

Neither another path through the skin nor a wire is thought of.

Symbols: I (R, C) port current per Vdd [S], R = R_top + R_bottom [ohm], g (R, C) cells [S].

    g = 1 / (1/I - R) = I / (1 - I R) ,    std(g) = (dg/dI) std(I) = (1 + g R)^2 std(I)

This is the paper's naive estimate. It sees ghosts: three pressed corners of a rectangle make the
fourth look pressed. `voltage` is the paper's baseline for forces: it reads a force from the mean
voltage over the reference resistors, and for all else it is `ohm`.
"""

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READING_OFFSET, READING_SIGN
from ohmskin.estimate.base import Estimator, Solution
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS
from ohmskin.estimate.port_faults import FAULT_STDS, cell_of
from ohmskin.estimate.port_readings import PortReadings


def conductance_from_current(current_siemens: Float, ref_ohm: float) -> Float:
    """g = I / (1 - I R) [S], I first clipped to what cells of 1e-9 S to 1 S draw."""
    least, most = port_current(MIN_CELL_SIEMENS, ref_ohm), port_current(MAX_CELL_SIEMENS, ref_ohm)
    current = np.clip(current_siemens, least, most)
    return np.clip(current / (1.0 - current * ref_ohm), MIN_CELL_SIEMENS, MAX_CELL_SIEMENS)


def port_current(cell_siemens: float, ref_ohm: float) -> float:
    """I = g / (1 + g R) per Vdd [S]: the current through one cell and both references."""
    return cell_siemens / (1.0 + cell_siemens * ref_ohm)


class OhmEstimator(Estimator):
    """rho = Rc. A port that reads shorter than its reference resistors gets the conductance bound
    of 1 S with the large standard deviation that belongs there; beyond 5 standard deviations past
    the bound the frame is not converged."""

    name = "ohm"

    def _solve(self, ports: PortReadings) -> Solution:
        ref_ohm = self.knowledge.ref_ohm
        current = ports.current
        cell = conductance_from_current(current, ref_ohm)
        allowed = port_current(MAX_CELL_SIEMENS, ref_ohm) + FAULT_STDS * self.knowledge.current_std
        excess = current - allowed
        message = ""
        if (excess > 0).any():
            message = f"{cell_of(excess.argmax(), excess)} has more current than a short allows"
        return Solution(
            cell_siemens=cell,
            cell_siemens_std=(1.0 + cell * ref_ohm) ** 2 * ports.current_std,
            chi2=self._chi2(ports, cell / (1.0 + cell * ref_ohm)),
            message=message,
        )


class VoltageEstimator(OhmEstimator):
    """`ohm`, but `Estimate.level` is `voltage_level` of the readings [1]."""

    name = "voltage"

    def _level(self, ratio: Float, found: Solution) -> tuple[Float, Float]:
        level = voltage_level(ratio)
        return level, np.full_like(level, self.knowledge.ratio_std)


def voltage_level(ratio: Float) -> Float:
    """The mean voltage over the reference resistors: (..., 4) [V/Vdd] to (...) [1].

    It is the mean over the configurations of sign (y - offset), and it grows with the cell's
    conductance. All four readings round alike, so its standard deviation is that of one reading
    (`SkinKnowledge.ratio_std`).
    """
    return np.asarray((ratio - READING_OFFSET) @ READING_SIGN / READING_SIGN.size)
