# SPDX-License-Identifier: Apache-2.0
"""Forces of a recording in arrays and files, against those of a replay."""

import csv
import json
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from command_line import Run, assert_one_line, well
from ohmskin.errors import OhmskinError, RecordingError
from ohmskin.force import tables
from ohmskin.force.geometry import Geometry
from ohmskin.force.reader import ForceScan
from ohmskin.force.tables import export, load_forces, read_forces
from ohmskin.record.export import Part
from ohmskin.record.readings import load_readings
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Mark
from stepped import stepped
from waiting import until

URL = "emulator://8x8?scene=ghost&seed=1&begin=0.2"
CELLS = ("force_n", "force_n_std")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third of a second, with a tare, a mark in the middle and one at the end."""
    path, skin = tmp_path_factory.mktemp("recorded") / "a.mcap", stepped(URL)
    with Recorder(path, skin.info, lambda: skin.now_s) as recorder:
        for k, scan in enumerate(islice(skin, 30)):
            if k == 12:
                calibrated = ohmskin.CalibratedSkin(skin, of_scene("ghost"))
                recorder.add(calibrated.tare(0.0, force=True))
                recorder.add(Mark("here", scan.host_time_s))
            recorder.add(scan)
        recorder.add(Mark("end", skin.now_s))
    return path


@pytest.fixture(scope="module")
def played(recorded: Path) -> list[ForceScan]:
    with ohmskin.open(f"replay://{recorded}?speed=0", calibration=of_scene("ghost")) as skin:
        return list(skin)


def test_arrays_are_those_of_a_replay(recorded: Path, played: list[ForceScan]) -> None:
    arrays = load_forces(recorded, of_scene("ghost"))
    for name in ("number", "missed", "time_ns"):
        assert arrays[name].tolist() == [getattr(scan, name) for scan in played]
    for name in CELLS:
        expected = np.array([getattr(scan, name) for scan in played], dtype=np.float32)
        np.testing.assert_array_equal(arrays[name], expected)
    contacts = [(k, contact) for k, scan in enumerate(played) for contact in scan.contacts]
    assert len(contacts) >= 3
    assert arrays["contact_scan"].tolist() == [k for k, _ in contacts]
    for name in ("identity", "row", "column", "force_n", "force_n_std"):
        assert arrays[f"contact_{name}"].tolist() == [getattr(c, name) for _, c in contacts]
    assert np.isnan(arrays["contact_position_m"]).all()
    assert arrays["mark_text"].tolist() == ["here", "end"]
    # A mark is set when a scan arrives, half a period after its middle.
    assert arrays["mark_time_ns"][0] - arrays["time_ns"][12] == pytest.approx(0.5e9 / 90, rel=0.1)


def test_contacts_have_places_where_the_calibration_says_where_cells_are(recorded: Path) -> None:
    flat = Geometry("flat", "skin", 8, 8, {"pitch_m": np.array([0.01, 0.02])})
    arrays = load_forces(recorded, replace(of_scene("ghost"), geometry=flat))
    row, column = arrays["contact_row"], arrays["contact_column"]
    expected = np.stack([0.01 * column, 0.02 * row, 0 * row], axis=-1)
    np.testing.assert_allclose(arrays["contact_position_m"], expected, atol=1e-12)
    np.testing.assert_array_equal(arrays["contact_normal"], [[0, 0, 1]] * len(row))


def test_a_file_of_arrays_holds_the_same(recorded: Path, tmp_path: Path) -> None:
    export(recorded, tmp_path / "a.npz", of_scene("ghost"))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        arrays = load_forces(recorded, of_scene("ghost"))
        assert sorted(file) == sorted(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(file[name], array)
            assert file[name].dtype == array.dtype


def test_a_table_has_a_row_a_scan(
    recorded: Path, played: list[ForceScan], tmp_path: Path, run: Run
) -> None:
    of_scene("ghost").save(tmp_path / "skin.json")
    out, known = tmp_path / "a.csv", ("--calibration", str(tmp_path / "skin.json"))
    assert "30 scans" in well(run("export", str(recorded), str(out), *known)).out
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 30
    for row, scan in zip(rows, played, strict=True):
        assert int(row["time_ns"]) == scan.time_ns
        assert float(row["r2c5_force_n"]) == scan.force_n[2, 5]
        assert float(row["r7c0_force_n_std"]) == scan.force_n_std[7, 0]


def test_parquet_is_read_by_its_library(
    recorded: Path, played: list[ForceScan], tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    export(recorded, tmp_path / "a.parquet", of_scene("ghost"))
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table["time_ns"].to_pylist() == [scan.time_ns for scan in played]
    force_n = np.array(table["force_n"].to_pylist(), dtype=np.float32).reshape(30, 8, 8)
    np.testing.assert_array_equal(force_n, [scan.force_n.astype(np.float32) for scan in played])
    of_contacts = [[c["row"] for c in contacts] for contacts in table["contacts"].to_pylist()]
    assert of_contacts == [[contact.row for contact in scan.contacts] for scan in played]
    told = parquet.read_metadata(tmp_path / "a.parquet").metadata
    assert [mark["text"] for mark in json.loads(told[b"marks"])] == ["here", "end"]


def test_a_calibration_may_be_a_file(recorded: Path, tmp_path: Path) -> None:
    """As for `open`: it was an AttributeError that named no file."""
    of_scene("ghost").save(path := tmp_path / "skin.json")
    for name, array in load_forces(recorded, path).items():
        np.testing.assert_array_equal(array, load_forces(recorded, of_scene("ghost"))[name])
    force_n = np.eye(8)
    of_file, same = (ohmskin.SimulatedSkin(of) for of in (str(path), of_scene("ghost")))
    np.testing.assert_array_equal(
        of_file.step(force_n, 0.1).force_n, same.step(force_n, 0.1).force_n
    )


def test_a_part_of_it(recorded: Path) -> None:
    arrays = load_forces(recorded, of_scene("ghost"), 0.1, 0.2)
    assert arrays["number"].tolist() == list(range(9, 18))
    assert arrays["force_n"].shape == (9, 8, 8)


def test_a_part_has_its_own_marks(recorded: Path) -> None:
    """It had those of the whole recording."""
    known = of_scene("ghost")
    of_parts = [(0.0, 0.05), (0.1, 0.2), (0.2, 0.0)]
    found = [load_forces(recorded, known, *part)["mark_text"].tolist() for part in of_parts]
    assert found == [[], ["here"], ["end"]]


def test_another_unit_in_a_recording_needs_its_own_calibration(tmp_path: Path) -> None:
    """Its forces were read by the first unit's calibration, and its own was refused."""
    path, first, other = tmp_path / "a.mcap", stepped(URL), stepped(f"{URL}&unit=5")
    with Recorder(path, first.info) as recorder:
        for scan in islice(first, 10):
            recorder.add(scan)
        recorder.add(other.info)
        for scan in islice(other, 10):
            recorder.add(replace(scan, host_time_s=scan.host_time_s + 1.0))
    with pytest.raises(RecordingError, match="unit 5 has come in place of unit 0: export each par"):
        load_forces(path, of_scene("ghost"))
    assert len(load_forces(path, of_scene("ghost"), end_s=0.5)["number"]) == 10
    of_other = replace(of_scene("ghost"), unit_id=5)
    assert len(load_forces(path, of_other, begin_s=0.5)["number"]) == 10
    with pytest.raises(ValueError, match="of unit 0, the board is unit 5"):
        load_forces(path, of_scene("ghost"), begin_s=0.5)


def test_scans_before_an_error_are_given_and_the_error_says_where(tmp_path: Path, run: Run) -> None:
    """Those of its group were not; and it named neither the recording nor the moment."""
    path, skin = tmp_path / "a.mcap", stepped(URL)
    with Recorder(path, skin.info) as recorder:
        for scan in islice(skin, 100):
            recorder.add(scan)
        skin.configure(mode="far")
        recorder.add(skin.info)
        recorder.add(skin.latest())
    forces, found = read_forces(Part(path), of_scene("ghost")), []
    with pytest.raises(RecordingError, match=r"a\.mcap: after 1\.1.* s, .* near, now in far: exp"):
        found += forces
    assert [scan.number for scan in found] == list(range(100))
    of_scene("ghost", unit_id=5).save(tmp_path / "skin.json")
    words = ("export", str(path), str(tmp_path / "a.npz"), "--calibration")
    assert_one_line(run(*words, str(tmp_path / "skin.json")), "a.mcap: this calibration is of unit")


def test_a_calibration_of_another_unit_can_be_taken(
    recorded: Path, tmp_path: Path, run: Run
) -> None:
    """As `stream` and `view` take it, for a board that was changed: `export` had no such option."""
    pytest.importorskip("joblib")
    of_scene("ghost", unit_id=5).save(tmp_path / "skin.json")
    again = tmp_path / "b.mcap"
    again.write_bytes(recorded.read_bytes())
    force = ("--calibration", str(tmp_path / "skin.json"), "--force", "--backend", "threading")
    well(run("export", str(recorded), str(tmp_path / "a.csv"), *force))
    well(run("export", str(recorded), str(again), str(tmp_path), *force))
    expected = load_forces(recorded, of_scene("ghost"))["force_n"]
    for name in ("a.npz", "b.npz"):
        with np.load(tmp_path / name) as file:
            np.testing.assert_array_equal(file["force_n"], expected)


def test_several_go_into_a_folder_at_once(recorded: Path, tmp_path: Path, run: Run) -> None:
    pytest.importorskip("joblib")
    of_scene("ghost").save(tmp_path / "skin.json")
    (out := tmp_path / "out").mkdir()
    again = tmp_path / "b.mcap"
    again.write_bytes(recorded.read_bytes())
    words = ("export", str(recorded), str(again), str(out), "--backend", "threading")
    well(run(*words, "--calibration", str(tmp_path / "skin.json")))
    assert (out / "a.npz").read_bytes()[:2] == b"PK"
    with np.load(out / "a.npz") as one, np.load(out / "b.npz") as other:
        np.testing.assert_array_equal(one["force_n"], other["force_n"])
    # One that cannot be read does not keep the others from being exported.
    (bad := tmp_path / "bad.mcap").write_bytes(b"no recording")
    (out / "b.npz").unlink()
    done = run("export", str(bad), str(again), str(out), "--backend", "threading")
    assert (done.code, "bad.mcap" in done.err) == (2, True)
    assert "not exported: 1 of 2 recordings" in done.err
    assert [path.name for path in sorted(out.iterdir())] == ["a.npz", "b.npz"]
    assert_one_line(run(*words[:-2], "--format", "xyz"), "no format '.xyz'")
    twice = run("export", str(again), str(again), str(out))
    assert_one_line(twice, "two recordings have one name")
    # It said "a folder takes several recordings", of a folder that nobody had made.
    for name in ("one.npz", "forces"):
        done = run("export", str(recorded), str(again), str(tmp_path / name))
        assert_one_line(done, f"{name} is no folder: make it first")
    assert_one_line(run("export", str(recorded), str(tmp_path / "forces")), "is no folder: make")


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no process is killed so")
def test_a_process_that_is_killed_is_said_in_a_line(
    recorded: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("joblib")
    (again := tmp_path / "b.mcap").write_bytes(recorded.read_bytes())

    def killed(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(tables, "export_or_why_not", killed)
    done = run("export", str(recorded), str(again), str(tmp_path))
    assert_one_line(done, "a process that wrote one of the files was ended")


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no process is killed so")
@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_ctrl_c_leaves_no_partial_file(
    recorded: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, backend: str
) -> None:
    """The processes that write them are killed: the files stayed for an hour."""
    pytest.importorskip("joblib" if backend == "loky" else "dask.distributed")
    (again := tmp_path / "b.mcap").write_bytes(recorded.read_bytes())
    (out := tmp_path / "out").mkdir()
    (out / "a.npz").write_text("old")

    def stuck(*told: object, **more: object) -> object:
        from ohmskin.force import tables  # of the process that writes
        from ohmskin.record import export

        export.ZipFile = lambda *_: time.sleep(600)
        return tables.export_or_why_not(*told, **more)

    def interrupt() -> None:
        until(lambda: list(out.glob(".ohmskin-*.part")), 60)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(tables, "export_or_why_not", stuck)
    waits = threading.Thread(target=interrupt)
    waits.start()
    done = run("export", str(recorded), str(again), str(out), "--backend", backend)
    waits.join()
    assert done.code == 130
    assert [path.read_text() for path in out.iterdir()] == ["old"]


def test_readings_are_exported_where_the_environment_names_a_calibration(
    recorded: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_scene("ghost").save(tmp_path / "skin.json")
    monkeypatch.setenv("OHMSKIN_CALIBRATION", str(tmp_path / "skin.json"))
    well(run("export", str(recorded), str(tmp_path / "out.npz")))
    assert load_readings(tmp_path / "out.npz").ratio.shape == (30, 8, 8, 4)


def test_a_format_that_the_file_has_not_is_refused(
    recorded: Path, tmp_path: Path, run: Run
) -> None:
    words = ("export", str(recorded), str(tmp_path / "out.npz"), "--format")
    for kind in (".csv", "csv"):
        assert_one_line(run(*words, kind), "--format .csv is of files in a folder")
    assert not (tmp_path / "out.npz").exists()
    assert_one_line(run(*words[:2], str(tmp_path / "a.parquet")), "say --calibration")
    assert_one_line(run(*words[:2], str(tmp_path), "--format", "parquet"), "say --calibration")
    well(run(*words, ".npz"))
    (tmp_path / "folder").mkdir()
    well(run("export", str(recorded), str(tmp_path / "folder"), "--format", "csv"))
    assert (tmp_path / "folder" / "a.csv").exists()


def test_without_dask_it_says_what_to_install(
    recorded: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("joblib")
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    (again := tmp_path / "b.mcap").write_bytes(recorded.read_bytes())
    done = run("export", str(recorded), str(again), str(tmp_path), "--backend", "dask")
    assert_one_line(done, "run pip install 'dask[distributed]'")


def test_what_cannot_be_written(recorded: Path, tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(ValueError, match=r"there are \.npz, \.csv, \.parquet"):
        export(recorded, tmp_path / "a.xls", of_scene("ghost"))
    with pytest.raises(ValueError, match="of unit 5"):
        load_forces(recorded, replace(of_scene("ghost"), unit_id=5))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(OhmskinError, match="run pip install pyarrow"):
        export(recorded, tmp_path / "a.parquet", of_scene("ghost"))
    assert not list(tmp_path.iterdir())
