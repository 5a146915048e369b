# SPDX-License-Identifier: Apache-2.0
"""tests/data/far: what is in the files, against their script, ngspice and the node Laplacian."""

import numpy as np
import pytest

import far_scenes
from network import laplacian_readings
from ohmskin.circuit.skin import Skin, all_readings, end_admittance
from ohmskin.record.readings import load_readings

FILES = [f"{name}_{number}" for name in far_scenes.KINDS for number in range(2)]


def arrays(name: str) -> dict[str, np.ndarray]:
    with np.load(far_scenes.FOLDER / f"{name}.npz", allow_pickle=False) as file:
        return dict(file)


def skin_in(file: dict[str, np.ndarray], frame: int) -> Skin:
    return Skin(1 / file["cell_ohm"][frame], file["top_wire_ohm"], file["bottom_wire_ohm"])


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
def test_readings_agree_with_the_circuit(name: str) -> None:
    file = arrays(name)
    for frame in range(0, far_scenes.FRAMES, 5):
        skin = skin_in(file, frame)
        # Readings are rounded to 1e-9.
        expected = all_readings(skin, end_admittance(skin))
        np.testing.assert_allclose(file["ratio"][frame], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["random_5x9_1", "harsh_8x8_0"])
def test_readings_agree_with_the_laplacian(name: str) -> None:
    file = arrays(name)
    expected = laplacian_readings(skin_in(file, 7), names="abcdefgh")
    np.testing.assert_allclose(file["ratio"][7], expected, rtol=0, atol=1e-9)


@pytest.mark.ngspice
def test_ngspice_still_says_so() -> None:
    file = arrays("random_5x9_0")
    wires = file["top_wire_ohm"], file["bottom_wire_ohm"]
    found = far_scenes.rounded(file["cell_ohm"][7], *wires)
    np.testing.assert_allclose(found, file["ratio"][7], rtol=0, atol=2e-9)
    np.testing.assert_allclose(
        far_scenes.rounded(file["rest_ohm"], *wires), file["rest_ratio"], rtol=0, atol=2e-9
    )
