# SPDX-License-Identifier: Apache-2.0
"""Emulated boards in a process of their own, and what a process uses of the processor."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.driver import PtyServer
from ohmskin.emulate.faults import LineFaults


def serve(boards: Sequence[EmulatedBoard], line: LineFaults | None = None) -> list[PtyServer]:
    """In that process: print the boards' ports, and serve them until stdin closes."""
    with ExitStack() as stack:
        servers = [stack.enter_context(PtyServer(board, line)) for board in boards]
        for server in servers:
            threading.Thread(target=server.serve, daemon=True).start()
            print(server.path, flush=True)
        sys.stdin.read()
    return servers


class Served:
    """That process. ports: of its boards. said: at the end, the JSON that it printed last."""

    def __init__(self, script: str, count: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, script, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.ports = [self._process.stdout.readline().strip() for _ in range(count)]
        self.said: Any = None

    def end(self) -> None:
        out, _ = self._process.communicate(timeout=20)
        self.said = json.loads(out)


@contextmanager
def served(script: str, count: int = 1) -> Iterator[Served]:
    """A process that runs ``SCRIPT --serve``, until the body ends."""
    process = Served(script, count)
    try:
        yield process
    finally:
        process.end()


@contextmanager
def started(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process of the command line ``ohmskin ARGUMENTS``, and the first line that it prints."""
    command = [sys.executable, "-m", "ohmskin", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.communicate(timeout=20)


class Load:
    """What this process uses of a core, since the object was made."""

    def __init__(self) -> None:
        self._used_s, self._begin_s = self._now_s()

    def percent(self) -> float:
        """User and system time over wall time."""
        used_s, now_s = self._now_s()
        return 100 * (used_s - self._used_s) / (now_s - self._begin_s)

    def seconds(self) -> float:
        """Wall time."""
        return time.monotonic() - self._begin_s

    @staticmethod
    def _now_s() -> tuple[float, float]:
        used = os.times()
        return used.user + used.system, time.monotonic()
