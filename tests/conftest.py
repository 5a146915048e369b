# SPDX-License-Identifier: Apache-2.0
"""What several test files share: ports to open, the command line as a process, and what leaks."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import settings

import ohmskin
from command_line import Done
from ohmskin.cli import main as cli
from ohmskin.emulate.board import PtyServer
from ohmskin.emulate.simavr import PROGRAM
from ohmskin.opening import emulated
from places import ROOT

OPEN_FILES = Path("/proc/self/fd")

# Commands are interrupted as by a keyboard. Where this process was started with SIGINT ignored, as
# in the background of a shell, they would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run, and no deadline: the machine may be busy.
settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("simavr") and not (
        PROGRAM.exists() and (ROOT / ".pio/build/uno/firmware.elf").exists()
    ):
        pytest.skip("needs 'make firmware sim'")
    if item.get_closest_marker("ngspice") and not shutil.which("ngspice"):
        _is_missing("ngspice", "ngspice")
    if item.get_closest_marker("browser") and not shutil.which("chromium"):
        _is_missing("Chromium", "chromium")


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
    assert _open_files() == files


def _open_files() -> int:
    return len(list(OPEN_FILES.iterdir())) if OPEN_FILES.exists() else 0


@pytest.fixture
def pty_board() -> Iterator[Callable[[str], PtyServer]]:
    """A function that serves an ``emulator://`` URL at a pseudo-terminal; `close` ends it early."""
    with ExitStack() as stack:

        def serve(url: str) -> PtyServer:
            board, _, faults = emulated(url)
            server = PtyServer(board, faults)
            done = threading.Event()

            def work() -> None:
                while not done.is_set():
                    server.serve(0.05)

            thread = threading.Thread(target=work, name=f"serve {url}")
            thread.start()
            close_files = server.close

            def close() -> None:
                if not done.is_set():
                    done.set()
                    thread.join()
                    close_files()

            server.close = close  # type: ignore[method-assign]
            stack.callback(close)
            return server

        yield serve


Command = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def command() -> Iterator[Command]:
    """A function that starts ``python -m MODULE ARGUMENTS``, MODULE as a rule ohmskin."""
    path = os.pathsep.join([str(Path(ohmskin.__file__).parents[1]), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1", "COLUMNS": "200"}
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str, module: str = "ohmskin") -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """A function that runs ``ohmskin ARGUMENTS`` in this process."""
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: str) -> Done:
        monkeypatch.setattr(sys, "argv", ["ohmskin", *arguments])
        capsys.readouterr()
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        captured = capsys.readouterr()
        return Done(code, captured.out, captured.err)

    return call
