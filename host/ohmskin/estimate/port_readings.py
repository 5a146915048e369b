# SPDX-License-Identifier: Apache-2.0
"""From a frame's readings to one current per port, and what no touches can make of a skin.

Symbols: y (R, C, 4) readings, s their standard deviation; o the offset of each sense node, median
of its cells; I, I_rest (R, C) port currents per Vdd, now and at rest, and s_I theirs [S].

    v_cell = sum_k (y_k - o_k - y_k(I))^2 / (3 - 2 / RC)      v is that of the usual cell
    s_I^2 = max(v_cell, v) / sum R_k^2 + max(0, s^2 - v / 2) (sum R_k / sum R_k^2)^2

Lines that float charge through the skin until they have settled, from the row as far as that
conducts to them, and from the column. So the currents at both ends differ, by 2 q on average over
both polarities, and the mean of all four is wrong. With I_row the sum of the row's other port
currents, and I_column of the column's, it is corrected by

    q (I_row - I_column) / (I_row + I_column) .

What is left of that, and the converter's curve, stay from frame to frame, while noise changes.
Where the change since the frame before, or rounding, is much less, v_n < SLOW v,

    s_I^2 = (v_n + SLOW_SHARE^2 max(0, v_cell - v_n)) / sum R_k^2 + ...

Without noise, the four readings of a cell round alike: they agree, and their mean is no better than
one. Noise makes them disagree and round differently. Where v is the variance s^2 of rounding twice,
their errors are independent. (Exact at both ends; between them, s_I is 1.0 to 1.2 times too large.)

Sensed at far ends, a cell is by itself: with D the voltage between the sensed ends, its current
without wires, and what the wires lose, are

    u = I / (D + R I) ,  R = R_top + R_bottom ,    p = (a - e) / I ,    q = (f - b) / I ,
    s_u^2 = (D^2 s_I^2 + 2 I^2 s^2) / (D + R I)^4 .

There a node is read at one supply only. What a and b have in common may be an offset of all four
readings, or be of lines that charge. Neither moves I or D; `far_wires` tells them apart.

A frame is at fault, and its answer not to be relied on, where

- the readings of most cells disagree by far more than noise, or those of one cell so that no three
  of the four agree (one that is stuck is left out);
- a current is below that at rest: lowering resistances lowers the resistance between any two
  electrodes (Rayleigh's monotonicity law), so touches do not do that, but open lines do;
- two lines that differed at rest draw the same current from every other, and all of it more than
  at rest: shorted electrodes; or they did so at rest already, and more than the other lines. A
  finger between two lines makes them alike for a moment: lines that frames have shown apart must
  be alike for `ALIKE_FRAMES`;
- a port has less resistance than it had if every cell were pressed as hard as can be, by the same
  law: a row shorted to a column;
- a line showed no current at rest, though others did;
- a far end has a potential that is not between those of the near ends: it is open, or of another
  line.
"""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import (
    EXCHANGED,
    NEAR,
    READING_OFFSET,
    READING_SENSES_TOP,
    READING_SIGN,
    READINGS_PER_CELL,
    PortCircuit,
    as_near,
    node_ratio,
    reference_ohm,
)
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.prior import HIGHEST_TOUCH_SIEMENS

_MEDIAN_CHI2: Final = {1: 0.455, 3: 2.366}  # by degrees of freedom
# Sign of a reading in what the other lines draw: more at the top node, less at the bottom one.
_DRAWN: Final = READING_SIGN * np.where(READING_SENSES_TOP, 1.0, -1.0)
# Variances of rounding, and of the median cell: a cell that disagrees by more is not usual.
_MOST_USUAL: Final = 9.0
MOST_OFFSET: Final = 0.008  # of a sense node, ratio to Vdd: what is above it counts as noise
# A disagreement that stays from frame to frame comes from lines that charge slowly, or from the
# converter's curve: share of it that is in the current (measured in firmware/sim, preset `desk`).
SLOW_SHARE: Final = 0.12
SLOW: Final = 0.25  # share of the variance that changes: with less, most of it stays
# Disagreement of a cell's readings, root of its mean square, ratio to Vdd: of most cells, of one.
DISAGREE_ALL: Final = 0.016
DISAGREE_ONE: Final = 0.03
DISAGREE_OVER_NOISE: Final = 6.0
AGREE: Final = 4.0  # deviations of a reading: three that disagree by less agree
DROP_SHARE: Final = 0.85  # of the current at rest, below which drift is no explanation
CLEAR_STDS: Final = 5.0  # deviations that are more than noise
# Joined electrodes give the same code, or differ by noise; one code is 3.5 deviations of rounding.
SAME_STDS: Final = 3.4
RISE_SHARE: Final = 1.15  # of the current at rest: shorted lines draw more, all of them
ALIKE_FRAMES: Final = 270  # three seconds at 90 Hz: a finger does not lie that evenly for longer
PAIR_SHARE: Final = 1.15  # of the median line's current: lines that were shorted at rest draw more
WIRE_SHARE: Final = 0.5  # of the nominal wires: a skin has no less, if all of it is pressed


@dataclass(frozen=True, eq=False)
class PortReadings:
    """One frame: ratio (R, C, 4); current, its standard deviation [S] (R, C); fault, or empty.

    far: whether rows, and columns, are sensed at their far ends. Then current is that of the cell
    without these wires, drop_ohm (2, R, C) what the wires of row and column lose per current, and
    drop_std (R, C) the deviation of both [ohm], drop_shift (R, C) that of an offset that the row's
    may have too much of, and the column's too little.
    """

    ratio: Float
    current: Float
    current_std: Float
    fault: str = ""
    far: tuple[bool, bool] = (False, False)
    drop_ohm: Float = field(default_factory=lambda: np.zeros((2, 0, 0)))
    drop_std: Float = field(default_factory=lambda: np.zeros((0, 0)))
    drop_shift: Float = field(default_factory=lambda: np.zeros((0, 0)))


class PortReader:
    """Reads the frames of a skin, and compares them with its rest readings and its wires."""

    def __init__(self, known: SkinKnowledge) -> None:
        shape, names = (known.rows, known.columns), known.reading_names
        has = {node: node in names or low in names for node, low in EXCHANGED.items()}
        if not (has["a"] and has["b"]):
            raise ValueError(f"readings {' '.join(names)}: of each near end, one is needed")
        self._names, self.far = names, (has["e"], has["f"])
        ends = READINGS_PER_CELL if names == NEAR else 2
        self._degrees, self._is_near = ends - 1, names == NEAR
        self._slow_share = np.full(shape, SLOW_SHARE)
        if not self._is_near:
            # In one of two passes, the first port has settled while the board waited for the scan.
            self._slow_share[0, 0] = 1.0
        self._ref_ohm = (known.ref_top_ohm, known.ref_bottom_ohm)
        self._ratio_std, self._current_std = known.ratio_std, known.current_std
        reference = reference_ohm(*self._ref_ohm)[:ends]
        self._drawn = _DRAWN[:ends] / reference / ends
        self._slope, self._level = READING_SIGN[:ends] * reference, READING_OFFSET[:ends]
        self._ref_square = float(np.sum(reference**2))
        self._highest_current: Float = np.full(shape, np.inf)
        if known.nominal_wire_ohm.both is not None:
            top, bottom = (WIRE_SHARE * ohm for ohm in known.nominal_wire_ohm.both)
            pressed = PortCircuit(np.full(shape, HIGHEST_TOUCH_SIEMENS), top, bottom)
            self._highest_current = 1.0 / (pressed.port_ohm.reshape(shape) + known.ref_ohm)
        self._rest: PortReadings | None = None
        self._rest_fault = ""
        self.reset()
        if known.rest_ratio is not None:
            self._rest = rest = self._read_near(known.rest_ratio, in_order=False)[0]
            self._rest_apart = [self._apart(rest, axis) for axis in (0, 1)]
            self._rest_fault = self._fault_at_rest(rest)

    def reset(self) -> None:
        """Forget the frames before: the last, and which lines they have shown apart."""
        self._residual: Float | None = None
        self._alike_frames = [np.asarray(ALIKE_FRAMES), np.asarray(ALIKE_FRAMES)]

    def read(self, ratio: Float, *, in_order: bool = False) -> PortReadings:
        """Currents of checked readings (R, C, 4), and what is wrong with them.

        in_order: they are of the frame after the last such, and what has changed is noise. Others
        are of rest: where they lie between codes, they are a mean of many scans, with little noise.
        """
        found, noise, usual, variance, offset = self._read_near(ratio, in_order=in_order)
        if not any(self.far):
            return found
        current = np.maximum(found.current, self._current_std)
        # What near ends have in common is of lines that charge, or an offset.
        near = 1.0 - self._ref_ohm[0] * current, self._ref_ohm[1] * current
        ends = [
            node_ratio(ratio, self._names, node) if is_far else by_current
            for node, is_far, by_current in zip("ef", self.far, near, strict=True)
        ]
        apart = np.maximum(ends[0] - ends[1], 0.0)
        whole = apart + sum(self._ref_ohm) * current
        # Of the difference of two readings: half of what stays is in both.
        variance = 2.0 * noise + 0.5 * np.maximum(variance - noise, 0.0)
        variance = np.maximum(variance, 2.0 * self._ratio_std**2)
        std = np.sqrt(apart**2 * found.current_std**2 + variance * current**2) / whole**2
        drop = np.stack([near[0] - ends[0], ends[1] - near[1]])
        drop_std = np.sqrt(variance)
        fault = found.fault or self._astray(drop, drop_std)
        # Of an offset, which these near ends have not, but far ends may have.
        shift = (usual + offset * offset) ** 0.5
        drops = drop / current, drop_std / current, shift / current
        return PortReadings(ratio, current / whole, std, fault, self.far, *drops)

    def _astray(self, drop: Float, std: Float) -> str:
        """Lines whose far ends are not between the near ends."""
        for axis, line in enumerate(("row", "column")):
            below = (drop[axis] + CLEAR_STDS * std).sum(axis=1 - axis)
            if below.min() < 0:
                return f"{line} {below.argmin()}: its far end does not follow it, is it open?"
        return ""

    def _read_near(
        self, ratio: Float, *, in_order: bool
    ) -> tuple[PortReadings, float, float, Float, float]:
        """What near ends show; variances of noise, usual, and of what is off; their offset [1]."""
        if not self._is_near:
            ratio = as_near(ratio, self._names)[..., :2]
        current: Float = (ratio - self._level) @ self._slope / self._ref_square
        residual = ratio - self._level - current[..., None] * self._slope
        # Currents do not show a node's offset: its two readings, A and D, B and C, have it alike.
        both = 0.5 * (residual[..., :2] + residual[..., :-3:-1]).reshape(-1, 2)
        order = [0, 1, 1, 0][: residual.shape[-1]]
        offset = np.partition(both.T, len(both) // 2)[order, len(both) // 2]
        offset = np.minimum(np.maximum(offset, -MOST_OFFSET), MOST_OFFSET)
        residual -= offset
        square = np.einsum("ijk,ijk->ij", residual, residual)
        middle = square.size // 2
        typical = float(np.partition(square, middle, axis=None)[middle])
        degrees = max(self._degrees - residual.shape[-1] / (2.0 * square.size), 0.5)
        own, rounding = square / degrees, self._ratio_std**2
        most = _MOST_USUAL * max(rounding, typical / _MEDIAN_CHI2[self._degrees])
        small = own[own <= most]
        usual = float(small.sum()) / small.size  # faster than mean
        noise, variance = usual, np.maximum(own, usual)
        least = 2.0 * rounding
        if least < SLOW * usual:  # else rounding and the noise of a converter explain it
            current -= residual @ self._drawn * _more_by_row(current)
            changing = self._noise(residual) if in_order else self._noise_at_rest(ratio)
            if (changing := max(changing, least)) < SLOW * usual:
                noise, stays = changing, np.maximum(own - changing, 0.0)
                variance = noise + self._slow_share**2 * stays
        if in_order:
            self._residual = residual
        alike = max(0.0, 1.0 - noise / (2.0 * rounding))
        std = np.sqrt(variance / self._ref_square + alike * self._current_std**2)
        fault = self._disagreement(current, std, ratio, square, typical) or self._rest_fault
        found = PortReadings(ratio, current, std)
        if not fault:
            fault = self._short(found) or (self._change(found) if self._rest is not None else "")
        found = replace(found, fault=fault) if fault else found
        return found, noise, usual, variance, float(offset[0])

    def _noise(self, residual: Float) -> float:
        """Variance of a reading [1], from what has changed since the frame before."""
        if self._residual is None:
            return np.inf
        change = residual - self._residual
        square = np.einsum("ijk,ijk->ij", change, change)
        middle = square.size // 2
        return float(np.partition(square, middle, axis=None)[middle]) / (
            2.0 * _MEDIAN_CHI2[self._degrees]
        )

    def _noise_at_rest(self, ratio: Float) -> float:
        """The same of readings at rest: little in a mean of many scans, else not known."""
        code = ratio / (self._ratio_std * 12**0.5) - 0.5
        return 0.0 if np.abs(code - np.rint(code)).max() > 0.01 else np.inf

    def _disagreement(
        self, current: Float, std: Float, ratio: Float, square: Float, typical: float
    ) -> str:
        """Readings that disagree; leaves out, in `current` and `std`, one that three others do not
        agree with.
        """
        most = (typical / self._degrees) ** 0.5
        # Far multiplexers double what charges.
        times = 1.0 if self._is_near else 2.0
        if most > times * DISAGREE_ALL:
            return f"the readings of most cells disagree, by {100 * most:.0f} % of Vdd"
        limit = max(times * DISAGREE_ONE, DISAGREE_OVER_NOISE * most)
        if square.max() <= self._degrees * limit**2:
            return ""
        fault = ""
        for index in np.flatnonzero(square > self._degrees * limit**2):
            cell = np.unravel_index(index, square.shape)
            off, without = self._without_one(ratio[cell]) if self._is_near else (np.inf, 0.0)
            if off < max(AGREE * self._ratio_std, DISAGREE_OVER_NOISE * most):
                current[cell] = without
                std[cell] = 2.0 * std.min()
            else:
                by = 100 * float(square[cell] / self._degrees) ** 0.5
                fault = f"{cell_of(index, square)}: its readings disagree by {by:.0f} % of Vdd"
        return fault

    def _without_one(self, ratio: Float) -> tuple[float, float]:
        """How the three of four readings disagree that agree best, and their current."""
        found = []
        for left_out in range(READINGS_PER_CELL):
            kept = np.arange(READINGS_PER_CELL) != left_out
            slope, level = self._slope[kept], (ratio - self._level)[kept]
            current = float(slope @ level / (slope @ slope))
            off = level - slope * current
            found.append((float(off @ off / (kept.sum() - 1)) ** 0.5, current))
        return min(found)

    def _short(self, found: PortReadings) -> str:
        """A port with less resistance than a skin can have."""
        excess = found.current - self._highest_current - CLEAR_STDS * found.current_std
        worst = excess.argmax()
        if excess.flat[worst] <= 0:
            return ""
        return f"{cell_of(worst, excess)}: less resistance than wires have: row and column shorted?"

    def _change(self, found: PortReadings) -> str:
        """What has changed since rest, and no touch can have."""
        rest = self._rest
        assert rest is not None
        std = np.hypot(found.current_std, rest.current_std)
        drop = DROP_SHARE * rest.current - found.current - CLEAR_STDS * std
        worst = drop.argmax()
        if drop.flat[worst] > 0:
            if np.count_nonzero(drop > 0) > 0.5 * drop.size:
                return "the whole skin conducts less than at rest: take the rest readings anew"
            return f"{cell_of(worst, drop)}: conducts less than at rest, is a line open?"
        risen = found.current > RISE_SHARE * rest.current
        for axis, line in enumerate(("row", "column")):
            up = np.asarray(risen.all(axis=1 - axis))
            frames = self._alike_frames[axis]
            # Lines once shown apart matter again where two conduct more in all their ports.
            known = frames.max() < ALIKE_FRAMES and np.count_nonzero(up) < 2
            if known or found.current.shape[1 - axis] < 3:
                continue
            apart = self._apart(found, axis)
            # By the deviations of this frame, perhaps nobody can tell.
            coarser = float(np.max(np.maximum(found.current_std, self._current_std)))
            coarser /= float(np.max(np.maximum(rest.current_std, self._current_std)))
            apart[self._rest_apart[axis] <= 2 * SAME_STDS * max(coarser, 1.0)] = np.inf
            # Between one and two times the limit, noise may be what differs.
            self._alike_frames[axis] = frames = np.where(apart > 2 * SAME_STDS, 0, frames + 1)
            apart[frames < ALIKE_FRAMES] = np.inf
            if pair := _alike(apart, up, line):
                return f"{pair} read alike as they did not at rest: shorted?"
        return ""

    def _apart(self, ports: PortReadings, axis: int) -> Float:
        """Largest difference between the currents of two rows (axis 0) or columns, (lines, lines).

        Over its deviation, or that of rounding if it is larger.
        """
        current, std = ports.current, np.maximum(ports.current_std, self._current_std)
        if axis:
            current, std = current.T, std.T
        difference = np.abs(current[:, None, :] - current)
        difference /= np.maximum(std[:, None, :], std)
        return np.asarray(difference.max(axis=2))

    def _fault_at_rest(self, rest: PortReadings) -> str:
        clear = rest.current / rest.current_std
        for axis, line in enumerate(("row", "column")):
            most = clear.max(axis=1 - axis)
            dark = (most < CLEAR_STDS) & (float(np.median(most)) > 4 * CLEAR_STDS)
            if dark.any():
                return f"{line} {int(dark.argmax())} conducted nothing at rest: is it open?"
            current = rest.current if axis == 0 else rest.current.T
            lines, ports = current.shape
            up = np.all(current > PAIR_SHARE * np.median(current, axis=0), axis=1)
            if lines < 4 or ports < 3:
                continue
            if pair := _alike(self._rest_apart[axis], up, line):
                return f"{pair} conducted alike at rest, and more than others"
        return ""


def _more_by_row(current: Float) -> Float:
    """How much more of what other lines draw comes from the row than from the column, (R, C)."""
    by_row, by_column = (current.sum(axis=axis, keepdims=True) - current for axis in (1, 0))
    more = (by_row - by_column) / np.maximum(by_row + by_column, 1e-12)
    return np.asarray(np.clip(more, -1.0, 1.0))


def _alike(apart: Float, up: NDArray[np.bool_], line: str) -> str:
    """The first two of the lines `up` that read alike, in words; empty if there are none."""
    alike = apart < SAME_STDS
    if not alike.any():
        return ""
    pairs = np.argwhere(np.triu(alike & up & up[:, None], 1))
    return f"{line}s {pairs[0][0]} and {pairs[0][1]}" if len(pairs) else ""


def cell_of(index: int | np.intp, array: Float) -> str:
    """The cell of this flat index into an array (R, C), in words."""
    row, column = np.unravel_index(index, array.shape)
    return f"cell ({row}, {column})"
