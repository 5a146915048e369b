# SPDX-License-Identifier: Apache-2.0
"""The command line: what it prints, and its exit codes. `test_errors` has its errors."""

import json
import os
import re
import select
import signal
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import ohmskin
from calibrations import of_scene
from command_line import Command, Run, assert_one_line, finish, python, well
from ohmskin.calibrate.rules import check_complete
from ohmskin.cli.main import app
from ohmskin.cli.stream import cell_table
from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS
from ohmskin.emulate.scale import SCALE_OPTIONS
from ohmskin.emulate.scenes import BEGIN_S, LEAD_OHM, SCENES, Scene
from ohmskin.estimate.methods import METHODS
from ohmskin.force.reader import DEFAULT_METHOD
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.device import Region
from ohmskin.link.messages import SelfTestReport
from ohmskin.link.protocol import ENUMS, LAYOUT_CRC
from ohmskin.link.session import Session
from ohmskin.record.readings import estimate_file, load_readings
from places import DATA
from ports import Attach, Serve

EMULATED = "emulator://4x6?scene=ghost&begin=0&seed=2"


# -------------------------------------------------------------------------------------- boards


def test_ports(run: Run, attach: Attach) -> None:
    attach()
    said = well(run("ports")).out
    assert "no serial ports" in said
    for scheme in ("emulator://", "socket://", "rfc2217://"):
        assert scheme in said
        assert scheme in well(run("--help")).out
    assert json.loads(run("ports", "--json").out) == []
    boards = {"/dev/ttyACM0": "uno", "/dev/ttyACM1": "megaatmega2560", "/dev/ttyUSB1": ""}
    attach(*reversed(boards.items()))
    assert json.loads(run("ports", "--json").out) == [
        {"path": path, "description": "", "board": board} for path, board in boards.items()
    ]
    assert "megaatmega2560" in run("ports").out


def test_info(run: Run) -> None:
    done = well(run("info", EMULATED))
    assert f"0x{LAYOUT_CRC:04X}" in done.out
    facts = json.loads(run("info", EMULATED, "--json").out)
    assert (facts["board"], facts["rows"], facts["columns"]) == ("emulated", 4, 6)
    assert facts["rate_hz"] == pytest.approx(90, abs=0.01)
    assert "findings" not in facts
    tested = json.loads(run("info", EMULATED, "--json", "--self-test").out)
    assert tested["findings"] == []
    assert len(tested["code_min"]) == 8
    for mode, names in (("near", "ABCD"), ("far", "ABCDEF")):
        page = well(run("info", f"{EMULATED}&mode={mode}", "--self-test")).out
        codes = page[page.index("codes") : page.index("findings")]
        assert re.findall("[A-H]", codes) == list(names)


def test_readings_that_the_self_test_did_not_take_are_not_called_sound(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = SelfTestReport((), (1000, 3, *[1023] * 6), (1023, 30, *[0] * 6))
    monkeypatch.setattr(Session, "self_test", lambda _: report)
    page = well(run("info", EMULATED, "--self-test")).out
    assert re.search(r"A 1000 to 1023, B 3 to 30 *\n", page)
    assert "none, but other readings came too late to be judged" in page


@pytest.mark.parametrize("form", [(), ("--json",)])
def test_findings_of_the_self_test_are_in_the_exit_code(
    run: Run, monkeypatch: pytest.MonkeyPatch, form: tuple[str, ...]
) -> None:
    report = SelfTestReport(("top_stuck_low",), (0,) * 8, (9,) * 8)
    monkeypatch.setattr(Session, "self_test", lambda _: report)
    done = run("info", EMULATED, "--self-test", *form)
    assert (done.code, done.err) == (1, "")
    assert "top_stuck_low" in done.out


def test_info_is_in_peoples_units(run: Run) -> None:
    said = dict(re.findall(r"^ ([a-z ]+?)  +(.*?) *$", well(run("info", EMULATED)).out, re.M))
    assert said["cells"] == "4 rows, 6 columns"
    assert said["mode"] == "near: readings a b c d of each cell"
    assert said["rate"] == "90.00 Hz (asked: 90.00 Hz)"
    assert said["references"] == "30000 Ohm top, 30000 Ohm bottom"
    assert said["settings"] == ENUMS["settings"].docs["defaults_blank"]
    assert not [name for name in said if "_" in name]


def test_the_environment_names_port_and_calibration(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "skin.json"
    of_scene("ghost").save(path)
    monkeypatch.setenv("OHMSKIN_PORT", "emulator://8x8?scene=ghost&begin=0&seed=1")
    monkeypatch.setenv("OHMSKIN_CALIBRATION", str(path))
    assert "8 rows, 8 columns" in well(run("info")).out
    assert "4 rows, 6 columns" in well(run("info", EMULATED)).out
    assert "force by 'touch'" in well(run("stream", "--scans", "1")).out
    assert "by 'ohm'" in well(run("stream", "--scans", "1", "--method", "ohm")).out
    assert "tared" in well(run("tare", "--force", "--seconds", "0.1")).out


def test_configure_lasts_on_a_running_board(run: Run, pty_board: Serve) -> None:
    path = pty_board("emulator://8x8").path
    done = well(
        run(
            *("configure", path, "--rows", "3", "--columns", "5", "--rate", "50", "--settle", "60"),
            *("--adc", "fine", "--mode", "far", "--unit-id", "12", "--save"),
        )
    )
    assert "3x5 at 50.00 Hz, mode far" in done.out
    assert "saved" in done.out
    facts = json.loads(run("info", path, "--json").out)
    assert (facts["rows"], facts["columns"], facts["unit_id"]) == (3, 5, 12)
    assert (facts["settle_asked_us"], facts["accuracy"]) == (60, "fine")
    assert facts["mode"] == "far"
    (line,) = run("stream", path, "--method", "none", "--json", "--scans", "1").out.splitlines()
    assert json.loads(line)["reading_names"] == ["a", "e", "b", "f"]
    well(run("stream", path, "--scans", "1"))
    refused = run("stream", path, "--method", "matrix", "--scans", "1")
    assert_one_line(refused, "takes the readings a b c d, not a e b f", "--mode near")
    assert "8x8 at 90.00 Hz, mode near" in run("configure", path, "--defaults").out
    assert json.loads(run("info", path, "--json").out)["unit_id"] == 0


def test_a_region_that_a_program_has_left_is_said_and_can_be_ended(
    run: Run, pty_board: Serve
) -> None:
    """A program that followed contacts was killed: `info` said 4x6 cells, and `calibrate` to do
    what was done already: "this board is in mode near: 'ohmskin configure PORT --mode near'"."""
    path = pty_board("emulator://4x6").path
    with ohmskin.open(path, start=False) as skin:
        skin.set_region(Region([1, 2], [0, 1, 5], mode="near", whole_every=30))
        wholes = [scan for scan in islice(skin, 100) if scan.is_whole]
        rate_hz, (first, *_, last) = skin.info.rate_hz, wholes
    page = well(run("info", path)).out
    assert " rows 1 2, columns 0 1 5; one scan in 30 is of all, in mode near" in page
    made_hz = 1e6 * (last.number - first.number) / (last.time_us - first.time_us)
    said = re.search(r"([\d.]+) Hz between whole scans, ([\d.]+) Hz with them", page)
    assert said
    assert list(map(float, said.groups())) == pytest.approx([rate_hz, made_hz], rel=1e-3)
    told = "'ohmskin configure PORT --rows 4 --columns 6 --save' changes that"
    assert told in page
    for method in ("none", "joint"):  # it showed 0.0 where nothing was read
        assert told in well(run("stream", path, "--method", method, "--scans", "1")).out
    touched = "emulator://8x8?scene=single&begin=0&speed=0"
    focused = well(run("stream", touched, "--focus", "--seconds", "1.5")).out
    assert "not all cells" not in focused
    done = well(run("configure", path, "--rate", "90")).out
    assert "4x6, a region of it (see 'ohmskin info'), at 90.00 Hz" in done
    with (
        ohmskin.open(path, start=False) as skin,
        pytest.raises(ValueError, match="of a region") as no,
    ):
        check_complete(skin.info)
    assert "'ohmskin configure PORT --mode near --rows 4 --columns 6 --save'" in str(no.value)
    well(run("configure", path, "--mode", "near", "--rows", "4", "--columns", "6"))
    assert "all cells" in well(run("info", path)).out
    with ohmskin.open(path, start=False) as skin:
        check_complete(skin.info)
        skin.set_region(Region([1], [0], mode="quick", rate_hz=1000))
    (told,) = re.findall("'ohmskin (configure) PORT (.*)'", well(run("info", path)).out)
    well(run(told[0], path, *told[1].split()))  # it left mode and rate, if it was not refused
    with ohmskin.open(path, start=False) as skin:
        check_complete(skin.info)


# --------------------------------------------------------------------------------------- scans


def test_stream_json_is_one_object_a_scan(run: Run) -> None:
    done = well(run("stream", EMULATED, "--json", "--scans", "7"))
    scans = [json.loads(line) for line in done.out.splitlines()]
    assert [scan["scan"] for scan in scans] == list(range(scans[0]["scan"], scans[0]["scan"] + 7))
    expected = Scene("ghost", 4, 6, seed=2).ratio(BEGIN_S)
    bare = {"scan", "time_us", "time_ns", "host_time_s", "missed", "reading_names", "ratio"}
    estimate = {"method", "cell_siemens", "cell_siemens_std", "converged", "message", "wires"}
    for scan in scans:
        assert set(scan) == bare | estimate
        assert scan["missed"] == 0
        assert 0 < time.time_ns() - scan["time_ns"] < 60e9
        assert (scan["method"], scan["wires"]) == ("joint", "assumed")
        assert np.shape(scan["ratio"]) == (4, 6, 4)
        assert np.shape(scan["cell_siemens"]) == (4, 6)
        assert np.abs(np.array(scan["ratio"]) - expected).max() < 3 / 1024
    done = run("stream", EMULATED, "--json", "--scans", "1", "--method", "none")
    assert set(json.loads(done.out)) == bare


def test_stream_reads_contacts_often_if_it_shall(run: Run) -> None:
    """JSON has no number for what was not read; the whole skin is read again in the end."""
    url = "emulator://8x8?scene=single&begin=0&speed=0"
    lines = well(run("stream", url, "--json", "--focus", "--seconds", "0.5")).out.splitlines()
    scans = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    regions = [scan for scan in scans if scan["ratio"][0][0] == [None] * 4]
    assert len(regions) > 4 * (len(scans) - len(regions)) > 0
    refused = run("stream", url, "--focus", "--method", "none")
    assert_one_line(refused, "--method none")


@pytest.mark.parametrize("method", ["none", "ohm", "matrix"])
def test_stream_shows_a_table(run: Run, method: str) -> None:
    done = well(run("stream", EMULATED, "--seconds", "0.4", "--method", method))
    assert "missed 0" in done.out
    assert EMULATED in done.out
    rows = [line.split() for line in done.out.splitlines()]
    for row in range(4):
        assert any(len(cells) == 7 and cells[0] == str(row) for cells in rows)


@pytest.mark.parametrize("place", ["pipe", "terminal"])
def test_a_table_of_16_columns_is_whole_on_80(place: str) -> None:
    arguments = ("stream", "emulator://1x16", "--scans", "1", "--method", "none")
    forced = {"FORCE_COLOR": "1", "TERM": "dumb"} if place == "terminal" else {}
    done = well(python("-m", "ohmskin", *arguments, COLUMNS="80", **forced))
    rows = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line).split() for line in done.out.splitlines()]
    assert [str(column) for column in range(16)] in rows
    assert [len(row) for row in rows if row and row[0] == "0" and row[1:2] != ["1"]] == [17]


def test_a_wide_text_keeps_its_column_whole(capsys: pytest.CaptureFixture[str]) -> None:
    Console(width=80, soft_wrap=True).print(cell_table([["0.12 (12)"] * 16], ""))
    assert capsys.readouterr().out.count("0.12 (12)") == 16


def test_stream_says_what_was_lost(run: Run) -> None:
    url = f"{EMULATED}&drop=0.06&rate=100&speed=0"
    done = run("stream", url, "--json", "--scans", "200")
    assert done.code == 0
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert sum(line["missed"] for line in lines) > 0
    assert done.err.count("\n") == 1
    assert "missed" in done.err


def test_stream_ends_when_its_reader_does(command: Command) -> None:
    for lossy, said in (("", r""), ("&drop=0.1", r"missed \d+ scans .*\n")):
        process = command("stream", f"{EMULATED}{lossy}&speed=0", "--json")
        for _ in range(100):
            assert json.loads(process.stdout.readline())["missed"] >= 0
        process.stdout.close()
        assert re.fullmatch(said, process.stderr.read())
        assert process.wait(20) == 0


@pytest.mark.parametrize("method", ["ohm", "matrix", DEFAULT_METHOD])
@pytest.mark.parametrize("cold", [False, True])
def test_estimate(run: Run, tmp_path: Path, method: str, cold: bool) -> None:
    out = tmp_path / "out.npz"
    done = run(
        *("estimate", str(DATA / "random_4x6.npz"), "--out", str(out)),
        *(["--cold"] if cold else []),
        *(["--method", method] if method != DEFAULT_METHOD else []),
    )
    assert done.code == 0
    assert "converged" in done.out
    expected = estimate_file(load_readings(DATA / "random_4x6.npz"), method, cold=cold)
    with np.load(out) as found:
        assert set(found.files) == set(expected)
        for name in set(expected) - {"seconds"}:
            np.testing.assert_array_equal(found[name], expected[name])


def test_estimate_says_why_frames_are_not_converged(run: Run, tmp_path: Path) -> None:
    with np.load(DATA / "random_4x6.npz") as given:
        arrays = dict(given)
    arrays["ratio"][1:3, 2, :, 0] = 0.0
    arrays["ratio"][1:3, 2, :, 3] = 0.9
    np.savez(tmp_path / "stuck.npz", **arrays)
    out = tmp_path / "out.npz"
    done = run("estimate", str(tmp_path / "stuck.npz"), "--method", "ohm", "--out", str(out))
    assert done.code == 0
    assert sum(map(int, re.findall(r"(\d) of 8: cell \(2, ", done.out))) == 2
    with np.load(out, allow_pickle=False) as found:
        assert [bool(message) for message in found["message"][:4]] == [False, True, True, False]


def test_estimate_does_not_leave_half_a_file(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    done = run("estimate", str(tmp_path / "bad.npz"), "--method", "ohm", "--out", str(out))
    assert_one_line(done, "bad.npz")
    assert not out.exists()


# ------------------------------------------------------------------------------ without a board


def test_emulate_serves_other_processes(run: Run, command: Command) -> None:
    process = command("emulate", "emulator://3x3?scene=single&begin=0&noise=0")
    path = process.stdout.readline().strip()
    with ohmskin.open(path) as skin:
        scan = skin.latest()
        np.testing.assert_array_equal(
            scan.ratio, ratio_from_codes(quantise(Scene("single", 3, 3).ratio(BEGIN_S)))
        )
        assert skin.info.board == "emulated"
    assert json.loads(run("info", path, "--json").out)["rows"] == 3
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert (done.code, done.out, done.err) == (0, "", "")


def test_emulate_ends_by_itself(command: Command) -> None:
    done = well(finish(command("emulate", "--seconds", "0.2")))
    assert done.out.startswith("/dev/")


def test_ctrl_c_while_opening(command: Command, silent_port: tuple[int, str]) -> None:
    port, path = silent_port
    process = command("info", path)
    assert select.select([port], [], [], 30)[0], "the process asks nothing"
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.code == 130
    assert "Traceback" not in done.err


@pytest.mark.parametrize("options", [("--json",), ()], ids=["json", "table"])
def test_a_stream_into_a_pipe_is_printed_as_it_goes_until_ctrl_c(
    command: Command, options: tuple[str, ...]
) -> None:
    process = command("stream", EMULATED, *options)
    for _ in range(2):  # two scans, or pictures of one, and it goes on
        while "missed" not in (line := process.stdout.readline()):
            assert line
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    well(finish(process))


def test_demo_shows_a_ghost_and_how_it_goes(run: Run, tmp_path: Path) -> None:
    picture = tmp_path / "demo.png"
    done = run("demo", "--seconds", "0.5", "--picture", str(picture))
    assert done.code == 0
    assert done.out.startswith("scanning emulator://8x8?scene=ghost&seed=1&begin=0 for 0.5 s\n")
    for word in ("truth", "ohm", "joint", "46 scans at 90.00 Hz", "0 missed", "0 damaged"):
        assert word in done.out
    verdicts = {
        line.split(":")[0].strip(): line for line in done.out.splitlines() if " ms a " in line
    }
    assert "no ghost" not in verdicts["ohm"]
    assert "ghost" in verdicts["ohm"]
    assert "no ghost" in verdicts["joint"]
    assert picture.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert picture.stat().st_size > 10_000


def test_the_demo_writes_the_picture_that_it_names(run: Run, tmp_path: Path) -> None:
    done = run("demo", "--seconds", "0.1", "--picture", str(tmp_path / "demo"))
    assert f"picture: {tmp_path / 'demo'}" in done.out
    assert (tmp_path / "demo").read_bytes().startswith(b"\x89PNG")
    done = run("demo", "--seconds", "0.1", "--picture", str(tmp_path / "no" / "demo.png"))
    assert done.code == 2
    assert "demo.png: cannot be written: say a file in a directory there is" in done.err
    done = run("demo", "--seconds", "0.1", "--picture", str(tmp_path / "demo.txt"))
    assert "demo.txt: no picture ends in '.txt': say .png, .svg or .pdf" in done.err


def test_nothing_listens_on_the_network(command: Command) -> None:
    if not Path("/proc/net/tcp").exists():
        pytest.skip("needs /proc")
    process = command("emulate")
    path = process.stdout.readline().strip()
    reader = command("stream", path, "--json")
    assert reader.stdout.readline()
    for running in (process, reader):
        for file in Path(f"/proc/{running.pid}/fd").iterdir():
            assert not os.readlink(file).startswith("socket:")


# ---------------------------------------------------------------------------------------- help

# All that each command takes, or the commands of a group.
TAKES = {
    "ports": "--json",
    "info": "PORT --json --self-test",
    "configure": "PORT --rows --columns --rate --settle --adc --mode --unit-id --defaults --save",
    "flash": "BOARD --port",
    "stream": "PORT --method --calibration --force --tare --ref-std --focus --json --scans"
    " --seconds",
    "view": "PORT --calibration --force --host --http-port --no-browser",
    "tare": "PORT CALIBRATION --seconds --undo --force",
    "skin": "FILE --pitch-mm --radius-mm --taxels --frame --picture",
    "doctor": "PORT --calibration --wires --leads --press --into --json",
    "verify": "PORT PLATE --wires --leads --seconds --picture --json --cell-percent "
    "--reference-percent --settling-lsb --loss",
    "estimate": "READINGS --out --method --cold --ref-std",
    "record": "PORT FILE --scans --seconds --tare --mark --force-port --force-baud --force-scale"
    " --force-unit --force-column",
    "export": "RECORDING OUT --begin --end --calibration --force --format --backend",
    "emulate": "URL --seconds",
    "demo": "--seconds --port --picture",
    "calibrate": "knead recording scale table weights",
}
NAMES = {
    "configure": ("to 32",),
    "stream": METHODS,
    "estimate": METHODS,
    "export": (".npz", ".csv", ".parquet"),
}


@pytest.mark.parametrize("name", TAKES)
def test_help_of_a_command(run: Run, name: str) -> None:
    command = app.commands[name].load()
    takes = sorted(getattr(command, "commands", ()))
    for taken in command.params if not takes else ():
        is_option = taken.param_type_name == "option"
        takes += taken.opts if is_option else [taken.metavar or taken.name.upper()]
    assert takes == TAKES[name].split()
    done = well(run(name, "--help"))
    for word in (*takes, *NAMES.get(name, ())):
        assert re.search(rf"(?<![\w-]){re.escape(word)}\b", done.out, re.IGNORECASE), word
    assert run(name, "-h").out == done.out


def test_help_of_emulate_has_a_line_for_each_scene_and_fault(run: Run) -> None:
    lines = [line.strip() for line in run("emulate", "--help").out.splitlines()]
    lead = {"lead": f"ohms of each line's lead, {LEAD_OHM:g} unless told"}
    known = {**SCENES, **lead, **SCALE_OPTIONS, **LINE_FAULTS, **SKIN_FAULTS}
    assert [line for line in lines if line.startswith("- ")] == [
        f"- {name}: {text}" for name, text in known.items()
    ]


def test_version(run: Run) -> None:
    assert well(run("--version")).out == f"ohmskin {ohmskin.__version__}\n"


@pytest.mark.parametrize(
    ("typed", "wanted"), [("ohmskin str", "stream"), ("ohmskin stream --tar", "--tare")]
)
def test_shells_complete_commands_and_options(typed: str, wanted: str) -> None:
    environment = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    program = "from ohmskin.cli.main import main; main()"
    done = python("-c", program, _OHMSKIN_COMPLETE="complete_bash", **environment)
    assert done.out.split() == [wanted]


def test_help_names_every_command(run: Run) -> None:
    done = well(run("--help"))
    for name in TAKES:
        assert f" {name} " in done.out
    assert sorted(TAKES) == sorted(app.commands)
