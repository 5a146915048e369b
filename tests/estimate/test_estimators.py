# SPDX-License-Identifier: Apache-2.0
"""The estimators' common interface, `ohm` and `matrix`, on networks whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network import laplacian_readings
from ohmskin.circuit.configurations import ratio_from_current
from ohmskin.circuit.ports import solve_ports, wires_add_ohm
from ohmskin.circuit.skin import Skin, port_resistance_ohm, readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.matrix import voltage_squared
from ohmskin.estimate.methods import LEVEL_METHODS, make_estimator
from ohmskin.estimate.ohm import voltage_level
from ohmskin.record.readings import estimate_file
from skins import reference, ten_bits, told, uniform_skin

REST_OHM = 1e6

pytestmark = pytest.mark.filterwarnings("error")


def wire_free_readings(cell_ohm: np.ndarray) -> np.ndarray:
    none = np.zeros(cell_ohm.shape)
    return readings(Skin(1 / cell_ohm, none, none))


# The methods that neglect the wires: what is said of all of them holds where there are none.
WIRE_FREE = ("ohm", "matrix")
# Those of any size; the paper's are tested in test_paper.py.
METHODS = (*WIRE_FREE, "joint")


def random_ohm(random: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return np.exp(random.uniform(np.log(1e3), np.log(1e6), shape))


@pytest.mark.parametrize("method", WIRE_FREE)
@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (5, 1)])
def test_wire_free_methods_are_exact_where_there_is_no_other_path(
    method: str, shape: tuple[int, int]
) -> None:
    cell_ohm = random_ohm(np.random.default_rng(1), shape)
    found = make_estimator(method, SkinKnowledge(*shape)).estimate(wire_free_readings(cell_ohm))
    np.testing.assert_allclose(found.cell_ohm, cell_ohm, rtol=1e-9)
    np.testing.assert_allclose(found.cell_siemens, 1 / cell_ohm, rtol=1e-9)
    assert found.converged
    assert found.message == ""
    assert found.chi2 < 1e-6
    assert found.seconds > 0
    assert np.isnan(found.top_wire_ohm).all()
    assert np.isnan(found.bottom_wire_ohm).all()


@settings(max_examples=60, deadline=None)
@given(rows=st.integers(1, 7), columns=st.integers(1, 7), seed=st.integers(0, 2**32 - 1))
def test_matrix_recovers_any_wire_free_network(rows: int, columns: int, seed: int) -> None:
    cell_ohm = random_ohm(np.random.default_rng(seed), (rows, columns))
    found = make_estimator("matrix", SkinKnowledge(rows, columns)).estimate(
        wire_free_readings(cell_ohm)
    )
    assert found.converged, found.message
    np.testing.assert_allclose(found.cell_ohm, cell_ohm, rtol=1e-5)


def test_matrix_recovers_16x16_with_deep_touches() -> None:
    random = np.random.default_rng(4)
    cell_ohm = np.full((16, 16), REST_OHM)
    cell_ohm.flat[random.permutation(256)[:30]] = 1e3
    found = make_estimator("matrix", SkinKnowledge(16, 16)).estimate(wire_free_readings(cell_ohm))
    assert found.converged, found.message
    np.testing.assert_allclose(found.cell_ohm, cell_ohm, rtol=1e-4)


@settings(max_examples=30, deadline=None)
@given(rows=st.integers(1, 5), columns=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_port_derivative_agrees_with_finite_differences(rows: int, columns: int, seed: int) -> None:
    cell = 1 / random_ohm(np.random.default_rng(seed), (rows, columns))
    analytic = -voltage_squared(solve_ports(cell)[1], rows)
    numeric = np.empty_like(analytic)
    for e in range(cell.size):
        step = 1e-4 * cell.flat[e]
        up, down = cell.copy(), cell.copy()
        up.flat[e] += step
        down.flat[e] -= step
        rise = solve_ports(up)[0] - solve_ports(down)[0]
        numeric[:, e] = rise.ravel() / (2 * step)
    # Relative to what one cell does to its own port: rounding of rho, not of the derivative.
    scale = np.abs(np.diagonal(analytic)).max()
    np.testing.assert_allclose(numeric, analytic, rtol=1e-5, atol=1e-6 * scale)


@settings(max_examples=30, deadline=None)
@given(rows=st.integers(1, 5), columns=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_what_short_wires_add_is_what_the_whole_circuit_says(
    rows: int, columns: int, seed: int
) -> None:
    cell = 1 / random_ohm(np.random.default_rng(seed), (rows, columns))
    wires = [np.full(cell.shape, ohm) for ohm in (0.1, 0.3)]
    whole_ohm = port_resistance_ohm(Skin(cell, *wires))
    ideal_ohm, impedance = solve_ports(cell)
    added_ohm = wires_add_ohm(impedance, cell, (0.1, 0.3))
    np.testing.assert_allclose(whole_ohm - ideal_ohm, added_ohm, rtol=1e-2, atol=1e-4)


def test_ghost_ohm_reports_the_fourth_corner_and_matrix_does_not() -> None:
    cell_ohm = np.full((4, 4), REST_OHM)
    rest = ten_bits(wire_free_readings(cell_ohm))
    corners, ghost = ([0, 0, 2], [1, 3, 1]), (2, 3)
    cell_ohm[corners] = 5e3
    touched = np.zeros((4, 4), dtype=bool)
    touched[corners] = True
    knowledge = SkinKnowledge(4, 4, adc_bits=10, rest_ratio=rest)
    frame = ten_bits(wire_free_readings(cell_ohm))
    naive = make_estimator("ohm", knowledge).estimate(frame)
    whole = make_estimator("matrix", knowledge).estimate(frame)
    assert naive.touched[ghost]
    assert naive.cell_ohm[ghost] == pytest.approx(15e3, rel=0.05)
    np.testing.assert_array_equal(whole.touched, touched)


@pytest.mark.parametrize("method", WIRE_FREE)
@pytest.mark.parametrize("shape", [(1, 6), (4, 4)])
def test_standard_deviation_is_honest_about_rounding(method: str, shape: tuple[int, int]) -> None:
    random = np.random.default_rng(2)
    estimator = make_estimator(method, SkinKnowledge(*shape, adc_bits=10))
    deviations = []
    for _ in range(2400 // (shape[0] * shape[1])):
        cell_ohm = np.exp(random.uniform(np.log(2e4), np.log(REST_OHM), shape))
        # `ohm` is judged where what it assumes holds: each cell read on its own.
        alone = ratio_from_current(1 / (cell_ohm + 60e3), 30e3, 30e3)
        ratio = alone if method == "ohm" else wire_free_readings(cell_ohm)
        found = estimator.estimate(ten_bits(ratio))
        assert found.converged, found.message
        deviations.append((found.cell_siemens - 1 / cell_ohm) / found.cell_siemens_std)
    z = np.abs(np.concatenate(deviations))
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.08)
    # Rounding is uniform: 58 % within one standard deviation instead of 68 %.
    assert 0.55 < np.mean(z < 1) < 0.72
    assert np.mean(z < 2) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_standard_deviation_covers_noise_above_what_was_said(method: str) -> None:
    """Against the cells, where what a method assumes holds: no wires; for `ohm`, lone cells."""
    random = np.random.default_rng(5)
    cell_ohm = np.full((3, 3), 1e5)
    alone = ratio_from_current(1 / (cell_ohm + 60e3), 30e3, 30e3)
    exact = alone if method == "ohm" else wire_free_readings(cell_ohm)
    known = SkinKnowledge(3, 3, adc_bits=16, nominal_wire_ohm=WireOhm(0.0, 0.0, 0.0))
    estimator = make_estimator(method, known)
    z = []
    for _ in range(200):
        noisy = exact + 2e-3 * random.standard_normal(exact.shape)
        found = estimator.estimate(noisy)
        z.append((found.cell_siemens - 1 / cell_ohm) / found.cell_siemens_std)
        assert found.chi2 > 1
    assert np.mean(np.abs(z) < 2) > 0.95


# Worst relative error of a pressed cell whose other path is no better than itself. What is
# neglected is the wire, up to 8 segments of 100 and 8 of 200 ohm in 8x8, in series with 1 kOhm.
@pytest.mark.parametrize(
    ("name", "median_bound", "worst_bound"),
    [("random_2x2", 0.08, 0.35), ("random_4x6", 0.10, 0.48), ("presses_8x8", 0.07, 0.30)],
)
def test_matrix_is_near_the_truth_where_wires_are_small(
    name: str, median_bound: float, worst_bound: float
) -> None:
    readings, arrays = reference(name, bits=None)
    found = estimate_file(readings, "matrix")
    assert found["converged"].all()
    pressed = 1 / arrays["cell_ohm"] - 1 / arrays["rest_ohm"] > 0.5e-6
    error = np.abs(found["cell_ohm"] / arrays["cell_ohm"] - 1)[pressed]
    assert np.median(error) < median_bound
    assert error.max() < worst_bound
    assert found["touched"][pressed].all()


def test_matrix_shows_no_ghosts_in_four_overlapping_presses_and_ohm_many() -> None:
    readings, arrays = reference("presses_8x8")
    pressed = 1 / arrays["cell_ohm"] - 1 / arrays["rest_ohm"] > 0.5e-6
    knowledge = SkinKnowledge(8, 8, adc_bits=10, rest_ratio=readings.rest_ratio)
    ghosts = {}
    for method in METHODS:
        estimator = make_estimator(method, knowledge)
        touched = np.array([estimator.estimate(frame).touched for frame in readings.ratio])
        ghosts[method] = np.count_nonzero(touched & ~pressed)
        assert touched[pressed].all()
    assert ghosts["matrix"] == 0
    assert ghosts["ohm"] > 1000


def test_warm_and_cold_starts_agree_and_warm_is_shorter() -> None:
    warm = make_estimator("matrix", SkinKnowledge(8, 8, adc_bits=10))
    cold = make_estimator("matrix", SkinKnowledge(8, 8, adc_bits=10))
    iterations = {"warm": 0, "cold": 0}
    for frame in reference("presses_8x8")[0].ratio[::3]:
        cold.reset()
        from_before, afresh = warm.estimate(frame), cold.estimate(frame)
        iterations["warm"] += from_before.iterations
        iterations["cold"] += afresh.iterations
        difference = np.abs(from_before.cell_siemens - afresh.cell_siemens)
        assert np.all(difference < 0.05 * afresh.cell_siemens_std)
    assert iterations["warm"] < iterations["cold"]


def test_reset_makes_an_estimator_as_new() -> None:
    random = np.random.default_rng(6)
    first, second = (ten_bits(wire_free_readings(random_ohm(random, (3, 4)))) for _ in range(2))
    used = make_estimator("matrix", SkinKnowledge(3, 4, adc_bits=10))
    used.estimate(first)
    used.reset()
    new = make_estimator("matrix", SkinKnowledge(3, 4, adc_bits=10))
    np.testing.assert_array_equal(
        used.estimate(second).cell_siemens, new.estimate(second).cell_siemens
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_shorted_and_an_open_port_are_known_to_be_uncertain(method: str) -> None:
    estimator = make_estimator(method, SkinKnowledge(1, 3, adc_bits=10))
    ratio = np.broadcast_to([0.5, 0.5, 0.5, 0.5], (1, 3, 4)).copy()
    ratio[0, 1] = [1, 0, 1, 0]
    ratio[0, 2] = ratio_from_current(1 / (1e5 + 6e4), 3e4, 3e4)
    found = estimator.estimate(ten_bits(ratio))
    # Code 512 is half a step above a short; `joint` knows that no touch is one.
    assert found.cell_siemens_std[0, 0] > found.cell_siemens[0, 0] / (3 if method == "joint" else 1)
    assert found.cell_siemens[0, 1] < 5 * found.cell_siemens_std[0, 1]
    assert found.cell_ohm[0, 2] == pytest.approx(1e5, rel=0.02)


def test_ohm_does_not_converge_on_a_current_that_no_resistance_allows() -> None:
    found = make_estimator("ohm", SkinKnowledge(1, 2, adc_bits=10)).estimate(
        np.array([[[0.9, 0.1, 0.9, 0.1], [0.4, 0.6, 0.4, 0.6]]])
    )
    assert not found.converged
    assert "(0, 1)" in found.message


def test_one_wrong_reading_is_left_out_and_two_enlarge_the_deviation_of_their_cell_alone() -> None:
    ratio = wire_free_readings(np.full((2, 2), 1e5))
    estimator = make_estimator("ohm", SkinKnowledge(2, 2, adc_bits=10))
    good = estimator.estimate(ratio)
    ratio[1, 0, 2] = 1.0
    one = estimator.estimate(ratio)
    assert one.converged
    np.testing.assert_allclose(one.cell_siemens, good.cell_siemens, rtol=1e-6)
    assert one.cell_siemens_std[1, 0] > 1.5 * good.cell_siemens_std[1, 0]
    ratio[1, 0, 1] = 0.8
    two = estimator.estimate(ratio)
    assert not two.converged
    assert two.cell_siemens_std[1, 0] > 20 * good.cell_siemens_std[1, 0]
    np.testing.assert_allclose(
        np.delete(two.cell_siemens_std.ravel(), 2), np.delete(good.cell_siemens_std.ravel(), 2)
    )


def test_touched_without_rest_compares_with_the_median_cell() -> None:
    cell_ohm = np.full((3, 3), REST_OHM)
    cell_ohm[1, 2] = 2e4
    estimator = make_estimator("matrix", SkinKnowledge(3, 3, adc_bits=10))
    found = estimator.estimate(ten_bits(wire_free_readings(cell_ohm)))
    np.testing.assert_array_equal(found.touched, cell_ohm < REST_OHM)


def test_touched_with_rest_sees_every_cell_pressed() -> None:
    rest = wire_free_readings(np.full((2, 3), REST_OHM))
    estimator = make_estimator("matrix", SkinKnowledge(2, 3, rest_ratio=rest))
    assert estimator.estimate(wire_free_readings(np.full((2, 3), 1e4))).touched.all()
    assert not estimator.estimate(rest).touched.any()


@pytest.mark.parametrize("method", WIRE_FREE)
def test_what_rounding_may_be_is_no_touch_however_much_a_cell_conducts(method: str) -> None:
    """A code more at a cell of 1 kilohm is 100 uS more. Three codes more are no rounding."""
    rest = ten_bits(wire_free_readings(np.array([[1e3, REST_OHM]])))
    estimator = make_estimator(method, told(rest, wires=False))
    for codes, touched in ((1, False), (3, True)):
        ratio = rest.copy()
        ratio[0, 0] += codes / 1024 * np.array([-1, 1, -1, 1])
        found = estimator.estimate(ratio)
        assert (found.level - estimator.rest_level())[0, 0] > 100e-6
        np.testing.assert_array_equal(found.touched, [[touched, False]])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wrong", [np.nan, -0.001, 1.001, np.inf])
def test_the_first_offending_cell_is_named(method: str, wrong: float) -> None:
    ratio = np.full((2, 3, 4), 0.5)
    ratio[1, 2, 3] = ratio[1, 0, 1] = wrong
    with pytest.raises(ValueError, match=r"^ratio of cell \(1, 0\), reading B, is .* not in 0..1$"):
        make_estimator(method, SkinKnowledge(2, 3)).estimate(ratio)


@pytest.mark.parametrize("shape", [(3, 2, 4), (2, 3), (2, 3, 3), (1, 2, 3, 4)])
def test_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="has shape"):
        make_estimator("ohm", SkinKnowledge(2, 3)).estimate(np.full(shape, 0.5))


@pytest.mark.parametrize("method", LEVEL_METHODS)
def test_levels_are_conductances_but_of_voltage_the_voltages(method: str) -> None:
    rest, frame = (wire_free_readings(np.full((2, 2), ohm)) for ohm in (1e6, 2e5))
    estimator = make_estimator(method, told(rest, wires=False))
    found = estimator.estimate(ten_bits(frame))
    if method == "voltage":
        # (1 - A + B + 1 - C + D) / 4 of the readings in this order, and the noise of one of them.
        level = (2 + ten_bits(frame) @ [-1, 1, -1, 1]) / 4
        at_rest = (2 + ten_bits(rest) @ [-1, 1, -1, 1]) / 4
        np.testing.assert_allclose(found.level, level, rtol=1e-12)
        np.testing.assert_allclose(found.level_std, 1 / 1024 / np.sqrt(12))
        np.testing.assert_allclose(voltage_level(ten_bits(frame)), level, rtol=1e-12)
        by_ohm = make_estimator("ohm", told(rest, wires=False)).estimate(ten_bits(frame))
        np.testing.assert_array_equal(found.cell_siemens, by_ohm.cell_siemens)
        np.testing.assert_array_equal(found.touched, by_ohm.touched)
    else:
        at_rest = estimator.estimate(ten_bits(rest)).cell_siemens
        # For `joint` and `touch`, with what wires differ by: next to nothing on a skin without any.
        np.testing.assert_allclose(found.level, found.cell_siemens, rtol=1e-6)
        np.testing.assert_allclose(found.level_std, found.cell_siemens_std, rtol=1e-6)
    np.testing.assert_allclose(estimator.rest_level(), at_rest, rtol=0.05)


def test_the_level_of_an_unknown_rest_is_refused() -> None:
    with pytest.raises(ValueError, match="the readings of the untouched skin are not known"):
        make_estimator("ohm", SkinKnowledge(2, 2)).rest_level()


def test_an_unknown_method_is_answered_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="no method 'magic': choose one of ohm, matrix"):
        make_estimator("magic", SkinKnowledge(2, 2))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rows": 0}, "at least 1x1"),
        ({"ref_top_ohm": -1.0}, "ref_top_ohm"),
        ({"adc_bits": 0}, "adc bits"),
        ({"rest_ratio": np.ones((2, 2))}, "rest_ratio has shape"),
        ({"rest_ratio": np.full((2, 2, 4), 2.0)}, r"rest_ratio of cell \(0, 0\)"),
        ({"nominal_wire_ohm": WireOhm(-1.0)}, "nominal_top_wire_ohm"),
        ({"nominal_wire_ohm": WireOhm(bottom=np.nan)}, "nominal_bottom_wire_ohm"),
        ({"nominal_wire_ohm": WireOhm(lead=np.inf)}, "nominal_lead_ohm"),
    ],
)
def test_impossible_knowledge_is_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SkinKnowledge(**({"rows": 2, "columns": 2} | wrong))  # type: ignore[arg-type]


def test_wires_in_a_plain_tuple_are_refused() -> None:
    """It was an AttributeError of the tuple: it has no attribute 'check'."""
    with pytest.raises(TypeError, match=r"told as WireOhm\(100, 200\), not as \(100, 200\)$"):
        SkinKnowledge(2, 2, nominal_wire_ohm=(100, 200))  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("shape", [(3, 3), (6, 6)])
def test_a_hard_touch_is_one_though_nobody_has_told_the_wires(
    method: str, shape: tuple[int, int]
) -> None:
    """Of what the port shows, the wires may be much or little, but an untouched cell shows 1 uS."""
    skin, random = uniform_skin(shape), np.random.default_rng(3)
    knowledge = told(laplacian_readings(skin), wires=False)
    for ohm in (300.0, 1e3, 3e3):
        cell = tuple(random.integers(shape))
        siemens = skin.cell_siemens.copy()
        siemens[cell] = 1 / ohm
        ratio = laplacian_readings(replace(skin, cell_siemens=siemens))
        found = make_estimator(method, knowledge).estimate(ten_bits(ratio))
        assert np.argwhere(found.touched).tolist() == [list(cell)]
