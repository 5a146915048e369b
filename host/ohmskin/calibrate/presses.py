# SPDX-License-Identifier: Apache-2.0
"""From presses of single cells, in scans or in a table, to the calibration of a skin.

A scan belongs to the cell that rises most above rest, if that cell is touched. Consecutive scans of
one cell are a press, if they take `MIN_PRESS_S` at least. Where the rise falls to a fifth in
between, they are several presses. Scans in which another touched cell rises by more than
`SECOND_SHARE` of the first are left out, because nothing tells how two cells share a force.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.regression import ForceRegression
from ohmskin.calibrate.rules import check_cell, check_cells_differ, check_complete
from ohmskin.calibrate.tables import ForceLog, PressTable
from ohmskin.calibrate.wires import FoundWires, PressReadings, find_wires
from ohmskin.errors import TareRefused
from ohmskin.estimate.base import TOUCH_STDS, Estimator
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.estimate.touched import touched_at_rest, touched_cells
from ohmskin.files import naming
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.curve import ForceModel
from ohmskin.force.reader import now
from ohmskin.link.clock import scan_times_s
from ohmskin.link.messages import Hello, Scan

# Scans without touch may interrupt a press for so long [s]. Chosen: a light touch flickers about
# its threshold, and nobody lifts a finger for less.
FLICKER_S: Final = 0.035
# A shorter press is a bounce [s], and so are fewer scans. Chosen: one scan may be noise.
MIN_PRESS_S, MIN_PRESS_SCANS = 0.05, 2
# A cell that rises by more than this share of the strongest one is pressed, too. Chosen: what the
# estimate leaves in the neighbours of one pressed cell is less.
SECOND_SHARE: Final = 0.25
# Fewer scans without touch do not tell the zero of a force sensor. Chosen: the median of so many
# has less than half the noise of one.
MIN_ZERO_SCANS: Final = 10
# Creep keeps a cell touched for a while, so that quick presses meet in a valley: two presses are
# told apart if the logarithm of the rise falls by so much between them. Chosen: to a fifth.
VALLEY_LOG: Final = np.log(5.0)
# What rises by less than this share of the strongest rise is noise, whose logarithm would have
# valleys without end. Chosen: far below what a light touch shows.
_NOISE_SHARE: Final = 1e-3
# A cell that has lost more than this share of its rest in the later scans was touched at rest.
# Chosen: no rest drifts by as much in a session.
LOST_SHARE: Final = 0.5
# The method whose levels find the presses. Chosen: it takes no wires, and knows all cells at once.
WIRELESS: Final = "matrix"
# Passes things on, one after another, and shows how many have been.
Progress = Callable[[Iterable[Scan]], Iterable[Scan]]
# Stands for a cell, or a press, where a scan has none. Chosen: no index is negative.
_NOTHING: Final = -1


@dataclass(frozen=True, eq=False)
class Presses:
    """What `ForceRegression.fit` learns from: n rows, each a scan of one pressed cell.

    cells: the cell's flat index, row * columns + column, (n,).
    rise: of that cell above rest, (n,) [S, or 1 for `voltage`].
    rise_std: standard deviation of `rise`, (n,).
    force_n: on that cell, (n,) [N].
    press: number of the press that the row is of, (n,).
    scan: number of the scan that the row is, (n,).
    shape: (R, C) of the skin.
    shared: how many scans were left out because two cells were pressed.
    zero_n: what the force sensor showed without touch, already taken off [N].
    """

    cells: NDArray[np.intp]
    rise: Float
    rise_std: Float
    force_n: Float
    press: NDArray[np.intp]
    scan: NDArray[np.intp]
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
    """What n scans showed of every cell.

    time_s: of the middle of each scan, (n,) [s].
    rise: levels above rest, (n, R, C) [S, or 1 for `voltage`].
    rise_std: standard deviations of `rise`.
    touched: whether something presses the cell, (n, R, C).
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
    has_force = np.isfinite(force_n)
    untouched = has_force & ~history.touched.any(axis=(1, 2))
    # The median, because the force begins to rise in scans that do not show a touch yet.
    enough = np.count_nonzero(untouched) >= MIN_ZERO_SCANS
    zero_n = float(np.median(force_n[untouched])) if enough else 0.0

    rise, touched = history.rise.reshape(scans, -1), history.touched.reshape(scans, -1)
    scan_s = scan_period_s(history.time_s)
    pressed = _pressed(rise, touched, int(FLICKER_S / scan_s))
    # Where no cell is pressed, `_NOTHING` is the index of the last cell. Such scans get its rise,
    # but they are of no press, and so are left out below.
    every = np.arange(scans)
    pressed_rise = rise[every, pressed]
    press = number_presses(pressed, pressed_rise, scan_s)
    others = np.where(touched, rise, -np.inf)
    others[every, pressed] = -np.inf
    shared = (press != _NOTHING) & (others.max(axis=1) > SECOND_SHARE * pressed_rise)
    good = (press != _NOTHING) & ~shared & has_force
    if not good.any():
        raise ValueError("no cell is pressed alone while the force is known")
    return Presses(
        cells=pressed[good],
        rise=pressed_rise[good],
        rise_std=history.rise_std.reshape(scans, -1)[every, pressed][good],
        # Below zero is the sensor's noise: `ForceLog` refuses more than that.
        force_n=np.maximum(force_n[good] - zero_n, 0.0),
        press=press[good],
        scan=every[good],
        shape=(rows, columns),
        shared=int(np.count_nonzero(shared)),
        zero_n=zero_n,
    )


def scan_period_s(time_s: Float) -> float:
    """Time from one scan to the next [s], by the times of n scans; of a single one, any.

    It is 0.1 ms at least, which no board is as fast as: whoever divides by it divides by no 0.
    """
    return max(float(np.median(np.diff(time_s))), 1e-4) if time_s.size > 1 else MIN_PRESS_S


def _pressed(rise: Float, touched: Bool, flicker: int) -> NDArray[np.intp]:
    """Index of the cell that each scan belongs to, or `_NOTHING`. Arrays (n, R * C).

    Scans between two of one cell belong to it as well, if they are so many at most: `flicker`.
    """
    from scipy.ndimage import binary_closing

    strongest = rise.argmax(axis=1)
    pressed = np.full(strongest.size, _NOTHING, dtype=np.intp)
    for cell in np.unique(strongest):
        of_cell = (strongest == cell) & touched[:, cell]
        # Closing fills gaps shorter than its structure. Without the padding, it would empty the
        # first and last scans.
        padded = np.pad(of_cell, flicker + 1)
        closed = binary_closing(padded, np.ones(flicker + 1))
        # Scans of a gap that show another cell stay that cell's, whichever of them comes first.
        pressed[closed[flicker + 1 : -flicker - 1] & (pressed == _NOTHING)] = cell
        pressed[of_cell] = cell
    return pressed


def number_presses(
    pressed: NDArray[np.intp], pressed_rise: Float, scan_s: float
) -> NDArray[np.intp]:
    """Number of the press that each scan is of, or `_NOTHING`.

    pressed: index of the cell that is pressed in each scan, or `_NOTHING`, (n,).
    pressed_rise: the rise of that cell, (n,).
    scan_s: time from one scan to the next.
    """
    least = max(MIN_PRESS_SCANS, math.ceil(MIN_PRESS_S / scan_s))
    press = np.full(pressed.size, _NOTHING, dtype=np.intp)
    number = 0
    changes = np.flatnonzero(np.diff(pressed)) + 1
    for run in np.split(np.arange(pressed.size), changes):
        if pressed[run[0]] == _NOTHING or run.size < least:
            continue
        for part in np.split(run, _valleys(pressed_rise[run])):
            press[part] = number
            number += 1
    return press


def _valleys(rise: Float) -> list[int]:
    """Where the presses of a run (n,) meet: at the least rise between two peaks.

    A peak counts if the rise falls by `VALLEY_LOG` on both sides of it before it is as high again.
    """
    from scipy.signal import find_peaks

    floor = _NOISE_SHARE * float(rise.max())
    height = np.log(np.maximum(rise, floor))
    # The padding is the untouched skin before and after: a run may begin or end with a peak.
    peaks, _ = find_peaks(np.pad(height, 1, constant_values=np.log(floor)), prominence=VALLEY_LOG)
    peaks -= 1
    valleys = []
    for before, after in pairwise(peaks):
        valley = int(before + height[before:after].argmin())
        # Peaks of exactly one height count all or none, however little it falls between them.
        if min(height[before], height[after]) - height[valley] >= VALLEY_LOG:
            valleys.append(valley)
    return valleys


@dataclass(eq=False)
class Calibrator:
    """Makes the calibration of one skin.

    board: the one that scans it.
    rest_ratio: readings (R, C, 4) of the untouched skin.
    method: the one by which forces will be read.
    indenter_area_m2: area that the skin is pressed with [m^2]; None: any, by `kneading`.
    nominal_wire_ohm: what is known of its wires.
    force: calibrate even if cells seem touched at rest.

    Made from these:

    knowledge: what is known of the skin.
    estimator: of this method, for this skin.
    rest_level: what the estimator shows of the untouched skin, (R, C) [S, or 1 for `voltage`].
    found: the wires by presses; None before `learn_wires`.
    fault: what is wrong with the skin at rest, such as an open line, in words; or empty.

    Cells count as touched at rest by `touched_at_rest`, or if their level is lower in later scans,
    by more than `LOST_SHARE` of rest.

    :raises TareRefused: something touched the skin while its rest was measured.
    """

    board: Hello
    rest_ratio: Float
    method: str
    indenter_area_m2: float | None
    nominal_wire_ohm: WireOhm = NO_WIRES
    force: bool = False

    def __post_init__(self) -> None:
        check_complete(self.board)
        self.found: FoundWires | None = None
        self._tell(self.nominal_wire_ohm)
        self.fault = PortReader(self.knowledge).read(self.rest_ratio).fault
        self._refuse(touched_at_rest(self.knowledge))

    def _tell(self, wires: WireOhm) -> None:
        """Make the estimator, which knows these wires.

        It is told that the skin was not bent since its wires were measured: the presses that show
        the wires are the ones that it estimates.
        """
        own = None if self.found is None else self.found.own_lead_ohm
        knowledge = SkinKnowledge.of(self.board, self.rest_ratio, wires, own_lead_ohm=own)
        self.knowledge = replace(knowledge, may_be_bent=False)
        self.estimator = make_estimator(self.method, self.knowledge)
        self.rest_level = self.estimator.rest_level()

    def _refuse(self, touched: Bool) -> None:
        """Raise TareRefused if a cell (R, C) was touched at rest."""
        if touched.any() and not self.force:
            remedy = "measure rest with nothing on the skin, or say --force if nothing was on it"
            raise TareRefused(f"{touched_cells(touched)} at rest", remedy)

    @property
    def shows_wires(self) -> bool:
        """Whether the estimator measures the wires by itself: far ends are read."""
        return self.board.mode != "near"

    def look(self, scans: list[Scan], progress: Progress = iter) -> LevelHistory:
        """What all scans show to a method that wires hardly mislead, so that presses are found.

        progress: passes scans on, one after another. Raises ValueError and TareRefused as
        `measure`.
        """
        by = self.estimator if self.shows_wires else make_estimator(WIRELESS, self.knowledge)
        return self.measure(scans, progress, by)

    def measure(
        self, scans: list[Scan], progress: Progress = iter, by: Estimator | None = None
    ) -> LevelHistory:
        """What all scans show above rest. progress: as for `look`. by: None: the estimator.

        Raises ValueError for scans of another size than the untouched skin, and TareRefused where
        it was touched.
        """
        estimator = by or self.estimator
        rest = estimator.rest_level()
        answers = (estimator.estimate(scan.ratio) for scan in progress(scans))
        levels = [(answer.level - rest, answer.level_std, answer.touched) for answer in answers]
        history = LevelHistory(scan_times_s(scans), *map(np.array, zip(*levels, strict=True)))
        # Single cells are pressed, so each cell is untouched in most scans, and its median rise is
        # about 0. If it is far below, something that touched the cell at rest has gone since.
        rise, std = np.median(history.rise, axis=0), np.median(history.rise_std, axis=0)
        self._refuse(-rise > np.fmax(LOST_SHARE * rest, TOUCH_STDS * std))
        return history

    def learn_wires(
        self, ratios: Iterable[Float], presses: Presses, *, in_order: bool = True
    ) -> None:
        """Find the wires by presses, and tell them the estimator.

        ratios: readings (R, C, 4) of each row of `presses`.
        in_order: the readings are scans, one after the other, and not means of scans.

        Raises ValueError where no press is clear.
        """
        reader, cells = PortReader(self.knowledge), presses.cells
        current = np.empty((2, cells.size))
        for row, ratio in enumerate(ratios):
            ports = reader.read(ratio, in_order=in_order)
            current[:, row] = ports.current.flat[cells[row]], ports.current_std.flat[cells[row]]
        readings = PressReadings(cells, presses.press, presses.force_n, *current)
        self.take_wires(find_wires(self.knowledge, readings))

    def take_wires(self, found: FoundWires) -> None:
        """Tell the estimator the wires that presses have shown."""
        self.found = found
        self._tell(found.wires)

    def presses_in_table(self, table: PressTable, ratios: Float | None = None) -> Presses:
        """The presses of a table, each of its rows one.

        ratios: mean readings under each press, (n, R, C, 4), by whose wires the presses are seen;
            None: they are not known.

        Raises ValueError, naming the row, for a cell that is not on the skin; and where readings
        show no press clearly.
        """
        rows, columns = self.board.rows, self.board.columns
        for number, (row, column) in enumerate(table[["row", "column"]].tolist(), start=2):
            with naming(f"row {number}"):
                check_cell(row, column, (rows, columns))
        cells = table["row"] * columns + table["column"]
        presses = Presses(
            cells=cells,
            rise=table["conductance"] - self.rest_level.flat[cells],
            rise_std=table["conductance_std"],
            force_n=table["force_n"],
            press=np.arange(cells.size),
            scan=np.arange(cells.size),
            shape=(rows, columns),
        )
        if ratios is None:
            return presses
        if not self.shows_wires:
            self.learn_wires(ratios, presses, in_order=False)
        seen = zip(ratios, cells, strict=True)
        rise = np.array([self.estimator.estimate(ratio).level.flat[cell] for ratio, cell in seen])
        rise -= self.rest_level.flat[cells]
        # The deviations in the table are of rises with other wires. As shares of the rise, they are
        # the same with these wires.
        return replace(presses, rise=rise, rise_std=presses.rise_std * np.abs(rise / presses.rise))

    def calibration(self, presses: Presses) -> tuple[Calibration, str]:
        """The calibration, and which cells have no curve of their own.

        Raises ValueError where presses break one of `calibrate.rules`, and where the force does not
        grow with what the skin shows: then they tell no curve.
        """
        regression = ForceRegression().fit(
            cells=presses.cells,
            rise=presses.rise,
            force_n=presses.force_n,
            shape=presses.shape,
            rise_std=presses.rise_std,
            press=presses.press,
        )
        pressed = np.argwhere(presses.counts).tolist()
        check_cells_differ({(row, column) for row, column in pressed}, presses.shape)
        largest_n = float(presses.force_n.max())
        return self.calibration_of(regression.model_, largest_n), regression.message_

    def calibration_of(self, model: ForceModel, largest_force_n: float) -> Calibration:
        """The calibration with these curves; largest_force_n: of all presses [N]."""
        date, told = now(), self.knowledge.nominal_wire_ohm
        return Calibration(
            unit_id=self.board.unit_id,
            date=date,
            method=self.method,
            rest=Rest.of(self.method, self.knowledge, date),
            model=model,
            indenter_area_m2=self.indenter_area_m2,
            # Single presses teach `joint` nothing that the fit of all presses does not know.
            nominal_wire_ohm=self.estimator.wires() if self.shows_wires else told,
            mode=self.board.mode,
            largest_force_n=largest_force_n,
            own_lead_ohm=self.knowledge.own_lead_ohm,
        )
