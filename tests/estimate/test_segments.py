# SPDX-License-Identifier: Apache-2.0
"""What single segments of long wires differ from their layers by: learned; no part of forces."""

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


def test_what_segments_differ_by_is_no_part_of_a_force() -> None:
    """Cells pressed alone, as for a calibration; and again, once segments are known."""
    trial = random_trial(8, 8, 8, 120, seed=2, wire_ohm=LONG)
    cells = [(7, 7), (6, 5), (5, 6), (7, 4), (3, 7)]

    def pressed(cell: tuple[int, int]) -> Skin:
        siemens = trial.rest.cell_siemens.copy()
        siemens[cell] = 1 / 2000
        return replace(trial.rest, cell_siemens=siemens)

    alone = [pressed(cell) for cell in cells]
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
