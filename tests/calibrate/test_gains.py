# SPDX-License-Identifier: Apache-2.0
"""Gains of cells, against dense normal distributions of scipy."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import invgamma, multivariate_normal

from ohmskin.arrays import Float
from ohmskin.calibrate.gains import Gains, find_gains
from ohmskin.calibrate.totals import GAIN_CELLS, GAIN_STD

CELLS, SCATTER_N = 24, 0.2  # the last cell is never pressed

Cells = NDArray[np.intp]


def presses(rows: int = 1) -> tuple[Cells, Cells, Float, Float]:
    """Press, cell, force and curve of rows: cell c is pressed c % 4 + 1 times."""
    random = np.random.default_rng(5)
    cells = np.repeat(np.arange(CELLS - 1), np.arange(CELLS - 1) % 4 + 1)
    curve_n = random.uniform(0.5, 8.0, cells.size)
    gain = np.exp(0.15 * random.standard_normal(CELLS))
    force_n = np.maximum(
        gain[cells] * curve_n + SCATTER_N * random.standard_normal(cells.size), 0.0
    )
    press = np.arange(cells.size)
    of_press = np.repeat(press, rows)
    return of_press, cells[of_press], force_n[of_press], curve_n[of_press]


def found(rows: int = 1) -> Gains:
    press, cell, force_n, curve_n = presses(rows)
    return find_gains(press, cell, force_n, curve_n, curve_n, CELLS)


def log_probability(s: float, t: float) -> float:
    """Of the forces, with all gains integrated out, and of t."""
    _, cell, force_n, curve_n = presses()
    same = cell[:, None] == cell
    covariance = s**2 * np.eye(cell.size) + t**2 * same * np.outer(curve_n, curve_n)
    of_forces = multivariate_normal(curve_n, covariance).logpdf(force_n)
    # Of an inverse gamma distribution: log p = -(a + 1) log t^2 - b / t^2.
    a, b = GAIN_CELLS / 2 - 1, GAIN_CELLS / 2 * GAIN_STD**2
    return float(of_forces + invgamma(a, scale=b).logpdf(t**2))


def test_both_scatters_are_the_most_probable_ones() -> None:
    gains = found()
    s, t = gains.scatter_n, float(gains.std[-1])  # nobody pressed the last cell
    print(f"presses scatter by {s:.3f} N, gains by {t:.3f}")
    assert s == pytest.approx(SCATTER_N, rel=0.25)
    here = log_probability(s, t)
    for more in (0.98, 1.02):
        assert log_probability(s * more, t) < here
        assert log_probability(s, t * more) < here


def test_gains_are_the_means_of_their_posterior() -> None:
    _, cell, force_n, curve_n = presses()
    gains = found()
    slopes = np.where(cell[:, None] == np.arange(CELLS), curve_n[:, None], 0.0)
    prior = float(gains.std[-1]) ** 2 * np.eye(CELLS)
    kept = (
        prior
        @ slopes.T
        @ np.linalg.inv(slopes @ prior @ slopes.T + gains.scatter_n**2 * np.eye(cell.size))
    )
    np.testing.assert_allclose(gains.gain, 1 + kept @ (force_n - curve_n), rtol=1e-9)
    variance = np.diagonal(prior - kept @ slopes @ prior)
    np.testing.assert_allclose(gains.std, np.sqrt(variance), rtol=1e-9)
    assert gains.gain[-1] == 1


def test_rows_of_a_press_count_as_one() -> None:
    """Thirty scans of a press tell no more than one, if all show the same."""
    for one, many in zip(found(1), found(30), strict=True):
        np.testing.assert_allclose(np.asarray(many), np.asarray(one), rtol=1e-6)


def test_held_out_errors_are_those_without_the_press() -> None:
    """A gain that the same s and t make of the other presses of the cell foresees each press."""
    press, cell, force_n, curve_n = presses()
    gains = found()
    ratio = (float(gains.std[-1]) / gains.scatter_n) ** 2
    for number in range(CELLS):
        off_n = []
        for held in np.flatnonzero(cell == number):
            others = (cell == number) & (press != press[held])
            f, off = curve_n[others], (force_n - curve_n)[others]
            gain = 1 + ratio * (f @ off) / (1 + ratio * (f @ f))
            off_n.append(force_n[held] - gain * curve_n[held])
        off_n = off_n or list(force_n - curve_n)
        expected = np.sqrt(np.mean(np.square(off_n)))
        assert gains.held_out_rmse[number] == pytest.approx(expected, rel=1e-9)


def test_exact_presses_have_exact_gains() -> None:
    press, cell, _, curve_n = presses()
    gain = np.linspace(0.8, 1.2, CELLS)
    gains = find_gains(press, cell, gain[cell] * curve_n, curve_n, curve_n, CELLS)
    np.testing.assert_allclose(gains.gain[:-1], gain[:-1], rtol=1e-6)
    assert gains.scatter_n < 1e-4


def test_a_cell_that_is_pressed_without_force_keeps_some_gain() -> None:
    """Ten presses of a cell show no force: the sensor was not under it."""
    press, cell, force_n, curve_n = presses()
    force_n[cell == 3] = 0.0
    gains = find_gains(press, cell, force_n, curve_n, curve_n, CELLS)
    assert 0.1 <= gains.gain[3] < 0.5
