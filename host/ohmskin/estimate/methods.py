# SPDX-License-Identifier: Apache-2.0
"""The estimators by name. A method's module is imported when one is made."""

from importlib import import_module
from typing import Final

from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge

_WHERE: Final = {
    "ohm": ("ohm", "OhmEstimator"),
    "matrix": ("matrix", "MatrixEstimator"),
    "lsq": ("paper", "LsqEstimator"),
    "regularized": ("paper", "RegularizedEstimator"),
    "joint": ("joint", "JointEstimator"),
    "touch": ("joint", "TouchEstimator"),
    "voltage": ("ohm", "VoltageEstimator"),
}
VOLTAGE: Final = "voltage"  # its levels are no conductances
LEVEL_METHODS: Final = tuple(_WHERE)  # all that a force can be read by
# All that estimate conductances of their own.
METHODS: Final = tuple(name for name in LEVEL_METHODS if name != VOLTAGE)


def make_estimator(method: str, knowledge: SkinKnowledge) -> Estimator:
    """The estimator called `method`. Raises ValueError as `kind_of`, and for what it refuses."""
    return kind_of(method)(knowledge)


def kind_of(method: str) -> type[Estimator]:
    """The class of a method, one of `LEVEL_METHODS`. Raises ValueError for any other name."""
    if method not in _WHERE:
        raise ValueError(f"no method '{method}': choose one of {', '.join(LEVEL_METHODS)}")
    module, name = _WHERE[method]
    kind: type[Estimator] = getattr(import_module(f"ohmskin.estimate.{module}"), name)
    return kind
