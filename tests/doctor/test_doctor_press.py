# SPDX-License-Identifier: Apache-2.0
"""The doctor's look at a skin that is pressed: what it tells of the wires."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench_board import Bench
from command_line import Done, assert_one_line
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.cli import doctor as doctor_command
from ohmskin.doctor.examine import Examined, examine
from ohmskin.doctor.press import (
    CornerScans,
    PressedWires,
    all_of,
    moved_across,
    pressed_corners,
    pressed_findings,
    suggested_corners,
)
from ohmskin.emulate.scenes import Scene
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Scan
from places import DATA

NOMINAL = (100.0, 200.0)
EXACT_LSB = 12**-0.5
Run = Callable[..., Done]


def pressed(url: str) -> Examined:
    return replace(Bench(url).pressed(), wire_ohm=NOMINAL)


def taken(*ratios: Float) -> CornerScans:
    """Readings, in 10 bits, that a board without noise has sent."""
    rows, columns = ratios[0].shape[:2]
    scans = CornerScans(Bench(f"emulator://{rows}x{columns}").hello())
    for ratio in ratios:
        scans.take(Scan(quantise(ratio), 0, 0, 0.0, 0))
    return scans


def both_pressed(skin: Skin) -> list[Float]:
    """Readings of the suggested corners, and of those moved across, pressed with 5 kOhm."""
    corners = suggested_corners(*skin.shape)
    ratios = []
    for cells in (corners, moved_across(corners)):
        siemens = skin.cell_siemens.copy()
        siemens[tuple(np.transpose(cells))] += 2e-4
        ratios.append(readings(replace(skin, cell_siemens=siemens)))
    return ratios


# ------------------------------------------------------------------------------------- wires


@pytest.mark.parametrize("size", ["2x2", "2x5", "3x3", "4x4", "8x8", "12x4", "16x16"])
def test_wires_that_are_not_nominal_are_found(size: str) -> None:
    for seed, wires in enumerate((0.5, 0.67, 1.5, 2.0)):
        noise = 0.3 * (seed % 2)
        url = f"emulator://{size}?scene=corners&wires={wires}&seed={seed}&noise={noise}"
        diagnosis = examine(pressed(url))
        [finding] = diagnosis.findings
        assert (finding.id, finding.where) == ("wires", "rows and columns")
        share, std = (float(finding.measured.split()[at]) for at in (0, 2))
        assert share == pytest.approx(wires, rel=0.15)
        assert abs(share - wires) < 4 * std


@pytest.mark.parametrize("size", ["2x2", "2x5", "3x3", "8x8", "16x16"])
def test_nominal_wires_are_no_finding(size: str) -> None:
    for seed in range(3):
        diagnosis = examine(pressed(f"emulator://{size}?scene=corners&seed={seed}"))
        assert diagnosis.findings == ()
        assert "times nominal" in diagnosis.measured["wires"]
        assert len(diagnosis.measured["wires_of_lines"]) == 2
        assert diagnosis.verdict == "sound: nothing is wrong"


@pytest.mark.parametrize("told", [0.5, 1.0, 2.0])
def test_wires_of_circuits_solved_by_ngspice(told: float) -> None:
    """Cells of 1 kOhm behind segments of 100, 500 and 1000 ohm, against `told` times as much."""
    random = np.random.default_rng(1)
    with np.load(DATA / "wire_sweep_3x3.npz") as reference:
        ratios, rests = reference["ratio"][:3], reference["rest_ratio"][:3]
        wire_ohm = reference["top_wire_ohm"][:3, 0, 0]
    for ratio, rest, ohm in zip(ratios, rests, wire_ohm, strict=True):
        of_rest, of_press = (
            exact + 0.3 / 1024 * random.standard_normal((90, 3, 3, 4)) for exact in (rest, ratio)
        )
        codes = quantise(of_rest).mean(axis=0)
        [wires] = taken(*of_press).measure(codes, 90, 0.42, (told * ohm, told * ohm))
        assert wires.where == "row 0, column 0"
        assert wires.log_share == pytest.approx(-np.log(told), abs=0.1)
        assert abs(wires.log_share + np.log(told)) < 2 * wires.log_std < 0.25


def test_what_a_finger_presses_beside_does_not_disturb() -> None:
    skin = Scene("rest", 8, 8, seed=1).skin(0.0)
    corners = suggested_corners(8, 8)
    ratios = []
    for cells in (corners, moved_across(corners)):
        siemens = skin.cell_siemens.copy()
        for row, column in cells:
            siemens[row - 1 : row + 2, column - 1 : column + 2] += 3e-5
            siemens[row, column] += 2e-4
        ratios.append(readings(replace(skin, cell_siemens=siemens)))
    rest = quantise(readings(skin)).astype(np.float64)
    wires = all_of(taken(*ratios).measure(rest, 1, EXACT_LSB, NOMINAL))
    assert abs(wires.log_share) < 3 * wires.log_std < 0.3


@pytest.mark.parametrize(
    ("layer", "where"), [("top", "row 4, column 4"), ("bottom", "row 7, column 7")]
)
def test_one_line_that_is_worn_is_named(layer: str, where: str) -> None:
    """Row 4 shares its wire in the first corners, column 7 in those moved across."""
    skin = Scene("rest", 8, 8, seed=2).skin(0.0)
    top, bottom = skin.top_wire_ohm.copy(), skin.bottom_wire_ohm.copy()
    top[4] *= 4 if layer == "top" else 1
    bottom[:, 7] *= 4 if layer == "bottom" else 1
    worn = replace(skin, top_wire_ohm=top, bottom_wire_ohm=bottom)
    rest = quantise(readings(worn)).astype(np.float64)
    seen = taken(*both_pressed(worn)).measure(rest, 1, EXACT_LSB, NOMINAL)
    assert [each.where for each in seen] == ["row 4, column 4", "row 7, column 7"]
    [finding] = pressed_findings(seen, NOMINAL)
    assert finding.where == where


def test_presses_that_tell_nothing_are_said_to() -> None:
    """Fingers as wide as the rectangle: every cell may be pressed."""
    skin = Scene("rest", 3, 3).skin(0.0)
    siemens = skin.cell_siemens + 4e-5
    for cell in suggested_corners(3, 3):
        siemens[cell] += 2e-4
    rest = quantise(readings(skin)).astype(np.float64)
    ratio = readings(replace(skin, cell_siemens=siemens))
    [wires] = taken(ratio).measure(rest, 1, EXACT_LSB, NOMINAL)
    assert not wires.differ
    assert wires.in_words(NOMINAL).startswith("not known: press with something smaller")
    nothing = taken(readings(skin))
    assert nothing.pressed == ()
    assert nothing.measure(rest, 1, EXACT_LSB, NOMINAL) == []


def test_what_is_hardly_known_is_no_finding() -> None:
    """However far it seems to be off."""
    assert PressedWires("row 1, column 1", 0.9, 0.1).differ
    vague = PressedWires("row 1, column 1", 0.9, 0.2)
    assert pressed_findings([vague], NOMINAL) == []
    assert vague.in_words(NOMINAL).startswith("not known")


def test_what_is_pressed_in_passing_is_left_out() -> None:
    skin = Scene("rest", 8, 8).skin(0.0)
    held, passing = both_pressed(skin)
    scans = taken(*[held] * 5, passing)
    other = readings(Scene("rest", 4, 4).skin(0.0))  # of a board that was reset
    assert scans.take(Scan(quantise(other), 0, 0, 0.0, 0)) is None
    assert scans.scans(moved_across(suggested_corners(8, 8))) == 1
    rest = quantise(readings(skin)).astype(np.float64)
    [wires] = scans.measure(rest, 1, EXACT_LSB, NOMINAL)
    assert wires.where == "row 4, column 4"


def test_without_nominal_wires_none_are_expected() -> None:
    read = replace(pressed("emulator://4x4?scene=corners&wires=2"), wire_ohm=None)
    diagnosis = examine(read)
    assert diagnosis.findings == ()
    assert diagnosis.measured["wires"].startswith(("1.9", "2.0", "2.1"))
    read = replace(read, presses=CornerScans(read.board))
    assert examine(read).measured["wires"].startswith("not known: no three corners")


# ----------------------------------------------------------------------------------- corners


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
    with pytest.raises(ValueError, match="1x8 skin cannot be measured"):
        suggested_corners(1, 8)


# ------------------------------------------------------------------------------ command line


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_command, "REST_S", 0.2)
    monkeypatch.setattr(doctor_command, "SETTLED_S", 0.05)
    monkeypatch.setattr(doctor_command, "PRESS_S", 0.1)


def test_wires_are_found_in_time(run: Run) -> None:
    begin_s = time.monotonic()
    url = "emulator://8x8?scene=corners&wires=1.5"
    done = run("doctor", url, "--wires", "100,200", "--press")
    assert time.monotonic() - begin_s < 10
    assert done.code == 1
    assert "1. warning, wires: rows and columns" in done.out
    first, second = done.err.splitlines()
    assert first == "press firmly, at once: (4, 4) (4, 7) (7, 4)"
    assert second == "now (2, 5) (5, 2) (5, 5)"


@pytest.mark.usefixtures("hasty")
def test_nobody_presses(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_command, "WAIT_S", 0.3)
    answer = json.loads(run("doctor", "emulator://2x3", "--press", "--json").out)
    assert answer["sound"] is True
    assert answer["measured"]["wires"] == "not known: no three corners of a rectangle were pressed"


@pytest.mark.usefixtures("hasty")
def test_a_skin_without_rectangle_is_not_asked_for_one(run: Run) -> None:
    assert_one_line(run("doctor", "emulator://1x4", "--press"), "1x4", "no rectangle")


@pytest.mark.usefixtures("hasty")
def test_a_terminal_shows_what_is_pressed() -> None:
    said: list[str] = []
    doctor_command.diagnose("emulator://4x4?scene=corners", ask=said.append)
    first = "press firmly, at once: (1, 1) (1, 3) (3, 1)"
    assert list(dict.fromkeys(said)) == [
        f"{first}; pressed: nothing",
        f"{first}; hold still",
        "now (1, 2) (2, 1) (2, 2); pressed: (1, 1) (1, 2) (2, 1)",
        "now (1, 2) (2, 1) (2, 2); hold still",
    ]
