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
l      scalar    lead_ohm: the usual lead of the layer's lines [ohm]
s      (L, n)    std_ohm: standard deviation of u [ohm]
w      (L, n)    floating_ohm: what u would be if the far node still had the voltage of the cell
                 that was read before [ohm]
A      (L, n, n) current_share: share of each port's current in each segment of its line [1]
r      (L, n)    resistances of the segments; the first one has what its lead is above the usual
                 one [ohm]
m      (L,)      mean of a line's segments, or the usual one of the layer [ohm]
====== ========= ===========================================================================

A far end carries no current, so its potential shows what the lead and all segments of the line
lose: u = l + A r. On an untouched skin, a line draws the same current at each of its crossings; a
touch draws most of it at its own crossing.

A 1 is what segments of 1 ohm lose. With one m for all segments of a line, u = l + m A 1 is a
straight line over A 1 that begins at the lead. Each line has a lead of its own. The layer's lead is
the mean of these by precision, without those that are far from their median: they have a bad crimp.
An untouched skin shows the lead badly. So the other layer's lead and the expected one count, too,
unless they contradict it. A first segment cannot be told from a lead. So what a line's lead has
above the layer's counts as a part of its first segment.

A depends on the cells. The cells follow from the port resistances without their wires, and the
wires follow from u and A. So the cells, A and the wires are computed in turn, `ROUNDS` times.

The readings alone do not determine n segments. They are taken to scatter about their mean m:

    cost(r) = |(u - l - A r) / s|^2 + |(r - m) / (SPREAD_SHARE m)|^2

With m free, this gives the segments of a sound line. With the usual m of the layer, and one segment
that may have any resistance, it finds a bad segment.

A far end is at fault if it stays while the near end moves, if it shows what the near end shows, if
no r fits, or if u = k w fits clearly better, with k from 0 to 1. A node that is not connected shows
the last: it keeps the voltage of the cell before (k = 1), but the converter's sample capacitor may
bring along the voltage of the near end, which is read just before (then k goes down to 0). Two ends
are swapped if the potentials that the circuit gives for the other line's end fit.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import as_near, current_from_ratio, ratio_from_current
from ohmskin.circuit.ports import PortCircuit, port_difference
from ohmskin.circuit.skin import Skin, end_admittance, impedance_of
from ohmskin.doctor.circuit import LinesAndCells
from ohmskin.doctor.findings import Diagnosis, Finding, Kind, LineWire, Place, lines_of
from ohmskin.doctor.limits import ADC_ERROR_LSB, CHANGED_SHARE, FEW_STDS, KNOWN_STD, MANY_STDS
from ohmskin.doctor.signal import Rest
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_faults import CONSTANT_TIMES, LEAST_LOSS_OHM
from ohmskin.estimate.prior import SEGMENT_STD
from ohmskin.link.protocol import ADC_BITS, LARGEST_CODE, from_scan_order, in_scan_order

# [1] Segments of a line scatter by this share of their mean. Chosen: twice what estimators expect.
SPREAD_SHARE: Final = 2 * SEGMENT_STD
# [1] A, and with it A r, is known to this share. Chosen: what is left after ROUNDS.
MODEL_STD: Final = 0.01
# [rounds] Each multiplies the error of A by the share of the wires in a port's resistance. Chosen:
# enough for 2 kOhm a segment (tests/doctor/test_far_doctor.py).
ROUNDS: Final = 3
# [chi-square] Two faults whose costs differ by less may be either. Chosen: two deviations, squared.
ALIKE_COST: Final = 4.0
# [deviations] Leads that differ by more contradict each other. Chosen: the other one hardly pulls
# where it should not, since rows and columns may have leads of two kinds.
ALIKE_STDS: Final = 2.5
# [ohm] No line has more: a fit that says so is of a far end at fault. Chosen: 16 segments of 2 kOhm
# have less.
MOST_LINE_OHM: Final = 50e3


class FarSkin:
    """A skin by its mean readings of mode far, without the lines that `examine_far` leaves out.

    kept: numbers of the rows, and of the columns, that are kept.
    shape: how many these are.
    loss_std_floating: u, s and w of rows (3, R, C), and of columns (3, C, R) [ohm].
    silent: which rows, and which columns, have a far end that stays while the near end moves, or
        shows what the near end shows.
    cell_siemens: the cells, (R, C) [S]; first as if wires had no resistance, later as
        `current_shares` corrects them.
    """

    def __init__(self, rest: Rest, kept: list[list[int]]) -> None:
        self.kept = kept
        self._refs, ratio = (rest.board.ref_top_ohm, rest.board.ref_bottom_ohm), rest.ratio
        # A far node that floats keeps the voltage of the cell that was read before: all four
        # readings of one cell after another, here.
        cell_later = np.roll(in_scan_order(ratio, 4), 4)
        before = from_scan_order(cell_later, ratio.shape, 4)[np.ix_(*kept)]
        ratio = ratio[np.ix_(*kept)]
        self.shape = ratio.shape[0], ratio.shape[1]
        near = as_near(ratio, "aebf")
        # At least 1e-9 S, which no code shows: losses are divided by it.
        self._current = np.maximum(current_from_ratio(near, *self._refs), 1e-9)
        a, e, b, f = np.moveaxis(ratio, -1, 0)
        loss = np.stack([a - e, f - b])
        # A loss is the difference of two readings, and the A r that explains it is not exact.
        std = np.hypot(2**0.5 * rest.std_lsb / 2**ADC_BITS, MODEL_STD * loss)
        self.silent: list[Bool] = []
        for axis, (near_end, far_end) in enumerate(((a, e), (b, f))):
            moves, follows = (np.ptp(each, axis=1 - axis) for each in (near_end, far_end))
            stays = (follows < moves / CONSTANT_TIMES) & (follows < 2.0**-ADC_BITS)
            ohm = np.abs((loss[axis] / self._current).mean(axis=1 - axis))
            std_ohm = (std[axis] / self._current).mean(axis=1 - axis) / loss.shape[2 - axis] ** 0.5
            most_ohm = LEAST_LOSS_OHM - FEW_STDS * std_ohm
            whole = ohm.mean() < LEAST_LOSS_OHM - FEW_STDS * std_ohm.mean() / ohm.size**0.5
            # A single line may stay by chance, where the loss of its wires cancels what the cells
            # change. So it counts only if all lines stay.
            self.silent.append(stays.all() | (ohm < most_ohm) | whole)
        floating = np.stack([a - before[..., 1], before[..., 3] - b])
        rows, columns = np.stack([loss, std, floating], axis=1) / self._current
        self.loss_std_floating = rows, columns.swapaxes(1, 2)
        board = SkinKnowledge(*self.shape, *self._refs, rest.board.adc_bits)
        self._matrix = make_estimator("matrix", board)
        self.cell_siemens = self._matrix.estimate(near).cell_siemens

    def current_shares(self, wire_ohm: Float, leads_ohm: float) -> tuple[Float, Float]:
        """A of rows and of columns, if the segments are `wire_ohm` (2, R, C). Corrects the cells.

        `matrix` takes wires for a part of the cells. So it is given what a skin without wires would
        read: each port without the resistance that the wires add to it.

        leads_ohm: both leads of a port.
        """
        refs_ohm = sum(self._refs)
        of_wires = PortCircuit(self.cell_siemens, *wire_ohm).port_ohm
        of_wires -= PortCircuit(self.cell_siemens, 0.0, 0.0).port_ohm
        # At least 1 ohm: in a short, noise may make less than nothing of what is left.
        of_wires += leads_ohm
        port_ohm = np.maximum(1 / self._current - refs_ohm - of_wires.reshape(self.shape), 1.0)
        ratio = ratio_from_current(1 / (port_ohm + refs_ohm), *self._refs)
        self.cell_siemens = self._matrix.estimate(ratio).cell_siemens
        wired = PortCircuit(self.cell_siemens, *wire_ohm)
        return wired.line_current(0), wired.line_current(1)

    def ends(self, wire_ohm: Float) -> tuple[Float, Float]:
        """What u - l of each line would be if the far end of another line were read for it [ohm].

        The circuit says this, if the segments are `wire_ohm` (2, R, C). It is how swapped ends are
        found. Axes: the line whose end is read, the line whose u it is, its ports. So the shapes
        are (R, R, C) of rows, and (C, C, R) of columns.
        """
        rows, lines = self.shape[0], sum(self.shape)
        admittance = end_admittance(Skin(self.cell_siemens, *wire_ohm))
        by_line = impedance_of(admittance, rows)[0][:lines]
        # Potential of each end while a current of 1 goes through each port (R, C). All near ends
        # come first, rows and then columns, and then all far ends.
        ends = port_difference(by_line, rows).T.reshape(-1, *self.shape)
        row, column = np.indices(self.shape)
        at_row, at_column = ends[row, row, column], ends[rows + column, row, column]
        of_columns = ends[lines + rows :] - at_column
        return at_row - ends[lines : lines + rows], of_columns.swapaxes(1, 2)


class Fit(NamedTuple):
    """Segments of lines at which the module's cost is least.

    ohm: the segments, (..., L, n) [ohm].
    covariance: of the segments, widened where the readings do not fit, (..., L, n, n) [ohm^2].
    cost: what the cost is there, (..., L).
    by_lead: d ohm / d lead: how the segments change if the lead is taken for more, (..., L, n) [1].
    """

    ohm: Float
    covariance: Float
    cost: Float
    by_lead: Float


class _Layer:
    """The rows (axis 0) or the columns (axis 1) that are kept, and what is found of their wires.

    numbers: the numbers of its lines.
    across: the numbers of the lines that cross them.
    shorts: groups of its lines that are shorted, by number.
    loss_ohm, std_ohm, floating_ohm: u, s and w, (L, n) [ohm].
    lead_ohm, lead_std_ohm: l and its deviation; until `fit_lines`, those expected [ohm].

    `fit_lines` sets the others:

    current_share: A, (L, n, n).
    beyond_ohm: u - l, (L, n) [ohm].
    fit: segments of each line that scatter about the line's own mean. Where one bad segment
        explains a line, `report_wires` replaces them.
    lost: which lines have a far end at fault, (L,).
    measured: which lines have a fit that counts, (L,): neither lost nor shorted.
    usual_ohm: the usual segment: the median of the measured lines [ohm].
    """

    def __init__(
        self, axis: int, skin: FarSkin, shorts: list[list[int]], lead_ohm: tuple[float, float]
    ) -> None:
        self.axis, self.numbers, self.across = axis, skin.kept[axis], skin.kept[1 - axis]
        self.loss_ohm, self.std_ohm, self.floating_ohm = skin.loss_std_floating[axis]
        self.shorts, (self.lead_ohm, self.lead_std_ohm) = shorts, lead_ohm
        self._silent = skin.silent[axis]
        # The wire of a shorted line also carries currents of the lines that it is shorted to, so
        # that u = l + A r does not hold.
        self._alone = ~np.isin(self.numbers, [n for group in self.shorts for n in group])

    def fit_lines(self, current_share: Float, lead_ohm: tuple[float, float]) -> None:
        """Fit the segments of all lines, and find the lines whose far end is at fault.

        lead_ohm: l and its deviation.
        """
        self.current_share = current_share
        # A^T / s^2, (L, n, n): times A and times u, it gives both sides of the normal equations.
        self._weighed = (current_share / self.std_ohm[..., None] ** 2).swapaxes(1, 2)
        self.lead_ohm, self.lead_std_ohm = lead_ohm
        self.beyond_ohm = self.loss_ohm - self.lead_ohm
        self.fit = self._fit_alike()
        least_cost = self.fit.cost
        if len(self._alone) > 2:  # of two lines, nobody can say which is usual
            one_bad = self._fit_one_bad(self._median_ohm(self._alone))
            least_cost = np.minimum(least_cost, one_bad.cost.min(axis=0))
        # A connected end has a cost below two limits: MANY_STDS^2 for each reading, and the cost of
        # a floating end. MANY_STDS^2 is added to the second: where wires lose little, both costs
        # are small and cannot be told apart.
        most_of_any = MANY_STDS**2 * max(len(self.across) - 1, 1)
        most_cost = np.minimum(most_of_any, MANY_STDS**2 + self._floating_cost())
        too_much = np.abs(self.fit.ohm.sum(axis=1)) > MOST_LINE_OHM
        self.lost = self._alone & ((least_cost > most_cost) | too_much | self._silent)
        self.measured = self._alone & ~self.lost
        self.usual_ohm = self._median_ohm(self.measured)

    def own_lead(self, current_share: Float) -> tuple[float, float]:
        """The usual lead by the lines of this layer alone, and its deviation [ohm].

        current_share: A. Lead l and mean segment m of each line are fitted to u = l + m A 1 + v. v
        is the noise, and what segments differ from m by. Its covariance is
        s^2 + (SPREAD_SHARE m)^2 A A^T, with m as of the round before.
        """
        slopes = np.stack([np.ones_like(self.loss_ohm), current_share.sum(axis=2)], axis=2)
        before_ohm = (self.loss_ohm - self.lead_ohm).mean(axis=1) / slopes[..., 1].mean(axis=1)
        spread_ohm = SPREAD_SHARE * np.maximum(before_ohm, 1.0)[:, None, None] * current_share
        covariance = spread_ohm @ spread_ohm.swapaxes(1, 2)
        np.einsum("lkk->lk", covariance)[:] += self.std_ohm**2
        columns = np.concatenate([slopes, self.loss_ohm[..., None]], axis=2)
        products = columns.swapaxes(1, 2) @ np.linalg.solve(covariance, columns)
        # Both unknowns of each line; a line of one crossing does not tell them apart. No wire loses
        # as much as a far end that shows another line, and few lines would have a median of both.
        by_lead, both, by_mean = products[:, 0, 0], products[:, 0, 1], products[:, 1, 1]
        precision = by_lead - both**2 / by_mean
        is_wire = np.abs(self.loss_ohm).mean(axis=1) < MOST_LINE_OHM
        tells = self._alone & is_wire & (precision > 1e-9 * by_lead)
        if not tells.any():
            return 0.0, np.inf
        pull = products[:, 0, 2] - both / by_mean * products[:, 1, 2]
        precision, lead_ohm = precision[tells], pull[tells] / precision[tells]
        off_stds = np.abs(lead_ohm - np.median(lead_ohm)) * precision**0.5
        weight = np.where(off_stds < FEW_STDS, precision, 0.0)
        if not weight.any():  # the median of two lines that differ is far from both
            return 0.0, np.inf
        return float(np.average(lead_ohm, weights=weight)), float(weight.sum() ** -0.5)

    def _fit(self, mean_ohm: Float, prior: Float) -> Fit:
        """The segments of least cost |(u - l - A r) / s|^2 + (r - mean)^T prior (r - mean).

        mean_ohm: mean of the segments, (..., 1, 1) [ohm].
        prior: inverse of their covariance before the readings, (..., n, n) [1 / ohm^2].

        A right model costs about n - 1. There are 2 n terms, n of readings and n of the prior, and
        n + 1 free numbers: the segments, and their mean. (With one bad segment, its term of the
        prior is missing instead.) A higher cost shows that the model is wrong by more than s says.
        The covariance is widened by as much.
        """
        covariance = np.linalg.inv(self._weighed @ self.current_share + prior)
        expected = prior.sum(axis=-1, keepdims=True) * mean_ohm
        ohm = covariance @ (self._weighed @ self.beyond_ohm[..., None] + expected)
        off = (self.beyond_ohm - (self.current_share @ ohm)[..., 0]) / self.std_ohm
        away = ohm - mean_ohm
        cost = np.sum(off**2, axis=-1) + np.sum(away * (prior @ away), axis=(-1, -2))
        misfit = np.maximum(cost / max(ohm.shape[-2] - 1, 1), 1.0)
        by_lead = -(covariance @ self._weighed).sum(axis=-1)
        return Fit(ohm[..., 0], covariance * misfit[..., None, None], cost, by_lead)

    def _fit_alike(self) -> Fit:
        """Segments that scatter about the mean of their line. The mean may be anything."""
        # What each segment has if all of a line are equal: one unknown a line, by least squares. It
        # is near m, and stands for it in SPREAD_SHARE m: so the cost stays quadratic in r.
        both_sides = (self._weighed @ self.beyond_ohm[..., None]).sum(axis=1)
        precision = (self._weighed @ self.current_share).sum(axis=(1, 2))
        equal_ohm = (both_sides / precision[:, None])[..., None]
        per_square_ohm = (SPREAD_SHARE * np.maximum(np.abs(equal_ohm), 1.0)) ** -2.0
        # This matrix takes the mean out of r, so that only differences from it cost something.
        count = len(self.across)
        return self._fit(equal_ohm, per_square_ohm * (np.eye(count) - 1 / count))

    def _fit_one_bad(self, usual_ohm: float) -> Fit:
        """Segments that scatter about the usual one of the layer, but for one that may be anything.

        There are n + 1 fits of each line, (n + 1, L): the k-th segment is the free one in the k-th
        fit, and none is in the last.
        """
        count = len(self.across)
        bound = (1 - np.eye(count + 1, count))[:, None, None]  # 0: this segment is free
        prior = (SPREAD_SHARE * usual_ohm) ** -2.0 * np.eye(count) * bound
        return self._fit(np.full((1, 1, 1), usual_ohm), prior)

    def _floating_cost(self) -> Float:
        """Cost (L,) of the readings, if the far ends float: |(u - k w) / s|^2, of the best k."""
        u, w = self.loss_ohm / self.std_ohm, self.floating_ohm / self.std_ohm
        # If w is 0, so is k: then no voltage could be kept.
        k = np.sum(w * u, axis=1) / np.maximum(np.sum(w * w, axis=1), 1e-30)
        return np.asarray(np.sum((u - np.clip(k, 0, 1)[:, None] * w) ** 2, axis=1))

    def _median_ohm(self, lines: Bool) -> float:
        """Median of the mean segments of these lines, by mask; of all lines if it is empty."""
        ohm = self.fit.ohm[lines] if lines.any() else self.fit.ohm
        return max(float(np.median(ohm.mean(axis=1))), 1.0)  # 1 ohm: a prior is divided by it

    @property
    def wire_ohm(self) -> Float:
        """Segments (L, n); the usual ones where a line is not measured."""
        return np.maximum(np.where(self.measured[:, None], self.fit.ohm, self.usual_ohm), 0.0)

    def place(self, lines: Iterable[int]) -> Place:
        """Lines of this layer, by index."""
        return Place.of_lines(self.axis, (self.numbers[line] for line in lines))

    def report_shorts(self, diagnosis: Diagnosis) -> None:
        """Add shorted lines that are joined at their far ends, and not at their near ends.

        Joined anywhere, N lines share the current of a port, so that each has 1/N of it. If they
        are joined at their near ends, this flows up to the crossing: through so many segments on
        average as A says. If they are joined at their far ends, the port's line also carries the
        current of the N - 1 others, through all of its segments. The limit is midway.
        """
        for group in self.shorts:
            line = self.numbers.index(group[0])
            near_segments = float(self.current_share[line].sum(axis=1).mean())
            far_segments = near_segments + (len(group) - 1) * len(self.across)
            loss_ohm = len(group) * self.loss_ohm[line].mean() - self.lead_ohm
            if loss_ohm > self.usual_ohm * (near_segments + far_segments) / 2:
                diagnosis.add(Kind.SHORT_FAR, Place.of_lines(self.axis, group))

    def report_ends(self, ends_ohm: Float, dead: Bool, diagnosis: Diagnosis) -> None:
        """Add far ends that do not show their lines.

        ends_ohm: what `FarSkin.ends` gives for this layer.
        dead: dead cells, (R, C).
        """
        # A broken yarn explains its far end. Such a line is not reported as swapped or open, too.
        for line in lines_of(self.lost):
            self.lost[line] = not self._report_broken(line, dead, diagnosis)
        off = (self.beyond_ohm - ends_ohm) / self.std_ohm
        chi2 = np.mean(off**2, axis=2)  # axes: the line whose end may be read, the line
        np.fill_diagonal(chi2, np.inf)  # its own end has been judged
        swapped = self.lost & ~self._silent & (chi2.min(axis=0) < MANY_STDS**2)
        for kind, lines in ((Kind.SWAPPED_FAR, swapped), (Kind.OPEN_FAR, self.lost & ~swapped)):
            if lines.any():
                diagnosis.add(kind, self.place(lines_of(lines)))

    def _report_broken(self, line: int, dead: Bool, diagnosis: Diagnosis) -> bool:
        """Add a broken yarn if that is why the far end of this line is lost; whether it is.

        The yarn is broken if all cells of the line beyond some crossing are dead. The finding
        explains these cells.
        """
        number = self.numbers[line]
        in_line = np.take(dead, number, axis=self.axis)[self.across]
        alive = np.flatnonzero(~in_line)
        beyond = self.across[alive[-1] + 1 :] if alive.size else []
        if not beyond:
            return False
        explained = np.zeros_like(dead)
        np.moveaxis(explained, self.axis, 0)[number, beyond] = True
        values = {"between": (self.across[alive[-1]], beyond[0])}
        place, cells = self.place([line]), Place.of_cells(explained)
        diagnosis.findings.append(Finding(Kind.BROKEN_YARN, place, values, cells))
        return True

    def report_wires(self, nominal_ohm: float | None, diagnosis: Diagnosis) -> None:
        """Add lines that are clearly not as they should be, and the wire of each measured line.

        All lines together are compared with `nominal_ohm`, if it is known. Then each line is
        compared with the usual one, unless one bad segment explains it.
        """
        measured = list(lines_of(self.measured))
        if nominal_ohm and measured:
            self._compare(measured, nominal_ohm, diagnosis)
        if len(self.measured) > 2:  # of two lines, nobody can say which is usual
            one_bad = self._fit_one_bad(self.usual_ohm)
            for line in measured:
                if not self._report_segment(line, one_bad, diagnosis):
                    self._compare([line], self.usual_ohm, diagnosis)
        for line in measured:
            ohm, by_lead = self.fit.ohm[line], self.lead_std_ohm * self.fit.by_lead[line]
            covariance = self.fit.covariance[line] + np.outer(by_lead, by_lead)
            whole = float(ohm.sum()), float(covariance.sum()) ** 0.5
            segments = ohm.tolist(), (covariance.diagonal() ** 0.5).tolist()
            diagnosis.lines.append(LineWire(self.place([line]), *whole, *segments))

    def usual_segment(self) -> tuple[float, float] | None:
        """Median segment of the measured lines [ohm], so that one bad line does not count, and the
        deviation of its log. None if no line is measured.
        """
        if not self.measured.any():
            return None
        fit, lines = self.fit, self.measured
        line_ohm = float(np.median(fit.ohm[lines].sum(axis=1)))
        # The variance of a median is pi / 2 times that of a mean. An error of the lead is the same
        # in all lines, so that no mean makes it smaller.
        own_std_ohm = np.median(fit.covariance[lines].sum(axis=(1, 2)) ** 0.5)
        own_std_ohm *= (np.pi / 2 / lines.sum()) ** 0.5
        by_lead = self.lead_std_ohm * np.median(fit.by_lead[lines].sum(axis=1))
        log_std = float(np.hypot(own_std_ohm, by_lead)) / max(line_ohm, 1e-9)
        return line_ohm / len(self.across), log_std

    def _report_segment(self, line: int, one_bad: Fit, diagnosis: Diagnosis) -> bool:
        """Add a bad segment if one explains this line, and take its fit; whether one does.

        It explains the line if it does so clearly better than usual segments alone, and as well as
        segments of another mean, and if what it adds is a large enough share of the line.

        one_bad: what `_fit_one_bad` gives of all lines.
        """
        costs, none_bad_cost = one_bad.cost[:-1, line], one_bad.cost[-1, line]
        # Readings at rest hardly tell where in the line it is: these segments explain it alike. The
        # nearest one is named first, since it has the crimp in it, or is nearest to that. Crimps
        # fail more often than yarn.
        candidates = np.flatnonzero(costs < costs.min() + ALIKE_COST)
        k = int(candidates[0])
        more_ohm = float(one_bad.ohm[k, line, k]) - self.usual_ohm
        explains = costs[k] < min(self.fit.cost[line] + ALIKE_COST, none_bad_cost - MANY_STDS**2)
        if not explains or more_ohm < CHANGED_SHARE * len(self.across) * self.usual_ohm:
            return False
        for of_lines, of_one_bad in zip(self.fit, one_bad, strict=True):
            of_lines[line] = of_one_bad[k, line]
        std_ohm = float(one_bad.covariance[k, line, k, k]) ** 0.5
        # Between which lines it is. Before the first one is the electrode, -1.
        between = self.across[k - 1] if k else -1, self.across[candidates[-1]]
        kind, place = Kind.BAD_SEGMENT if k else Kind.BAD_CRIMP, self.place([line])
        diagnosis.add(kind, place, between=between, more_ohm=more_ohm, std_ohm=std_ohm)
        return True

    def _compare(self, lines: list[int], segment_ohm: float, diagnosis: Diagnosis) -> None:
        """Add lines, by index, if their median is clearly not that of segments of `segment_ohm`."""
        ohm = float(np.median(self.fit.ohm[lines].sum(axis=1)))
        std_ohm = float(np.median(self.fit.covariance[lines].sum(axis=(1, 2)) ** 0.5))
        usual_ohm = len(self.across) * segment_ohm
        # Two sound lines differ, since segments scatter.
        scatter_ohm = (2 / len(self.across)) ** 0.5 * SEGMENT_STD * max(ohm, usual_ohm)
        # Both were measured, the usual one as the median of all L lines. The variance of a median
        # is pi / 2 times that of a mean, which has 1 / L of a line's.
        both_std_ohm = (1 + np.pi / 2 / len(self.measured)) ** 0.5 * std_ohm
        doubt_ohm = FEW_STDS * float(np.hypot(both_std_ohm, scatter_ohm))
        if abs(ohm - usual_ohm) > CHANGED_SHARE * usual_ohm + doubt_ohm:
            values = {"ohm": ohm, "std_ohm": std_ohm, "usual_ohm": usual_ohm}
            diagnosis.add(Kind.LINE_WIRE, self.place(lines), **values)


def near_ends(rest: Rest) -> Rest:
    """What mode near would have read of a skin that was read in mode far.

    Mode near also reads c and d, with the drive reversed. On an exact board, c = 1 - b and
    d = 1 - a, so that is what they are taken for. But on a real board they have the converter's
    offset with the other sign, which cancels in the mean of all four. Here it does not cancel:
    `offset_lsb`.
    """
    a, _, b, _ = np.moveaxis(rest.codes, -1, 0)
    codes = np.stack([a, b, LARGEST_CODE - b, LARGEST_CODE - a], axis=-1)
    board = replace(rest.board, mode="near")
    return replace(rest, board=board, codes=codes, offset_lsb=2 * ADC_ERROR_LSB)


def _agreed(own: tuple[float, float], *others: tuple[float, float]) -> tuple[float, float]:
    """The mean by precision of a lead and of those others that do not contradict it.

    Each is a lead and its deviation [ohm], and so is the mean.
    """
    ohm, std_ohm = own
    for other_ohm, other_std_ohm in others:
        if abs(ohm - other_ohm) < ALIKE_STDS * np.hypot(std_ohm, other_std_ohm):
            precisions = std_ohm**-2.0, other_std_ohm**-2.0
            if total := sum(precisions):  # 0: neither is known
                ohm = (precisions[0] * ohm + precisions[1] * other_ohm) / total
                std_ohm = total**-0.5
    return max(ohm, 0.0), std_ohm


def _wires_of(layers: Sequence[_Layer], lead_ohm: tuple[float, float]) -> WireOhm | None:
    """Segment of each layer, and the leads [ohm]; None if a segment is not known of both layers.

    lead_ohm: the leads and their deviation.
    """
    segments = [each for layer in layers if (each := layer.usual_segment()) is not None]
    if len(segments) < 2 or max(log_std for _, log_std in segments) > KNOWN_STD:
        return None
    (top, top_log_std), (bottom, bottom_log_std) = segments
    lead, lead_std_ohm = lead_ohm if np.isfinite(lead_ohm[1]) else (None, None)
    return WireOhm(top, bottom, lead, top_log_std, bottom_log_std, lead_std_ohm)


def examine_far(rest: Rest, near: LinesAndCells, diagnosis: Diagnosis) -> None:
    """Add the wires of all lines, and what is wrong with far ends.

    rest: readings of mode far. Where no wires are told, lines are compared with each other alone.
    near: what the near ends show.
    """
    kept = [list(lines_of(~left_out)) for left_out in near.left_out]
    skin, expected_lead = FarSkin(rest, kept), rest.lead_ohm
    layers = [_Layer(axis, skin, near.shorts[axis], expected_lead) for axis in (0, 1)]
    wire_ohm: Float = np.zeros((2, *skin.shape))
    for _ in range(ROUNDS):
        leads_ohm = sum(layer.lead_ohm for layer in layers)
        shares = skin.current_shares(wire_ohm, leads_ohm)
        own_leads = [each.own_lead(share) for each, share in zip(layers, shares, strict=True)]
        for layer, current_share, own, of_other in zip(
            layers, shares, own_leads, own_leads[::-1], strict=True
        ):
            layer.fit_lines(current_share, _agreed(own, of_other, expected_lead))
        wire_ohm = np.stack([layers[0].wire_ohm, layers[1].wire_ohm.T])
    ends_ohm = skin.ends(wire_ohm)
    for layer, ends, nominal in zip(layers, ends_ohm, rest.told.both or (None, None), strict=True):
        layer.report_shorts(diagnosis)
        layer.report_ends(ends, near.dead, diagnosis)
        layer.report_wires(nominal, diagnosis)
    # What is told counts as measured. A lead that is only usual does not.
    lead_ohm = _agreed(*own_leads, *(() if rest.told.lead is None else (expected_lead,)))
    diagnosis.wires_by_far_ends = _wires_of(layers, lead_ohm)
    if np.isfinite(lead_ohm[1]):
        ohm, std_ohm = map(round, lead_ohm)
        diagnosis.measured |= {"lead_ohm": ohm, "lead_std_ohm": std_ohm}
