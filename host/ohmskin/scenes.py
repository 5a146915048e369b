# SPDX-License-Identifier: Apache-2.0
"""Skins that do not exist, and what touches them: simulation, for demos and tests.

A scene is a skin whose cells at rest and wires are drawn from a seed, and touches that are a
function of time alone, so that a scene can be asked twice and answers the same.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from ohmskin.circuit import Float, Skin, readings

REST_OHM: Final = 1.0e6
TOP_WIRE_OHM: Final = 100.0
BOTTOM_WIRE_OHM: Final = 200.0
_SPREAD: Final = 0.1  # relative, of rest resistances and wires

SCENES: Final = {
    "rest": "nothing touches the skin",
    "single": "one touch in the middle",
    "ghost": "three corners of a rectangle: without an estimator the fourth seems touched too",
    "multi": "five touches at places drawn from the seed",
    "moving": "one fingertip on a closed curve over the whole skin, once in 4 s",
}
_MOVING_PERIOD_S: Final = 4.0
_FINGER_CELLS: Final = 0.7  # radius of the fingertip's pressure
_FINGER_SIEMENS: Final = 2e-4


class Scene:
    """A scene by name (see `SCENES`) on a rows x columns skin.

    Conductance of a cell: g(t) = 1 / r_rest + touch(t) [S], both (rows, columns).

    :raises ValueError: no such scene, or a skin too small for it.
    """

    def __init__(
        self,
        name: str = "rest",
        rows: int = 8,
        columns: int = 8,
        *,
        seed: int = 0,
        ref_top_ohm: float = 30_000.0,
        ref_bottom_ohm: float = 30_000.0,
    ) -> None:
        if name not in SCENES:
            raise ValueError(f"no scene '{name}': there are {', '.join(SCENES)}")
        if name == "ghost" and min(rows, columns) < 2:
            raise ValueError("the scene 'ghost' needs a skin of at least 2x2")
        self.name = name
        self.rows = rows
        self.columns = columns
        random = np.random.default_rng(seed)

        def spread(middle: float) -> Float:
            return middle * np.exp(_SPREAD * random.standard_normal((rows, columns)))

        self._rest = Skin(
            cell_siemens=1 / spread(REST_OHM),
            top_wire_ohm=spread(TOP_WIRE_OHM),
            bottom_wire_ohm=spread(BOTTOM_WIRE_OHM),
            ref_top_ohm=ref_top_ohm,
            ref_bottom_ohm=ref_bottom_ohm,
        )
        self._touches = self._place(random)
        self._still_ratio = lru_cache(maxsize=1)(lambda: readings(self.skin(0.0)))

    @property
    def moves(self) -> bool:
        """Whether the touches change with time."""
        return self.name == "moving"

    @property
    def rest_ratio(self) -> Float:
        """Exact readings of the untouched skin, shape (rows, columns, 4)."""
        return readings(self._rest)

    def skin(self, time_s: float) -> Skin:
        """The truth: every resistance at a time."""
        touch = self._finger(time_s) if self.moves else self._touches
        return replace(self._rest, cell_siemens=self._rest.cell_siemens + touch)

    def touched(self, time_s: float) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
        """Cells whose conductance a touch raises by 1 microsiemens or more, (rows, columns)."""
        cells: np.ndarray[tuple[int, int], np.dtype[np.bool_]] = (
            self.skin(time_s).cell_siemens - self._rest.cell_siemens >= 1e-6
        )
        return cells

    def ratio(self, time_s: float) -> Float:
        """Exact readings at a time, shape (rows, columns, 4)."""
        return readings(self.skin(time_s)) if self.moves else self._still_ratio()

    def _place(self, random: np.random.Generator) -> Float:
        touches = np.zeros((self.rows, self.columns))
        if self.name == "single":
            touches[self.rows // 2, self.columns // 2] = 1 / 5e3
        elif self.name == "ghost":
            (top, bottom), (left, right) = _two_of(self.rows), _two_of(self.columns)
            # Light touches: heavy ones leave a trace at the fourth corner wherever a method
            # neglects the wires.
            touches[top, left] = 1 / 30e3
            touches[top, right] = 1 / 40e3
            touches[bottom, left] = 1 / 35e3
        elif self.name == "multi":
            count = min(5, touches.size)
            cells = random.choice(touches.size, count, replace=False)
            touches.flat[cells] = 1 / np.exp(random.uniform(np.log(2e3), np.log(5e4), count))
        return touches

    def _finger(self, time_s: float) -> Float:
        angle = 2 * np.pi * time_s / _MOVING_PERIOD_S
        row = (self.rows - 1) * (0.5 + 0.4 * np.sin(angle))
        column = (self.columns - 1) * (0.5 + 0.4 * np.sin(2 * angle))
        away = (np.arange(self.rows)[:, None] - row) ** 2 + (np.arange(self.columns) - column) ** 2
        touch: Float = _FINGER_SIEMENS * np.exp(-away / (2 * _FINGER_CELLS**2))
        return touch


def _two_of(count: int) -> tuple[int, int]:
    """Two lines well apart, a quarter in from the edges where there is room."""
    return count // 4, count - 1 - count // 4
