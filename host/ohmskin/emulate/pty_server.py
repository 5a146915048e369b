# SPDX-License-Identifier: Apache-2.0
"""An emulated board at a pseudo-terminal, which programs can open like a serial port."""

import os
import select
import time
from typing import Final

from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.line_faults import Faults
from ohmskin.errors import PortError
from ohmskin.files import Closing

# Without scans, faults that are due are looked for as often as this [s].
_IDLE_S: Final = 0.2
# Largest number of bytes taken from the host at once.
_READ_SIZE: Final = 4096


class PtyServer(Closing):
    """Serves `board` in real time at `path`, for as long as `serve` runs.

    Bytes that no program takes are thrown away, as a serial port does that nobody has open.
    `dropped_bytes` counts them.

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
        """Serve for `seconds`, or until the faults let the board vanish."""
        end_s = self._now_s() + seconds
        while (now := self._now_s()) < end_s and not self._faults.vanished(now):
            self._write(self._board.heard(self._faults, now))
            wake_s = min(now + _IDLE_S, end_s, self._board.next_scan_s or end_s)
            if select.select([self._master], [], [], max(0.0, wake_s - self._now_s()))[0]:
                self._write(self._board.heard(self._faults, self._now_s()))
                self._board.receive(os.read(self._master, _READ_SIZE))

    def _now_s(self) -> float:
        return time.monotonic() - self._begin_s

    def _write(self, octets: bytes) -> None:
        try:
            self.dropped_bytes += len(octets) - (os.write(self._master, octets) if octets else 0)
        except BlockingIOError:
            self.dropped_bytes += len(octets)

    def close(self) -> None:
        """Take the pseudo-terminal away."""
        os.close(self._master)
        os.close(self._slave)
