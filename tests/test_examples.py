# SPDX-License-Identifier: Apache-2.0
"""The examples run, and do what they say they do."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

import ohmskin
from calibrations import half_doubtful, of_scene
from command_line import Run, python, well
from lsl_stub import CLOCK_OFFSET_S, StreamInfo, pylsl_module
from ohmskin.emulate.scenes import BEGIN_S, SLIP_HZ, SLIP_SHARE, Scene
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Mark
from places import ROOT

EXAMPLES = ROOT / "examples"
GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"


def output_of(*command: str) -> str:
    return well(python(*command)).out


def first_lines(count: int, *command: str) -> list[str]:
    """Of a program that goes on until Ctrl-C, which ends it well."""
    pipe = subprocess.PIPE
    process = subprocess.Popen([sys.executable, *command], stdout=pipe, stderr=pipe, text=True)
    try:
        return [process.stdout.readline() for _ in range(count)]
    finally:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20)
        assert (process.returncode, said) == (0, "")


def example(name: str) -> SimpleNamespace:
    return SimpleNamespace(**run_path(str(EXAMPLES / f"{name}.py")))


@pytest.fixture(scope="module")
def skin_json(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("calibration") / "skin.json"
    of_scene("ghost").save(path)
    return str(path)


def test_every_scan_prints_consecutive_scans() -> None:
    lines = output_of(str(EXAMPLES / "every_scan.py"), "emulator://2x2", "5").splitlines()
    numbers = [int(line.split()[0]) for line in lines]
    assert numbers == list(range(numbers[0], numbers[0] + 5))


def test_every_scan_refuses_what_is_no_number_of_scans() -> None:
    """It ended in a traceback."""
    done = python(str(EXAMPLES / "every_scan.py"), "emulator://2x2", "abc")
    said = "every_scan: SCANS is a whole number, such as 100, not 'abc'\n"
    assert (done.code, done.err) == (1, said)


@pytest.mark.parametrize("name", ["every_scan", "estimate"])
def test_ctrl_c_ends_an_example(name: str) -> None:
    [line] = first_lines(1, "-u", str(EXAMPLES / f"{name}.py"), "emulator://2x2?scene=multi")
    assert line


def test_ctrl_c_ends_an_example_that_waits_for_a_touch(skin_json: str) -> None:
    """It waited in silence, and Ctrl-C was a traceback."""
    [line] = first_lines(1, "-u", str(EXAMPLES / "slip.py"), "emulator://8x8", skin_json)
    assert line == "waits for a touch\n"


@pytest.mark.parametrize(("mode", "error"), [("near", 0.1), ("far", 0.02)])
def test_estimate_prints_the_touches(
    mode: str, error: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """Against the scene that the board is given: nobody has told the wires, far ends show them."""
    example("estimate").main(f"emulator://8x8?scene=ghost&seed=1&mode={mode}", seconds=4.5)
    printed = capsys.readouterr().out
    touches = re.findall(r"\((\d), (\d)\): ([\d.]+) \+- ([\d.]+) microsiemens", printed)
    assert {(int(row), int(column)) for row, column, *_ in touches} == {(2, 2), (2, 5), (5, 2)}
    truth_us = 1e6 * Scene("ghost", 8, 8, seed=1).skin(BEGIN_S).cell_siemens
    for row, column, us, _ in touches:
        assert float(us) == pytest.approx(truth_us[int(row), int(column)], rel=error)


def test_forces_prints_contacts(skin_json: str) -> None:
    lines = first_lines(6, str(EXAMPLES / "forces.py"), GHOST, skin_json)
    pattern = r"[\d.]+ \+- [\d.]+ N at \((\d\.\d), (\d\.\d)\)\n"
    found = [re.fullmatch(pattern, line) for line in lines]
    assert all(found)
    assert len({each.groups() for each in found if each}) == 3  # the ghost is none


def test_forces_says_where_a_force_is_uncertain(tmp_path: Path) -> None:
    path = tmp_path / "skin.json"
    half_doubtful("ghost").save(path)
    first, second, third = first_lines(3, str(EXAMPLES / "forces.py"), GHOST, str(path))
    assert first == "uncertain at (2.0, 2.0)\n"
    assert re.fullmatch(r"1\.2\d \+- 0\.[12]\d N at \(2\.0, 5\.0\)\n", second)
    assert third == "uncertain at (5.0, 2.0)\n"


def test_slip_shows_what_only_a_region_is_fast_enough_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skin, picture = tmp_path / "skin.json", tmp_path / "slip.png"
    of_scene("slip").save(skin)
    port = "emulator://8x8?scene=slip&seed=1&begin=0&speed=0"
    example("slip").main(port, str(skin), str(picture))
    line = r"(\d+) times .*: the strongest line is ([\d.]+) % of .* at ([\d.]+) Hz"
    found = re.findall(line, capsys.readouterr().out)
    (whole_hz, _, seen_hz), (region_hz, share, true_hz) = [list(map(float, line)) for line in found]
    assert (whole_hz, seen_hz) == (90, abs(SLIP_HZ - 2 * 90))  # 200 Hz look like 20
    assert region_hz > 600
    assert true_hz == pytest.approx(SLIP_HZ, rel=0.01)
    # The calibration's cells are linear; those of the scene add k F^1.7.
    assert share == pytest.approx(1.7 * 100 * SLIP_SHARE, rel=0.1)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_presses_of_an_emulated_skin_make_a_calibration_that_is_near_the_truth(
    tmp_path: Path, run: Run
) -> None:
    path, table = tmp_path / "skin.json", str(EXAMPLES / "presses.csv")
    told = ("--indenter-mm2", "80", "--wires", "100,200", "--leads", "80")
    said = well(run("calibrate", "table", "emulator://8x8", table, str(path), *told)).out
    assert "6 of 64 cells take the curve of all presses, with their own gain\n" in said
    assert re.search("58 of 64 cells take .* all presses; its held-out error is 0.5[0-9] N", said)
    calibration = ohmskin.load_calibration(path)
    assert (calibration.rows, calibration.columns, calibration.unit_id) == (8, 8, 0)
    moving = "emulator://8x8?scene=moving&begin=0&speed=0"
    lines = well(run("stream", moving, "--calibration", str(path), "--seconds", "1", "--json")).out
    for line in lines.splitlines():  # the gains of other cells are other ones
        shown, true_n = json.loads(line), np.sum(json.loads(line)["true_force_n"])
        shown_n, std_n = (
            sum(contact[name] for contact in shown["contacts"])
            for name in ("force_n", "force_n_std")
        )
        assert shown_n == pytest.approx(true_n, rel=0.25)
        assert abs(shown_n - true_n) < 2 * std_n
        assert std_n < 0.3 * true_n


def test_two_boards_have_one_clock() -> None:
    urls = ("emulator://8x8?unit=1", "emulator://8x8?unit=2&mode=far")
    begin_s = time.time()
    head, *lines = first_lines(40, str(EXAMPLES / "two_boards.py"), *urls)
    assert head == "units 1, 2\n"
    scans = [
        re.match(r"([\d.]+) s: unit (\d), scan (\d+), missed 0, 0\.(?:09|1\d)\d$", x) for x in lines
    ]
    times_s = [float(each[1]) for each in scans if each]
    assert len(times_s) == 39
    assert all(b - a > -0.002 for a, b in pairwise(times_s))
    # A clock that is still learning may be ahead by 50 ms.
    assert begin_s < times_s[0] < times_s[-1] < time.time() + 0.1
    assert {each[2] for each in scans if each} == {"1", "2"}


def check_periods(times_s: Sequence[float]) -> None:
    """Times are whole periods of 1/90 s apart: a busy computer misses scans."""
    periods = np.rint(90 * np.diff(times_s))
    assert periods.min() >= 1
    assert np.diff(times_s) == pytest.approx(periods / 90, abs=3e-3)


LABELS = [f"row {row} column {column}" for row in range(8) for column in range(8)]


def test_the_lsl_outlet_pushes_forces_at_their_times(
    monkeypatch: pytest.MonkeyPatch, skin_json: str
) -> None:
    samples: list[tuple[list[float], float]] = []
    infos: list[StreamInfo] = []
    monkeypatch.setitem(sys.modules, "pylsl", pylsl_module(samples, infos))
    begin_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        example("lsl_outlet").main(GHOST, skin_json)
    (info,) = infos
    assert (info.name, info.type, info.channel_count) == ("ohmskin", "Force", 64)
    assert info.nominal_srate == pytest.approx(90, rel=1e-3)
    assert info.source_id == "ohmskin-unit-0"
    assert info.get_channel("label") == LABELS
    assert info.get_channel("unit") == ["newtons"] * 64
    times_s = np.array([timestamp for _, timestamp in samples])
    check_periods(times_s)
    host_s = times_s - CLOCK_OFFSET_S
    assert begin_s < host_s[0] < host_s[-1] < time.monotonic() + 0.1
    assert np.count_nonzero(np.array(samples[-1][0]) > 0.1) == 3


def test_a_real_lsl_inlet_gets_them(skin_json: str) -> None:
    try:
        import pylsl
    except (ImportError, RuntimeError) as exc:  # RuntimeError: there is no liblsl
        pytest.skip(f"needs pylsl: {exc}")
    outlet = threading.Thread(target=example("lsl_outlet").main, args=(GHOST, skin_json, 2.5))
    outlet.start()
    try:
        found = pylsl.resolve_byprop("source_id", "ohmskin-unit-0", timeout=2.0)
        if not found:
            pytest.skip("this machine's network has no multicast")
        inlet = pylsl.StreamInlet(found[0])
        info = inlet.info()
        pulled = [inlet.pull_sample(timeout=2.0) for _ in range(30)]
        inlet.close_stream()
    finally:
        outlet.join()
    assert info.get_channel_labels() == LABELS
    assert info.get_channel_units() == ["newtons"] * 64
    times_s = np.array([timestamp for _, timestamp in pulled])
    assert np.diff(times_s) == pytest.approx(1 / 90, abs=3e-3)
    assert np.count_nonzero(np.array(pulled[-1][0]) > 0.1) == 3


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "recording.mcap"
    with ohmskin.open(GHOST) as skin, Recorder(path, skin.info) as recorder:
        recorder.add(Mark("begin", time.monotonic()))
        for _, scan in zip(range(20), skin, strict=False):
            recorder.add(scan)
    return path


def messages_of(path: Path) -> list[tuple[str, str, str, dict, int, dict]]:
    """Topic, schema's name and text, log time and content of each; encodings as Foxglove wants."""
    found = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            # docs.foxglove.dev, "Custom schema encodings": these, and "type": "object".
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            text = json.loads(schema.data)
            assert text["type"] == "object"
            content = json.loads(message.data)
            assert set(content) >= set(text.get("required", ()))
            found.append((channel.topic, schema.name, text, message.log_time, content))
    return found


def test_a_recording_is_as_foxglove_wants_it(recorded: Path) -> None:
    found = messages_of(recorded)
    assert {topic for topic, *_ in found} == {"/skin/hello", "/skin/mark", "/skin/scan"}
    named = (ROOT / "integrations/foxglove/README.md").read_text()
    for _, _, text, _, content in found:
        assert set(text["properties"]) == set(content)
    for topic in ("/skin/hello", "/skin/mark", "/skin/scan.codes", "/skin/scan.missed"):
        assert f"`{topic}" in named


@pytest.mark.parametrize("name", ["every_scan", "estimate", "forces"])
def test_an_example_without_arguments_says_how_to_call_it(name: str) -> None:
    done = python(str(EXAMPLES / f"{name}.py"))
    assert (done.code, done.out) == (1, "")
    assert f"python {name}.py " in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("name", ["every_scan", "estimate", "forces", "slip", "two_boards"])
def test_a_wrong_port_is_one_line(name: str, skin_json: str) -> None:
    """It was a traceback."""
    calibration = [skin_json] if name in ("forces", "slip") else []
    done = python(str(EXAMPLES / f"{name}.py"), "/dev/nothing", *calibration)
    line = f"{name}: no port /dev/nothing: 'ohmskin ports' lists the ports there are\n"
    assert (done.code, done.err) == (1, line)


def test_every_example_is_run_here() -> None:
    tested = {
        *("every_scan.py", "estimate.py", "forces.py", "two_boards.py"),
        *("lsl_outlet.py", "slip.py"),
    }
    assert {path.name for path in EXAMPLES.glob("*.py")} == tested
