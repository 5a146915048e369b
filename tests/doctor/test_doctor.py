# SPDX-License-Identifier: Apache-2.0
"""`ohmskin doctor`: every emulated fault is named, and none on a sound skin.

Most boards here run in simulated time. A finding is asked for by its fault's own option, and
everything else that is found besides is a failure, too.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import serial

import ohmskin
from bench_board import Bench, examined
from calibrations import calibration
from command_line import Done, assert_one_line
from ohmskin.cli import doctor as doctor_command
from ohmskin.doctor.examine import Examined, examine
from ohmskin.doctor.findings import ORDER, SEVERITIES, Diagnosis, Finding, in_order
from ohmskin.doctor.signal import RestScans, comparison, examine_signal, find_hum, mean_std_lsb
from ohmskin.emulate.pty_server import PtyServer
from ohmskin.emulate.scenes import Scene
from ohmskin.link import protocol, session
from ohmskin.link.messages import BoardStats, DecoderStats, SelfTestReport
from ohmskin.link.serial_port import latency_ms, latency_timer_file

NOISES = (0.0, 0.1, 0.3, 0.5)


def found(url: str, **changes: object) -> list[tuple[str, str]]:
    """Identity and place of each finding."""
    return [(each.id, each.where) for each in examine(examined(url, **changes)).findings]


def at_rest(seed: int, rows: int, columns: int) -> np.ndarray:
    return Scene("rest", rows, columns, seed=seed).ratio(0.0)


# ------------------------------------------------------------------------------- sound skins


SIZES = [(1, 1), (1, 2), (2, 1), (1, 16), (16, 1), (2, 2), (3, 3), (2, 5), (5, 2), (8, 8), (4, 12)]


@pytest.mark.parametrize(("rows", "columns"), [*SIZES, (16, 16)])
def test_a_sound_skin_has_no_finding(rows: int, columns: int) -> None:
    for seed, noise in enumerate(NOISES):
        url = f"emulator://{rows}x{columns}?seed={seed}&noise={noise}"
        told = {"wire_ohm": (100.0, 200.0), "rest_ratio": at_rest(seed, rows, columns)}
        diagnosis = examine(examined(url, **(told if seed % 2 else {})))
        assert diagnosis.findings == (), url
        assert diagnosis.verdict.startswith("sound: nothing is wrong")
        unknown = diagnosis.measured["wires"].startswith("not known")
        assert ("that an untouched skin shows" in diagnosis.verdict) is unknown
        assert diagnosis.measured["reference_ratio"] == pytest.approx(1, abs=0.03)
        assert diagnosis.measured["noise_lsb"] < 0.8


@pytest.mark.parametrize("rate", [1, 3, 25, 50, 60, 100, 0])
def test_a_sound_skin_has_no_finding_at_any_rate(rate: int) -> None:
    for size in ("2x3", "8x8"):
        diagnosis = examine(examined(f"emulator://{size}?rate={rate}&noise=0.5"))
        assert diagnosis.findings == (), (size, rate)


@pytest.mark.parametrize("scene", ["single", "ghost", "multi", "moving", "press"])
def test_a_touch_is_said_and_is_no_fault(scene: str) -> None:
    for seed, size in enumerate(("2x3", "8x8")):
        bench = Bench(f"emulator://{size}?scene={scene}&seed={seed}")
        bench.now_s = 5.0  # the robot of "press" is on the skin
        bench.board.advance(bench.now_s)
        diagnosis = examine(bench.examined())
        assert [each.id for each in diagnosis.findings] == ["touched"], (scene, size)
        assert not diagnosis.wrong
        assert "something touches the skin" in diagnosis.verdict


def test_touched_cells_are_named() -> None:
    assert found("emulator://8x8?scene=single") == [("touched", "cell (4, 4)")]
    assert found("emulator://1x1?scene=single") == [("touched", "cell (0, 0)")]
    assert found("emulator://4x4?scene=ghost") == [("touched", "cells (1, 1), (1, 2), (2, 1)")]


# ------------------------------------------------------------------------------------ faults


FAULTS = {
    "open_row=3": ("open_row", "row 3"),
    "open_column=5": ("open_column", "column 5"),
    "short_rows=2,3": ("short_rows", "rows 2 and 3"),
    "short_rows=7,0": ("short_rows", "rows 0 and 7"),
    "short_columns=4,6": ("short_columns", "columns 4 and 6"),
    "dead=1,2": ("dead_cell", "cell (1, 2)"),
    "saturated=1,2": ("saturated_cell", "cell (1, 2)"),
    "saturated=7,7": ("saturated_cell", "cell (7, 7)"),
    "ref_top=33000": ("reference_ratio", "reference resistors"),
    "ref_bottom=28500": ("reference_ratio", "reference resistors"),
    "noise=1": ("noise", "whole skin"),
    "noise=3": ("noise", "whole skin"),
    "hum=50": ("hum", "whole skin"),
    "hum=60&hum_lsb=1": ("hum", "whole skin"),
    "tau_us=10": ("settling", "whole skin"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_named_and_no_other(fault: str) -> None:
    for seed in (0, 1):
        noise = "" if fault.startswith("noise") else f"&noise={NOISES[3 * seed]}"
        assert found(f"emulator://8x8?{fault}&seed={seed}{noise}") == [FAULTS[fault]]


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("3x1?short_rows=0,2", ("short_rows", "rows 0 and 2")),
        ("2x6?short_rows=0,1", ("short_rows", "rows 0 and 1")),
        ("16x16?short_columns=0,15", ("short_columns", "columns 0 and 15")),
        ("16x16?dead=15,15", ("dead_cell", "cell (15, 15)")),
        ("2x2?dead=0,1", ("dead_cell", "cell (0, 1)")),
        ("16x16?saturated=15,15", ("saturated_cell", "cell (15, 15)")),
        ("1x1?saturated=0,0", ("saturated_cell", "cell (0, 0)")),
        ("2x2?open_row=1", ("open_row", "row 1")),
        ("4x1?open_row=2", ("open_row", "row 2 (or the only cell there is dead)")),
        ("1x1?open_row=0", ("nothing_conducts", "the only cell, its row or its column")),
        ("1x3?open_row=0", ("nothing_conducts", "every row and column")),
        ("1x1?ref_top=36000", ("reference_ratio", "reference resistors")),
        ("1x1?hum=50", ("hum", "whole skin")),
        ("16x16?hum=60", ("hum", "whole skin")),
        ("16x16?tau_us=8", ("settling", "whole skin")),
        ("1x1?noise=2", ("noise", "whole skin")),
    ],
)
def test_faults_of_skins_large_and_small(url: str, expected: tuple[str, str]) -> None:
    assert found(f"emulator://{url}") == [expected]


def test_several_faults_come_in_the_order_in_which_they_matter() -> None:
    url = "emulator://8x8?dead=1,2&open_column=5&short_rows=6,7&ref_top=33000&hum=50"
    assert found(url) == [
        ("open_column", "column 5"),
        ("short_rows", "rows 6 and 7"),
        ("dead_cell", "cell (1, 2)"),
        ("reference_ratio", "reference resistors"),
        ("hum", "whole skin"),
    ]


def test_faults_are_found_beside_a_touch() -> None:
    for fault in ("open_row=3", "short_rows=2,3", "saturated=1,2", "dead=1,2"):
        url = f"emulator://8x8?scene=single&{fault}"
        assert found(url) == [FAULTS[fault], ("touched", "cell (4, 4)")]


def test_lines_that_are_not_there_are_one_finding() -> None:
    bench = Bench("emulator://4x6")
    wanted = {"rows": 7, "columns": 6, "rate_mhz": 0, "settle_us": 0}
    bench.ask("configure", adc_prescaler="clock_500khz", **wanted)
    [finding] = examine(bench.examined()).findings
    assert (finding.id, finding.where) == ("open_row", "rows 4, 5, 6")
    assert "'ohmskin configure PORT --rows 4'" in finding.what_to_do


# ------------------------------------------------------------- hum, noise, settling: figures


@pytest.mark.parametrize("rate", [90, 100, 110, 120, 37.6, 143])
def test_hum_is_told_from_the_other_mains_at_any_rate(rate: float) -> None:
    """At 110 scans/s both mains look like 50 Hz, at 37.6 both like 13 to 15 Hz; at 100 and
    120 one of them is half the rate, where only a part of each sine is seen.
    """
    for mains in ("50", "60"):
        diagnosis = examine(examined(f"emulator://8x8?rate={rate}&hum={mains}&hum_lsb=2"))
        [finding] = diagnosis.findings
        assert finding.measured.startswith(f"{mains} Hz of amplitude 2.0 LSB")
        assert diagnosis.measured["noise_lsb"] < 0.6


def test_what_hum_looks_like() -> None:
    measured = {
        mains: examine(examined(f"emulator://8x8?hum={mains}")).findings[0].measured
        for mains in (50, 60)
    }
    assert measured[50].endswith("looks like 40.0 Hz")
    assert measured[60].endswith("looks like 30.0 Hz")


def test_hum_that_stands_still_shows_at_another_rate() -> None:
    for rate in (25, 50):
        url = f"emulator://8x8?rate={rate}&hum=50&hum_lsb=2"
        bench = Bench(url)
        alone = replace(bench.examined(), settled=None)
        assert 50.0 in examine(alone).measured["hum_not_visible"]
        assert ("hum", "whole skin") in found(url)


def test_hum_is_not_seen_in_noise_or_in_other_tones() -> None:
    for noise in (1.0, 3.0, 10.0):
        assert "hum" not in [name for name, _ in found(f"emulator://4x4?noise={noise}")]
    for hz in (41.0, 45.0, 55.0, 65.0, 77.0):
        assert "hum" not in [name for name, _ in found(f"emulator://4x4?hum={hz}&hum_lsb=3")]


def rest_of(url: str, scans: int = 0) -> RestScans:
    read = examined(url)
    codes = np.stack([scan.codes for scan in read.scans]).astype(float)
    return RestScans(read.board, codes, np.array([1e-6 * scan.time_us for scan in read.scans]))


def test_noisy_lines_and_cells_are_named() -> None:
    rest = rest_of("emulator://6x5")
    random = np.random.default_rng(1)
    for place, where in (
        (np.s_[:, 3], "row 3"),
        (np.s_[:, :, 1], "column 1"),
        (np.s_[:, 2, 4], "cell (2, 4)"),
    ):
        codes = rest.codes.copy()
        codes[place] += np.round(3 * random.standard_normal(codes[place].shape))
        [finding] = examine_signal(replace(rest, codes=codes)).findings
        assert (finding.id, finding.where) == ("noise", where)
        assert float(finding.measured.split()[0]) == pytest.approx(3.05, abs=0.25)


def test_noise_is_measured_beside_hum_and_drift() -> None:
    rest = rest_of("emulator://6x5?noise=0.5&hum=50")
    drift = np.linspace(0, 2, len(rest.codes))[:, None, None, None]
    signal = examine_signal(replace(rest, codes=rest.codes + drift))
    assert signal.noise_lsb == pytest.approx((0.5**2 + 1 / 12) ** 0.5, rel=0.1)
    hum = find_hum(rest)
    assert hum is not None
    assert hum.lsb == pytest.approx(3.0, rel=0.05)


def test_deviation_of_a_mean_of_codes() -> None:
    """Against means of simulated codes over all places within a code."""
    random = np.random.default_rng(2)
    for before in (0.0, 0.2, 0.4, 1.0):
        places = random.uniform(100, 101, 400)
        exact = places[:, None] + before * random.standard_normal((400, 50))
        errors = np.floor(exact).mean(axis=1) + 0.5 - places
        noise = (before**2 + 1 / 12) ** 0.5
        assert mean_std_lsb(noise, 50) == pytest.approx(errors.std(), rel=0.35)


def test_settling_says_how_long_is_enough() -> None:
    for tau in (10, 15, 20):
        url = f"emulator://8x8?tau_us={tau}"
        [finding] = examine(examined(url)).findings
        enough_us = int(finding.what_to_do.partition("--settle ")[2].split()[0])
        bench = Bench(url)
        wanted = {"rows": 8, "columns": 8, "rate_mhz": 0, "settle_us": enough_us}
        bench.ask("configure", adc_prescaler="clock_500khz", **wanted)
        assert examine(bench.examined()).findings == ()
        assert enough_us < 12 * tau


def test_second_look_is_what_a_board_takes() -> None:
    for url in ("1x1", "1x1?rate=50", "2x2?rate=1", "16x16", "16x16?rate=1", "16x16?rate=0", "8x8"):
        bench = Bench(f"emulator://{url}")
        board = bench.hello()
        other = comparison(board)
        if other is None:
            assert board.settle_us * 1.2 >= 3000
            continue
        wanted = {"rate_mhz": protocol.rate_mhz(other[1]), "settle_us": other[0]}
        size = {"rows": board.rows, "columns": board.columns}
        bench.ask("configure", adc_prescaler=board.adc_prescaler, **size, **wanted)
        assert bench.hello().settle_asked_us == other[0]
        assert bench.hello().rate_hz >= min(1.0, 0.7 * board.rate_hz)


# ------------------------------------------------------------------------------------- wires


def test_wires_show_against_an_earlier_rest() -> None:
    for rows, factor in ((16, 3.0), (8, 10.0)):
        told = {"wire_ohm": (100.0, 200.0), "rest_ratio": at_rest(3, rows, rows)}
        diagnosis = examine(examined(f"emulator://{rows}x{rows}?seed=3&wires={factor}", **told))
        assert {each.id for each in diagnosis.findings} == {"wires"}
        lines = diagnosis.measured["wires_of_lines"]
        assert len(lines) == 2 * rows
        assert lines[rows].startswith("column 0: ")
        share, std = (float(lines[-1].split()[at]) for at in (2, 4))
        assert abs(share - factor) < 4 * std
        for finding in diagnosis.findings:
            ohm, std = (float(finding.measured.split()[at]) for at in (0, 2))
            nominal = 200.0 if "bottom" in finding.where else 100.0
            assert abs(ohm - factor * nominal) < 4 * std


def test_an_untouched_skin_alone_says_nothing_of_its_wires() -> None:
    diagnosis = examine(examined("emulator://8x8?wires=1.5", wire_ohm=(100.0, 200.0)))
    assert diagnosis.findings == ()
    assert diagnosis.measured["wires"].startswith("not known")


# ---------------------------------------------------------------------------- board and link


@pytest.fixture(scope="module")
def sound() -> Examined:
    return examined("emulator://4x4")


def findings_of(read: Examined, **changes: object) -> list[Finding]:
    return list(examine(replace(read, **changes)).findings)


def test_what_the_board_says_of_itself(sound: Examined) -> None:
    for cause in ("brown_out", "watchdog"):
        board = replace(sound.board, reset_cause=(cause,))
        [finding] = findings_of(sound, board=board)
        assert (finding.id, finding.severity) == ("reset_cause", "warning")
        assert cause.replace("_", "-") in finding.measured
    report = SelfTestReport(("bottom_stuck_low", "top_reference_missing"), (0,) * 4, (9,) * 4)
    first, second = findings_of(sound, report=report)
    assert (first.id, first.where) == ("self_test", "bottom sense node")
    assert "short to ground" in first.what_to_do
    assert second.where == "top sense node"
    [finding] = findings_of(sound, host_version="9.9.9")
    assert (finding.id, finding.severity) == ("version", "note")


def test_counts_of_the_line(sound: Examined) -> None:
    for name, stats in (
        ("loss", BoardStats(scans=100, missed=3, dropped_by_board=2)),
        ("damaged", BoardStats(scans=100, line=DecoderStats(crc_errors=2))),
        ("receive_errors", BoardStats(scans=100, board_rx_errors=1)),
        ("restarted", BoardStats(scans=100, restarts=2)),
    ):
        [finding] = findings_of(sound, stats=stats)
        assert (finding.id, finding.severity) == (name, "warning")
    [finding] = findings_of(sound, scans=sound.scans[:1])
    assert (finding.id, finding.where) == ("loss", "line")


def test_faults_of_the_line_are_found() -> None:
    for fault, expected in (
        ("drop=0.05", {"loss"}),
        ("bitflip=1e-5", {"loss", "damaged"}),
        ("garbage=0.1", {"damaged"}),
    ):
        assert {name for name, _ in found(f"emulator://8x8?{fault}")} == expected


def test_a_rate_that_is_not_kept(sound: Examined) -> None:
    late = [replace(scan, time_us=round(1.02 * scan.time_us)) for scan in sound.scans]
    [finding] = findings_of(sound, scans=late, settled=None)
    assert (finding.id, finding.measured) == ("rate", "88.24 scans/s by the board's clock")
    slow = [replace(scan, host_time_s=1.3 * scan.host_time_s) for scan in sound.scans]
    [finding] = findings_of(sound, scans=slow)
    assert (finding.id, finding.severity) == ("slow_host", "note")


def test_latency_timer(tmp_path: Path, sound: Examined) -> None:
    devices = tmp_path / "devices"
    (devices / "ttyUSB3").mkdir(parents=True)
    timer = devices / "ttyUSB3" / "latency_timer"
    timer.write_text("16\n")
    by_id = tmp_path / "by-id"
    by_id.symlink_to("/dev/ttyUSB3")
    for port in ("/dev/ttyUSB3", str(by_id)):
        assert latency_timer_file(port, devices) == timer
        assert latency_ms(port, devices) == 16
    assert latency_ms("/dev/ttyACM0", devices) is None
    timer.write_text("no number")
    assert latency_ms("/dev/ttyUSB3", devices) is None
    [finding] = findings_of(sound, latency=(16, str(timer)))
    assert (finding.id, finding.severity) == ("usb_latency", "note")
    assert str(timer) in finding.what_to_do
    assert findings_of(sound, latency=(1, str(timer))) == []


def test_order_and_verdict() -> None:
    made = [Finding(name, each, "x", "", "", "") for name in ORDER for each in SEVERITIES]
    ordered = in_order(reversed(made))
    assert [each.severity for each in ordered] == [s for s in SEVERITIES for _ in ORDER]
    assert [each.id for each in ordered] == list(ORDER) * len(SEVERITIES)
    assert Diagnosis(ordered[:1], {}).verdict == "not sound: 1 finding, first port unusable (x)"
    assert not Diagnosis(ordered[-1:], {}).wrong
    with pytest.raises(ValueError, match="no finding"):
        Finding("cold", "fault", "", "", "", "")


# ------------------------------------------------------------------------------ command line


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_command, "REST_S", 0.2)
    monkeypatch.setattr(doctor_command, "SETTLED_S", 0.05)
    monkeypatch.setattr(session, "CONNECT_TIMEOUT_S", 0.3)


Run = Callable[..., Done]


def test_a_sound_board_in_full(run: Run) -> None:
    begin_s = time.monotonic()
    done = run("doctor", "emulator://8x8")
    assert time.monotonic() - begin_s < 10
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("emulator://8x8: sound: nothing is wrong that an untouched")


@pytest.mark.usefixtures("hasty")
def test_page_and_json(run: Run) -> None:
    url = "emulator://8x8?open_row=3&dead=1,2"
    done = run("doctor", url)
    assert (done.code, done.err) == (1, "")
    lines = done.out.splitlines()
    assert lines[0] == f"{url}: not sound: 2 findings, first open row (row 3)"
    assert done.out.index("1. fault, open row: row 3") < done.out.index("2. fault, dead cell")
    assert "what to do  check connector, crimp" in done.out
    done = run("doctor", url, "--json")
    answer = json.loads(done.out)
    assert (done.code, done.err) == (1, "")
    assert done.out.count("\n") == 1
    assert answer["sound"] is False
    assert [each["id"] for each in answer["findings"]] == ["open_row", "dead_cell"]
    for each in answer["findings"]:
        assert set(each) == {"id", "severity", "where", "measured", "expected", "what_to_do"}
        assert all(each.values())
    assert answer["measured"]["rows"] == 8


@pytest.mark.usefixtures("hasty")
def test_ports_that_do_not_answer_are_findings(
    run: Run, pty_board: Callable[[str], PtyServer]
) -> None:
    path = pty_board("emulator://2x2").path
    with serial.Serial(path, exclusive=True):
        busy = json.loads(run("doctor", path, "--json").out)["findings"]
    assert [each["id"] for each in busy] == ["port_unusable"]
    assert "busy" in busy[0]["measured"]
    assert "close the other program" in busy[0]["what_to_do"]
    for url, name, word in (
        ("emulator://2x2?silent=1", "nothing_answers", "nothing answers: "),
        ("emulator://2x2?foreign=1", "protocol_mismatch", "layout 0x"),
        ("emulator://2x2?vanish=0.2", "lost", "gone"),
        ("/dev/ttyACM99", "port_unusable", "no port"),
    ):
        done = run("doctor", url, "--json")
        answer = json.loads(done.out)
        assert (done.code, done.err) == (1, "")
        assert answer["findings"][0]["id"] == name
        assert word in answer["findings"][0]["measured"]
        assert "not sound" in answer["verdict"]


def test_a_wrong_use_is_one_line(run: Run, tmp_path: Path) -> None:
    assert_one_line(run("doctor", "emulator://8x8?speed=1"), "no option 'speed'")
    assert_one_line(run("doctor", "emulator://8x8", "--wires", "100"), "two numbers")
    assert_one_line(run("doctor", "emulator://8x8", "--wires", "100,-1"), "above 0")
    assert_one_line(run("doctor", "emulator://8x8", "--calibration", "/no/such.json"), "/no/such")
    calibration(at_rest(0, 2, 3)).save(tmp_path / "skin.json")
    assert_one_line(
        run("doctor", "emulator://8x8", "--calibration", str(tmp_path / "skin.json")), "2x3", "8x8"
    )


@pytest.mark.usefixtures("hasty")
def test_a_calibration_is_compared_with(run: Run, tmp_path: Path) -> None:
    calibration(at_rest(5, 8, 8)).save(tmp_path / "skin.json")
    url = "emulator://8x8?seed=5&wires=30"
    done = run("doctor", url, "--calibration", str(tmp_path / "skin.json"), "--json")
    names = [each["id"] for each in json.loads(done.out)["findings"]]
    assert set(names) == {"wires"}
    assert done.code == 1


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("end", ["done", "ctrl-c", "error"])
def test_the_board_is_left_as_it_was(
    end: str, pty_board: Callable[[str], PtyServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = pty_board("emulator://3x4").path
    with ohmskin.open(path, start=False) as skin:
        before = skin.configure(rate_hz=77.5, settle_us=120, adc_prescaler="clock_250khz")
    seen: list[int] = []

    def scan(device: ohmskin.Device, scans: list[ohmskin.Scan], seconds: float) -> None:
        seen.append(device.info.settle_us)
        if len(seen) == 2 and end != "done":
            raise KeyboardInterrupt if end == "ctrl-c" else RuntimeError("a defect")

    monkeypatch.setattr(doctor_command, "_scan", scan)
    if end == "done":
        doctor_command.diagnose(path)
    else:
        with pytest.raises((KeyboardInterrupt, RuntimeError)):
            doctor_command.diagnose(path)
    assert seen[1] > 3 * seen[0]
    with ohmskin.open(path, start=False) as skin:
        assert skin.info == before


@pytest.mark.usefixtures("hasty")
def test_progress_is_shown_at_a_terminal_alone(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    assert run("doctor", "emulator://2x2").code == 0
    assert "scanning the untouched skin" in terminal.getvalue()
    monkeypatch.setattr("sys.stderr", quiet := io.StringIO())
    assert json.loads(run("doctor", "emulator://2x2", "--json").out)["sound"] is True
    assert quiet.getvalue() == ""


@pytest.mark.simavr
@pytest.mark.usefixtures("hasty")
def test_the_firmware_is_sound(run: Run) -> None:
    done = run("doctor", "simavr://uno", "--json")
    answer = json.loads(done.out)
    assert answer["sound"], answer["findings"]
    assert done.code == 0
    assert answer["measured"]["settling_lsb"] < 1
    assert {each["id"] for each in answer["findings"]} <= {"slow_host"}
