# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate`` from recordings and tables: what is found, and what is refused."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from command_line import Done, Run, assert_one_line, well
from ohmskin.arrays import Float
from ohmskin.cli.board import TERMINAL
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Scene
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import SkinReader
from ohmskin.record.recording import ForceSample, Tare, load_recording
from recordings import (
    HOST_BEGIN_S,
    PRESSES,
    SENSOR_ZERO_N,
    record_presses,
    sensor_log,
    write_log,
    write_recording,
)

SECONDS = 44.0  # two cells of six presses
SENSOR_BEGIN_S = 70_000.0
TOLD = ("--indenter-mm2", "80", "--wires", f"{TOP_WIRE_OHM},{BOTTOM_WIRE_OHM}")
BY_OHM = ("--rest", "1.5", "--method", "ohm")  # the fastest


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with presses.mcap and forces.csv."""
    folder = tmp_path_factory.mktemp("presses")
    record_presses(folder / "presses.mcap", SECONDS)
    times_s, force_n = sensor_log(SECONDS)
    write_log(folder / "forces.csv", times_s + SENSOR_BEGIN_S, force_n)
    return folder


@pytest.fixture
def presses(made: Path, tmp_path: Path) -> tuple[Path, Path, Path]:
    """Paths of a recording, of a force log, and of the calibration to be written."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "presses.mcap", tmp_path / "forces.csv", tmp_path / "skin.json"


def calibrate(run: Run, presses: tuple[Path, Path, Path], *more: str) -> Done:
    recording, forces, out = presses
    return run(
        *("calibrate", "recording", str(recording), str(out), "--forces", str(forces)),
        *TOLD,
        *(more or ("--rest", "1.5")),
    )


def test_a_recording_and_its_forces_make_a_calibration(
    run: Run, presses: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    recording, _, out = presses
    done = well(calibrate(run, presses))
    offset_s = float(done.out.partition("offset of the clocks ")[2].partition(" s")[0])
    # Creep and the sensor's rate leave some hundredths.
    assert offset_s == pytest.approx(HOST_BEGIN_S - SENSOR_BEGIN_S, abs=0.05)
    zero_n = float(done.out.partition("zero of the force sensor ")[2].partition(" N")[0])
    assert zero_n == pytest.approx(SENSOR_ZERO_N, abs=0.02)
    found = load_calibration(out)
    assert (found.unit_id, found.method) == (3, "joint")
    assert found.indenter_area_m2 == pytest.approx(80e-6)
    assert found.nominal_wire_ohm.both == pytest.approx((100.0, 200.0), rel=0.3)
    assert "ohm a segment by 12 presses, " in done.out
    assert not found.model.pooled.any()
    rest_siemens = PRESSES.skin(0.0).cell_siemens
    np.testing.assert_allclose(found.rest.level, rest_siemens, rtol=0.1)
    np.testing.assert_allclose(found.rest.ratio, PRESSES.rest_ratio, atol=1e-3)

    # What the calibration makes of the same skin, against what pressed it.
    given = load_recording(recording)
    reader = SkinReader(given.hellos[0], found)
    scans = [reader.read(scan) for scan in given.scans[::3]]
    true_n = np.array([PRESSES.force_n(1e-6 * scan.time_us) for scan in scans])
    force_n = np.array([scan.force_n for scan in scans])
    pressed = true_n > 0.3
    assert np.sqrt(np.mean((force_n - true_n)[pressed] ** 2)) < 0.15 * true_n.max()
    assert np.abs(force_n[~pressed & (true_n == 0)]).max() < 0.3
    held_out_n = np.sqrt(np.mean(found.model.held_out_rmse**2))
    assert 0.05 < held_out_n < 1.0
    assert done.out.count("(6)") == 2  # six presses of each cell

    # The recording can hold the forces itself.
    both = tmp_path / "both.mcap"
    samples = [
        ForceSample(float(force), HOST_BEGIN_S + float(time_s), source="cell")
        for time_s, force in zip(*sensor_log(SECONDS), strict=True)
    ]
    write_recording(both, given.hellos[0], [*given.scans, *samples])
    slopes = []
    for command in (
        lambda: run("calibrate", "recording", str(both), str(out), *TOLD, *BY_OHM),
        lambda: calibrate(run, presses, *BY_OHM),
    ):
        done = well(command())
        slopes.append(load_calibration(out).model.slope)
    np.testing.assert_allclose(*slopes, rtol=0.02)


def test_the_lead_that_was_told_is_said(run: Run, presses: tuple[Path, Path, Path]) -> None:
    """Presses never doubt it, so one that was told in kilohm was kept in silence."""
    done = well(calibrate(run, presses, "--rest", "1.5", "--leads", "0.08"))
    assert "; leads of 0.08 ohm, as told\n" in done.out


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_presses_that_far_ends_have_read(
    run: Run, presses: tuple[Path, Path, Path], method: str
) -> None:
    """Forces of a replay against what pressed the skin. Nothing is told of the wires."""
    (_, forces, out), recording = presses, presses[0].with_name("far.mcap")
    record_presses(recording, SECONDS, "far")
    told = ("--forces", str(forces), "--indenter-mm2", "80", "--rest", "1.5")
    well(run("calibrate", "recording", str(recording), str(out), *told, "--method", method))
    found = load_calibration(out)
    assert (found.mode, found.method) == ("far", method)
    assert not found.model.pooled.any()
    with ohmskin.open(f"replay://{recording}?speed=0", calibration=out) as skin:
        scans = list(islice(skin, 1200))
    true_n = np.array([PRESSES.force_n(1e-6 * scan.time_us) for scan in scans])
    force_n = np.array([scan.force_n for scan in scans])
    pressed = true_n > 0.3
    assert pressed.sum() > 100
    assert np.sqrt(np.mean((force_n - true_n)[pressed] ** 2)) < 0.15 * true_n.max()
    assert np.abs(force_n[~pressed & (true_n == 0)]).max() < 0.3


def test_shorted_lines_are_suspected_where_two_cells_seem_pressed(run: Run, tmp_path: Path) -> None:
    """Half of the skin got no curve of its own, and nothing said why."""
    recording, out = str(tmp_path / "a.mcap"), str(tmp_path / "skin.json")
    url = "emulator://3x3?scene=presses&rate=20&speed=0&short_rows=1,2"
    well(run("record", url, recording, "--force-port", "truth", "--seconds", "40"))
    said = well(run("calibrate", "recording", recording, out, "--indenter-mm2", "80")).out
    assert "two cells were pressed; if nobody did so, lines may be shorted: ohmskin doctor" in said


def test_other_methods_refuse_what_far_ends_have_read(
    run: Run, presses: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    (_, forces, out), recording = presses, tmp_path / "far.mcap"
    readings, answers = tmp_path / "readings.npz", tmp_path / "answers.npz"
    record_presses(recording, 5.0, "far")
    told = ("--forces", str(forces), "--indenter-mm2", "80", "--rest", "1.5")
    well(run("export", str(recording), str(readings)))
    for method in ("ohm", "matrix", "lsq", "regularized", "voltage"):
        words = f"'{method}' takes the readings a b c d, not a e b f: use 'joint' or 'touch', or"
        asked = ("--method", method)
        assert_one_line(
            run("calibrate", "recording", str(recording), str(out), *told, *asked), words
        )
        if method != "voltage":
            assert_one_line(run("stream", f"replay://{recording}", *asked), words)
            assert_one_line(run("estimate", str(readings), *asked, "--out", str(answers)), words)
    assert not out.exists()
    assert not answers.exists()


def test_presses_read_in_two_modes_are_refused(
    run: Run, presses: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    given = load_recording(presses[0])
    hello, half = given.hellos[0], len(given.scans) // 2
    far = [replace(scan, mode="far") for scan in given.scans]
    for name, first, messages in (
        ("first", hello, [*given.scans[:half], replace(hello, mode="far"), *far[half:]]),
        ("later", replace(hello, mode="far"), [*far[:half], hello, *given.scans[half:]]),
        ("hello", hello, far),
    ):
        path = tmp_path / f"{name}.mcap"
        write_recording(path, first, messages)
        words = f"{name}.mcap: modes near and far are mixed in it: record the presses in one mode"
        assert_one_line(calibrate(run, (path, *presses[1:])), words)
        assert not presses[2].exists()


@pytest.mark.parametrize("method", ["voltage", "touch"])
def test_other_methods(run: Run, presses: tuple[Path, Path, Path], method: str) -> None:
    well(calibrate(run, presses, "--rest", "1.5", "--method", method))
    assert load_calibration(presses[2]).method == method


def edited(path: Path, edit: Callable[[Float, Float], tuple[Float, Float]]) -> None:
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    write_log(path, *edit(table[:, 0], table[:, 1]))


def test_bad_force_logs(run: Run, presses: tuple[Path, Path, Path]) -> None:
    _, forces, out = presses
    good = forces.read_text()
    random = np.random.default_rng(1)
    for edit, words in (
        (lambda t, f: (t, -f), ["forces.csv", "turn the sign"]),
        (lambda t, f: (t, np.full(f.size, 2.0)), ["forces.csv", "force_n is 2 throughout"]),
        (lambda t, f: (t[:5], f[:5]), ["forces.csv", "too few samples: 5"]),
        (lambda t, f: (t, random.permutation(f)), ["presses.mcap", "fit at no offset"]),
        (lambda t, f: (1e3 * t, f), ["presses.mcap"]),
    ):
        forces.write_text(good)
        edited(forces, edit)
        assert_one_line(calibrate(run, presses, *BY_OHM), *words)
        assert not out.exists()
    lines = good.splitlines()
    forces.write_text("\n".join([*lines[:40], "70000.5,", *lines[41:]]))
    assert_one_line(calibrate(run, presses), "forces.csv", "row 41")
    assert not out.exists()


def test_a_gap_in_the_log_costs_its_presses_alone(
    run: Run, presses: tuple[Path, Path, Path]
) -> None:
    def with_gap(t: Float, f: Float) -> tuple[Float, Float]:
        kept = (t < SENSOR_BEGIN_S + 8) | (t > SENSOR_BEGIN_S + 12)
        return t[kept], f[kept]

    edited(presses[1], with_gap)
    done = well(calibrate(run, presses, *BY_OHM))
    assert "held-out error [N], of so many presses" in done.out
    assert load_calibration(presses[2]).model.pooled.sum() <= 1


def test_in_a_narrow_terminal_held_out_errors_are_hundredths_of_a_newton(
    run: Run, presses: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TERMINAL, "width", 15)
    done = well(calibrate(run, presses, *BY_OHM))
    assert "held-out error [0.01 N]" in " ".join(done.out.split())
    assert "(5)" not in done.out


def test_bad_recordings(run: Run, presses: tuple[Path, Path, Path], tmp_path: Path) -> None:
    recording, forces, out = presses
    assert_one_line(
        run("calibrate", "recording", str(recording), str(out), "--rest", "1", *TOLD),
        "presses.mcap: no force in it: say --forces LOG.csv",
    )
    assert_one_line(
        calibrate(run, presses, "--method", "joint"), "presses.mcap: no tare in it: say --rest 2"
    )
    assert_one_line(
        calibrate(run, presses, "--rest", "100"),
        "presses.mcap: nothing touched the skin for 100 s? all of it is not longer",
    )
    given = load_recording(recording)
    tare = Tare(given.scans[0].ratio, 0.0, "far")
    write_recording(tmp_path / "far.mcap", given.hellos[0], [tare, *given.scans[:2]])
    assert_one_line(
        calibrate(run, (tmp_path / "far.mcap", forces, out), "--method", "joint"),
        "far.mcap: no tare in mode near in it: say --rest 2",
    )
    edited(forces, lambda t, f: (t[t < SENSOR_BEGIN_S + 21], f[t < SENSOR_BEGIN_S + 21]))
    few = [scan for scan in given.scans if scan.time_us < 5e6]
    for name, scans, words in (("none", [], ": no scan in it"), ("one", few, "")):
        path = tmp_path / f"{name}.mcap"
        write_recording(path, given.hellos[0], scans)
        assert_one_line(calibrate(run, (path, forces, out)), f"{name}.mcap{words}")
    for name, octets in (("foreign", b"no recording"), ("cut", recording.read_bytes()[:200])):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(octets)
        assert_one_line(calibrate(run, (path, forces, out)), f"{name}.mcap")
    assert not out.exists()


REST = "emulator://2x3?seed=1&unit=5"


def press_table(path: Path, seed: int = 1) -> Float:
    """Presses of all cells of `REST` at 10 microsiemens a newton; their rests (2, 3)."""
    rest = Scene("rest", 2, 3, seed=1).skin(0.0).cell_siemens
    lines = ["row,column,force_n,conductance"]
    for row, column in np.ndindex(2, 3):
        for force_n in (0.5, 1, 2, 3, 5, 8):
            lines.append(f"{row},{column},{force_n},{rest[row, column] + 10e-6 * force_n}")
    path.write_text("\n".join(lines) + "\n")
    return rest


def test_a_table_makes_a_calibration(run: Run, tmp_path: Path) -> None:
    table, out = tmp_path / "presses.csv", tmp_path / "skin.json"
    rest = press_table(table)
    well(run("calibrate", "table", REST, str(table), str(out), "--rest", "0.3", *TOLD))
    found = load_calibration(out)
    assert (found.unit_id, found.rows, found.columns) == (5, 2, 3)
    np.testing.assert_allclose(found.model.slope, 1e5, rtol=0.02)
    np.testing.assert_allclose(found.rest.level, rest, rtol=0.1)
    with ohmskin.open(REST, calibration=out) as skin:
        assert np.abs(skin.latest().force_n).max() < 0.02


def test_a_new_calibration_keeps_where_the_cells_are(run: Run, tmp_path: Path) -> None:
    """It dropped the geometry of the file it replaces, without a word."""
    table, out = tmp_path / "presses.csv", tmp_path / "skin.json"
    press_table(table)
    words = ("calibrate", "table", REST, str(table), str(out), "--rest", "0.05", *TOLD)
    out.write_text("no calibration")
    assert "stay" not in well(run(*words)).out
    well(run("skin", str(out), "--pitch-mm", "10,20", "--frame", "arm"))
    assert f"cells stay where {out} had them: flat, in 'arm'" in well(run(*words)).out
    assert load_calibration(out).geometry.position_m[1, 2] == pytest.approx([0.02, 0.02, 0])
    of_scene("rest").save(out)  # of 8x8 cells
    well(run("skin", str(out), "--pitch-mm", "10,20"))
    assert "stay" not in well(run(*words)).out
    assert load_calibration(out).geometry is None


def test_bad_tables(run: Run, tmp_path: Path) -> None:
    table, out = tmp_path / "presses.csv", tmp_path / "skin.json"
    press_table(table)
    good = table.read_text()
    header, *rows = good.splitlines()
    for text, words in (
        ("\n".join([header, *rows[:6]]), ["all presses are on cell (0, 0)"]),
        (good.replace("0,0,1,", "2,0,1,"), ["row 3: cell (2, 0) is not on this 2x3 skin"]),
        ("\n".join([header, *(f"{row[:4]}2,{row[-9:]}" for row in rows)]), ["presses.csv"]),
    ):
        table.write_text(text)
        done = run("calibrate", "table", REST, str(table), str(out), "--rest", "0.05", *TOLD)
        assert_one_line(done, *words)
        assert not out.exists()
    table.write_text(good)
    assert_one_line(
        run("calibrate", "table", REST, str(table), str(out), *TOLD, "--method", "voltage"),
        "a table has conductances",
    )


def test_a_recording_in_the_place_of_the_file_to_write_is_not_lost(
    run: Run, tmp_path: Path
) -> None:
    """It was replaced by the calibration, and so was a sensor's log, if --forces was forgotten."""
    for name in ("b.mcap", "sensor.csv"):
        (kept := tmp_path / name).write_text("measured for an hour")
        words = (str(tmp_path / "a.mcap"), str(kept), *TOLD)
        assert_one_line(
            run("calibrate", "recording", *words), f"{name}: the file to write is a .json"
        )
        readings = (str(tmp_path / "a.npz"), "--method", "joint", "--out", str(kept))
        assert_one_line(run("estimate", *readings), f"{name}: the file to write is a .npz")
        (plate := tmp_path / "plate.csv").write_text("1e6,1e6\n1e6,1e6\n")
        verify = ("verify", "emulator://2x2?speed=0", str(plate), "--json", str(kept))
        assert_one_line(run(*verify), f"{name}: the file to write is a .json")
        assert kept.read_text() == "measured for an hour"


def test_a_missing_indenter_is_asked_for(run: Run, tmp_path: Path) -> None:
    done = run("calibrate", "table", REST, "t.csv", str(tmp_path / "skin.json"))
    assert done.code == 2
    assert "--indenter-mm2" in done.err
