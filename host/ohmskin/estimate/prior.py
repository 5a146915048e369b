# SPDX-License-Identifier: Apache-2.0
"""What is expected of a skin's resistances before a frame is read: its cells, and its wires.

RC readings do not determine 3RC resistances; these numbers decide the rest. Touches correct what is
believed of the wires:

====== ========== =============================================================== ==========
symbol shape      meaning                                                         unit
====== ========== =============================================================== ==========
m      (2,)       log of the mean segment of each layer: top, bottom              log ohm
C      (2, 2)     its covariance; C0 before any frame
s      scalar     deviation of a segment from its layer's mean, each by itself    log ohm
L      (2, 2RC)   ones: which segments are of which layer
P      (2RC, 2RC) covariance of the log segments, L^T C L + s^2
J      (m, 2RC)   slope of m readings by the log segments, over their noise       1
N      (m, m)     covariance of these readings' noise, cells of unknown force in it
====== ========== =============================================================== ==========

A frame is one step of a Kalman filter: with z the residual at the mean and S = N + J P J^T,

    m += C L J^T S^-1 z ,     C -= C L J^T S^-1 J L^T C .

The first frame of a touch is noisy, as it changes. A calmer one of the same touch takes its place:
its step starts from m and C as they were before the touch. What its readings alone say is

    A = L J^T N^-1 J L^T = C^-1/2 (1 - X)^-1 X C^-1/2 ,     X = C^1/2 L J^T S^-1 J L^T C^1/2 .

A touch alone reveals nothing, as its own resistance is in the same reading: N holds the touched
cells as noise without limit. After it C grows back towards C0: a skin bends. What single segments
have of their own is not learned: frames say too little of it.

P^1/2 has a column for each segment's own deviation, and two for what the segments of the layers
share: s and L^T C^1/2.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.small import solve, solve_lower
from ohmskin.estimate.knowledge import WireOhm

# Deviations (..._STD) are of the log of a resistance.
UNTOUCHED_STD: Final = 1.0  # of a cell about all cells' level, before its rest is read
UNKNOWN_REST_STD: Final = 0.3  # of a cell whose rest readings are not known, about all cells' level
REST_STD: Final = 0.05  # drift of a cell since the rest readings
HIGHEST_TOUCH_SIEMENS: Final = 1 / 300.0  # the hardest touch
# A cell that the prior holds at rest may be touched all the same, where readings say little of it.
TOUCHED: Final = 2.0  # deviations of the prior: further from rest, a cell's force is unknown
UNLIMITED_STD: Final = 3.0  # what is not known of such a cell
HIDDEN: Final = 0.3  # a rise that must not go unnoticed
# Under soft fingertips, rest is no more likely than a touch: many cells rise, neighbours alike.
CROWDED: Final = 0.3  # share of touched cells: above it, they are many
SOFT: Final = 0.5  # correlation of the rises of neighbours: above it, they are alike

UNKNOWN_WIRE_OHM: Final = 150.0  # a segment of a layer whose nominal value is not known
UNKNOWN_LAYER_STD: Final = 0.7  # what all segments of such a layer share: a factor of two
LAYER_STD: Final = 0.3  # the same where it is known: stretch, temperature
SEGMENT_STD: Final = 0.1  # what each segment has of its own
FADE: Final = 0.1  # share of the knowledge of the wires that fades with each lesson: skins bend

MAX_ITERATIONS: Final = 40
CLOSE: Final = 0.5  # deviations: a step that moves no reading or cell by more is the last
MISFIT: Final = 1.5  # chi-square per port: above it no resistances explain the readings
# Of the log of a resistance: no step of a fit is larger, and a frame that differs by it is news.
MAX_STEP: Final = 1.5
REACH: Final = 2.0  # deviations of what is normal that make as many deviations of a conductance

Lesson = tuple[Float, Float, Float]  # what wires learn from: J L^T C^1/2, z and the factor of S


@dataclass(frozen=True, eq=False)
class CellPrior:
    """Log resistance of the cells: normal near rest, heavy-tailed further away.

    With d the distance from `expected` over `std`, -2 log p is d^2 up to d = 1, and goes on with
    the same slope as 1 + log(d^2): the density falls as 1 / d, the same for all hardnesses of a
    touch. Cells at rest are a quadratic problem, which costs no iterations; being touched is
    unlikely, but how hard, once a cell is, costs little.
    expected, std: (RC,) [log ohm].
    """

    expected: Float
    std: Float

    def rise(self, log_ohm: Float) -> Float:
        """How far a cell conducts more than at rest, in deviations."""
        return (self.expected - log_ohm) / self.std

    def touches(self, log_ohm: Float) -> int:
        """Number of touched cells."""
        return int(np.count_nonzero(self.rise(log_ohm) > TOUCHED))

    def is_soft(self, log_ohm: Float, shape: tuple[int, int]) -> bool:
        """Whether cells (RC,) rise as under soft fingertips: many of them, neighbours alike.

        Differences of neighbours have 2 (1 - c) times the variance of single cells, c their
        correlation.
        """
        if self.touches(log_ohm) <= CROWDED * log_ohm.size:
            return False
        rise = (self.expected - log_ohm).reshape(shape)
        apart = np.concatenate([np.diff(rise, axis=axis).ravel() for axis in (0, 1)])
        return bool(apart @ apart < 2.0 * (1.0 - SOFT) * rise.var() * apart.size)

    def unsure(self) -> "CellPrior":
        """What is expected where rest is no more likely: any cell, of the level at rest."""
        return CellPrior(self.expected, np.maximum(self.std, UNTOUCHED_STD))

    def normal(
        self, log_ohm: Float, cells: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[Float, Float]:
        """Mean and variance of the normal that has this prior's slope there."""
        expected = self.expected[cells]
        away = log_ohm - expected
        return expected, np.maximum(self.std[cells] ** 2, away * away)


class WireBelief:
    """Mean and covariance of the log wire resistances of a skin of rows x columns."""

    def __init__(self, rows: int, columns: int, wires: WireOhm) -> None:
        """wires: what is known of them before any frame."""
        self.shape = (rows, columns)
        *ohms, log_std = wires
        layer_std = UNKNOWN_LAYER_STD if None in ohms else LAYER_STD
        # Both together, and what differs between them: a measurement tells their sum.
        apart = 0.5 * layer_std**2
        both = apart if log_std is None else float(np.clip(log_std, 0.01, 1.0)) ** 2
        self._prior_covariance = both + max(apart, both) * np.array([[1.0, -1.0], [-1.0, 1.0]])
        nominal = [UNKNOWN_WIRE_OHM if ohm is None else max(ohm, 1e-3) for ohm in ohms]
        self._nominal: Float = np.log(nominal)
        self.reset()

    def reset(self) -> None:
        """Back to the nominal wires."""
        self.log_layers = self._nominal
        self._root: Float = np.asarray(np.linalg.cholesky(self._prior_covariance), np.float64)
        self._untaught = self.log_layers, self._root  # before the last lesson

    @property
    def mean(self) -> Float:
        """Expected log resistances, (2RC,)."""
        return np.repeat(self.log_layers, self.shape[0] * self.shape[1])

    def by_layers(self, slopes: Float) -> Float:
        """J L^T C^1/2, (m, 2), from slopes by the layers' logs (m, 2)."""
        return slopes @ self._root

    def root(self, slopes: Float) -> Float:
        """J P^1/2, (m, 2RC + 2), from J (m, 2RC): what each segment has, and what layers share."""
        root = np.empty((len(slopes), slopes.shape[1] + 2))
        np.multiply(slopes, SEGMENT_STD, out=root[:, :-2])
        root[:, -2:] = self.by_layers(slopes.reshape(len(slopes), 2, -1).sum(axis=2))
        return root

    def away(self, layers: Float) -> Float:
        """Logs of the layers (2,) that are m + C^1/2 away, from what is normal (2,)."""
        return self.log_layers + self._root @ layers

    def log_wires(self, layers: Float, segments: Float) -> Float:
        """Log resistances (2RC,) from what is normal: of layers (2,), of segments (2RC,)."""
        common = np.repeat(self.away(layers), self.shape[0] * self.shape[1])
        own = np.minimum(np.maximum(SEGMENT_STD * segments, -MAX_STEP), MAX_STEP)
        return common + own  # it is linear there

    def moved(self, by_layers: Float, log_layers: Float) -> Float:
        """J (m - m'), (m,): change of readings since m' (2,), log_layers then."""
        return np.asarray(by_layers @ solve_lower(self._root, self.log_layers - log_layers))

    def std(self) -> float:
        """Standard deviation of the log of the layer that is known less."""
        return float(np.hypot(*self._root.T).max())

    def learned(self) -> WireOhm:
        """Mean segments of the layers, and the deviation of the log of both together."""
        top, bottom = np.exp(self.log_layers)
        log_std = float(np.linalg.norm(self._root.sum(axis=0)) / 2)
        return WireOhm(float(top), float(bottom), log_std)

    def layers(self, log_wires: Float) -> Float:
        """Top and bottom segments (2, R, C) [ohm] of these log resistances (2RC,)."""
        return np.asarray(np.exp(log_wires).reshape(2, *self.shape))

    def segment_std(self) -> Float:
        """Standard deviation of the log of each segment, for (2, R, C)."""
        return np.asarray(np.hypot(np.hypot(*self._root.T), SEGMENT_STD)[:, None, None])

    def learn(
        self, by_layers: Float, residual: Float, factor: Float, *, instead: bool = False
    ) -> None:
        """One Kalman step from a `Lesson`. residual: z (m,) at the mean; factor: of S (m, m).

        instead: of the last lesson, which is forgotten.
        """
        if not instead:
            self._untaught = self.log_layers, self._root
        if len(residual) < 2:
            return
        left = solve(factor, by_layers).T
        of_log = np.linalg.inv(self._root)
        alone = of_log.T @ np.linalg.inv(np.eye(2) - left @ by_layers) @ left
        information = alone @ by_layers @ of_log
        before, root = self._untaught
        pull = alone @ residual + information @ (self.log_layers - before)
        covariance = np.linalg.inv(np.linalg.inv(root @ root.T) + information)
        self.log_layers = before + covariance @ pull
        covariance += FADE * (self._prior_covariance - covariance)
        self._root = np.asarray(np.linalg.cholesky(covariance), np.float64)


def path_ohm(
    top_wire_ohm: Float, bottom_wire_ohm: Float, *, far: tuple[bool, bool] = (False, False)
) -> Float:
    """Wire between each cell and its electrodes [ohm], (RC,), but that up to sensed far ends."""
    top, bottom = (0.0 if is_far else 1.0 for is_far in far)
    path = top * top_wire_ohm.cumsum(axis=1) + bottom * bottom_wire_ohm.cumsum(axis=0)
    return np.asarray(path.ravel())


def rest_level(current_siemens: Float, ref_ohm: float) -> float:
    """Conductance of untouched cells, all alike, from port currents per Vdd (R, C) [S].

    A port of R x C equal cells g, without wires, is (R + C - 1) / (R C g). Touches make every port
    conduct more, most of all those of touched cells: this goes by the median port.
    """
    rows, columns = current_siemens.shape
    current = float(np.median(current_siemens))
    port_ohm = max(1.0 / max(current, 1e-9) - ref_ohm, 1.0)
    level = (rows + columns - 1) / (rows * columns * port_ohm)
    return float(min(level, HIGHEST_TOUCH_SIEMENS))


def siemens_std(
    log_siemens: Float, log_std: Float, by_layers: Float, layer_std: float, series_ohm: Float
) -> tuple[Float, Float]:
    """Standard deviations of conductances, upwards and downwards [S]: halves of two deviations.

    log_std: of the log conductance, to first order; by_layers: what the layers' wires have in it;
    layer_std: the deviation of their log. series_ohm: wires to the cell and references. All (RC,).
    Errors are normal in the current u = 1 / (r + series), not in g = 1 / r, and the wires' in their
    log: upwards, behind much series resistance, a cell may be anything that a touch makes of it.
    """
    siemens = np.exp(log_siemens)
    cell_ohm = 1.0 / siemens
    wider = np.expm1(REACH * layer_std) / (REACH * layer_std)
    up_std = np.sqrt(log_std**2 + (wider**2 - 1.0) * by_layers**2)
    share = REACH * cell_ohm / (cell_ohm + series_ohm)
    more, less = up_std * share, np.minimum(log_std * share, 1.0 - 1e-6)
    lowest_ohm = (cell_ohm - more * series_ohm) / (1.0 + more)
    highest_ohm = (cell_ohm + less * series_ohm) / (1.0 - less)
    highest = 1.0 / np.maximum(lowest_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS)
    up = np.maximum(siemens * log_std, (highest - siemens) / REACH)
    return np.asarray(up), np.asarray((siemens - 1.0 / highest_ohm) / REACH)
