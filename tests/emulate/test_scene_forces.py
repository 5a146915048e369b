# SPDX-License-Identifier: Apache-2.0
"""Forces of scenes: what presses a cell, and what that adds to its conductance."""

import numpy as np
import pytest

from ohmskin.calibrate.rules import MIN_PRESSES
from ohmskin.emulate.scenes import ROBOT_PRESSES, SCENES, Scene


def rise(scene: Scene, time_s: float) -> np.ndarray:
    """What touches add to the cells [S]."""
    return scene.skin(time_s).cell_siemens - scene.rest.cell_siemens


@pytest.mark.parametrize("name", SCENES)
def test_cells_follow_one_power_law_each_in_every_scene(name: str) -> None:
    """Scenes of one seed are of one skin: its cells have the same law, whatever presses them."""
    scene, scale = Scene(name, 3, 4, seed=5), Scene("weights", 3, 4, seed=5)
    scene.put(((1, 1), 2.0) if name == "weights" else None)
    for time_s in np.arange(0.0, 20.0, 0.37):
        force_n = scene.force_n(time_s)
        assert ((force_n > 0) == (rise(scene, time_s) > 0)).all()
        for cell in np.argwhere(force_n):
            place = int(cell[0]), int(cell[1])
            scale.put((place, float(force_n[place])))
            np.testing.assert_allclose(rise(scale, 0.0)[place], rise(scene, time_s)[place])
    one_n, two_n = (scale.put(((2, 3), each)) or rise(scale, 0.0)[2, 3] for each in (1.0, 2.0))
    assert two_n / one_n == pytest.approx(2**1.7)
    assert one_n == pytest.approx(30e-6, rel=1.0)


def test_a_weight_lies_on_one_cell_until_it_is_taken_off() -> None:
    scene = Scene("weights", 2, 2)
    untouched = scene.ratio(1.0)
    for weight in (((0, 1), 1.5), ((1, 0), 0.5), None):
        scene.put(weight)
        force_n = np.zeros((2, 2))
        if weight is not None:
            force_n[weight[0]] = weight[1]
        np.testing.assert_allclose(scene.force_n(1.0), force_n)
        assert (scene.ratio(1.0) == untouched).all() == (weight is None)


def test_a_weight_between_cells_presses_several() -> None:
    scene = Scene("weights", 4, 4)
    scene.put(((1.5, 2.0), 3.0))
    force_n = scene.force_n(1.0)
    assert force_n.sum() == pytest.approx(3.0)
    assert force_n[1, 2] == pytest.approx(force_n[2, 2])
    assert np.argwhere(force_n).tolist() == [[1, 1], [1, 2], [1, 3], [2, 1], [2, 2], [2, 3]]


def test_the_robot_presses_each_cell_as_often_as_a_curve_needs() -> None:
    assert ROBOT_PRESSES == MIN_PRESSES
    scene = Scene("presses", 2, 3, seed=4)
    times_s = np.arange(0.0, 6 + 6 * 5 + 2, 0.005)
    force_n = np.array([scene.force_n(time_s).ravel() for time_s in times_s])
    assert not force_n[times_s < 6].any()
    assert (np.count_nonzero(force_n, axis=1) <= 1).all()
    begins = np.flatnonzero((force_n[1:].sum(axis=1) > 0) & (force_n[:-1].sum(axis=1) == 0)) + 1
    cells = force_n[begins + 1].argmax(axis=1)
    assert cells.tolist() == [cell for cell in range(6) for _ in range(5)]
    peaks_n = np.array([force_n[begin : begin + 120].max() for begin in begins])
    assert peaks_n.min() >= 0.4
    assert peaks_n.max() <= 8.0
    assert np.unique(np.round(np.diff(times_s[begins]), 2)).size > 10  # at irregular times
    assert not force_n[-1].any()


def test_fingertips_come_to_all_cells_and_press_them_together() -> None:
    scene = Scene("knead", 8, 8, seed=4)
    times_s = np.arange(0.0, 6 + 130, 0.02)
    force_n = np.array([scene.force_n(time_s) for time_s in times_s])
    total_n = force_n.sum(axis=(1, 2)).round(6)
    assert not total_n[times_s < 6].any()
    peaks_n = total_n[1:-1][(total_n[1:-1] > total_n[:-2]) & (total_n[1:-1] >= total_n[2:])]
    assert 110 < peaks_n.size < 180
    assert 0.8 < peaks_n.min() < 1.3
    assert 11.0 < peaks_n.max() <= 12.0
    assert force_n.max(axis=0).min() > 0.5  # no cell is left out
    assert 3 <= np.median(np.count_nonzero(force_n[total_n > 1.0] > 0.05, axis=(1, 2))) <= 12
    middle = [np.tensordot(force_n, at, 2) / np.maximum(total_n, 1e-9) for at in np.mgrid[:8, :8]]
    held = (total_n[1:] > 0.9) & (total_n[1:] == total_n[:-1])
    assert np.hypot(*np.diff(middle))[held].mean() > 0.01  # they move
