# SPDX-License-Identifier: Apache-2.0
"""Trials of reference files: the truth beside the readings is the one that gives them."""

import numpy as np
import pytest

from ohmskin.circuit.skin import all_readings, end_admittance, readings
from studies.trials import reference_trial


@pytest.mark.parametrize("name", ["random_4x6", "bent_8x8", "wire_sweep_3x3", "far/harsh_8x8_0"])
def test_the_skins_of_a_file_give_its_readings(name: str) -> None:
    """Of this circuit and of ngspice's: so cells, wires and frames belong together."""
    trial = reference_trial(name)
    exact = trial.rounded(None).ratio
    assert len(exact) == len(trial.frames)
    for skin, ratio in zip(trial.frames, exact, strict=True):
        np.testing.assert_allclose(readings(skin), ratio, atol=1e-7)


def test_some_frames_of_a_file_in_mode_far() -> None:
    some = reference_trial("far/random_5x9_0", slice(-2, None))
    exact = some.rounded(None, mode="far")
    assert len(some.frames) == len(exact.ratio) == 2
    skin = some.frames[1]
    a_to_h = all_readings(skin, end_admittance(skin))
    np.testing.assert_allclose(a_to_h[..., [0, 4, 1, 5]], exact.ratio[1], atol=1e-7)
    picked = reference_trial("random_8x8", np.array([3, 7]))
    every = reference_trial("random_8x8")
    np.testing.assert_array_equal(picked.cell_siemens, every.cell_siemens[[3, 7]])
    np.testing.assert_array_equal(picked.readings.ratio, every.readings.ratio[[3, 7]])
