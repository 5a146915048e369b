# SPDX-License-Identifier: Apache-2.0
"""Force curves against numpy and scipy's own regressions, known laws, and counted coverage."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import curve_fit

from ohmskin.calibrate.regression import ForceRegression
from ohmskin.estimate.ohm import voltage_level
from ohmskin.force.curve import LINEAR, POWER, ForceModel
from ohmskin.record.readings import estimate_file
from studies.trials import skin_at_rest, trial_of

ONE = (1, 1)
NOISE_N = 0.1  # the paper's force sensor


def presses(
    number: int, seed: int, exponent: float = 1.0, noise_n: float = NOISE_N
) -> tuple[np.ndarray, np.ndarray]:
    """Rises up to 100 uS, and forces up to 10 N by a power law, never below 0."""
    random = np.random.default_rng(seed)
    rise = random.uniform(2e-6, 100e-6, number)
    force_n = 10.0 * (rise / 100e-6) ** exponent + noise_n * random.standard_normal(number)
    return rise, np.maximum(force_n, 0.0)


def fit_one(rise: np.ndarray, force_n: np.ndarray) -> ForceRegression:
    return ForceRegression().fit(np.zeros(rise.size, dtype=int), rise, force_n, shape=ONE)


def test_line_through_rest_is_curve_fits() -> None:
    rise, force_n = presses(40, 2)
    found = fit_one(rise, force_n)
    slope, covariance = curve_fit(lambda x, a: a * x, rise, force_n, p0=[1e5])
    assert found.model_.kind[0, 0] == LINEAR
    np.testing.assert_allclose(found.model_.slope[0, 0], slope[0], rtol=1e-7)
    np.testing.assert_allclose(found.model_.slope_std[0, 0], covariance[0, 0] ** 0.5, rtol=1e-6)
    force_at_rest, _ = found.model_.predict([[0.0]], [[0.0]])
    assert force_at_rest[0, 0] == 0


@pytest.mark.parametrize("exponent", [0.5, 2.0])
def test_power_law_is_curve_fits(exponent: float) -> None:
    rise, force_n = presses(60, 3, exponent)
    found = fit_one(rise, force_n)
    assert found.model_.kind[0, 0] == POWER

    def law(x: np.ndarray, log_slope: float, power: float) -> np.ndarray:
        return np.exp(log_slope) * (x / 50e-6) ** power  # another parametrisation than ours

    best, covariance = curve_fit(law, rise, force_n, p0=[1.0, 1.0], xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose(found.model_.exponent[0, 0], best[1], rtol=1e-6)
    np.testing.assert_allclose(found.model_.exponent_std[0, 0], covariance[1, 1] ** 0.5, rtol=1e-4)
    np.testing.assert_allclose(
        found.model_.slope[0, 0], np.exp(best[0]) * 50e-6 ** -best[1], rtol=1e-5
    )
    # The curve's own uncertainty does not depend on the parametrisation.
    at = np.array([5e-6, 30e-6, 90e-6])
    forces = law(at, *best)
    jacobian = np.column_stack([forces, forces * np.log(at / 50e-6)])
    of_fit = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    for rise_here, force_here, variance in zip(at, forces, of_fit, strict=True):
        predicted, std = found.model_.predict([[rise_here]], [[0.0]])
        np.testing.assert_allclose(predicted[0, 0], force_here, rtol=1e-6)
        own = std[0, 0] ** 2 - found.model_.residual_std[0, 0] ** 2
        np.testing.assert_allclose(own, variance, rtol=1e-3)


@pytest.mark.parametrize("exponent", [0.6, 1.0])
def test_scatter_that_grows_with_force_is_seen_and_weighed(exponent: float) -> None:
    """Contacts are off by a share of what they conduct. curve_fit, told so, is what to reach."""
    random = np.random.default_rng(23)
    cells = np.repeat(np.arange(100), 24)
    shape = (10, 10)
    force_n = random.uniform(0.1, 8.0, cells.size)
    exact = 1e-4 * (force_n / 10) ** (1 / exponent)
    rise = exact * np.exp(0.2 * random.standard_normal(cells.size))
    found = ForceRegression().fit(cells, rise, force_n, shape=shape)
    assert np.all(found.model_.residual_share > 0)
    most_n = force_n.reshape(100, 24).max(axis=1).reshape(shape)
    np.testing.assert_allclose(
        found.model_.residual_std, 0.1 * most_n * found.model_.residual_share
    )
    expected = []
    for cell in range(100):
        x, force = rise[cells == cell] / 1e-4, force_n[cells == cell]
        scatter = np.sqrt(force**2 + (0.1 * force.max()) ** 2)
        law, _ = curve_fit(lambda x, a, b: a * x**b, x, force, p0=[10, 1], sigma=scatter)
        expected.append(law[0] * 0.3 ** law[1])
    power = found.model_.kind.ravel() == POWER
    at, _ = found.model_.predict(np.full(shape, 0.3e-4), np.zeros(shape))
    np.testing.assert_allclose(at.ravel()[power], np.array(expected)[power], rtol=1e-4)
    assert np.mean(power) > 0.95 if exponent != 1 else np.mean(power) < 0.4
    for newton in (0.5, 2.0, 6.0):
        rise = 1e-4 * (newton / 10) ** (1 / exponent) * np.exp(0.2 * random.standard_normal(shape))
        predicted, std = found.model_.predict(rise, np.zeros(shape))
        share = np.mean(np.abs(predicted - newton) <= 2 * std)
        print(f"{exponent}, {newton} N: {share:.0%} within 2 std of {np.median(std):.2f} N")
        assert share > 0.88
        assert np.median(std) < 0.35 * newton + 0.15


@pytest.mark.parametrize(("exponent", "kind"), [(1.0, LINEAR), (0.6, POWER), (1.6, POWER)])
def test_held_out_error_finds_the_law(exponent: float, kind: str) -> None:
    random = np.random.default_rng(4)
    cells = np.repeat(np.arange(64), 25)
    rise, force_n = presses(cells.size, 5, exponent)
    order = random.permutation(cells.size)
    found = ForceRegression().fit(cells[order], rise, force_n, shape=(8, 8))
    share = np.mean(found.model_.kind == kind)
    print(f"exponent {exponent}: {share:.0%} of cells {kind}")
    assert share > (0.8 if kind == LINEAR else 0.98)
    assert not found.model_.pooled.any()
    assert found.message_ == ""
    assert np.all((found.model_.held_out_rmse > 0.05) & (found.model_.held_out_rmse < 0.2))


@pytest.mark.parametrize(
    ("count", "exponent"), [(5, 0.5), (5, 1.0), (5, 1.8), (10, 1.0), (40, 0.5), (40, 1.8)]
)
def test_two_standard_deviations_cover_what_they_should(exponent: float, count: int) -> None:
    """New presses of calibrated cells, with noise on the rise both when learning and when asked."""
    random = np.random.default_rng(6)
    shape, rise_std = (12, 12), 1e-6
    cells = np.repeat(np.arange(144), count)
    true_rise, force_n = presses(cells.size, 7, exponent)
    rise = true_rise + rise_std * random.standard_normal(cells.size)
    found = ForceRegression().fit(
        cells, rise, force_n, shape=shape, rise_std=np.full(cells.size, rise_std)
    )
    true_rise, true_force_n = (each.reshape(shape) for each in presses(144, 8, exponent))
    seen = true_rise + rise_std * random.standard_normal(shape)
    predicted, std = found.model_.predict(seen, np.full(shape, rise_std))
    share = np.mean(np.abs(predicted - true_force_n) <= 2 * std)
    print(f"exponent {exponent}, {count} presses: {share:.1%} within 2 std")
    assert 0.90 <= share <= 0.99


def test_noise_of_the_rise_is_not_counted_twice() -> None:
    """What presses scatter by when learning is the noise that predicting adds again."""
    random = np.random.default_rng(24)
    cells, rise_std = np.repeat(np.arange(100), 40), 5e-6
    true_rise, force_n = presses(cells.size, 25)
    rise = true_rise + rise_std * random.standard_normal(cells.size)
    found = ForceRegression().fit(
        cells, rise, force_n, shape=(10, 10), rise_std=np.full(cells.size, rise_std)
    )
    _, std = found.model_.predict(np.full((10, 10), 50e-6), np.full((10, 10), rise_std))
    expected = np.hypot(1e5 * rise_std, NOISE_N)
    print(f"{np.median(std):.3f} N, and {expected:.3f} N")
    assert np.median(std) == pytest.approx(expected, rel=0.12)


def test_cells_without_data_are_covered_too() -> None:
    """Half the cells are pressed; every cell has its own sensitivity, 20 % apart."""
    random = np.random.default_rng(9)
    shape = (20, 20)
    sensitivity = np.exp(0.2 * random.standard_normal(400))
    cells = np.repeat(np.arange(200), 10)
    rise, force_n = presses(cells.size, 10)
    found = ForceRegression().fit(cells, rise * sensitivity[cells], force_n, shape=shape)
    assert found.model_.pooled.sum() == 200
    assert found.message_ == "200 of 400 cells take the curve of all presses"
    rise, force_n = presses(400, 11)
    predicted, std = found.model_.predict((rise * sensitivity).reshape(shape), np.zeros(shape))
    miss = np.abs(predicted - force_n.reshape(shape)) / std
    shares = [np.mean(miss[~found.model_.pooled] <= 2), np.mean(miss[found.model_.pooled] <= 2)]
    print(f"within 2 std: {shares[0]:.1%} of calibrated cells, {shares[1]:.1%} of the others")
    assert all(0.90 <= share <= 0.99 for share in shares)
    # Pooled cells say how wrong they are on cells never seen: far more than the calibrated ones.
    held_out = found.model_.held_out_rmse
    assert held_out[found.model_.pooled].min() > 3 * held_out[~found.model_.pooled].max()


def test_one_cell_alone_serves_the_others_without_a_standard_deviation() -> None:
    rise, force_n = presses(20, 12)
    found = ForceRegression().fit(np.full(20, 1), rise, force_n, shape=(2, 2))
    np.testing.assert_array_equal(found.model_.pooled, [[True, False], [True, True]])
    assert found.message_ == (
        "3 of 4 cells take the curve of all presses: how far they are off is unknown"
    )
    force, std = found.model_.predict(np.full((2, 2), 50e-6), np.zeros((2, 2)))
    np.testing.assert_allclose(force, force[0, 1])
    np.testing.assert_array_equal(np.isnan(std), found.model_.pooled)
    np.testing.assert_array_equal(np.isnan(found.model_.held_out_rmse), found.model_.pooled)


def test_cells_with_too_little_for_a_curve_have_a_gain() -> None:
    rise, force_n = presses(34, 13)
    cells = np.array([0] * 20 + [1] * 4 + [2] * 10)
    force_n[cells == 2] = 3.0  # the same force all over
    found = ForceRegression().fit(cells, rise, force_n, shape=(1, 4))
    np.testing.assert_array_equal(found.model_.pooled, [[False, False, False, True]])
    assert found.message_ == (
        "2 of 4 cells take the curve of all presses, with their own gain\n"
        "1 of 4 cells take the curve of all presses"
    )


@pytest.mark.parametrize("exponent", [0.65, 1.0])
def test_few_presses_of_a_cell_tell_its_gain(exponent: float) -> None:
    """Cells differ by 20 %. A cell is pressed twice, or never: all say rightly how far off."""
    random = np.random.default_rng(26)
    shape = (20, 20)
    sensitivity = np.exp(0.2 * random.standard_normal(400))
    cells = np.repeat(np.arange(200), 2)
    rise, force_n = presses(cells.size, 27, exponent)
    found = ForceRegression().fit(cells, rise * sensitivity[cells], force_n, shape=shape)
    rise, force_n = presses(400, 28, exponent)
    predicted, std = found.model_.predict((rise * sensitivity).reshape(shape), np.zeros(shape))
    off, pressed = predicted - force_n.reshape(shape), ~found.model_.pooled
    rmse_n = [float(np.sqrt(np.mean(off[which] ** 2))) for which in (pressed, ~pressed)]
    within = [np.mean((np.abs(off) <= 2 * std)[which]) for which in (pressed, ~pressed)]
    print(f"pressed twice, never: {rmse_n} N, {within} within 2 std")
    assert rmse_n[0] < 0.8 * rmse_n[1]
    assert all(0.90 <= share <= 0.99 for share in within)
    held_out = np.sqrt(np.mean(found.model_.held_out_rmse[pressed] ** 2))
    assert rmse_n[0] * 0.9 < held_out < rmse_n[0] * 2


def test_one_odd_cell_does_not_spoil_the_others() -> None:
    """A cell pressed once, without effect: no curve rises when the other cell is held out."""
    rise, force_n = presses(21, 22)
    rise[20] = -1e-7
    found = ForceRegression().fit([0] * 20 + [1], rise, force_n, shape=(1, 2))
    np.testing.assert_array_equal(found.model_.pooled, [[False, True]])
    np.testing.assert_array_equal(np.isnan(found.model_.held_out_rmse), [[False, True]])
    assert found.message_.endswith("all presses: how far they are off is unknown")
    force, std = found.model_.predict([[50e-6, 50e-6]], [[0.0, 0.0]])
    assert np.all(force > 0)
    np.testing.assert_array_equal(np.isnan(std), [[False, True]])


def test_a_cell_whose_presses_do_not_foresee_each_other_has_a_gain() -> None:
    """One of its presses alone shows a rise. It counted as a cell without presses, and -1 cells
    were said to have a gain.
    """
    rise, force_n = presses(10, 21)
    shown = np.array([-1, -1.1, -1, -1.2, -1, -1.1, -1, -1.05, 3, 3.1]) * rise.max() / 3
    weak_n = np.array([1, 1, 1.2, 1.1, 1, 1.3, 1.1, 1, 3, 3.2])
    found = ForceRegression().fit(
        [1] * 10 + [0] * 10,
        np.concatenate([rise, shown]),
        np.concatenate([force_n, weak_n]),
        shape=(1, 3),
        press=np.arange(20) // 2,
    )
    np.testing.assert_array_equal(found.model_.pooled, [[False, False, True]])
    assert found.message_.startswith("1 of 3 cells take the curve of all presses, with their own")


def test_rows_of_one_press_are_held_out_together() -> None:
    """Each press is off by its own offset: rows held out one by one would not show it."""
    random = np.random.default_rng(15)
    press = np.repeat(np.arange(10), 30)
    rise = np.repeat(np.linspace(10e-6, 100e-6, 10), 30) + 1e-8 * random.standard_normal(300)
    force_n = 1e5 * rise + np.repeat(random.uniform(-0.9, 0.9, 10), 30)
    by_row = fit_one(rise, force_n)
    by_press = ForceRegression().fit(
        np.zeros(300, dtype=int), rise, force_n, shape=ONE, press=press
    )
    assert by_press.model_.held_out_rmse[0, 0] > by_row.model_.held_out_rmse[0, 0]
    with pytest.raises(ValueError, match=r"^too few presses: 4, 5 are needed$"):
        ForceRegression().fit(
            np.zeros(300, dtype=int), rise, force_n, shape=ONE, press=np.arange(300) % 4
        )


@pytest.mark.parametrize("number", [6, 20])
def test_presses_recorded_in_many_rows_are_covered(number: int) -> None:
    """The force is off by 0.3 N for a whole press: its 20 rows tell no more than one does."""
    random = np.random.default_rng(19)
    shape, rows = (12, 12), 20
    true_rise, true_force_n = presses(144 * number, 20)
    force_n = true_force_n + 0.3 * random.standard_normal(144 * number)
    rise = np.repeat(true_rise, rows) + 1e-7 * random.standard_normal(144 * number * rows)
    press = np.repeat(np.arange(144 * number), rows)
    found = ForceRegression().fit(
        press // number, rise, np.abs(force_n)[press], shape=shape, press=press
    )
    rise, force_n = presses(144, 21)
    force_n = force_n + 0.3 * random.standard_normal(144)
    predicted, std = found.model_.predict(rise.reshape(shape), np.zeros(shape))
    share = np.mean(np.abs(predicted - force_n.reshape(shape)) <= 2 * std)
    print(f"{number} presses of {rows} rows: {share:.1%} within 2 std")
    assert 0.90 <= share <= 0.99


def test_force_is_never_negative_and_keeps_its_standard_deviation() -> None:
    rise, force_n = presses(40, 16)
    for exponent in (1.0, 0.5):
        force_n = presses(40, 16, exponent)[1]
        found = fit_one(rise, force_n)
        force, std = found.model_.predict([[-20e-6]], [[1e-6]])
        assert force[0, 0] == 0
        assert std[0, 0] >= found.model_.residual_std[0, 0] > 0
    force, std = found.model_.predict([[50e-6]], [[np.nan]])
    assert force[0, 0] > 0
    assert np.isnan(std[0, 0])


def test_an_error_upwards_is_no_error_downwards() -> None:
    """Behind long wires, a conductance may be twice as large, but no touch is perhaps none."""
    x = np.linspace(20e-6, 200e-6, 12)
    found = ForceRegression().fit(np.zeros(12, int), x, 800 * x**0.65, shape=(1, 1))
    (force,), (std,) = found.model_.predict([[100e-6]], [[100e-6]])
    assert std[0] == pytest.approx(force[0] * (2**0.65 - 1), rel=1e-3)


def test_steep_laws_stay_finite_at_rest() -> None:
    found = fit_one(*presses(60, 17, 0.4))
    _, std = found.model_.predict([[0.0]], [[1e-6]])
    expected = 10 * (1e-6 / 100e-6) ** 0.4  # the law's own force at one standard deviation
    assert expected * 0.8 < std[0, 0] < expected * 1.3


def test_voltage_baseline_takes_ghosts_for_forces() -> None:
    """Single touches, read at 10 bits, calibrate both. With three corners pressed the fourth's
    reading rises too; the estimated conductance does not."""
    rest = skin_at_rest(2, 2, np.random.default_rng(18))
    newton_per_siemens = 2e4
    touches = [(cell, rise) for cell in range(4) for rise in np.linspace(5e-6, 50e-6, 12)]
    skins = []
    for cell, rise in touches:
        conductance = rest.cell_siemens.copy()
        conductance.flat[cell] += rise
        skins.append(replace(rest, cell_siemens=conductance))
    ghost = rest.cell_siemens + np.array([[50e-6, 50e-6], [50e-6, 0.0]])
    skins.append(replace(rest, cell_siemens=ghost))
    told = trial_of(rest, skins).rounded(10)
    estimated = estimate_file(told, "joint")["cell_siemens"]
    rest_told = estimate_file(replace(told, ratio=told.rest_ratio[None]), "joint")["cell_siemens"]
    cells = np.array([cell for cell, _ in touches])
    force_n = newton_per_siemens * np.array([rise for _, rise in touches])
    on_nobody = {}
    for method, levels in (
        ("voltage", voltage_level(told.ratio) - voltage_level(told.rest_ratio)),
        ("joint", estimated - rest_told),
    ):
        rise = levels[:-1].reshape(-1, 4)[np.arange(cells.size), cells]
        found = ForceRegression().fit(cells, rise, force_n, shape=(2, 2))
        assert np.all(found.model_.held_out_rmse < 0.1)
        force, _ = found.model_.predict(levels[-1], np.zeros((2, 2)))
        np.testing.assert_allclose(force[0, 0], 1.0, atol=0.2)
        on_nobody[method] = force[1, 1]
        print(f"{method}: {force[1, 1]:.3f} N on the cell that nobody presses, 1 N on the others")
    assert on_nobody["voltage"] > 0.2
    assert on_nobody["joint"] < 0.05


GOOD: dict[str, Any] = {
    "cells": [0, 0, 0, 1, 1, 1],
    "rise": [1e-6, 2e-6, 3e-6, 1e-6, 2e-6, 3e-6],
    "force_n": [1.0, 2.0, 3.0, 1.0, 2.0, 3.1],
    "shape": (1, 2),
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": [0], "rise": [1e-6], "force_n": [1.0]}, "too few presses: 1, 5 are needed"),
        ({"cells": [], "rise": [], "force_n": []}, "too few presses: 0, 5 are needed"),
        ({"force_n": [1, 2, 3, -0.5, 2, 3]}, "row 3: force_n is -0.5, it must be 0 or more: zero"),
        ({"force_n": [2.0] * 6}, "all 6 forces are 2 N: press with different forces"),
        ({"force_n": [1, 2, np.nan, 1, 2, 3]}, "row 2: force_n is nan, it must be finite"),
        ({"force_n": ["hard"] * 6}, "force_n holds <U4, it must hold float64"),
        ({"force_n": [[1.0] * 6]}, r"force_n has shape \(1, 6\), it must be \(6,\)"),
        ({"rise": [1e-6, np.inf, 3e-6, 1e-6, 2e-6, 3e-6]}, "row 1: rise is inf"),
        ({"rise": [1e-6, 2e-6]}, r"rise has shape \(2,\), it must be \(6,\)"),
        ({"rise": [-1e-6, -2e-6, -3e-6] * 2}, "force does not rise with the cells' rise"),
        ({"rise": [0.0] * 6}, "force does not rise with the cells' rise"),
        ({"rise_std": [0, 0, 0, 0, 0, -1]}, "row 5: rise_std is -1, it must be 0 or more"),
        ({"cells": [0, 0, 0, 1, 1, 2]}, "row 5: cells is 2, it must be one of a 1x2 skin"),
        ({"cells": [0, 0, 0, 1, 1, -1]}, "row 5: cells is -1, it must be one of a 1x2 skin"),
        ({"cells": [0.0] * 6}, "cells holds float64, it must hold int64"),
        ({"cells": [0] * 5}, r"cells has shape \(5,\), it must be \(6,\)"),
        ({"press": [0.5] * 6}, "press holds float64, it must hold int64"),
        ({"shape": (0, 2)}, "row 0: cells is 0, it must be one of a 0x2 skin"),
    ],
)
def test_bad_presses_are_refused(change: dict[str, Any], message: str) -> None:
    ForceRegression().fit(**GOOD)
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        ForceRegression().fit(**(GOOD | change))
    assert "\n" not in str(caught.value)


def test_bad_questions_are_refused() -> None:
    found = ForceRegression().fit(**GOOD)
    with pytest.raises(ValueError, match=r"^rise has shape \(2,\), this calibration \(1, 2\)$"):
        found.model_.predict([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"^rise of cell \(0, 1\) is not finite$"):
        found.model_.predict([[0.0, np.nan]], [[0.0, 0.0]])
    with pytest.raises(ValueError, match=r"^rise_std of cell \(0, 0\) is negative or inf$"):
        found.model_.predict([[0.0, 0.0]], [[-1.0, 0.0]])


def test_models_that_no_fit_gives_are_refused() -> None:
    model: ForceModel = ForceRegression().fit(**GOOD).model_
    for name, value, message in (
        ("slope", -1.0, "slope of cell (0, 0) is not above 0"),
        ("kind", "cubic", "kind of cell (0, 0) is neither linear nor power"),
        ("exponent", 2.0, "exponent of cell (0, 0) is not 1, as of a linear cell"),
        ("correlation", 1.5, "correlation of cell (0, 0) is not in -1..1"),
        ("residual_std", np.inf, "residual_std of cell (0, 0) is negative or inf"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            replace(model, **{name: np.array([[value, value]])})
