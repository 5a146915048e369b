# SPDX-License-Identifier: Apache-2.0
"""What several test files share: ports to open, the command line as a process, and what leaks."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

import second_simulator
from command_line import ENVIRONMENT, Command, Done, Run
from lockstep import elf_of
from ohmskin.cli import main as cli
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.driver import PtyServer
from ohmskin.emulate.simavr import PROGRAM
from ohmskin.emulate.urls import emulated
from pin_maps import DEFAULT, told_by
from ports import USB_IDS, Attach, Serve
from studies.__main__ import app as studies

OPEN_FILES = Path("/proc/self/fd")

# Commands are interrupted as by a keyboard. Where this process was started with SIGINT ignored, as
# in the background of a shell, they would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run, and no deadline: the machine may be busy.
settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("simavr") and not (PROGRAM.exists() and elf_of("uno").exists()):
        pytest.skip("needs 'make firmware sim'")
    own = not item.get_closest_marker("simavr") or item.get_closest_marker("any_wiring")
    if not own and (other := _wired_otherwise()):
        pytest.skip(f"needs the wiring of docs/build.md: platformio.ini has another for {other}")
    if item.get_closest_marker("ngspice") and not shutil.which("ngspice"):
        _is_missing("ngspice", "ngspice")
    if item.get_closest_marker("browser") and not shutil.which("chromium"):
        _is_missing("Chromium", "chromium")
    if item.get_closest_marker("second_sim") and not second_simulator.is_installed("avr8js"):
        _is_missing("avr8js", "npm")
    if item.get_closest_marker("pico"):
        if not second_simulator.PICO_ELF.exists():
            pytest.skip("needs 'make pico'")
        if not second_simulator.is_installed("rp2040js"):
            _is_missing("rp2040js", "npm")


@cache
def _wired_otherwise() -> str:
    """The boards whose built firmware has not the wiring, or the references, of docs/build.md."""
    usual = {board: (wiring.numbers, wiring.ref_ohm) for board, wiring in DEFAULT.items()}
    return ", ".join(board for board in usual if told_by(elf_of(board)) != usual[board])


def _is_missing(program: str, package: str) -> None:
    reason = f"needs {program}, which 'make setup' installs (apt package {package})"
    if os.environ.get("CI") == "true":
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """Fails a test that leaves a thread or an open file behind."""
    threads, files = set(threading.enumerate()), _open_files()
    yield
    assert set(threading.enumerate()) <= threads
    assert _open_files() <= files  # fewer, where a file of a test before was closed late


def _open_files() -> int:
    return len(list(OPEN_FILES.iterdir())) if OPEN_FILES.exists() else 0


@pytest.fixture
def pty_board() -> Iterator[Serve]:
    """A function that serves a board, or that of an ``emulator://`` URL, at a pseudo-terminal.

    It is silent at first for `silent_s`. `close` ends it early.
    """
    with ExitStack() as stack:

        def serve(of: str | EmulatedBoard, silent_s: float = 0.0) -> PtyServer:
            board, _, faults = emulated(of) if isinstance(of, str) else (of, "", None)
            server = PtyServer(board, faults)
            thread = threading.Timer(silent_s, server.serve)
            thread.start()
            for end in (thread.join, thread.cancel, server.close):  # the last one first
                stack.callback(end)
            return server

        yield serve


@pytest.fixture
def silent_port() -> Iterator[tuple[int, str]]:
    """The far end and the path of a pseudo-terminal at which nobody answers."""
    tty = pytest.importorskip("tty")
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def attach(monkeypatch: pytest.MonkeyPatch) -> Attach:
    """A function that says which ports this machine has: path and board of each, ``""`` if none."""

    def say(*ports: tuple[str, str]) -> None:
        found = [ListPortInfo(path, skip_link_detection=True) for path, _ in ports]
        for port, (_, board) in zip(found, ports, strict=True):
            port.vid, port.pid = USB_IDS[board]
        monkeypatch.setattr(list_ports, "comports", lambda: found)

    return say


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, driven by Playwright."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Chromium's sandbox does not start for root.
        arguments = [] if os.geteuid() else ["--no-sandbox"]
        chromium = shutil.which("chromium")
        running = playwright.chromium.launch(executable_path=chromium, args=arguments)
        yield running
        running.close()


@pytest.fixture
def command() -> Iterator[Command]:
    """A function that starts ``python -m MODULE ARGUMENTS``, MODULE as a rule ohmskin."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str, module: str = "ohmskin", **options: Any) -> "subprocess.Popen[str]":
        piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        call = [sys.executable, "-m", module, *arguments]
        started.append(subprocess.Popen(call, **(piped | {"env": ENVIRONMENT} | options)))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """A function that runs ``ohmskin ARGUMENTS`` in this process, or ``python -m studies``."""
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: str, program: str = "ohmskin") -> Done:
        monkeypatch.setattr(sys, "argv", [program, *arguments])
        capsys.readouterr()
        code = 0
        try:
            cli.main() if program == "ohmskin" else cli.run(studies, program)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        return Done(code, *capsys.readouterr())

    return call
