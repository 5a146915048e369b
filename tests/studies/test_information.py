# SPDX-License-Identifier: Apache-2.0
"""The information limit, against the dense formula with derivatives by finite differences."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, port_resistance_ohm, readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.prior import (
    LAYER_STD,
    REST_STD,
    SEGMENT_STD,
    UNKNOWN_REST_STD,
    USUAL_LAYER_STD,
)
from skins import uniform_skin
from studies.information import PRESSED_STD, information_limit

NOMINAL = {"nominal_wire_ohm": WireOhm(100.0, 200.0, 0.0)}


def skin_of(rows: int, columns: int, pressed: int, seed: int) -> tuple[Skin, NDArray[np.bool_]]:
    random = np.random.default_rng(seed)
    cell = 1e-6 * np.exp(0.1 * random.standard_normal((rows, columns)))
    places = random.choice(cell.size, pressed, replace=False)
    cell.flat[places] = np.exp(random.uniform(np.log(1e-5), np.log(1e-3), pressed))
    top, bottom = (ohm * np.exp(0.1 * random.standard_normal(cell.shape)) for ohm in (100, 200))
    return Skin(cell, top, bottom), np.isin(np.arange(cell.size), places).reshape(cell.shape)


def dense_limit(
    skin: Skin, known: SkinKnowledge, pressed: NDArray[np.bool_], rest_std: float, layer_std: float
) -> Float:
    """sqrt diag (J^T W J + P^-1)^-1 of all 3RC log resistances, J by central differences."""
    logs = np.log([1 / skin.cell_siemens, skin.top_wire_ohm, skin.bottom_wire_ohm]).ravel()
    cells = skin.cell_siemens.size

    def current(log_ohm: Float) -> Float:
        cell, top, bottom = np.exp(log_ohm).reshape(3, *skin.shape)
        return 1 / (port_resistance_ohm(Skin(1 / cell, top, bottom)).ravel() + known.ref_ohm)

    steps = 1e-5 * np.eye(logs.size)
    jacobian = np.array([(current(logs + s) - current(logs - s)) / 2e-5 for s in steps]).T
    prior = np.zeros((logs.size, logs.size))
    prior[:cells, :cells] = np.diag(np.where(pressed.ravel(), PRESSED_STD, rest_std) ** 2)
    for first in (cells, 2 * cells):
        layer = slice(first, first + cells)
        prior[layer, layer] = SEGMENT_STD**2 * np.eye(cells) + layer_std**2
    # The root of J^T W J + P^-1, because squaring would lose half of the digits.
    whitened = np.linalg.inv(np.linalg.cholesky(prior))
    root = np.linalg.qr(np.vstack([jacobian / known.current_std, whitened]), mode="r")
    covariance_root = np.linalg.inv(root)
    std: Float = np.sqrt(np.sum(covariance_root[:cells] ** 2, axis=1)).reshape(skin.shape)
    return std


@pytest.mark.parametrize("bits", [10, 14, None])
@pytest.mark.parametrize(("size", "pressed"), [((2, 2), 1), ((2, 2), 4), ((3, 3), 3), ((2, 4), 0)])
def test_limit_agrees_with_the_dense_formula(
    size: tuple[int, int], pressed: int, bits: int | None
) -> None:
    skin, where = skin_of(*size, pressed, seed=3)
    rest, _ = skin_of(*size, 0, seed=3)
    known = SkinKnowledge(*size, adc_bits=bits, rest_ratio=readings(rest), **NOMINAL)
    found = information_limit(skin, known, where)
    expected = dense_limit(skin, known, where, REST_STD, LAYER_STD)
    # The differences have eight digits; of exact readings, cells at rest need more than these.
    compared = where if bits is None else np.full(size, True)
    np.testing.assert_allclose(found[compared], expected[compared], rtol=1e-3)


def test_what_is_not_known_widens_the_limit() -> None:
    skin, where = skin_of(3, 3, 2, seed=4)
    told = SkinKnowledge(3, 3, adc_bits=10, rest_ratio=readings(skin), **NOMINAL)
    untold = SkinKnowledge(3, 3, adc_bits=10)
    limit = information_limit(skin, told, where)
    exactly = information_limit(skin, told, where, rest_std=0.0, layer_std=0.0)
    assert np.all(exactly[where] < limit[where])
    np.testing.assert_array_equal(exactly[~where], 0.0)
    closely = information_limit(skin, told, where, rest_std=1e-4, layer_std=0.01)
    np.testing.assert_allclose(closely, dense_limit(skin, told, where, 1e-4, 0.01), rtol=1e-3)
    expected = dense_limit(skin, untold, where, UNKNOWN_REST_STD, USUAL_LAYER_STD)
    np.testing.assert_allclose(information_limit(skin, untold, where), expected, rtol=1e-3)
    assert np.all(limit[where] < expected[where])


def test_an_open_cell_has_no_relative_deviation() -> None:
    with pytest.raises(ValueError, match="open"):
        information_limit(
            uniform_skin((2, 2), 0.0), SkinKnowledge(2, 2), np.zeros((2, 2), np.bool_)
        )
