# SPDX-License-Identifier: Apache-2.0
"""The readings file: what is read, what is refused and how it is said, what is written."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import METHODS
from ohmskin.record import readings as readings_module
from ohmskin.record.readings import Readings, estimate_file, load_readings, save_arrays
from places import DATA

SIEMENS = ("cell_siemens", "cell_siemens_std")
OUT_SHAPES = {
    **dict.fromkeys(("cell_ohm", *SIEMENS, "touched", "top_wire_ohm", "bottom_wire_ohm"), 3),
    **dict.fromkeys(("top_wire_ohm_std", "bottom_wire_ohm_std"), 3),
    **dict.fromkeys(("converged", "message", "chi2", "iterations", "seconds"), 1),
}


def write(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def test_a_reference_file_is_read_whole() -> None:
    with np.load(DATA / "random_4x6.npz") as reference:
        readings = load_readings(DATA / "random_4x6.npz")
        np.testing.assert_array_equal(readings.ratio, reference["ratio"])
        np.testing.assert_array_equal(readings.rest_ratio, reference["rest_ratio"])
    knowledge = readings.knowledge(0)
    assert (knowledge.rows, knowledge.columns) == (4, 6)
    assert (knowledge.ref_top_ohm, knowledge.ref_bottom_ohm) == (30e3, 30e3)
    assert knowledge.nominal_wire_ohm.both == (100, 200)
    assert knowledge.adc_bits is None
    assert not readings.one_skin_per_frame


def test_readings_at_far_ends_have_names(tmp_path: Path) -> None:
    """The file of the reference has all of them: eight a cell."""
    readings = load_readings(DATA / "far_harsh_8x8.npz")
    assert readings.reading_names == tuple("abcdefgh")
    assert readings.ratio.shape[-1] == 8
    far = Readings(readings.ratio[..., [0, 4, 1, 5]], reading_names=tuple("aebf"))
    assert far.knowledge(0).reading_names == tuple("aebf")
    for names, ratio in (("abef", np.ones((1, 2, 2, 8))), ("aaef", np.ones((1, 2, 2, 4)))):
        path = write(tmp_path / "wrong.npz", ratio=ratio, reading_names=list(names))
        with pytest.raises(ValueError, match=r"wrong\.npz: (ratio has shape|reading_names are)"):
            load_readings(path)
    with pytest.raises(ValueError, match="reading E, is 2, not in 0"):
        Readings(2 * np.eye(4)[1] * np.ones((1, 1, 1, 4)), reading_names=tuple("aebf"))


def test_a_sweep_has_rest_and_wires_of_its_own_per_frame() -> None:
    readings = load_readings(DATA / "wire_sweep_3x3.npz")
    assert readings.one_skin_per_frame
    first, last = readings.knowledge(0), readings.knowledge(4)
    assert (first.nominal_wire_ohm.top, last.nominal_wire_ohm.top) == (100, 41_000)
    assert first.nominal_wire_ohm.lead is None
    assert not np.array_equal(first.rest_ratio, last.rest_ratio)  # type: ignore[arg-type]


def test_ratio_alone_is_enough(tmp_path: Path) -> None:
    path = write(tmp_path / "bare.npz", ratio=np.full((2, 3, 4, 4), 0.5), adc_bits=12, junk="text")
    knowledge = load_readings(path).knowledge(1)
    assert knowledge.adc_bits == 12
    assert knowledge.ref_top_ohm == 30e3
    assert knowledge.rest_ratio is None
    assert knowledge.nominal_wire_ohm.top is None
    assert knowledge.nominal_wire_ohm.lead is None
    path = write(tmp_path / "leads.npz", ratio=GOOD, nominal_lead_ohm=80.0)
    assert load_readings(path).knowledge(0).nominal_wire_ohm == WireOhm(lead=80.0)
    each = Readings(GOOD, nominal_lead_ohm=np.array([0.0, 300.0]))
    assert each.one_skin_per_frame
    assert [each.knowledge(frame).nominal_wire_ohm.lead for frame in (0, 1)] == [0.0, 300.0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["random_2x2", "cell_sweep_3x3"])
def test_estimates_have_the_arrays_of_the_format(method: str, name: str) -> None:
    readings = load_readings(DATA / f"{name}.npz")
    seen: list[NDArray[np.float64]] = []
    out = estimate_file(readings, method, watch=lambda each: (seen.append(f) or f for f in each))
    frames, rows, columns, _ = readings.ratio.shape
    assert {name: array.shape for name, array in out.items()} == {
        name: (frames, rows, columns)[:ndim] for name, ndim in OUT_SHAPES.items()
    }
    assert out["touched"].dtype == bool
    assert out["converged"].dtype == bool
    assert out["converged"].mean() >= 0.8
    assert np.isnan(out["top_wire_ohm"]).all() == (method in ("ohm", "matrix"))
    np.testing.assert_allclose(out["cell_ohm"] * out["cell_siemens"], 1)
    assert len(seen) == frames


def test_cold_frames_do_not_depend_on_their_order() -> None:
    readings = load_readings(DATA / "presses_8x8.npz")
    some, turned = (Readings(readings.ratio[20:32][::step]) for step in (1, -1))
    forth = estimate_file(some, "matrix", cold=True)
    back = estimate_file(turned, "matrix", cold=True)
    warm = estimate_file(some, "matrix")
    np.testing.assert_array_equal(forth["cell_siemens"], back["cell_siemens"][::-1])
    np.testing.assert_array_equal(forth["iterations"], back["iterations"][::-1])
    assert warm["iterations"].sum() < forth["iterations"].sum()
    np.testing.assert_allclose(warm["cell_siemens"], forth["cell_siemens"], rtol=1e-3)


def test_frames_of_one_skin_each_are_estimated_each_afresh() -> None:
    readings = load_readings(DATA / "cell_sweep_3x3.npz")
    warm = estimate_file(readings, "matrix")
    cold = estimate_file(readings, "matrix", cold=True)
    np.testing.assert_array_equal(warm["cell_siemens"], cold["cell_siemens"])


GOOD = np.full((2, 3, 4, 4), 0.5)


def bad_ratio(index: tuple[int, ...], ratio: float) -> np.ndarray:
    bad = GOOD.copy()
    bad[index] = ratio
    return bad


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({}, "no array 'ratio'"),
        ({"ratio": GOOD[0]}, r"ratio has shape \(3, 4, 4\)"),
        ({"ratio": GOOD[..., :3]}, "ratio has shape"),
        ({"ratio": GOOD[:0]}, "ratio has 0 frames"),
        ({"ratio": GOOD[:, :0]}, "0x4 cells"),
        ({"ratio": np.zeros((1, 65, 64, 4))}, "65x64 cells: .* 4096"),
        (
            {"ratio": bad_ratio((1, 2, 0, 2), np.nan)},
            r"ratio, frame 1, of cell \(2, 0\), reading C",
        ),
        ({"ratio": bad_ratio((0, 0, 3, 0), 1.5)}, r"ratio, frame 0, of cell \(0, 3\), reading A"),
        ({"ratio": np.array(["a"])}, "ratio cannot be read: it holds <U1"),
        ({"ratio": GOOD + 0j}, "ratio cannot be read: it holds complex128"),
        ({"ratio": np.array([None])}, "ratio cannot be read: .*allow_pickle=False"),
        ({"ratio": GOOD, "rest_ratio": GOOD[0, :2]}, "rest_ratio has shape"),
        ({"ratio": GOOD, "rest_ratio": GOOD[:1]}, "rest_ratio has 1 frames, ratio 2"),
        ({"ratio": GOOD, "rest_ratio": GOOD[0] * 3}, r"rest_ratio of cell \(0, 0\)"),
        ({"ratio": GOOD, "rest_ratio": bad_ratio((1, 0, 0, 0), 2)}, r"rest_ratio of cell \(0, 0\)"),
        ({"ratio": GOOD, "ref_top_ohm": np.ones(2)}, "ref_top_ohm has shape"),
        ({"ratio": GOOD, "ref_bottom_ohm": 0.0}, "ref_bottom_ohm must be positive"),
        ({"ratio": GOOD, "adc_bits": 10.5}, "adc bits must be"),
        ({"ratio": GOOD, "adc_bits": np.inf}, "adc bits must be"),
        ({"ratio": GOOD, "nominal_top_wire_ohm": np.ones(3)}, "nominal_top_wire_ohm has shape"),
        ({"ratio": GOOD, "nominal_bottom_wire_ohm": [1, -1]}, "nominal_bottom_wire_ohm is -1"),
        ({"ratio": GOOD, "nominal_lead_ohm": -1.0}, "nominal_lead_ohm is -1"),
        ({"ratio": GOOD, "nominal_lead_ohm": np.ones((2, 1))}, "nominal_lead_ohm has shape"),
    ],
)
def test_a_wrong_file_is_refused_by_name_in_one_line(
    tmp_path: Path, arrays: dict[str, object], message: str
) -> None:
    path = write(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(ValueError, match=message) as refusal:
        load_readings(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert "\n" not in str(refusal.value)


def test_files_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "missing.npz"
    with pytest.raises(ValueError, match=r"missing.npz: .*No such file"):
        load_readings(path)
    with pytest.raises(ValueError, match=r"cannot be read: Is a directory"):
        load_readings(tmp_path)
    path.write_bytes(b"not a zip")
    with pytest.raises(ValueError, match="not a zip file"):
        load_readings(path)


def test_every_truncation_and_many_damages_are_refused_or_read(tmp_path: Path) -> None:
    whole = io.BytesIO()
    np.savez_compressed(whole, ratio=np.random.default_rng(0).random((1, 2, 2, 4)))
    packed = whole.getvalue()
    path = tmp_path / "damaged.npz"
    for length in range(len(packed)):
        path.write_bytes(packed[:length])
        with pytest.raises(ValueError, match=r"damaged.npz: "):
            load_readings(path)
    refusals = []
    for position in range(len(packed)):
        path.write_bytes(packed[:position] + b"\xff" + packed[position + 1 :])
        try:
            load_readings(path)
        except ValueError as error:
            refusals.append(str(error))
    assert "\n" not in "".join(refusals)
    assert len(refusals) > len(packed) / 2


def test_an_array_over_the_limit_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, ratio=np.zeros((100, 16, 16, 4)))
    monkeypatch.setattr(readings_module, "MAX_ARRAY_BYTES", 800_000)
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"ratio cannot be read: 819\d\d\d bytes, more than"):
        load_readings(path)
    # Numbers of one byte take eight when they are computed with.
    np.savez_compressed(path, ratio=np.zeros((100, 16, 16, 4), np.uint8))
    with pytest.raises(
        ValueError, match="ratio cannot be read: 819200 bytes as float64, more than"
    ):
        load_readings(path)


def test_frames_that_are_right_are_not_checked_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """200 MB of 1x1 cells took a minute."""
    checked: list[object] = []
    monkeypatch.setattr(
        readings_module, "check_ratio", lambda ratio, *_, **name: checked.append(name)
    )
    ratio = np.full((500, 1, 1, 4), 0.5)
    ratio[321, 0, 0, 2] = np.nan
    Readings(ratio)
    assert checked == [{"name": "ratio, frame 321,", "of": tuple("abcd")}]


def test_a_header_that_promises_more_than_the_file_holds_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    shape = (10**9, 1, 1, 4)
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    path = tmp_path / "promise.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ratio.npy", header.getvalue())
    with pytest.raises(ValueError, match=r"ratio cannot be read: "):
        load_readings(path)


def test_saved_arrays_come_back_and_nothing_else_is_left(tmp_path: Path) -> None:
    out = estimate_file(load_readings(DATA / "random_2x2.npz"), "ohm")
    path = tmp_path / "out.npz"
    path.write_bytes(b"an older file")
    save_arrays(path, out)
    with np.load(path, allow_pickle=False) as saved:
        assert set(saved.files) == set(OUT_SHAPES)
        for name, array in out.items():
            np.testing.assert_array_equal(saved[name], array)
    assert list(tmp_path.iterdir()) == [path]


def test_objects_are_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cell_ohm holds Python objects"):
        save_arrays(tmp_path / "out.npz", {"cell_ohm": np.array([object()])})
    assert list(tmp_path.iterdir()) == []
