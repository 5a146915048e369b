# SPDX-License-Identifier: Apache-2.0
"""Estimators: from readings to cell conductances. `METHODS` lists them by name."""

from __future__ import annotations

from ohmskin.estimate.base import Estimate, Estimator, SkinKnowledge
from ohmskin.estimate.joint import JointEstimator
from ohmskin.estimate.matrix import MatrixEstimator
from ohmskin.estimate.ohm import OhmEstimator
from ohmskin.estimate.paper import LsqEstimator, RegularizedEstimator
from ohmskin.estimate.touch import TouchEstimator

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
