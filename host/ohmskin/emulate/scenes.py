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

# Median of the untouched cells [ohm]. Chosen: in the range of a knitted skin.
REST_OHM: Final = 1.0e6
# Median of the wire segments of rows [ohm]. Chosen: in the range of a knitted skin.
TOP_WIRE_OHM: Final = 100.0
# Median of the wire segments of columns [ohm]. Chosen: other than that of rows, so that layers that
# are confused show.
BOTTOM_WIRE_OHM: Final = 200.0
# Cells and segments scatter about their medians by this share: it is the standard deviation of
# their logarithm. Chosen: no two are alike, and a cell at rest is far from a touched one.
_SPREAD_SHARE: Final = 0.1
# Touches begin at this time [s]. Chosen: who tares before, tares the untouched skin.
BEGIN_S: Final = 3.0
# Those of the scene "corners" begin at this time [s]. Chosen: the doctor has examined the untouched
# skin by then, behind a boot loader too, and waits for presses of corners.
_CORNERS_BEGIN_S: Final = 8.0
# In the scene "corners", each rectangle is pressed for this time [s]. Chosen: long enough for
# several of the doctor's looks of 0.3 s.
_CORNERS_HELD_S: Final = 1.5
# Its three touches: resistance [ohm], and how often in a second it trembles, as a finger does [Hz].
# Chosen so that no two tremble together.
_CORNERS_OHM_HZ: Final = ((5e3, 3.1), (8e3, 4.7), (6e3, 6.1))
# Conductances of these touches tremble by this share to either side. Chosen: enough to tell the
# three apart, and no touch ends by it.
_TREMBLE_SHARE: Final = 0.05
# In the scene "moving", a finger goes round in this time [s]. Chosen: an eye can follow it.
_MOVING_PERIOD_S: Final = 4.0
# Its pressure falls off from its middle as a normal density of this standard deviation [cells].
# Chosen: it then covers some 15 cells.
_FINGER_STD_CELLS: Final = 0.7
# A cell in its middle gains this conductance [S]. Chosen: 5 kOhm is a firm touch.
_FINGER_SIEMENS: Final = 2e-4

SCENES: Final = {
    "rest": "nothing touches the skin",
    "single": f"after {BEGIN_S:g} s (begin=0: at once, as in every scene), one touch in the middle",
    "ghost": f"after {BEGIN_S:g} s, three corners of a rectangle: raw readings show a fourth",
    "multi": f"after {BEGIN_S:g} s, five touches, at places drawn from the seed",
    "corners": f"after {_CORNERS_BEGIN_S:g} s, three corners of a rectangle; every "
    f"{_CORNERS_HELD_S:g} s one of them moves across",
    "moving": f"after {BEGIN_S:g} s, one fingertip on a closed curve over the whole skin, once in "
    f"{_MOVING_PERIOD_S:g} s",
}


class Scene:
    """A scene by name (see `SCENES`) on a rows x columns skin.

    Conductance of a cell: g(t) = 1 / r_rest + touch(t) [S], both (rows, columns).

    seed: of the wires and cells at rest, and of the touches of "multi".
    faults: what is wrong with the skin; a fault that differs from reading to reading, such as hum,
    is not in `ratio`: `EmulatedBoard` adds it.
    begin_s: when touches begin [s]; None: as `SCENES` says.

    `rest` is the untouched skin, without faults: another of the same size may take its place.
    `moves`: whether touches change after they have begun.

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
        usual_s = {"rest": float("inf"), "corners": _CORNERS_BEGIN_S}.get(name, BEGIN_S)
        self.begin_s = usual_s if begin_s is None else begin_s
        if not self.begin_s >= 0:
            raise ValueError(f"begin must be 0 s or later, not {begin_s}")
        self.faults = faults or SkinFaults()
        self.faults.check(rows, columns)
        random = np.random.default_rng(seed)

        def spread(middle: float) -> Float:
            return middle * np.exp(_SPREAD_SHARE * random.standard_normal((rows, columns)))

        self.rest = Skin(1 / spread(REST_OHM), spread(TOP_WIRE_OHM), spread(BOTTOM_WIRE_OHM))
        self._touches = self._place(random)
        self._still_ratio = lru_cache(
            lambda at_s, mode: self.faults.readings(self.skin(at_s), mode)
        )

    @property
    def rest_ratio(self) -> Float:
        """Exact readings of the untouched skin, shape (rows, columns, 4)."""
        return self.faults.readings(self.faults.damaged(self.rest))

    def skin(self, time_s: float) -> Skin:
        """Every resistance of the skin at a time."""
        if time_s < self.begin_s:
            touch = np.zeros_like(self._touches)
        elif self.name == "corners":
            touch = self._corners(time_s)
        else:
            touch = self._finger(time_s) if self.moves else self._touches
        touched = replace(self.rest, cell_siemens=self.rest.cell_siemens + touch)
        return self.faults.damaged(touched)

    def touched(self, time_s: float) -> NDArray[np.bool_]:
        """Cells, (rows, columns), to which a touch adds as much as a cell has at rest, 1 uS."""
        rest_siemens = self.faults.damaged(self.rest).cell_siemens
        return np.asarray(self.skin(time_s).cell_siemens - rest_siemens >= 1 / REST_OHM)

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
            # The touches are light: with heavy ones, methods that neglect the wires show a trace at
            # the fourth corner.
            for cell, ohm in zip(self._three_corners(0), (30e3, 40e3, 35e3), strict=True):
                touches[cell] = 1 / ohm
        elif self.name == "multi":
            count = min(5, touches.size)
            cells = random.choice(touches.size, count, replace=False)
            touches.flat[cells] = 1 / np.exp(random.uniform(np.log(2e3), np.log(5e4), count))
        return touches

    def _three_corners(self, across: int) -> list[tuple[int, int]]:
        """Corners of a rectangle: of the first and the fourth, only the fourth if across is 1."""
        (top, bottom), (left, right) = _two_of(self.rows), _two_of(self.columns)
        return [(bottom, right) if across else (top, left), (top, right), (bottom, left)]

    def _corners(self, time_s: float) -> Float:
        touches = np.zeros((self.rows, self.columns))
        across = int((time_s - self.begin_s) / _CORNERS_HELD_S) % 2
        for cell, (ohm, hz) in zip(self._three_corners(across), _CORNERS_OHM_HZ, strict=True):
            touches[cell] = (1 + _TREMBLE_SHARE * np.sin(2 * np.pi * hz * time_s)) / ohm
        return touches

    def _finger(self, time_s: float) -> Float:
        angle = 2 * np.pi * (time_s - self.begin_s) / _MOVING_PERIOD_S
        row = (self.rows - 1) * (0.5 + 0.4 * np.sin(angle))
        column = (self.columns - 1) * (0.5 + 0.4 * np.sin(2 * angle))
        away = (np.arange(self.rows)[:, None] - row) ** 2 + (np.arange(self.columns) - column) ** 2
        return np.asarray(_FINGER_SIEMENS * np.exp(-away / (2 * _FINGER_STD_CELLS**2)))


def _two_of(count: int) -> tuple[int, int]:
    """Two lines well apart, a quarter in from the edges where there is room."""
    return count // 4, count - 1 - count // 4
