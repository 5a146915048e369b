# SPDX-License-Identifier: Apache-2.0
"""Errors of the command line: exactly one line, which says what to do."""

import errno
import os
from pathlib import Path

import pytest
import serial

from command_line import Command, Done, Run, assert_one_line, finish, well
from ohmskin.link.protocol import LAYOUT_CRC
from places import DATA
from ports import Attach

EMULATED = "emulator://4x6?scene=ghost&begin=0&seed=2"
READINGS = str(DATA / "random_4x6.npz")
WRONG: dict[str, tuple[list[str], list[str]]] = {
    "unknown port": (["info", "/dev/ttyACM99"], ["no port /dev/ttyACM99", "ohmskin ports"]),
    "empty port": (["info", ""], ["no port"]),
    "no serial port": (["info", "/dev/null"], ["/dev/null is no serial port", "ohmskin ports"]),
    "a folder": (["info", "/tmp"], ["/tmp is no serial port", "ohmskin ports"]),
    "a number that is too large": (["info", "emulator://8x8?rate=1e308"], ["times a second"]),
    "a number that is too long": (["info", "/dev/null?baud=" + "9" * 5000], ["500000"]),
    "wrong scheme": (["info", "usb://1"], ["usb://", "emulator://"]),
    "wrong size": (["info", "emulator://big"], ["8x8"]),
    "impossible rate": (["info", "emulator://8x8?rate=1000"], ["line_too_slow"]),
    "wrong line speed": (["info", "/dev/ttyACM99?baud=9600"], ["9600", "500000"]),
    "a port without real time": (["emulate", "emulator://8x8?speed=0"], ["has real time"]),
    "wrong simulated board": (["info", "simavr://due"], ["due", "uno"]),
    "another protocol": (
        ["info", "emulator://4x4?foreign=257"],
        ["layout", f"0x{LAYOUT_CRC ^ 257:04X}", f"0x{LAYOUT_CRC:04X}", "ohmskin flash"],
    ),
    "refused rows": (
        ["configure", EMULATED, "--rows", "0"],
        ["bad_rows", "rows_max", "(at most 16x16)"],
    ),
    "rate out of range": (
        ["configure", EMULATED, "--rate", "60000"],
        ["bad_rate", "1000..50000000 mHz", "(1 to 50000 scans/s)"],
    ),
    "negative rate": (["configure", EMULATED, "--rate", "-1"], ["no board scans -1.0 times"]),
    "settle time out of range": (
        ["configure", EMULATED, "--settle", "3001"],
        ["bad_settle", "above 3000 us"],
    ),
    "refused rate": (["configure", EMULATED, "--rate", "1900"], ["line_too_slow", "at most"]),
    "impossible rows": (["configure", EMULATED, "--rows", "-3"], ["rows is -3", "255"]),
    "unknown prescaler": (["configure", EMULATED, "--adc", "x"], ["usual"]),
    "unplugged": (["stream", f"{EMULATED}&vanish=0.4", "--seconds", "5"], ["gone"]),
    "bad method of a stream": (["stream", EMULATED, "--method", "magic"], ["magic", "matrix"]),
    "bad method of a file": (
        ["estimate", READINGS, "--method", "magic", "--out", "/tmp/never.npz"],
        ["magic", "matrix"],
    ),
    "no readings": (
        ["estimate", "/no/such.npz", "--method", "ohm", "--out", "/tmp/never.npz"],
        ["/no/such.npz"],
    ),
    "no place for the answer": (
        ["estimate", READINGS, "--method", "ohm", "--out", "/no/such/place.npz"],
        ["/no/such/place.npz"],
    ),
    "demo of a real port": (["demo", "--port", "/dev/ttyACM99"], ["emulator://8x8"]),
    "emulation of a real port": (["emulate", "/dev/ttyACM99"], ["emulator://8x8"]),
    "unknown command": (["skin"], ["skin"]),
    "unknown option": (["info", EMULATED, "--fast"], ["--fast"]),
    "missing argument": (["info"], ["port", "Usage: ohmskin info [OPTIONS] "]),
    "missing file to write": (["export", "a.mcap"], ["Usage: ohmskin export ", "..."]),
    "arguments in another order": (["flash", "/dev/ttyACM99", "uno"], ["(uno). Usage: "]),
    "a recording to export": (
        ["export", "/no/such.mcap", "/tmp/never.npz"],
        ["/no/such.mcap: cannot be read: No such file"],  # it was "[Errno 2]"
    ),
    # It recorded no forces, and said nothing.
    "a force sensor's port": (
        ["record", EMULATED, "/tmp/never.mcap", "--scans", "1", "--force-unit", "g"],
        ["--force-port"],
    ),
    "a recording as a port": (["stream", __file__ + ".mcap"], [f"replay://{__file__}.mcap"]),
    "no recording": (["stream", "replay://"], ["replay:// names no recording: write replay://FI"]),
    "more weights than there is memory": (
        [
            *("calibrate", "weights", EMULATED, "/tmp/never.json", "--anywhere"),
            *("--grams", "50,100", "--repeats", "1000000000000000"),
        ],
        ["--repeats"],
    ),
    "missing option": (["estimate", READINGS], ["--out"]),
    "not a number": (["stream", EMULATED, "--scans", "many"], ["--scans"]),
}


NO_TIMES = {
    ("stream", EMULATED): ("--seconds", "--scans", "--tare"),
    ("record", EMULATED, "/no/such/place.mcap"): ("--seconds", "--scans", "--tare"),
    ("tare", EMULATED, "/no/such/skin.json"): ("--seconds",),
    ("calibrate", "table", EMULATED, READINGS, "/no/such.json", "--indenter-mm2", "1"): ("--rest",),
    ("calibrate", "recording", READINGS, "/no/such.json", "--indenter-mm2", "1"): ("--rest",),
    ("export", READINGS, "/no/such/place.csv"): ("--begin", "--end"),
    ("emulate", EMULATED): ("--seconds",),
    ("demo",): ("--seconds",),
}


@pytest.mark.parametrize("arguments", NO_TIMES, ids=" ".join)
def test_a_time_below_0_is_refused(run: Run, arguments: tuple[str, ...]) -> None:
    for option in NO_TIMES[arguments]:
        for value in ("-1", "nan"):
            assert_one_line(run(*arguments, option, value), option)


def test_any_number_of_scans_may_be_asked_for(run: Run) -> None:
    """One that Python counts no scans by was an error, after the file was begun."""
    port, limits = f"{EMULATED}&speed=0", ("--scans", 30 * "9", "--seconds", "0.05")
    assert len(well(run("stream", port, "--json", *limits)).out.splitlines()) == 6


def test_a_demo_ends(run: Run) -> None:
    assert_one_line(run("demo", "--seconds", "0"), "--seconds")


@pytest.mark.parametrize("what", WRONG)
def test_an_error_is_one_line(what: str, run: Run, attach: Attach) -> None:
    attach()
    arguments, words = WRONG[what]
    done = run(*arguments)
    if what in ("unplugged", "demo of a real port"):
        done = Done(done.code, "", done.err)  # what was shown until then
    assert_one_line(done, *words)


def test_an_error_of_a_process_is_one_line(command: Command) -> None:
    arguments, words = WRONG["another protocol"]
    assert_one_line(finish(command(*arguments)), *words)


def test_a_silent_port(run: Run) -> None:
    assert_one_line(run("info", "emulator://4x4?silent=1&speed=0"), "silent", "ohmskin flash")


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM])
def test_no_permission(run: Run, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refuse(path: str, *_: object, **__: object) -> None:
        raise serial.SerialException(number, f"could not open port {path}: {os.strerror(number)}")

    monkeypatch.setattr(serial, "Serial", refuse)
    assert_one_line(run("info", "/dev/ttyACM0"), "no permission for /dev/ttyACM0", "dialout")


def test_without_arguments_there_is_help(run: Run) -> None:
    done = run()
    assert done.code == 2
    assert "Usage" in done.out
    assert "stream" in done.out
    assert done.err == ""


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "table", EMULATED, "{}", "{}", "--indenter-mm2", "80"),
        ("calibrate", "recording", "{}", "{}", "--indenter-mm2", "80"),
        ("estimate", "{}", "--method", "joint", "--out", "{}"),
        ("verify", EMULATED, "{}", "--json", "{}"),
    ],
)
def test_what_is_read_is_not_written_over(run: Run, tmp_path: Path, words: tuple[str, ...]) -> None:
    (there := tmp_path / "there").write_text("an hour's work")
    (tmp_path / "link").symlink_to(there)
    names = iter((there, tmp_path / "link"))
    done = run(*(str(next(names)) if word == "{}" else word for word in words))
    assert_one_line(done, "link: is what is read: say another file to write")
    assert there.read_text() == "an hour's work"
