# SPDX-License-Identifier: Apache-2.0
"""The judge of estimates, against numbers by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from ohmskin.record.readings import estimate_file
from studies.judge import Judged, Verdict, judge, judge_trial, pooled, verdict
from studies.trials import random_trial

REST = 1e-6 * np.array([[1.0, 1.0, 2.0]])
TRUE = 1e-6 * np.array([[[100.0, 1.0, 2.0]], [[1.0, 1.0, 2.0]], [[1.4, 50.0, 20.0]]])
FOUND = 1e-6 * np.array([[[110.0, 0.5, 2.25]], [[1.0, 1.0, 2.0]], [[1.4, 49.0, 30.0]]])
STD = 1e-6 * np.array([[[4.0, 0.25, 0.125]], [[0.0, 1.0, 1.0]], [[1.0, 2.0, 1.0]]])


@pytest.fixture
def judged() -> Judged:
    answers = {
        "cell_siemens": FOUND,
        "cell_siemens_std": STD,
        "converged": np.array([True, True, False]),
        "seconds": np.array([1.0, 2.0, 3.0]),
    }
    return judge(answers, TRUE, REST)


def test_pressed_cells_are_those_that_conduct_half_as_much_again(judged: Judged) -> None:
    np.testing.assert_allclose(judged.relative, [0.1, 0.02, 0.5])
    np.testing.assert_allclose(judged.stated, [0.04, 0.04, 0.05])
    assert judged.error_percent() == pytest.approx(10)
    assert judged.error_percent(1.0) == pytest.approx(50)
    assert judged.pressed_within_percent() == pytest.approx(100 * 2 / 3)
    assert judged.pressed_within_percent(1) == pytest.approx(100 / 3)


def test_no_error_is_within_any_deviation(judged: Judged) -> None:
    np.testing.assert_allclose(judged.deviations, [2.5, 2, 2, 0, 0, 0, 0, 0.5, 10])
    assert judged.within_percent(1) == pytest.approx(100 * 5 / 9)
    assert judged.within_percent() == pytest.approx(100 * 8 / 9)


def test_quantities_of_frames(judged: Judged) -> None:
    np.testing.assert_allclose(judged.ghost_siemens, [0.25e-6, 0, 0], atol=1e-18)
    assert judged.ghost_us() == pytest.approx(0.225)  # 95 % of the way from 0 to 0.25, and 0
    np.testing.assert_allclose(judged.rise_siemens, [99e-6, 0, 67.4e-6], atol=1e-18)
    np.testing.assert_allclose(judged.rise_share[[0, 2]], [108.75 / 99, 76.4 / 67.4])
    assert np.isnan(judged.rise_share[1])
    # 1/110 - 1/100, 1/0.5 - 1 and 1/2.25 - 1/2 megohm in the first frame.
    expected = np.sqrt(((1 / 110 - 0.01) ** 2 + 1 + (1 / 2.25 - 0.5) ** 2) / 3)
    np.testing.assert_allclose(judged.rmse_megohm[:2], [expected, 0])
    assert judged.converged_percent() == pytest.approx(100 * 2 / 3)


def test_skins_are_pooled_and_what_is_not_stated_is_no_number(judged: Judged) -> None:
    one_cell = judge(
        {"cell_siemens": np.full((1, 1, 1), 3e-6)}, np.full((1, 1, 1), 4e-6), REST[0, :1]
    )
    both = pooled([judged, one_cell])
    np.testing.assert_allclose(both.relative, [0.1, 0.02, 0.5, 0.25])
    assert both.seconds.size == both.rise_share.size == 4
    assert np.isnan([both.stated[-1], both.deviations[-1], both.seconds[-1]]).all()
    assert not both.converged[-1]


def test_frames_of_a_trial() -> None:
    trial = random_trial(3, 4, 4, 6, seed=1)
    answers = estimate_file(trial.rounded(10), "ohm")
    late = judge_trial(answers, trial, slice(4, None))
    error = np.abs(answers["cell_siemens"] / trial.cell_siemens - 1)[4:]
    np.testing.assert_allclose(late.relative, error[trial.pressed[4:]])
    np.testing.assert_array_equal(late.seconds, answers["seconds"][4:])


@pytest.mark.parametrize(
    ("cells_us", "std_us", "expected"),
    [
        ([200.0, 1.0], [0.0, 0.0], "right"),
        ([209.0, 1.0], [0.0, 0.0], "right"),  # within 5 %
        ([200.0, 1.45], [0.0, 0.0], "right"),  # within 0.5 uS
        ([200.0, 0.0], [9.0, 0.3], "flagged"),  # 1 uS too low, but 3.3 deviations
        ([211.0, 1.0], [3.0, 0.1], "flagged"),  # 5.5 %, but 3.7 deviations
        ([211.0, 1.0], [2.0, 0.1], "wrong_unflagged"),  # 5.5 deviations
        ([189.0, 1.0], [2.0, 0.1], "wrong_unflagged"),  # as much too low
        ([200.0, 1.6], [9.0, 0.1], "wrong_unflagged"),  # a ghost
        ([211.0, 1.6], [9.0, 0.1], "wrong_unflagged"),  # one stated, one not
        ([211.0, 1.0], [np.nan, np.nan], "wrong_unflagged"),  # no deviation is no excuse
        ([209.0, 1.0], [np.nan, np.nan], "right"),
        ([1e9, 1.0], [np.inf, 0.1], "flagged"),
        ([np.nan, 1.0], [9.0, 0.1], "wrong_unflagged"),
        ([np.nan, 1.0], [np.inf, 0.1], "wrong_unflagged"),
    ],
)
def test_verdict(cells_us: list[float], std_us: list[float], expected: str) -> None:
    """Truth: a touched cell of 200 microsiemens and one of 1 at rest."""
    truth, cells, std = (1e-6 * np.array([each]) for each in ([200.0, 1.0], cells_us, std_us))
    estimate = SimpleNamespace(cell_siemens=cells, cell_siemens_std=std, converged=True)
    assert verdict(estimate, truth) == expected
    estimate.converged = False
    assert verdict(estimate, truth) == verdict(None, truth) == Verdict.FLAGGED
