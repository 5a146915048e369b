# SPDX-License-Identifier: Apache-2.0
"""References that are not as told, by a node Laplacian (tests/helpers/network.py)."""

from dataclasses import replace

import numpy as np
import pytest

from network import SkinCircuit  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ENUMS, MODES
from studies.trials import random_trial

TRIAL = random_trial(8, 8, 6, 12, seed=9)


def read(true_ohm: float, told_ohm: float, method: str, mode: str, std: float) -> list[Estimate]:
    """All frames of a skin at references of `true_ohm`, where `told_ohm` is told."""
    circuit = SkinCircuit(replace(TRIAL.rest, ref_top_ohm=true_ohm, ref_bottom_ohm=true_ohm))
    names = [ENUMS["reading"].values[name] for name in MODES[mode]]
    cells = [TRIAL.rest.cell_siemens, *TRIAL.cell_siemens]
    exact = np.array([circuit.readings(siemens) for siemens in cells])[..., names]
    rest, *frames = ratio_from_codes(quantise(exact))
    known = SkinKnowledge(
        *(8, 8, told_ohm, told_ohm, 10, rest),
        nominal_wire_ohm=WireOhm(lead=0.0),
        reading_names=MODES[mode],
        ref_log_std=std,
    )
    estimator = make_estimator(method, known)
    return [estimator.estimate(frame) for frame in frames]


def within_4(found: list[Estimate]) -> float:
    siemens, stds = of(found, "cell_siemens"), of(found, "cell_siemens_std")
    error = np.abs(siemens - TRIAL.cell_siemens)[TRIAL.pressed]
    return float(np.mean(error < 4 * stds[TRIAL.pressed]))


def of(found: list[Estimate], name: str) -> Float:
    return np.array([getattr(one, name) for one in found])


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("mode", MODES)
def test_what_both_references_may_be_off_by_is_in_the_deviation(mode: str, method: str) -> None:
    silent = read(31_500, 30_000, method, mode, 0.0)
    told = read(31_500, 30_000, method, mode, 0.05)
    assert within_4(silent) < 0.9
    assert within_4(told) > 0.98
    assert np.array_equal(of(silent, "touched"), of(told, "touched"))


def test_a_level_and_so_a_force_does_not_depend_on_what_references_may_be_off_by() -> None:
    """A calibration is learned through the same references: both have the same error."""
    right = read(31_500, 31_500, "touch", "near", 0.0)
    wrong = read(31_500, 30_000, "touch", "near", 0.05)
    assert of(wrong, "level") == pytest.approx(1.05 * of(right, "level"), rel=0.02)
    share, wrong_share = (of(one, "level_std") / of(one, "level") for one in (right, wrong))
    # Where a cell may be the hardest touch that there is, a little more noise changes all.
    known = share < 1
    assert known.mean() > 0.99
    assert wrong_share[known] == pytest.approx(share[known], rel=0.2)
