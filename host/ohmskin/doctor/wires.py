# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin against nominal ones, from three corners of a rectangle that are pressed.

Why three corners. Call them (a, b), (a, b') and (a', b), of which (a, b) is between the other two.
The fourth one, (a', b'), is not pressed, so its port's current takes the way through all three,
in series. So four ports show four sums of three unknown cells and of wires. If the untouched cells
conducted nothing, and lines had no leads, this would be left:

    rho[a,b] + rho[a,b'] + rho[a',b] - rho[a',b'] = 2 (top + bottom)

top is the wire of row a from its electrode to the nearer of columns b and b', bottom that of column
b to the nearer of rows a and a'. Only their sum is seen. So both layers are taken to have changed
by the same factor exp(y).

Symbols. Index 0 is the untouched skin, index 1 the pressed one.

====== ============ =====================================================================
symbol shape        meaning
====== ============ =====================================================================
y      ()           log of the wires over nominal: what is sought
z      (RC,)        port resistances as read, less leads and those of the model [ohm]
n      (RC,)        standard deviations of the port resistances as read [ohm]
c      (RC,)        log resistances of the untouched cells
p      (RC,)        what a press adds to these; 0 but for the free cells, which may be pressed
B      (RC, RC)     slopes of the model's port resistances by the cells' log resistances [ohm]
W      (RC, 2RC)    slopes of these by the segments' log resistances [ohm]
V      (RC,)        variance of p: wide for the free cells, narrow for all others
l      ()           deviation of the leads of a port, which all ports have alike [ohm]
====== ============ =====================================================================

The untouched cells are those that explain the untouched skin, whatever the wires are:
dc = B0^-1 (z0 - W0 dy). The readings of the pressed skin then are

    r = z1 - B1 B0^-1 z0 = W dy + B1 dp + noise ,   W = W1 - B1 B0^-1 W0

    S = n1^2 + B1 B0^-1 n0^2 B0^-T B1^T + SEGMENT_STD^2 W W^T + B1 V B1^T + l^2 d d^T

S is the covariance of all that is not y: noise of both skins, what segments have of their own,
presses, and leads, which move r by d = 1 - B1 B0^-1 1. With w the sum of W over all segments, a
Gauss-Newton step is

    dy = w^T S^-1 r / (w^T S^-1 w) ,

and a prior of deviation UNLIMITED_STD keeps y finite where readings say nothing of it. The three
corners and their neighbours are free, since a fingertip may press these as well. If the residual is
larger than S says, the deviation of y is widened.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import current_std
from ohmskin.circuit.ports import PortCircuit
from ohmskin.doctor.findings import WHOLE_SKIN, Cell, Diagnosis, Kind, Place, WireShare
from ohmskin.doctor.limits import CHANGED_SHARE, FEW_STDS, KNOWN_STD, PRESSED_LSB
from ohmskin.doctor.signal import NOISE_S, Look, Rest, rounding_std_lsb, settling_values
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.estimate.prior import MAX_ITERATIONS, MAX_STEP_LOG, SEGMENT_STD, UNLIMITED_STD
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import ADC_BITS

Corners = tuple[Cell, Cell, Cell]


# [log] Deviation of an untouched cell since rest was read, some seconds ago. Chosen: a fifth of
# REST_STD, which is for hours.
DRIFT_STD: Final = 0.01

# Presses.
# [S] A firm press conducts more. Chosen: 20 times a cell at rest.
PRESSED_SIEMENS: Final = 2e-5
# [1] No other cell conducts more than this share of the weakest corner: else it is pressed, too.
# Chosen: three fingers press alike.
FOURTH_SHARE: Final = 0.5
# [1] Corners were pressed in passing if they are pressed in less than this share of a look's scans,
# or of as many scans as the corners that were held the longest. Chosen: what is held has far more.
HELD_SHARE: Final = 0.5

# The fit. Its steps are at most MAX_ITERATIONS and no longer than MAX_STEP_LOG, as in estimators.
# [log] The step that is shorter is the last. Chosen: far below any deviation.
CLOSE_STEP: Final = 1e-4


def _ports(
    ratio: Float, std_lsb: Float | float, matrix: Estimator, lead_ohm: float
) -> tuple[Float, Float, Float]:
    """Port resistances less leads, their deviations [ohm], log resistances of cells; (RC,) each.

    ratio: mean readings, (R, C, 4).
    std_lsb: deviation of a port's reading, one for all or (R, C).
    matrix: the method by that name, which knows the references.
    lead_ohm: lead of each line.

    The currents are those that estimators use: the converter's offset and what floating lines draw
    are taken out of them.
    """
    skin = matrix.knowledge
    # Port and references in series; finite, though a port may show no current.
    loop_ohm = (1 / np.maximum(PortReader(skin).read(ratio).current, 1e-9)).ravel()
    std_siemens = current_std(2.0**-ADC_BITS, skin.ref_top_ohm, skin.ref_bottom_ohm)
    log_ohm = -np.log(matrix.estimate(ratio).cell_siemens.ravel())
    port_ohm = loop_ohm - skin.ref_ohm - 2 * lead_ohm
    return port_ohm, std_siemens * np.ravel(std_lsb) * loop_ohm**2, log_ohm


def suggested_corners(rows: int, columns: int) -> Corners:
    """Where to press: far from the electrodes, where wires are long, and apart from each other.

    The sides are the last line of each layer and one that is nearly half of the skin before it. On
    a small skin it is at least two lines before, so that fingers have room, or line 0.

    :raises ValueError: a skin of one row or column has no rectangle.
    """
    if min(rows, columns) < 2:
        raise ValueError(f"a {rows}x{columns} skin has no rectangle whose corners could be pressed")
    row, column = (max(0, count - 1 - max(2, count // 2 - 1)) for count in (rows, columns))
    return (row, column), (row, columns - 1), (rows - 1, column)


def moved_across(corners: Corners) -> Corners:
    """The fourth corner between the other two, in place of the one that was between them.

    The wires that these three show are those of the rectangle's other two sides.
    """
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
    for corner, beside, below in permutations(cells):  # they come by conductance, not by place
        if beside[0] == corner[0] and below[1] == corner[1]:
            return corner, beside, below
    return None


class CornerScans:
    """Scans while somebody presses three corners of a rectangle, and then moves one across.

    wanted: the corners to press next.
    pressed: all cells that the last scan shows pressed.
    hold: whether these are three corners, which should be held still until they have been read.
    read: the corners that have been read: any three first, then the next ones, and all is done.

    :raises ValueError: a skin of one row or column has no rectangle.
    """

    def __init__(self, board: Hello, own_lead_ohm: Float | None = None) -> None:
        """own_lead_ohm: what single leads have above the nominal one (`SkinKnowledge`)."""
        self.wanted = suggested_corners(board.rows, board.columns)
        self.pressed: tuple[Cell, ...] = ()
        self.read: list[Corners] = []
        self.hold = False
        self._board = board
        self._matrix = make_estimator("matrix", SkinKnowledge.of(board, own_lead_ohm=own_lead_ohm))
        self._codes: defaultdict[Corners, list[Float]] = defaultdict(list)

    @property
    def done(self) -> bool:
        """Whether corners have been read twice."""
        return len(self.read) > 1

    def take(self, scan: Scan) -> None:
        """Keep a scan if three corners are pressed in it, and nothing else is.

        Corners that were held for NOISE_S are read, and `wanted` becomes those across. As long as
        the ones just read stay pressed, their scans are kept, too, but nobody is asked to hold.
        """
        siemens = self._siemens(scan.codes)
        self.pressed = Place.of_cells(siemens > PRESSED_SIEMENS).cells
        corners = pressed_corners(siemens)
        self.hold = corners is not None and corners not in self.read[-1:]
        if corners is None:
            return
        self._codes[corners].append(scan.codes.astype(np.float64))
        if self.hold and len(self._codes[corners]) >= NOISE_S * self._board.rate_hz:
            self.read.append(corners)
            self.hold, self.wanted = False, moved_across(corners)

    def _siemens(self, codes: ArrayLike) -> Float:
        """Conductances (R, C) [S]; zeros for another size: the board was reset meanwhile."""
        ratio = ratio_from_codes(codes, self._board.adc_bits)
        if ratio.shape[:2] != (self._board.rows, self._board.columns):
            return np.zeros(ratio.shape[:2])
        return self._matrix.estimate(ratio).cell_siemens

    def examine_settling(self, looks: Sequence[Look | None], diagnosis: Diagnosis) -> None:
        """Add a finding if readings of pressed corners change with a longer settle time.

        looks: by turns as usual and with the longer time. A hand drifts alike in both, and the
        scatter among looks of one kind shows by how much.
        """
        # By corners: the means of each look as usual, and of each one with the longer time.
        means: defaultdict[Corners, list[list[Float]]] = defaultdict(lambda: [[], []])
        for turn, look in enumerate(looks):
            held = defaultdict(list)
            for codes in () if look is None else look.codes:
                if corners := pressed_corners(self._siemens(codes)):
                    held[corners].append(codes)
            for corners, scans in held.items():
                if look is not None and len(scans) >= HELD_SHARE * len(look.codes):
                    means[corners][turn % 2].append(np.mean(scans, axis=0))
        # Of each of the corners: the change of their readings, noise and drift apart, and as it is.
        changes = []
        for of_corners in means.values():
            if min(map(len, of_corners)) > 1:  # one look of a kind shows no scatter
                before, after = (np.mean(turns, axis=0) for turns in of_corners)
                variance = sum(np.var(turns, axis=0, ddof=1) / len(turns) for turns in of_corners)
                change = np.abs(after - before).max()
                changes.append((change - FEW_STDS * np.max(variance) ** 0.5, change))
        if not changes or looks[0] is None or looks[1] is None:
            return  # corners were not held in enough looks of both kinds
        clear_lsb, change_lsb = map(float, max(changes))
        diagnosis.measured["settling_pressed_lsb"] = round(max(clear_lsb, 0.0), 2)
        if clear_lsb > PRESSED_LSB:
            values = settling_values(looks[0], looks[1], change_lsb)
            diagnosis.add(
                Kind.SETTLING_PRESSED, most_lsb=PRESSED_LSB, mean=False, pressed=True, **values
            )

    def measure(self, rest: Rest) -> list[WireShare]:
        """The share of all wires, then that of each row and column; empty if none was pressed."""
        lead_ohm, lead_std_ohm = rest.lead_ohm
        at_rest = _ports(rest.ratio, rest.std_lsb, self._matrix, lead_ohm)
        most = max(map(len, self._codes.values()), default=0)
        measured = []
        for corners, codes in self._codes.items():
            if len(codes) < HELD_SHARE * most:
                continue
            # A hand trembles. So codes round up and down, as with noise, and rounding leaves a
            # smaller error in the mean. But the trembling itself is no error of the mean, because
            # all readings follow it together.
            scatter_lsb = np.maximum(np.std(codes, axis=0), rest.noise_lsb)
            variance = np.mean(rounding_std_lsb(scatter_lsb) ** 2, axis=-1)
            std_lsb = np.sqrt(variance + rest.noise_lsb**2 / len(codes))
            ratio = ratio_from_codes(np.mean(codes, axis=0), self._board.adc_bits)
            pressed = _ports(ratio, std_lsb, self._matrix, lead_ohm)
            free = self._free(corners)
            found = _pressed_fit(at_rest, pressed, free, rest.wire_ohm, lead_std_ohm)
            measured.append((corners[0], *found))
        return shares_of(measured)

    def _free(self, corners: Corners) -> Bool:
        """Cells that may be pressed, (R, C): the corners, and their neighbours for wide fingertips.

        The fourth corner and its neighbours are not among them, since its current tells the wires.
        A corner is free even if it is a neighbour of the fourth, as on the smallest skin.
        """
        rows, columns = np.indices((self._board.rows, self._board.columns))
        *near, near_fourth = (
            np.maximum(np.abs(rows - row), np.abs(columns - column)) <= 1
            for row, column in (*corners, moved_across(corners)[0])
        )
        free = np.any(near, axis=0) & ~near_fourth
        free[tuple(np.transpose(corners))] = True
        return np.asarray(free)


def shares_of(measured: Sequence[tuple[Cell, float, float]]) -> list[WireShare]:
    """The share of all wires that were seen, if any, then that of each row and column.

    measured: row and column of the corner between the others, y, and the deviation of y.

    All wires together are the mean by precision. If this mean explains each of them, only the mean
    can be a finding; if not, only single rows and columns can, and the mean is not known.
    """
    if not measured:
        return []
    logs, log_stds = (np.array([one[at] for one in measured]) for at in (1, 2))
    weights = log_stds**-2.0
    mean, mean_std = float(np.average(logs, weights=weights)), float(np.sum(weights) ** -0.5)
    alike = bool(np.all(np.abs(logs - mean) < FEW_STDS * log_stds))

    def share_at(place: Place, log: float, log_std: float, may_differ: bool) -> WireShare:
        least = max(float(np.log(1 + CHANGED_SHARE)), FEW_STDS * log_std)
        is_known, share = log_std <= KNOWN_STD, float(np.exp(log))
        differs = may_differ and is_known and abs(log) > least
        return WireShare(place, share, share * log_std, is_known, differs)

    lines = [share_at(Place((i,), (j,)), y, std, not alike) for (i, j), y, std in measured]
    whole = share_at(WHOLE_SKIN, mean, mean_std, alike)
    return [replace(whole, known=whole.known and alike), *lines]


def _pressed_fit(
    rest: tuple[Float, ...],
    pressed: tuple[Float, ...],
    free: Bool,
    wire_ohm: tuple[float, float],
    lead_std_ohm: float,
) -> tuple[float, float]:
    """y and its deviation: how the wires differ from nominal ones, by pressed corners.

    rest, pressed: what `_ports` gives of the untouched and of the pressed skin.
    free: which cells may be pressed, (R, C).
    wire_ohm: nominal wires of a segment, top and bottom.
    lead_std_ohm: deviation of a line's lead, which all lines have alike.
    """
    shape, free = free.shape, free.ravel()
    (rest_ohm, rest_std, untouched), (port_ohm, port_std, touched) = rest, pressed
    log_share = 0.0  # y
    lift = np.where(free, touched - untouched, 0.0)  # p, first as if wires were nominal
    variance = np.where(free, UNLIMITED_STD, DRIFT_STD) ** 2  # V
    for _ in range(MAX_ITERATIONS):
        top, bottom = (np.full(shape, ohm * np.exp(log_share)) for ohm in wire_ohm)
        before, now = (
            PortCircuit(np.exp(-cell).reshape(shape), top, bottom)
            for cell in (untouched, untouched + lift)
        )
        at_rest = np.linalg.inv(before.by_cell())  # B0^-1
        by_cell = now.by_cell()  # B1
        through = by_cell @ at_rest  # B1 B0^-1
        by_rest_wires = before.by_wires()  # W0
        off_rest = rest_ohm - before.port_ohm  # z0
        residual = port_ohm - now.port_ohm - through @ off_rest  # r
        by_segment = now.by_wires() - through @ by_rest_wires  # W
        slopes = by_segment.sum(axis=1)  # w
        spread = by_cell * variance  # B1 V
        covariance = spread @ by_cell.T + SEGMENT_STD**2 * by_segment @ by_segment.T
        covariance += (through * rest_std**2) @ through.T + np.diag(port_std**2)
        by_lead = 2 * lead_std_ohm * (1 - through.sum(axis=1))  # l d
        covariance += np.outer(by_lead, by_lead)
        weighed = np.linalg.solve(covariance, np.column_stack([slopes, residual]))
        precision = float(slopes @ weighed[:, 0]) + UNLIMITED_STD**-2
        pull = float(slopes @ weighed[:, 1]) - log_share * UNLIMITED_STD**-2
        step = float(np.clip(pull / precision, -MAX_STEP_LOG, MAX_STEP_LOG))
        log_share += step
        untouched = untouched + at_rest @ (off_rest - step * by_rest_wires.sum(axis=1))
        # The presses that, with this dy, best explain r. Those of untouched cells are small, and
        # stay in the covariance.
        lift_step = spread.T @ (weighed[:, 1] - step * weighed[:, 0])
        lift += np.where(free, np.clip(lift_step, -MAX_STEP_LOG, MAX_STEP_LOG), 0.0)
        if abs(step) < CLOSE_STEP:
            break
    # Readings that may contradict the model: one for each cell that is not free, less one for y.
    misfit = float(residual @ weighed[:, 1]) / max(int((~free).sum()) - 1, 1)
    return log_share, (max(misfit, 1.0) / precision) ** 0.5
