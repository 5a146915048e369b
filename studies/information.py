# SPDX-License-Identifier: Apache-2.0
"""What the readings of one frame can tell at all: the posterior's standard deviation at the truth.

Symbols, at the true resistances

====== ============ ================================================================ ==========
symbol shape        meaning                                                          unit
====== ============ ================================================================ ==========
J_p    (RC, k)      d current / d log r of the k pressed cells, over the noise       1
B      (RC, n)      the same of everything else, times the root of its prior         1
S      (RC, RC)     B B^T + 1: the readings' covariance if the pressed cells stood   1
====== ============ ================================================================ ==========

With W the inverse variance of the port currents and P the covariance of the prior, the posterior
covariance of the log resistances is (J^T W J + P^-1)^-1: the Cramer-Rao bound with a prior (Van
Trees 1968, section 2.4). A pressed cell's prior is so wide that P - P J^T (J P J^T + 1)^-1 J P
would cancel to nothing, so the pressed cells come last:

    covariance of the pressed cells   V = (J_p^T S^-1 J_p + 1/PRESSED_STD^2)^-1
    variance of a cell at rest        s^2 (1 - b^T S^-1 b + b^T S^-1 J_p V J_p^T S^-1 b)

with s its prior's deviation and b its column of B. The priors are those of `joint`, but for the
cells: it is known which are pressed. No estimator of one frame does better on average, as far as
the circuit is linear within these deviations; one that remembers earlier frames may, for it can
know the wires better than the prior does.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import Skin
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.prior import (
    LAYER_STD,
    REST_STD,
    SEGMENT_STD,
    UNKNOWN_REST_STD,
    USUAL_LAYER_STD,
)
from ohmskin.link.protocol import ADC_BITS
from studies.trials import Trial

# Prior standard deviation of a pressed cell's log conductance: nine decades within one deviation
# either way is no knowledge.
PRESSED_STD: Final = 10.0


def information_limit(
    skin: Skin,
    knowledge: SkinKnowledge,
    pressed: NDArray[np.bool_],
    *,
    rest_std: float | None = None,
    layer_std: float | None = None,
) -> Float:
    """Standard deviation of each cell's conductance over its true value, shape (R, C).

    skin: the truth. knowledge: what an estimator is told; without rest readings or nominal wires
    the priors are wider, as in `joint`. pressed: (R, C).
    rest_std, layer_std: how well cells at rest and the mean of each layer's wires are known, of the
    log, instead of the priors of `joint`; 0: exactly.
    Raises ValueError for an open cell.
    """
    if not np.all(skin.cell_siemens > 0):
        raise ValueError("cells must conduct: an open one has no relative deviation")
    free = pressed.ravel()
    if rest_std is None:
        rest_std = UNKNOWN_REST_STD if knowledge.rest_ratio is None else REST_STD
    if layer_std is None:
        layer_std = USUAL_LAYER_STD if knowledge.nominal_wire_ohm.both is None else LAYER_STD

    circuit = PortCircuit(skin.cell_siemens, skin.top_wire_ohm, skin.bottom_wire_ohm)
    current = 1.0 / (circuit.port_ohm + knowledge.ref_ohm)
    slope = (current**2 / knowledge.current_std)[:, None]
    by_cell, by_wire = slope * circuit.by_cell(), slope * circuit.by_wires()
    at_rest = rest_std * by_cell[:, ~free]
    layers = layer_std * by_wire.reshape(free.size, 2, free.size).sum(axis=2)
    others = np.hstack([at_rest, SEGMENT_STD * by_wire, layers])
    factor = scipy.linalg.cholesky(others @ others.T + np.eye(free.size), lower=True)

    told = scipy.linalg.solve_triangular(factor, by_cell[:, free], lower=True)
    precision = told.T @ told
    precision[np.diag_indices_from(precision)] += PRESSED_STD**-2
    root = np.linalg.inv(np.linalg.cholesky(precision))  # V = root^T root
    learned = scipy.linalg.solve_triangular(factor, at_rest, lower=True)
    shared = root @ (told.T @ learned)

    std = np.empty(free.size)
    std[free] = np.sqrt(np.sum(root**2, axis=0))
    share = 1.0 - np.sum(learned**2, axis=0) + np.sum(shared**2, axis=0)
    std[~free] = rest_std * np.sqrt(np.maximum(share, 1e-12))  # as far as rounding lets it be known
    return std.reshape(skin.shape)


def pressed_limits(
    trial: Trial,
    frames: slice,
    *,
    bits: int | None = ADC_BITS,
    wires_told: bool = True,
    **known: float | None,
) -> Float:
    """The limits of the pressed cells in these frames of a trial, one after the other, (n,).

    known: `rest_std` and `layer_std` of `information_limit`.
    """
    knowledge = trial.rounded(bits, wires_told=wires_told).knowledge(0)
    limits = [
        information_limit(skin, knowledge, pressed, **known)[pressed]
        for skin, pressed in zip(trial.frames[frames], trial.pressed[frames], strict=True)
    ]
    return np.concatenate(limits)
