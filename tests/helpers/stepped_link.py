# SPDX-License-Identifier: Apache-2.0
"""An emulated board whose time the test lets pass: nothing depends on how busy the machine is."""

import threading

from ohmskin.errors import DeviceLost
from ohmskin.link.serial_port import READ_TIMEOUT_S
from ohmskin.opening import emulated


class SteppedLink:
    """The board of an ``emulator://`` URL, as a `Link`. Its time passes in `run` alone."""

    resets_board = False

    def __init__(self, url: str) -> None:
        self._board, _, self._faults = emulated(url)
        self.name = url
        self._now_s = 0.0
        self._octets = bytearray()
        self._changed = threading.Condition()
        self._is_read = self._closed = False

    def run(self, seconds: float) -> None:
        """Let time pass; return when the host has decoded all that the board has sent by then."""
        with self._changed:
            self.say(seconds)
            self._changed.wait_for(lambda: self._is_read and not self._octets)

    def say(self, seconds: float) -> None:
        """Let time pass; return at once, for a host that ends by what it hears."""
        with self._changed:
            end_s = self._now_s + seconds
            while (due_s := self._board.next_scan_s) is not None and due_s <= end_s:
                self._advance(due_s)
            self._advance(end_s)

    def _advance(self, now_s: float) -> None:
        self._now_s = now_s
        self._octets += self._faults.apply(self._board.advance(now_s), now_s)
        self._changed.notify_all()

    def read(self) -> bytes:
        with self._changed:
            self._is_read = True  # what was read before is decoded
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._octets or self._closed, READ_TIMEOUT_S)
            octets = bytes(self._octets)
            self._octets.clear()
            self._is_read = not octets
            return octets

    def write(self, octets: bytes) -> None:
        with self._changed:
            if self._closed:
                raise DeviceLost(f"{self.name} is closed")
            self._board.receive(octets)
            self._advance(self._now_s)

    def set_baud(self, baud: int) -> None:
        pass

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
