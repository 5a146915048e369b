# SPDX-License-Identifier: Apache-2.0
"""Simulated skins, and what touches them, for demos and tests.

A scene is a skin, whose wires and cells at rest are drawn from a seed, and touches that depend on
time alone. So a scene always gives the same answer for the same time. Only in "weights", touches
depend on what `Scene.put` is told. A scene begins untouched, so that a program that tares first
tares the skin at rest.

Every scene knows the forces on its cells, by the simplest law that a calibration can learn: the
conductance that a force F adds to a cell is k F^b, where each cell has its own k. Textiles also
have creep, hysteresis, drift and noise of the contact (docs/force.md); a scene has none of these.
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
# Median of the wire segments of columns [ohm]. Chosen: another than that of rows, so that a program
# that confuses the layers is found out.
BOTTOM_WIRE_OHM: Final = 200.0
# The lead of each line, unless told [ohm]. Chosen: a multiplexer's switch has 70 typically (data
# sheet of the CD74HC4067, at 4.5 V), and a connector some.
LEAD_OHM: Final = 80.0
# Cells and segments scatter about their medians by this share: it is the standard deviation of
# their logarithm. Chosen: no two are alike, and a cell at rest is far from a touched one.
_SPREAD_SHARE: Final = 0.1
# Touches begin at this time [s]. Chosen: it leaves time for a tare of the untouched skin.
BEGIN_S: Final = 3.0
# Those of the scene "corners" begin at this time [s]. Chosen: the doctor has examined the untouched
# skin by then, behind a boot loader too, and waits for presses of corners.
_CORNERS_BEGIN_S: Final = 8.0
# In the scene "corners", each rectangle is pressed for this time [s]. Chosen: long enough for
# several of the doctor's looks of 0.3 s.
_CORNERS_HELD_S: Final = 1.5
# The three touches of "corners": resistance [ohm], and how often it trembles in a second, as a
# finger does [Hz]. Chosen: no two of them tremble together.
_CORNERS_OHM_HZ: Final = ((5e3, 3.1), (8e3, 4.7), (6e3, 6.1))
# Conductances of these touches tremble by this share to either side. Chosen: enough to tell the
# three apart, and not enough to end a touch.
_TREMBLE_SHARE: Final = 0.05
# In the scene "moving", a finger goes round in this time [s]. Chosen: an eye can follow it.
_MOVING_PERIOD_S: Final = 4.0
# Its pressure falls off from its middle as a normal density of this standard deviation [cells].
# Chosen: it then covers some 15 cells.
_FINGER_STD_CELLS: Final = 0.7
# A cell in its middle gains this conductance [S]. Chosen: 5 kOhm is a firm touch.
_FINGER_SIEMENS: Final = 2e-4

# In the scene "slip", a fingertip presses with this force [N], as one that holds a cup.
_SLIP_N: Final = 4.0
# Its force trembles so often in a second [Hz], and by this share to either side. Chosen: as when a
# thing begins to slip.
SLIP_HZ: Final = 200.0
SLIP_SHARE: Final = 0.05

# A force of 1 N adds this conductance to a usual cell [S]. Chosen: as in the model of textile
# contact that the studies use (studies/press.py).
_SIEMENS_AT_1N: Final = 30e-6
# The conductance grows with this power of the force. Chosen: as in that model.
_EXPONENT: Final = 1.7
# Cells scatter by this in what they conduct at 1 N: it is the standard deviation of its logarithm.
# Chosen: as in that model.
_GAIN_SPREAD: Final = 0.2
# The robot of the scene "presses" begins at this time [s]. Chosen: boot loader and tare are over.
_ROBOT_BEGIN_S: Final = 6.0
# It presses each cell so often. Chosen: so many give a cell a curve of its own.
ROBOT_PRESSES: Final = 5
# Least and largest peak of its presses [N]. Chosen: from a touch to a firm push of a finger.
_ROBOT_PEAK_N: Final = (0.4, 8.0)
# A press begins at the first of these times, holds from the second to the third, and is gone at
# the fourth [s]. Chosen: a scan is short against them.
_ROBOT_PRESS_S: Final = (0.0, 0.2, 0.4, 0.6)
# Least and longest pause before a press [s]. Chosen: presses at even times could not be aligned.
_ROBOT_PAUSE_S: Final = (0.15, 0.45)
# The fingertips of the scene "knead" press, all cells together, with these forces [N], least and
# largest. Chosen: those of people who knead.
_TIP_N: Final = (1.0, 12.0)
# A fingertip presses the cells within this distance of its middle [cells], as a ball does (Hertz,
# 1882). Chosen: it covers some five.
_TIP_RADIUS_CELLS: Final = 1.3
# While it presses, its middle moves so far [cells]. Chosen: as a hand that kneads.
_TIP_MOVES_CELLS: Final = 1.5
# After so many fingertips for each cell, they come again. Chosen: four minutes on 8x8.
_TIPS_A_CELL: Final = 4

# When touches begin in scenes where it is not at `BEGIN_S` [s].
_BEGIN_S: Final = {
    "rest": float("inf"),
    "corners": _CORNERS_BEGIN_S,
    "presses": _ROBOT_BEGIN_S,
    "knead": _ROBOT_BEGIN_S,
    "weights": 0.0,
}

SCENES: Final = {
    "rest": "nothing touches the skin",
    "single": f"after {BEGIN_S:g} s (begin=0: at once, as in every scene), one touch in the middle",
    "ghost": f"after {BEGIN_S:g} s, three corners of a rectangle: raw readings show a fourth",
    "multi": f"after {BEGIN_S:g} s, five touches, at places drawn from the seed",
    "corners": f"after {_CORNERS_BEGIN_S:g} s, three corners of a rectangle; every "
    f"{_CORNERS_HELD_S:g} s one of them moves across",
    "moving": f"after {BEGIN_S:g} s, one fingertip on a closed curve over the whole skin, once in "
    f"{_MOVING_PERIOD_S:g} s",
    "slip": f"after {BEGIN_S:g} s, one fingertip that stays; its {_SLIP_N:g} N tremble by "
    f"{100 * SLIP_SHARE:g} % {SLIP_HZ:g} times a second",
    "presses": f"after {_ROBOT_BEGIN_S:g} s, a robot presses cell after cell {ROBOT_PRESSES} times "
    f"with {_ROBOT_PEAK_N[0]:g} to {_ROBOT_PEAK_N[1]:g} N, which takes some 4.5 s a cell",
    "knead": f"{_ROBOT_BEGIN_S:g} s after scans begin, one fingertip after another with "
    f"{_TIP_N[0]:g} to {_TIP_N[1]:g} N, which moves while it presses; over the whole skin, again "
    "and again",
    "weights": "the weights that 'ohmskin calibrate weights' asks for",
}


class Scene:
    """A scene by name (see `SCENES`) on a rows x columns skin.

    Conductance of a cell: g(t) = 1 / r_rest + touch(t), touch = k F(t)^b [S], all (rows, columns).

    seed: of the wires and cells at rest, and of the touches of "multi".
    faults: what is wrong with the skin. A fault that differs from reading to reading, such as hum,
        is not in `ratio`: `EmulatedBoard` adds it.
    begin_s: when touches begin [s]; None: as `SCENES` says.

    `rest` is the untouched skin, without faults; it may be replaced by another of the same size.
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
        self.moves = name in ("corners", "moving", "slip", "presses", "knead", "weights")
        self._waits_s = _BEGIN_S.get(name, BEGIN_S) if begin_s is None else begin_s
        self.begin_s = self._waits_s
        if not self.begin_s >= 0:
            raise ValueError(f"begin must be 0 s or later, not {begin_s}")
        self.faults = faults or SkinFaults()
        self.faults.check(rows, columns)
        random = np.random.default_rng(seed)
        rest, top, bottom = np.exp(_SPREAD_SHARE * random.standard_normal((3, rows, columns)))
        layers = 1 / (REST_OHM * rest), TOP_WIRE_OHM * top, BOTTOM_WIRE_OHM * bottom
        self.rest = Skin(*layers, lead_ohm=np.array(LEAD_OHM))
        self._touches = self._place(random)
        # From another generator, so that all that is drawn above stays as it is.
        log_gain = _GAIN_SPREAD * np.random.default_rng([seed, 1]).standard_normal((rows, columns))
        self._siemens_at_1n = _SIEMENS_AT_1N * np.exp(log_gain)
        cells = rows * columns
        self._robot = _Presses(ROBOT_PRESSES * cells, _ROBOT_PEAK_N, [seed, 2])
        self._tips = _Presses(_TIPS_A_CELL * cells, _TIP_N, [seed, 3])
        # All cells in a random order, again and again, so that no cell waits for long.
        order = np.random.default_rng([seed, 4])
        self._tip_cells = np.concatenate([order.permutation(cells) for _ in range(_TIPS_A_CELL)])
        self._tip_ways = order.uniform(0, 2 * np.pi, self._tip_cells.size)
        self._still_ratio = lru_cache(
            lambda at_s, mode: self.faults.readings(self.skin(at_s), mode)
        )

    @property
    def rest_ratio(self) -> Float:
        """Exact readings of the untouched skin, shape (rows, columns, 4)."""
        return self.faults.readings(self.faults.damaged(self.rest))

    def skin(self, time_s: float) -> Skin:
        """Every resistance of the skin at a time."""
        touched = replace(self.rest, cell_siemens=self.rest.cell_siemens + self._touch(time_s))
        return self.faults.damaged(touched)

    def wait(self, start_s: float) -> None:
        """Take this for the time when scans begin: only then do the fingertips of "knead" begin."""
        if self.name == "knead":
            self.begin_s = start_s + self._waits_s

    def force_n(self, time_s: float) -> Float:
        """The true force on each cell at a time, (rows, columns) [N]: (touch / k)^(1 / b)."""
        return np.asarray((self._touch(time_s) / self._siemens_at_1n) ** (1 / _EXPONENT))

    def put(self, weight: tuple[tuple[float, float], float] | None) -> None:
        """Press a cell by a force [N], and no other; None: none. For the scene "weights".

        A place between cells is pressed as by a fingertip, which covers several.
        """
        force_n = np.zeros((self.rows, self.columns))
        if weight is not None:
            (row, column), total_n = weight
            if row % 1 or column % 1:
                force_n = total_n * self._pressure(row, column)
            else:
                force_n[int(row), int(column)] = total_n
        self._touches = self._by_force(force_n)

    def _by_force(self, force_n: Float) -> Float:
        """What forces (rows, columns) [N] add to the cells [S]."""
        return np.asarray(self._siemens_at_1n * force_n**_EXPONENT)

    def touched(self, time_s: float) -> NDArray[np.bool_]:
        """Cells, (rows, columns), to which a touch adds as much as a cell has at rest, 1 uS."""
        rest_siemens = self.faults.damaged(self.rest).cell_siemens
        return np.asarray(self.skin(time_s).cell_siemens - rest_siemens >= 1 / REST_OHM)

    def ratio(self, time_s: float, mode: str = "near") -> Float:
        """Exact readings of a mode at a time, shape (rows, columns, readings of the mode)."""
        if self.moves and time_s >= self.begin_s:
            return self.faults.readings(self.skin(time_s), mode)
        return self._still_ratio(self.begin_s if time_s >= self.begin_s else -1.0, mode)

    def _touch(self, time_s: float) -> Float:
        """What touches add to each cell at a time, (rows, columns) [S]."""
        if time_s < self.begin_s:
            return np.zeros_like(self._touches)
        match self.name:
            case "corners":
                return self._corners(time_s)
            case "moving":
                return self._finger(time_s)
            case "slip":
                row, column = (self.rows - 1) / 2, (self.columns - 1) / 2
                tremble = SLIP_SHARE * np.sin(2 * np.pi * SLIP_HZ * (time_s - self.begin_s))
                return self._by_force(_SLIP_N * (1 + tremble) * self._pressure(row, column))
            case "presses":
                cell, _, force_n = self._robot.at(time_s - self.begin_s)
                of_cells = np.arange(self._touches.size) == cell // ROBOT_PRESSES
                return self._by_force(force_n * of_cells.reshape(self._touches.shape))
            case "knead":
                return self._by_force(self._fingertip(time_s - self.begin_s))
        return self._touches

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
        """Three corners of a rectangle: the fourth in place of the first if `across` is 1."""
        (top, bottom), (left, right) = _two_of(self.rows), _two_of(self.columns)
        return [(bottom, right) if across else (top, left), (top, right), (bottom, left)]

    def _corners(self, time_s: float) -> Float:
        touches = np.zeros((self.rows, self.columns))
        across = int((time_s - self.begin_s) / _CORNERS_HELD_S) % 2
        for cell, (ohm, hz) in zip(self._three_corners(across), _CORNERS_OHM_HZ, strict=True):
            touches[cell] = (1 + _TREMBLE_SHARE * np.sin(2 * np.pi * hz * time_s)) / ohm
        return touches

    def _fingertip(self, knead_s: float) -> Float:
        """Forces (rows, columns) [N] at a time since the fingertips have begun."""
        number, share, force_n = self._tips.at(knead_s % self._tips.end_s)
        row, column = np.divmod(self._tip_cells[number], self.columns)
        moved, way = _TIP_MOVES_CELLS * (share - 0.5), self._tip_ways[number]
        row = np.clip(row + moved * np.sin(way), 0, self.rows - 1)
        column = np.clip(column + moved * np.cos(way), 0, self.columns - 1)
        return force_n * self._pressure(row, column)

    def _pressure(self, row: float, column: float) -> Float:
        """The share of each cell (rows, columns) in the force of a fingertip at a place."""
        pressure = np.sqrt(np.maximum(1 - self._away(row, column) / _TIP_RADIUS_CELLS**2, 0.0))
        return np.asarray(pressure / pressure.sum())

    def _away(self, row: float, column: float) -> Float:
        """Square distances of the cells from a place, (rows, columns) [cells^2]."""
        away = np.arange(self.rows)[:, None] - row, np.arange(self.columns) - column
        return np.asarray(away[0] ** 2 + away[1] ** 2)

    def _finger(self, time_s: float) -> Float:
        angle = 2 * np.pi * (time_s - self.begin_s) / _MOVING_PERIOD_S
        row = (self.rows - 1) * (0.5 + 0.4 * np.sin(angle))
        column = (self.columns - 1) * (0.5 + 0.4 * np.sin(2 * angle))
        away = self._away(row, column)
        return np.asarray(_FINGER_SIEMENS * np.exp(-away / (2 * _FINGER_STD_CELLS**2)))


class _Presses:
    """So many presses, one after another, whose peaks are drawn between two forces [N].

    end_s: how long all of them take [s].
    """

    def __init__(self, count: int, peaks_n: tuple[float, float], seed: list[int]) -> None:
        random, (least_n, most_n) = np.random.default_rng(seed), peaks_n
        self._peaks_n = least_n * (most_n / least_n) ** random.uniform(size=count)
        ends_s = np.cumsum(random.uniform(*_ROBOT_PAUSE_S, count) + _ROBOT_PRESS_S[-1])
        self._starts_s = ends_s - _ROBOT_PRESS_S[-1]
        self.end_s = float(ends_s[-1])

    def at(self, time_s: float) -> tuple[int, float, float]:
        """Which press is the newest at a time; the share of it that is over; its force [N]."""
        press = max(int(np.searchsorted(self._starts_s, time_s, side="right")) - 1, 0)
        into_s, peak_n = time_s - self._starts_s[press], self._peaks_n[press]
        force_n = np.interp(into_s, _ROBOT_PRESS_S, (0.0, peak_n, peak_n, 0.0))
        return press, float(np.clip(into_s / _ROBOT_PRESS_S[-1], 0, 1)), float(force_n)


def _two_of(count: int) -> tuple[int, int]:
    """Two lines well apart, a quarter in from the edges where there is room."""
    return count // 4, count - 1 - count // 4
