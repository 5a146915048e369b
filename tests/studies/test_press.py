# SPDX-License-Identifier: Apache-2.0
"""The press model, against analytic answers and its own claims; a skin that follows it."""

from dataclasses import replace

import numpy as np
import pytest

from press_scene import PressScene
from pressed_skin import SeriesModel
from studies.press import PressModel

QUIET = PressModel(noise=0.0, drift=0.0, gain_spread=0.0, exponent_spread=0.0)
NO_CREEP = replace(QUIET, creep=0.0)


def test_loading_is_the_saturated_power_law() -> None:
    force_n = np.linspace(0.0, 10.0, 201)
    rise = NO_CREEP.rise(np.arange(201.0), force_n)
    contact = 30e-6 * force_n**1.7
    np.testing.assert_allclose(rise, contact * 4e-3 / (contact + 4e-3), rtol=1e-12)
    assert (np.diff(rise) > 0).all()
    assert rise[20] == pytest.approx(30e-6, rel=0.01)
    assert 1 / rise[-1] == pytest.approx(900, rel=0.05)


def test_unloading_conducts_more_and_ends_at_nothing() -> None:
    up_n = np.linspace(0.0, 5.0, 501)
    force_n = np.concatenate([up_n, up_n[-2::-1]])
    rise = NO_CREEP.rise(np.arange(1001.0), force_n)
    loading, unloading = rise[:501], rise[:499:-1]
    assert (unloading[1:-1] > loading[1:-1]).all()
    assert unloading[0] == loading[0] == 0.0
    # Once the play is used up, unloading follows the power law of a force h F / (F + h) larger.
    at_1n = 1 + 0.06 / 1.06
    assert unloading[100] / loading[100] == pytest.approx(at_1n**1.7, rel=0.01)


def test_the_other_law_has_a_resistor_in_series_and_two_branches() -> None:
    model = SeriesModel(noise=0.0, spread=0.0, exponent_spread=0.0)
    rise = model.rise(np.arange(5.0), np.array([0.0, 2.0, 4.0, 4.0, 2.0]))
    without = 1 / (1 / (30e-6 * np.array([2.0, 4.0, 4.0, 2.0]) ** 1.5) + 250)
    np.testing.assert_allclose(rise[1:] / without, [0.96, 0.96, 0.96, 1.04], rtol=1e-12)
    assert rise[0] == 0


def test_a_small_reversal_stays_within_the_loop() -> None:
    """Less than the play: the conductance does not follow the force down at all."""
    rise = NO_CREEP.rise(np.arange(4.0), np.array([0.0, 2.0, 1.96, 2.0]))
    assert rise[1] == rise[2] == rise[3] > 0


def test_creep_after_a_step_is_that_of_a_standard_linear_solid() -> None:
    model = replace(QUIET, play_n=0.0, creep=0.5, creep_time_s=2.0, full_contact_siemens=1e9)
    time_s = np.r_[0.0, 1e-9, np.linspace(0.1, 20.0, 40)]
    rise = model.rise(time_s, np.r_[0.0, np.full(41, 3.0)])
    deep_n = (rise / 30e-6) ** (1 / 1.7)
    crept_n = 3.0 * (1 + 0.5 * -np.expm1(-time_s[1:] / 2.0)) / 1.5
    np.testing.assert_allclose(deep_n[1:], crept_n, rtol=1e-6)


def test_creep_does_not_depend_on_the_steps_of_time() -> None:
    fine_s, coarse_s = np.linspace(0, 4, 4001), np.linspace(0, 4, 5)
    force_n = np.array([0.0, 3.0, 3.0, 5.0, 8.0])
    model = replace(QUIET, play_n=0.0)
    fine = model.rise(fine_s, np.interp(fine_s, coarse_s, force_n))
    np.testing.assert_allclose(fine[::1000], model.rise(coarse_s, force_n), rtol=1e-9)


def test_no_force_is_no_rise() -> None:
    assert not PressModel().rise(np.arange(100.0), np.zeros((100, 3, 2))).any()
    time_s = np.arange(0, 20, 0.01)
    after = PressModel().rise(time_s, np.where(time_s < 5, 8.0, 0.0))
    assert after[499] > 5e-4
    assert after[-1] < 1e-9


def test_without_memory_the_same_cells_make_the_same_noise() -> None:
    """Force alone tells the conductance, up to a noise that both have."""
    time_s = np.linspace(0, 10, 500)
    force_n = 0.01 + 4 * np.sin(np.pi * np.linspace(0, 1, 500)).clip(0)
    model = replace(PressModel(), full_contact_siemens=1e9)
    forgetful = replace(model, play_n=0.0, creep=0.0)
    noisy = forgetful.rise(time_s, force_n)
    gains = replace(forgetful, noise=0.0, drift=0.0).rise(time_s, force_n)
    quiet = replace(model, noise=0.0, drift=0.0).rise(time_s, force_n)
    np.testing.assert_allclose(model.rise(time_s, force_n) / quiet, noisy / gains, rtol=1e-9)
    np.testing.assert_allclose(gains, gains[::-1], rtol=1e-9)
    assert quiet[400] > 1.1 * quiet[-401]


def test_noise_has_its_stated_strength_and_memory() -> None:
    model = replace(QUIET, noise=0.24, noise_time_s=0.14, full_contact_siemens=1e9, seed=3)
    time_s = np.arange(0, 2000, 0.1)
    log_rise = np.log(model.rise(time_s, np.ones(time_s.size)) / 30e-6)
    assert log_rise.std() == pytest.approx(0.24, rel=0.05)
    neighbours = np.corrcoef(log_rise[:-1], log_rise[1:])[0, 1]
    assert neighbours == pytest.approx(np.exp(-0.1 / 0.14), abs=0.04)


def test_cells_differ_and_a_seed_repeats() -> None:
    time_s, force_n = np.arange(3.0), np.ones((3, 20, 20))
    model = replace(QUIET, gain_spread=0.2, seed=1)
    rise = model.rise(time_s, force_n)
    assert np.log(rise[0]).std() == pytest.approx(0.2, rel=0.15)
    np.testing.assert_array_equal(rise, model.rise(time_s, force_n))
    assert (replace(model, seed=2).rise(time_s, force_n) != rise).all()


def test_a_robot_presses_one_cell_after_another() -> None:
    scene = PressScene(2, 3, seed=5)
    time_s = np.arange(0, 130, 0.05)
    force_n = np.array([scene.force_n(t) for t in time_s])
    assert not force_n[time_s < 2].any()
    assert ((force_n > 0).sum(axis=(1, 2)) <= 1).all()
    for cell, forces in enumerate(force_n.reshape(-1, 6).T):
        begins = np.flatnonzero(np.diff((forces > 0).astype(int)) == 1)
        assert len(begins) == 6, f"cell {cell}"
        peaks = [float(part.max()) for part in np.split(forces, begins[1:])]
        assert peaks == sorted(peaks)
        assert 0.4 < peaks[0] < 0.6
        assert 6 < peaks[-1] < 8.1
    assert not force_n[-1].any()
