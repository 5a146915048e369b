# SPDX-License-Identifier: Apache-2.0
"""What is believed of a skin's wires and leads: before any frame, and after what frames have shown.

A lead is what lies between the multiplexer's common pin and the first crossing of a line. It
carries the whole current of a port and no other. So the leads of a port's lines add to its
resistance as the references do, if its lines are sensed at near ends. At a far end, no current
flows, and leads are not in the readings.

Symbols

====== ========== =============================================================== ==========
symbol shape      meaning                                                         unit
====== ========== =============================================================== ==========
R, C              number of rows and of columns
W                 number of wires: 2RC segments and R+C leads
w      (W,)       the wires: logs of the segments, then leads                     log ohm, ohm
m      (n,)       log of the mean segment of each layer, top and bottom; the mean log ohm, ohm
                  lead; how much each line's lead differs from it, as a share of
                  it: n = 3 + R+C. On a damp skin, two more: what neighbouring    uS
                  rows, and columns, leak into each other at each crossing.
                  Where wires are long, what each segment's log differs from its
                  layer's mean by, 2RC more
V      (n, n)     its covariance; V0 before any frame
s      (2RC,)     deviation of a segment from its mean, each by itself; 0 if m    log ohm
                  has single segments
L      (n, W)     dw / dm: which wires are of which mean
P      (W, W)     covariance of w, L^T V L + s^2
J      (k, W)     slope of k readings by w, over their noise
N      (k, k)     covariance of these readings if the means were known: of their  1
                  noise, of cells, and of what wires differ from their means by
====== ========== =============================================================== ==========

Leads are no logs, because a lead may be next to nothing, and because readings are nearly linear in
them. P^1/2 has a column for each segment's own deviation (s), and one for each of m (L^T V^1/2).

There are two kinds of belief, and `joint` asks the same of both: `before_fit`, what this frame and
those before say of the wires; `after_fit`, to learn from the fit. `LearnedWires`
(`near_wires`) is for skins that are read at near ends only. There, a frame says something of the
wires once its touches are known, so it learns after the fit. `MeasuredWires` (`far_wires`) is for
far ends, which show the wires before the fit.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit, wires_add_ohm
from ohmskin.circuit.skin import incidence
from ohmskin.circuit.small import solve_lower
from ohmskin.estimate.knowledge import LEAST_WIRE_OHM, WireOhm
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    LAYER_STD,
    MAX_STEP_LOG,
    REACH_STDS,
    SEGMENT_STD,
    UNKNOWN_LAYER_STD,
    UNKNOWN_LEAD_STD_OHM,
    UNKNOWN_WIRE_OHM,
    UNTOLD_REACH_STDS,
    USUAL_LAYER_STD,
    USUAL_LEAD_STD_OHM,
    UpperLimits,
)

# A frame is fitted again if its lesson moves the log of a mean by more. Chosen: 30 %, up to which
# slopes are nearly right.
LARGE_MOVE_LOG: Final = 0.3
# A frame is fitted so often at most. Chosen: the time of a frame stays bounded.
MOST_FITS: Final = 4
# A leak of a fit may be this far below 0 [uS]. No leak is, but a limit at 0, of which slopes do not
# know, would keep fits of small leaks from ending. Chosen: as much as 10 MOhm, the other way.
LOWEST_LEAK_US: Final = -0.1

CircuitT = TypeVar("CircuitT", bound=PortCircuit)


class Lesson(NamedTuple):
    """What k readings of one frame say of the wires.

    per_mean_std: J L^T V^1/2, (k, n), with the V that the fit had.
    residual: of these readings at its m, (k,).
    factor: Cholesky factor of N, (k, k).
    """

    per_mean_std: Float
    residual: Float
    factor: Float


def without_means(log_std: Float, by_means_std: Float, belief: "WireBelief") -> tuple[Float, Float]:
    """Two attributes of a fit, `own_log_std` (k,) and `by_means` (k, 3), of k cells.

    log_std: deviation of the log resistance, (k,). by_means_std: the parts of it that come from the
    means of both layers and the mean lead, as the fit took them from this belief, (k, 3).
    """
    of_means = np.einsum("ij,ij->i", by_means_std, by_means_std)
    own = np.sqrt(np.maximum(log_std * log_std - of_means, 0.0))
    return own, np.abs(by_means_std) / belief.means_std()[:3]


class Fit(Protocol):
    """What wires learn from: the fit of one frame."""

    @property
    def log_cells(self) -> Float:
        """Log resistances of the cells, (RC,)."""

    @property
    def lesson(self) -> Lesson:
        """What the readings say of the wires; a fit may compute it only now."""


@dataclass(frozen=True, eq=False)
class SkinWires:
    """The wires as an answer reports them.

    segment_ohm: segments of top and bottom layer, (2, R, C) [ohm].
    segment_std_ohm: their standard deviations, (2, R, C) [ohm].
    path_ohm: wires and leads between each cell and the sensed ends of its lines, (RC,) [ohm].
    hidden_path_ohm: what of it curves of presses take for a part of the cell, (RC,) [ohm]: what
        single wires differ from their means by, and what the means were told wrongly by.
    """

    segment_ohm: Float
    segment_std_ohm: Float
    path_ohm: Float
    hidden_path_ohm: Float


@dataclass(eq=False)
class _State:
    """What fits take for the wires: m, V, and what follows: its root, the deviations of m, and the
    wires and their upper limits, once asked for.
    """

    means: Float
    covariance: Float
    wires: SkinWires | None = None
    limits: UpperLimits | None = None

    def __post_init__(self) -> None:
        self.root: Float = np.asarray(np.linalg.cholesky(self.covariance), np.float64)
        self.means_std: Float = np.sqrt(self.covariance.diagonal())


class WireBelief(ABC):
    """Mean and covariance of the wires of a skin, and of its leaks, whoever has shown them.

    Segments are in logs of ohms, the mean lead in ohms, what each line's lead differs from it by in
    shares of it, leaks in uS.

    shape: (rows, columns).
    far: whether rows, and columns, are sensed at their far ends.
    told: what was known of them before any frame.
    means: m, (n,). It is replaced when the belief changes, and never written into.
    untold: whether nobody told them, and not both far ends measure them.
    leads_of_ports: which leads are in the readings of each port: those of its lines that are sensed
        at near ends, (RC, R+C), ones and zeros.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        wires: WireOhm,
        far: tuple[bool, bool] = (False, False),
        *,
        may_be_bent: bool = True,
    ) -> None:
        """The belief before any frame.

        wires: what is known of them.
        may_be_bent: whether the skin may have been bent since they were measured.
        """
        self.shape, self.far, self.told, self._may_be_bent = shape, far, wires, may_be_bent
        rows, columns = shape
        self.leads_of_ports: Float = np.abs(incidence(rows, columns)) * ~np.repeat(far, shape)
        # How many top segments, bottom segments and leads are up to each cell, (3, RC).
        row, column = np.divmod(np.arange(rows * columns), columns)
        by_row, by_column = np.logical_not(far)
        leads = self.leads_of_ports.sum(axis=1)
        self._wires_of_paths = np.array([by_row * (column + 1), by_column * (row + 1), leads])
        self.untold = wires.both is None and not all(far)
        layer_std = UNKNOWN_LAYER_STD if wires.both is None else LAYER_STD
        layer_stds = np.array([wires.top_log_std or 0.0, wires.bottom_log_std or 0.0])
        # However well wires were measured: since then, the skin may have been stretched. No
        # measurement is believed to be better than 1 %.
        if may_be_bent or not layer_stds.all():
            layer_stds = np.hypot(layer_std, layer_stds)
        layer_stds = np.maximum(layer_stds, 0.01)
        lead_ohm, lead_std_ohm = wires.lead_or_usual(UNKNOWN_LEAD_STD_OHM)
        lead_std_ohm = max(lead_std_ohm, 1e-3)
        usual_layer_stds = layer_stds if wires.both else np.full(2, USUAL_LAYER_STD)
        usual_lead_std_ohm = min(USUAL_LEAD_STD_OHM, lead_std_ohm)
        self._usual_stds = np.array([*usual_layer_stds, usual_lead_std_ohm])
        # Where each line's own lead is in m.
        self._of_lines = slice(3, 3 + rows + columns)
        # Where leaks are in m, and what segments differ from their means by: at first, nowhere.
        self._of_leaks = self._of_segments = slice(3 + rows + columns, 3 + rows + columns)
        own = np.full(rows + columns, SEGMENT_STD)
        self._prior_covariance = np.diag([*layer_stds, lead_std_ohm, *own]) ** 2
        nominal = [
            UNKNOWN_WIRE_OHM if ohm is None else max(ohm, LEAST_WIRE_OHM) for ohm in wires[:2]
        ]
        self._nominal: Float = np.array([*np.log(nominal), lead_ohm, *np.zeros(rows + columns)])
        self.reset()

    def expect_leaks(self, leaks_us: Float, stds_us: Float) -> None:
        """Know that lines leak, by the rest readings, and forget what frames have shown.

        leaks_us: from row to row, and from column to column, at each crossing (2,) [uS].
        stds_us: their deviations (2,) [uS].
        """
        wires = self._of_lines.stop
        self._of_leaks = slice(wires, wires + 2)
        self._of_segments = slice(wires + 2, wires + 2)
        self._nominal = np.concatenate([self._nominal[:wires], leaks_us])
        stds = np.sqrt(np.diagonal(self._prior_covariance)[:wires])
        self._prior_covariance = np.diag(np.concatenate([stds, stds_us])) ** 2
        self.reset()

    def learn_segments(self) -> None:
        """From now on, learn what each segment's log differs from its layer's mean by.

        It never ends, not even by `reset`: where nothing is known of single segments yet, answers
        are nearly the same whether they are in m or noise of the same deviation.
        """
        own = np.zeros(2 * self.leads_of_ports.shape[0])
        self._of_segments = slice(self._nominal.size, self._nominal.size + own.size)
        self._nominal = np.concatenate([self._nominal, own])
        self._prior_covariance = self._with_segments(self._prior_covariance)
        means = np.concatenate([self._known.means, own])
        self._believe(means, self._with_segments(self._known.covariance))

    def _with_segments(self, covariance: Float) -> Float:
        """This covariance of m, if single segments are in m as well, of which nothing is known."""
        own = SEGMENT_STD**2 * np.eye(2 * self.leads_of_ports.shape[0])
        return np.asarray(block_diag(covariance, own), np.float64)

    def line_ohm(self) -> float:
        """Resistance of the wire of a row or of a column, whichever is more, end to end [ohm]."""
        return float((np.exp(self.means[:2]) * self.shape[::-1]).max())

    @property
    def learns_segments(self) -> bool:
        """Whether what single segments differ from their means by is in m."""
        return self._of_segments.stop > self._of_segments.start

    @property
    def unlearned_std(self) -> float:
        """s, the deviation of a segment's log from its mean that is not in m."""
        return 0.0 if self.learns_segments else SEGMENT_STD

    def reset(self) -> None:
        """Forget what frames have shown.

        Single segments that were in m stay there, as if nothing were known of them: see
        `learn_segments`.
        """
        self._lesson_cells: Float | None = None  # log resistances of the last lesson's frame
        self._believe(self._nominal, self._prior_covariance)

    def _believe(self, means: Float, covariance: Float) -> None:
        """Take these means (n,), with this covariance (n, n), for what is known.

        Layers and leads that nobody has told may be anything up to kilohms, and lessons must be
        able to show that. But most skins have usual ones. Frames that tell nothing of them, as
        those of fingertips do, are answered better if fits expect the usual ones. So there are two
        states: `_known`, and `_usual`, which also has a prior of usual layers and leads. Where a
        known mean is far from the usual one, this prior is as wide as they are apart: like that of
        a cell, it has a heavy tail (`prior.CellPrior`). Upper deviations of conductances come from
        what is known.
        """
        self._known = self._usual = _State(means, covariance)
        shared = np.arange(3)  # both layers and the lead
        away = np.abs(means - self._nominal)[shared]
        known = 1.0 / self._prior_covariance[shared, shared]
        usual = np.maximum(np.maximum(self._usual_stds, away) ** -2.0 - known, 0.0)
        if usual.any():
            information = np.linalg.inv(covariance)
            right = information @ means
            information[shared, shared] += usual
            right[shared] += usual * self._nominal[shared]
            covariance = np.linalg.inv(information)
            self._usual = _State(covariance @ right, covariance)
        self.expect_usual(True)

    def expect_usual(self, wanted: bool) -> None:
        """Let m and V be the usual ones, for a frame that may tell nothing, or what is known."""
        self._state = self._usual if wanted else self._known
        self.means, self._root = self._state.means, self._state.root

    @abstractmethod
    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Take what this frame, and those before, say of the wires before its fit.

        log_cells: about what its cells have, (RC,).
        """

    @abstractmethod
    def after_fit(
        self, fit: Fit, ports: PortReadings, tip_log: Float | None = None, *, again: bool = False
    ) -> bool:
        """Learn from a frame whose fit is to be trusted.

        tip_log: of a frame with fingertips, how far all its cells conduct more than at rest, (RC,)
            [log S].
        again: it is another fit of the same frame, in place of what the last one has taught.
        Returns whether this has moved what is believed so far that the frame wants another fit:
        slopes hold for small moves only.
        """

    @abstractmethod
    def fix_rest_wires(self) -> None:
        """Take what is believed now, after fits of the rest readings, for the wires at rest."""

    def _has_moved(self, log_cells: Float) -> bool:
        """Whether these cells (RC,) differ from the last lesson's by `MAX_STEP_LOG` somewhere.

        Frames that are alike have errors that are alike, from the same drift of cells and the same
        odd segments. A lesson from each of them would count one error as many independent ones.
        """
        before = self._lesson_cells
        return before is None or bool(np.abs(log_cells - before).max() >= MAX_STEP_LOG)

    @property
    def fault(self) -> str:
        """What frames have shown to be wrong with the wires, in words, or empty."""
        return ""

    def learned(self) -> WireOhm | None:
        """The means, and their deviations. None before any lesson."""
        return None if self._lesson_cells is None else self._as_known()

    def _as_known(self) -> WireOhm:
        means, variance = self._known.means, self._known.covariance.diagonal()
        top, bottom = np.exp(means[:2]).tolist()
        lead = max(float(means[2]), 0.0)
        return WireOhm(top, bottom, lead, *np.sqrt(variance[:3]).tolist())

    def circuit(self, log_cells: Float, means: Float, kind: type[CircuitT]) -> CircuitT:
        """The skin with these logs of its cells (RC,), and these means (n,), without its leads."""
        siemens, leaks = np.exp(-log_cells).reshape(self.shape), self.leak_siemens(means)
        # One number for all segments of a layer is faster than many that are alike.
        wires = means[:2] if not self.learns_segments else self._log_segments(means)
        return kind(siemens, *np.exp(wires), far=self.far, leak_siemens=leaks)

    def leak_siemens(self, means: Float) -> tuple[float, float]:
        """From row to row, and from column to column, at each crossing, by these means (n,) [S]."""
        if not self.has_leaks:
            return 0.0, 0.0
        by_row, by_column = (1e-6 * max(leak, LOWEST_LEAK_US) for leak in self.leaks(means))
        return by_row, by_column

    def leaks(self, means: Float) -> Float:
        """The leaks among these means (n,), or what else comes in their order, (2,), or none."""
        return means[self._of_leaks]

    @property
    def has_leaks(self) -> bool:
        """Whether the means have two leaks after the leads."""
        return self.leaks(self.means).size > 0

    def lead_ohm(self, means: Float) -> Float:
        """The lead of each line by these means (n,), (R+C,) [ohm]."""
        return np.asarray(means[2] * (1.0 + means[self._of_lines]))

    def lost_ohm(self, impedance: Float, cell_siemens: Float) -> Float:
        """What wires and leads add to the ports of cells (R, C) [S], (R, C) [ohm], nearly.

        impedance: Z of these cells without wires, as of `solve_ports`. A line that is sensed at its
        far end is taken to add nothing.
        """
        top_ohm, bottom_ohm = np.exp(self.means[:2]) * np.logical_not(self.far)
        leads_ohm = self.leads_of_ports @ self.lead_ohm(self.means)
        lost = wires_add_ohm(impedance, cell_siemens, (top_ohm, bottom_ohm))
        return lost + leads_ohm.reshape(self.shape)

    def by_means(
        self,
        by_segment: Float,
        means: Float,
        ports: NDArray[np.intp] | slice = slice(None),
        by_leaks: Float | None = None,
    ) -> Float:
        """How the resistance of k ports follows the means, at these means, (k, n).

        by_segment: how it follows the logs of the segments, (k, 2RC). If m has no single segments,
            it may as well be how it follows those of the layers, (k, 2).
        by_leaks: how it follows the leaks, (k, 2); None: m has no leaks.
        """
        slopes, leads = np.empty((len(by_segment), means.size)), self.leads_of_ports[ports]
        by_segment.reshape(len(slopes), 2, -1).sum(axis=2, out=slopes[:, :2])
        slopes[:, 2] = leads @ (1.0 + means[self._of_lines])
        np.multiply(means[2], leads, out=slopes[:, self._of_lines])
        if by_leaks is not None:
            slopes[:, self._of_leaks] = by_leaks
        if self.learns_segments:
            slopes[:, self._of_segments] = by_segment
        return slopes

    @property
    def expected_wires(self) -> Float:
        """Expected wires w, (W,)."""
        return self._wires_of(self.means)

    def _wires_of(self, means: Float) -> Float:
        return np.concatenate([self._log_segments(means).ravel(), self.lead_ohm(means)])

    def _log_segments(self, means: Float) -> Float:
        """Logs of top and bottom segments by these means (n,), (2, R, C) [log ohm]."""
        logs = np.repeat(means[:2], self.leads_of_ports.shape[0])
        if self.learns_segments:
            logs += means[self._of_segments]
        return logs.reshape(2, *self.shape)

    def means_std(self) -> Float:
        """Standard deviations of `means`, (n,)."""
        return self._state.means_std

    def odd_lead_ohm(self) -> float:
        """Deviation of a lead from the mean lead, in so far as the mean lead is not known [ohm].

        A lesson takes it for noise: the mean lead may be large, and large leads differ by more.
        """
        return SEGMENT_STD * self._known_lead_std_ohm

    @property
    def is_assumed(self) -> bool:
        """Whether nobody has told the layers, nor frames taught both of them to `LAYER_STD`."""
        return self.untold and float(self._known.means_std[:2].max()) >= LAYER_STD

    def upper_limits(self) -> UpperLimits:
        """How large the means of both layers and of the lead may be: made once for each belief.

        Their upper limits are `REACH_STDS` deviations above them: not those that fits take, but
        those of what is known (`_believe`), and of wires that may just have grown longer. As layers
        are normal in their log, their limits are further up than to first order. While nobody has
        told the layers, their limits count as more deviations, the less frames have taught of them.
        """
        if self._known.limits is None:
            known = self._known.means_std[:3]
            reach, count = REACH_STDS * known, np.full(3, REACH_STDS)
            reach[:2] = np.expm1(REACH_STDS * np.maximum(self._layer_limit_stds(), known[:2]))
            if self.untold:
                taught = REACH_STDS * known[:2] / LAYER_STD
                count[:2] = np.clip(taught, REACH_STDS, UNTOLD_REACH_STDS)
            self._known.limits = UpperLimits(reach, reach / count)
        return self._known.limits

    def _layer_limit_stds(self) -> Float:
        """How far above their means upper limits of both layers (2,) are, counted as deviations."""
        return self._known.means_std[:2]

    @property
    def _known_lead_std_ohm(self) -> float:
        return float(self._known.covariance[2, 2] ** 0.5)

    def per_mean_std(self, slopes: Float) -> Float:
        """J L^T V^1/2 from slopes by the means, J L^T: one row a reading, one column a mean."""
        return slopes @ self._root

    def per_std(self, by_segment: Float, by_means: Float) -> Float:
        """J P^1/2: by what segments have of their own (2RC columns), and by the means (n).

        The first columns are missing where m has single segments.
        by_segment: J of the log segments, (k, 2RC). by_means: J L^T, (k, n).
        """
        if self.learns_segments:
            return self.per_mean_std(by_means)
        segments = by_segment.shape[1]
        root = np.empty((len(by_segment), segments + by_means.shape[1]))
        np.multiply(by_segment, SEGMENT_STD, out=root[:, :segments])
        np.matmul(by_means, self._root, out=root[:, segments:])
        return root

    def means_off(self, mean_stds: Float) -> Float:
        """The means (n,) that are so many deviations off: m + V^1/2 `mean_stds` (n,)."""
        return self.means + self._root @ mean_stds

    def wires_off(self, mean_stds: Float, segments_off: Float) -> Float:
        """w (W,): means `mean_stds` (n,) deviations off, and segments by more.

        segments_off: what the logs of segments differ from their means by, (2RC,).
        """
        wires = self._wires_of(self.means_off(mean_stds))
        # What comes from slopes holds as far as readings are linear in the logs.
        wires[: segments_off.size] += np.clip(segments_off, -MAX_STEP_LOG, MAX_STEP_LOG)
        return wires

    def moved_since(self, means: Float, per_mean_std: Float) -> Float:
        """What readings have moved since m was `means` (n,): J L^T (m - means)."""
        return np.asarray(per_mean_std @ solve_lower(self._root, self.means - means))

    def segment_ohm(self, wires: Float) -> Float:
        """Top and bottom segments (2, R, C) [ohm] of a fit that found these wires w (W,)."""
        segments = 2 * self.leads_of_ports.shape[0]
        return np.asarray(np.exp(wires[:segments]).reshape(2, *self.shape))

    def segment_std(self) -> Float:
        """Standard deviation of the log of each segment, for (2, R, C)."""
        if not self.learns_segments:
            return np.asarray(np.hypot(self.means_std()[:2], SEGMENT_STD)[:, None, None])
        segments = self._root[self._of_segments].reshape(2, -1, self._root.shape[1])
        stds = np.linalg.norm(segments + self._root[:2, None], axis=2)
        return np.asarray(stds.reshape(2, *self.shape))

    def wires(self, wires: Float, means: Float) -> SkinWires:
        """The wires of an answer whose fit found these, w (W,), and these means (n,)."""
        segments = self.segment_ohm(wires)
        leads = np.maximum(wires[segments.size :], 0.0)
        path_ohm = self._path_ohm(segments, leads)
        top_ohm, bottom_ohm = np.exp(means[:2]).tolist()
        curve_ohm = self.told.of_curves((top_ohm, bottom_ohm, float(means[2])))
        hidden_ohm = path_ohm - curve_ohm @ self._wires_of_paths
        return SkinWires(segments, segments * self.segment_std(), path_ohm, hidden_ohm)

    def _path_ohm(self, segments: Float, leads: Float) -> Float:
        """Wires and leads up to each cell, (RC,), by segments (2, R, C) and leads (R+C,) [ohm]."""
        # A sensed far end has the potential of the cell, as no current flows from one to the other:
        # the wires of such a line do not count.
        by_top, by_bottom = (0.0 if is_far else 1.0 for is_far in self.far)
        path = by_top * segments[0].cumsum(axis=1) + by_bottom * segments[1].cumsum(axis=0)
        return np.asarray(path.ravel() + self.leads_of_ports @ leads)

    def believed_wires(self) -> SkinWires:
        """The wires as believed, for answers whose fit took them so: made once for each belief."""
        if self._state.wires is None:
            self._state.wires = wires = self.wires(self.expected_wires, self.means)
            for array in (wires.segment_ohm, wires.segment_std_ohm):
                array.setflags(write=False)  # they are in more than one estimate
        return self._state.wires
