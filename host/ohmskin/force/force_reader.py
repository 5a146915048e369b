# SPDX-License-Identifier: Apache-2.0
"""From scan to force: readings, levels of the cells, newtons, contacts."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate, SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.contacts import Contact, ContactTracker
from ohmskin.link.messages import Hello, Scan


@dataclass(frozen=True, eq=False)
class ForceScan(Scan):
    """A scan, and the forces that it shows.

    force_n, force_n_std: normal force of each cell and its standard deviation, (R, C) [N]; NaN
    where `ForceModel.predict` has none. contacts: touched cells that adjoin. estimate: what the
    forces are from, with ``message`` where the readings cannot be trusted.
    """

    force_n: Float
    force_n_std: Float
    contacts: tuple[Contact, ...]
    estimate: Estimate


class ForceReader:
    """Reads the forces of scan after scan: the same scans in the same order, the same forces.

    Raises ValueError where the board scans other cells than were calibrated.
    """

    def __init__(self, board: Hello, calibration: Calibration) -> None:
        self._board = board
        self._tracker = ContactTracker()
        self.use(calibration)

    def use(self, calibration: Calibration) -> None:
        """Go on with another tare. Raises ValueError as the constructor."""
        calibration.check(calibration.unit_id, self._board.rows, self._board.columns)
        self.calibration = calibration
        knowledge = self._knowledge(calibration.untouched.ratio)
        self._estimator = make_estimator(calibration.method, knowledge)

    def tared(self, rest_ratio: Float, date: str) -> Calibration:
        """The calibration with these readings of the untouched skin (R, C, 4) as its tare."""
        rest = Rest.of(self.calibration.method, self._knowledge(rest_ratio), date)
        return replace(self.calibration, tare=rest)

    def _knowledge(self, rest_ratio: Float) -> SkinKnowledge:
        return SkinKnowledge.of(
            self._board,
            rest_ratio,
            self.calibration.nominal_wire_ohm,
        )

    def measure(self, ratio: Float) -> Estimate:
        """What readings (R, C, 4) show, without forces."""
        return self._estimator.estimate(ratio)

    def read(self, scan: Scan) -> ForceScan:
        """The forces of a scan. Raises ValueError if it is of other cells."""
        estimate = self.measure(scan.ratio)
        force_n, force_n_std = self.calibration.predict(estimate.level, estimate.level_std)
        touched = estimate.touched
        return ForceScan(
            scan.codes,
            scan.number,
            scan.time_us,
            scan.host_time_s,
            scan.missed,
            force_n=force_n,
            force_n_std=force_n_std,
            contacts=self._tracker.update(scan.time_us, touched, force_n, force_n_std),
            estimate=estimate,
        )
