# SPDX-License-Identifier: Apache-2.0
"""Force logs and tables of presses: what is read is what stands there, all else is refused."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.calibrate import tables
from ohmskin.calibrate.tables import (
    PRESS,
    ForceLog,
    load_force_log,
    load_press_table,
    save_press_table,
)
from ohmskin.record.readings import MAX_LINES

ROWS = [f"{0.1 * k:.1f},{k % 5}" for k in range(12)]
HEADER = "row,column,force_n,conductance"
GOOD = "1,2,3.5,1e-5"


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def log_text(rows: list[str], header: str = "time_s,force_n") -> str:
    return "\n".join([header, *rows]) + "\n"


@pytest.mark.parametrize(
    "content",
    [
        log_text(ROWS).encode(),
        log_text(ROWS).replace("\n", "\r\n").encode(),
        log_text(ROWS).replace("\n", "\r").encode(),
        b"\xef\xbb\xbf" + log_text(ROWS).encode(),
        log_text(ROWS, '"Time_s"," force_N"').encode(),
        log_text([*ROWS[:5], "", *ROWS[5:], "", " "]).encode(),
        log_text(
            [f"{row.split(',')[1]},Büro 20°,{row.split(',')[0]}" for row in ROWS],
            "force_n,Bemerkung,time_s",
        ).encode("latin-1"),
    ],
    ids=["plain", "crlf", "cr", "bom", "quoted", "empty lines", "other columns, latin-1"],
)
def test_a_log_is_read_however_it_was_written(tmp_path: Path, content: bytes) -> None:
    log = load_force_log(written(tmp_path, content))
    assert log.time_s.tolist() == [float(row.split(",")[0]) for row in ROWS]
    assert log.force_n.tolist() == [float(row.split(",")[1]) for row in ROWS]


BAD_LOGS: list[tuple[str | bytes, str]] = [
    ("", "no column time_s (seconds: 0.001 times milliseconds): row 1 must be the header"),
    ("\n".join(ROWS), "row 1 must be the header time_s,force_n, it is '0.0,0'"),
    (log_text(ROWS, "time_ms,force_n"), "no column time_s (seconds: 0.001 times milliseconds)"),
    (log_text(ROWS, "time_s,Force [g]"), "no column force_n (newtons: 0.00980665 times grams)"),
    (log_text(ROWS, "time_s,Force (µN)").encode("latin-1"), "no column force_n"),
    (log_text(ROWS, "time_s,time_s,force_n"), "column time_s stands twice"),
    (log_text(ROWS).replace(",", ";"), "it is 'time_s;force_n': separate columns by commas"),
    (log_text(ROWS).replace(",", "\t"), "it is 'time_s\\tforce_n': separate columns by commas"),
    (log_text(ROWS).encode("utf-16"), "UTF-16: save it as UTF-8"),
    (log_text([*ROWS, "1,3,2,5"]), "row 14 has 4 fields, the header 2: give each column one"),
    (log_text([*ROWS, "1.3"]), "row 14 has 1 fields, the header 2"),
    (log_text([*ROWS, '1.3,"2,5"']), "row 14: force_n is '2,5': write a finite number, with a"),
    (log_text([*ROWS[:4], ",2", *ROWS[4:]]), "row 6: time_s is '': write a finite number"),
    (log_text([*ROWS[:4], "", "0.35,x", *ROWS[4:]]), "row 7: force_n is 'x': write a finite"),
    (log_text([*ROWS, "1.3,nan"]), "row 14: force_n is 'nan': write a finite number"),
    (log_text([*ROWS, "inf,1"]), "row 14: time_s is 'inf': write a finite number"),
    (log_text([*ROWS, "1.3,1e300"]), "row 14: force_n is '1e300': write a finite number"),
    (log_text([*ROWS, "1.3,1_0"]), "row 14: force_n is '1_0': write a finite number"),
    (log_text([*ROWS[:6], "0.4,1", *ROWS[6:]]), "row 8: time_s is 0.4, it must be later than"),
    (log_text([*ROWS[:6], ROWS[5], *ROWS[6:]]), "row 8: time_s is 0.5, it must be later than"),
    (log_text(ROWS[:9]), "too few samples: 9, 10 are needed"),
    (log_text([f"{k},2.5" for k in range(12)]), "force_n is 2.5 throughout"),
    (log_text([f"{k},{-(k % 5)}" for k in range(12)]), "a press is negative: turn the sign"),
    (log_text([*ROWS, "1.3,-0.5"]), "row 14: force_n is -0.5, it must be -0.08 N or more: zero"),
    (log_text([*ROWS, '1.3,"2']), "row 14 is damaged: unexpected end of data"),
    (log_text([*ROWS, "1.3," + 200_000 * "1"]), "row 14 is damaged: field larger than"),
]
BAD_TABLES = [
    ([""], f"row 1 must be the header {HEADER}"),
    ([HEADER], "no press is in it"),
    (["row,column,force_g,conductance", GOOD], "no column force_n (newtons: 0.0098"),
    (["row,column,force_n,Conductance (µS)", GOOD], "no column conductance (siemens: 1e-6 times"),
    (["row,column,force_n,resistance", GOOD], "no column conductance (siemens: 1e-6 times micro"),
    ([f"{HEADER},conductance_std_us", f"{GOOD},1"], "unknown column 'conductance_std_us': leave"),
    ([f"{HEADER},", f"{GOOD},"], "unknown column '': leave it out; known are row, column, force_n"),
    (["row,col,force_n,conductance", GOOD], "no column column: row 1 must be the header"),
    ([f"{HEADER},row", f"{GOOD},1"], "column row stands twice"),
    ([HEADER.replace(",", ";"), GOOD], "separate columns by commas"),
    ([HEADER, GOOD, "1,2,3"], "row 3 has 3 fields, the header 4"),
    ([HEADER, GOOD, HEADER], "row 3: row is 'row': write a finite number"),
    ([HEADER, GOOD, "", "1,2,,1e-5"], "row 4: force_n is '': write a finite number"),
    ([HEADER, GOOD, "1.5,2,3,1e-5"], "row 3: row is 1.5, it must be a whole number from 0 to"),
    ([HEADER, GOOD, "1,-1,3,1e-5"], "row 3: column is -1, it must be a whole number from 0"),
    ([HEADER, GOOD, "1,1e30,3,1e-5"], "row 3: column is 1e+30, it must be a whole number"),
    ([HEADER, GOOD, "1,2,-3,1e-5"], "row 3: force_n is -3, it must be 0 or more: zero the"),
    ([HEADER, GOOD, "1,2,3,-1e-5"], "row 3: conductance is -1e-05, it must be 0 to 1 S"),
    ([HEADER, GOOD, "1,2,3,12.5"], "row 3: conductance is 12.5, it must be 0 to 1 S: of micros"),
    ([f"{HEADER},conductance_std", f"{GOOD},-1e-7"], "row 2: conductance_std is -1e-07, it must"),
]


@pytest.mark.parametrize(
    ("load", "content", "words"),
    [(load_force_log, *case) for case in BAD_LOGS]
    + [(load_press_table, "\n".join([*lines, ""]), words) for lines, words in BAD_TABLES],
)
def test_what_is_no_table_is_refused_in_one_line(
    tmp_path: Path, load: Callable[[Path], object], content: str | bytes, words: str
) -> None:
    path = written(tmp_path, content)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        load(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 240


def test_files_that_are_not_there_or_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match=r"table\.csv: cannot be read: No such file"):
        load_force_log(tmp_path / "table.csv")
    with pytest.raises(ValueError, match="cannot be read"):
        load_force_log(tmp_path)
    path = written(tmp_path, log_text(ROWS))
    monkeypatch.setattr(tables, "MAX_TABLE_BYTES", path.stat().st_size)
    load_force_log(path)
    monkeypatch.setattr(tables, "MAX_TABLE_BYTES", path.stat().st_size - 1)
    with pytest.raises(ValueError, match=r"more than [0-9]+ bytes"):
        load_force_log(path)


_PIECES = [b"force_g", b",", b";", b'"', b"\n", b"\r", b"\0", b"\xff", b" ", b"\xef\xbb\xbf", b"_"]
_PIECES += [b"0", b"1", b"2.5", b"1e-5", b"-3", b"1e308", b"nan", b"\xe2\x80\xa8", b"a,b\n"]


@pytest.mark.parametrize(
    ("header", "load"), [("time_s,force_n", load_force_log), (HEADER, load_press_table)]
)
@given(draw=st.data())
def test_any_bytes_are_a_table_or_a_value_error_of_one_line(
    tmp_path_factory: pytest.TempPathFactory,
    header: str,
    load: Callable[[Path], object],
    draw: st.DataObject,
) -> None:
    columns = header.count(",") + 1
    numbers = st.lists(st.floats() | st.integers(), min_size=columns, max_size=columns)
    pieces = st.lists(st.sampled_from([*_PIECES, header.encode()]), max_size=60).map(b"".join)
    content = draw.draw(
        st.binary(max_size=200)
        | pieces
        | pieces.map(lambda octets: header.encode() + b"\n" + octets)
        | st.lists(numbers.map(lambda row: ",".join(map(repr, row))), max_size=20).map(
            lambda rows: log_text(rows, header).encode()
        )
    )
    path = written(tmp_path_factory.getbasetemp(), content)
    found, fault = None, "nothing"
    try:
        found = load(path)
    except ValueError as error:
        fault = str(error)
    assert len(fault.splitlines()) == 1
    if isinstance(found, ForceLog):
        assert np.isfinite(found.at(found.time_s)).all()
    elif found is not None:
        assert isinstance(found, np.ndarray)
        assert found.size
        assert (found["force_n"] >= 0).all()


def ramp(count: int = 20, step_s: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    return step_s * np.arange(count), 2.0 * np.arange(count)


def test_noise_about_zero_is_no_fault() -> None:
    time_s, force_n = ramp()
    force_n[3] = -0.02 * force_n.max()
    ForceLog(time_s, force_n)
    force_n[3] *= 1.01
    with pytest.raises(ValueError, match=r"row 3: force_n is .*: zero the sensor"):
        ForceLog(time_s, force_n)
    weak = 0.01 * np.arange(20)
    weak[0] = -0.05
    ForceLog(time_s, weak)


def test_force_between_samples_and_nothing_in_gaps() -> None:
    time_s, force_n = ramp()  # 0 to 1.9 s, 20 N/s
    time_s[10:] += 1.0  # samples at 0.9 and 2.0 s: 1.1 s, 11 median steps
    log = ForceLog(time_s, force_n)
    wanted = np.array([[-0.1, 0.0, 0.05, time_s[9]], [0.91, 1.5, time_s[10], 2.25]])
    nan = np.nan
    np.testing.assert_allclose(log.at(wanted), [[nan, 0, 1, 18], [nan, nan, 20, 25]])
    assert np.isnan(log.at(np.nextafter(time_s[-1], np.inf)))
    assert log.at(time_s[-1]) == force_n[-1]
    assert np.isnan(log.at(np.nan))


@pytest.mark.parametrize(("step_s", "pause_s"), [(0.1, 0.9), (0.01, 0.4), (0.4, 3.0)])
def test_what_is_long_or_unusual_but_not_both_is_no_gap(step_s: float, pause_s: float) -> None:
    time_s, force_n = ramp(step_s=step_s)
    time_s[10:] += pause_s - step_s
    np.testing.assert_allclose(ForceLog(time_s, force_n).at((time_s[9] + time_s[10]) / 2), 19.0)


def test_a_table_is_read_in_any_order_of_columns(tmp_path: Path) -> None:
    found = load_press_table(
        written(tmp_path, "\ufeffconductance,force_n,column,row\n1e-5,2.5,3,0\n0,0,1.0,15\n")
    )
    assert found.dtype == PRESS
    assert found.tolist() == [(0, 3, 2.5, 1e-5, 0.0), (15, 1, 0.0, 0.0, 0.0)]


_CELL = st.integers(0, MAX_LINES - 1)
_SIEMENS = st.floats(0, 1)
_PRESS = st.tuples(_CELL, _CELL, st.floats(0, 1e60), _SIEMENS, _SIEMENS)


@given(st.lists(_PRESS, min_size=1, max_size=20))
def test_a_saved_table_is_a_csv_that_is_read_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[int, int, float, float, float]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    saved = np.array(rows, PRESS)
    save_press_table(path, saved)
    assert load_press_table(path).tobytes() == saved.tobytes()
    lines = path.read_text("ascii").splitlines()
    assert lines[0] == f"{HEADER},conductance_std"
    by_numpy = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    np.testing.assert_array_equal(by_numpy, [list(press) for press in rows])
