# SPDX-License-Identifier: Apache-2.0
"""Estimators: from readings to cell conductances. `METHODS` lists them by name."""

from __future__ import annotations

from ohmskin.estimators.base import Estimate, Estimator, SkinKnowledge
from ohmskin.estimators.joint import JointEstimator
from ohmskin.estimators.matrix import MatrixEstimator
from ohmskin.estimators.ohm import OhmEstimator
from ohmskin.estimators.paper import LsqEstimator, RegularizedEstimator
from ohmskin.estimators.touch import TouchEstimator

METHODS: dict[str, type[Estimator]] = {
    method.name: method
    for method in (
        OhmEstimator,
        MatrixEstimator,
        LsqEstimator,
        RegularizedEstimator,
        JointEstimator,
        TouchEstimator,
    )
}


def make_estimator(method: str, knowledge: SkinKnowledge) -> Estimator:
    """The estimator called `method`. Raises ValueError, with the names there are, if none is."""
    if method not in METHODS:
        raise ValueError(f"no method '{method}': choose one of {', '.join(METHODS)}")
    return METHODS[method](knowledge)


__all__ = [
    "METHODS",
    "Estimate",
    "Estimator",
    "OhmEstimator",
    "SkinKnowledge",
    "make_estimator",
]
