# SPDX-License-Identifier: Apache-2.0
"""What wires are told wrongly by, or single segments differ by: learned, and no part of forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.estimate import joint
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.estimate.methods import make_estimator
from studies.trials import Trial, random_trial, trial_of

LONG = (500.0, 1000.0)  # ohm a segment


def late_errors(trial: Trial) -> tuple[Float, Float]:
    """Of pressed cells in the second half of the frames: over the truth; over what is stated."""
    given = trial.rounded(10)
    estimator = make_estimator("joint", given.knowledge(0))
    answers = [estimator.estimate(ratio) for ratio in given.ratio]
    late = np.arange(len(answers)) >= len(answers) // 2
    pressed = trial.pressed & late[:, None, None]
    found, std = (
        np.array([getattr(answer, name) for answer in answers])[pressed]
        for name in ("cell_siemens", "cell_siemens_std")
    )
    off = np.abs(found - trial.cell_siemens[pressed])
    return off / trial.cell_siemens[pressed], off / std


def test_touches_teach_single_segments_of_long_wires(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = [random_trial(8, 8, 8, 80, seed, wire_ohm=LONG) for seed in range(3)]
    share, stds_off = np.concatenate([late_errors(trial) for trial in trials], axis=1)
    assert np.mean(stds_off < 4) > 0.98
    monkeypatch.setattr(joint, "LEARNED_LINE_OHM", np.inf)
    without, _ = np.concatenate([late_errors(trial) for trial in trials], axis=1)
    assert np.median(share) < 0.8 * np.median(without)


def pressed(rest: Skin, cell: tuple[int, int]) -> Skin:
    """This skin with one cell pressed to 2 kOhm."""
    siemens = rest.cell_siemens.copy()
    siemens[cell] = 1 / 2000
    return replace(rest, cell_siemens=siemens)


def test_what_segments_differ_by_is_no_part_of_a_force() -> None:
    """Cells pressed alone, as for a calibration; and again, once segments are known."""
    trial = random_trial(8, 8, 8, 120, seed=2, wire_ohm=LONG)
    cells = [(7, 7), (6, 5), (5, 6), (7, 4), (3, 7)]
    alone = [pressed(trial.rest, cell) for cell in cells]
    given = trial_of(trial.rest, [*alone, *trial.frames, *alone], LONG).rounded(10)
    # Layers are known, so that single segments alone are learned.
    wires = WireOhm(*LONG, 0.0, 0.01, 0.01)
    known = replace(given.knowledge(0), nominal_wire_ohm=wires, may_be_bent=False)
    estimator = make_estimator("joint", known)
    answers = [estimator.estimate(ratio) for ratio in given.ratio]
    # All cells move a little with the layers; by how much they differ in that comes from segments.
    apart = {
        name: np.std(
            [
                np.log(getattr(late, name)[cell] / getattr(first, name)[cell])
                for cell, first, late in zip(cells, answers, answers[-5:], strict=False)
            ]
        )
        for name in ("cell_siemens", "level")
    }
    assert apart["cell_siemens"] > 0.02
    assert apart["level"] < 0.2 * apart["cell_siemens"]


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_what_wires_were_told_wrongly_by_is_no_part_of_a_force(method: str) -> None:
    """Told half of the wires, by presses that hardly know them; and again, once they are learned.

    A new session begins with the learned wires. It gives the same level, from its first frame on.
    """
    cells = [(3, 3), (2, 1), (0, 3)]
    trial = random_trial(4, 4, 4, 40, seed=1, wire_ohm=LONG)
    alone = [pressed(trial.rest, cell) for cell in cells]
    given = trial_of(trial.rest, [*alone, *trial.frames, *alone], LONG).rounded(10)
    told = WireOhm(0.5 * LONG[0], 0.5 * LONG[1], 0.0, 0.7, 0.7, 1.0)
    known = replace(given.knowledge(0), nominal_wire_ohm=told)
    estimator = make_estimator(method, known)
    answers = [estimator.estimate(ratio) for ratio in given.ratio]
    learned = told.or_surer(estimator.wires())
    assert learned.top is not None
    assert learned.top > 0.8 * LONG[0]
    again = make_estimator(method, replace(known, nominal_wire_ohm=learned))
    anew = [again.estimate(ratio) for ratio in given.ratio[-3:]]
    for cell, first, late, new in zip(cells, answers, answers[-3:], anew, strict=False):
        assert late.cell_siemens[cell] > 1.2 * first.cell_siemens[cell]
        for later in (late, new):
            assert later.level[cell] == pytest.approx(first.level[cell], rel=0.1)


def test_what_a_skin_is_stretched_by_is_no_part_of_a_level() -> None:
    """Wires that were well known when cells were pressed, and have doubled since."""
    trial = random_trial(4, 4, 4, 40, seed=1, wire_ohm=LONG)
    told = WireOhm(0.5 * LONG[0], 0.5 * LONG[1], 0.0, 0.02, 0.02, 1.0)
    given = trial.rounded(10)
    estimator = make_estimator("joint", replace(given.knowledge(0), nominal_wire_ohm=told))
    for ratio in given.ratio:
        found = estimator.estimate(ratio)
    # What single wires differ by is in the level, whatever the layers do.
    off = np.abs(found.level / found.cell_siemens - 1)[found.touched]
    assert off.max() < 0.2


def test_wires_that_are_learned_twice_are_still_those_of_the_curves() -> None:
    told = WireOhm(100.0, 200.0, 80.0, 0.3, 0.3, 50.0)
    once = WireOhm(144.0, 200.0, 200.0, 0.1, 0.0, 10.0).for_curves_of(told)
    # Half of the change was there when they were told: by a deviation of 0.3, as of stretch.
    assert once.of_curves[:3] == pytest.approx((120.0, 200.0, 80.0))
    twice = WireOhm(144.0, 300.0, 90.0, 0.1, 0.1, 5.0).for_curves_of(once)
    assert twice.of_curves[:3] == pytest.approx((120.0, 300.0, 80.0))
    assert told.for_curves_of(NO_WIRES) == told  # nobody knows what the curves were made with


@pytest.mark.parametrize("seed", [7, 15])
def test_usual_wires_that_nobody_told_are_not_taken_for_long_ones(seed: int) -> None:
    """Their lines have 1.6 kOhm. Single segments make each frame take twice as long."""
    given = random_trial(8, 8, 6, 10, seed).rounded(10)
    knowledge = replace(given.knowledge(0), nominal_wire_ohm=NO_WIRES)
    estimator = make_estimator("joint", knowledge)
    for ratio in given.ratio:
        found = estimator.estimate(ratio)
    # Where segments are learned, some of them are known better than others.
    assert np.ptp(found.top_wire_ohm_std / found.top_wire_ohm) < 1e-9
