# SPDX-License-Identifier: Apache-2.0
"""Runs an emulated board, behind a line with faults: in this process, or at a pseudo-terminal.

A program that opens ``emulator://`` gets a `Session` over an `EmulatorLink`, in real time. With
``speed=0`` it gets a `SteppedSkin` over a `SteppedLink`, whose time passes only while somebody
waits.
"""

import math
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from io import DEFAULT_BUFFER_SIZE

from ohmskin.ctrl_c import Condition
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.faults import LineFaults
from ohmskin.emulate.scale import EmulatedScale
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing
from ohmskin.link.serial_port import READ_TIMEOUT_S
from ohmskin.link.session import Session


class _Running:
    """A board that is switched on now. `begin_s`: when that was, on the host's clock [s]."""

    def __init__(self, board: EmulatedBoard, faults: LineFaults | None) -> None:
        self.board = board
        self.begin_s = time.monotonic()
        self._faults = faults or LineFaults()

    def now_s(self) -> float:
        """The time since the board was switched on [s]."""
        return time.monotonic() - self.begin_s


class EmulatorLink(_Running):
    """A running board as a `Link`."""

    resets_board = False

    def __init__(
        self, board: EmulatedBoard, name: str = "emulated board", faults: LineFaults | None = None
    ) -> None:
        super().__init__(board, faults)
        self.name = name
        self._wake = Condition()
        self._arrived = bytearray()  # what the host has not read yet
        self._closed = False

    def read(self, limit_s: float = READ_TIMEOUT_S) -> bytes:
        """See `Link.read`; waits for `limit_s` at most."""
        with self._wake:
            end_s = self.now_s() + limit_s
            while (now_s := self._listen()) < end_s and not self._arrived:
                due_s = min(end_s, self.board.next_scan_s or end_s)
                self._pass(due_s - now_s)
            octets, self._arrived = bytes(self._arrived), bytearray()
            return octets

    def _pass(self, limit_s: float) -> None:
        """Wait, holding `_wake`, until the host writes something, or for `limit_s`."""
        self._wake.wait(limit_s)

    def write(self, octets: bytes) -> None:
        """See `Link.write`."""
        with self._wake:
            self._listen()
            self.board.receive(octets)
            self._wake.notify_all()

    def _listen(self) -> float:
        """Take what arrives from the board by now; return the time since it was switched on [s]."""
        now_s = self.now_s()
        if self._closed or self._faults.vanished(now_s):
            raise DeviceLost(f"{self.name} is gone: is the board still plugged in?")
        self._arrived += self.board.heard(self._faults, now_s)
        return now_s

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`: an emulated line has no speed."""

    def close(self) -> None:
        """See `Link.close`."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()


class SteppedLink(EmulatorLink):
    """As `EmulatorLink`, but its time begins at 0 and passes only in `read`, which never waits."""

    _stepped_s = 0.0

    def now_s(self) -> float:
        """See `_Running.now_s`."""
        return self._stepped_s

    def _pass(self, limit_s: float) -> None:
        # Even a step that is smaller than the resolution of a float changes the time. Without this,
        # a loop that waits for a time might never end.
        self._stepped_s = max(self._stepped_s + limit_s, math.nextafter(self._stepped_s, math.inf))


class SteppedSkin(Session):
    """An emulated board whose time passes only while somebody waits for it: ``speed=0``.

    A program that takes a scan lets time pass until the board has sent it. This takes as long as
    the machine needs to compute the scan. There is no thread, so every run of a program is the
    same.
    `host_time_s` of a scan is the time since the board was switched on.
    """

    def __init__(self, link: SteppedLink) -> None:
        self._stepped = link
        super().__init__(link)

    @property
    def now_s(self) -> float:
        """The time since the board was switched on [s]."""
        return self._stepped.now_s()

    def step(self, seconds: float) -> None:
        """Let time pass. What the board sends meanwhile is received, and can be taken afterwards.

        :raises DeviceLost: the board went away.
        """
        self._wait(lambda: False, seconds)

    def _begin_thread(self, work: Callable[[], None], name: str) -> None:
        """Nothing reads by itself."""

    def _wait(self, ready: Callable[[], bool], limit_s: float) -> bool:
        """See `Device._wait`. Reads meanwhile, because no thread does."""
        end_s = self.now_s + limit_s
        with self._changed:
            while not ready() and self._failure is None and self.now_s < end_s:
                self._run(lambda: self._take_next(end_s - self.now_s))
            return super()._wait(ready, 0.0)

    def _take_next(self, limit_s: float) -> None:
        # A step is no longer than a read of a thread would be, because faults are looked for once a
        # step.
        self._take(self._stepped.read(min(limit_s, READ_TIMEOUT_S)))


class PtyServer(_Running, Closing):
    """Serves a running board at `path`, and a scale at `scale_path`, while `serve` runs.

    scale: the scale under the skin; None: there is none, and `scale_path` is "".

    Bytes that no program takes are thrown away, as by a serial port that nobody has open.
    `lost_bytes` counts them.

    :raises PortError: this system has no pseudo-terminals.
    """

    def __init__(
        self,
        board: EmulatedBoard,
        faults: LineFaults | None = None,
        scale: EmulatedScale | None = None,
    ) -> None:
        super().__init__(board, faults)
        self.lost_bytes = 0
        self._closing, self._serving = False, threading.Lock()
        self._files: list[int] = []
        self._scale = scale
        self._master, self.path = self._open()
        self._scale_master, self.scale_path = (-1, "") if scale is None else self._open()

    def _open(self) -> tuple[int, str]:
        """A new pseudo-terminal: our end, and the path of the other one."""
        try:
            import tty
        except ImportError as exc:
            raise PortError("this system has no pseudo-terminals: use emulator:// itself") from exc
        master, slave = os.openpty()
        self._files += [master, slave]
        tty.setraw(slave)
        os.set_blocking(master, False)
        return master, os.ttyname(slave)

    def serve(self, seconds: float = float("inf")) -> None:
        """Serve for `seconds`, until `close`, or until the faults let the board vanish."""
        end_s = self.now_s() + seconds
        with self._serving:
            while not self._closing and (now_s := self.now_s()) < end_s:
                if self._faults.vanished(now_s):
                    break
                self._write(self._master, self.board.heard(self._faults, now_s))
                wake_s = min(now_s + READ_TIMEOUT_S, end_s, self.board.next_scan_s or end_s)
                if self._scale is not None:
                    self._write(self._scale_master, self._scale.heard(now_s))
                    wake_s = min(wake_s, self._scale.next_s)
                if select.select([self._master], [], [], max(0.0, wake_s - self.now_s()))[0]:
                    self._write(self._master, self.board.heard(self._faults, self.now_s()))
                    # All that has come: Linux keeps 4096 bytes, and this reads more.
                    self.board.receive(os.read(self._master, DEFAULT_BUFFER_SIZE))

    def _write(self, master: int, octets: bytes) -> None:
        taken = 0
        with suppress(BlockingIOError):
            taken = os.write(master, octets)
        self.lost_bytes += len(octets) - taken

    def close(self) -> None:
        """End `serve`, and take the pseudo-terminal away. May be called again, by any thread."""
        self._closing = True
        with self._serving:  # `serve` lets it go within READ_TIMEOUT_S
            while self._files:
                os.close(self._files.pop())
