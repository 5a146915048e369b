# SPDX-License-Identifier: Apache-2.0
"""What is expected of cells, and how a deviation of a log becomes one of a conductance."""

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.prior import (
    HIGHEST_TOUCH_SIEMENS,
    UNTOUCHED_STD,
    CellPrior,
    UpperLimits,
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


NONE, ONES, SERIES_OHM = np.zeros(3), np.ones(3), 6e4


def test_deviations_of_conductances_are_those_of_logs_where_both_are_small() -> None:
    log_siemens, log_std = np.log([1e-6, 1e-5, 1e-4]), np.full(3, 0.001)
    parts = log_std, np.zeros((3, 3)), NONE
    up, down = siemens_std(log_siemens, *parts, UpperLimits(NONE, NONE), np.full(3, SERIES_OHM))
    np.testing.assert_allclose(up, 0.001 * np.exp(log_siemens), rtol=0.03)
    np.testing.assert_allclose(down, 0.001 * np.exp(log_siemens), rtol=0.03)


def test_a_cell_behind_unknown_wires_may_be_a_short() -> None:
    """1 kOhm +- 50 % behind 10 kOhm of wire: two deviations down are nearly nothing."""
    by_top, upper = np.array([[0.5, 0.0, 0.0]]), UpperLimits(np.full(3, 2.1), np.full(3, 1.05))
    up, down = siemens_std(np.log([1e-3]), np.zeros(1), by_top, ONES, upper, np.array([7e4]))
    assert 1e-3 + 2 * up[0] == pytest.approx(HIGHEST_TOUCH_SIEMENS)
    assert 0 < down[0] < 0.5e-3


def test_no_less_than_the_deviation_to_first_order_is_stated() -> None:
    """The hardest touch is next to nothing away from this cell."""
    half, upper = np.full(1, 0.5), UpperLimits(NONE, NONE)
    up, _ = siemens_std(np.log([1 / 310]), half, np.zeros((1, 3)), ONES, upper, np.full(1, 7e4))
    assert up[0] == pytest.approx(0.5 / 310)


@pytest.mark.parametrize("mean", range(3))
def test_what_comes_from_means_reaches_to_their_upper_limits(mean: int) -> None:
    """1 % of 100 kOhm is 1 kOhm for each deviation of the mean that the fit took."""
    by_mean, reach = np.zeros((1, 3)), np.full(3, 99.0)
    by_mean[0, mean], reach[mean] = 0.01, 30.0
    for count in (2.0, 4.0):
        upper = UpperLimits(reach, reach / count)
        parts = np.zeros(1), by_mean, ONES
        up, down = siemens_std(np.log([1e-5]), *parts, upper, np.full(1, SERIES_OHM))
        assert 1e-5 + count * up[0] == pytest.approx(1 / (1e5 - 30 * 1e3))
        assert down[0] == pytest.approx(1e-5 * 0.01, rel=0.02)


def lowest_shares(siemens: Float, own_std: Float, by_means: Float, reach: Float) -> Float:
    """How much of each cell's resistance is left at the upper limits, (RC,)."""
    upper, series_ohm = UpperLimits(reach, reach / 2), np.full(siemens.size, SERIES_OHM)
    up, _ = siemens_std(np.log(siemens), own_std, by_means, ONES, upper, series_ohm)
    return 1 / (siemens + 2 * up) * siemens


def test_a_hard_cell_says_how_long_wires_are_at_most() -> None:
    """If they were eleven times as long, nothing would be left of it; soft cells lose little."""
    siemens, by_top, far = np.array([1e-4, 1e-5, 1e-6]), np.array([0.1, 0.01, 0.001]), 1e3 * ONES
    top, both = np.outer(by_top, [1.0, 0.0, 0.0]), np.outer(by_top, [1.0, 1.0, 0.0])
    left = lowest_shares(siemens, NONE, top, far)
    np.testing.assert_allclose(left, [300 / 1e4, 0.895, 0.9895], rtol=1e-6)
    # If the other layer may take as much of that cell, it is not lost twice.
    np.testing.assert_allclose(lowest_shares(siemens, NONE, both, far)[1:], left[1:])
    # A hard cell that is not known by itself says less.
    unsure = lowest_shares(siemens, np.array([1.0, 0.0, 0.0]), both, far)
    np.testing.assert_allclose(1 - unsure[1:], (1 - left[1:]) * 3.05 / 1.05)


def test_a_hard_cell_bounds_a_mean_that_it_follows_though_it_hardly_follows_another() -> None:
    """The second mean has a limit of its own, far below what the hard cell lets it rise."""
    by_means = np.array([[0.09, 0.008, 0.0], [0.26, 0.006, 0.0]])
    left = lowest_shares(np.array([1e-4, 2e-4]), np.zeros(2), by_means, 12.0 * ONES)
    assert left[0] == pytest.approx(1 - np.hypot(0.09 * 1.05 / 0.26, 0.008 * 12))


def test_the_level_of_an_untouched_skin_is_found_and_touches_raise_it_little() -> None:
    skin = uniform_skin((8, 8), 1 / 8e5, (0.0, 0.0))
    current = readings(skin)[:, :, 1] / skin.ref_bottom_ohm
    assert rest_level(current, 6e4) == pytest.approx(1 / 8e5, rel=1e-6)
    cells = skin.cell_siemens.copy()
    cells[[1, 4, 6], [2, 2, 5]] = 1e-4
    touched = Skin(cells, skin.top_wire_ohm, skin.bottom_wire_ohm)
    current = readings(touched)[:, :, 1] / skin.ref_bottom_ohm
    assert 1.0 < rest_level(current, 6e4) * 8e5 < 1.5


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
