# SPDX-License-Identifier: Apache-2.0
"""Forces on the command line: ``stream --calibration`` and ``tare``."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrations import half_doubtful, of_scene
from command_line import Run, assert_one_line, well
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import SkinReader
from recordings import write_recording
from stepped import stepped

GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"
REST = "emulator://8x8?seed=1"


@pytest.fixture
def skin(tmp_path: Path) -> Path:
    path = tmp_path / "skin.json"
    of_scene("ghost").save(path)
    return path


def test_stream_json_has_forces(run: Run, skin: Path) -> None:
    done = well(run("stream", GHOST, "--calibration", str(skin), "--scans", "3", "--json"))
    scans = [json.loads(line) for line in done.out.splitlines()]
    assert len(scans) == 3
    for scan in scans:
        assert scan["method"] == "touch"
        assert np.shape(scan["force_n"]) == np.shape(scan["force_n_std"]) == (8, 8)
        assert [contact["identity"] for contact in scan["contacts"]] == [1, 2, 3]
        first = scan["contacts"][0]
        assert first["force_n"] == scan["force_n"][2][2]
        assert (first["row"], first["column"]) == (2.0, 2.0)


def test_stream_shows_newtons_and_contacts(run: Run, skin: Path) -> None:
    done = well(run("stream", GHOST, "--calibration", str(skin), "--scans", "30"))
    assert "force by 'touch' [N]" in done.out
    assert re.search(r"contact 1: 1\.6\d \+- 0\.\d\d N at \(2\.0, 2\.0\)", done.out)
    assert "at (5.0, 2.0)" in done.out
    cells = done.out.partition("uncertain\n")[2].partition("contact")[0]
    assert "1.7" in cells
    assert "?" not in cells  # forces of untouched cells are known, too


def test_stream_says_which_forces_are_uncertain(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "doubtful.json"
    half_doubtful("ghost").save(path)
    arguments = ("stream", GHOST, "--calibration", str(path), "--scans")
    done = well(run(*arguments, "30"))
    assert "contact 1: uncertain at (2.0, 2.0)" in done.out
    assert re.search(r"contact 2: 1\.2\d \+- 0\.[12]\d N at \(2\.0, 5\.0\)", done.out)
    cells = done.out.partition("uncertain\n")[2].partition("contact")[0]
    assert cells.count("?") == cells.count(".") == 32
    scan = json.loads(well(run(*arguments, "1", "--json")).out)  # programs get numbers
    assert scan["contacts"][0]["force_n"] == scan["force_n"][2][2] > 1


def test_a_force_of_unknown_deviation_is_uncertain(
    run: Run, skin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = SkinReader.read
    unknown = {"force_n_std": np.full((8, 8), np.nan)}
    monkeypatch.setattr(SkinReader, "read", lambda self, scan: replace(read(self, scan), **unknown))
    done = well(run("stream", GHOST, "--calibration", str(skin), "--scans", "1"))
    assert done.out.partition("uncertain\n")[2].partition("contact")[0].count("?") == 64


def test_stream_tares(run: Run, skin: Path) -> None:
    arguments = ("stream", "--calibration", str(skin), "--tare", "0.1", "--scans", "20")
    assert "no contact" in run(*arguments, REST).out
    assert_one_line(run(*arguments, GHOST), "cells (2, 2), (2, 5), (5, 2) are touched")
    assert load_calibration(skin).tare is None


def test_a_picture_of_a_focus_knows_the_scans_before_it(tmp_path: Path, run: Run) -> None:
    """A picture a second, of several hundred scans: each was to be told apart from the one before,
    by a region that was chosen a second ago. Forces came out wrong, and were called certain."""
    of_scene("moving").save(tmp_path / "skin.json")
    url = "emulator://8x8?scene=moving&seed=1&begin=0&speed=0"
    words = ("--calibration", str(tmp_path / "skin.json"), "--focus", "--seconds", "6")
    said = well(run("stream", url, *words)).out
    assert "no resistances" not in said
    found = re.findall(
        r"contact (\d+): .* at \(([\d.]+), ([\d.]+)\)\ntruth: .* at \((.*), (.*)\)", said
    )
    assert len(found) > 4
    numbers = np.array(found, dtype=float)
    assert set(numbers[:, 0]) == {1.0}
    np.testing.assert_allclose(numbers[:, 1:3], numbers[:, 3:], atol=0.25)


def test_stream_without_a_calibration_can_be_told_rest(run: Run) -> None:
    stds = []
    for rest in ((), ("--tare", "0.2")):
        done = well(run("stream", f"{REST}&noise=2", "--scans", "20", "--json", *rest))
        lines = [json.loads(line) for line in done.out.splitlines()]
        stds.append(np.median([line["cell_siemens_std"] for line in lines]))
    assert stds[1] < 0.8 * stds[0]


NAMED = "'ohmskin configure PORT --unit-id 0 --save'"
SIZED = "'ohmskin configure PORT --rows 8 --columns 8 --save'"


def test_a_board_that_was_not_told_of_its_skin_is_told_how(run: Run, skin: Path) -> None:
    """'tare --force' was told to force it, and whoever forgot --save to calibrate again."""
    done = run("tare", "emulator://8x8?unit=5", str(skin), "--force")
    assert_one_line(done, "of unit 0, the board is unit 5: calibrate this skin", NAMED)
    done = run("tare", "emulator://6x8", str(skin))
    assert_one_line(done, "of a 8x8 skin, the board scans 6x8: calibrate this skin", SIZED)


def test_wrong_streams(run: Run, skin: Path) -> None:
    calibrated = ("--calibration", str(skin))
    for arguments, words in (
        ((GHOST, "--method", "joint", *calibrated), ["either --method or --calibration"]),
        (("emulator://8x8?unit=5", *calibrated), ["of unit 0, the board is unit 5", NAMED]),
        (("emulator://4x4", *calibrated, "--force"), ["of a 8x8 skin, the board scans 4x4"]),
        ((GHOST, "--method", "none", "--tare", "1"), ["leave out --method none"]),
        ((GHOST, "--calibration", "none.json"), ["none.json: cannot be read"]),
    ):
        assert_one_line(run("stream", "--scans", "1", *arguments), *words)
    well(run("stream", "--scans", "1", "emulator://8x8?unit=5", *calibrated, "--force"))


def test_tare_lasts_and_is_undone(run: Run, skin: Path) -> None:
    before = load_calibration(skin)
    lower = replace(before, rest=replace(before.rest, level=0.9 * before.rest.level))
    lower.save(skin)
    done = well(run("tare", REST, str(skin), "--seconds", "0.3"))
    words = r"skin\.json: tared, largest force before it 0\.00\d \+- 0\.\d{3} N"
    assert re.search(words, done.out)
    tared = load_calibration(skin).tare
    # The same skin as was calibrated.
    np.testing.assert_allclose(tared.level, before.rest.level, rtol=0.05, atol=5e-8)
    done = well(run("tare", REST, str(skin), "--undo"))
    assert load_calibration(skin).tare is None
    assert_one_line(run("tare", REST, str(skin), "--undo"), "there is no tare to undo")


def test_tare_is_refused_while_something_touches_the_skin(run: Run, skin: Path) -> None:
    before = skin.read_bytes()
    arguments = ("tare", GHOST, str(skin), "--seconds", "0.1")
    assert_one_line(run(*arguments), "cells (2, 2), (2, 5), (5, 2) are touched")
    assert skin.read_bytes() == before
    assert run(*arguments, "--force").code == 0
    assert load_calibration(skin).tare is not None


@pytest.mark.parametrize("command", ["stream", "record"])
def test_a_rest_with_touches_in_it_is_said(run: Run, tmp_path: Path, command: str) -> None:
    """It made the touched cells show too little, and nobody said so before the calibration."""
    of = ("--tare", "0.3", "--seconds", "0.5")

    def said(scene: str) -> str:
        out = [str(tmp_path / f"{scene}.mcap")] if command == "record" else []
        done = run(command, f"emulator://6x6?scene={scene}", *out, *of)
        assert done.code == 0
        return done.err

    touched = "cells (1, 1), (1, 4), (4, 1) are touched at rest: if something is on the skin"
    assert said("ghost&begin=0").startswith(touched)
    assert said("single&begin=9") == ""


def test_presses_in_a_mode_that_no_calibration_takes_are_said_at_once(
    run: Run, tmp_path: Path
) -> None:
    """Else a robot had pressed all cells before."""
    of = ("--force-port", "truth", "--tare", "0.1", "--seconds", "0.3")
    half, near = (
        well(run("record", f"emulator://3x3?scene=presses&mode={mode}&speed=0", str(out), *of)).out
        for mode, out in (("half", tmp_path / "half.mcap"), ("near", tmp_path / "near.mcap"))
    )
    assert "no calibration learns from this recording: a skin is calibrated in" in half
    assert "no calibration" not in near


def test_a_replay_ends_with_a_picture_of_its_last_scan(run: Run, tmp_path: Path) -> None:
    """As fast as it can, it showed the first scan alone."""
    out = tmp_path / "a.mcap"
    well(run("record", "emulator://4x4?speed=0", str(out), "--scans", "50"))
    for method in ("none", "ohm"):
        said = well(run("stream", f"replay://{out}?speed=0", "--method", method)).out
        assert re.findall(r"scan (\d+) ", said) == ["0", "49"]


def test_a_replay_of_no_scan_says_so(run: Run, tmp_path: Path) -> None:
    """It printed nothing, and ended as if all had been shown."""
    write_recording(tmp_path / "a.mcap", stepped("emulator://4x4").info, [])
    for more in ((), ("--json",)):
        done = run("stream", f"replay://{tmp_path / 'a.mcap'}", *more)
        assert_one_line(done, "a.mcap: no scan in it")
