# SPDX-License-Identifier: Apache-2.0
"""A calibration from presses: what all ways of ``ohmskin calibrate`` have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ohmskin.arrays import Float
from ohmskin.calibrate.alignment import Alignment, align
from ohmskin.calibrate.force_log import ForceLog
from ohmskin.calibrate.press_table import PressTable
from ohmskin.calibrate.presses import LevelHistory, Presses, find_presses
from ohmskin.estimate.base import NO_WIRES, Estimator, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import VOLTAGE, make_estimator
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.regression import ForceRegression
from ohmskin.link.messages import Hello, Scan


@dataclass(frozen=True, eq=False)
class Bench:
    """What a calibration is made with: the board, the untouched skin, the tool, the method.

    rest_ratio (R, C, 4). indenter_area_m2: of the tool's contact. nominal_wire_ohm: of one wire
    segment of each layer. date: ISO 8601.
    """

    board: Hello
    rest_ratio: Float
    method: str
    indenter_area_m2: float
    date: str
    nominal_wire_ohm: WireOhm = NO_WIRES

    def estimator(self) -> Estimator:
        """An estimator that is told all this."""
        known = SkinKnowledge.of(self.board, self.rest_ratio, self.nominal_wire_ohm)
        return make_estimator(self.method, known)

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
        pressed = np.flatnonzero(presses.counts)
        if pressed.size == 1 and presses.counts.size > 1:
            row, column = divmod(int(pressed[0]), presses.shape[1])
            raise ValueError(
                f"all presses are on cell ({row}, {column}): press at least one more, which tells "
                "how much cells differ"
            )
        calibration = Calibration(
            unit_id=self.board.unit_id,
            date=self.date,
            method=self.method,
            rest=Rest(self.date, self.rest_ratio, np.maximum(self.estimator().rest_level(), 0.0)),
            model=found.model_,
            indenter_area_m2=self.indenter_area_m2,
            nominal_wire_ohm=self.nominal_wire_ohm,
        )
        return calibration, found.message_


def measure(
    bench: Bench, scans: list[Scan], progress: Callable[[int], None] = lambda done: None
) -> LevelHistory:
    """Levels above rest of all scans, in order. Raises ValueError for scans of another size."""
    expected = bench.rest_ratio.shape[:2]
    for scan in scans:
        if scan.codes.shape[:2] != expected:
            raise ValueError(
                f"scan {scan.number} is {scan.rows}x{scan.columns}, the untouched skin was "
                f"{expected[0]}x{expected[1]}"
            )
    estimator, history = bench.estimator(), LevelHistory.empty(scans)
    rest = estimator.rest_level()
    for index, scan in enumerate(scans):
        found = estimator.estimate(scan.ratio)
        history.rise[index] = found.level - rest
        history.rise_std[index] = found.level_std
        history.touched[index] = found.touched
        progress(index + 1)
    return history


def presses_from_log(history: LevelHistory, log: ForceLog) -> tuple[Presses, Alignment]:
    """The presses of a history, the force sensor's clock aligned with the skin's.

    Raises ValueError as `align` and `find_presses`.
    """
    rise = np.where(history.touched, history.rise, 0.0).sum(axis=(1, 2))
    alignment = align(history.time_s, rise, log)
    return find_presses(history, log, alignment.offset_s), alignment


def presses_from_table(bench: Bench, table: PressTable) -> Presses:
    """The presses of a table, each row one, above the bench's rest.

    Raises ValueError, naming the row, for a cell that is not on the skin.
    """
    if bench.method == VOLTAGE:
        raise ValueError(f"a table has conductances, which '{VOLTAGE}' knows nothing of")
    rows, columns = bench.rest_ratio.shape[:2]
    outside = (table.row >= rows) | (table.column >= columns)
    if outside.any():
        at = int(np.argmax(outside))
        raise ValueError(
            f"row {at + 2}: cell ({table.row[at]}, {table.column[at]}) is not on this "
            f"{rows}x{columns} skin, whose first is (0, 0)"
        )
    cells = table.row * columns + table.column
    return Presses(
        cells=cells,
        rise=table.conductance - bench.estimator().rest_level().flat[cells],
        rise_std=table.conductance_std,
        force_n=table.force_n,
        press=np.arange(cells.size),
        shape=(rows, columns),
    )
