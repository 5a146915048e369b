# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin against nominal ones, from three corners of a rectangle that are pressed.

Symbols. Index 0 is the untouched skin, index 1 the pressed one.

====== ============ =====================================================================
symbol shape        meaning
====== ============ =====================================================================
z      (RC,)        port resistances read, less those of the model [ohm]
n      (RC,)        deviations of what was read [ohm]
B      (RC, RC)     slopes of the model by the cells' log resistances [ohm]
W      (RC, 2RC)    slopes of the model by the segments' log resistances [ohm]
y      ()           log of the wires over nominal
u      (RC,)        what a press adds to the cells' log resistances; 0 but for the free cells
====== ============ =====================================================================

With three corners of a rectangle pressed, (a, b) the one between the other two, (a, b') and
(a', b), the current of the fourth goes through all three in series, so that four ports see three
unknown cells and the wires. But for the untouched cells,

    rho[a,b] + rho[a,b'] + rho[a',b] - rho[a',b'] = 2 (top + bottom)

with top the wire of row a from its electrode up to the nearer of columns b and b', and bottom that
of column b up to the nearer of rows a and a'. So only the sum of both layers is seen, and they are
taken to have changed alike. The untouched cells follow from what was read of them,
dc = B0^-1 (z0 - W0 dy), so

    r = z1 - B1 B0^-1 z0 = W dy + B1 du + noise ,   W = W1 - B1 B0^-1 W0

    S = n1^2 + B1 B0^-1 n0^2 B0^-T B1^T + SEGMENT_STD^2 W W^T + B1 V B1^T

with V wide for the free cells, narrow for others. With w the sum of W over all segments, a
Gauss-Newton step is dy = w^T S^-1 r / (w^T S^-1 w), but for a weak prior of y. Free are the three
cells and their neighbours, since a fingertip may press these as well. What stays unexplained widens
the deviation.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import permutations
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.skin import PortCircuit, current_std
from ohmskin.doctor.findings import WHOLE_SKIN, Cell, Diagnosis, Kind, Place, WireShare
from ohmskin.doctor.signal import Rest, RestScans, rounding_std_lsb, settling
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.estimate.prior import SEGMENT_STD, UNLIMITED_STD
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import ADC_BITS

Corners = tuple[Cell, Cell, Cell]

# What is told. Shares are over nominal; deviations are those of their logs.
KNOWN: Final = 0.15  # [share] A deviation above this is too close to a change to tell the share.
CHANGED: Final = 0.25  # [share] Estimators expect smaller changes of the wires anyway.
CLEAR_STDS: Final = 3.5  # [deviations] By chance, no share of presses differs by this.

# Standard deviations before the readings.
BEFORE_STD: Final = 2.0  # [log] All wires may have changed by a factor of seven.
DRIFT_STD: Final = 0.01  # [log] An untouched cell drifts by this in the seconds since it was read.

# Presses.
PRESS_S: Final = 1.0  # [s] Corners are held this long, so that scans even the noise out.
PRESSED_SIEMENS: Final = 2e-5  # [S] A firm press conducts more: 20 times a cell at rest.
FOURTH_SHARE: Final = 0.5  # [1] No other cell conducts more than this share of the weakest corner.
HELD_SHARE: Final = 0.5  # [1] Corners with less than this share of the most scans were passed by.
LEAST_HELD: Final = 5  # [scans] Fewer scans of a look at pressed corners do not count.
PRESSED_LSB: Final = 4.0  # [LSB] A firm press shows some 400: a change by 1 % of it is no fault.
MOST_STEPS: Final = 20  # [steps] A fit that converges takes fewer.
LONGEST_STEP: Final = 1.0  # [log] The slopes do not hold for longer steps.
CLOSE: Final = 1e-4  # [log] A step that is shorter changes nothing: deviations are longer.


def _ports(ratio: Float, std_lsb: Float | float, matrix: Estimator) -> tuple[Float, Float, Float]:
    """Port resistances of readings (R, C, 4), their deviations, and log resistances of the cells.

    std_lsb: deviation of a port's reading, one for all or (R, C). All (RC,) [ohm]. The currents are
    those that estimators use: without the converter's offset, and what floating lines draw.
    """
    known = matrix.knowledge
    loop_ohm = (1 / np.maximum(PortReader(known).read(ratio).current, 1e-9)).ravel()
    std_siemens = current_std(2.0**-ADC_BITS, known.ref_top_ohm, known.ref_bottom_ohm)
    log_ohm = -np.log(matrix.estimate(ratio).cell_siemens.ravel())
    return loop_ohm - known.ref_ohm, std_siemens * np.ravel(std_lsb) * loop_ohm**2, log_ohm


def suggested_corners(rows: int, columns: int) -> Corners:
    """Where to press: far from the electrodes, and apart.

    :raises ValueError: a skin of one row or column has no rectangle.
    """
    if min(rows, columns) < 2:
        raise ValueError(f"a {rows}x{columns} skin has no rectangle whose corners could be pressed")
    row, column = (max(0, count - 1 - max(2, count // 2 - 1)) for count in (rows, columns))
    return (row, column), (row, columns - 1), (rows - 1, column)


def moved_across(corners: Corners) -> Corners:
    """The same, with the corner between the others moved to the fourth: it shows other wires."""
    _, beside, below = corners
    return (below[0], beside[1]), below, beside


def pressed_corners(siemens: Float) -> Corners | None:
    """The firmly pressed cells of conductances (R, C), the one between the others first.

    None if they are not three corners of a rectangle.
    """
    order = np.argsort(siemens, axis=None)[::-1]
    level = siemens.ravel()[order[:4]]
    if len(level) < 4 or level[2] < PRESSED_SIEMENS or level[3] > FOURTH_SHARE * level[2]:
        return None
    cells = [divmod(int(cell), siemens.shape[1]) for cell in order[:3]]
    for corner, beside, below in permutations(cells):
        if beside[0] == corner[0] and below[1] == corner[1]:
            return corner, beside, below
    return None


class CornerScans:
    """Scans of a skin on which somebody presses three corners, and then has moved one across.

    wanted: the corners to press next. pressed: all cells that the last scan shows pressed. hold:
    these are corners that are to be held still. again: the first corners are done. done: so are the
    second.

    :raises ValueError: a skin of one row or column has no rectangle.
    """

    def __init__(self, board: Hello) -> None:
        self.wanted = suggested_corners(board.rows, board.columns)
        self.pressed: tuple[Cell, ...] = ()
        self.hold = self.again = self.done = False
        self._board = board
        self._matrix = make_estimator("matrix", SkinKnowledge.of(board))
        self._codes: defaultdict[Corners, list[Float]] = defaultdict(list)
        self._last: Corners | None = None

    def take(self, scan: Scan) -> None:
        """Keep a scan if three corners are pressed in it, and nothing else is."""
        siemens = self._siemens(scan)
        self.pressed = Place.of_cells(siemens > PRESSED_SIEMENS).cells
        corners = pressed_corners(siemens)
        self.hold = corners is not None and corners != self._last
        if corners is None:
            return
        self._codes[corners].append(scan.codes.astype(np.float64))
        if self.hold and len(self._codes[corners]) >= PRESS_S * self._board.rate_hz:
            self.hold, self.again, self.done = False, True, self.again
            self._last, self.wanted = corners, moved_across(corners)

    def _siemens(self, scan: Scan) -> Float:
        """Conductances (R, C) [S]; zeros for another size: the board was reset meanwhile."""
        shape = self._board.rows, self._board.columns
        if scan.codes.shape[:2] != shape:
            return np.zeros(shape)
        return self._matrix.estimate(scan.ratio).cell_siemens

    def examine_settling(
        self, looks: Sequence[tuple[Hello, list[Scan]]], diagnosis: Diagnosis
    ) -> None:
        """Add how readings change with a longer settle time while the same corners are pressed.

        looks: by turns as usual and with the longer time, so that what drifts does not count.
        """
        means: defaultdict[Corners, list[list[Float]]] = defaultdict(lambda: [[], []])
        for turn, (_, scans) in enumerate(looks):
            codes = defaultdict(list)
            for scan in scans:
                if corners := pressed_corners(self._siemens(scan)):
                    codes[corners].append(scan.codes)
            for corners, held in codes.items():
                if len(held) >= LEAST_HELD:
                    means[corners][turn % 2].append(np.mean(held, axis=0))
        both = [each for each in means.values() if min(map(len, each)) >= 2]
        first = [RestScans.of(*look) for look in looks[:2]]
        if not both or first[0] is None or first[1] is None:
            return
        changes = []
        for each in both:
            before, after = (np.mean(held, axis=0) for held in each)
            scatter = np.sum([np.var(held, axis=0, ddof=1) / len(held) for held in each], axis=0)
            change = np.abs(after - before).max()
            changes.append((change - CLEAR_STDS * scatter.max() ** 0.5, change))
        clear, most = map(float, max(changes))
        diagnosis.measured["settling_pressed_lsb"] = round(max(clear, 0.0), 2)
        if clear > PRESSED_LSB:
            others = [each for each in diagnosis.findings if each.kind is not Kind.SETTLING]
            diagnosis.findings = others
            values = settling(first[0], first[1], most)
            diagnosis.add(Kind.SETTLING, most_lsb=PRESSED_LSB, pressed=True, **values)

    def measure(self, rest: Rest) -> list[WireShare]:
        """The share of both layers, then that of each row and column; none if none was pressed."""
        at_rest = _ports(rest.ratio, rest.std_lsb, self._matrix)
        most = max(map(len, self._codes.values()), default=0)
        found = []
        for corners, codes in self._codes.items():
            if len(codes) < HELD_SHARE * most:
                continue
            # A hand trembles: that evens rounding out, and is no noise, as all readings follow it.
            scatter_lsb = np.maximum(np.std(codes, axis=0), rest.noise_lsb)
            variance = np.mean(rounding_std_lsb(scatter_lsb) ** 2, axis=-1)
            std_lsb = np.sqrt(variance + rest.noise_lsb**2 / len(codes))
            ratio = ratio_from_codes(np.mean(codes, axis=0), self._board.adc_bits)
            pressed, free = _ports(ratio, std_lsb, self._matrix), self._free(corners)
            found.append((corners[0], *_pressed_fit(at_rest, pressed, free, rest.wire_ohm)))
        return shares_of(found)

    def _free(self, corners: Corners) -> Bool:
        """Cells that may be pressed, (R, C): the corners and those around, but for the fourth's."""
        rows, columns = np.indices((self._board.rows, self._board.columns))
        *near, near_fourth = (
            np.maximum(np.abs(rows - row), np.abs(columns - column)) <= 1
            for row, column in (*corners, moved_across(corners)[0])
        )
        free = np.any(near, axis=0) & ~near_fourth
        free[tuple(np.transpose(corners))] = True
        return np.asarray(free)


def shares_of(found: Sequence[tuple[Cell, float, float]]) -> list[WireShare]:
    """The share of all wires that were seen, if any, then that of each row and column.

    found: row and column, y, and its deviation. All wires together are the mean by precision; the
    others tell a change only where this mean does not explain them.
    """
    if not found:
        return []
    y, std = (np.array([each[at] for each in found]) for at in (1, 2))
    mean, mean_std = float(np.average(y, weights=std**-2.0)), float(np.sum(std**-2.0) ** -0.5)
    alike = bool(np.all(np.abs(y - mean) < CLEAR_STDS * std))

    def share(y: float, std: float, tells: bool, place: Place = WHOLE_SKIN) -> WireShare:
        clear = abs(y) > max(float(np.log(1 + CHANGED)), CLEAR_STDS * std)
        known, times = std <= KNOWN, float(np.exp(y))
        return WireShare(place, times, times * std, known, tells and known and clear)

    each = [share(y, std, not alike, Place((row,), (column,))) for (row, column), y, std in found]
    return [share(mean, mean_std, alike), *each]


def _pressed_fit(
    rest: tuple[Float, ...], pressed: tuple[Float, ...], free: Bool, wire_ohm: tuple[float, float]
) -> tuple[float, float]:
    """y and its deviation. rest, pressed: what `_ports` gives."""
    shape, free = free.shape, free.ravel()
    (rest_ohm, rest_std, untouched), (port_ohm, port_std, touched) = rest, pressed
    log_share = 0.0
    lift = np.where(free, touched - untouched, 0.0)
    variance = np.where(free, UNLIMITED_STD, DRIFT_STD) ** 2
    for _ in range(MOST_STEPS):
        top, bottom = (np.full(shape, ohm * np.exp(log_share)) for ohm in wire_ohm)
        before, now = (
            PortCircuit(np.exp(-cell).reshape(shape), top, bottom)
            for cell in (untouched, untouched + lift)
        )
        at_rest = np.linalg.inv(before.by_cell())
        by_cell = now.by_cell()
        through = by_cell @ at_rest  # B1 B0^-1
        by_rest_wires = before.by_wires()
        off_rest = rest_ohm - before.port_ohm
        residual = port_ohm - now.port_ohm - through @ off_rest  # r
        by_segment = now.by_wires() - through @ by_rest_wires  # W
        slopes = by_segment.sum(axis=1)  # w
        spread = by_cell * variance
        covariance = spread @ by_cell.T + SEGMENT_STD**2 * by_segment @ by_segment.T
        covariance += (through * rest_std**2) @ through.T + np.diag(port_std**2)
        weighed = np.linalg.solve(covariance, np.column_stack([slopes, residual]))
        known = float(slopes @ weighed[:, 0]) + BEFORE_STD**-2
        pull = float(slopes @ weighed[:, 1]) - log_share * BEFORE_STD**-2
        step = float(np.clip(pull / known, -LONGEST_STEP, LONGEST_STEP))
        log_share += step
        untouched = untouched + at_rest @ (off_rest - step * by_rest_wires.sum(axis=1))
        more = spread.T @ (weighed[:, 1] - step * weighed[:, 0])
        lift += np.where(free, np.clip(more, -LONGEST_STEP, LONGEST_STEP), 0.0)
        if abs(step) < CLOSE:
            break
    misfit = float(residual @ weighed[:, 1]) / max(int((~free).sum()) - 1, 1)
    return log_share, (max(misfit, 1.0) / known) ** 0.5
