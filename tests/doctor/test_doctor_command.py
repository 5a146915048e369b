# SPDX-License-Identifier: Apache-2.0
"""``ohmskin doctor`` as a command: what it asks for, what it prints, what it leaves behind."""

import json
import re
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import serial
from rich.console import Console
from rich.status import Status

import ohmskin
from calibrations import calibration
from command_line import Run, assert_one_line, well
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.cli.doctor_words import measured_in_words
from ohmskin.doctor import gather as gathering
from ohmskin.doctor.examine import examine
from ohmskin.doctor.gather import Step, gather
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import LEAD_OHM, Scene
from ohmskin.emulate.simavr import SimavrLink
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import load_calibration
from ohmskin.link import session
from ohmskin.link.session import Session
from ports import Serve
from recordings import write_recording
from stepped import stepped, stepped_link


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """For boards in real time."""
    monkeypatch.setattr(gathering, "SETTLED_S", 0.05)
    monkeypatch.setattr(session, "ATTEMPTS", session.ATTEMPTS[:1])


def test_a_sound_board_takes_less_than_ten_seconds(run: Run, benches: list[SteppedSkin]) -> None:
    done = well(run("doctor", "emulator://8x8"))
    assert done.out.startswith("emulator://8x8: sound: nothing is wrong that an untouched")
    assert benches[0].now_s < 5  # and a second or two to connect


@pytest.mark.usefixtures("benches")
def test_page_and_json(run: Run) -> None:
    url = "emulator://8x8?open_row=3&dead=1,2"
    done = run("doctor", url)
    assert (done.code, done.err) == (1, "")
    lines = done.out.splitlines()
    assert lines[0] == f"{url}: not sound: 2 findings, first open row (row 3)"
    assert done.out.index("1. fault, open row: row 3") < done.out.index("2. fault, dead cell")
    assert "   what to do  check connector, crimp" in done.out
    done = run("doctor", url, "--json")
    answer = json.loads(done.out)
    assert (done.code, done.err) == (1, "")
    assert done.out.count("\n") == 1
    assert answer["sound"] is False
    assert [each["id"] for each in answer["findings"]] == ["open_row", "dead_cell"]
    for each in answer["findings"]:
        for name in ("severity", "where", "measured", "expected", "what_to_do"):
            assert each[name]
    row, cell = answer["findings"]
    assert row["place"]["rows"] == [3]
    assert row["values"] == {"line_count": 8, "cells_per_line": 8}
    assert cell["place"]["cells"] == [[1, 2]]
    assert answer["measured"]["rows"] == 8


@pytest.mark.usefixtures("benches")
def test_all_that_is_listed_is_counted(run: Run) -> None:
    done = run("doctor", "emulator://8x8?open_row=3&scene=single&begin=0")
    assert "not sound: 1 finding and 1 note, first open row" in done.out
    assert "2. note, touched" in done.out


@pytest.mark.usefixtures("benches")
def test_what_no_longer_settle_time_has_shown_is_not_known(run: Run) -> None:
    """At 1 Hz, the settle time is as long as any."""
    slow = "emulator://8x8?rate=1"
    assert re.search(r"\nsettling_lsb +not known\n", well(run("doctor", slow)).out)
    assert json.loads(run("doctor", slow, "--json").out)["measured"]["settling_lsb"] is None


def test_wires_are_measured_where_somebody_presses(run: Run, benches: list[SteppedSkin]) -> None:
    arguments = ("emulator://8x8?scene=corners&wires=1.5", "--wires", "100,200", "--press")
    done = run("doctor", *arguments, "--json")
    assert benches[0].now_s < 18
    assert done.code == 1
    [finding] = json.loads(done.out)["findings"]
    assert (finding["id"], finding["where"]) == ("wires", "rows and columns")
    assert finding["values"]["share"]["share"] == pytest.approx(1.5, rel=0.15)
    # Where no terminal is, each request is said once.
    assert done.err.splitlines() == [
        "press firmly, at once: (4, 4) (4, 7) (7, 4)",
        "now (2, 5) (5, 2) (5, 5)",
        "keep pressing",
    ]


@pytest.mark.parametrize(("tau_us", "slow"), [(0, False), (5, False), (8, True), (10, True)])
def test_slow_nodes_are_seen_while_pressed(
    run: Run, benches: list[SteppedSkin], tau_us: int, slow: bool
) -> None:
    url = f"emulator://8x8?scene=corners&tau_us={tau_us}&noise=0.5"
    answer = json.loads(run("doctor", url, "--press", "--json").out)
    found = [(each["id"], each["where"]) for each in answer["findings"]]
    assert found == ([("settling", "whole skin")] if slow else [])
    assert (answer["measured"]["settling_pressed_lsb"] > 4) == slow
    if slow:
        [finding] = answer["findings"]
        assert finding["measured"].startswith("nodes settle too slowly: pressed, readings change")
        needed_us = finding["values"]["needed_us"]
        assert f"--settle {needed_us} --rate 0" in finding["what_to_do"]
        # What it says to do is enough: half a code of 1024 is left after so many time constants.
        assert np.log(1024 / 0.5) - 2 < needed_us / tau_us < 1.5 * np.log(1024 / 0.5)


class PressedWhenAsked(Scene):
    """Its corners are pressed once somebody is asked to press, however busy the machine was."""

    asked = False

    def skin(self, time_s: float) -> Skin:
        return super().skin(time_s if self.asked else -1.0)

    def report(self, step: Step, _: object) -> None:
        self.asked |= step is Step.PRESSES


@pytest.mark.simavr
def test_wires_of_the_simulated_desk_are_measured() -> None:
    """Behind a boot loader, in real time."""
    scene = PressedWhenAsked("corners", 8, 8, seed=1)
    with Session(SimavrLink("uno", scene, settings={"desk": "1", "seed": "1"})) as skin:
        diagnosis = examine(gather(skin, scene.report, WireOhm(100.0, 200.0, LEAD_OHM), press=True))
    assert [each.kind.id for each in diagnosis.findings] == ["settling"]  # 100 pF a line
    share, _, std = measured_in_words(diagnosis)["wires"].split()[:3]
    assert float(std) <= 0.06
    assert abs(float(share) - 1) < 3 * float(std)


def test_drift_of_a_press_is_no_slow_node() -> None:
    """The resistance of all corners falls by a tenth meanwhile."""
    scene = Scene("corners", 8, 8)
    pressed = scene.skin(9.0)

    def ratio(time_s: float, _mode: str) -> Float:
        siemens = scene.skin(min(time_s, 5.0)).cell_siemens
        if time_s > 5.5:
            moved = (4, 4) if time_s < 7.5 else (2, 2)
            siemens = siemens.copy()
            for cell in (moved, (4, 2), (2, 4)):
                siemens[cell] = (1 + 0.02 * (time_s - 5.5)) / 6e3
        return readings(replace(pressed, cell_siemens=siemens))

    evidence = gather(stepped(EmulatedBoard(ratio, BoardSettings(), noise_lsb=0.3)), press=True)
    assert len(evidence.pressed) == 10
    assert examine(evidence).findings == []


@pytest.mark.usefixtures("benches")
def test_a_terminal_shows_progress_and_what_is_pressed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(Console, "is_terminal", True)
    monkeypatch.setattr(Status, "update", lambda _, text: said.append(text))
    assert run("doctor", "emulator://4x4?scene=corners", "--press").code == 0
    first = "press firmly, at once: (1, 1) (1, 3) (3, 1)"
    assert list(dict.fromkeys(said)) == [
        "self-test",
        "scanning the untouched skin for 2.5 s",
        "scanning with a longer settle time",
        f"{first}; pressed: nothing",
        f"{first}; hold still",
        "now (1, 2) (2, 1) (2, 2); pressed: (1, 1) (1, 2) (2, 1)",
        "now (1, 2) (2, 1) (2, 2); hold still",
        "keep pressing; comparing settle times",
    ]


def test_nobody_presses(run: Run, benches: list[SteppedSkin]) -> None:
    done = run("doctor", "emulator://2x3?rate=10", "--press", "--json")
    answer = json.loads(done.out)
    assert done.code == 1
    assert answer["sound"] is False
    assert answer["findings"] == []
    assert "nobody pressed" in answer["verdict"]
    assert answer["measured"]["wires"] == "not known: no three corners of a rectangle were pressed"
    assert benches[0].now_s < 40
    done = run("doctor", "emulator://8x8?scene=single&begin=0", "--press", "--json")
    answer = json.loads(done.out)
    assert (done.code, answer["sound"]) == (1, False)
    assert "something touches the skin" in answer["verdict"]


@pytest.mark.usefixtures("benches")
def test_a_wrong_use_is_one_line(run: Run, tmp_path: Path) -> None:
    assert_one_line(run("doctor", "emulator://8x8?colour=1"), "no option 'colour'")
    assert_one_line(run("doctor", "emulator://8x8", "--wires", "100"), "two numbers")
    assert_one_line(run("doctor", "emulator://8x8", "--wires", "100,-1"), "-1", "from 0 to")
    assert_one_line(run("doctor", "emulator://8x8", "--leads", "-1"), "--leads says -1 ohm")
    assert_one_line(run("doctor", "emulator://8x8", "--calibration", "/no/such.json"), "/no/such")
    assert_one_line(run("doctor", "emulator://1x4", "--press"), "1x4", "no rectangle")
    far = run("doctor", "emulator://8x8?mode=far", "--press")
    assert_one_line(far, "mode far shows the wires untouched: leave out --press")
    calibration(Scene("rest", 2, 3).rest_ratio).save(tmp_path / "skin.json")
    path = str(tmp_path / "skin.json")
    assert_one_line(run("doctor", "emulator://8x8", "--calibration", path), "2x3", "8x8")


@pytest.mark.usefixtures("benches")
def test_a_calibration_of_another_skin_takes_no_wires(run: Run, tmp_path: Path) -> None:
    own, others = tmp_path / "own.json", tmp_path / "others.json"
    told = calibration(Scene("rest", 8, 8).rest_ratio)
    told.save(own)
    replace(told, unit_id=99).save(others)
    before, url = others.read_bytes(), "emulator://8x8?scene=corners&wires=1.5"
    done = run("doctor", url, "--calibration", str(own), "--press", "--into", str(others))
    assert_one_line(done, "this calibration is of unit 99")
    assert others.read_bytes() == before


@pytest.mark.usefixtures("benches")
def test_leads_that_a_calibration_has_found_are_named(run: Run, tmp_path: Path) -> None:
    path, own_ohm = tmp_path / "skin.json", np.zeros(16)
    own_ohm[[3, 8]] = 1500.0, -70.0
    told = calibration(Scene("rest", 8, 8).rest_ratio)
    replace(told, own_lead_ohm=own_ohm).save(path)
    done = well(run("doctor", "emulator://8x8", "--calibration", str(path)))
    named = f"leads unlike the others': row 3 +1500 ohm, column 0 -70 ohm, by the presses of {path}"
    assert named in done.out


@pytest.mark.usefixtures("benches")
def test_corners_at_a_lead_that_a_calibration_has_found_are_sound(run: Run, tmp_path: Path) -> None:
    path, url = tmp_path / "skin.json", "emulator://8x8?scene=corners&crimp_column=5&crimp_ohm=2000"
    told = calibration(Scene("rest", 8, 8).rest_ratio)
    own_ohm = np.zeros(16)
    for own_ohm[13], names in ((0.0, ["wires"]), (2000.0, [])):
        replace(told, own_lead_ohm=own_ohm).save(path)
        done = run("doctor", url, "--calibration", str(path), "--press", "--json")
        assert [each["id"] for each in json.loads(done.out)["findings"]] == names


@pytest.mark.usefixtures("benches")
@pytest.mark.parametrize("now_ohm", [4000, 6000])
def test_a_lead_that_got_worse_is_not_kept_as_wires_of_all_lines(
    run: Run, tmp_path: Path, now_ohm: float
) -> None:
    """Both rectangles differ, so their mean is nobody's: it was written, and said to be sound."""
    path, own_ohm = tmp_path / "skin.json", np.zeros(8)
    own_ohm[2] = 1500.0
    told = replace(calibration(Scene("rest", 4, 4).rest_ratio), own_lead_ohm=own_ohm)
    told.save(path)
    before = path.read_bytes()
    url = f"emulator://4x4?scene=corners&crimp_row=2&crimp_ohm={now_ohm}"
    asked = ("doctor", url, "--press", "--calibration", str(path), "--leads", "80")
    done = run(*asked)
    assert done.code == 1
    assert "wires               not known: the lines that were pressed differ: look at" in done.out
    done = run(*asked, "--into", str(path))
    assert done.err.endswith("is as it was: neither presses nor far ends have told the wires\n")
    assert path.read_bytes() == before


@pytest.mark.usefixtures("benches")
def test_presses_are_compared_with_the_wires_of_a_calibration(run: Run, tmp_path: Path) -> None:
    path, told = tmp_path / "skin.json", calibration(Scene("rest", 8, 8).rest_ratio)
    for wire_ohm, more, names in (
        (told.nominal_wire_ohm, (), ["wires"]),
        (WireOhm(), (), []),
        (told.nominal_wire_ohm, ("--wires", "150,300"), []),
    ):
        replace(told, nominal_wire_ohm=wire_ohm).save(path)
        url = "emulator://8x8?scene=corners&wires=1.5"
        done = run("doctor", url, "--calibration", str(path), "--press", "--json", *more)
        assert [each["id"] for each in json.loads(done.out)["findings"]] == names
        assert done.code == len(names)
    by_presses = told.nominal_wire_ohm._replace(top_log_std=0.9, bottom_log_std=0.9)
    replace(told, nominal_wire_ohm=by_presses).save(path)
    told_now = ("--wires", "100,200", "--leads", str(LEAD_OHM))
    assert run("doctor", url, *told_now, "--press", "--into", str(path)).code == 1
    kept = load_calibration(path).nominal_wire_ohm
    assert kept.both == pytest.approx((150, 300), rel=0.07)
    assert (kept.top_log_std, kept.bottom_log_std) == pytest.approx((0.04, 0.04), abs=0.035)
    assert (kept.lead, kept.lead_std_ohm) == (LEAD_OHM, None)
    # The curves are of the wires that presses showed, so badly that hardly any of it is stretch.
    assert kept[6:8] == pytest.approx((100 * 1.5**0.07, 200 * 1.5**0.07), rel=0.01)
    assert_one_line(run("doctor", url, "--into", str(path)), "--press")
    # Presses tell both layers together: neither gets surer than it was, and a lead that is told now
    # has no deviation of the one before.
    by_presses = WireOhm(150.0, 300.0, 46.0, 0.01, 0.2, 125.0)
    replace(told, nominal_wire_ohm=by_presses).save(path)
    assert run("doctor", url, "--press", "--into", str(path)).code == 0
    kept = load_calibration(path).nominal_wire_ohm
    assert kept.both == pytest.approx((150, 300), rel=0.1)
    assert 0.02 < kept.top_log_std < 0.1
    assert (kept.bottom_log_std, kept.lead, kept.lead_std_ohm) == (0.2, 46.0, 125.0)
    assert run("doctor", url, "--leads", "80", "--press", "--into", str(path)).code == 0
    kept = load_calibration(path).nominal_wire_ohm
    assert (kept.lead, kept.lead_std_ohm) == (80.0, None)


@pytest.mark.parametrize("end", [None, KeyboardInterrupt, RuntimeError])
def test_the_board_is_left_as_it_was(end: type[BaseException] | None) -> None:
    looks_us: list[int] = []

    class Watched(SteppedSkin):
        def __iter__(self) -> Iterator[ohmskin.Scan]:
            looks_us.append(self.info.settle_us)
            if end is not None and len(looks_us) == 2:
                raise end
            return super().__iter__()

    bench = Watched(stepped_link("emulator://3x4"))
    settings = {"accuracy": "fine", "mode": "far"}
    before = bench.configure(rate_hz=77.5, settle_us=120, **settings)
    with nullcontext() if end is None else pytest.raises(end):
        gather(bench, clocks=True)
    assert looks_us[1] > 3 * looks_us[0]
    assert bench.info == before


@pytest.mark.usefixtures("hasty")
def test_ports_that_do_not_answer_are_findings(run: Run, pty_board: Serve) -> None:
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
        assert answer["findings"][0]["what_to_do"]
        assert "not sound" in answer["verdict"]


@pytest.mark.simavr
@pytest.mark.usefixtures("hasty")
def test_a_late_converter_is_the_only_finding_where_no_scan_comes(run: Run) -> None:
    """Beside "ask for a lower rate", people read that cable, plug and supply are to be checked."""
    done = run("doctor", "simavr://uno?late_cycles=300", "--json")
    (found,) = json.loads(done.out)["findings"]
    assert found["id"] == "lost"
    assert "conversions late" in found["measured"]
    assert found["what_to_do"].startswith("lower the rate")
    assert "--settle 0" in found["what_to_do"]  # as long as one is asked, no rate helps


def test_a_wrong_url_is_no_finding(run: Run) -> None:
    """Even where no board is: a person wrote it, and no cable mends it."""
    for url, word in (
        ("/dev/ttyACM99?speed=1", "no option 'speed'"),
        ("/dev/ttyACM99?baud=9600", "a board knows"),
        ("simavr://none", "no simulated board 'none'"),
        ("replay:///no/such.mcap", "No such file"),
        ("emulator://8x8?plate=/no/such.csv", "/no/such.csv"),
    ):
        assert_one_line(run("doctor", url), word)


@pytest.mark.parametrize("speed", [0, 1])
def test_the_end_of_a_recording_is_no_loss(run: Run, tmp_path: Path, speed: int) -> None:
    bench, path = stepped("emulator://3x4"), tmp_path / "skin.mcap"
    write_recording(path, bench.info, islice(bench, 60))
    for more in ((), ("--press",)):
        answer = json.loads(run("doctor", f"replay://{path}?speed={speed}", "--json", *more).out)
        assert answer["verdict"].startswith("sound: ")
        assert answer["findings"] == []
        assert answer["measured"]["scans"] == 60


@pytest.mark.usefixtures("hasty")
def test_a_board_at_a_port(run: Run, pty_board: Serve) -> None:
    path = pty_board("emulator://3x4").path
    with ohmskin.open(path, start=False) as skin:
        before = skin.configure(rate_hz=77.5, settle_us=120)
    done = run("doctor", path, "--json")
    assert {each["severity"] for each in json.loads(done.out)["findings"]} <= {"note"}
    assert (done.code, done.err) == (0, "")
    with ohmskin.open(path, start=False) as skin:
        assert skin.info == before


@pytest.mark.simavr
@pytest.mark.parametrize("desk", ["", "?desk=1"])
@pytest.mark.usefixtures("hasty")
def test_the_firmware_is_sound(run: Run, desk: str) -> None:
    """On a desk too: lines that charge change single readings, which estimates take out of them."""
    done = run("doctor", f"simavr://uno{desk}", "--json")
    answer = json.loads(done.out)
    assert answer["sound"], answer["findings"]
    assert done.code == 0
    assert answer["measured"]["settling_lsb"] < 1
    assert answer["findings"] == []
