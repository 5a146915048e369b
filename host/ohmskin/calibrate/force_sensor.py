# SPDX-License-Identifier: Apache-2.0
"""A force sensor at a serial port, which prints one number a line, as sketches for the HX711 do."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from typing import Final

from ohmskin.calibrate.force_log import ForceLineDecoder
from ohmskin.errors import DeviceLost
from ohmskin.files import Closing
from ohmskin.link.serial_port import SerialLink
from ohmskin.record.recording import ForceSample

DEFAULT_BAUD: Final = 115_200
# The opening of its port resets an Arduino: 2 s in its bootloader, then the sketch zeroes the cell.
SILENCE_S: Final = 5.0
# 20 s of the fastest: who takes less often does not want all.
QUEUE_SAMPLES: Final = 2000
# Lines that arrive together were printed one after another: no sensor is slower than 10 Hz.
_LONGEST_STEP_S: Final = 0.1
# Where the clock's steps are coarser than the samples'.
_SHORTEST_STEP_S: Final = 1e-6


class ForceSensor(Closing):
    """Reads forces in a thread of its own, from opening to closing. `take` gives them.

    path: serial port. newtons_per_unit: force of one unit of the printed number [N]; below 0 where
    the sensor is mounted upside down.

    :raises PortError: as `SerialLink`.
    :raises ValueError: newtons_per_unit is 0 or not finite.
    """

    def __init__(self, path: str, baud: int = DEFAULT_BAUD, newtons_per_unit: float = 1.0) -> None:
        if not (math.isfinite(newtons_per_unit) and newtons_per_unit):
            raise ValueError(f"scale is {newtons_per_unit:g}: give the newtons of one unit")
        self.path = path
        self.dropped = 0
        self._baud = baud
        self._newtons_per_unit = newtons_per_unit
        self._link = SerialLink(path, baud)
        self._decoder = ForceLineDecoder()
        self._overflows = 0
        self._octets = 0  # since the last force
        self._changed = threading.Condition()
        self._waiting: deque[ForceSample] = deque()
        self._failure: DeviceLost | None = None
        self._last_s = time.monotonic()
        self._closing = False
        self._thread = threading.Thread(target=self._read, name=f"read {path}", daemon=True)
        self._thread.start()

    @property
    def damaged(self) -> int:
        """How many lines were no number."""
        return self._decoder.damaged + self._overflows

    def take(self) -> list[ForceSample]:
        """The samples since the last call, in order, their times rising. Never waits.

        At most `QUEUE_SAMPLES`; `dropped` counts the older ones that had to go.

        :raises DeviceLost: there are none, and the sensor has gone, or has printed no number for
            `SILENCE_S`.
        """
        with self._changed:
            taken = list(self._waiting)
            self._waiting.clear()
            if not taken:
                self._check()
            return taken

    def wait(self) -> None:
        """Wait for the next sample. Raises DeviceLost as `take`."""
        with self._changed:
            while not self._waiting:
                self._check()
                self._changed.wait(0.1)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if time.monotonic() - self._last_s <= SILENCE_S:
            return
        if not self._octets:
            raise DeviceLost(
                f"{self.path} has said nothing for {SILENCE_S:g} s: is it the force sensor's port, "
                "and does its sketch print?"
            )
        raise DeviceLost(
            f"{self.path} prints no numbers ({self.damaged} damaged lines): it must print one "
            f"number a line and nothing else; is --baud {self._baud} what its sketch says?"
        )

    # ------------------------------------------------------------------------- reader thread

    def _read(self) -> None:
        try:
            while not self._closing:
                octets = self._link.read()
                if octets:
                    self._keep(octets, time.monotonic())
        except DeviceLost:
            with self._changed:
                self._failure = DeviceLost(
                    f"{self.path} is gone: is the force sensor still plugged in?"
                )
                self._changed.notify_all()

    def _keep(self, octets: bytes, now_s: float) -> None:
        with self._changed:
            self._octets += len(octets)
            numbers = self._decoder.feed(octets)
            forces_n = [self._newtons_per_unit * number for number in numbers]
            finite_n = [force_n for force_n in forces_n if math.isfinite(force_n)]
            self._overflows += len(forces_n) - len(finite_n)
            if not finite_n:
                return
            count = len(finite_n)
            step_s = min((now_s - self._last_s) / count, _LONGEST_STEP_S)
            for index, force_n in enumerate(finite_n):
                arrived_s = now_s - (count - 1 - index) * step_s
                self._last_s = max(arrived_s, self._last_s + _SHORTEST_STEP_S)
                self._waiting.append(ForceSample(force_n, self._last_s, source=self.path))
            while len(self._waiting) > QUEUE_SAMPLES:
                self._waiting.popleft()
                self.dropped += 1
            self._octets = 0
            self._changed.notify_all()

    def close(self) -> None:
        """Give the port back. May be called again."""
        self._closing = True
        self._thread.join()
        self._link.close()
