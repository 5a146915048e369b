# SPDX-License-Identifier: Apache-2.0
"""`ohmskin flash`: which board and port it means, what it runs, and how it knows that it worked.

PlatformIO and avrdude are scripts that note their arguments; the board is at a pseudo-terminal.
"""

import os
import sys
import threading
from pathlib import Path

import pytest

import ohmskin
from command_line import Run, assert_one_line, well
from ohmskin.cli import board as flash_command
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.scenes import Scene
from ohmskin.link import session
from places import ROOT
from ports import Attach, Serve


class Writer:
    """The ``pio`` or ``avrdude`` that notes its arguments, and fails at some."""

    def __init__(self, name: str, place: Path) -> None:
        self.name, self._noted, self._script = name, place / "noted", place / name
        self.fail_at("nothing")

    def fail_at(self, pattern: str, said: str = "it is broken") -> None:
        note = f'echo "$*" >> {self._noted}'
        fails = f'{pattern}) echo "{said}" >&2; exit 1'
        self._script.write_text(f'#!/bin/sh\n{note}\ncase "$*" in {fails}; esac\n')
        self._script.chmod(0o755)

    @property
    def calls(self) -> list[str]:
        return self._noted.read_text().splitlines() if self._noted.exists() else []


@pytest.fixture(autouse=True, params=["pio", "avrdude"])
def writer(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Writer:
    place = tmp_path / "bin"
    place.mkdir()
    monkeypatch.setattr(sys, "executable", str(place / "python"))
    monkeypatch.setenv("PATH", f"{place}:/usr/bin:/bin")
    if request.param == "avrdude":
        monkeypatch.setattr(flash_command, "_ROOT", tmp_path)
        monkeypatch.setattr(flash_command, "_FIRMWARE", tmp_path)
        for name in ("uno", "nano", "megaatmega2560"):
            (tmp_path / f"{name}.hex").touch()
    return Writer(request.param, place)


def board(says: str = "uno") -> EmulatedBoard:
    """One that says which real board it is."""
    return EmulatedBoard(Scene().ratio, BoardSettings(), says={"board": says})


@pytest.mark.parametrize(
    ("arguments", "kind", "bridge", "other"),
    [
        ([], "uno", "uno", ""),
        (["uno"], "uno", "uno", ""),
        (["uno", "--port", "{}"], "uno", "uno", ""),
        (["--port", "{}"], "uno", "uno", ""),
        ([], "megaatmega2560", "megaatmega2560", ""),
        (["megaatmega2560"], "megaatmega2560", "megaatmega2560", "uno"),
        (["uno", "--port", "{}"], "uno", "", ""),  # with another USB bridge
        (["nano", "--port", "{}"], "nano", "", "uno"),
    ],
)
def test_it_flashes_and_hears_from_the_board(
    run: Run,
    writer: Writer,
    attach: Attach,
    pty_board: Serve,
    tmp_path: Path,
    arguments: list[str],
    kind: str,
    bridge: str,
    other: str,
) -> None:
    port = pty_board(board("uno" if kind == "nano" else kind)).path
    attach(("/dev/ttyS0", other), (port, bridge))
    done = well(run("flash", *(each.format(port) for each in arguments)))
    assert f"flashing {kind} at {port}, 115200 baud" in done.out
    assert f"{port}: {kind}, firmware {ohmskin.__version__}, answers" in done.out
    # As Arduino's boards.txt has it.
    chip = "atmega2560 -c wiring" if kind == "megaatmega2560" else "atmega328p -c arduino"
    chip += " -x attempts=2" if kind == "nano" else ""  # the other speed is tried soon
    assert writer.calls == [
        f"run -d {ROOT} -t upload --upload-port {port} -e {kind}"
        if writer.name == "pio"
        else f"-p {chip} -D -P {port} -U flash:w:{tmp_path}/{kind}.hex:i -b 115200"
    ]


def test_an_old_boot_loader_of_a_nano_is_tried_next(
    run: Run, writer: Writer, attach: Attach, pty_board: Serve
) -> None:
    port = pty_board(board()).path
    attach((port, ""))
    writer.fail_at("*nano|*115200")
    assert "57600 baud" in well(run("flash", "nano", "--port", port)).out
    tried = {"pio": ["nano", "nano_old"], "avrdude": ["115200", "57600"]}[writer.name]
    assert [call.split()[-1] for call in writer.calls] == tried


def test_the_board_may_take_its_time_to_boot(run: Run, attach: Attach, pty_board: Serve) -> None:
    port = pty_board(board(), silent_s=1.0).path
    attach((port, "uno"))
    assert run("flash").code == 0


def test_the_port_may_be_gone_for_a_while(
    run: Run, writer: Writer, attach: Attach, pty_board: Serve, tmp_path: Path
) -> None:
    port, link = pty_board(board()).path, tmp_path / "ttyACM0"
    attach((str(link), "uno"))
    back = threading.Timer(0.7, link.symlink_to, [port])
    back.start()
    assert run("flash").code == 0
    back.join()


UNCLEAR: dict[str, tuple[list[str], list[tuple[str, str]], list[str]]] = {
    "nothing attached": ([], [], ["uno", "megaatmega2560", "--port"]),
    "no such board": (["due"], [], ["no board 'due'", "uno, nano, megaatmega2560"]),
    "two boards": (
        [],
        [("/dev/ttyACM0", "uno"), ("/dev/ttyACM1", "megaatmega2560")],
        ["2 known boards", "--port", "/dev/ttyACM0 (uno)", "/dev/ttyACM1 (megaatmega2560)"],
    ),
    "two of the board": (
        ["uno"],
        [("/dev/ttyACM0", "uno"), ("/dev/ttyACM1", "uno")],
        ["2 uno boards", "--port", "/dev/ttyACM0", "/dev/ttyACM1"],
    ),
    "no such port": (["uno", "--port", "/dev/x"], [], ["no port /dev/x", "ohmskin ports"]),
    "the other board": (
        ["uno", "--port", "/dev/ttyACM1"],
        [("/dev/ttyACM1", "megaatmega2560")],
        ["/dev/ttyACM1 is a megaatmega2560, not a uno"],
    ),
    "a Pico, no board": (
        ["--port", "/dev/ttyACM1"],
        [("/dev/ttyACM1", "pico")],
        ["/dev/ttyACM1 is a pico: run 'ohmskin flash pico'"],
    ),
    "only an unknown bridge": (
        ["uno"],
        [("/dev/ttyUSB0", ""), ("/dev/ttyUSB1", "")],
        ["no uno boards", "--port", "/dev/ttyUSB0 (?), /dev/ttyUSB1 (?)"],
    ),
    "an unknown bridge, no board": (
        ["--port", "/dev/ttyUSB0"],
        [("/dev/ttyUSB0", "")],
        ["/dev/ttyUSB0", "say which is where", "uno | nano | megaatmega2560"],
    ),
}


@pytest.mark.parametrize("what", UNCLEAR)
def test_what_is_not_clear_is_asked_and_nothing_is_written(
    what: str, run: Run, writer: Writer, attach: Attach
) -> None:
    arguments, ports, words = UNCLEAR[what]
    attach(*ports)
    assert_one_line(run("flash", *arguments), *words)
    assert writer.calls == []


def failed(run: Run) -> str:
    done = run("flash")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert "answers" not in done.out
    return done.out + done.err


def test_a_failed_upload_is_said(run: Run, writer: Writer, attach: Attach) -> None:
    attach(("/dev/ttyACM0", "uno"))
    writer.fail_at("*")
    said = failed(run)
    assert "it is broken" in said
    assert "flashing uno at /dev/ttyACM0 failed: the lines above" in said


@pytest.mark.parametrize(
    "said",
    [
        "avrdude warning: attempt 2 of 2: not in sync: resp=0x00",
        "avrdude error: timeout communicating with programmer",
    ],
)
def test_a_dead_port_is_a_line(run: Run, writer: Writer, attach: Attach, said: str) -> None:
    """avrdude alone says 23."""
    attach(("/dev/ttyACM0", "uno"))
    writer.fail_at("*", f"{said}\navrdude done.  Thank you.")
    done = run("flash")
    assert (done.code, done.out) == (2, "flashing uno at /dev/ttyACM0, 115200 baud\n")
    assert done.err.startswith("ohmskin: no boot loader answers at /dev/ttyACM0: is it a uno")
    assert done.err.count("\n") == 1


def test_a_url_is_no_port(run: Run) -> None:
    assert_one_line(run("flash", "uno", "--port", "emulator://8x8"), "flash takes no URL")


def test_a_board_that_stays_silent_is_said(
    run: Run, attach: Attach, pty_board: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "ATTEMPTS", session.ATTEMPTS[:1])
    attach((pty_board(board(), silent_s=30.0).path, "uno"))
    assert "is silent" in failed(run)


def test_a_port_that_does_not_come_back_is_said(
    run: Run, attach: Attach, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flash_command, "SILENCE_TIMEOUT_S", 0.3)
    attach(("/dev/ttyACM77", "uno"))
    assert "no port /dev/ttyACM77" in failed(run)


def test_another_board_at_the_port_is_said(run: Run, attach: Attach, pty_board: Serve) -> None:
    attach((pty_board(board("megaatmega2560")).path, "uno"))
    assert "answers as 'megaatmega2560', not as uno" in failed(run)


def test_a_link_to_another_board_is_seen(run: Run, attach: Attach, tmp_path: Path) -> None:
    attach((str(tmp_path / "ttyACM0"), "megaatmega2560"))
    (tmp_path / "skin").symlink_to(tmp_path / "ttyACM0")
    assert_one_line(run("flash", "nano", "--port", str(tmp_path / "skin")), "is a megaatmega2560")


def test_what_is_missing_is_said_and_how_to_get_it(
    run: Run, writer: Writer, attach: Attach, monkeypatch: pytest.MonkeyPatch
) -> None:
    attach(("/dev/ttyACM0", "uno"))
    monkeypatch.setenv("PATH", os.devnull)
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    avrdude = ["apt install avrdude", "brew install avrdude", "the Arduino IDE's"]
    assert_one_line(run("flash"), *(["pip install"] if writer.name == "pio" else avrdude))
    for place in ("_ROOT", "_FIRMWARE"):
        monkeypatch.setattr(flash_command, place, Path("/nowhere"))
    assert_one_line(run("flash"), "no firmware", "make wheel")


def test_the_arduino_ides_avrdude_is_told_its_configuration(
    run: Run, writer: Writer, attach: Attach, pty_board: Serve, tmp_path: Path
) -> None:
    attach((pty_board(board()).path, "uno"))
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "avrdude.conf").touch()
    well(run("flash"))
    assert writer.calls[0].startswith(f"-C {tmp_path}/etc/" if writer.name == "avrdude" else "run")
