# SPDX-License-Identifier: Apache-2.0
"""`ohmskin flash`: which board and port it means, what it runs, and how it knows that it worked.

PlatformIO is a script that writes down its arguments; the board is emulated at a pseudo-terminal.
"""

import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from command_line import Run, assert_one_line, well
from ohmskin.cli import board as flash_command
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.link import session
from ohmskin.link.serial_port import SerialPort
from ohmskin.opening import emulated
from places import ROOT
from ports import Attach, Serve


class FlashedBoard(EmulatedBoard):
    """One that says which real board it is."""

    says = "uno"

    def _send(self, name: str, tail: bytes = b"", **values: Any) -> None:
        if name == "hello":
            values["board"] = self.says
        super()._send(name, tail, **values)


class Pio:
    """A ``pio`` that notes its arguments, then does what `upload` says, and ends with `code`."""

    def __init__(self, place: Path) -> None:
        self._noted = place / "noted"
        self._script = place / "pio"
        self.end_with(0)

    def end_with(self, code: int, then: str = "") -> None:
        self._script.write_text(
            f"#!/bin/sh\nprintf '%s\\n' \"$@\" > {self._noted}\n"
            f"echo core=$PLATFORMIO_CORE_DIR\n{then}\nexit {code}\n"
        )
        self._script.chmod(0o755)

    @property
    def arguments(self) -> list[str]:
        return self._noted.read_text().splitlines() if self._noted.exists() else []


@pytest.fixture(autouse=True)
def pio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pio:
    place = tmp_path / "bin"
    place.mkdir()
    monkeypatch.setattr(sys, "executable", str(place / "python"))
    monkeypatch.setenv("PATH", f"{place}:/usr/bin:/bin")
    return Pio(place)


def board(says: str = "uno") -> FlashedBoard:
    made = FlashedBoard(emulated("emulator://8x8")[0]._ratio_at, 8, 8)
    made.says = says
    made.reset()  # its first hello was of a class that did not know yet
    return made


@pytest.mark.parametrize(
    ("arguments", "kind", "bridge", "beside"),
    [
        ([], "uno", "uno", ""),
        (["uno"], "uno", "uno", ""),
        (["uno", "--port", "{}"], "uno", "uno", ""),
        (["--port", "{}"], "uno", "uno", ""),
        ([], "megaatmega2560", "megaatmega2560", ""),
        (["uno", "--port", "{}"], "uno", "", ""),  # with another USB bridge
        (["megaatmega2560"], "megaatmega2560", "megaatmega2560", "uno"),  # the one of that kind
    ],
)
def test_it_flashes_and_hears_from_the_board(
    run: Run,
    pio: Pio,
    attach: Attach,
    pty_board: Serve,
    arguments: list[str],
    kind: str,
    bridge: str,
    beside: str,
) -> None:
    port = pty_board(board(kind)).path
    attach(("/dev/ttyS0", beside), (port, bridge))
    done = well(run("flash", *(each.format(port) for each in arguments)))
    assert f"flashing {kind} at {port}" in done.out
    assert f"{port}: {kind}, firmware 0.1.0, answers" in done.out
    expected = ["run", "-d", str(ROOT), "-e", kind, "-t", "upload", "--upload-port", port]
    assert pio.arguments == expected


def test_the_board_may_take_its_time_to_boot(run: Run, attach: Attach, pty_board: Serve) -> None:
    port = pty_board(board(), silent_s=1.0).path
    attach((port, "uno"))
    assert run("flash").code == 0


def test_the_port_may_be_gone_for_a_while(
    run: Run, pio: Pio, attach: Attach, pty_board: Serve, tmp_path: Path
) -> None:
    port, link = pty_board(board()).path, tmp_path / "ttyACM0"
    attach((str(link), "uno"))
    back = threading.Timer(0.7, link.symlink_to, [port])
    back.start()
    assert run("flash").code == 0
    back.join()


def test_the_port_may_come_back_by_another_name(
    run: Run, attach: Attach, pty_board: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = pty_board(board()).path
    begin_s = time.monotonic()

    def ports() -> list[SerialPort]:
        renamed = time.monotonic() - begin_s > 0.5
        return [SerialPort(port if renamed else "/dev/ttyACM77", "", "uno")]

    monkeypatch.setattr(flash_command, "serial_ports", ports)
    done = run("flash")
    assert done.code == 0
    assert f"{port}: uno" in done.out


UNCLEAR: dict[str, tuple[list[str], list[tuple[str, str]], list[str]]] = {
    "nothing attached": ([], [], ["uno", "megaatmega2560", "--port"]),
    "no such board": (["due"], [], ["no board 'due'", "uno, megaatmega2560"]),
    "two boards": (
        [],
        [("/dev/ttyACM0", "uno"), ("/dev/ttyACM1", "megaatmega2560")],
        ["2 boards", "--port", "/dev/ttyACM0 (uno)", "/dev/ttyACM1 (megaatmega2560)"],
    ),
    "two of the board": (
        ["uno"],
        [("/dev/ttyACM0", "uno"), ("/dev/ttyACM1", "uno")],
        ["2 boards", "--port", "/dev/ttyACM0", "/dev/ttyACM1"],
    ),
    "the other board": (
        ["uno", "--port", "/dev/ttyACM1"],
        [("/dev/ttyACM1", "megaatmega2560")],
        ["/dev/ttyACM1 is a megaatmega2560, not a uno"],
    ),
    "only an unknown bridge": (
        ["uno"],
        [("/dev/ttyUSB0", ""), ("/dev/ttyUSB1", "")],
        ["no uno is found", "--port", "/dev/ttyUSB0, /dev/ttyUSB1"],
    ),
    "an unknown bridge, no board": (
        ["--port", "/dev/ttyUSB0"],
        [("/dev/ttyUSB0", "")],
        ["/dev/ttyUSB0", "say which board is", "uno | megaatmega2560"],
    ),
}


@pytest.mark.parametrize("what", UNCLEAR)
def test_what_is_not_clear_is_asked_and_nothing_is_written(
    what: str, run: Run, pio: Pio, attach: Attach
) -> None:
    arguments, ports, words = UNCLEAR[what]
    attach(*ports)
    assert_one_line(run("flash", *arguments), *words)
    assert pio.arguments == []


def failed(run: Run) -> str:
    done = run("flash")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert "answers" not in done.out
    return done.err


def test_a_failed_upload_is_said(run: Run, pio: Pio, attach: Attach) -> None:
    attach(("/dev/ttyACM0", "uno"))
    pio.end_with(1)
    assert "flashing uno at /dev/ttyACM0 failed" in failed(run)


def test_a_board_that_stays_silent_is_said(
    run: Run, attach: Attach, pty_board: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "_OFTEN", session._OFTEN[:1])
    attach((pty_board(board(), silent_s=30.0).path, "uno"))
    assert "is silent" in failed(run)


def test_a_port_that_does_not_come_back_is_said(
    run: Run, attach: Attach, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flash_command, "REBOOT_S", 0.3)
    attach(("/dev/ttyACM77", "uno"))
    assert "no port /dev/ttyACM77" in failed(run)


def test_another_board_at_the_port_is_said(run: Run, attach: Attach, pty_board: Serve) -> None:
    attach((pty_board(board("megaatmega2560")).path, "uno"))
    assert "answers as 'megaatmega2560', not as uno" in failed(run)


def test_without_platformio_it_says_how_to_get_it(
    run: Run, attach: Attach, monkeypatch: pytest.MonkeyPatch
) -> None:
    attach(("/dev/ttyACM0", "uno"))
    monkeypatch.setenv("PATH", os.devnull)
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert_one_line(run("flash"), "pip install 'ohmskin[flash]'")


def test_without_a_checkout_it_says_so(
    run: Run, attach: Attach, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    attach(("/dev/ttyACM0", "uno"))
    monkeypatch.setattr(flash_command, "_ROOT", tmp_path)
    assert_one_line(run("flash"), "run this in a checkout")
