# SPDX-License-Identifier: Apache-2.0
"""Every command block of README, docs and examples is run, and prints what its page shows.

A block is indented code whose first line is a command. Commands in the text that name a port are
run as well. How a command is run here, and what is compared:

- A port such as /dev/ttyACM0, or the word PORT, is an emulated board at a pseudo-terminal; doctor
  and verify get one in simulated time. The port's name is put back into what is printed. An
  emulator:// URL stays; where it has a fault, the doctor finds something.
- Each command has a folder of its own, in which `files` made what a command before it would have.
  But those of `IN_ORDER` run one after another in one folder.
- A command that goes on until Ctrl-C is stopped after some tables or lines. Times for which a port
  is recorded are shorter.
- Lines of a block below a command are what it prints: each is among the printed lines, in this
  order. Spaces count as one. A number stands for one of the same sign up to three times larger or
  smaller, 0 for 0 alone; before "ms" and behind "missed" for any, because machines differ.
- "ohmskin NAME    description" in a list of commands: its --help is asked for.
- `NOT_RUN` lists what is not run, by name, and why.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from command_line import ENVIRONMENT, Command, Run, finish, well
from ohmskin.force.reader import DEFAULT_METHOD
from ohmskin.record.recording import ForceSample, Tare, load_recording
from places import ROOT
from ports import Attach, Serve
from recordings import HOST_BEGIN_S, record_presses, sensor_log, write_log, write_recording
from stepped import stepped

PROGRAMS = "ohmskin|make|uv|build/lowest/bin/python|python|pip|pio|npm|sudo|apt-get|export"
SPAN = re.compile(r"`(ohmskin\s[^`]*(?:PORT|/dev/tty|emulator://|first\.mcap)[^`]*)`")
COMMAND = re.compile(rf"(?:\.venv/bin/)?(?:{PROGRAMS}) |\. ")
BLOCK = re.compile(r"(?:^    .*\n|^\n(?=    ))+", re.MULTILINE)
TOP = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
FENCE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
BOARD = re.compile(r"/dev/ttyACM\d")
SENSOR = "/dev/ttyUSB0"

NOT_RUN = {
    ". .venv/bin/activate": "changes a shell",
    "make setup": "installs packages",
    "make setup-host": "installs packages",
    "make test": "runs these tests",
    "make test-wiring": "runs a part of them",
    "ohmskin info --self-test simavr://uno": "needs the built firmware, which tests/firmware opens",
    "ohmskin stream simavr://uno?scene=ghost": "the same",
    "make test-arduino-gcc": "CI runs it",
    "make check": "CI runs it before these tests",
    "uv venv build/lowest": "makes an environment",
    "uv pip install --python build/lowest --resolution lowest-direct -e .[dev]": "installs them",
    "build/lowest/bin/python -m pytest": "runs these tests",
    "make docs": "a part of make check",
    "make fuzz": "takes minutes; the tests have a short run of it",
    "make format": "changes sources",
    "make chart": "takes minutes; tests/studies runs small ones of its kind",
    "make stability": "takes minutes; tests/studies runs small ones of its kind",
    "make ablate": "takes minutes; tests/studies runs small ones of its kind",
    "make far": "takes minutes; tests/studies runs small ones of its kind",
    "make experiments": "takes minutes; tests/studies runs small ones of its kind",
    "make test-world": "installs packages",
    "make test-lerobot": "installs packages",
    "make bench-quick": "takes minutes; tests/benchmarks runs a part of it",
    "make bench-tables": "takes minutes; tests/benchmarks has a quick run of it",
    "ohmskin flash uno --port /dev/ttyACM0": "needs a boot loader; tests/cli/test_flash.py has one",
    "ohmskin flash pico": "needs a drive; tests/cli/test_flash_pico.py has one",
    "pio run -e uno_arduino -t upload": "needs a board; tests/firmware has one",
    "ohmskin calibrate scale /dev/ttyUSB0 --grams 200,500": "asks for weights; "
    "tests/record/test_force_sensor.py puts them on",
    "ohmskin calibrate knead /dev/ttyACM0 skin.json --force-port /dev/ttyUSB0": "ends when a skin "
    "is kneaded; tests/cli/test_knead.py has one",
    "ohmskin calibrate weights /dev/ttyACM0 skin.json --anywhere --grams 100,200,500": "waits for "
    "weights; tests/cli/test_knead.py puts them on",
    "ohmskin calibrate recording knead.mcap skin.json --total": "tests/calibrate has such "
    "recordings",
    "python examples/lsl_outlet.py emulator://8x8?scene=moving skin.json": "needs liblsl; "
    "tests/test_examples.py runs it with a stand-in",
}
# What a command is given besides, to be short, by the beginning of its words.
STOPPED = {
    "verify": ("--seconds", "1"),
    "stream": ("--seconds", "1.5"),
    "record": ("--seconds", "2"),
}


class Shown(NamedTuple):
    """What pages show below a command, and its words."""

    page: str
    lines: tuple[str, ...]
    words: list[str]


def texts() -> Iterator[tuple[str, str]]:
    for path in (*map(ROOT.joinpath, TOP), *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.*")):
        text = path.read_text()
        if path.suffix == ".py":
            text = text.split('"""')[1].replace("\\\n", "")
        yield str(path.relative_to(ROOT)), text


def steps() -> dict[str, list[Shown]]:
    """What follows each command, on each page that has it."""
    found: dict[str, list[Shown]] = defaultdict(list)
    for page, text in texts():
        plain = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
        for span in SPAN.findall(BLOCK.sub("", plain)):
            words = shlex.split(span.replace("PORT", "/dev/ttyACM0"))
            found[" ".join(words)].append(Shown(page, (), words))
        for block in BLOCK.findall(plain):
            lines = [line.strip() for line in block.strip("\n").splitlines()]
            if not COMMAND.match(lines[0]):
                continue
            starts = [at for at, line in enumerate(lines) if COMMAND.match(line)]
            for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
                command = re.sub(r"^\.venv/bin/", "", lines[start])
                if "#" not in command:
                    command = re.sub(r"^(ohmskin \w+)\s{3,}.*", r"\1 --help", command)
                words = shlex.split(command, comments=True)
                shown = tuple(line for line in lines[start + 1 : end] if line and line[0] != "#")
                found[" ".join(words)].append(Shown(page, shown, words))
    return found


STEPS = steps()
KNEADED = [line for line in STEPS if re.search(r"\bkneaded\.json|scene=knead\"?$", line)]
IN_ORDER = [line for line in STEPS if re.search(r"\b(?:robot|weights)\.(?:mcap|json)", line)]


def is_shown(line: str, printed: str) -> bool:
    """Whether a page's line stands for a printed one."""
    parts, others = (NUMBER.split(" ".join(text.split())) for text in (line, printed))
    if len(parts) != len(others):
        return False
    for at, (part, other) in enumerate(zip(parts, others, strict=True)):
        if at % 2 == 0:
            if part != other:
                return False
        elif not (parts[at + 1].startswith(" ms") or parts[at - 1].endswith("missed ")):
            wanted, given = float(part), float(other)
            if not wanted / 3 <= given <= 3 * wanted:
                return False
    return True


def missing(lines: tuple[str, ...], printed: str) -> str | None:
    """The first of a page's lines that was not printed, after those before it."""
    left = iter(printed.splitlines())
    return next((line for line in lines if not any(is_shown(line, each) for each in left)), None)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages' commands read: presses with forces, a recording, a calibration, a table."""
    folder = tmp_path_factory.mktemp("files")
    learned = of_scene("rest", method=DEFAULT_METHOD)  # as the pages' `calibrate` learns it
    with ohmskin.open("emulator://8x8", calibration=learned) as skin:
        skin.tare(0.2)
        skin.calibration.save(folder / "skin.json")
    shutil.copy(ROOT / "examples/presses.csv", folder)
    plate = re.findall(r"^    ((?:\w+,){7}\w+)$", (ROOT / "docs/hardware.md").read_text(), re.M)
    (folder / "plate.csv").write_text("\n".join(plate))
    record_presses(folder / "bare.mcap", 44.0)  # two cells of six presses
    bare = load_recording(folder / "bare.mcap")
    times_s, forces_n = sensor_log(44.0)
    write_log(folder / "sensor.csv", times_s + 70_000, forces_n)
    rest = [scan.ratio for scan in bare.scans if scan.host_time_s < HOST_BEGIN_S + 1.5]
    tare = Tare(np.mean(rest, axis=0), HOST_BEGIN_S + 1.5)
    samples = [
        ForceSample(float(force_n), HOST_BEGIN_S + float(time_s), source="cell")
        for time_s, force_n in zip(times_s, forces_n, strict=True)
    ]
    write_recording(folder / "presses.mcap", bare.hellos[0], [tare, *bare.scans, *samples])
    with ohmskin.open("emulator://8x8") as skin:
        scans = [scan for _, scan in zip(range(200), skin, strict=False)]
        for name in ("first.mcap", "recording.mcap"):
            write_recording(folder / name, skin.info, scans)
    rows = [
        f"{row},{column},{force_n},{20e-6 * force_n},1e-7"
        for row in range(8)
        for column in range(8)
        for force_n in (0.4903325, 0.980665, 1.96133)
        for _ in range(2)
    ]
    head = "row,column,force_n,conductance,conductance_std"
    (folder / "skin.presses.csv").write_text("\n".join([head, *rows]) + "\n")
    return folder


@pytest.fixture
def place(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files, in which a command runs."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def sensor(silent_port: tuple[int, str]) -> Iterator[str]:
    """The port of a force sensor that says a number a line."""
    master, path = silent_port
    done = threading.Event()

    def work() -> None:
        while not done.wait(0.02):
            os.write(master, b"0.00\n")

    thread = threading.Thread(target=work)
    thread.start()
    yield path
    done.set()
    thread.join()


def printed_by(
    words: list[str],
    run: Run,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> str:
    """What a command prints until it ends, or is stopped; it ends well."""
    if words[0] == "python":
        process = subprocess.Popen(
            [sys.executable, *words[1:]], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        lines = [line for _, line in zip(range(3), process.stdout, strict=False)]
        process.kill()
        process.communicate()
        assert lines or process.returncode == 0
        return "".join(lines)
    if words[1] == "view" and words[2:] != ["--help"]:
        process = command(*words[1:], "--http-port", "0", "--no-browser")
        url = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        done = finish(process)
        assert (done.code, done.err) == (0, "")
        return url
    finds = words[1] == "doctor" and words[2].startswith("emulator://")
    if words[1] in ("doctor", "verify"):
        skin = "plate=plate.csv" if words[1] == "verify" else "scene=rest"
        skin = "scene=corners" if "--press" in words else skin
        url = words[2] if finds else f"emulator://8x8?{skin}"
        monkeypatch.setattr(ohmskin, "open", lambda *_, **__: stepped(url))
    arguments = words[1:]
    if arguments[0] in STOPPED and "--help" not in arguments:
        option, seconds = STOPPED[arguments[0]]
        if option in arguments:
            at = arguments.index(option)
            del arguments[at : at + 2]
        arguments += [option, seconds]
    if arguments[0] == "record" and len(arguments) > 2:
        Path(arguments[2]).unlink(missing_ok=True)
    done = run(*arguments)
    # The doctor asks for presses, and a busy machine misses scans.
    said = ("press", "now", "keep pressing", "missed")
    assert [line for line in done.err.splitlines() if not line.startswith(said)] == []
    assert done.code == int(finds)
    return done.out


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    "line", [line for line in STEPS if line not in (*NOT_RUN, *IN_ORDER, *KNEADED)]
)
def test_a_command_prints_what_its_pages_show(
    line: str,
    run: Run,
    command: Command,
    pty_board: Serve,
    sensor: str,
    attach: Attach,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words, names = list(STEPS[line][0].words), {}
    if words[0] == "make":  # what the target does, without what it needs
        dry = (*words, "-n", "--no-print-directory")
        made = subprocess.check_output(dry, cwd=ROOT, text=True).splitlines()
        words = made[-1].removeprefix(".venv/bin/").split()
    attach(("/dev/ttyACM0", "uno"))
    for at, word in enumerate(words):
        if BOARD.fullmatch(word) and words[1] not in ("doctor", "verify"):
            words[at] = pty_board("emulator://8x8").path
            names[words[at]] = word
        elif word == SENSOR:
            words[at] = sensor
    printed = printed_by(words, run, command, monkeypatch)
    for path, name in names.items():
        printed = printed.replace(path, name)
    for page, lines, _ in STEPS[line]:
        assert missing(lines, printed) is None, (page, printed)


def test_an_emulated_skin_is_calibrated_as_a_page_says(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert [line.split(" ")[1] for line in IN_ORDER] == [
        *("record", "calibrate", "stream"),
        *("calibrate", "stream"),
    ]
    for line in IN_ORDER:
        [(page, lines, words)] = STEPS[line]
        stop = ("--seconds", "1") if words[1] == "stream" else ()
        done = well(run(*words[1:], *stop))
        assert missing(lines, done.out) is None, (page, done.out)


def test_an_emulated_skin_is_kneaded_as_a_page_says(
    run: Run, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    [(_, names, words)], *others = (STEPS[line] for line in KNEADED)
    assert words[1] == "emulate"
    process = command(*words[1:])
    try:
        places = {name: process.stdout.readline().strip() for name in names}
        for [(page, lines, words)] in others:
            stop = ("--seconds", "1") if words[1] == "stream" else ()
            done = well(run(*(places.get(word, word) for word in words[1:]), *stop))
            assert missing(lines, done.out) is None, (page, done.out)
    finally:
        process.kill()
        process.communicate()


def test_what_is_not_run_is_on_a_page() -> None:
    assert set(NOT_RUN) <= set(STEPS)


def test_another_output_is_noticed() -> None:
    assert is_shown("cell (0, 3):  12.1 uS, 2.5 ms", "cell (0, 7): 30 uS, 200 ms")
    assert is_shown("9 scans, missed 0, 7", "8 scans, missed 99, 7")
    for other in ("cell (1, 3): 12.1 uS, 2.5 ms", "cell (0, 3): 40 uS, 2.5 ms", "cell (0, 3)"):
        assert not is_shown("cell (0, 3): 12.1 uS, 2.5 ms", other)
    assert missing(("a 1", "b"), "a 2\nc\nb") is None
    assert missing(("b", "a 1"), "a 2\nc\nb") == "a 1"


class Enough(Exception):
    """A program has printed enough."""


CODE = {page: found for page, text in texts() if (found := FENCE.findall(text))}


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize("page", CODE)
def test_python_of_a_page_runs(page: str) -> None:
    printed: list[tuple[Any, ...]] = []

    def show(*values: Any) -> None:
        printed.append(values)
        if len(printed) == 3:
            raise Enough

    port, names = "emulator://8x8?scene=ghost&begin=0&seed=1", {"print": show}
    for code in CODE[page]:
        printed.clear()
        with pytest.raises(Enough):
            exec(compile(BOARD.sub(port, code), page, "exec"), names)
