# SPDX-License-Identifier: Apache-2.0
"""What is believed of a skin's wires: before any frame, and after what frames have shown.

Symbols

====== ========== =============================================================== ==========
symbol shape      meaning                                                         unit
====== ========== =============================================================== ==========
R, C              number of rows and of columns
m      (2,)       log of the mean segment of each layer: top, bottom              log ohm
V      (2, 2)     its covariance; V0 before any frame
s      scalar     deviation of a segment from its layer's mean, each by itself    log ohm
L      (2, 2RC)   ones: which segments are of which layer
P      (2RC, 2RC) covariance of the log segments, L^T V L + s^2
J      (n, 2RC)   slope of n readings by the log segments, over their noise       1
N      (n, n)     covariance of these readings, were the layers known: of their   1
                  noise, of cells, and of what segments have of their own
S      (n, n)     covariance of these readings, N + J L^T V L J^T                 1
z      (n,)       residual of these readings at the mean                          1
====== ========== =============================================================== ==========

P^1/2 has a column for each segment's own deviation, and two for what the segments of the layers
share: s and L^T V^1/2.

There are two beliefs, and `joint` asks both the same: `before_fit`, what this frame and those
before say of the wires; `after_fit`, to learn from the fit. `LearnedWires`, below, knows near ends
only: there a frame says something of the wires once its touches are known, so it learns after the
fit. `MeasuredWires` (`far_wires`) knows far ends: they show the wires before the fit.

A lesson of `LearnedWires` is one step of a Kalman filter,

    m += V L J^T S^-1 z ,     V -= V L J^T S^-1 J L^T V .

The first frame of a touch is noisy, as it changes. A calmer one of the same touch takes its place:
its step starts from m and V as they were before the touch. What its readings alone say of m is the
information A, the inverse of a covariance:

    A = L J^T N^-1 J L^T = V^-T/2 (1 - X)^-1 X V^-1/2 ,     X = V^T/2 L J^T S^-1 J L^T V^1/2 ,

V^1/2 the Cholesky factor of V, and V^T/2 its transpose.

A touch alone reveals nothing, as its own resistance is in the same reading: N holds the touched
cells as noise without limit. After a lesson V grows back towards V0: a skin bends. What single
segments have of their own is not learned: frames of near ends say too little of it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit
from ohmskin.circuit.small import solve, solve_lower
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    FADE_SHARE,
    LAYER_STD,
    MAX_STEP_LOG,
    SEGMENT_STD,
    UNKNOWN_LAYER_STD,
    UNKNOWN_WIRE_OHM,
)


class Lesson(NamedTuple):
    """What n readings of one frame say of the wires.

    per_layer_std: J L^T V^1/2, (n, 2).
    residual: z, (n,).
    factor: Cholesky factor of S, (n, n).
    """

    per_layer_std: Float
    residual: Float
    factor: Float


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
    path_ohm: wires between each cell and the sensed ends of its lines, (RC,) [ohm].
    """

    segment_ohm: Float
    segment_std_ohm: Float
    path_ohm: Float


class WireBelief(ABC):
    """Mean and covariance of the log wire resistances of a skin, whoever has shown them.

    shape: (rows, columns).
    far: whether rows, and columns, are sensed at their far ends.
    log_layers: m, (2,). It is replaced when the belief changes, and never written into.
    """

    def __init__(
        self, shape: tuple[int, int], wires: WireOhm, far: tuple[bool, bool] = (False, False)
    ) -> None:
        """wires: what is known of them before any frame."""
        self.shape, self.far = shape, far
        ohms = wires.top, wires.bottom
        layer_std = UNKNOWN_LAYER_STD if None in ohms else LAYER_STD
        # However well wires were measured: since then, the skin may have been stretched.
        measured_std = [std or 0.0 for std in (wires.top_log_std, wires.bottom_log_std)]
        self._prior_covariance = np.diag(np.hypot(layer_std, measured_std) ** 2)
        nominal = [UNKNOWN_WIRE_OHM if ohm is None else max(ohm, 1e-3) for ohm in ohms]
        self._nominal: Float = np.log(nominal)
        self.reset()

    def reset(self) -> None:
        """Forget what frames have shown."""
        self._lesson_cells: Float | None = None  # log resistances of the last lesson's frame
        root = np.asarray(np.linalg.cholesky(self._prior_covariance), np.float64)
        self._believe(self._nominal, root)

    def _believe(self, log_layers: Float, root: Float) -> None:
        """Take these for m and V^1/2."""
        self.log_layers, self._root = log_layers, root
        self._believed: SkinWires | None = None

    @abstractmethod
    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Take what this frame, and those before, say of the wires before its fit.

        log_cells: about what its cells have, (RC,).
        """

    @abstractmethod
    def after_fit(self, fit: Fit, ports: PortReadings) -> None:
        """Learn from a frame whose fit is to be trusted."""

    @abstractmethod
    def fix_rest_wires(self) -> None:
        """Take what is believed now, after fits of the rest readings, for the wires at rest."""

    def _is_news(self, log_cells: Float) -> bool:
        """Whether these cells (RC,) differ from the last lesson's by `MAX_STEP_LOG` somewhere.

        Frames that are alike have errors that are alike, from the same drift of cells and the same
        odd segments. A lesson from each of them would count one error as many independent ones.
        """
        before = self._lesson_cells
        return before is None or bool(np.abs(log_cells - before).max() >= MAX_STEP_LOG)

    def learned(self) -> WireOhm | None:
        """Mean segments of the layers, and the deviations of their logs. None before any lesson."""
        if self._lesson_cells is None:
            return None
        top, bottom = np.exp(self.log_layers).tolist()
        top_log_std, bottom_log_std = np.linalg.norm(self._root, axis=1).tolist()
        return WireOhm(top, bottom, top_log_std=top_log_std, bottom_log_std=bottom_log_std)

    def circuit(self, log_cells: Float, log_layers: Float) -> PortCircuit:
        """The skin with these logs of its cells (RC,), and of its layers' segments (2,)."""
        cell_siemens = np.exp(-log_cells).reshape(self.shape)
        return PortCircuit(cell_siemens, *np.exp(log_layers), far=self.far)

    @property
    def mean(self) -> Float:
        """Expected log resistances of the segments, (2RC,)."""
        return np.repeat(self.log_layers, self.shape[0] * self.shape[1])

    def layer_std(self) -> float:
        """Standard deviation of the log of the layer that is known less."""
        return float(np.hypot(*self._root.T).max())

    def per_layer_std(self, slopes: Float) -> Float:
        """J L^T V^1/2, (n, 2), from slopes by the layers' logs, J L^T (n, 2)."""
        return slopes @ self._root

    def per_std(self, slopes: Float) -> Float:
        """J P^1/2, (n, 2RC + 2), from J (n, 2RC): by what segments have, by what layers share."""
        root = np.empty((len(slopes), slopes.shape[1] + 2))
        np.multiply(slopes, SEGMENT_STD, out=root[:, :-2])
        root[:, -2:] = self.per_layer_std(slopes.reshape(len(slopes), 2, -1).sum(axis=2))
        return root

    def log_layers_off(self, layer_stds: Float) -> Float:
        """Logs of the layers (2,) that are so many deviations off: m + V^1/2 `layer_stds` (2,)."""
        return self.log_layers + self._root @ layer_stds

    def log_wires_off(self, layer_stds: Float, segment_stds: Float) -> Float:
        """Log resistances (2RC,) of layers that are so far off (2,), and segments (2RC,)."""
        common = np.repeat(self.log_layers_off(layer_stds), self.shape[0] * self.shape[1])
        # What comes from slopes holds as far as readings are linear in the logs.
        off_layer = np.minimum(np.maximum(SEGMENT_STD * segment_stds, -MAX_STEP_LOG), MAX_STEP_LOG)
        return common + off_layer

    def moved_since(self, log_layers: Float, per_layer_std: Float) -> Float:
        """What readings have moved since m was `log_layers` (2,): J L^T (m - log_layers), (n,)."""
        return np.asarray(per_layer_std @ solve_lower(self._root, self.log_layers - log_layers))

    def segment_ohm(self, log_wires: Float) -> Float:
        """Top and bottom segments (2, R, C) [ohm] of a fit that found these logs (2RC,)."""
        return np.asarray(np.exp(log_wires).reshape(2, *self.shape))

    def segment_std(self) -> Float:
        """Standard deviation of the log of each segment, for (2, R, C)."""
        return np.asarray(np.hypot(np.hypot(*self._root.T), SEGMENT_STD)[:, None, None])

    def wires(self, log_wires: Float) -> SkinWires:
        """The wires of an answer whose fit found these logs, (2RC,)."""
        top, bottom = segments = self.segment_ohm(log_wires)
        # A sensed far end has the potential of the cell, as no current flows from one to the other:
        # the wires of such a line do not count.
        by_top, by_bottom = (0.0 if is_far else 1.0 for is_far in self.far)
        path = by_top * top.cumsum(axis=1) + by_bottom * bottom.cumsum(axis=0)
        return SkinWires(segments, segments * self.segment_std(), path.ravel())

    def believed_wires(self) -> SkinWires:
        """The wires as believed, for answers whose fit took them so: made once for each belief."""
        if self._believed is None:
            self._believed = wires = self.wires(self.mean)
            for array in (wires.segment_ohm, wires.segment_std_ohm):
                array.setflags(write=False)  # they are in more than one estimate
        return self._believed


class LearnedWires(WireBelief):
    """Wires at near ends: touches that share wires reveal the layers, a Kalman step a touch."""

    def reset(self) -> None:
        """Back to the nominal wires."""
        super().reset()
        self._lesson_noise = np.inf  # mean deviation of the last lesson's currents [S]
        self._before_lesson = self.log_layers, self._root

    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Nothing: before its touches are known, a frame of near ends shows no wires."""

    def fix_rest_wires(self) -> None:
        """Nothing: an untouched skin shows no wires, as its cells resist far more than they do."""

    def after_fit(self, fit: Fit, ports: PortReadings) -> None:
        """Learn from a touch that is new, or again from a calmer frame of the last one.

        The calmer frame must not count as one more, since both have the touch's errors. So it
        takes the place of the other.
        """
        noise = float(ports.current_std.mean())
        is_news = self._is_news(fit.log_cells)
        if is_news or noise < self._lesson_noise:
            self._lesson_cells, self._lesson_noise = fit.log_cells, noise
            self.take(fit.lesson, replace_last=not is_news)

    def take(self, lesson: Lesson, *, replace_last: bool = False) -> None:
        """One Kalman step.

        replace_last: undo the last lesson first, by a step from where that lesson started. A lesson
            that says nothing undoes nothing.
        """
        if not replace_last:
            self._before_lesson = self.log_layers, self._root
        per_layer_std, residual, factor = lesson
        # One reading shows its own touch, of unknown resistance, and so nothing of the wires.
        if len(residual) < 2:
            return
        # The lesson counts in deviations of the belief that the fit had, but the step may start
        # from an older belief. So the lesson is first changed to logs, and freed of that belief:
        #     L J^T N^-1 = V^-T/2 (1 - X)^-1 V^T/2 L J^T S^-1     are the `weights`,
        # X is `gain @ per_layer_std`, and A is `information`. The step from V and m of the older
        # belief is V' = (V^-1 + A)^-1, m' = m + V' L J^T N^-1 z: the same as that by S above.
        gain = solve(factor, per_layer_std).T
        per_log = np.linalg.inv(self._root)
        weights = per_log.T @ np.linalg.inv(np.eye(2) - gain @ per_layer_std) @ gain
        information = weights @ per_layer_std @ per_log
        before, root = self._before_lesson
        # z is the residual at the mean that the fit had, which is `self.log_layers`. At the mean
        # that the step starts from, the residual differs by what the mean has moved since.
        pull = weights @ residual + information @ (self.log_layers - before)
        covariance = np.linalg.inv(np.linalg.inv(root @ root.T) + information)
        log_layers = before + covariance @ pull
        covariance += FADE_SHARE * (self._prior_covariance - covariance)
        self._believe(log_layers, np.asarray(np.linalg.cholesky(covariance), np.float64))
