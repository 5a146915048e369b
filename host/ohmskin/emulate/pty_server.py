# SPDX-License-Identifier: Apache-2.0
"""An emulated board at a pseudo-terminal, which any program can open like a serial port."""

from __future__ import annotations

import os
import select
import time
from typing import Final

from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.line_faults import Faults
from ohmskin.errors import PortError
from ohmskin.files import Closing

_IDLE_S: Final = 0.2
_READ_SIZE: Final = 4096


class PtyServer(Closing):
    """Serves `board` in real time at `path`; nothing but `serve` does any work.

    Bytes that no program takes are thrown away, as by a serial port that nobody has open.

    :raises PortError: this system has no pseudo-terminals.
    """

    def __init__(self, board: EmulatedBoard, faults: Faults | None = None) -> None:
        try:
            import tty
        except ImportError as exc:
            raise PortError("this system has no pseudo-terminals: use emulator:// itself") from exc
        self._board = board
        self._faults = faults or Faults()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.dropped_bytes = 0
        self._begin_s = time.monotonic()

    def serve(self, seconds: float = float("inf")) -> None:
        """Serve for so long, or until the faults let the board vanish."""
        end_s = self._now_s() + seconds
        while (now := self._now_s()) < end_s and not self._faults.vanished(now):
            if self._faults.resets(now):
                self._board.reset()
            self._write(self._faults.apply(self._board.advance(now), now))
            due = self._board.next_scan_s
            wake_s = min(now + _IDLE_S, end_s, float("inf") if due is None else due)
            if select.select([self._master], [], [], max(0.0, wake_s - self._now_s()))[0]:
                self._write(self._faults.apply(self._board.advance(self._now_s()), now))
                self._board.receive(os.read(self._master, _READ_SIZE))

    def _now_s(self) -> float:
        return time.monotonic() - self._begin_s

    def _write(self, octets: bytes) -> None:
        if not octets:
            return
        try:
            self.dropped_bytes += len(octets) - os.write(self._master, octets)
        except BlockingIOError:
            self.dropped_bytes += len(octets)

    def close(self) -> None:
        """Take the pseudo-terminal away."""
        os.close(self._master)
        os.close(self._slave)
