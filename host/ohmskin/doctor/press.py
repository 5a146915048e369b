# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin, from three corners of a rectangle that are pressed at once.

A cell hides the wires behind it: an untouched one by its megohm, a pressed one because its own
resistance is in the same reading. Three corners of a rectangle do not: with (a, b) the one between
the other two, (a, b') and (a', b), the current of the fourth goes through all three in series, so
that four ports see three unknown cells. But for the untouched cells,

    rho[a,b] + rho[a,b'] + rho[a',b] - rho[a',b'] = 2 (top + bottom)

with top the wire of row a from its electrode up to the nearer of columns b and b', and bottom that
of column b up to the nearer of rows a and a'. So only the sum of both layers is seen, and they are
taken to have changed alike.

Symbols

====== =========== ====================================================================
symbol shape       meaning                                                     unit
====== =========== ====================================================================
y      ()          log of the wires over nominal
c      (RC,)       log resistances of the untouched cells
u      (RC,)       what a press adds to it; 0 but for the free cells
z0, z1 (RC,)       port resistances read, less those of the model: untouched, pressed [ohm]
B0, B1 (RC, RC)    slopes of the model by the cells' log resistances [ohm]
W0, W1 (RC, 2RC)   slopes of the model by the segments' log resistances [ohm]
n0, n1 (RC,)       deviations of what was read [ohm]
====== =========== ====================================================================

Gauss-Newton. The untouched cells follow from what was read of them, dc = B0^-1 (z0 - W0 dy), so

    r = z1 - B1 B0^-1 z0 = W dy + B1 du + noise ,   W = W1 - B1 B0^-1 W0

    S = n1^2 + B1 B0^-1 n0^2 B0^-T B1^T + SEGMENT_STD^2 W W^T + B1 V B1^T

with V wide for the free cells, narrow for others. With w the sum of W over all segments,
dy = w^T S^-1 r / (w^T S^-1 w), but for a weak prior of y. Free are the three cells and their
neighbours, since a fingertip may press these as well. What stays unexplained widens the deviation.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import current_std, port_sensitivity
from ohmskin.doctor.findings import NOT_KNOWN, Finding
from ohmskin.doctor.signal import rounding_std_lsb
from ohmskin.doctor.wires import CHANGED, KNOWN, TO_DO, port_ohm
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.prior import SEGMENT_STD, UNLIMITED_STD
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan

Cell = tuple[int, int]
Corners = tuple[Cell, Cell, Cell]

PRESSED_SIEMENS: Final = 2e-5  # firmly
FOURTH_SHARE: Final = 0.5  # of the weakest corner's conductance: so much any other cell may show
CLEAR_STDS: Final = 3.5
BEFORE_STD: Final = 2.0  # of y, before anything is pressed
DRIFT_STD: Final = 0.01  # log: of an untouched cell since it was read
MOST_STEPS: Final = 20
LONGEST_STEP: Final = 1.0
CLOSE: Final = 1e-4


@dataclass(frozen=True)
class PressedWires:
    """Log of the wires over nominal, and its deviation.

    where: whose wires these are: of a row and a column, or of all that were seen.
    """

    where: str
    log_share: float
    log_std: float

    @property
    def differ(self) -> bool:
        """Whether they clearly are not nominal."""
        least = max(float(np.log(1 + CHANGED)), CLEAR_STDS * self.log_std)
        return self.log_std <= KNOWN and abs(self.log_share) > least

    @property
    def share(self) -> str:
        """Over nominal, with the deviation."""
        if self.log_std > KNOWN:
            return f"{NOT_KNOWN}: press with something smaller than a cell, further apart"
        share = float(np.exp(self.log_share))
        return f"{share:.2f} +- {share * self.log_std:.2f} times nominal"

    def in_words(self, wire_ohm: tuple[float, float]) -> str:
        """For the page."""
        if self.log_std > KNOWN:
            return self.share
        top, bottom = (f"{np.exp(self.log_share) * ohm:.0f}" for ohm in wire_ohm)
        return f"{self.share}: top {top}, bottom {bottom} ohm a segment, if both changed alike"

    def finding(self, wire_ohm: tuple[float, float]) -> Finding:
        """That they are not nominal."""
        return Finding(
            *("wires", "warning", self.where, self.in_words(wire_ohm)),
            f"top {wire_ohm[0]:.0f}, bottom {wire_ohm[1]:.0f} ohm a segment",
            TO_DO,
        )


def all_of(seen: Sequence[PressedWires]) -> PressedWires:
    """All wires that were seen, taken for alike: the mean by precision."""
    precisions = [each.log_std**-2 for each in seen]
    mean = float(np.average([each.log_share for each in seen], weights=precisions))
    return PressedWires("rows and columns", mean, sum(precisions) ** -0.5)


def pressed_findings(seen: Sequence[PressedWires], wire_ohm: tuple[float, float]) -> list[Finding]:
    """What is not nominal: all of it alike, or some of it, where what was seen contradicts that."""
    together = all_of(seen)
    alike = all(
        abs(each.log_share - together.log_share) < CLEAR_STDS * each.log_std for each in seen
    )
    return [each.finding(wire_ohm) for each in ([together] if alike else seen) if each.differ]


@dataclass(frozen=True, eq=False)
class _Look:
    """Port resistances (RC,), their deviations, and log resistances of the cells by `matrix`."""

    port_ohm: Float
    std_ohm: Float
    cell: Float


def suggested_corners(rows: int, columns: int) -> Corners:
    """Where to press: far from the electrodes, and apart.

    :raises ValueError: a skin of one row or column has no rectangle.
    """
    if min(rows, columns) < 2:
        raise ValueError(
            f"the wires of a {rows}x{columns} skin cannot be measured by pressing it: there is no "
            "rectangle"
        )
    row, column = (max(0, count - 1 - max(2, count // 2 - 1)) for count in (rows, columns))
    return (row, column), (row, columns - 1), (rows - 1, column)


def moved_across(corners: Corners) -> Corners:
    """The same, with the corner between the others moved to the fourth: it shows other wires."""
    _, beside, below = corners
    return (below[0], beside[1]), below, beside


def pressed_corners(siemens: Float) -> Corners | None:
    """The firmly pressed cells of conductances (R, C), the one between the others first; None if
    they are not three corners of a rectangle.
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
    """Scans of a board as they come, and what they tell of its wires."""

    def __init__(self, board: Hello) -> None:
        self._board = board
        self._refs = (board.ref_top_ohm, board.ref_bottom_ohm)
        knowledge = SkinKnowledge(board.rows, board.columns, *self._refs, adc_bits=board.adc_bits)
        self._matrix = make_estimator("matrix", knowledge)
        self._codes: defaultdict[Corners, list[Float]] = defaultdict(list)
        self.pressed: tuple[Cell, ...] = ()

    def take(self, scan: Scan) -> Corners | None:
        """The corners that are pressed in a scan, the one between the others first, if they are
        three and nothing else is. `pressed` is all that is pressed. A scan of another size is left
        out: of a board that was reset meanwhile.
        """
        if scan.codes.shape[:2] != (self._board.rows, self._board.columns):
            return None
        siemens = self._matrix.estimate(scan.ratio).cell_siemens
        self.pressed = tuple(
            (int(row), int(column)) for row, column in np.argwhere(siemens > PRESSED_SIEMENS)
        )
        corners = pressed_corners(siemens)
        if corners is not None:
            self._codes[corners].append(scan.codes.astype(np.float64))
        return corners

    def scans(self, corners: Corners) -> int:
        """How many there are with these cells pressed."""
        return len(self._codes.get(corners, ()))

    def measure(
        self, rest_codes: Float, rest_scans: int, noise_lsb: float, wire_ohm: tuple[float, float]
    ) -> list[PressedWires]:
        """The wires against `wire_ohm` of a segment (top, bottom), once for each corners pressed.

        rest_codes: mean codes (R, C, 4) of the untouched skin.
        """
        rest = self._look(rest_codes, np.full(1, noise_lsb), noise_lsb, rest_scans)
        most = max(map(len, self._codes.values()), default=0)
        seen = []
        for corners, codes in self._codes.items():
            if len(codes) < most / 2:
                continue
            # A hand trembles: that evens rounding out, and is no noise, as all readings follow it.
            scatter_lsb = np.maximum(np.std(codes, axis=0), noise_lsb)
            pressed = self._look(np.mean(codes, axis=0), scatter_lsb, noise_lsb, len(codes))
            log_share, log_std = _fit(rest, pressed, _free(rest.cell.shape, corners), wire_ohm)
            row, column = corners[0]
            seen.append(PressedWires(f"row {row}, column {column}", log_share, log_std))
        return seen

    def _look(self, mean: Float, scatter_lsb: Float, noise_lsb: float, scans: int) -> _Look:
        bits = self._board.adc_bits
        ratio = ratio_from_codes(mean, bits)
        read_ohm = port_ohm(ratio, self._refs)
        variance = np.mean(rounding_std_lsb(scatter_lsb) ** 2, axis=-1) + noise_lsb**2 / scans
        std_siemens = current_std(1 / 2**bits, *self._refs) * np.sqrt(variance).ravel()
        std_ohm = std_siemens * (read_ohm + sum(self._refs)) ** 2
        return _Look(read_ohm, std_ohm, -np.log(self._matrix.estimate(ratio).cell_siemens))


def _fit(
    rest: _Look, pressed: _Look, free: NDArray[np.bool_], wire_ohm: tuple[float, float]
) -> tuple[float, float]:
    """y and its deviation."""
    shape = free.shape
    log_share = 0.0
    untouched = rest.cell.ravel()
    lift = np.where(free, pressed.cell - rest.cell, 0.0).ravel()
    variance = np.where(free, UNLIMITED_STD, DRIFT_STD).ravel() ** 2
    for _ in range(MOST_STEPS):
        top, bottom = (np.full(shape, ohm * np.exp(log_share)) for ohm in wire_ohm)
        before, now = (
            port_sensitivity(np.exp(-cell).reshape(shape), top, bottom)
            for cell in (untouched, untouched + lift)
        )
        at_rest = np.linalg.inv(before.by_cell)
        through = now.by_cell @ at_rest
        by_rest_wires = before.by_wires()
        off_rest = rest.port_ohm - before.port_ohm
        residual = pressed.port_ohm - now.port_ohm - through @ off_rest
        by_segment = now.by_wires() - through @ by_rest_wires
        slopes = by_segment.sum(axis=1)
        spread = now.by_cell * variance
        covariance = spread @ now.by_cell.T + SEGMENT_STD**2 * by_segment @ by_segment.T
        covariance += (through * rest.std_ohm**2) @ through.T + np.diag(pressed.std_ohm**2)
        weighed = np.linalg.solve(covariance, np.column_stack([slopes, residual]))
        known = float(slopes @ weighed[:, 0]) + BEFORE_STD**-2
        pull = float(slopes @ weighed[:, 1]) - log_share * BEFORE_STD**-2
        step = float(np.clip(pull / known, -LONGEST_STEP, LONGEST_STEP))
        log_share += step
        untouched = untouched + at_rest @ (off_rest - step * by_rest_wires.sum(axis=1))
        more = spread.T @ (weighed[:, 1] - step * weighed[:, 0])
        lift += np.where(free.ravel(), np.clip(more, -LONGEST_STEP, LONGEST_STEP), 0.0)
        if abs(step) < CLOSE:
            break
    misfit = float(residual @ weighed[:, 1]) / max(int((~free).sum()) - 1, 1)
    return log_share, (max(misfit, 1.0) / known) ** 0.5


def _free(shape: tuple[int, ...], corners: Corners) -> NDArray[np.bool_]:
    """Cells that may be pressed, (R, C): the corners and those around, but for the fourth's."""
    row, column = np.indices(shape)

    def around(cell: Cell) -> NDArray[np.bool_]:
        return np.asarray((np.abs(row - cell[0]) <= 1) & (np.abs(column - cell[1]) <= 1))

    free = around(corners[0]) | around(corners[1]) | around(corners[2])
    free &= ~around(moved_across(corners)[0])
    free[tuple(np.transpose(corners))] = True
    return free
