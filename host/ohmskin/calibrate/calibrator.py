# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells, in scans or in a table, to the calibration of a skin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ohmskin.calibrate.presses import LevelHistory, Presses
from ohmskin.calibrate.tables import PressTable
from ohmskin.estimate.base import Estimator, SkinKnowledge
from ohmskin.estimate.methods import VOLTAGE, make_estimator
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.regression import ForceRegression
from ohmskin.link.clock import scan_times_s
from ohmskin.link.messages import Scan


@dataclass(frozen=True, eq=False)
class Calibrator:
    """Makes the calibration of one skin.

    knowledge: of that skin, with the readings of the untouched skin and the nominal wires. method:
    what its cells are estimated by. indenter_area_m2: area that it is pressed with [m^2]. unit_id:
    the board's. date: of the calibration, ISO 8601.
    """

    knowledge: SkinKnowledge
    method: str
    indenter_area_m2: float
    unit_id: int
    date: str

    def estimator(self) -> Estimator:
        """A new estimator of this skin. Raises ValueError if there is no such method."""
        return make_estimator(self.method, self.knowledge)

    def measure(
        self, scans: list[Scan], progress: Callable[[int], None] = lambda done: None
    ) -> LevelHistory:
        """What all scans show above rest, in order. progress: is told how many are done.

        Raises ValueError for scans of another size.
        """
        estimator = self.estimator()
        rest = estimator.rest_level()
        shape = (len(scans), *rest.shape)
        history = LevelHistory(
            scan_times_s(scans), np.empty(shape), np.empty(shape), np.empty(shape, np.bool_)
        )
        for index, scan in enumerate(scans):
            if scan.codes.shape[:2] != rest.shape:
                raise ValueError(
                    f"scan {scan.number} is {scan.rows}x{scan.columns}, the untouched skin was "
                    f"{rest.shape[0]}x{rest.shape[1]}"
                )
            found = estimator.estimate(scan.ratio)
            history.rise[index] = found.level - rest
            history.rise_std[index] = found.level_std
            history.touched[index] = found.touched
            progress(index + 1)
        return history

    def presses_in_table(self, table: PressTable) -> Presses:
        """The presses of a table, each of its rows one.

        Raises ValueError, naming the row, for a cell that is not on the skin; and for the method
        `voltage`, whose levels are no conductances.
        """
        if self.method == VOLTAGE:
            raise ValueError(f"a table has conductances, which '{VOLTAGE}' knows nothing of")
        rows, columns = self.knowledge.rows, self.knowledge.columns
        outside = (table["row"] >= rows) | (table["column"] >= columns)
        if outside.any():
            at = int(np.argmax(outside))
            raise ValueError(
                f"row {at + 2}: cell ({table['row'][at]}, {table['column'][at]}) is not on this "
                f"{rows}x{columns} skin, whose first is (0, 0)"
            )
        cells = table["row"] * columns + table["column"]
        return Presses(
            cells=cells,
            rise=table["conductance"] - self.estimator().rest_level().flat[cells],
            rise_std=table["conductance_std"],
            force_n=table["force_n"],
            press=np.arange(cells.size),
            shape=(rows, columns),
        )

    def calibration(self, presses: Presses) -> tuple[Calibration, str]:
        """The calibration, and which cells have no curve of their own.

        Raises ValueError where the presses do not tell the curves: too few, all on one cell, of one
        force, or such that the force does not grow with what the skin shows.
        """
        found = ForceRegression().fit(
            presses.cells,
            presses.rise,
            presses.force_n,
            shape=presses.shape,
            rise_std=presses.rise_std,
            press=presses.press,
        )
        pressed = np.argwhere(presses.counts).tolist()
        if len(pressed) == 1 and presses.counts.size > 1:
            raise ValueError(
                f"all presses are on cell {tuple(pressed[0])}: press at least one more, which "
                "tells how much cells differ"
            )
        calibration = Calibration(
            unit_id=self.unit_id,
            date=self.date,
            method=self.method,
            rest=Rest.of(self.method, self.knowledge, self.date),
            model=found.model_,
            indenter_area_m2=self.indenter_area_m2,
            nominal_wire_ohm=self.knowledge.nominal_wire_ohm,
        )
        return calibration, found.message_
