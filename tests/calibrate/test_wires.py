# SPDX-License-Identifier: Apache-2.0
"""Wires found from presses, against readings of the node Laplacian and two models of presses."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from network import SkinCircuit
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.tables import PRESS
from ohmskin.calibrate.wires import FoundWires, PressReadings, find_wires
from ohmskin.circuit.configurations import current_from_ratio
from ohmskin.circuit.skin import Skin
from ohmskin.cli.calibrate import _wires_in_words
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.force.calibration import load_calibration
from pressed_skin import LAWS, Plan, PressedSkin, calibrate
from stepped import stepped

FORCES_N = np.geomspace(0.5, 8.0, 6)
REF_OHM = 30_000.0


def skin(shape: tuple[int, int], top_ohm: float, bottom_ohm: float, lead_ohm: float = 0.0) -> Skin:
    ones = np.ones(shape)
    leads = np.full(sum(shape), lead_ohm)
    return Skin(1e-6 * ones, top_ohm * ones, bottom_ohm * ones, lead_ohm=leads)


def found_by(
    of: Skin,
    told: WireOhm,
    cells: list[int],
    scatter: float = 0.0,
    seed: int = 0,
    series_ohm: float = 250.0,
    series_scatter: float = 0.0,
) -> FoundWires:
    """From presses of these cells, each by all forces: a power law with a resistance in series.

    scatter: of what a cell conducts under any force, and a sixth of it of each press.
    series_scatter: of the resistance in series, from cell to cell.
    """
    random = np.random.default_rng(seed)
    circuit, rest = SkinCircuit(of), of.cell_siemens
    currents, factor = [], np.exp(scatter * random.standard_normal(rest.size))
    series = series_ohm * np.exp(
        series_scatter * np.random.default_rng(seed + 100).standard_normal(rest.size)
    )
    for cell in cells:
        for force_n in FORCES_N:
            contact = 30e-6 * factor[cell] * force_n**1.5
            contact *= np.exp(scatter / 6 * random.standard_normal())
            pressed = rest.copy()
            pressed.flat[cell] += contact / (1 + series[cell] * contact)
            ratio = circuit.readings(pressed)[..., :4]
            currents.append(current_from_ratio(ratio, REF_OHM, REF_OHM).flat[cell])
    pressed = np.repeat(cells, FORCES_N.size)
    rest_ratio = circuit.readings(rest)[..., :4]
    knowledge = SkinKnowledge(*of.shape, rest_ratio=rest_ratio, nominal_wire_ohm=told)
    readings = PressReadings(
        pressed,
        np.arange(len(currents)),
        np.tile(FORCES_N, len(cells)),
        np.array(currents),
        np.full(len(currents), 1e-9),
    )
    return find_wires(knowledge, readings)


@pytest.mark.parametrize("wires", [(30.0, 60.0), (200.0, 100.0), (3000.0, 9000.0)])
def test_exact_presses_give_exact_wires(wires: tuple[float, float]) -> None:
    """Whatever the wires are, from no knowledge of them, and with leads that are told.

    That presses scatter is expected, so exact ones do not outweigh the rest of what is expected.
    """
    found = found_by(skin((5, 4), *wires, 300.0), WireOhm(lead=300.0), list(range(20)))
    assert found.wires.both == pytest.approx(wires, rel=0.02, abs=6.0)
    assert found.wires.lead == pytest.approx(300.0, rel=0.05)
    assert (found.presses, found.unclear, found.disagrees) == (120, (), False)


def open_row(of: Skin, row: int) -> Skin:
    leads = of.lead_ohm.copy()
    leads[row] = 1e10
    return replace(of, lead_ohm=leads)


def test_an_open_line_is_said_and_changes_nothing_else(tmp_path: Path) -> None:
    """`joint` took its presses for weak ones elsewhere: forces of sound cells were 2 N off. The fit
    of the wires did not end, and said leads of 348 ohm to 0 % where 77 were.
    """
    pressed = PressedSkin(Plan((100.0, 200.0), "series", 5, (6, 6)))
    pressed.rest = open_row(pressed.rest, 2)
    pressed.record(tmp_path / "r.mcap")
    said = calibrate(tmp_path / "r.mcap", tmp_path / "skin.json", "joint")
    assert "row 2 conducted nothing at rest: is it open?" in said
    rows = [line.split()[1:] for line in said.splitlines() if re.match(r"\d +[\d-]", line)]
    presses = [[cell.strip("()") for cell in row if cell == "-" or "(" in cell] for row in rows]
    assert presses == [["-" if row == 2 else "5"] * 6 for row in range(6)]
    wires = load_calibration(tmp_path / "skin.json").nominal_wire_ohm
    assert wires.both == pytest.approx((100, 200), abs=30)
    assert wires.lead_std_ohm is not None
    assert wires.lead == pytest.approx(0.0, abs=3 * wires.lead_std_ohm)


def with_own_lead(of: Skin, line: int, own_ohm: float) -> Skin:
    leads = of.lead_ohm.copy()
    leads[line] += own_ohm
    return replace(of, lead_ohm=leads)


@pytest.mark.parametrize(("line", "own_ohm"), [(2, 2000.0), (9, 700.0)])
def test_a_lead_unlike_the_others_is_found(line: int, own_ohm: float) -> None:
    """A row's and a column's, beside leads of 300 ohm and cells that scatter. As long as nothing
    looked for it, it passed for a scatter of all contacts, and the wires were not found.
    """
    even = skin((6, 6), 100.0, 200.0, 300.0)
    found = found_by(with_own_lead(even, line, own_ohm), WireOhm(), list(range(36)), 0.1)
    assert found.own_lead_ohm is not None
    assert np.flatnonzero(found.own_lead_ohm).tolist() == [line]
    assert found.own_lead_ohm[line] == pytest.approx(own_ohm, rel=0.2)
    assert found.odd_stripe is None
    np.testing.assert_allclose(found.wires.both, (100, 200), rtol=0.15)


@pytest.mark.parametrize("size", [4, 6])
def test_several_leads_unlike_the_others_are_found(size: int) -> None:
    """On 4x4, one of two explains too little to be believed by itself: neither was found."""
    row, column = 1, size + 2
    of = with_own_lead(skin((size, size), 100.0, 200.0), row, 2500.0)
    of = with_own_lead(of, column, 1500.0)
    found = found_by(of, WireOhm(), list(range(size**2)), 0.1)
    assert found.own_lead_ohm is not None
    assert np.flatnonzero(found.own_lead_ohm).tolist() == [row, column]
    np.testing.assert_allclose(found.own_lead_ohm[[row, column]], (2500, 1500), rtol=0.2)
    np.testing.assert_allclose(found.wires.both, (100, 200), rtol=0.25, atol=40.0)


@pytest.mark.parametrize(("line", "more"), [(3, 3.0), (7, 2.0)])
def test_a_stripe_unlike_the_others_is_no_lead(line: int, more: float) -> None:
    """A row's segments have 200 ohm more, and a column's."""
    even = skin((6, 6), 100.0, 200.0)
    top, bottom = even.top_wire_ohm.copy(), even.bottom_wire_ohm.copy()
    layer = top[line] if line < 6 else bottom[:, line - 6]
    layer *= more
    worn = replace(even, top_wire_ohm=top, bottom_wire_ohm=bottom)
    found = found_by(worn, WireOhm(), list(range(36)), 0.05)
    assert found.own_lead_ohm is None
    assert found.odd_stripe is not None
    assert found.odd_stripe.line == line
    assert found.odd_stripe.ohm == pytest.approx(200.0, rel=0.2)


def test_no_line_of_even_ones_is_odd() -> None:
    for seed in range(10):
        found = found_by(skin((5, 4), 60.0, 30.0), WireOhm(), list(range(20)), 0.2, seed)
        assert (found.own_lead_ohm, found.odd_stripe) == (None, None)


def test_a_lead_unlike_the_others_costs_no_force(tmp_path: Path) -> None:
    """2 kohm more at a column: `touch` was off by three times as much as without."""
    errors_n = []
    for own_ohm in (0.0, 2000.0):
        plan = Plan((50.0, 600.0), "series", 5, (4, 4), odd_lead_ohm=own_ohm, touches=30)
        pressed = PressedSkin(plan)
        recording = tmp_path / f"presses-{own_ohm:.0f}.mcap"
        pressed.record(recording)
        said = calibrate(recording, tmp_path / "skin.json", "touch")
        errors_n.append(pressed.read(tmp_path / "skin.json").rmse_n())
    print(f"{errors_n[0]:.3f} N, behind the lead {errors_n[1]:.3f} N")
    assert errors_n[1] < 1.3 * errors_n[0]
    own_ohm = load_calibration(tmp_path / "skin.json").own_lead_ohm
    assert own_ohm is not None
    assert own_ohm[5] == pytest.approx(2000.0, rel=0.15)
    assert f"leads unlike the others': column 1 +{own_ohm[5]:.0f} ohm: forces count them" in said


def test_leads_are_what_the_usual_contact_leaves_in_series() -> None:
    found = found_by(skin((5, 4), 100.0, 200.0, 600.0), WireOhm(), list(range(20)))
    assert found.wires.both == pytest.approx((100.0, 200.0), rel=0.05)
    assert found.wires.lead == pytest.approx(600.0, rel=0.1)
    assert found.wires.lead_std_ohm is not None
    assert 60 < found.wires.lead_std_ohm < 300  # the contact may have more or less than 250 ohm


def test_stated_deviations_are_those_of_repeated_skins() -> None:
    """Cells scatter by 20 %, presses by 3 %, and nothing is told."""
    true = np.log([100.0, 200.0])
    of, off = skin((5, 4), 100.0, 200.0), []
    for seed in range(12):
        wires = found_by(of, WireOhm(), list(range(20)), 0.2, seed).wires
        stds = wires.top_log_std, wires.bottom_log_std
        off.append((np.log(wires.both or 1) - true) / np.array(stds, np.float64))
    assert np.mean(np.abs(off) < 2) > 0.9
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_contacts_that_saturate_do_not_pass_for_wires() -> None:
    """At 600 uS, and some cells before others. With a fixed scatter of that, 2.5."""
    true, of, off = np.log([20.0, 200.0]), skin((6, 6), 20.0, 200.0), []
    for seed in range(8):
        wires = found_by(of, WireOhm(), list(range(36)), 0.2, seed, 1600.0, 0.3).wires
        stds = wires.top_log_std, wires.bottom_log_std
        off.append((np.log(wires.both or 1) - true) / np.array(stds, np.float64))
        print(f"{wires.top:.0f} {wires.bottom:.0f} ohm, {off[-1].round(1)} deviations off")
    assert np.sqrt(np.mean(np.square(off))) < 2


def test_cells_of_one_row_tell_little_of_the_columns() -> None:
    found = found_by(skin((5, 4), 300.0, 300.0), WireOhm(), [0, 1, 2, 3], 0.2)
    assert found.unclear == ("bottom",)
    assert found.wires.bottom_log_std is not None
    assert found.wires.bottom_log_std > 0.5


@pytest.mark.parametrize(("factor", "disagrees"), [(1.0, False), (2.0, True), (0.5, True)])
def test_told_wires_are_one_more_piece_of_evidence(factor: float, disagrees: bool) -> None:
    told = WireOhm(factor * 300.0, factor * 600.0)
    found = found_by(skin((5, 4), 300.0, 600.0), told, list(range(20)), 0.2)
    assert found.wires.both == pytest.approx((300.0, 600.0), rel=0.15)
    assert found.disagrees is disagrees
    # Where presses tell nothing, what was told stays.
    found = found_by(skin((5, 4), 300.0, 600.0), told, [0, 1], 0.2)
    assert found.wires.bottom == pytest.approx(factor * 600.0, rel=0.35)


@pytest.mark.parametrize(("told_ohm", "disagrees"), [(300.0, False), (1200.0, True)])
@pytest.mark.parametrize("layers", [(None, None), (100.0, 200.0)])
def test_a_lead_that_was_told_wrongly_moves_no_wires(
    told_ohm: float, disagrees: bool, layers: tuple[float | None, float | None]
) -> None:
    """Believed, a lead of 1200 ohm would leave nothing for the wires: 19 ohm for 100."""
    of, cells = skin((5, 4), 100.0, 200.0, 300.0), list(range(20))
    found = found_by(of, WireOhm(*layers, told_ohm), cells, 0.2)
    assert found.wires.both == pytest.approx((100.0, 200.0), rel=0.15)
    assert found.wires.lead == pytest.approx(300.0, abs=150.0)
    assert (found.disagrees, found.lead_disagrees) == (False, disagrees)


@pytest.mark.parametrize("factor", [1e-5, 0.01, 100.0, 1000.0])
def test_wires_that_were_told_in_another_unit_count_for_nothing(factor: float) -> None:
    """Near 0 ohm, presses have no slope by the log of wires: a fit that is there stays there."""
    of, cells = skin((4, 4), 100.0, 200.0), list(range(16))
    found = found_by(of, WireOhm(factor * 100.0, factor * 200.0), cells, 0.2)
    assert found.disagrees
    untold = found_by(of, WireOhm(), cells, 0.2)
    assert found.wires.both == pytest.approx(untold.wires.both, rel=1e-3)


@pytest.mark.parametrize(("cells", "factor"), [([0, 1, 2, 3], 2.5), ([0, 4, 8, 12], 3.0)])
def test_layers_that_presses_do_not_tell_are_no_evidence(cells: list[int], factor: float) -> None:
    """Cells of one line tell one layer, and it was told wrongly.

    That the other one may be anything, if nothing was told, makes that no less probable.
    """
    told = WireOhm(factor * 100.0, factor * 200.0)
    found, untold = (
        found_by(skin((4, 4), 100.0, 200.0), each, cells, 0.2).wires for each in (told, WireOhm())
    )
    assert found.both == pytest.approx(untold.both, rel=1e-3)


@pytest.mark.parametrize(
    ("told", "kept"),
    [
        (WireOhm(None, 2.0), WireOhm()),
        (WireOhm(1.0, 2.0, 300.0, None, None, 300.0), WireOhm(lead=300.0, lead_std_ohm=300.0)),
    ],
    ids=["one layer", "lead"],
)
def test_what_counts_for_nothing_are_layers_alone(told: WireOhm, kept: WireOhm) -> None:
    """A wrong layer held the other one's place; and a lead of 300 +- 300 ohm was kept as exact."""
    of, cells = skin((4, 4), 100.0, 200.0, 600.0), list(range(16))
    found, expected = (found_by(of, each, cells, 0.2) for each in (told, kept))
    assert list(found.wires[:6]) == pytest.approx(list(expected.wires[:6]), rel=1e-3)
    assert (found.disagrees, expected.disagrees) == (True, False)


def test_readings_under_weights_tell_the_wires() -> None:
    """Three weights twice on every cell: conductances that were read without knowing the wires."""
    of, law, random = skin((5, 4), 300.0, 600.0), [], np.random.default_rng(4)
    circuit, rest = SkinCircuit(of), of.cell_siemens
    true, ratios = [], []
    for cell, force_n in product(range(20), np.tile([0.5, 1.0, 2.0], 2)):
        contact = 100e-6 * force_n**1.5 * np.exp(0.03 * random.standard_normal())
        true.append(contact / (1 + 250.0 * contact))
        pressed = rest.copy()
        pressed.flat[cell] += true[-1]
        ratios.append(circuit.readings(pressed)[..., :4])
        law.append((*divmod(cell, 4), force_n, 0.8 * true[-1], 0.01 * true[-1]))
    rest_ratio = circuit.readings(rest)[..., :4]
    with ohmskin.open("emulator://5x4", start=False) as board:
        calibrator = Calibrator(board.info, rest_ratio, "joint", 8e-5)
    presses = calibrator.presses_in_table(np.array(law, PRESS), np.array(ratios))
    assert calibrator.found is not None
    assert calibrator.found.wires.both == pytest.approx((300.0, 600.0), rel=0.1)
    np.testing.assert_allclose(presses.rise, true, rtol=0.05)
    np.testing.assert_allclose(presses.rise_std / presses.rise, 0.0125, rtol=0.05)


def test_what_shows_no_press_is_refused() -> None:
    rest = SkinCircuit(skin((2, 2), 100.0, 100.0)).readings(np.full((2, 2), 1e-6))[..., :4]
    nothing = PressReadings(*(np.zeros(9, np.intp),) * 2, np.ones(9), np.zeros(9), np.ones(9))
    with pytest.raises(ValueError, match="no scan shows a press clearly"):
        find_wires(SkinKnowledge(2, 2, rest_ratio=rest), nothing)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("wires", [(200.0, 400.0), (10_000.0, 10_000.0)])
def test_recordings_tell_the_wires(law: str, wires: tuple[float, float], tmp_path: Path) -> None:
    """Through the command: at 10 kilohms a segment, too, clocks are aligned and presses found."""
    pressed = PressedSkin(Plan(wires, law, 3, shape=(4, 4), touches=1))
    true = [layer.mean() for layer in (pressed.rest.top_wire_ohm, pressed.rest.bottom_wire_ohm)]
    recording, out = tmp_path / "presses.mcap", tmp_path / "skin.json"
    pressed.record(recording)
    said = calibrate(recording, out, "touch")
    found = load_calibration(out).nominal_wire_ohm
    np.testing.assert_allclose(found.both, true, rtol=0.12, atol=30.0)
    words = f"wires: {found.top:.0f} and {found.bottom:.0f} ohm a segment by 80 presses, "
    assert words in said
    assert "told" not in said
    # Other wires are told: it says so, and finds the same. So it does where far ends show them.
    of_far = replace(load_calibration(out), mode="far")
    board = replace(stepped("emulator://4x4").info, mode="near")
    calibrator = Calibrator(board, of_far.rest.ratio, "ohm", None, WireOhm(1e3, 9e3), force=True)
    assert "by far ends" in (by_far := _wires_in_words(of_far, calibrator))
    assert "; told: 1000, 9000: they disagree" in by_far
    told = wires[0] / 2, wires[1] / 2
    said = calibrate(recording, out, "ohm", WireOhm(*told))
    assert f"; told: {told[0]:g}, {told[1]:g}: they disagree" in said
    found = load_calibration(out).nominal_wire_ohm
    np.testing.assert_allclose(found.both, true, rtol=0.12, atol=30.0)


@pytest.mark.parametrize("method", ["voltage", "ohm", "matrix"])
def test_methods_without_wires_learn_the_same_curves(method: str, tmp_path: Path) -> None:
    pressed = PressedSkin(Plan((200.0, 400.0), "series", 3, shape=(2, 3), touches=1))
    recording, curves = tmp_path / "presses.mcap", []
    pressed.record(recording)
    for told in (WireOhm(), WireOhm(700.0, 100.0)):
        calibrate(recording, tmp_path / "skin.json", method, told)
        curves.append(load_calibration(tmp_path / "skin.json").model.slope)
    np.testing.assert_array_equal(*curves)
