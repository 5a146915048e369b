# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells, in scans or in a table, to the calibration of a skin.

A scan belongs to the cell that rises most above rest, if that cell is touched. Consecutive scans of
one cell, `MIN_SCANS` at least, are a press; where the rise falls to a fifth in between, several.
Scans in which another cell rises by more than `SECOND_SHARE` of the first are left out, for nothing
tells how two cells share a force.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.tables import ForceLog, PressTable
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.files import naming
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.reader import now
from ohmskin.force.regression import ForceRegression
from ohmskin.link.clock import scan_times_s
from ohmskin.link.messages import Hello, Scan

# So many scans without touch may interrupt a press: a light touch flickers about its threshold.
FLICKER_SCANS: Final = 3
# Fewer scans in a row are a bounce, not a press.
MIN_SCANS: Final = 5
# A cell that rises by more than this share of the strongest one is pressed, too; a neighbour of
# one pressed cell rises by less.
SECOND_SHARE: Final = 0.25
# Fewer scans without touch do not tell the zero of a force sensor.
MIN_ZERO_SCANS: Final = 10
# Creep keeps a cell touched for a while, so that quick presses meet in a valley: two presses are
# told apart if the logarithm of the rise falls by so much between them.
VALLEY_LOG: Final = np.log(5.0)
# What rises by less than this share of the strongest rise is noise to that logarithm.
_NOISE_FLOOR: Final = 1e-3
# Stands for a cell, or a press, where a scan has none.
_NOTHING: Final = -1


@dataclass(frozen=True, eq=False)
class Presses:
    """What `ForceRegression.fit` learns from, n rows: arrays (n,).

    cells: flat indices, row * columns + column. rise, rise_std: of that cell [S, or 1 for
    `voltage`]. force_n [N]. press: number of the press that a row is of. shape: (R, C). shared:
    scans left out because two cells were pressed. zero_n: what the force sensor showed without
    touch, already taken off [N].
    """

    cells: NDArray[np.intp]
    rise: Float
    rise_std: Float
    force_n: Float
    press: NDArray[np.intp]
    shape: tuple[int, int]
    shared: int = 0
    zero_n: float = 0.0

    @property
    def counts(self) -> NDArray[np.intp]:
        """Number of presses of each cell, (R, C)."""
        _, first = np.unique(self.press, return_index=True)
        rows, columns = self.shape
        return np.bincount(self.cells[first], minlength=rows * columns).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class LevelHistory:
    """What n scans showed, by the times (n,) of their middles [s].

    rise, rise_std (n, R, C): levels above rest and their standard deviations [S, or 1 for
    `voltage`]. touched (n, R, C).
    """

    time_s: Float
    rise: Float
    rise_std: Float
    touched: Bool

    @property
    def of_skin(self) -> Float:
        """Rise of all touched cells together, (n,)."""
        return np.asarray(np.sum(self.rise, axis=(1, 2), where=self.touched))


def find_presses(history: LevelHistory, log: ForceLog, offset_s: float) -> Presses:
    """The presses, with the force at each scan: log time + offset_s = scan time.

    Raises ValueError where no scan of a single pressed cell has a force.
    """
    scans, rows, columns = history.rise.shape
    force_n = log.at(history.time_s - offset_s)
    known = np.isfinite(force_n)
    untouched = known & ~history.touched.any(axis=(1, 2))
    # The median of many scans, because the force begins before a touch is certain.
    enough = np.count_nonzero(untouched) >= MIN_ZERO_SCANS
    zero_n = float(np.median(force_n[untouched])) if enough else 0.0

    rise = history.rise.reshape(scans, -1)
    pressed = _pressed(rise, history.touched.reshape(scans, -1))
    every = np.arange(scans)
    top = rise[every, pressed]
    press = _numbered(pressed, top)
    others = rise.copy()
    others[every, pressed] = -np.inf
    shared = (press != _NOTHING) & (others.max(axis=1) > SECOND_SHARE * top)
    good = (press != _NOTHING) & ~shared & known
    if not good.any():
        raise ValueError("no cell is pressed alone while the force is known")
    return Presses(
        cells=pressed[good],
        rise=top[good],
        rise_std=history.rise_std.reshape(scans, -1)[every, pressed][good],
        # Below zero is the sensor's noise: `ForceLog` refuses more than that.
        force_n=np.maximum(force_n[good] - zero_n, 0.0),
        press=press[good],
        shape=(rows, columns),
        shared=int(np.count_nonzero(shared)),
        zero_n=zero_n,
    )


def _pressed(rise: Float, touched: Bool) -> NDArray[np.intp]:
    """Index of the cell that each scan belongs to, or `_NOTHING`. Arrays (n, R * C)."""
    from scipy.ndimage import binary_closing

    top = rise.argmax(axis=1)
    pressed = np.full(top.size, _NOTHING, dtype=np.intp)
    for cell in np.unique(top):
        of_cell = (top == cell) & touched[:, cell]
        padded = np.pad(of_cell, FLICKER_SCANS + 1)
        closed = binary_closing(padded, np.ones(FLICKER_SCANS + 1))
        pressed[closed[FLICKER_SCANS + 1 : -FLICKER_SCANS - 1] & (pressed == _NOTHING)] = cell
        pressed[of_cell] = cell
    return pressed


def _numbered(pressed: NDArray[np.intp], top: Float) -> NDArray[np.intp]:
    """Number of the press that each scan is of, or `_NOTHING`."""
    press = np.full(pressed.size, _NOTHING, dtype=np.intp)
    number = 0
    changes = np.flatnonzero(np.diff(pressed)) + 1
    for run in np.split(np.arange(pressed.size), changes):
        if pressed[run[0]] == _NOTHING or run.size < MIN_SCANS:
            continue
        for part in np.split(run, _valleys(top[run])):
            press[part] = number
            number += 1
    return press


def _valleys(rise: Float) -> list[int]:
    """Where the presses of a run (n,) meet: the least rise between peaks that stand out of it."""
    from scipy.signal import find_peaks

    floor = _NOISE_FLOOR * float(rise.max())
    height = np.log(np.maximum(rise, floor))
    peaks, _ = find_peaks(np.pad(height, 1, constant_values=np.log(floor)), prominence=VALLEY_LOG)
    peaks -= 1
    return [int(before + height[before:after].argmin()) for before, after in pairwise(peaks)]


def check_cell(row: int, column: int, shape: tuple[int, int]) -> tuple[int, int]:
    """The cell. Raises ValueError if it is not on a skin of this shape."""
    if row >= shape[0] or column >= shape[1]:
        skin = f"{shape[0]}x{shape[1]} skin, whose first is (0, 0)"
        raise ValueError(f"cell ({row}, {column}) is not on this {skin}")
    return row, column


@dataclass(eq=False)
class Calibrator:
    """Makes the calibration of one skin.

    board: that scans it. rest_ratio: readings (R, C, 4) of the untouched skin. method: that of
    `estimator`. indenter_area_m2: area that it is pressed with [m^2]. rest_level (R, C): what the
    estimator shows of the untouched skin [S, or 1 for `voltage`].
    """

    board: Hello
    rest_ratio: Float
    method: str
    indenter_area_m2: float
    nominal_wire_ohm: WireOhm = NO_WIRES

    def __post_init__(self) -> None:
        self._knowledge = SkinKnowledge.of(self.board, self.rest_ratio, self.nominal_wire_ohm)
        self.estimator = make_estimator(self.method, self._knowledge)
        self.rest_level = self.estimator.rest_level()

    def measure(
        self, scans: list[Scan], progress: Callable[[Iterable[Scan]], Iterable[Scan]] = iter
    ) -> LevelHistory:
        """What all scans show above rest. progress: passes them on, one after another.

        Raises ValueError for scans of another size than the untouched skin.
        """
        levels = []
        for scan in progress(scans):
            found = self.estimator.estimate(scan.ratio)
            levels.append((found.level - self.rest_level, found.level_std, found.touched))
        return LevelHistory(scan_times_s(scans), *map(np.array, zip(*levels, strict=True)))

    def presses_in_table(self, table: PressTable) -> Presses:
        """The presses of a table, each of its rows one.

        Raises ValueError, naming the row, for a cell that is not on the skin.
        """
        rows, columns = self.board.rows, self.board.columns
        for number, (row, column) in enumerate(table[["row", "column"]].tolist(), start=2):
            with naming(f"row {number}"):
                check_cell(row, column, (rows, columns))
        cells = table["row"] * columns + table["column"]
        return Presses(
            cells=cells,
            rise=table["conductance"] - self.rest_level.flat[cells],
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
            *(presses.cells, presses.rise, presses.force_n),
            shape=presses.shape,
            rise_std=presses.rise_std,
            press=presses.press,
        )
        pressed = np.argwhere(presses.counts).tolist()
        if len(pressed) == 1 and presses.counts.size > 1:
            remedy = "press at least one more, which tells how much cells differ"
            raise ValueError(f"all presses are on cell {tuple(pressed[0])}: {remedy}")
        date = now()
        calibration = Calibration(
            unit_id=self.board.unit_id,
            date=date,
            method=self.method,
            rest=Rest.of(self.method, self._knowledge, date),
            model=found.model_,
            indenter_area_m2=self.indenter_area_m2,
            nominal_wire_ohm=self.estimator.wires(),
            mode=self.board.mode,
        )
        return calibration, found.message_
