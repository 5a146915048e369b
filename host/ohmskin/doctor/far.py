# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin whose far ends are sensed, line by line, and what is wrong with far ends.

In mode far, each port is read at four nodes: a and e are the near and the far end of its row, b and
f the near and the far end of its column. A layer is all rows, or all columns. It has L lines of n
crossings each, and a line has n segments, the one at the near end first.

Symbols

====== ========= ===========================================================================
symbol shape     meaning
====== ========= ===========================================================================
I      (R, C)    current of a port per Vdd, from readings a and b [S]
u      (L, n)    loss_ohm: what a line loses between its ends, per current of each of its ports:
                 (a - e) / I of rows, (f - b) / I of columns [ohm]
s      (L, n)    std_ohm: standard deviation of u [ohm]
w      (L, n)    floating_ohm: what u would be if the far node still had the voltage of the cell
                 that was read before [ohm]
A      (L, n, n) current_share: share of each port's current in each segment of its line [1]
r      (L, n)    resistances of the segments [ohm]
m      (L,)      mean of a line's segments, or the usual one of the layer [ohm]
====== ========= ===========================================================================

A far end carries no current, so its potential shows what all segments of the line lose: u = A r. On
an untouched skin, a line draws current at all its crossings alike; a touch draws it at its own.

A depends on the cells. The cells follow from the port resistances without their wires, and the
wires follow from u and A. So the cells, A and the wires are computed in turn, `ROUNDS` times.

The readings alone do not determine n segments. They are taken to scatter about their mean m:

    cost(r) = |(u - A r) / s|^2 + |(r - m) / (SPREAD m)|^2

With m free, this gives the segments of a sound line. With the usual m of the layer, and one segment
that may have any resistance, it finds a bad segment. If no r fits, the far end is at fault; also if
u = k w fits clearly better, with k from 0 to 1: so reads a far end that is not connected. If what
the circuit says of another line's far end fits, the ends are swapped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit import skin as circuit
from ohmskin.doctor.circuit import LinesAndCells
from ohmskin.doctor.findings import Diagnosis, Finding, Kind, LineWire, Place, lines_of
from ohmskin.doctor.limits import ADC_ERROR_LSB, CHANGED_SHARE, FEW_STDS, KNOWN_STD, MANY_STDS
from ohmskin.doctor.signal import Rest
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.prior import SEGMENT_STD
from ohmskin.link.protocol import ADC_BITS

# [1] Segments of a line scatter by this share of their mean. Chosen: twice what estimators expect.
SPREAD: Final = 2 * SEGMENT_STD
# [1] A, and with it A r, is known to this share. Chosen: what is left after ROUNDS.
MODEL_STD: Final = 0.01
# [rounds] Each makes the error of A smaller by the share of the wires in a port. Chosen: enough for
# 2 kOhm a segment (tests/doctor/test_far_doctor.py).
ROUNDS: Final = 3
# [chi-square] Two faults whose costs differ by less may be either. Chosen: two deviations, squared.
ALIKE_COST: Final = 4.0
# [ohm] No line has more: a fit that says so is of a far end at fault. Chosen: 16 segments of 2 kOhm
# have less.
MOST_LINE_OHM: Final = 50e3


@dataclass(frozen=True, eq=False)
class LayerReadings:
    """What the readings say of the wires of a layer, by the symbols of this module.

    current_share: A, (L, n, n).
    loss_ohm: u, (L, n) [ohm].
    std_ohm: s, (L, n) [ohm].
    floating_ohm: w, (L, n) [ohm].
    """

    current_share: Float
    loss_ohm: Float
    std_ohm: Float
    floating_ohm: Float

    @cached_property
    def weighed(self) -> Float:
        """A^T / s^2, (L, n, n): times A or u, the two sides of the normal equations."""
        return (self.current_share / self.std_ohm[..., None] ** 2).swapaxes(1, 2)


class FarReadings:
    """Mean readings of mode far, of the rows and columns that are kept. kept: their numbers.

    shape: number of rows and columns.
    cell_siemens: the cells, (R, C) [S]: first as if wires had no resistance, then by `layers`.
    """

    def __init__(self, rest: Rest, kept: list[list[int]]) -> None:
        self._refs, ratio = (rest.board.ref_top_ohm, rest.board.ref_bottom_ohm), rest.ratio
        # A far node that floats keeps the voltage of the cell that was read before. A scan goes
        # down one column after the other.
        before = np.roll(ratio.swapaxes(0, 1).reshape(-1, 4), 1, axis=0)
        before = before.reshape(ratio.shape[1], -1, 4).swapaxes(0, 1)[np.ix_(*kept)]
        ratio = ratio[np.ix_(*kept)]
        self.shape = ratio.shape[0], ratio.shape[1]
        near = circuit.as_near(ratio, "aebf")
        self._current = np.maximum(circuit.current_from_ratio(near, *self._refs), 1e-9)
        a, e, b, f = np.moveaxis(ratio, -1, 0)
        loss = np.stack([a - e, f - b])
        # A loss is the difference of two readings, and A r is not known exactly.
        std = np.hypot(2**0.5 * rest.std_lsb / 2**ADC_BITS, MODEL_STD * loss)
        floating = np.stack([a - before[..., 1], before[..., 3] - b])
        self._loss_std_floating = np.stack([loss, std, floating], axis=1) / self._current
        board = SkinKnowledge(*self.shape, *self._refs, rest.board.adc_bits)
        self._matrix = make_estimator("matrix", board)
        self.cell_siemens = self._matrix.estimate(near).cell_siemens

    def layers(self, wire_ohm: Float) -> tuple[LayerReadings, LayerReadings]:
        """Rows and columns, if the segments are `wire_ohm` (2, R, C). Corrects the cells for these.

        `matrix` knows no wires. So it is given the readings of a skin without them: of ports that
        have less resistance by what the wires add.
        """
        refs_ohm = sum(self._refs)
        of_wires = circuit.PortCircuit(self.cell_siemens, *wire_ohm).port_ohm
        of_wires -= circuit.PortCircuit(self.cell_siemens, 0.0, 0.0).port_ohm
        port_ohm = np.maximum(1 / self._current - refs_ohm - of_wires.reshape(self.shape), 1.0)
        ratio = circuit.ratio_from_current(1 / (port_ohm + refs_ohm), *self._refs)
        self.cell_siemens = self._matrix.estimate(ratio).cell_siemens
        wired = circuit.PortCircuit(self.cell_siemens, *wire_ohm)
        rows, columns = self._loss_std_floating
        return (
            LayerReadings(wired.line_current(0), *rows),
            LayerReadings(wired.line_current(1), *columns.swapaxes(1, 2)),
        )

    def ends(self, wire_ohm: Float) -> tuple[Float, Float]:
        """What u of each line would be if the far end of another line were read for it [ohm].

        This is what the circuit says of swapped ends, if the segments are `wire_ohm` (2, R, C).
        Of rows (R, R, C), of columns (C, C, R): the end that is read, the line, its port.
        """
        rows, lines = self.shape[0], sum(self.shape)
        admittance = circuit.end_admittance(circuit.Skin(self.cell_siemens, *wire_ohm))
        by_line = circuit.impedance_of(admittance, rows)[0][:lines]
        # Potential of each end, near and then far, while a unit current goes through each port.
        ends = circuit.port_difference(by_line, rows).T.reshape(-1, *self.shape)
        row, column = np.indices(self.shape)
        at_row, at_column = ends[row, row, column], ends[rows + column, row, column]
        of_columns = ends[lines + rows :] - at_column
        return at_row - ends[lines : lines + rows], of_columns.swapaxes(1, 2)


class Fit(NamedTuple):
    """Segments of lines, by the cost of the module.

    ohm: the segments, (..., L, n) [ohm].
    covariance: of these, widened where the readings do not fit, (..., L, n, n) [ohm^2].
    cost: the least one, (..., L).
    """

    ohm: Float
    covariance: Float
    cost: Float


def _fit(layer: LayerReadings, mean_ohm: Float, prior: Float) -> Fit:
    """The segments of least cost |(u - A r) / s|^2 + (r - mean)^T prior (r - mean).

    mean_ohm: mean of the segments, (..., 1, 1) [ohm].
    prior: inverse of their covariance before the readings, (..., n, n) [1 / ohm^2].

    A cost above the number of readings, less one, shows that the model is wrong by more than s
    says. The covariance is widened by as much.
    """
    covariance = np.linalg.inv(layer.weighed @ layer.current_share + prior)
    expected = prior.sum(axis=-1, keepdims=True) * mean_ohm
    ohm = covariance @ (layer.weighed @ layer.loss_ohm[..., None] + expected)
    off = (layer.loss_ohm - (layer.current_share @ ohm)[..., 0]) / layer.std_ohm
    away = ohm - mean_ohm
    cost = np.sum(off**2, axis=-1) + np.sum(away * (prior @ away), axis=(-1, -2))
    misfit = np.maximum(cost / max(ohm.shape[-2] - 1, 1), 1.0)
    return Fit(ohm[..., 0], covariance * misfit[..., None, None], cost)


def fit_alike(layer: LayerReadings) -> Fit:
    """Segments that scatter about the mean of their line. The mean may be anything."""
    count = layer.loss_ohm.shape[1]
    # What each segment has if all are equal. It scales the cost in place of m, which is near it.
    pull = (layer.weighed @ layer.loss_ohm[..., None]).sum(axis=1)
    precision = (layer.weighed @ layer.current_share).sum(axis=(1, 2))
    equal_ohm = (pull / precision[:, None])[..., None]
    scale = (SPREAD * np.maximum(np.abs(equal_ohm), 1.0)) ** -2.0
    # This matrix takes the mean out of r, so that only differences from it cost something.
    return _fit(layer, equal_ohm, scale * (np.eye(count) - 1 / count))


def fit_one_bad(layer: LayerReadings, usual_ohm: float) -> Fit:
    """Segments that scatter about the usual one of the layer, but for one, which may be anything.

    There are n + 1 fits of each line, (n + 1, L): the k-th segment is the free one in the k-th fit,
    and none is in the last.
    """
    count = layer.loss_ohm.shape[1]
    bound = (1 - np.eye(count + 1, count))[:, None, None]  # 0: this segment is free
    prior = (SPREAD * usual_ohm) ** -2.0 * np.eye(count) * bound
    return _fit(layer, np.full((1, 1, 1), usual_ohm), prior)


class _Layer:
    """The rows (axis 0) or the columns (axis 1) that are kept, and what was found of their wires.

    numbers: the numbers of its lines.
    across: the numbers of the lines that cross them.
    measured: which lines have wires that are measured, (L,).
    lost: which lines have a far end at fault, (L,).
    fit: segments of all lines.
    """

    def __init__(
        self, axis: int, kept: list[list[int]], shorts: list[list[int]], readings: LayerReadings
    ) -> None:
        self.axis, self.numbers, self.across = axis, kept[axis], kept[1 - axis]
        self.readings, self.shorts = readings, shorts
        # A shorted line has currents of others in its wire, so that u = A r does not hold.
        shorted = [n for group in shorts for n in group]
        self.measured = alone = ~np.isin(self.numbers, shorted)
        self.fit = fit_alike(readings)
        least_cost = self.fit.cost
        if len(alone) > 2:  # else no line is usual
            one_bad = fit_one_bad(readings, self.usual_ohm)
            least_cost = np.minimum(least_cost, one_bad.cost.min(axis=0))
        # A connected end costs less than MANY_STDS^2 a reading, and not clearly more than if it
        # floated.
        most_of_any = MANY_STDS**2 * max(len(self.across) - 1, 1)
        most_cost = np.minimum(most_of_any, MANY_STDS**2 + self._floating_cost())
        too_much = np.abs(self.fit.ohm.sum(axis=1)) > MOST_LINE_OHM
        at_fault = (least_cost > most_cost) | too_much
        self.measured, self.lost = alone & ~at_fault, alone & at_fault

    def _floating_cost(self) -> Float:
        """Cost (L,) of the readings, if the far ends float: |(u - k w) / s|^2, of the best k."""
        std_ohm = self.readings.std_ohm
        u, w = self.readings.loss_ohm / std_ohm, self.readings.floating_ohm / std_ohm
        k = np.sum(w * u, axis=1) / np.maximum(np.sum(w * w, axis=1), 1e-30)
        return np.asarray(np.sum((u - np.clip(k, 0, 1)[:, None] * w) ** 2, axis=1))

    @property
    def usual_ohm(self) -> float:
        """The usual mean of a line's segments: the median of the lines, of measured ones if any."""
        ohm = self.fit.ohm[self.measured] if self.measured.any() else self.fit.ohm
        return max(float(np.median(ohm.mean(axis=1))), 1.0)

    @property
    def wire_ohm(self) -> Float:
        """Segments (L, n); the usual ones where a line is not measured."""
        return np.maximum(np.where(self.measured[:, None], self.fit.ohm, self.usual_ohm), 0.0)

    def place(self, lines: Any) -> Place:
        """Lines of this layer, by index or mask."""
        return Place.of_lines(self.axis, np.array(self.numbers)[lines])

    def report_shorts(self, diagnosis: Diagnosis) -> None:
        """Say which shorted lines are joined at their far ends, and not at their near ends.

        Either way, the current of a port divides among the lines. Joined at near ends, a line
        carries the current of its own cells, up to these. Joined at far ends, it also carries that
        of the other lines' cells, through all its segments. So it loses more: what it loses is
        compared with the mean of both.
        """
        for group in self.shorts:
            line, others = self.numbers.index(group[0]), len(group) - 1
            near = float(self.readings.current_share[line].sum(axis=1).mean())  # in segments
            far = near + others * len(self.across)
            loss_ohm = self.readings.loss_ohm[line].mean() * len(group)
            if loss_ohm > self.usual_ohm * (near + far) / 2:
                diagnosis.add(Kind.SHORT_FAR, Place.of_lines(self.axis, group))

    def report_ends(self, ends_ohm: Float, dead: Bool, diagnosis: Diagnosis) -> None:
        """Add far ends that do not show their lines.

        ends_ohm: what `FarReadings.ends` gives for this layer. dead: dead cells, (R, C).
        """
        self.lost &= [not self.report_broken(n, dead, diagnosis) for n in range(len(self.lost))]
        off = (self.readings.loss_ohm - ends_ohm) / self.readings.std_ohm
        chi2 = np.mean(off**2, axis=2)
        np.fill_diagonal(chi2, np.inf)
        swapped = self.lost & (chi2.min(axis=0) < MANY_STDS**2)
        for kind, lines in ((Kind.SWAPPED_FAR, swapped), (Kind.OPEN_FAR, self.lost & ~swapped)):
            if lines.any():
                diagnosis.add(kind, self.place(lines))

    def report_broken(self, line: int, dead: Bool, diagnosis: Diagnosis) -> bool:
        """Whether all cells of a line are dead from some cell on. If its far end is lost, too, its
        yarn is broken there: this is added, and explains these dead cells.
        """
        in_line = np.take(dead, self.numbers[line], axis=self.axis)[self.across]
        alive = np.flatnonzero(~in_line)
        beyond = self.across[alive[-1] + 1 :] if alive.size else []
        if beyond and self.lost[line]:
            explained = np.zeros_like(dead)
            np.moveaxis(explained, self.axis, 0)[self.numbers[line], beyond] = True
            values = {"between": (self.across[alive[-1]], beyond[0])}
            place, cells = self.place([line]), Place.of_cells(explained)
            diagnosis.findings.append(Finding(Kind.BROKEN_YARN, place, values, cells))
        return bool(beyond)

    def report_wires(self, nominal_ohm: float | None, diagnosis: Diagnosis) -> None:
        """Add the wire of each measured line, and lines that are clearly not as they should be.

        All lines together are compared with `nominal_ohm`, if it is known. Each line is compared
        with the usual one, unless one bad segment explains it better: then this is added. Of two
        lines, nobody can say which is usual.
        """
        measured: list[int] = np.flatnonzero(self.measured).tolist()
        if nominal_ohm and measured:
            self._compare(measured, nominal_ohm, diagnosis)
        one_bad, usual_ohm = fit_one_bad(self.readings, self.usual_ohm), self.usual_ohm
        for line in measured if len(self.measured) > 2 else ():
            if not self._report_segment(line, one_bad, usual_ohm, diagnosis):
                self._compare([line], usual_ohm, diagnosis)
        for line in measured:
            ohm, covariance = self.fit.ohm[line], self.fit.covariance[line]
            whole = float(ohm.sum()), float(covariance.sum()) ** 0.5
            segments = ohm.tolist(), (covariance.diagonal() ** 0.5).tolist()
            diagnosis.lines.append(LineWire(self.place([line]), *whole, *segments))

    def _report_segment(
        self, line: int, one_bad: Fit, usual_ohm: float, diagnosis: Diagnosis
    ) -> bool:
        """Whether one bad segment explains a line clearly better than anything else does.

        Then it is added, and the line takes the segments of that fit.
        one_bad: what `fit_one_bad` gives of all lines.
        """
        costs, none_bad_cost = one_bad.cost[:-1, line], one_bad.cost[-1, line]
        # Several segments may explain the line. The nearest one has the crimp in it, or is the
        # nearest to it: contacts fail more often than yarn.
        candidates = np.flatnonzero(costs < costs.min() + ALIKE_COST)
        k = int(candidates[0])
        more_ohm = float(one_bad.ohm[k, line, k]) - usual_ohm
        clear = costs[k] < min(self.fit.cost[line] + ALIKE_COST, none_bad_cost - MANY_STDS**2)
        if not clear or more_ohm < CHANGED_SHARE * len(self.across) * usual_ohm:
            return False
        self.fit.ohm[line] = one_bad.ohm[k, line]
        self.fit.covariance[line] = one_bad.covariance[k, line]
        values = {"more_ohm": more_ohm, "std_ohm": float(one_bad.covariance[k, line, k, k]) ** 0.5}
        between = self.across[k - 1] if k else -1, self.across[candidates[-1]]
        kind = Kind.BAD_SEGMENT if k else Kind.BAD_CRIMP
        diagnosis.add(kind, self.place([line]), between=between, **values)
        return True

    def _compare(self, lines: Any, segment_ohm: float, diagnosis: Diagnosis) -> None:
        """Add lines, by index, if their median is clearly not that of segments of `segment_ohm`."""
        ohm = float(np.median(self.fit.ohm[lines].sum(axis=1)))
        std_ohm = float(np.median(self.fit.covariance[lines].sum(axis=(1, 2)) ** 0.5))
        usual_ohm = len(self.across) * segment_ohm
        # Two sound lines differ, since segments scatter; and both were measured, the usual one as a
        # median of all lines, whose variance is pi / 2 of that of a mean.
        scatter_ohm = (2 / len(self.across)) ** 0.5 * SEGMENT_STD * max(ohm, usual_ohm)
        both_std_ohm = (1 + np.pi / 2 / len(self.measured)) ** 0.5 * std_ohm
        doubt_ohm = FEW_STDS * float(np.hypot(both_std_ohm, scatter_ohm))
        if abs(ohm - usual_ohm) > CHANGED_SHARE * usual_ohm + doubt_ohm:
            values = {"ohm": ohm, "std_ohm": std_ohm, "usual_ohm": usual_ohm}
            diagnosis.add(Kind.LINE_WIRE, self.place(lines), **values)


def near_ends(rest: Rest) -> Rest:
    """What mode near would have read of a skin that was read in mode far.

    Readings c and d are those of b and a with the drive reversed: c = 1 - b, d = 1 - a. But there
    the converter's errors would have the other sign, so here they do not cancel: `offset_lsb`.
    """
    a, _, b, _ = np.moveaxis(rest.codes, -1, 0)
    codes = np.stack([a, b, 2**ADC_BITS - 1 - b, 2**ADC_BITS - 1 - a], axis=-1)
    board = replace(rest.board, mode="near")
    return replace(rest, board=board, codes=codes, offset_lsb=2 * ADC_ERROR_LSB)


def segments_of(lines: Sequence[LineWire]) -> WireOhm | None:
    """Segment of each layer [ohm]: the median of its lines, so that one bad line does not count.

    None if it is not known of both layers. The deviation is the mean of both layers', and not less,
    because what is wrong with the model is wrong in both.
    """
    means, stds = [0.0, 0.0], [np.inf, np.inf]
    for axis, name in enumerate(("rows", "columns")):
        if layer := [line for line in lines if getattr(line.place, name)]:
            ohm, std_ohm = np.median([(line.ohm, line.std_ohm) for line in layer], axis=0).tolist()
            means[axis] = ohm / len(layer[0].segment_ohm)
            stds[axis] = std_ohm / max(ohm, 1e-9) * (np.pi / 2 / len(layer)) ** 0.5
    return WireOhm(means[0], means[1], sum(stds) / 2) if max(stds) <= KNOWN_STD else None


def examine_far(
    rest: Rest,
    near: LinesAndCells,
    nominal_ohm: tuple[float, float] | None,
    diagnosis: Diagnosis,
) -> None:
    """Add the wires of all lines, and what is wrong with far ends.

    rest: readings of mode far.
    near: what the near ends show. Open lines are left out, and all but one of shorted lines.
    nominal_ohm: a segment of each layer; None: lines are compared with each other alone.
    """
    kept = []
    for is_open, shorts in zip(near.open_lines, near.shorts, strict=True):
        left_out = {*lines_of(is_open), *(n for group in shorts for n in group[1:])}
        kept.append([n for n in range(len(is_open)) if n not in left_out])
    readings = FarReadings(rest, kept)
    wire_ohm: Float = np.zeros((2, *readings.shape))
    for _ in range(ROUNDS):
        layers = [
            _Layer(axis, kept, near.shorts[axis], of_layer)
            for axis, of_layer in enumerate(readings.layers(wire_ohm))
        ]
        wire_ohm = np.stack([layers[0].wire_ohm, layers[1].wire_ohm.T])
    ends_ohm = readings.ends(wire_ohm)
    for layer, ends, nominal in zip(layers, ends_ohm, nominal_ohm or (None, None), strict=True):
        layer.report_shorts(diagnosis)
        layer.report_ends(ends, near.dead, diagnosis)
        layer.report_wires(nominal, diagnosis)
