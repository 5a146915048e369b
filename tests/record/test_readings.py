# SPDX-License-Identifier: Apache-2.0
"""The readings file: what is read, what is refused and how it is said, what is written."""

import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from command_line import EMPTY_MB, assert_one_line, bounded
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import METHODS
from ohmskin.record import readings as readings_module
from ohmskin.record.readings import Readings, estimate_file, load_readings, save_arrays
from places import DATA

SIEMENS = ("cell_siemens", "cell_siemens_std")
OUT_SHAPES = {
    **dict.fromkeys(("cell_ohm", *SIEMENS, "touched", "top_wire_ohm", "bottom_wire_ohm"), 3),
    **dict.fromkeys(("top_wire_ohm_std", "bottom_wire_ohm_std"), 3),
    **dict.fromkeys(("converged", "message", "wires", "chi2", "iterations", "seconds"), 1),
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
        (
            {"ratio": GOOD, "nominal_lead_ohm": 1e300},
            "nominal_lead_ohm is 1e.300, it must be from 0",
        ),
        ({"ratio": np.zeros((1, 33, 32, 4))}, "33x32 cells: at most 1024 cells in 64 rows"),
        ({"ratio": np.zeros((1, 1, 65, 4))}, "no skin has 1x65 cells"),
        (
            {"ratio": bad_ratio((1, 2, 0, 2), np.nan)},
            r"ratio, frame 1, of cell \(2, 0\), reading C",
        ),
        ({"ratio": bad_ratio((0, 0, 3, 0), 1.5)}, r"ratio, frame 0, of cell \(0, 3\), reading A"),
        ({"ratio": np.array(["a"])}, "ratio cannot be read: it holds <U1"),
        ({"ratio": GOOD + 0j}, "ratio cannot be read: it holds complex128"),
        ({"ratio": np.array([None])}, "ratio cannot be read: it holds object"),
        ({"ratio": GOOD, "rest_ratio": GOOD[0, :2]}, "rest_ratio has shape"),
        ({"ratio": GOOD, "rest_ratio": GOOD[:1]}, "rest_ratio has 1 frames, ratio 2"),
        ({"ratio": GOOD, "rest_ratio": GOOD[0] * 3}, r"rest_ratio of cell \(0, 0\)"),
        ({"ratio": GOOD, "rest_ratio": bad_ratio((1, 0, 0, 0), 2)}, r"rest_ratio of cell \(0, 0\)"),
        (
            {"ratio": GOOD, "ref_top_ohm": np.ones(2)},
            "ref_top_ohm .*, not one number",
        ),
        ({"ratio": GOOD, "reading_names": list("abcdefgha")}, "9 names of 4 bytes, not some"),
        ({"ratio": GOOD[..., :0], "reading_names": np.array([], "U1")}, "reading_names are ,"),
        ({"ratio": np.zeros((200_001, 1, 1, 4))}, "200001 frames, not 1 to 200000"),
        ({"ratio": GOOD, "ref_bottom_ohm": 0.0}, "ref_bottom_ohm must be from 1"),
        ({"ratio": GOOD, "adc_bits": 10.5}, "adc bits must be"),
        ({"ratio": GOOD, "adc_bits": np.inf}, "adc bits must be"),
        ({"ratio": GOOD, "ref_log_std": 1.5}, "ref_log_std is 1.5, it must be from 0 to 1"),
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
    # All arrays together count.
    half = np.zeros((200, 8, 8, 4))
    np.savez_compressed(path, ratio=half, rest_ratio=half)
    with pytest.raises(ValueError, match=r"rest_ratio cannot be read: 409600 bytes, more than"):
        load_readings(path)
    # Estimates of numbers of a byte take as much memory as those of four.
    np.savez_compressed(path, ratio=np.zeros((200, 16, 16, 4), np.uint8))
    with pytest.raises(ValueError, match="ratio cannot be read: 819200 bytes, more than 800000"):
        load_readings(path)


def npy(descr: str, shape: tuple[int, ...], data: bytes = b"") -> bytes:
    """An array whose header says so, whatever it holds."""
    file = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + data


RATIO = npy("<f8", (1, 1, 1, 4), bytes(32))
# What a file of some kilobytes could ask for, and what is said of it.
BOMBS: dict[str, tuple[str, bytes, int, str]] = {
    "names without letters": ("reading_names", npy("<U0", (10**9,)), 0, "1000000000 names"),
    "names": ("reading_names", npy("<U1", (49_000_000,)), 196_000_000, "49000000 names"),
    "a name": ("reading_names", npy("<U49000000", (1,)), 196_000_000, "1 names of 196000000"),
    "numbers": ("ref_top_ohm", npy("<f2", (24_000_000,)), 48_000_000, "not one number"),
    "a header": ("adc_bits", b"\x93NUMPY\2\0\0\0\0\x70", 100_000_000, "another version"),
    "frames": ("ratio", npy("<f2", (6_000_000, 1, 1, 4)), 48_000_000, "6000000 frames"),
    "cells": ("ratio", npy("<f8", (1, 64, 64, 4)), 8 * 4 * 4096, "64x64 cells"),
}


@pytest.mark.parametrize("what", BOMBS)
def test_a_small_file_takes_little_memory(tmp_path: Path, what: str) -> None:
    """Text took 1.6 GB of 610 bytes, as it passed before the limits."""
    name, begins, more, said = BOMBS[what]
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        if name != "ratio":
            archive.writestr("ratio.npy", RATIO)
        archive.writestr(f"{name}.npy", begins + bytes(more))
    command = "estimate", path, "--method", "matrix", "--out", tmp_path / "out.npz"
    done, peak_mb = bounded(*command)
    assert_one_line(done, said)
    assert peak_mb < EMPTY_MB + 250


def test_a_directory_of_any_stated_size_is_not_read(tmp_path: Path) -> None:
    """A file of holes has room for it."""
    path, size = tmp_path / "sparse.npz", 1_400_000_000
    with path.open("wb") as file:
        file.seek(size)
        file.write(struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, size, 0, 0))
    done, peak_mb = bounded("estimate", path, "--method", "ohm", "--out", tmp_path / "out.npz")
    assert_one_line(done, "Bad magic number for central directory")
    assert peak_mb < EMPTY_MB + 250


def test_what_has_no_end_is_not_read(tmp_path: Path) -> None:
    for path in (Path("/dev/zero"), tmp_path / "pipe"):
        if not path.exists():
            os.mkfifo(path)
        with pytest.raises(ValueError, match="the archive cannot be read: it is no file"):
            load_readings(path)


def test_methods_without_a_bound_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "packed.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("ratio.npy", RATIO)
    with pytest.raises(ValueError, match="packed by a method that numpy does not write"):
        load_readings(path)


def test_single_precision_is_estimated_in_double(tmp_path: Path) -> None:
    """A file of it takes half of the memory, and says the same."""
    exact = load_readings(DATA / "random_4x6.npz")
    single = exact.ratio.astype(np.float32)
    arrays = {"rest_ratio": exact.rest_ratio, "nominal_top_wire_ohm": np.float32(100.1)}
    read = load_readings(write(tmp_path / "single.npz", ratio=single, **arrays))
    assert read.ratio.dtype == np.float32
    assert type(read.knowledge(0).nominal_wire_ohm.top) is np.float64
    double = load_readings(write(tmp_path / "d.npz", ratio=single.astype(float), **arrays))
    one, other = (estimate_file(each, "joint")["cell_siemens"] for each in (read, double))
    np.testing.assert_array_equal(one, other)


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
    path = tmp_path / "promise.npz"
    for frames, said in ((10**9, "bytes, more than"), (100, "EOF")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("ratio.npy", npy("<f8", (frames, 1, 1, 4)))
        with pytest.raises(ValueError, match=f"ratio cannot be read: .*{said}"):
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
