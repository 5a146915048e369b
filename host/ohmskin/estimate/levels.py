# SPDX-License-Identifier: Apache-2.0
"""What a cell shows, before it is a force: its conductance by an estimator, or its raw reading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READING_OFFSET, READING_SIGN
from ohmskin.estimate.base import Estimate, SkinKnowledge
from ohmskin.estimate.methods import METHODS, make_estimator
from ohmskin.estimate.ohm import OhmEstimator

VOLTAGE: Final = "voltage"
LEVEL_METHODS: Final = (*METHODS, VOLTAGE)


def voltage_level(ratio: ArrayLike) -> Float:
    """What `voltage`, the paper's "naive" baseline, regresses on: (..., 4) [V/Vdd] to (...) [1].

    Mean over the configurations of sign (y - offset): voltage over the reference resistors, which
    grows with the cell's conductance. All four round alike, so its standard deviation is that of
    one reading (`SkinKnowledge.ratio_std`). Raises ValueError for another shape.
    """
    readings = np.asarray(ratio, dtype=np.float64)
    if readings.ndim < 1 or readings.shape[-1] != READING_SIGN.size:
        raise ValueError(f"ratio has shape {readings.shape}, it must end in {READING_SIGN.size}")
    return np.asarray((readings - READING_OFFSET) @ READING_SIGN / READING_SIGN.size)


@dataclass(frozen=True, eq=False)
class Level:
    """One frame. level, level_std: shape (R, C) [S], for `voltage` [1]. estimate: where it is from.

    `voltage` knows no circuit: its estimate is that of `ohm`, for what is touched and for faults.
    """

    level: Float
    level_std: Float
    estimate: Estimate


class LevelMeter:
    """Reads frame after frame by `method`: an estimator's name, or "voltage".

    Raises ValueError, with the names there are, for another.
    """

    def __init__(self, method: str, knowledge: SkinKnowledge) -> None:
        if method not in LEVEL_METHODS:
            raise ValueError(f"no method '{method}': choose one of {', '.join(LEVEL_METHODS)}")
        self._voltage = method == VOLTAGE
        self._estimator = make_estimator(OhmEstimator.name if self._voltage else method, knowledge)

    def rest(self) -> Float:
        """Levels of the rest readings, shape (R, C). Raises ValueError if none are known."""
        rest_ratio = self._estimator.knowledge.rest_ratio
        found = self._estimator.rest()
        if rest_ratio is None or found is None:
            raise ValueError("the readings of the untouched skin are not known")
        return voltage_level(rest_ratio) if self._voltage else found.cell_siemens

    def read(self, ratio: ArrayLike) -> Level:
        """Levels of one frame of readings (R, C, 4). Raises ValueError as `Estimator.estimate`."""
        estimate = self._estimator.estimate(ratio)
        if not self._voltage:
            return Level(estimate.cell_siemens, estimate.cell_siemens_std, estimate)
        level = voltage_level(ratio)
        return Level(level, np.full_like(level, self._estimator.knowledge.ratio_std), estimate)
