# SPDX-License-Identifier: Apache-2.0
"""Simulated skins, and what touches them, for demos and tests.

A scene is a skin, whose wires and cells at rest are drawn from a seed, and touches that depend on
time alone. So a scene always gives the same answer for the same time. It begins untouched, so that
who tares first tares the skin at rest.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.faults import SkinFaults

# Medians of an untouched cell and of the wire segments of rows and of columns [ohm], in the range
# of a knitted skin. Single ones are spread log-normally, by this share.
REST_OHM: Final = 1.0e6
TOP_WIRE_OHM: Final = 100.0
BOTTOM_WIRE_OHM: Final = 200.0
_SPREAD: Final = 0.1
# A cell counts as touched where a touch adds as much as a cell at rest has [S].
_TOUCHED_SIEMENS: Final = 1e-6

SCENES: Final = {
    "rest": "nothing touches the skin",
    "single": "after 3 s (begin=0: at once, as in every scene), one touch in the middle",
    "ghost": "after 3 s, three corners of a rectangle: raw readings show a fourth",
    "multi": "after 3 s, five touches, at places drawn from the seed",
    "corners": "after 8 s, three corners of a rectangle; every 1.5 s one of them moves across",
    "moving": "after 3 s, one fingertip on a closed curve over the whole skin, once in 4 s",
}
# When touches begin, and those of the scene "corners" [s]: the doctor has examined rest by then,
# behind a bootloader too.
BEGIN_S: Final = 3.0
_CORNERS_BEGIN_S: Final = 8.0
# The scene "moving": its period, the radius and the peak of the finger's pressure.
_MOVING_PERIOD_S: Final = 4.0
_FINGER_CELLS: Final = 0.7
_FINGER_SIEMENS: Final = 2e-4
# The scene "corners": its step, and resistances that tremble as fingers do, by a share, at rates.
_CORNERS_HELD_S: Final = 1.5
_CORNER_OHM: Final = (5e3, 8e3, 6e3)
_TREMBLE: Final = 0.05
_TREMBLE_HZ: Final = (3.1, 4.7, 6.1)


class Scene:
    """A scene by name (see `SCENES`) on a rows x columns skin.

    Conductance of a cell: g(t) = 1 / r_rest + touch(t) [S], both (rows, columns). faults: what is
    wrong with the skin; an `EmulatedBoard` adds those that depend on the instant of a reading.
    plate: conductances (R, C) of resistors on wires of no resistance [S], in place of the untouched
    skin. begin_s: when touches begin [s]; None: as `SCENES` says. `moves`: whether touches change
    after that.

    :raises ValueError: no such scene or time, or a skin too small for the scene or the faults.
    """

    def __init__(
        self,
        name: str = "rest",
        rows: int = 8,
        columns: int = 8,
        *,
        seed: int = 0,
        faults: SkinFaults | None = None,
        plate: Float | None = None,
        begin_s: float | None = None,
    ) -> None:
        if name not in SCENES:
            raise ValueError(f"no scene '{name}': there are {', '.join(SCENES)}")
        if name in ("ghost", "corners") and min(rows, columns) < 2:
            raise ValueError(f"the scene '{name}' needs a skin of at least 2x2")
        self.name = name
        self.rows = rows
        self.columns = columns
        self.moves = name in ("corners", "moving")
        known_s = {"rest": float("inf"), "corners": _CORNERS_BEGIN_S}.get(name, BEGIN_S)
        self.begin_s = known_s if begin_s is None else begin_s
        if not self.begin_s >= 0:
            raise ValueError(f"begin must be 0 s or later, not {begin_s}")
        self.faults = faults or SkinFaults()
        self.faults.check(rows, columns)
        random = np.random.default_rng(seed)

        def spread(middle: float) -> Float:
            return middle * np.exp(_SPREAD * random.standard_normal((rows, columns)))

        self._rest = Skin(1 / spread(REST_OHM), spread(TOP_WIRE_OHM), spread(BOTTOM_WIRE_OHM))
        if plate is not None:
            if plate.shape != (rows, columns):
                size = "x".join(map(str, plate.shape))
                raise ValueError(f"the plate has {size} cells, the skin {rows}x{columns}")
            self._rest = Skin(plate, np.zeros_like(plate), np.zeros_like(plate))
        self._touches = self._place(random)
        self._still_ratio = lru_cache(
            lambda at_s, mode: self.faults.readings(self.skin(at_s), mode)
        )

    @property
    def rest_ratio(self) -> Float:
        """Exact readings of the untouched skin, shape (rows, columns, 4)."""
        return self.faults.readings(self.faults.damaged(self._rest))

    def skin(self, time_s: float) -> Skin:
        """Every resistance of the skin at a time."""
        if time_s < self.begin_s:
            touch = np.zeros_like(self._touches)
        elif self.name == "corners":
            touch = self._corners(time_s)
        else:
            touch = self._finger(time_s) if self.moves else self._touches
        touched = replace(self._rest, cell_siemens=self._rest.cell_siemens + touch)
        return self.faults.damaged(touched)

    def touched(self, time_s: float) -> NDArray[np.bool_]:
        """Cells whose conductance a touch raises by 1 uS or more, shape (rows, columns)."""
        rest_siemens = self.faults.damaged(self._rest).cell_siemens
        return np.asarray(self.skin(time_s).cell_siemens - rest_siemens >= _TOUCHED_SIEMENS)

    def ratio(self, time_s: float, mode: str = "near") -> Float:
        """Exact readings of a mode at a time, shape (rows, columns, 4)."""
        if self.moves and time_s >= self.begin_s:
            return self.faults.readings(self.skin(time_s), mode)
        return self._still_ratio(self.begin_s if time_s >= self.begin_s else -1.0, mode)

    def _place(self, random: np.random.Generator) -> Float:
        touches = np.zeros((self.rows, self.columns))
        if self.name == "single":
            touches[self.rows // 2, self.columns // 2] = 1 / 5e3
        elif self.name == "ghost":
            (top, bottom), (left, right) = _two_of(self.rows), _two_of(self.columns)
            # The touches are light: with heavy ones, methods that neglect the wires show a trace at
            # the fourth corner.
            touches[[top, top, bottom], [left, right, left]] = 1 / np.array([30e3, 40e3, 35e3])
        elif self.name == "multi":
            count = min(5, touches.size)
            cells = random.choice(touches.size, count, replace=False)
            touches.flat[cells] = 1 / np.exp(random.uniform(np.log(2e3), np.log(5e4), count))
        return touches

    def _corners(self, time_s: float) -> Float:
        touches = np.zeros((self.rows, self.columns))
        (top, bottom), (left, right) = _two_of(self.rows), _two_of(self.columns)
        across = int((time_s - self.begin_s) / _CORNERS_HELD_S) % 2
        alone = (bottom, right) if across else (top, left)
        cells = (alone, (top, right), (bottom, left))
        for cell, ohm, hz in zip(cells, _CORNER_OHM, _TREMBLE_HZ, strict=True):
            touches[cell] = (1 + _TREMBLE * np.sin(2 * np.pi * hz * time_s)) / ohm
        return touches

    def _finger(self, time_s: float) -> Float:
        angle = 2 * np.pi * (time_s - self.begin_s) / _MOVING_PERIOD_S
        row = (self.rows - 1) * (0.5 + 0.4 * np.sin(angle))
        column = (self.columns - 1) * (0.5 + 0.4 * np.sin(2 * angle))
        away = (np.arange(self.rows)[:, None] - row) ** 2 + (np.arange(self.columns) - column) ** 2
        return np.asarray(_FINGER_SIEMENS * np.exp(-away / (2 * _FINGER_CELLS**2)))


def _two_of(count: int) -> tuple[int, int]:
    """Two lines well apart, a quarter in from the edges where there is room."""
    return count // 4, count - 1 - count // 4
