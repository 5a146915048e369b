# SPDX-License-Identifier: Apache-2.0
"""What a person sees who presses cells while they are recorded, and so what is missing."""

from __future__ import annotations

from typing import Final

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ohmskin.arrays import Float
from ohmskin.calibrate.guide import OnSkin, pressed_cells
from ohmskin.estimate.base import Estimator, SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.messages import Hello, Scan

# Looks at so many scans alone, whatever their rate: an estimate takes time, the recording goes on.
_LOOK_EVERY_S: Final = 0.1
# Fast on every skin, whatever method the calibration is for.
_METHOD: Final = "joint"


class PressWatch:
    """Counts presses of single cells that last for `guide.CERTAIN_S`, as far as one sees live.

    rest_s: nothing touches the skin for so long at first. counts: presses of each cell (R, C).
    """

    def __init__(self, board: Hello, rest_s: float) -> None:
        self.counts = np.zeros((board.rows, board.columns), dtype=np.intp)
        self._board = board
        self._rest_s = rest_s
        self._untouched: list[Float] = []
        self._estimator: Estimator | None = None
        self._on = OnSkin()
        self._first_s = self._looked_s = float("-inf")
        self._elapsed_s = 0.0
        self._scans = 0
        self._force_n: float | None = None

    def see(self, scan: Scan, force_n: float | None) -> bool:
        """One scan, and the newest force if there is one [N]; returns whether it was looked at.

        Raises ValueError for a scan of another size.
        """
        if not self._scans:
            self._first_s = scan.host_time_s
        self._scans += 1
        self._force_n = self._force_n if force_n is None else force_n
        self._elapsed_s = scan.host_time_s - self._first_s
        if self._elapsed_s <= self._rest_s:
            self._untouched.append(scan.ratio)
        if scan.host_time_s - self._looked_s < _LOOK_EVERY_S:
            return False
        self._looked_s = scan.host_time_s
        if self._elapsed_s > self._rest_s:
            self._look(scan)
        return True

    def _look(self, scan: Scan) -> None:
        if self._estimator is None:
            rest_ratio = np.asarray(np.mean(self._untouched, axis=0))
            known = SkinKnowledge.of(self._board, rest_ratio)
            self._estimator = make_estimator(_METHOD, known)
            self._untouched.clear()
        found = self._estimator.estimate(scan.ratio)
        pressed = pressed_cells(found.level - self._estimator.rest_level(), found.touched)
        if self._on.see(scan.host_time_s, pressed) and len(self._on.cells) == 1:
            self.counts[self._on.cells[0]] += 1

    def table(self) -> Group:
        """All of it, for a terminal."""
        resting = self._elapsed_s <= self._rest_s
        pressed = ", ".join(map(str, self._on.cells)) or "none"
        force = "?" if self._force_n is None else f"{self._force_n:.2f}"
        head = (
            f"{self._elapsed_s:.0f} s   {self._scans} scans   force {force} N   "
            f"{'touch nothing yet' if resting else f'pressed: {pressed}'}"
        )
        table = Table(box=None, title="presses of each cell")
        table.add_column("", justify="right", style="dim")
        for column in range(self.counts.shape[1]):
            table.add_column(str(column), justify="right")
        for row, counts in enumerate(self.counts):
            cells = (
                Text(str(count), style="reverse" if (row, column) in self._on.cells else "")
                for column, count in enumerate(counts)
            )
            table.add_row(str(row), *cells)
        return Group(Text(head), table)
