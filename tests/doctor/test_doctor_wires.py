# SPDX-License-Identifier: Apache-2.0
"""What the doctor tells of the wires, from pressed corners."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from desk import examined
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.cli.doctor_words import measured_in_words, named, verdict, words_of
from ohmskin.doctor.examine import Evidence, examine
from ohmskin.doctor.findings import Diagnosis, Kind, Place
from ohmskin.doctor.signal import Rest
from ohmskin.doctor.wires import (
    CornerScans,
    moved_across,
    pressed_corners,
    shares_of,
    suggested_corners,
)
from ohmskin.emulate.scenes import LEAD_OHM, Scene
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Scan
from places import DATA
from stepped import evidence, stepped

NOMINAL = (100.0, 200.0)
TOLD = WireOhm(*NOMINAL, lead=LEAD_OHM)
EXACT_LSB = 12**-0.5
HELD = 30  # scans for which corners are held here


def taken(*ratios: Float) -> CornerScans:
    """Readings, in 10 bits, that a board without noise has sent."""
    rows, columns = ratios[0].shape[:2]
    scans = CornerScans(stepped(f"emulator://{rows}x{columns}").info)
    for ratio in ratios:
        scans.take(Scan(quantise(ratio), 0, 0, 0.0, 0))
    return scans


def worn(size: str, times: float, seed: int) -> Skin:
    """A skin at rest whose wires have so many times the nominal resistance."""
    skin = Scene("rest", *map(int, size.split("x")), seed=seed).skin(0.0)
    top, bottom = times * skin.top_wire_ohm, times * skin.bottom_wire_ohm
    return replace(skin, top_wire_ohm=top, bottom_wire_ohm=bottom)


def both_pressed(skin: Skin, beside: float = 0.0, time: float = 0.0) -> list[Float]:
    """Readings of the suggested corners, and of those moved across, pressed with about 5 kOhm.

    beside: conductance [S] that the same fingers give to the cells around. time: of the hand's
    trembling, 0 to 1.
    """
    corners = suggested_corners(*skin.shape)
    ratios = []
    for cells in (corners, moved_across(corners)):
        siemens = skin.cell_siemens.copy()
        for finger, (row, column) in enumerate(cells):
            if beside:
                siemens[row - 1 : row + 2, column - 1 : column + 2] += beside
            siemens[row, column] += 2e-4 * (1 + 0.05 * np.sin(2 * np.pi * (3 + finger) * time))
        ratios.append(readings(replace(skin, cell_siemens=siemens)))
    return ratios


@cache
def sound(rows: int, columns: int) -> Evidence:
    return evidence(f"emulator://{rows}x{columns}", told=TOLD, settled=None)


def read_of(
    skin: Skin, noise_lsb: float = 0.0, seed: int = 0, own_lead_ohm: Float | None = None
) -> Evidence:
    """What a sound board with this noise reads of a skin, untouched and then pressed.

    own_lead_ohm: what is told of single leads.
    """
    random = np.random.default_rng(seed)
    read = sound(*skin.shape)

    def codes(ratio: Float) -> Float:
        return quantise(ratio + noise_lsb / 1024 * random.standard_normal(ratio.shape))

    rest = readings(skin)
    presses = CornerScans(read.board, own_lead_ohm)
    for time in np.linspace(0, 1, HELD):
        for ratio in both_pressed(skin, time=time):
            presses.take(Scan(codes(ratio), 0, 0, 0.0, 0))
    scans = [replace(scan, codes=codes(rest)) for scan in read.scans]
    return replace(read, scans=scans, presses=presses)


def rest_of(skin: Skin) -> Rest:
    """Of one scan without noise."""
    board, codes = sound(*skin.shape).board, quantise(readings(skin)).astype(np.float64)
    return Rest(board, codes, 1, EXACT_LSB, told=TOLD)


@pytest.mark.parametrize("size", ["2x2", "2x5", "3x3", "4x4", "8x8", "12x4", "16x16"])
def test_wires_that_are_not_nominal_are_found(size: str) -> None:
    for seed, times in enumerate((0.5, 0.67, 1.5, 2.0) if size != "16x16" else (1.5,)):
        [finding] = examine(read_of(worn(size, times, seed), 0.3 * (seed % 2), seed)).findings
        assert finding.kind is Kind.WIRES
        words, share = words_of(finding), finding.values["share"]
        assert words["where"] == "rows and columns"
        assert words["measured"].startswith(f"{share.share:.2f} +- {share.std:.2f} times nominal")
        assert words["expected"] == "top 100, bottom 200 ohm a segment"
        assert share.share == pytest.approx(times, rel=0.15)
        assert abs(share.share - times) < 4 * share.std


@pytest.mark.parametrize("size", ["2x2", "2x5", "3x3", "8x8", "16x16"])
def test_nominal_wires_are_no_finding(size: str) -> None:
    for seed in range(3 if size != "16x16" else 1):
        diagnosis = examine(read_of(worn(size, 1.0, seed), 0.3, seed))
        assert diagnosis.findings == []
        said = measured_in_words(diagnosis)
        assert "times nominal" in said["wires"]
        assert len(said["wires_of_lines"]) == 2
        assert verdict(diagnosis).startswith("sound: nothing is wrong")


def test_a_lead_that_a_calibration_knows_is_no_finding() -> None:
    """2 kohm more at the last column, beside two corners. Who does not know them is told so."""
    own_ohm = np.zeros(16)
    own_ohm[15] = 2000.0
    skin = worn("8x8", 1.0, 0)
    skin = replace(skin, lead_ohm=skin.lead_ohm + own_ohm)
    [finding] = examine(read_of(skin, 0.3)).findings
    assert finding.kind is Kind.WIRES
    assert finding.place.columns == (15 - 8,)
    assert examine(read_of(skin, 0.3, own_lead_ohm=own_ohm)).findings == []


@pytest.mark.parametrize("told", [0.5, 1.0, 2.0])
def test_wires_of_circuits_solved_by_ngspice(told: float) -> None:
    """Cells of 1 kOhm behind segments of 100, 500 and 1000 ohm, against `told` times as much."""
    random = np.random.default_rng(1)
    with np.load(DATA / "wire_sweep_3x3.npz") as reference:
        ratios, rests = reference["ratio"][:3], reference["rest_ratio"][:3]
        wire_ohm = reference["top_wire_ohm"][:3, 0, 0]
    for ratio, untouched, ohm in zip(ratios, rests, wire_ohm, strict=True):
        of_rest, of_press = (
            exact + 0.3 / 1024 * random.standard_normal((90, 3, 3, 4))
            for exact in (untouched, ratio)
        )
        nominal = WireOhm(told * ohm, told * ohm, lead=0.0)
        rest = Rest(sound(3, 3).board, quantise(of_rest).mean(axis=0), 90, 0.42, told=nominal)
        _, wires = taken(*of_press).measure(rest)
        assert wires.place == Place(rows=(0,), columns=(0,))
        off = np.log(wires.share * told)
        assert off == pytest.approx(0, abs=0.1)
        assert abs(off) < 2 * wires.std / wires.share < 0.25


def test_what_a_finger_presses_beside_does_not_disturb() -> None:
    skin = worn("8x8", 1.0, seed=1)
    wires = taken(*both_pressed(skin, 3e-5)).measure(rest_of(skin))[0]
    assert abs(np.log(wires.share)) < 3 * wires.std / wires.share < 0.3


@pytest.mark.parametrize(
    ("layer", "where"), [("top", "row 4, column 4"), ("bottom", "row 7, column 7")]
)
def test_one_line_that_is_worn_is_named(layer: str, where: str) -> None:
    """Row 4 shares its wire in the first corners, column 7 in those moved across."""
    skin = worn("8x8", 1.0, seed=2)
    top, bottom = skin.top_wire_ohm.copy(), skin.bottom_wire_ohm.copy()
    top[4] *= 4 if layer == "top" else 1
    bottom[:, 7] *= 4 if layer == "bottom" else 1
    skin = replace(skin, top_wire_ohm=top, bottom_wire_ohm=bottom)
    _, *each = taken(*both_pressed(skin)).measure(rest_of(skin))
    assert [named(share.place) for share in each] == ["row 4, column 4", "row 7, column 7"]
    [finding] = examine(read_of(skin)).findings
    assert words_of(finding)["where"] == where


def test_presses_that_tell_nothing_are_said_to() -> None:
    """Fingers as wide as the rectangle: every cell may be pressed."""
    skin = worn("3x3", 1.0, seed=0)
    siemens = skin.cell_siemens + 4e-5
    for cell in suggested_corners(3, 3):
        siemens[cell] += 2e-4
    scans = taken(readings(replace(skin, cell_siemens=siemens)))
    shares = scans.measure(rest_of(skin))
    assert not any(each.differs or each.known for each in shares)
    said = measured_in_words(Diagnosis(nominal_ohm=NOMINAL, pressed=shares))
    assert said["wires"].startswith("not known: tell --leads, or press with what is smaller")
    asked = Diagnosis(nominal_ohm=NOMINAL, pressed=shares)
    assert not asked.sound
    assert verdict(asked).endswith("these presses do not show the wires: see 'wires'")
    nothing = taken(readings(skin))
    assert nothing.pressed == ()
    assert nothing.measure(rest_of(skin)) == []


def test_nominal_wires_that_nobody_has_told_are_said_to_be_none() -> None:
    [whole] = shares_of([((1, 1), 0.9, 0.05)])[:1]
    for is_told in (True, False):
        shown = Diagnosis(nominal_ohm=NOMINAL, is_told=is_told, pressed=[whole])
        assert ("say --wires" in measured_in_words(shown)["wires"]) is not is_told
        assert shown.sound


@pytest.mark.parametrize(
    ("lead_ohm", "std_ohm", "taken"),
    [(46.0, 125.0, (100.0, 40.0)), (967.0, 148.0, (967.0, 148.0)), (80.0, 10.0, (80.0, 10.0))],
)
def test_a_lead_that_presses_hardly_tell_is_that_of_a_switch(
    lead_ohm: float, std_ohm: float, taken: tuple[float, float]
) -> None:
    rest = rest_of(worn("3x3", 1.0, seed=0))
    assert replace(rest, told=WireOhm(lead=lead_ohm, lead_std_ohm=std_ohm)).lead_ohm == taken


def test_what_is_hardly_known_is_no_finding() -> None:
    """However far it seems to be off."""
    clear, vague = (shares_of([((1, 1), 0.9, std)]) for std in (0.1, 0.2))
    assert [each.differs for each in clear] == [True, False]  # together, and so not again
    assert not any(each.differs or each.known for each in vague)


def test_what_is_pressed_in_passing_is_left_out() -> None:
    skin = worn("8x8", 1.0, seed=0)
    held, passing = both_pressed(skin)
    scans = taken(*[held] * 5, passing)
    other = readings(worn("4x4", 1.0, seed=0))  # of a board that was reset
    scans.take(Scan(quantise(other), 0, 0, 0.0, 0))
    _, *each = scans.measure(rest_of(skin))
    assert [named(share.place) for share in each] == ["row 4, column 4"]


def test_without_nominal_wires_none_are_expected() -> None:
    read = replace(read_of(worn("4x4", 2.0, seed=0)), told=NO_WIRES)
    diagnosis = examine(read)
    assert diagnosis.findings == []
    assert measured_in_words(diagnosis)["wires"].startswith(("1.9", "2.0", "2.1"))
    diagnosis = examine(replace(read, presses=CornerScans(read.board)))
    assert measured_in_words(diagnosis)["wires"].startswith("not known: no three corners")


def test_three_corners_are_told_from_other_touches() -> None:
    siemens = np.full((4, 5), 1e-6)
    assert pressed_corners(siemens) is None
    for cell in ((1, 4), (3, 0), (1, 0)):
        siemens[cell] = 1e-4
    assert pressed_corners(siemens) == ((1, 0), (1, 4), (3, 0))
    siemens[0, 2] = 6e-5
    assert pressed_corners(siemens) is None  # a fourth
    siemens[0, 2] = siemens[1, 0] = 1e-6
    siemens[2, 1] = 1e-4
    assert pressed_corners(siemens) is None  # no rectangle
    assert pressed_corners(np.full((1, 2), 1e-4)) is None


def test_corners_that_are_asked_for() -> None:
    for rows in range(2, 33):
        for columns in (2, 3, 8, 32):
            corner, beside, below = suggested_corners(rows, columns)
            assert corner[0] == beside[0] < below[0] == rows - 1
            assert corner[1] == below[1] < beside[1] == columns - 1
            assert moved_across((corner, beside, below)) == ((rows - 1, columns - 1), below, beside)
    with pytest.raises(ValueError, match="1x8 skin has no rectangle"):
        suggested_corners(1, 8)


@pytest.mark.simavr
def test_wires_on_a_board_as_on_a_desk() -> None:
    """There, lines that float move readings by 30 LSB: the doctor sees the wires all the same."""
    off = []
    for seed in range(3):
        diagnosis = examined(seed, NOMINAL)
        assert diagnosis.findings == []
        assert diagnosis.pressed is not None
        whole = diagnosis.pressed[0]
        assert whole.std < 0.05
        off.append(whole.share - 1)
    assert np.abs(off).max() < 0.08
    assert np.mean(off) == pytest.approx(0, abs=0.05)
