# SPDX-License-Identifier: Apache-2.0
"""Recordings are exported: arrays (.npz), from which methods estimate, and tables (.csv)."""

import csv
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from ohmskin.errors import RecordingError
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.tables import export
from ohmskin.link.device import mean_ratio, scans_for
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.readings import estimate_file, load_readings
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import Tare, load_recording
from recordings import scan, write_recording
from stepped import stepped

pytestmark = pytest.mark.usefixtures("nothing_left")


def test_regions_and_fewer_readings_are_exported(
    tmp_path: Path, path: Path, regions: list[Scan]
) -> None:
    export(path, tmp_path / "all.npz")
    readings = load_readings(tmp_path / "all.npz")
    assert readings.reading_names == ("a", "b", "c", "d")
    for ratio, each in zip(readings.ratio, regions, strict=True):
        places = ["abcd".index(name) for name in each.reading_names]
        np.testing.assert_array_equal(ratio[..., places], each.ratio)
        assert np.isnan(np.delete(ratio, places, axis=-1)).all()
    # What is estimated of the file is what is estimated of the scans.
    found = estimate_file(readings, "joint")["cell_siemens"]
    estimator = make_estimator("joint", readings.knowledge(0))
    for cells, each in zip(found, regions, strict=True):
        np.testing.assert_array_equal(cells, estimator.estimate(each.ratio).cell_siemens)
    export(path, tmp_path / "all.csv")
    with (tmp_path / "all.csv").open() as file:
        for row, each in zip(csv.DictReader(file), regions, strict=True):
            cells = np.ndindex(each.codes.shape)
            codes = {f"r{i}c{j}{each.reading_names[k]}": each.codes[i, j, k] for i, j, k in cells}
            read = {f"r{i}c{j}" for i, j in np.argwhere(each.read)}
            for name, text in list(row.items())[4:]:
                assert text == (str(codes[name]) if name in codes and name[:4] in read else "")


def test_a_file_of_few_readings_has_the_rest_of_all(tmp_path: Path, path: Path) -> None:
    """One reading of each cell, and a tare that was made in mode near."""
    skin = stepped("emulator://3x3?scene=single&begin=0&seed=1")
    near, board = mean_ratio(islice(skin, 20)), skin.configure(mode="quick")
    with Recorder(path, board, lambda: skin.now_s) as recorder:
        recorder.add(Tare(near, 0.0))
        record(skin, recorder, scans_for(skin, 0.1))
    export(path, tmp_path / "quick.npz")
    readings = load_readings(tmp_path / "quick.npz")
    np.testing.assert_array_equal(readings.rest_ratio, near)
    assert np.isnan(readings.ratio).all(axis=(0, 1, 2)).tolist() == [True, False, True, True]


@pytest.fixture
def recorded(path: Path) -> Path:
    rest, touched = (
        stepped(f"emulator://3x4?scene={scene}&begin=0&noise=0") for scene in ("rest", "single")
    )
    tare = Tare(next(iter(rest)).ratio, 0.0)
    write_recording(path, rest.info, [tare, *islice(touched, 5)])
    return path


def test_export_is_estimated(tmp_path: Path, recorded: Path) -> None:
    out = tmp_path / "a.npz"
    recording = load_recording(recorded)
    assert export(recorded, out).scans == 5
    readings = load_readings(out)
    expected = [each.ratio for each in recording.scans]
    np.testing.assert_array_equal(readings.ratio, expected)
    np.testing.assert_array_equal(readings.rest_ratio, recording.tares[0].rest_ratio)
    assert (readings.adc_bits, readings.ref_top_ohm) == (10, 30_000)
    assert estimate_file(readings, "joint")["converged"].all()
    with np.load(out) as arrays:
        assert arrays["time_us"].tolist() == [each.time_us for each in recording.scans]


def test_export_as_a_table(tmp_path: Path, recorded: Path) -> None:
    out = tmp_path / "a.csv"
    recording = load_recording(recorded)
    export(recorded, out)
    header = out.read_text().splitlines()[0].split(",")
    assert header[:6] == ["number", "time_us", "host_time_s", "missed", "r0c0a", "r0c0b"]
    assert header[-1] == "r2c3d"
    table = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(
        table[:, 4:], [each.codes.reshape(-1) for each in recording.scans]
    )
    np.testing.assert_array_equal(table[:, 2], [each.host_time_s for each in recording.scans])


def test_export_of_a_part(tmp_path: Path, recorded: Path) -> None:
    recording = load_recording(recorded)
    times_s = [each.host_time_s - recording.scans[0].host_time_s for each in recording.scans]
    part = export(recorded, tmp_path / "a.npz", begin_s=times_s[1], end_s=times_s[3] + 1e-6)
    assert part.scans in (3, 2)  # the first may fall to rounding
    with pytest.raises(RecordingError, match="no scans"):
        export(recorded, tmp_path / "b.npz", begin_s=1000)
    with pytest.raises(ValueError, match="no format"):
        export(recorded, tmp_path / "b.txt")
    assert not list(tmp_path.glob("b*"))


def test_a_part_that_ends_before_it_begins_is_refused(tmp_path: Path, recorded: Path) -> None:
    """It was said to have no scans."""
    with pytest.raises(
        ValueError, match=r"cannot end after 0\.5 s, and begin after 1 s: say --beg"
    ):
        export(recorded, tmp_path / "a.npz", begin_s=1.0, end_s=0.5)


def test_a_part_has_the_tare_that_held_and_the_board_that_was_there(
    path: Path, hello: Hello, tmp_path: Path
) -> None:
    """The file had a tare from after the part, and the references of a board before it."""
    rests = [np.full((3, 4, 4), rest) for rest in (0.2, 0.3)]
    other = replace(hello, ref_top_ohm=10_000)
    messages_in_order = (
        *(scan(0, at_s=0.0), Tare(rests[0], 0.5), other, scan(1, at_s=1.0)),
        *(Tare(rests[1], 1.5), scan(2, at_s=2.0)),
    )
    write_recording(path, hello, messages_in_order)
    export(path, tmp_path / "a.npz", begin_s=0.9, end_s=1.1)
    readings = load_readings(tmp_path / "a.npz")
    assert np.load(tmp_path / "a.npz")["ref_top_ohm"].dtype == np.float64
    np.testing.assert_array_equal(readings.rest_ratio, rests[0])
    assert readings.ref_top_ohm == 10_000


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ({"unit_id": 9}, "unit 9 has come in place of unit"),
        ({"ref_top_ohm": 10_000}, "the board has other reference resistors"),
    ],
)
def test_codes_of_two_boards_are_not_in_one_file(
    path: Path, hello: Hello, tmp_path: Path, said: dict[str, int], reason: str
) -> None:
    """The file had the first board's references for the scans of both."""
    write_recording(path, hello, [scan(0), replace(hello, **said), scan(1, at_s=1.0)])
    for name in ("a.npz", "a.csv"):
        with pytest.raises(RecordingError, match=rf"after 1\.000 s {reason}.*: export each part"):
            export(path, tmp_path / name)
    export(path, tmp_path / "b.npz", begin_s=0.5)
    assert load_readings(tmp_path / "b.npz").ratio.shape[0] == 1


def test_cells_that_no_scan_has_read_are_exported_as_such(
    tmp_path: Path, path: Path, hello: Hello
) -> None:
    """They were written as the ratio of code 0, which estimators took for readings."""
    of_region = [replace(scan(n), row_mask=0b010, column_mask=0b0110) for n in (1, 2)]
    write_recording(path, hello, of_region)
    export(path, tmp_path / "region.npz")
    ratio = load_readings(tmp_path / "region.npz").ratio
    assert np.isfinite(ratio[:, 1, 1:3]).all()
    assert np.isfinite(ratio).sum() == ratio[:, 1, 1:3].size
