# SPDX-License-Identifier: Apache-2.0
"""What the pressure of fingertips tells of gains, by fingertips of which the truth is known."""

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.calibrate.smoothness import OWN_STDS, Smoothness, peaks, smoothness

SHAPE = 6, 7
CELLS = SHAPE[0] * SHAPE[1]


def fingertips(count: int, edge: float = 0.0) -> Float:
    """Forces (count, C) [N] of fingertips that are as wide as they like, and lie as they like.

    edge: how much of their pressure has the edge of a flat stamp.
    """
    random = np.random.default_rng(1)
    row, column = np.indices(SHAPE)
    force_n = []
    for _ in range(count):
        middle, turn = random.uniform(0, np.subtract(SHAPE, 1)), random.uniform(0, np.pi)
        down, right = row - middle[0], column - middle[1]
        along = np.cos(turn) * down + np.sin(turn) * right
        across = np.cos(turn) * right - np.sin(turn) * down
        round_tip = np.exp(-((along / 1.5) ** 2) - (across / 1.1) ** 2)
        stamp = np.hypot(along, across) < 1.6
        force_n.append((1 - edge) * round_tip + edge * stamp)
    shown = np.reshape(force_n, (count, CELLS)) * random.uniform(1, 12, (count, 1))
    return np.where(shown > 0.01 * shown.max(axis=1, keepdims=True), shown, 0.0)


def told(force_n: Float, log_rise: Float | None = None) -> Smoothness:
    """What these forces tell."""
    steep = np.zeros_like(force_n) if log_rise is None else log_rise
    found = smoothness(force_n, steep, SHAPE)
    assert found is not None
    return found


def changes(found: Smoothness, stds: Float) -> Float:
    """The most probable g and e, (2, C), where they have these deviations (2C,) before."""
    both = np.linalg.solve(found.precision + np.diag(stds**-2.0), found.pull)
    return np.asarray(both.reshape(2, CELLS))


def rough(cells: Float) -> Float:
    """Of a value a cell (C,), what is not smooth from cell to cell: second differences."""
    return np.diff(np.diff(cells.reshape(SHAPE), 2, axis=0), 2, axis=1)


def test_gains_that_no_total_shows_are_found() -> None:
    """A checkerboard: under a fingertip, half of the gains are too large, and half too small."""
    gains = 0.1 * (-1.0) ** np.indices(SHAPE).sum(axis=0).ravel()
    force_n = fingertips(200)
    seen = force_n * np.exp(gains)
    totals = np.log(seen.sum(axis=1) / force_n.sum(axis=1))
    assert np.std(totals) < 0.02
    found, _ = changes(told(seen), np.repeat([0.25, 1e-6], CELLS))
    assert rough(found) == pytest.approx(rough(-gains), abs=0.02 * 16)


def test_exponents_of_cells_are_found() -> None:
    """A cell whose exponent is off stands out at high forces, the other way at low ones."""
    random = np.random.default_rng(2)
    bends = 0.02 * random.standard_normal(CELLS)
    force_n = fingertips(400)
    log_rise = np.log(np.maximum(force_n, 1e-3)) / 0.67
    found = changes(told(force_n * np.exp(bends * log_rise), log_rise), np.repeat(0.1, 2 * CELLS))
    assert np.std(rough(found[1] + bends)) < 0.5 * np.std(rough(bends))


def test_gains_that_are_right_stay() -> None:
    """Of fingertips whose pressure is a quadratic of place: nothing pulls."""
    found = told(fingertips(100))
    assert np.abs(found.pull).max() < 1e-6 * found.precision.diagonal().max()


def test_fingers_with_edges_tell_less() -> None:
    smooth, edged = told(fingertips(100)), told(fingertips(100, edge=0.5))
    assert edged.precision.diagonal().max() < 0.3 * smooth.precision.diagonal().max()


def test_no_gain_is_known_better_than_a_plate_is_even() -> None:
    """The pattern of gains that presses tell best has the plate's deviation, or a larger one."""
    force_n = fingertips(3000)
    found = told(force_n, np.log(np.maximum(force_n, 1e-3)) / 0.67)
    own = np.repeat(OWN_STDS, CELLS)
    best = np.linalg.eigvalsh(own[:, None] * found.precision * own)[-1]
    assert 0.95 < best < 1.0


def test_too_few_presses_or_cells_tell_nothing() -> None:
    force_n = fingertips(5)
    assert smoothness(force_n, np.zeros_like(force_n), SHAPE) is None
    single = 3.0 * np.eye(CELLS)
    assert smoothness(single, np.zeros_like(single), SHAPE) is None
    assert smoothness(single[:0], single[:0], SHAPE) is None


def test_fingers_on_two_rows_tell_the_same_upside_down() -> None:
    """Two of the six quadratics are alike there. Rounding said what counted in place of one."""
    shape, random = (2, 8), np.random.default_rng(3)
    row, column = np.indices(shape)
    middle = random.uniform(0, np.subtract(shape, 1), (100, 2))[..., None, None]
    logs = -((row - middle[:, 0]) ** 2) - ((column - middle[:, 1]) / 2.5) ** 2
    force_n = np.exp(logs + 0.05 * random.standard_normal(logs.shape))
    pulls = []
    for turned_n in (force_n, force_n[:, ::-1]):
        cells_n = turned_n.reshape(len(turned_n), -1)
        found = smoothness(cells_n, np.zeros_like(cells_n), shape)
        assert found is not None
        pulls.append(found.pull.reshape(2, *shape))
    np.testing.assert_allclose(pulls[1][:, ::-1], pulls[0], atol=1e-6 * np.abs(pulls[0]).max())


def test_the_strongest_scan_of_each_hardest_cell_is_taken() -> None:
    """A finger that rolls from cell 0 to cell 1, a pause, and another press."""
    hardest = [(0, 1.0), (0, 5.0), (0, 4.0), (1, 4.5), (1, 6.0), (1, 2.0), (2, 9.0), (2, 3.0)]
    force_n = np.zeros((len(hardest), 3))
    for scan, (cell, force) in enumerate(hardest):
        force_n[scan, cell] = force
    press = np.array([0, 0, 0, 0, 0, 0, -1, 3])
    assert peaks(force_n, press).tolist() == [1, 4, 7]
