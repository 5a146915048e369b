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
from dataclasses import dataclass
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


@dataclass
class Served:
    """That process.

    ports: of its boards.
    said: at the end, the JSON that it printed last.
    """

    ports: list[str]
    said: Any = None


@contextmanager
def served(script: str, count: int = 1) -> Iterator[Served]:
    """A process that runs ``SCRIPT --serve``, until the body ends."""
    command = [sys.executable, script, "--serve"]
    pipe = subprocess.PIPE
    # It imports what this process can.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)
    assert process.stdout is not None
    boards = Served([process.stdout.readline().strip() for _ in range(count)])
    try:
        yield boards
    finally:
        out, _ = process.communicate(timeout=20)
        boards.said = json.loads(out)


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
