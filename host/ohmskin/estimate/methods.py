# SPDX-License-Identifier: Apache-2.0
"""The estimators by name.

The module of a method is imported when an estimator of it is made: CasADi alone, which `paper`
needs, takes longer to import than all others.
"""

from importlib import import_module
from typing import Final

from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge

# Module and class of each method.
_WHERE: Final = {
    "ohm": ("ohm", "OhmEstimator"),
    "matrix": ("matrix", "MatrixEstimator"),
    "lsq": ("paper", "LsqEstimator"),
    "regularized": ("paper", "RegularizedEstimator"),
    "joint": ("joint", "JointEstimator"),
    "touch": ("joint", "TouchEstimator"),
    "voltage": ("ohm", "VoltageEstimator"),
}
# The method whose levels are voltages, not conductances.
VOLTAGE: Final = "voltage"
# All methods that a force can be read by.
LEVEL_METHODS: Final = tuple(_WHERE)
# All methods that estimate conductances of their own. `voltage` takes those of `ohm`.
METHODS: Final = tuple(name for name in LEVEL_METHODS if name != VOLTAGE)


def make_estimator(method: str, knowledge: SkinKnowledge) -> Estimator:
    """The estimator called `method`. Raises ValueError as `kind_of`, and for what it refuses."""
    if not isinstance(knowledge, SkinKnowledge):
        given = f"a SkinKnowledge, such as SkinKnowledge.of(skin.info), not {knowledge!r:.40}"
        raise TypeError(f"'{method}' is made of {given}")
    return kind_of(method)(knowledge)


def kind_of(method: str) -> type[Estimator]:
    """The class of a method, one of `LEVEL_METHODS`. Raises ValueError for any other name."""
    if method not in _WHERE:
        raise ValueError(f"no method '{method}': choose one of {', '.join(LEVEL_METHODS)}")
    module, name = _WHERE[method]
    kind: type[Estimator] = getattr(import_module(f"ohmskin.estimate.{module}"), name)
    return kind
