# SPDX-License-Identifier: Apache-2.0
"""What is expected of cells, and how a deviation of a log becomes one of a conductance."""

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.joint import TELLING_SHARE
from ohmskin.estimate.prior import (
    HIGHEST_TOUCH_SIEMENS,
    PALM_SHARE,
    UNTOUCHED_STD,
    CellPrior,
    WireStds,
    rest_level,
    siemens_std,
)
from skins import uniform_skin

REST = np.log([1e6])


def test_the_stand_in_normal_has_the_slope_of_the_prior() -> None:
    """-2 log p is d^2 up to one deviation, and 1 + log(d^2) beyond."""
    prior = CellPrior(REST, np.full(1, 0.05), np.zeros((1, 3)), np.zeros(3))
    for away in (-4.0, -0.3, -0.051, -0.02, 0.0, 0.03, 0.2, -9.5):
        mean, variance = prior.normal(REST + away)
        slope = 2 * away / 0.05**2 if abs(away) < 0.05 else 2 / away
        assert float(2 * (REST + away - mean)[0] / variance[0]) == pytest.approx(slope)


def test_deviations_of_conductances_are_those_of_logs_where_both_are_small() -> None:
    log_siemens, log_std = np.log([1e-6, 1e-5, 1e-4]), np.full(3, 0.001)
    up, down = siemens_std(
        log_siemens, log_std, np.zeros(3), np.zeros(3), WireStds(0.1, 1.0, 1.0), np.full(3, 6e4)
    )
    np.testing.assert_allclose(up, 0.001 * np.exp(log_siemens), rtol=0.03)
    np.testing.assert_allclose(down, 0.001 * np.exp(log_siemens), rtol=0.03)


def test_a_cell_behind_unknown_wires_may_be_a_short() -> None:
    """1 kOhm +- 50 % behind 10 kOhm of wire: two deviations down are nearly nothing."""
    half, series_ohm = np.array([0.5]), np.array([7e4])
    up, down = siemens_std(
        np.log([1e-3]), half, half, np.zeros(1), WireStds(0.05, 1.0, 1.0), series_ohm
    )
    assert 1e-3 + 2 * up[0] == pytest.approx(HIGHEST_TOUCH_SIEMENS)
    assert 0 < down[0] < 0.5e-3


def test_wires_of_unknown_length_make_a_cell_uncertain_upwards() -> None:
    """A layer known to a factor of two: two of its deviations up are a factor of four."""
    part, none, series_ohm = np.array([0.01]), np.zeros(1), np.array([6e4])
    wires = WireStds(np.log(2.0), 1.0, 1.0)
    up, down = siemens_std(np.log([1e-5]), part, part, none, wires, series_ohm)
    assert up[0] == pytest.approx(1e-5 * 0.01 * 3 / np.log(4.0), rel=0.02)
    assert down[0] == pytest.approx(1e-5 * 0.01, rel=0.02)
    # Three of its deviations, where nobody told it, are a factor of eight.
    up, _ = siemens_std(np.log([1e-5]), part, part, none, wires._replace(reach_stds=3), series_ohm)
    assert up[0] == pytest.approx(1e-5 * 0.01 * 7 / np.log(8.0), rel=0.05)
    # A layer that may just have grown longer, by five times the deviation that the fit took.
    wires = WireStds(np.log(2.0), 5.0, 1.0)
    up, down = siemens_std(np.log([1e-5]), part, part, none, wires, series_ohm)
    assert up[0] == pytest.approx(1e-5 * 0.05 * 3 / np.log(4.0), rel=0.2)
    assert down[0] == pytest.approx(1e-5 * 0.01, rel=0.02)


def test_leads_that_may_be_unusual_make_a_cell_uncertain_upwards() -> None:
    """Ten times as unsure as the fit took them: all of the deviation comes from leads here."""
    part, none, series_ohm = np.array([0.01]), np.zeros(1), np.array([6e4])
    wires = WireStds(0.1, 1.0, 10.0)
    up, down = siemens_std(np.log([1e-5]), part, none, part, wires, series_ohm)
    assert up[0] == pytest.approx(1e-5 * 0.1, rel=0.2)
    assert down[0] == pytest.approx(1e-5 * 0.01, rel=0.02)


def test_the_level_of_an_untouched_skin_is_found_and_touches_raise_it_little() -> None:
    skin = uniform_skin((8, 8), 1 / 8e5, (0.0, 0.0))
    current = readings(skin)[:, :, 1] / skin.ref_bottom_ohm
    assert rest_level(current, 6e4) == pytest.approx(1 / 8e5, rel=1e-6)
    cells = skin.cell_siemens.copy()
    cells[[1, 4, 6], [2, 2, 5]] = 1e-4
    touched = Skin(cells, skin.top_wire_ohm, skin.bottom_wire_ohm)
    current = readings(touched)[:, :, 1] / skin.ref_bottom_ohm
    assert 1.0 < rest_level(current, 6e4) * 8e5 < 1.5


def test_fingertips_are_no_palm() -> None:
    """On 8x8 cells, a palm over 60 % of them is one; two of the widest fingertips are not."""
    row, column = np.indices((8, 8))
    prior = CellPrior(np.full(64, np.log(1e6)), np.full(64, 0.05), np.zeros((64, 3)), np.zeros(3))

    def share(*middles: tuple[float, float]) -> float:
        tips = (np.exp(-((row - i) ** 2 + (column - j) ** 2) / 2) for i, j in middles)
        return prior.spread_share(-np.log(1e-6 + 1e-4 * sum(tips)).ravel())

    assert share((3.5, 3.5)) < share((2.0, 2.0), (5.0, 5.0)) < TELLING_SHARE < PALM_SHARE
    middle = np.abs(row - 3.5) + np.abs(column - 3.5) < 5
    assert 0.5 < middle.mean() < 0.7
    of_palm = prior.spread_share(-np.log(1e-6 + 1e-4 * middle).ravel())
    assert of_palm == pytest.approx(middle.mean(), rel=0.01)
    assert of_palm > PALM_SHARE


def touched(*rows: str) -> tuple[CellPrior, Float, tuple[int, int]]:
    """A prior, logs of cells that conduct twice as much where a row has an "x", and the shape."""
    on = np.array([[mark == "x" for mark in row] for row in rows])
    rest = np.full(on.size, np.log(1e6))
    prior = CellPrior(rest, np.full(on.size, 0.05), np.zeros((on.size, 3)), np.zeros(3))
    return prior, rest - np.log(2) * on.ravel(), on.shape


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            ("........", "..xx....", "..xx....", "........", "........", "........"),
            (".xxxx...", ".xxxx...", ".xxxx...", ".xxxx...", "........", "........"),
        ),
        (  # at the edge of the skin, beside a touch by itself
            ("xx......", "xx......", "x.......", "........", "......x.", "........"),
            ("xxx.....", "xxx.....", "xxx.....", "xx......", "........", "........"),
        ),
        (  # as many neighbours as by chance
            (".xx.....", "........", "x...x.x.", "........", "..x..x..", "..x....."),
            ("........",) * 6,
        ),
        (("xx......", "........", "........"), ("........",) * 3),
        (("xx.", "xx.", "..."), ("...",) * 3),
        (("xxx.....",), ("........",)),
    ],
)
def test_cells_within_reach_of_fingertips(rows: tuple[str, ...], expected: tuple[str, ...]) -> None:
    """Cells around touched neighbours, if these are more than by chance."""
    prior, log_ohm, shape = touched(*rows)
    near = prior.fingertips(log_ohm, shape).reshape(shape)
    assert ["".join("x" if cell else "." for cell in row) for row in near] == list(expected)
    wide = prior.for_fingertips(log_ohm, shape).std.reshape(shape)
    assert (wide[near] == UNTOUCHED_STD).all()
    assert (wide[~near] == 0.05).all()
