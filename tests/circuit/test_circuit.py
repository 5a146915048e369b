# SPDX-License-Identifier: Apache-2.0
"""The forward model against files of ngspice and hand arithmetic."""

from dataclasses import replace

import numpy as np
import pytest

from ohmskin.circuit.configurations import current_from_ratio, current_std
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, port_resistance_ohm, readings
from places import DATA
from skins import uniform_skin
from studies.trials import reference_trial

REFERENCE_FILES = sorted(
    str(path.relative_to(DATA).with_suffix("")) for path in DATA.rglob("*_[0-9]x[0-9]*.npz")
)


def test_all_reference_files_are_there() -> None:
    assert len(REFERENCE_FILES) == 9 + 8


@pytest.mark.parametrize("name", REFERENCE_FILES)
def test_readings_agree_with_ngspice(name: str) -> None:
    trial = reference_trial(name)
    # Measured: 6e-13, the last digit ngspice printed. Those of far/ are rounded to 1e-9.
    tolerance = 1e-9 if name.startswith("far/") else 2e-12
    for skin, expected in zip(trial.frames, trial.readings.ratio, strict=True):
        np.testing.assert_allclose(readings(skin), expected[..., :4], rtol=0, atol=tolerance)
        found = all_readings(skin, end_admittance(skin))[..., : expected.shape[-1]]
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_one_cell_is_a_series_circuit() -> None:
    skin = replace(uniform_skin((1, 1), 1 / 39_700, (100, 200)), ref_bottom_ohm=20_000)
    assert port_resistance_ohm(skin) == pytest.approx(40_000)
    # 1 V over 30 + 40 + 20 kOhm.
    np.testing.assert_allclose(readings(skin)[0, 0], [6 / 9, 2 / 9, 7 / 9, 3 / 9], rtol=1e-12)


def test_two_by_two_without_wires_is_a_cell_beside_three_in_series() -> None:
    ohm = np.array([[1e3, 2e3], [3e3, 4e3]])
    skin = Skin(1 / ohm, np.zeros((2, 2)), np.zeros((2, 2)))
    others = ohm.sum() - ohm
    np.testing.assert_allclose(port_resistance_ohm(skin), ohm * others / ohm.sum(), rtol=1e-12)


def test_one_row_adds_the_segments_up_to_the_cell() -> None:
    skin = Skin(np.array([[1e-3, 1e-3, 1e-3]]), np.array([[10.0, 20, 30]]), np.full((1, 3), 5.0))
    np.testing.assert_allclose(port_resistance_ohm(skin), [[1015, 1035, 1065]], rtol=1e-12)


def test_far_ends_show_the_crossing_that_carries_the_current() -> None:
    """One cell conducts; its row and column carry the current up to it, and nothing beyond."""
    cell = np.zeros((3, 4))
    cell[1, 2] = 1 / 40e3
    skin = Skin(cell, np.full((3, 4), 1e3), np.full((3, 4), 2.5e3), ref_bottom_ohm=20e3)
    # 30 kOhm, three segments of the row, the cell, two of the column, 20 kOhm: 98 kOhm.
    a, b, e, f = (np.array([98 - 30, 20, 98 - 33, 25]) / 98).tolist()
    found = all_readings(skin, end_admittance(skin))[1, 2]
    np.testing.assert_allclose(found, [a, b, 1 - b, 1 - a, e, f, 1 - f, 1 - e], rtol=1e-9)


def test_leads_are_in_series_with_the_port_and_lose_nothing_up_to_far_ends() -> None:
    cell = np.zeros((3, 4))
    cell[1, 2] = 1 / 40e3
    leads = np.array([7, 5, 7, 9, 9, 2, 9]) * 1e3  # three rows, four columns
    skin = Skin(cell, np.full((3, 4), 1e3), np.full((3, 4), 2.5e3), lead_ohm=leads)
    # 30 kOhm, lead of 5, three segments of 1, the cell, two of 2.5, lead of 2, 30 kOhm: 115 kOhm.
    a, b, e, f = (np.array([115 - 30, 30, 115 - 38, 37]) / 115).tolist()
    found = all_readings(skin, end_admittance(skin))[1, 2]
    np.testing.assert_allclose(found, [a, b, 1 - b, 1 - a, e, f, 1 - f, 1 - e], rtol=1e-9)
    np.testing.assert_allclose(readings(skin)[1, 2], [a, b, 1 - b, 1 - a], rtol=1e-12)
    assert port_resistance_ohm(skin)[1, 2] == pytest.approx(48e3)  # of the skin alone
    alike = replace(skin, lead_ohm=np.array(80.0))
    np.testing.assert_array_equal(alike.lead_ohm, [80.0] * 7)
    assert not Skin(cell, skin.top_wire_ohm, skin.bottom_wire_ohm).lead_ohm.any()


def test_open_cells_give_inf_ports_and_readings_at_the_rails() -> None:
    skin = uniform_skin((3, 2), 0.0)
    assert np.all(np.isinf(port_resistance_ohm(skin)))
    np.testing.assert_array_equal(readings(skin), np.broadcast_to([1, 0, 1, 0], (3, 2, 4)))


def test_current_is_the_combination_of_least_variance() -> None:
    skin = replace(uniform_skin((2, 3), 1e-4, (100, 200)), ref_top_ohm=27e3, ref_bottom_ohm=33e3)
    exact = readings(skin)
    refs = (skin.ref_top_ohm, skin.ref_bottom_ohm)
    truth = 1 / (port_resistance_ohm(skin) + sum(refs))
    np.testing.assert_allclose(current_from_ratio(exact, *refs), truth, rtol=1e-12)

    noise = 1e-3 * np.random.default_rng(0).standard_normal((4000, *exact.shape))
    spread = current_from_ratio(exact + noise, *refs).std()
    least = 1e-3 / np.sqrt(2 * refs[0] ** 2 + 2 * refs[1] ** 2)
    error = (current_from_ratio(exact + noise, *refs) - truth).std()
    assert error == pytest.approx(least, rel=0.02)
    assert spread > error
    # The stated one also holds for noise that all four readings share, twice as much at most.
    assert least < current_std(1e-3, *refs) <= 2 * least


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell_siemens": np.ones(4)}, "cell_siemens must be"),
        ({"cell_siemens": np.ones((0, 2))}, "cell_siemens must be"),
        ({"top_wire_ohm": np.ones((2, 3))}, "top_wire_ohm has shape"),
        ({"bottom_wire_ohm": np.full((2, 2), -1.0)}, "bottom_wire_ohm must be finite"),
        ({"cell_siemens": np.full((2, 2), np.nan)}, "cell_siemens must be finite"),
        ({"ref_top_ohm": 0.0}, "ref_top_ohm must be from 1"),
        ({"ref_bottom_ohm": np.inf}, "ref_bottom_ohm must be from 1"),
        ({"lead_ohm": np.ones(3)}, "lead_ohm has shape"),
        ({"lead_ohm": np.array(-1.0)}, "lead_ohm must be finite"),
    ],
)
def test_impossible_skins_are_refused(change: dict[str, object], message: str) -> None:
    skin = {name: np.ones((2, 2)) for name in ("cell_siemens", "top_wire_ohm", "bottom_wire_ohm")}
    with pytest.raises(ValueError, match=message):
        Skin(**(skin | change))  # type: ignore[arg-type]


def test_a_skin_keeps_its_own_copy() -> None:
    cell = np.ones((2, 2))
    skin = Skin(cell, np.ones((2, 2)), np.ones((2, 2)))
    cell[0, 0] = 7
    assert skin.cell_siemens[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        skin.cell_siemens[0, 0] = 2
