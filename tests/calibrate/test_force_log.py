# SPDX-License-Identifier: Apache-2.0
"""Force logs: what is read is what stands there, and whatever else is refused in one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.calibrate import number_table
from ohmskin.calibrate.force_log import ForceLineDecoder, ForceLog, load_force_log

ROWS = [f"{0.1 * k:.1f},{k % 5}" for k in range(12)]


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def log_text(rows: list[str], header: str = "time_s,force_n") -> str:
    return "\n".join([header, *rows]) + "\n"


def ramp(count: int = 20, step_s: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    return step_s * np.arange(count), 2.0 * np.arange(count)


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
    assert log.source == "log.csv"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "empty: it needs the header time_s,force_n"),
        ("\n".join(ROWS), "row 1 holds numbers: put the header time_s,force_n above"),
        (log_text(ROWS, "time_ms,force_n"), "'time_ms': time_s is wanted: multiply it by 0.001"),
        (log_text(ROWS, "time_s,force_g"), "'force_g': force_n is wanted: multiply it by 0.0098"),
        (
            log_text(ROWS, "time_s,Force [kg]"),
            "'Force [kg]': force_n is wanted: multiply it by 9.8",
        ),
        (log_text(ROWS, "time_s,force_mN"), "force_mN': force_n is wanted: multiply it by 0.001"),
        (log_text(ROWS, "Time (s),force_n"), "'Time (s)': time_s is wanted: rename it"),
        (log_text(ROWS, "time_s,Force (µN)").encode("latin-1"), "no column force_n"),
        (log_text(ROWS, "time_s,b"), "no column force_n: the header must hold time_s,force_n"),
        (log_text(ROWS, "time_s,time_s,force_n"), "column time_s stands twice"),
        (log_text(ROWS).replace(",", ";"), "semicolons separate its columns"),
        (log_text(ROWS).replace(",", "\t"), "tabs separate its columns"),
        (log_text(ROWS).encode("utf-16"), "UTF-16: save it as UTF-8"),
        (log_text([*ROWS, "1,3,2,5"]), "row 14 has 4 fields, the header 2"),
        (log_text([*ROWS, "1.3"]), "row 14 has 1 fields, the header 2"),
        (log_text([*ROWS, '1.3,"2,5"']), "row 14: force_n is '2,5', not a number: use a point"),
        (log_text([*ROWS[:4], ",2", *ROWS[4:]]), "row 6: time_s is empty"),
        (log_text([*ROWS[:4], "", "0.35,x", *ROWS[4:]]), "row 7: force_n is 'x', not a number"),
        (log_text([*ROWS, "1.3,nan"]), "row 14: force_n is 'nan', not finite"),
        (log_text([*ROWS, "inf,1"]), "row 14: time_s is 'inf', not finite"),
        (log_text([*ROWS, "1.3,1e300"]), "row 14: force_n is '1e300', beyond 1e+60"),
        (log_text([*ROWS, "1.3,1_0"]), "row 14: force_n is '1_0', not a number"),
        (log_text([*ROWS[:6], "0.4,1", *ROWS[6:]]), "row 8: time_s is 0.4 after 0.5: it must inc"),
        (log_text([*ROWS[:6], ROWS[5], *ROWS[6:]]), "row 8: time_s is 0.5 after 0.5: it must inc"),
        (log_text(ROWS[:9]), "9 samples are too few: 10 are needed"),
        (log_text(["0,1"]), "1 sample is too few"),
        (log_text([f"{k},2.5" for k in range(12)]), "force_n is 2.5 throughout"),
        (log_text([f"{k},{-(k % 5)}" for k in range(12)]), "a press is negative: turn the sign"),
        (log_text([*ROWS, "1.3,-0.5"]), "row 14: force_n is -0.5, below -0.08 N: zero the sensor"),
        (log_text([*ROWS, '1.3,"2']), "row 14 is damaged: unexpected end of data"),
        (log_text([*ROWS, "1.3," + 200_000 * "1"]), "row 14 is damaged: field larger than"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(
    tmp_path: Path, content: str | bytes, words: str
) -> None:
    path = written(tmp_path, content)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        load_force_log(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 200


def test_files_that_are_not_there_or_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match=r"log\.csv: cannot be read: No such file"):
        load_force_log(tmp_path / "log.csv")
    with pytest.raises(ValueError, match="cannot be read"):
        load_force_log(tmp_path)
    path = written(tmp_path, log_text(ROWS))
    monkeypatch.setattr(number_table, "MAX_FILE_BYTES", path.stat().st_size)
    load_force_log(path)
    monkeypatch.setattr(number_table, "MAX_FILE_BYTES", path.stat().st_size - 1)
    with pytest.raises(ValueError, match=r"more than [0-9]+ bytes"):
        load_force_log(path)


_PIECES = [b"time_s", b"force_n", b"force_g", b",", b";", b'"', b"\n", b"\r", b"\0", b"\xff", b" "]
_PIECES += [b"1", b"2.5", b"-3", b"1e308", b"nan", b"_", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b"a,b\n"]


@given(
    st.binary(max_size=200)
    | st.lists(st.sampled_from(_PIECES), max_size=60).map(b"".join)
    | st.lists(st.sampled_from(_PIECES[3:]), max_size=60).map(
        lambda pieces: b"time_s,force_n\n" + b"".join(pieces)
    )
    | st.lists(st.floats() | st.integers(), min_size=20, max_size=40).map(
        lambda numbers: log_text(
            [f"{a},{b}" for a, b in zip(numbers[::2], numbers[1::2], strict=False)]
        ).encode()
    )
)
def test_any_bytes_are_a_log_or_a_value_error_of_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = written(tmp_path_factory.getbasetemp(), content)
    log, fault = None, "nothing"
    try:
        log = load_force_log(path)
    except ValueError as error:
        fault = str(error)
    assert len(fault.splitlines()) == 1
    assert log is None or np.isfinite(log.at(log.time_s)).all()


def test_noise_about_zero_is_no_fault() -> None:
    time_s, force_n = ramp()
    force_n[3] = -0.02 * force_n.max()
    ForceLog(time_s, force_n, "")
    force_n[3] *= 1.01
    with pytest.raises(ValueError, match=r"sample 3: force_n is .*: zero the sensor"):
        ForceLog(time_s, force_n, "")
    weak = 0.01 * np.arange(20)
    weak[0] = -0.05
    ForceLog(time_s, weak, "")


def test_force_between_samples_and_nothing_in_gaps() -> None:
    time_s, force_n = ramp()  # 0 to 1.9 s, 20 N/s
    time_s[10:] += 1.0  # samples at 0.9 and 2.0 s: 1.1 s, 11 median steps
    log = ForceLog(time_s, force_n, "")
    np.testing.assert_allclose(log.gaps, [[0.9, 2.0]])
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
    log = ForceLog(time_s, force_n, "")
    assert log.gaps.shape == (0, 2)
    np.testing.assert_allclose(log.at((time_s[9] + time_s[10]) / 2), 19.0)


@pytest.mark.parametrize(
    ("line", "forces"),
    [
        (b"12.34\r\n", [12.34]),
        (b"-0.5\n", [-0.5]),
        (b" +3 N\r", [3.0]),
        (b".5N\n", [0.5]),
        (b"1.5e1\n", [15.0]),
        (b"\r\n\r\n", []),
    ],
)
def test_a_line_with_one_number_is_a_force(line: bytes, forces: list[float]) -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"4.2\r\n" + line) == forces
    assert decoder.damaged == 0


@pytest.mark.parametrize(
    "line",
    [
        *(b"Reading: 12.3 g", b"12.3 g", b"1,5", b"1 2", b"nan", b"1e999", b"--1", b"\xff", b"1_0"),
        *(b".", b"1" * 65, b"x" * 100_000),
    ],
)
def test_another_line_is_counted_and_the_next_is_read(line: bytes) -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"\n" + line + b"\r\n7\r\n") == [7.0]
    assert decoder.damaged == 1


def test_the_first_line_may_be_a_part_and_counts_for_nothing() -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"x" * 1000) == []
    assert decoder.feed(b"4.1\r\n5.1\r\n6") == [5.1]
    assert decoder.feed(b".1\r") == [6.1]
    assert decoder.damaged == 0


@given(
    st.lists(
        st.sampled_from([b"1.5", b"-2 N", b"x", b"\r\n", b"\n", b"9" * 70, b" "]), max_size=30
    ),
    st.integers(1, 80),
)
def test_lines_do_not_depend_on_how_they_come(pieces: list[bytes], size: int) -> None:
    octets = b"".join([*pieces, b"\n"])
    decoder = ForceLineDecoder()
    found = [
        force_n
        for start in range(0, len(octets), size)
        for force_n in decoder.feed(octets[start : start + size])
    ]
    lines = [line.strip() for line in re.split(rb"[\r\n]", octets)[1:] if line.strip()]
    forces = {b"1.5": 1.5, b"-2 N": -2.0}
    assert found == [forces[line] for line in lines if line in forces]
    assert decoder.damaged == len([line for line in lines if line not in forces])


def test_a_line_without_end_takes_no_memory() -> None:
    decoder = ForceLineDecoder()
    decoder.feed(b"\n")
    for _ in range(1000):
        decoder.feed(b"1" * 1000)
        assert len(decoder._line) <= ForceLineDecoder.LARGEST_LINE
    assert decoder.damaged == 1
