# SPDX-License-Identifier: Apache-2.0
"""``ohmskin skin``."""

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from calibrations import of_scene
from command_line import Run, assert_one_line, well
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import load_calibration


@pytest.fixture
def file(tmp_path: Path) -> Path:
    of_scene("rest").save(tmp_path / "skin.json")
    return tmp_path / "skin.json"


def test_it_says_and_changes_where_cells_are(file: Path, run: Run) -> None:
    assert "nobody has said where the cells are" in well(run("skin", str(file))).out
    said = well(run("skin", str(file), "--pitch-mm", "10,20")).out
    assert "flat, in 'skin': from (0.0, 0.0, 0.0) to (70.0, 140.0, 0.0) mm" in said
    assert said == well(run("skin", str(file))).out  # it is kept
    well(run("skin", str(file), "--pitch-mm", "10,10", "--radius-mm", "40", "--frame", "arm"))
    known = load_calibration(file).geometry
    assert (known.kind, known.frame_id) == ("cylinder", "arm")
    assert np.hypot(*known.position_m[..., [0, 2]].T) == pytest.approx(0.04)
    well(run("skin", str(file), "--frame", "wrist"))
    assert load_calibration(file).geometry.frame_id == "wrist"


def test_stream_says_where_contacts_are(file: Path, run: Run) -> None:
    words = ("stream", "emulator://8x8?scene=ghost&begin=0", "--calibration", str(file), "--json")
    line = json.loads(well(run(*words, "--scans", "1")).out)
    assert not {"net_force_n", "net_torque_nm"} & set(line)
    assert not {"position_m", "normal"} & set(line["contacts"][0])
    well(run("skin", str(file), "--pitch-mm", "10,20"))
    line = json.loads(well(run(*words, "--scans", "1")).out)
    found = [contact["position_m"] for contact in line["contacts"]]
    expected = [[0.01 * each["column"], 0.02 * each["row"], 0.0] for each in line["contacts"]]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert {tuple(each["normal"]) for each in line["contacts"]} == {(0.0, 0.0, 1.0)}
    of_contacts = sum(each["force_n"] for each in line["contacts"])
    assert line["net_force_n"][2] == pytest.approx(-of_contacts, rel=0.1)
    assert np.shape(line["net_torque_nm"]) == (3,)


def test_it_says_what_is_known_of_the_wires(file: Path, run: Run) -> None:
    for wires, words in (
        (WireOhm(), "wires of ? (top) and ? (bottom) ohm a segment, leads of ? ohm"),
        (WireOhm(100.0, 200.0, 80.0), "wires of 100 (top) and 200 (bottom) ohm a segment"),
        (
            WireOhm(100.0, 200.0, 80.0, 0.1, 0.02, 30.0),
            "wires of 100 +- 10 (top) and 200 +- 4 (bottom) ohm a segment, leads of 80 +- 30 ohm",
        ),
        (WireOhm(100.0, 200.0, 10.0, 0.1, 0.02, 900.0), "leads of up to 1810 ohm"),
    ):
        replace(load_calibration(file), nominal_wire_ohm=wires).save(file)
        assert words in " ".join(well(run("skin", str(file))).out.split())


def test_it_draws_every_cell(file: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "skin.svg"
    well(run("skin", str(file), "--pitch-mm", "10,10", "--picture", str(out)))
    assert ElementTree.parse(out).getroot().tag.endswith("svg")
    # matplotlib draws letters as curves, and says in a comment which text they are.
    texts = re.findall(r"<!-- (\d,\d) -->", out.read_text())
    assert sorted(texts) == [f"{row},{column}" for row in range(8) for column in range(8)]


def test_it_takes_a_file_of_taxels(file: Path, run: Run, tmp_path: Path) -> None:
    taxels = tmp_path / "taxels.txt"
    taxels.write_text("\n".join(f"{k / 100} 0 0 0 0 1" for k in range(64)))
    well(run("skin", str(file), "--taxels", str(taxels)))
    assert load_calibration(file).geometry.position_m[1, 0, 0] == pytest.approx(0.08)


@pytest.mark.parametrize("pitch", ["10", "a,b", "1,2,3", ".,1", "1.2.3,1"])
def test_a_pitch_is_two_numbers(file: Path, run: Run, pitch: str) -> None:
    done = run("skin", str(file), "--pitch-mm", pitch)
    assert (done.code, done.out) == (2, "")
    assert "--pitch-mm wants two numbers" in done.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frame", "palm"), "nobody has said where the cells are: say --pitch-mm"),
        (("--picture", "p.svg"), "nobody has said where the cells are: say --pitch-mm"),
        (("--pitch-mm", "10,10", "--picture", "/no/such/p.svg"), "/no/such/p.svg: cannot"),
        (("--pitch-mm", "10,10", "--picture", "p.txt"), "p.txt: no picture ends in '.txt': say"),
        (("--pitch-mm", "0,10"), "--pitch-mm wants two numbers above 0, as 10,10, not '0,10'"),
        (("--pitch-mm", "-1,10"), "--pitch-mm wants two numbers above 0, as 10,10, not '-1,10'"),
        (("--pitch-mm", "10,10", "--radius-mm", "5"), "8 columns of 0.01 m go round more than"),
        (("--radius-mm", "50"), "--radius-mm needs --pitch-mm, too"),
        (("--pitch-mm", "10,10", "--taxels", "taxels.txt"), "either --taxels, or --pitch-mm"),
    ],
)
def test_what_cannot_be_done_is_refused_and_the_file_is_as_it_was(
    file: Path, run: Run, options: tuple[str, ...], words: str
) -> None:
    before = file.read_bytes()
    assert_one_line(run("skin", str(file), *options), words)
    assert file.read_bytes() == before
