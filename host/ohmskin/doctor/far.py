# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin whose far ends are sensed, line by line, and what is wrong with far ends.

Symbols. A layer has L lines, rows or columns, of n crossings and n segments, the near end first.

====== ============ =====================================================================
symbol shape        meaning
====== ============ =====================================================================
I      (R, C)       current of a port per Vdd, from readings a and b [S]
u, s   (L, n)       (a - e) / I of rows, (f - b) / I of columns; deviations [ohm]
w      (L, n)       as u, with what the far node had at the cell before in place of e, f [ohm]
A      (L, n, n)    share of each port's current that goes through each segment of its line
r      (L, n)       segments [ohm]
m      (L,)         mean of a line's segments, or the usual one of the layer [ohm]
====== ============ =====================================================================

A far end carries no current, so that u = A r. An untouched skin draws current at all crossings of a
line, a touch draws it at its own. A follows from the cells, these from the ports less their wires,
and these from u: three times around. The cost |(u - A r) / s|^2 + |(r - m) / (SPREAD m)|^2, with m
free, tells r; with the usual m and one segment free, it finds a bad one. A far end is at fault if
neither fits, or less well than u = k w, which is of an end that floats. The circuit says what all
far ends have while a port is selected: if that of another line fits, the ends are swapped.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit import skin as circuit
from ohmskin.doctor.findings import Diagnosis, Kind, LineWire, Place
from ohmskin.doctor.signal import Rest
from ohmskin.doctor.wires import KNOWN
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.prior import SEGMENT_STD
from ohmskin.link.protocol import ADC_BITS

SPREAD: Final = 2 * SEGMENT_STD  # [1] Segments of a line scatter by up to this share of m.
MODEL_STD: Final = 0.01  # [1] A, and so A r, is known to this share.
ROUNDS: Final = 3  # [1] Each makes the error of A smaller by the share of the wires in a port.
OFFSET_LSB: Final = 4.0  # [LSB] Offset and gain of 2 LSB each: 1 - a has more by it, or b less.
LOST_CHI2: Final = 25.0  # [1] Five deviations: an end that is connected has less a reading.
MOST_LINE_OHM: Final = 50e3  # [ohm] A line of 16 segments of 2 kOhm has less.
CLEAR_STDS: Final = 5.0  # [deviations] Of hundreds of segments, none is so far off by chance.
ALIKE_COST: Final = 4.0  # [1] Two deviations: faults whose costs differ by less may be either.
CHANGED: Final = 0.25  # [1] A line that differs by less of its resistance is no fault.
LINE_STDS: Final = 3.5  # [deviations] It also differs by this.


class _Skin:
    """Readings of mode far, and of these the rows and columns that are kept."""

    def __init__(self, rest: Rest, kept: list[list[int]]) -> None:
        self.refs, ratio = (rest.board.ref_top_ohm, rest.board.ref_bottom_ohm), rest.ratio
        before = np.roll(ratio.swapaxes(0, 1).reshape(-1, 4), 1, axis=0)
        before = before.reshape(ratio.shape[1], -1, 4).swapaxes(0, 1)[np.ix_(*kept)]
        a, e, b, f = np.moveaxis(ratio[np.ix_(*kept)], -1, 0)
        near, drop = circuit.as_near(ratio[np.ix_(*kept)], "aebf"), np.stack([a - e, f - b])
        self.shape = a.shape[0], a.shape[1]
        self.current = np.maximum(circuit.current_from_ratio(near, *self.refs), 1e-9)
        std = np.hypot(2**0.5 * rest.std_lsb / 2**ADC_BITS, MODEL_STD * drop)
        floating = np.stack([a - before[..., 1], before[..., 3] - b])
        self.readings_ohm = np.stack([drop, std, floating], axis=1) / self.current
        known = SkinKnowledge(*self.shape, *self.refs, rest.board.adc_bits)
        self._matrix = make_estimator("matrix", known)
        self.cell_siemens = self._matrix.estimate(near).cell_siemens

    def layers(self, wire_ohm: Float) -> tuple[list[Float], list[Float]]:
        """A, u, s and w of the rows, and of the columns, if the segments are so, (2, R, C)."""
        refs_ohm = sum(self.refs)
        wired = circuit.PortCircuit(self.cell_siemens, *wire_ohm).port_ohm
        wired -= circuit.PortCircuit(self.cell_siemens, 0.0, 0.0).port_ohm
        port_ohm = np.maximum(1 / self.current - refs_ohm - wired.reshape(self.shape), 1.0)
        ratio = circuit.ratio_from_current(1 / (port_ohm + refs_ohm), *self.refs)
        self.cell_siemens = self._matrix.estimate(ratio).cell_siemens
        wired_skin = circuit.PortCircuit(self.cell_siemens, *wire_ohm)
        return (
            [wired_skin.line_current(0), *self.readings_ohm[0]],
            [wired_skin.line_current(1), *self.readings_ohm[1].swapaxes(1, 2)],
        )

    def ends(self, wire_ohm: Float) -> tuple[Float, Float]:
        """u of each far end (first axis) at the ports of each line, (R, R, C) and (C, C, R)."""
        rows, lines = self.shape[0], sum(self.shape)
        admittance = circuit.end_admittance(circuit.Skin(self.cell_siemens, *wire_ohm))
        by_line = circuit.impedance_of(admittance, rows)[0][:lines]
        ends = circuit.port_difference(by_line, rows).T.reshape(-1, *self.shape)
        row, column = np.indices(self.shape)
        at_row, at_column = ends[row, row, column], ends[rows + column, row, column]
        columns = ends[lines + rows :] - at_column
        return at_row - ends[lines : lines + rows], columns.swapaxes(1, 2)


def _fit(layer: list[Float], usual_ohm: float | None = None) -> tuple[Float, Float, Float]:
    """r, its covariance, and the cost, (L, ...), with m free. With the usual m, (n + 1, L, ...):
    each segment is free by turns, and last none is.
    """
    share, drop_ohm, std_ohm, _ = layer
    count = share.shape[-1]
    weighed = (share / std_ohm[..., None] ** 2).swapaxes(1, 2)
    pull, known = weighed @ drop_ohm[..., None], weighed @ share
    if usual_ohm is None:
        mean = (pull.sum(axis=1) / known.sum(axis=(1, 2))[:, None])[..., None]
        prior = (SPREAD * np.maximum(np.abs(mean), 1.0)) ** -2.0 * (np.eye(count) - 1 / count)
    else:
        mean = np.full((1, 1, 1), usual_ohm)
        prior = (SPREAD * usual_ohm) ** -2.0 * np.eye(count)
        prior = prior * (1 - np.eye(count + 1, count))[:, None, None]
    covariance = np.linalg.inv(known + prior)
    ohm = covariance @ (pull + prior.sum(axis=-1, keepdims=True) * mean)
    off = (drop_ohm - (share @ ohm)[..., 0]) / std_ohm
    cost = np.sum(off**2, axis=-1) + np.sum((ohm - mean) * (prior @ (ohm - mean)), axis=(-1, -2))
    misfit = np.maximum(cost / max(count - 1, 1), 1.0)
    return ohm[..., 0], covariance * misfit[..., None, None], cost


class _Layer:
    """The rows (axis 0) or the columns (axis 1) that are kept. joined: those that are shorted.

    told: the lines whose wire is told. lost: those whose far end is at fault.
    """

    def __init__(self, axis: int, kept: list[list[int]], joined: set[int], of: list[Float]) -> None:
        self.axis, self.numbers, self.across, self.of = axis, kept[axis], kept[1 - axis], of
        self.told = alone = np.array([number not in joined for number in self.numbers])
        _, drop_ohm, std_ohm, floating_ohm = of
        self.ohm, self.covariance, self.cost = _fit(of)
        least, count = self.cost, len(self.across)
        if len(alone) > 2:
            least = np.minimum(least, _fit(of, self.usual_ohm)[2].min(axis=0))
        weighed = floating_ohm / std_ohm**2
        k = np.sum(weighed * drop_ohm, 1) / np.maximum(np.sum(weighed * floating_ohm, 1), 1e-30)
        off = (drop_ohm - np.clip(k, 0, 1)[:, None] * floating_ohm) / std_ohm
        most = np.minimum(LOST_CHI2 * max(count - 1, 1), LOST_CHI2 + np.sum(off**2, axis=1))
        wrong = (least > most) | (np.abs(self.ohm.sum(axis=1)) > MOST_LINE_OHM)
        self.told, self.lost = alone & ~wrong, alone & wrong

    @property
    def usual_ohm(self) -> float:
        """The usual mean of a line's segments."""
        told = self.ohm[self.told] if self.told.any() else self.ohm
        return max(float(np.median(told.mean(axis=1))), 1.0)

    @property
    def wire_ohm(self) -> Float:
        """Segments (L, n); the usual ones of lines that are not told."""
        return np.maximum(np.where(self.told[:, None], self.ohm, self.usual_ohm), 0.0)

    def place(self, lines: Any) -> Place:
        """Lines that are kept, by number or mask."""
        named = tuple(np.array(self.numbers)[lines].tolist())
        return Place(columns=named) if self.axis else Place(rows=named)

    def examine_shorts(self, diagnosis: Diagnosis) -> None:
        """Say which lines are joined at their far ends: all current of the others' cells goes
        through all of a line. That of its own cells goes as far as these.
        """
        kind = (Kind.SHORT_ROWS, Kind.SHORT_COLUMNS)[self.axis]
        for short in [each for each in diagnosis.findings if each.kind is kind]:
            joined = short.place.columns if self.axis else short.place.rows
            n, others = self.numbers.index(joined[0]), len(joined) - 1
            least = float(self.of[0][n].sum(axis=1).mean())  # segments, if joined at near ends
            most = least + others * len(self.across)
            if self.of[1][n].mean() * len(joined) > self.usual_ohm * (least + most) / 2:
                diagnosis.findings.remove(short)
                diagnosis.add(Kind.SHORT_FAR, short.place)

    def examine_ends(self, ends_ohm: Float, diagnosis: Diagnosis) -> None:
        """Add far ends that do not show their lines. ends_ohm: as `_Skin.ends`."""
        chi2 = np.mean(((self.of[1] - ends_ohm) / self.of[2]) ** 2, axis=2)
        np.fill_diagonal(chi2, np.inf)
        self.lost &= [not self._is_broken(n, diagnosis) for n in range(len(self.lost))]
        swapped = self.lost & (chi2.min(axis=0) < LOST_CHI2)
        if swapped.any():
            diagnosis.add(Kind.SWAPPED_FAR, self.place(swapped))
        if (self.lost & ~swapped).any():
            diagnosis.add(Kind.OPEN_FAR, self.place(self.lost & ~swapped))

    def _is_broken(self, n: int, diagnosis: Diagnosis) -> bool:
        """Add a lost line that is dead from some cell on, in place of these dead cells."""
        [*found] = [each for each in diagnosis.findings if each.kind is Kind.DEAD_CELL]
        cells = {cell for each in found for cell in each.place.cells}
        mine = {cell[1 - self.axis]: cell for cell in cells if cell[self.axis] == self.numbers[n]}
        last = max((each for each in self.across if each not in mine), default=-1)
        beyond = [each for each in self.across if each > last >= 0]
        if beyond and self.lost[n]:
            diagnosis.add(Kind.BROKEN_YARN, self.place([n]), between=(last, beyond[0]))
            diagnosis.findings.remove(found[0])
            if rest := cells - {mine[each] for each in beyond}:
                place = Place(cells=tuple(sorted(rest)))
                diagnosis.add(Kind.DEAD_CELL, place, **found[0].values)
        return bool(beyond)

    def examine_wires(self, nominal_ohm: float | None, diagnosis: Diagnosis) -> None:
        """Add the wire of each line, and lines that are clearly not as others, or as nominal."""
        told, usual_ohm = np.flatnonzero(self.told), self.usual_ohm
        if nominal_ohm and told.size:
            self._compare(told, nominal_ohm, diagnosis)
        ohm, covariance, cost = _fit(self.of, usual_ohm)
        for n in told if len(self.told) > 2 else ():
            costs = cost[:-1, n]
            may_be = np.flatnonzero(costs < costs.min() + ALIKE_COST)
            k = int(may_be[0])  # contacts fail more often than yarn
            more_ohm = float(ohm[k, n, k]) - usual_ohm
            clear = costs[k] < min(self.cost[n] + ALIKE_COST, cost[-1, n] - CLEAR_STDS**2)
            if not clear or more_ohm < CHANGED * len(self.across) * usual_ohm:
                self._compare([n], usual_ohm, diagnosis)
                continue
            self.ohm[n], self.covariance[n] = ohm[k, n], covariance[k, n]
            values = {"more_ohm": more_ohm, "std_ohm": float(covariance[k, n, k, k]) ** 0.5}
            between = self.across[k - 1] if k else -1, self.across[may_be[-1]]
            kind = Kind.BAD_SEGMENT if k else Kind.BAD_CRIMP
            diagnosis.add(kind, self.place([n]), between=between, **values)
        for n in told:
            std_ohm = self.covariance[n].diagonal() ** 0.5
            whole = float(self.ohm[n].sum()), float(self.covariance[n].sum()) ** 0.5
            each = self.ohm[n].tolist(), std_ohm.tolist()
            diagnosis.lines.append(LineWire(self.place([n]), *whole, *each))

    def _compare(self, lines: Any, segment_ohm: float, diagnosis: Diagnosis) -> None:
        """Add lines whose resistance is clearly not that of so many such segments."""
        ohm = float(np.median(self.ohm[lines].sum(axis=1)))
        std_ohm = float(np.median(self.covariance[lines].sum(axis=(1, 2)) ** 0.5))
        usual_ohm = len(self.across) * segment_ohm
        scatter_ohm = (2 / len(self.across)) ** 0.5 * SEGMENT_STD * max(ohm, usual_ohm)
        both_ohm = (1 + np.pi / 2 / len(self.told)) ** 0.5 * std_ohm  # the usual one is a median
        doubt_ohm = LINE_STDS * float(np.hypot(both_ohm, scatter_ohm))
        if abs(ohm - usual_ohm) > CHANGED * usual_ohm + doubt_ohm:
            values = {"ohm": ohm, "std_ohm": std_ohm, "usual_ohm": usual_ohm}
            diagnosis.add(Kind.LINE_WIRE, self.place(lines), **values)


def near_ends(rest: Rest) -> Rest:
    """What mode near would have read of a skin that was read in mode far: c = 1 - b, d = 1 - a."""
    a, _, b, _ = np.moveaxis(rest.codes, -1, 0)
    codes = np.stack([a, b, 2**ADC_BITS - 1 - b, 2**ADC_BITS - 1 - a], axis=-1)
    board = replace(rest.board, mode="near")
    return replace(rest, board=board, codes=codes, offset_lsb=OFFSET_LSB)


def segments_of(lines: Sequence[LineWire]) -> WireOhm | None:
    """Segment of each layer [ohm], the median of its lines'. None if the lines do not tell both.

    The deviation is the mean of both layers': their errors may be the same.
    """
    means, stds = [0.0, 0.0], [np.inf, np.inf]
    for k, axis in enumerate(("rows", "columns")):
        if layer := [each for each in lines if getattr(each.place, axis)]:
            ohm, std_ohm = np.median([(each.ohm, each.std_ohm) for each in layer], axis=0).tolist()
            means[k] = ohm / len(layer[0].segment_ohm)
            stds[k] = std_ohm / max(ohm, 1e-9) * (np.pi / 2 / len(layer)) ** 0.5
    return WireOhm(means[0], means[1], sum(stds) / 2) if max(stds) <= KNOWN else None


def examine_far(rest: Rest, nominal_ohm: tuple[float, float] | None, diagnosis: Diagnosis) -> None:
    """Add the wires of lines that are neither open nor shorted, and what is wrong with far ends.

    rest: of mode far. nominal_ohm: a segment of each layer, where told: else lines are compared
    with each other.
    """
    kept, joined = [], []
    for axis, count in enumerate(rest.codes.shape[:2]):
        told = ((each.kind.id, each.place) for each in diagnosis.findings)
        found = [(kind, (place.rows, place.columns)[axis]) for kind, place in told]
        out = {n for kind, lines in found if kind.startswith("open_") for n in lines}
        out |= {n for kind, lines in found if kind.startswith("short_") for n in lines[1:]}
        joined.append({n for kind, lines in found if kind.startswith("short_") for n in lines})
        kept.append([n for n in range(count) if n not in out])
    skin = _Skin(rest, kept)
    wire_ohm: Float = np.zeros((2, *skin.shape))
    for _ in range(ROUNDS):
        layers = [_Layer(n, kept, joined[n], of) for n, of in enumerate(skin.layers(wire_ohm))]
        wire_ohm = np.stack([layers[0].wire_ohm, layers[1].wire_ohm.T])
    ends_ohm = skin.ends(wire_ohm)
    for layer, ends, nominal in zip(layers, ends_ohm, nominal_ohm or (None, None), strict=True):
        layer.examine_shorts(diagnosis)
        layer.examine_ends(ends, diagnosis)
        layer.examine_wires(nominal, diagnosis)
