# SPDX-License-Identifier: Apache-2.0
"""Press tables: the same bits after a round trip, and whatever else a file may hold refused."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.calibrate.press_table import PressTable, load_press_table, save_press_table

HEADER = "row,column,force_n,conductance"


def written(folder: Path, *lines: str, encoding: str = "utf-8") -> Path:
    path = folder / "presses.csv"
    path.write_bytes("\n".join([*lines, ""]).encode(encoding))
    return path


def table(count: int = 3) -> PressTable:
    random = np.random.default_rng(1)
    return PressTable(
        random.integers(0, 8, count),
        random.integers(0, 8, count),
        random.uniform(0, 20, count),
        random.uniform(0, 1e-4, count),
        random.uniform(0, 1e-6, count),
    )


def test_a_table_is_read_in_any_order_of_columns(tmp_path: Path) -> None:
    found = load_press_table(
        written(tmp_path, "\ufeffconductance,force_n,column,row", "1e-5,2.5,3,0", "0,0,1.0,15")
    )
    assert found.row.tolist() == [0, 15]
    assert found.column.tolist() == [3, 1]
    assert found.row.dtype == found.column.dtype == np.int64
    assert found.force_n.tolist() == [2.5, 0.0]
    assert found.conductance.tolist() == [1e-5, 0.0]
    assert found.conductance_std.tolist() == [0.0, 0.0]


_NOT_NEGATIVE = st.floats(0, 1e60)
_SIEMENS = st.floats(0, 1)
_CELL = st.integers(0, 4095)


@given(
    st.lists(st.tuples(_CELL, _CELL, _NOT_NEGATIVE, _SIEMENS, _SIEMENS), min_size=1, max_size=20)
)
def test_a_saved_table_is_read_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[int, int, float, float, float]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    row, column, *numbers = (np.array(each) for each in zip(*rows, strict=True))
    saved = PressTable(row, column, *numbers)
    save_press_table(path, saved)
    found = load_press_table(path)
    for field in fields(PressTable):
        one, other = getattr(saved, field.name), getattr(found, field.name)
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()


def test_a_saved_table_is_a_csv_that_numpy_reads(tmp_path: Path) -> None:
    saved = table()
    save_press_table(tmp_path / "presses.csv", saved)
    lines = (tmp_path / "presses.csv").read_text("ascii").splitlines()
    assert lines[0] == f"{HEADER},conductance_std"
    found = np.loadtxt(lines[1:], delimiter=",")
    columns = [getattr(saved, field.name) for field in fields(PressTable)]
    assert (found == np.stack(columns, axis=1)).all()


def test_a_table_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = written(tmp_path, HEADER, "0,0,1,1e-6")
    broken = table()
    object.__setattr__(broken, "force_n", broken.force_n[:-1])
    with pytest.raises(ValueError, match="argument 3 is shorter"):
        save_press_table(path, broken)
    assert load_press_table(path).force_n.tolist() == [1.0]
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    with pytest.raises(ValueError, match=r"presses\.csv: cannot be written"):
        save_press_table(tmp_path / "nowhere" / "presses.csv", table())


GOOD = "1,2,3.5,1e-5"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([""], f"empty: it needs the header {HEADER}"),
        ([HEADER], "no press is in it"),
        ([GOOD], f"row 1 holds numbers: put the header {HEADER} above"),
        (["row,column,force_g,conductance", GOOD], "'force_g': force_n is wanted: multiply it by"),
        (
            ["row,column,force_n,conductance_us", GOOD],
            "'conductance_us': conductance is wanted: multiply it by 1e-6",
        ),
        (
            ["row,column,force_n,Conductance (µS)", GOOD],
            "'Conductance (µS)': conductance is wanted: multiply it by 1e-6",
        ),
        (
            ["row,column,force_n,resistance_ohm", GOOD],
            "'resistance_ohm': conductance is wanted: write 1 / resistance in ohm",
        ),
        (
            [f"{HEADER},conductance_std_us", f"{GOOD},1"],
            "'conductance_std_us': conductance_std is wanted: multiply it by 1e-6",
        ),
        (["row,col,force_n,conductance", GOOD], "'col': column is wanted: rename it"),
        ([f"{HEADER},remark", f"{GOOD},1"], "unknown column 'remark': leave it out"),
        ([f"{HEADER},", f"{GOOD},"], "unknown column '': leave it out"),
        ([f"{HEADER},row", f"{GOOD},1"], "column row stands twice"),
        (["row,column,force_n", "1,2,3"], "no column conductance: the header must hold"),
        ([HEADER.replace(",", ";"), GOOD], "semicolons separate its columns"),
        ([HEADER, GOOD, f"{GOOD},7"], "row 3 has 5 fields, the header 4"),
        ([HEADER, GOOD, "1,2,3"], "row 3 has 3 fields, the header 4"),
        ([HEADER, GOOD, HEADER], "row 3: row is 'row', not a number"),
        ([HEADER, GOOD, "", "1,2,,1e-5"], "row 4: force_n is empty"),
        ([HEADER, GOOD, "1.5,2,3,1e-5"], "row 3: row is 1.5, it must be a whole number from 0"),
        ([HEADER, GOOD, "1,-1,3,1e-5"], "row 3: column is -1, it must be a whole number from 0"),
        ([HEADER, GOOD, "1,1e30,3,1e-5"], "row 3: column is 1e+30, it must be a whole number"),
        ([HEADER, GOOD, "1,2,-3,1e-5"], "row 3: force_n is -3, it must be 0 or more: zero the"),
        ([HEADER, GOOD, "1,2,3,-1e-5"], "row 3: conductance is -1e-05, it must be finite and 0"),
        ([HEADER, GOOD, "1,2,3,12.5"], "row 3: conductance is 12.5, above 1 S: give siemens"),
        ([HEADER, GOOD, "1,2,nan,1e-5"], "row 3: force_n is 'nan', not finite"),
        (
            [f"{HEADER},conductance_std", f"{GOOD},0", f"{GOOD},-1e-7"],
            "row 3: conductance_std is -1e-07, it must be",
        ),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(
    tmp_path: Path, lines: list[str], words: str
) -> None:
    path = written(tmp_path, *lines)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        load_press_table(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("row", np.array([0, 1]), r"column has shape \(3,\), row \(2,\)"),
        ("column", np.array([0.0, 1.0, 2.0]), "column holds float64, not integers"),
        ("force_n", np.array([0.0, np.nan, 1.0]), "press 1: force_n is nan, it must be finite"),
        ("conductance", np.array([0.0, 1e-6, np.inf]), "press 2: conductance is inf, above 1 S"),
    ],
)
def test_a_table_is_checked_however_it_was_made(name: str, values: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(table(), **{name: values})


_PIECES = [HEADER, "\n", ",", "0", "1", "1e-5", "-", ";", '"', "nan", "1e400", "\r", "\0", "x", " "]


@given(
    st.binary(max_size=100)
    | st.lists(st.sampled_from(_PIECES), max_size=40).map(lambda each: "".join(each).encode())
    | st.lists(st.lists(st.floats(), min_size=4, max_size=4), max_size=5).map(
        lambda rows: "\n".join([HEADER, *(",".join(map(repr, row)) for row in rows)]).encode()
    )
)
def test_any_bytes_are_a_table_or_a_value_error_of_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(content)
    found, fault = None, "nothing"
    try:
        found = load_press_table(path)
    except ValueError as error:
        fault = str(error)
    assert len(fault.splitlines()) == 1
    assert found is None or (found.row.size > 0 and (found.force_n >= 0).all())
