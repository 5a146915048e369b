# SPDX-License-Identifier: Apache-2.0
"""The simulated experiments with force: their skins, errors and smallest forces."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from ohmskin.force.curve import MAX_EXPONENT
from studies import force_limits, published
from studies.force_experiment import (
    CHOICE,
    LINE,
    REGRESSIONS,
    SQUARES,
    Comparison,
    Row,
    learn,
    measure,
    rises,
)
from studies.force_limits import ALONE, BESIDE, Detection, press_series, smallest_forces
from studies.force_trial import ForceTrial, Plan, surface_trial
from studies.press import PressModel

SMALL = Plan(seeds=1, presses=6, test_presses=2, frames_per_press=2)


@pytest.fixture(scope="module")
def flat() -> ForceTrial:
    return surface_trial(2, 2, 3, SMALL, PressModel(), curved=False)


def test_calibration_presses_one_cell_and_the_test_three(flat: ForceTrial) -> None:
    single = flat.group < 0
    pressed = (flat.force_n > 0).sum(axis=(1, 2))
    assert (pressed[single] == 1).all()
    assert (pressed[~single] == 3).all()
    assert np.bincount(flat.cell[single]).tolist() == [12] * 4
    for force_n, cell in zip(flat.force_n[~single], flat.cell[~single], strict=True):
        row, column = divmod(int(cell), 2)
        assert force_n[:, 1 - column].tolist() == [0.981, 0.981]
        assert force_n[1 - row, column] == 0
        assert 0 < force_n[row, column] <= 8
    assert (np.diff(flat.time_s) > 1 / 90).all()


def test_readings_are_those_of_a_board_with_ten_bits(flat: ForceTrial) -> None:
    codes = flat.ratio * 1024 - 0.5
    np.testing.assert_array_equal(codes, codes.round())
    # A single touch is a cell between two references of 30 kOhm, and wires of 1 % of the least.
    single = flat.group < 0
    rows, columns = np.divmod(flat.cell[single], 2)
    siemens = 1e-6 + flat.rise_siemens[single, rows, columns]
    level = 30e3 / (60e3 + 1 / siemens)
    np.testing.assert_allclose(flat.ratio[single, rows, columns, 1], level, atol=0.015)
    np.testing.assert_allclose(flat.rest_ratio[..., 1], 30e3 / (60e3 + 1e6), atol=0.02)


def test_a_seed_repeats_and_a_bend_comes_after_the_calibration(flat: ForceTrial) -> None:
    again = surface_trial(2, 2, 3, SMALL, PressModel(), curved=False)
    np.testing.assert_array_equal(flat.ratio, again.ratio)
    other = surface_trial(2, 2, 4, SMALL, PressModel(), curved=False)
    assert (other.ratio != flat.ratio).any()
    bent = surface_trial(2, 2, 3, SMALL, PressModel(), curved=True)
    single = flat.group < 0
    np.testing.assert_array_equal(bent.force_n[single], flat.force_n[single])
    # The noise of the board is drawn later than the bend, hence an LSB or two.
    np.testing.assert_allclose(bent.ratio[single], flat.ratio[single], atol=3 / 1024)


def test_the_baseline_is_a_line_through_raw_readings(flat: ForceTrial) -> None:
    level = np.mean(np.abs(flat.ratio - [1, 0, 1, 0]), axis=-1)
    expected = np.empty_like(level)
    for row in range(2):
        for column in range(2):
            own = (flat.group < 0) & (flat.cell == 2 * row + column)
            slope, intercept = np.polyfit(
                level[own, row, column], flat.force_n[own, row, column], 1
            )
            expected[:, row, column] = slope * level[:, row, column] + intercept
    rise = rises("voltage", flat)
    np.testing.assert_allclose(learn(flat, rise, LINE)(rise), expected, atol=1e-9)


def test_true_conductances_of_perfect_cells_give_the_forces() -> None:
    ideal = PressModel(play_n=0.0, creep=0.0, noise=0.0, drift=0.0)
    perfect = replace(ideal, full_contact_siemens=1e6)
    trial = surface_trial(2, 2, 0, SMALL, perfect, curved=True)
    rise = rises("truth", trial)
    np.testing.assert_allclose(learn(trial, rise, CHOICE)(rise), trial.force_n, atol=1e-4)
    assert np.abs(learn(trial, rise, LINE)(rise) - trial.force_n).max() > 0.1


def test_errors_are_the_root_mean_squares(flat: ForceTrial) -> None:
    rows = measure([Comparison(2, 2, SMALL, ("voltage", "truth"), ("whole",))], curved=False)
    trial = surface_trial(2, 2, 0, SMALL, PressModel(), curved=False)
    rise = rises("truth", trial)
    off_n = learn(trial, rise, CHOICE)(rise) - trial.force_n
    row = only(rows, regression=CHOICE, method="truth", group="(2, 1)")
    at = trial.group == 2
    assert row.pressed_n == pytest.approx(np.sqrt(np.mean(off_n[at, 1, 0] ** 2)), abs=1e-4)
    assert row.every_cell_n == pytest.approx(np.sqrt(np.mean(off_n[at] ** 2)), abs=1e-4)
    at = (trial.group < 0) & (trial.cell == 2)
    assert row.calibration_n == pytest.approx(np.sqrt(np.mean(off_n[at, 1, 0] ** 2)), abs=1e-4)
    mean = only(rows, regression=CHOICE, method="truth", group="mean")
    voltage = only(rows, regression=CHOICE, method="voltage", group="mean")
    below = 100 * (1 - mean.pressed_n / voltage.pressed_n)
    assert mean.pressed_below_percent == pytest.approx(below, abs=0.1)
    assert voltage.pressed_below_percent == 0
    best_n = min(
        only(rows, regression=regression, method="voltage", group="mean").pressed_n
        for regression in REGRESSIONS
    )
    assert mean.pressed_below_best_percent == pytest.approx(
        100 * (1 - mean.pressed_n / best_n), abs=0.1
    )


def test_squares_are_curve_fits(flat: ForceTrial) -> None:
    """The baseline's best: steeper than any law that a calibration takes."""
    rise = rises("voltage", flat)
    own = (flat.group < 0) & (flat.cell == 3)
    x, force_n = rise[own, 1, 1], flat.force_n[own, 1, 1]
    law, _ = curve_fit(lambda x, a, b: a * x**b, x, force_n, p0=[100.0, 4.0], maxfev=10_000)
    assert law[1] > MAX_EXPONENT
    seen = np.full((1, 2, 2), 0.4)
    expected = law[0] * 0.4 ** law[1]
    assert learn(flat, rise, SQUARES)(seen)[0, 1, 1] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("curved", [False, True])
def test_ours_are_well_below_the_baseline(curved: bool) -> None:
    plan = Plan(seeds=2, test_presses=3, frames_per_press=2)
    methods = ("voltage", "touch", "truth")
    rows = measure([Comparison(2, 2, plan, methods, ("whole", "ideal"))], curved=curved)
    for cells, least in (("whole", 30), ("ideal", 60 if curved else 80)):
        touch = only(rows, cells=cells, regression=CHOICE, method="touch", group="mean")
        assert touch.pressed_below_percent > least
        assert touch.every_cell_below_percent > least
        assert touch.pressed_below_best_percent > least / 2
        assert touch.every_cell_below_best_percent > least


def test_larger_skins_are_grouped_by_touches() -> None:
    plan = Plan(seeds=1, presses=5, test_presses=1, frames_per_press=1)
    trial = surface_trial(3, 3, 0, plan, PressModel(), curved=False)
    for group in range(4):
        pressed = (trial.force_n[trial.group == group] > 0).sum(axis=(1, 2))
        assert pressed.tolist() == [group + 3] * 3


def test_the_paper_is_quoted() -> None:
    """What its table gives, which is less than what its text says."""
    for surface, percent in (("flat", 21.8), ("curved", 20.8)):
        table = published.FORCE_RMSE_N[surface]
        naive, solved = (np.mean(table[name, "estimation"]) for name in ("naive", "solved"))
        assert 100 * (1 - solved / naive) == pytest.approx(percent, abs=0.05)


def test_the_series_is_one_press_at_90_hz() -> None:
    trial = press_series(0)
    window = trial.group == 0
    np.testing.assert_allclose(np.diff(trial.time_s[window]), 1 / 90, rtol=1e-4)
    assert window.sum() == 360
    force_n = trial.force_n[window].reshape(-1, 4)
    assert not force_n[:, :3].any()
    assert force_n[:, 3].max() == 5
    assert force_n[0, 3] == force_n[-1, 3] == 0


def test_a_smallest_force_follows_from_the_noise_of_readings() -> None:
    """`voltage` alone: 2 x 2.33 standard deviations of the mean of four readings, 30 kOhm g."""
    plan = Detection(seeds=1, empty_frames=60, frames=12, forces=6, methods=("voltage", "joint"))
    rows = {(row.method, row.scene): row for row in smallest_forces(plan)}
    std = np.sqrt(0.3**2 + 1 / 12) / 1024 / 2
    expected_n = (2 * 2.33 * std / 30e3 / 30e-6) ** (1 / 1.7)
    alone = rows["voltage", ALONE]
    assert alone.median_n == pytest.approx(expected_n, rel=0.5)
    assert len(alone.by_cell_n) == 4
    beside = rows["joint", BESIDE]
    assert beside.worst_n < 0.3


@pytest.mark.parametrize(
    ("margin", "expected"),
    [([-1, -1, 1, 2], 2.0), ([1, 2, 3, 4], 1.0), ([1, -1, 1, 2], 2.0), ([1, 1, 1, -1], np.inf)],
)
def test_the_margin_must_stay_above_zero(margin: list[float], expected: float) -> None:
    forces_n = np.array([1.0, np.sqrt(2), 2 * np.sqrt(2), 4 * np.sqrt(2)])
    assert force_limits.crossing_n(forces_n, np.array(margin)) == pytest.approx(expected)


def only(rows: list[Row], **what: object) -> Row:
    found = [row for row in rows if all(getattr(row, key) == value for key, value in what.items())]
    assert len(found) == 1
    return found[0]
