# SPDX-License-Identifier: Apache-2.0
"""The four configurations of a cell: what each reads of a port's current, and back to the current.

A configuration drives one electrode and senses the reference resistor of one layer, so each reading
is a straight line of the current I through the port, per volt of Vdd:

    y[k] = offset[k] + sign[k] R_ref[k] I .
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Bool, Float
from ohmskin.link.protocol import MODES

NEAR: Final = MODES["near"]
CONFIGURATIONS: Final = tuple(name.upper() for name in NEAR)
READINGS_PER_CELL: Final = len(NEAR)
# Of configurations A to D, in this order.
READING_OFFSET: Final[Float] = np.array([1.0, 0.0, 1.0, 0.0])
READING_SIGN: Final[Float] = np.array([-1.0, 1.0, -1.0, 1.0])
READING_SENSES_TOP: Final[Bool] = np.array([True, False, False, True])

# A node's reading with the top pin high, and its reading with the bottom pin high: near end of the
# row, near end of the column, far end of the row, far end of the column.
EXCHANGED: Final = {"a": "d", "b": "c", "e": "h", "f": "g"}

# A reference resistor, unless told [ohm]: that of the wiring in README.md.
DEFAULT_REF_OHM: Final = 30_000.0
# No reference, wire or lead has more [ohm]. Chosen: a gigohm. No converter sees a current through
# it, and squares of what is computed with it stay finite.
MAX_OHM: Final = 1e9


def check_references(ref_top_ohm: float, ref_bottom_ohm: float) -> None:
    """Raise ValueError unless both reference resistors are within 1..`MAX_OHM`."""
    for name, ohm in (("ref_top_ohm", ref_top_ohm), ("ref_bottom_ohm", ref_bottom_ohm)):
        if not 1 <= ohm <= MAX_OHM:
            raise ValueError(f"{name} must be from 1 to {MAX_OHM:g}, not {ohm:g}")


@lru_cache(maxsize=8)  # each frame asks for it again
def reference_ohm(ref_top_ohm: float, ref_bottom_ohm: float) -> Float:
    """The reference resistor that each configuration senses [ohm], shape (4,), read-only."""
    reference = np.where(READING_SENSES_TOP, ref_top_ohm, ref_bottom_ohm)
    reference.setflags(write=False)
    return reference


def ratio_from_current(
    current_siemens: ArrayLike, ref_top_ohm: float, ref_bottom_ohm: float
) -> Float:
    """y = offset + sign * R_ref * I, shape (..., 4), for currents per Vdd (...) [S]."""
    current = np.asarray(current_siemens, dtype=np.float64)[..., None]
    slope = READING_SIGN * reference_ohm(ref_top_ohm, ref_bottom_ohm)
    return np.asarray(READING_OFFSET + slope * current, dtype=np.float64)


def node_ratio(ratio: Float, reading_names: Sequence[str], node: str) -> Float:
    """Potential over Vdd of the node of reading a, b, e or f while the top pin is high, (...).

    It is the mean of those of the readings (..., n), of these names, that are taken at this node. A
    reading with exchanged supplies is 1 minus the potential. There must be one.
    """
    high = [ratio[..., k] for k, name in enumerate(reading_names) if name == node]
    low = [1 - ratio[..., k] for k, name in enumerate(reading_names) if name == EXCHANGED[node]]
    return np.asarray(sum(high + low) / len(high + low), dtype=np.float64)


def is_near(reading_names: Iterable[str]) -> bool:
    """Whether these are readings at near ends, some of a to d: all say the same of a skin."""
    return set(reading_names) <= set(NEAR)


def as_near(ratio: Float, reading_names: Sequence[str]) -> Float:
    """Readings a to d (..., 4), made of readings at both ends. Those of near ends alone stay."""
    if is_near(reading_names):
        return ratio
    a, b = (node_ratio(ratio, reading_names, node) for node in "ab")
    return np.stack([a, b, 1 - b, 1 - a], axis=-1)


def current_from_ratio(ratio: Float, ref_top_ohm: float, ref_bottom_ohm: float) -> Float:
    """I = sum_k R_k s_k (y_k - offset_k) / sum_k R_k^2, per Vdd [S], shape (...,) from (..., 4).

    Each reading alone gives I_k = s_k (y_k - offset_k) / R_k, with s_k its `READING_SIGN` and R_k
    the reference that it senses. If all readings are equally noisy, the mean with the weights R_k^2
    has the least variance.
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    weight = READING_SIGN * reference / (reference @ reference)
    return np.asarray((ratio - READING_OFFSET) @ weight, dtype=np.float64)


def current_std(ratio_std: float, ref_top_ohm: float, ref_bottom_ohm: float) -> float:
    """Standard deviation of `current_from_ratio` [S]: ratio_std * sum_k R_k / sum_k R_k^2.

    Deviations are added, and not variances, because without other noise all four readings are
    rounded alike. For independent noise, the result is too large by a factor of at most 2.
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    return float(ratio_std * np.sum(reference) / np.sum(reference**2))
