# SPDX-License-Identifier: Apache-2.0
"""tests/data/far: what is in the files, against their script and the circuit."""

import numpy as np
import pytest

import far_scenes
from ohmskin.circuit.skin import all_readings, end_admittance
from ohmskin.record.readings import load_readings
from studies.trials import reference_trial

FILES = [f"{name}_{number}" for name in far_scenes.KINDS for number in range(2)]


def arrays(name: str) -> dict[str, np.ndarray]:
    with np.load(far_scenes.FOLDER / f"{name}.npz", allow_pickle=False) as file:
        return dict(file)


@pytest.mark.parametrize("name", FILES)
def test_the_files_are_what_their_script_draws(name: str) -> None:
    file, (kind, number) = arrays(name), name.rsplit("_", 1)
    drawn = far_scenes.skin(far_scenes.KINDS[kind], int(number))
    for key, expected in zip(
        ("cell_ohm", "rest_ohm", "top_wire_ohm", "bottom_wire_ohm"), drawn, strict=True
    ):
        np.testing.assert_allclose(file[key], expected, rtol=1e-12, err_msg=key)
    assert file["ratio"].shape == (far_scenes.FRAMES, *file["rest_ohm"].shape, 8)
    assert load_readings(far_scenes.FOLDER / f"{name}.npz").reading_names == tuple("abcdefgh")


@pytest.mark.parametrize("name", FILES)
def test_readings_at_rest_agree_with_the_circuit(name: str) -> None:
    """The files are by ngspice; test_circuit.py has their frames, test_ngspice.py asks it again."""
    trial = reference_trial(f"far/{name}")
    expected = all_readings(trial.rest, end_admittance(trial.rest))
    np.testing.assert_allclose(trial.readings.rest_ratio, expected, rtol=0, atol=1e-9)
