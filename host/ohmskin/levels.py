# SPDX-License-Identifier: Apache-2.0
"""What a cell shows, before it is a force: its conductance by an estimator, or its raw reading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.circuit import Float
from ohmskin.estimators import METHODS, Estimate, OhmEstimator, SkinKnowledge, make_estimator
from ohmskin.force import voltage_level

VOLTAGE: Final = "voltage"
LEVEL_METHODS: Final = (*METHODS, VOLTAGE)


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
