# SPDX-License-Identifier: Apache-2.0
"""Presses found in scans: which cell, which scans, which force."""

from dataclasses import replace

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.calibrate.presses import LevelHistory, find_presses, number_presses
from ohmskin.calibrate.tables import ForceLog

HZ = 90.0
OFFSET_S = 500.0


def history(rise: Float) -> LevelHistory:
    """Scans (n, R, C) of these rises [S]: touched above 0.5 microsiemens."""
    return LevelHistory(np.arange(len(rise)) / HZ, rise, np.full(rise.shape, 1e-8), rise > 0.5e-6)


def log_of(force_n: Float, zero_n: float = 0.0) -> ForceLog:
    """A sensor that samples with the scans, on a clock of its own."""
    return ForceLog(np.arange(force_n.size) / HZ - OFFSET_S, force_n + zero_n)


def bump(scans: int, begin: int, end: int, peak: float) -> Float:
    values = np.zeros(scans)
    values[begin:end] = peak * np.sin(np.linspace(0, np.pi, end - begin)) ** 2
    return values


def pressed_in_turn() -> tuple[Float, Float]:
    """Three presses of 3, 2 and 1 N on cells (0, 0), (1, 2) and (0, 0) again; rises and forces."""
    force_n = np.zeros((400, 2, 3))
    force_n[:, 0, 0] = bump(400, 50, 130, 3.0) + bump(400, 280, 350, 1.0)
    force_n[:, 1, 2] = bump(400, 170, 250, 2.0)
    return 20e-6 * force_n, force_n.sum(axis=(1, 2))


def test_each_press_has_its_cell_and_its_forces() -> None:
    rise, force_n = pressed_in_turn()
    found = find_presses(history(rise), log_of(force_n), OFFSET_S)
    np.testing.assert_array_equal(found.counts, [[2, 0, 0], [0, 0, 1]])
    assert sorted(set(found.press.tolist())) == [0, 1, 2]
    np.testing.assert_array_equal(np.unique(found.cells[found.press == 1]), [5])
    np.testing.assert_allclose(found.rise, 20e-6 * found.force_n, atol=1e-12)
    assert found.force_n.max() == pytest.approx(3.0, rel=1e-3)
    assert (found.shared, found.zero_n) == (0, 0.0)


def test_the_zero_of_the_sensor_is_taken_off() -> None:
    rise, force_n = pressed_in_turn()
    found = find_presses(history(rise), log_of(force_n, zero_n=0.25), OFFSET_S)
    assert found.zero_n == pytest.approx(0.25)
    np.testing.assert_allclose(found.rise, 20e-6 * found.force_n, atol=1e-12)


def test_scans_of_two_pressed_cells_are_left_out() -> None:
    rise, force_n = pressed_in_turn()
    rise[80:100, 0, 1] = 0.3 * rise[80:100, 0, 0]
    rise[200:220, 0, 1] = 0.2 * rise[200:220, 1, 2]
    found = find_presses(history(rise), log_of(force_n), OFFSET_S)
    assert found.shared == 20
    np.testing.assert_array_equal(found.counts, [[2, 0, 0], [0, 0, 1]])


def test_a_flicker_does_not_divide_a_press_and_a_bounce_is_none() -> None:
    rise, force_n = pressed_in_turn()
    whole = find_presses(history(rise), log_of(force_n), OFFSET_S)
    flickering = history(rise)
    flickering.touched[90:93] = False
    np.testing.assert_array_equal(
        find_presses(flickering, log_of(force_n), OFFSET_S).counts, whole.counts
    )
    bouncing = rise.copy()
    bouncing[10:14, 1, 0] = 5e-6
    np.testing.assert_array_equal(
        find_presses(history(bouncing), log_of(force_n), OFFSET_S).counts, whole.counts
    )


def test_a_slow_board_sees_short_presses_and_the_pauses_between_them() -> None:
    """At 5 scans/s, a press of 0.8 s has four scans; after a pause of 0.4 s comes the next one.

    Noise of an untouched cell is no second press, however little the pressed cell shows.
    """
    times_s = np.arange(60) / 5
    force_n = np.zeros((60, 1, 2))
    for begin in range(10, 58, 6):
        force_n[begin : begin + 4, 0, begin // 34] = [0.5, 2.0, 3.0, 1.0]
    rise = np.where(force_n > 0, 20e-6 * force_n, 4e-6)
    seen = LevelHistory(times_s, rise, np.full_like(rise, 4e-6), force_n > 0)
    found = find_presses(seen, ForceLog(times_s - OFFSET_S, force_n.sum(axis=(1, 2))), OFFSET_S)
    np.testing.assert_array_equal(found.counts, [[4, 4]])
    assert found.shared == 0
    assert found.cells.size == 32  # no scan of a pause


def test_presses_in_quick_succession_are_several() -> None:
    """Creep keeps the cell touched in between, noise makes it flutter."""
    random = np.random.default_rng(4)
    force_n = bump(400, 20, 140, 1.0) + bump(400, 140, 260, 8.0) + bump(400, 260, 380, 3.0)
    rise = 20e-6 * (force_n + 0.15 * (force_n > 0)) * np.exp(0.2 * random.standard_normal(400))
    found = find_presses(history(rise[:, None, None]), log_of(force_n), OFFSET_S)
    assert found.counts.item() == 3
    assert sorted(round(found.force_n[found.press == n].max()) for n in range(3)) == [1, 3, 8]


@pytest.mark.parametrize(
    ("rise", "numbers"),
    [
        ([0.2, 5, 8, 7.99, 8, 7.98, 8, 7.99, 8, 5, 0.2], [0] * 11),
        ([0.2, 8, 7.9, 8, 1, 8, 7.9, 8, 0.2], [0] * 4 + [1] * 5),
        ([8, 1, 5, 4.9, 5, 0.9, 8, 8, 7.9, 8], [0] + [1] * 4 + [2] * 5),
    ],
)
def test_a_maximum_that_repeats_exactly_is_one_press(rise: list[float], numbers: list[int]) -> None:
    """As where readings are whole steps of a converter. Deep valleys divide presses as ever."""
    found = number_presses(np.zeros(len(rise), np.intp), np.array(rise), 1 / HZ)
    np.testing.assert_array_equal(found, numbers)


def test_sliding_from_cell_to_cell_is_a_press_of_each() -> None:
    force_n = np.zeros((200, 1, 2))
    force_n[:, 0, 0], force_n[:, 0, 1] = bump(200, 20, 100, 2.0), bump(200, 90, 170, 2.0)
    found = find_presses(history(20e-6 * force_n), log_of(force_n.sum(axis=(1, 2))), OFFSET_S)
    np.testing.assert_array_equal(found.counts, [[1, 1]])


def test_scans_without_a_force_are_left_out() -> None:
    rise, force_n = pressed_in_turn()
    log = log_of(force_n)
    late = replace(log, time_s=log.time_s[150:], force_n=log.force_n[150:])
    found = find_presses(history(rise), late, OFFSET_S)
    np.testing.assert_array_equal(found.counts, [[1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("rise", "offset_s", "reason"),
    [
        (pressed_in_turn()[0], 0.0, "no cell is pressed alone while the force is known"),
        (np.zeros((400, 2, 3)), OFFSET_S, "no cell is pressed alone while the force is known"),
        (np.full((400, 2, 3), 1e-5), OFFSET_S, "no cell is pressed alone"),
    ],
)
def test_what_holds_no_press_is_refused(rise: Float, offset_s: float, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        find_presses(history(rise), log_of(pressed_in_turn()[1]), offset_s)
