# SPDX-License-Identifier: Apache-2.0
"""The wires: what is believed of them, and how touches correct it.

Symbols

====== =========== ============================================================== ==========
symbol shape       meaning                                                        unit
====== =========== ============================================================== ==========
w      (2RC,)      log resistances of the segments, top layer, then bottom layer  log ohm
P0     (2RC, 2RC)  prior covariance: own part of each segment, common part of each layer
U      (2RC, n)    what was learned: P = P0 - U U^T
J      (m, 2RC)    slope of m readings by w, over their noise                      1
N      (m, m)      covariance of these readings' noise, cells of unknown force in it
====== =========== ============================================================== ==========

A frame is one step of a Kalman filter: with z the residual at the mean and S = N + J P J^T,

    mean += P J^T S^-1 z ,     P -= P J^T S^-1 J P .

The common part of a layer is most of P0, so it is what the first touches settle; segments follow.
A touch alone reveals nothing, as its own resistance is in the same reading: N holds the touched
cells as noise without limit. Between frames knowledge fades, U shrinks: a skin bends.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg

from ohmskin.arrays import Float
from ohmskin.circuit.cholesky import cholesky, gram, solve, solve_lower
from ohmskin.estimate.prior import LAYER_STD, SEGMENT_STD, UNKNOWN_LAYER_STD, UNKNOWN_WIRE_OHM

FADE: Final = 0.1  # share of the knowledge that fades with each lesson: skins bend
# Lessons, the last few together, that ask for a change of a layer by so many standard deviations
# say that the skin has been bent.
MEMORY: Final = 0.8
ALARM: Final = 1.6  # three times what they scatter by: lessons state their noise on the safe side
MAX_DIRECTIONS: Final = 32  # columns of U; the least informative are forgotten
_LEAST_DIRECTION: Final = 1e-3  # of SEGMENT_STD^2: not worth a column
Lesson = tuple[Float, Float, Float]
LOG_LIMITS: Final = (np.log(1e-6), np.log(1e7))


class WireBelief:
    """Mean and covariance of the log wire resistances of a skin of rows x columns."""

    def __init__(
        self, rows: int, columns: int, nominal_top: float | None, nominal_bottom: float | None
    ) -> None:
        cells = rows * columns
        told = nominal_top is not None and nominal_bottom is not None
        self._cells = cells
        self._layer_std = LAYER_STD if told else UNKNOWN_LAYER_STD
        nominal = [
            np.log(max(UNKNOWN_WIRE_OHM if ohm is None else ohm, 1e-3))
            for ohm in (nominal_top, nominal_bottom)
        ]
        self._nominal = np.repeat(nominal, cells)
        self.reset()

    def reset(self) -> None:
        """Back to the nominal wires."""
        self.mean = self._nominal
        self.forget()

    @property
    def is_fresh(self) -> bool:
        """Whether nothing has been learned."""
        return self._learned.shape[1] == 0

    def forget(self) -> None:
        """Back to the prior's covariance; the mean stays as the best guess there is."""
        self._learned = np.zeros((2 * self._cells, 0))
        self._slope, self._curvature = np.zeros(2), np.full(2, 1e-9)

    def times(self, slopes: Float) -> Float:
        """P J^T, shape (2RC, m), or P a for a vector (2RC,)."""
        rows = slopes.reshape(*slopes.shape[:-1], 2, self._cells)
        product = SEGMENT_STD**2 * rows
        product += self._layer_std**2 * rows.sum(axis=-1, keepdims=True)
        product = product.reshape(slopes.shape)
        if self._learned.shape[1]:
            product -= (slopes @ self._learned) @ self._learned.T
        return np.asarray(product.T)

    def seen(self, slopes: Float, onto: Float | None = None) -> Float:
        """J P J^T, what the wires' uncertainty does to m readings: lower triangle (m, m).

        Added onto a matrix that is overwritten, if there is one.
        """
        layers = slopes.reshape(len(slopes), 2, self._cells).sum(axis=2)
        seen = gram(slopes, SEGMENT_STD**2, onto)
        seen = gram(layers, self._layer_std**2, seen)
        return gram(slopes @ self._learned, -1.0, seen) if self._learned.shape[1] else seen

    def variance(self, slopes: Float) -> Float:
        """Diagonal of J P J^T, (m,)."""
        layers = slopes.reshape(len(slopes), 2, self._cells).sum(axis=2)
        learned = slopes @ self._learned
        variance = SEGMENT_STD**2 * np.einsum("ij,ij->i", slopes, slopes)
        variance += self._layer_std**2 * np.einsum("ij,ij->i", layers, layers)
        return np.asarray(variance - np.einsum("ij,ij->i", learned, learned))

    def std(self) -> Float:
        """Standard deviation of each log resistance, (2RC,)."""
        variance = SEGMENT_STD**2 + self._layer_std**2 - np.sum(self._learned**2, axis=1)
        return np.asarray(np.sqrt(np.maximum(variance, 1e-12)))

    def paths(self, log_wires: Float, shape: tuple[int, int]) -> tuple[Float, Float]:
        """Wire between each cell and its electrodes [ohm], and the deviation of its log, (RC,)."""
        top, bottom = np.exp(log_wires).reshape(2, *shape)
        path_ohm = np.cumsum(top, axis=1) + np.cumsum(bottom, axis=0)
        return path_ohm.ravel(), self.std().reshape(2, -1).mean(axis=0)

    def learn(self, slopes: Float, residual: Float, noise: Float) -> bool:
        """One Kalman step; True if lessons say that the skin was bent: what was learned is dropped.

        slopes: J (m, 2RC); residual: z (m,) at the mean; noise: N (m, m).
        """
        if len(residual) < 2:
            return False
        self._learned *= np.sqrt(1 - FADE)
        spread = self.times(slopes)
        factor = cholesky(noise + slopes @ spread)
        # Slope and curvature of the likelihood along a change of a whole layer.
        layers = slopes.reshape(len(slopes), 2, self._cells).sum(axis=2)
        pulls = solve(factor, np.column_stack([residual, layers]))
        self._slope = MEMORY * self._slope + layers.T @ pulls[:, 0]
        self._curvature = MEMORY * self._curvature + np.sum(layers * pulls[:, 1:], axis=0)
        bent = False
        if np.any(self._slope**2 > ALARM**2 * self._curvature):
            self.forget()
            bent = True
            spread = self.times(slopes)
            factor = cholesky(noise + slopes @ spread)
            pulls = solve(factor, residual[:, None])
        self.mean = np.clip(self.mean + spread @ pulls[:, 0], *LOG_LIMITS)
        gain = solve_lower(factor, spread.T)
        learned = np.concatenate([self._learned, gain.T], axis=1)
        size, turn = scipy.linalg.eigh(learned.T @ learned, check_finite=False)
        kept = np.flatnonzero(size > _LEAST_DIRECTION * SEGMENT_STD**2)[-MAX_DIRECTIONS:]
        self._learned = learned @ turn[:, kept]
        return bent
