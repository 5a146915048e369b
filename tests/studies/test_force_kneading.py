# SPDX-License-Identifier: Apache-2.0
"""Skins that are kneaded, beside single touches of the same skins."""

import numpy as np
import pytest

from studies import force_kneading
from studies.force_experiment import CELLS, CHOICE, Comparison, measure
from studies.force_kneading import KNEADED, SINGLE, SINGLE_VOLTAGE, Row, fingertips_n
from studies.force_trial import Plan

PLAN = Plan(seeds=1, presses=6, test_presses=2, frames_per_press=2)


@pytest.fixture(scope="module")
def ideal() -> list[Row]:
    """3x3 cells without memory and noise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(force_kneading, "MODEL", CELLS["ideal"])
        return force_kneading.measure(3, PLAN, 20.0)


def test_fingertips_press_every_cell_after_a_rest() -> None:
    time_s, force_n = fingertips_n((4, 3), 60.0, np.random.default_rng(0))
    total_n = force_n.sum(axis=(1, 2))
    assert not total_n[time_s < 2].any()
    assert 8 < total_n.max() <= 12
    assert (force_n.max(axis=0) > 1).all()
    assert (force_n > 0).sum(axis=(1, 2)).max() > 4  # several cells at once
    begun = np.count_nonzero(np.diff((total_n > 0).astype(int)) > 0)
    assert begun == pytest.approx(57 / 0.5, rel=0.15)


def test_both_ways_read_the_same_skin_and_the_same_frames(ideal: list[Row]) -> None:
    ways = (SINGLE_VOLTAGE, SINGLE, KNEADED)
    names = [(row.surface, row.calibrated) for row in ideal]
    assert names == [(surface, way) for surface in ("flat", "curved") for way in ways]
    for voltage, kneaded in zip(ideal[::3], ideal[2::3], strict=True):
        np.testing.assert_array_equal(voltage.true_n, kneaded.true_n)
        # With another skin's curves, cells would be off by a tenth and more.
        assert np.median(np.abs(kneaded.force_n / kneaded.true_n - 1)) < 0.05
        assert kneaded.pressed_n < 0.5 * voltage.pressed_n
        assert kneaded.every_cell_n < 0.5 * voltage.every_cell_n


def test_single_touches_are_those_of_the_papers_experiment(ideal: list[Row]) -> None:
    plan = Comparison(3, 3, PLAN, ("voltage", "joint"), ("ideal",))
    rows = measure([plan], curved=False)
    means = [row for row in rows if (row.regression, row.group) == (CHOICE, "mean")]
    for expected, row in zip(means, ideal[:2], strict=True):
        assert row.pressed_n == pytest.approx(expected.pressed_n, abs=1e-3)
        assert row.every_cell_n == pytest.approx(expected.every_cell_n, abs=1e-3)
