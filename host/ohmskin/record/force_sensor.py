# SPDX-License-Identifier: Apache-2.0
"""A force sensor at a serial port, which prints one number a line, as sketches for the HX711 do."""

import math
import re
import threading
import time
from collections import deque
from typing import Final

from ohmskin.errors import DeviceLost
from ohmskin.files import Closing
from ohmskin.link.serial_port import SerialLink
from ohmskin.record.recording import ForceSample

# Speed of the sensor's line, unless told: that of most sketches.
DEFAULT_BAUD: Final = 115_200
# A sensor without a number for so long counts as lost [s]. The opening of its port resets an
# Arduino: it is 2 s in its bootloader, and then the sketch zeroes the sensor.
SILENCE_S: Final = 5.0
# Samples that are kept for a slow reader: 20 s of the fastest sensor.
QUEUE_SAMPLES: Final = 2000
# Lines that arrive together were printed one after another. No sensor takes longer for one [s].
_LONGEST_STEP_S: Final = 0.1
# Times rise by so much [s] where the clock's steps are longer than those of the samples.
_SHORTEST_STEP_S: Final = 1e-6
_NUMBER: Final = re.compile(rb"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*N?\s*")


class ForceLineDecoder:
    """Forces from what a serial sensor prints: one number a line, perhaps with the unit N.

    What comes before the first end of a line is part of a line, and is dropped. damaged: how many
    lines since then were not blank and no such number. Holds at most `LARGEST_LINE` bytes.
    """

    LARGEST_LINE: Final = 64

    def __init__(self, newtons_per_unit: float = 1.0) -> None:
        self.damaged = 0
        self._newtons_per_unit = newtons_per_unit
        self._partial = b""
        self._skips = True  # the rest of this line: of the first one, or of one that is too long

    def feed(self, octets: bytes) -> list[float]:
        """The forces [N] of the lines that these bytes complete, in order."""
        forces_n: list[float] = []
        *lines, self._partial = re.split(rb"[\r\n]", self._partial + octets)
        for line in lines:
            if line.strip() and not self._skips:
                number = _NUMBER.fullmatch(line) if len(line) <= self.LARGEST_LINE else None
                force_n = self._newtons_per_unit * float(number[1]) if number else math.inf
                if math.isfinite(force_n):
                    forces_n.append(force_n)
                else:
                    self.damaged += 1
            self._skips = False
        if len(self._partial) > self.LARGEST_LINE:
            self._partial = b""
            self.damaged += not self._skips
            self._skips = True
        return forces_n


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
        """Samples that nobody took in time."""
        self._baud = baud
        self._link = SerialLink(path, baud)
        self._decoder = ForceLineDecoder(newtons_per_unit)
        self._changed = threading.Condition()
        self._waiting: deque[ForceSample] = deque(maxlen=QUEUE_SAMPLES)
        self._last_s = time.monotonic()
        self._closing = self._is_gone = False
        self._thread = threading.Thread(target=self._read, name=f"read {path}", daemon=True)
        self._thread.start()

    @property
    def damaged(self) -> int:
        """How many lines were no number."""
        return self._decoder.damaged

    def take(self) -> list[ForceSample]:
        """The samples since the last call, `QUEUE_SAMPLES` at most, times rising. Never waits.

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
        if self._is_gone:
            raise DeviceLost(f"{self.path} is gone: is the force sensor still plugged in?")
        if time.monotonic() - self._last_s <= SILENCE_S:
            return
        trouble = f"no number from {self.path} for {SILENCE_S:g} s ({self.damaged} damaged lines)"
        remedy = f"the force sensor must print one number a line, and that at {self._baud} baud"
        raise DeviceLost(trouble, remedy)

    def _read(self) -> None:
        try:
            while not self._closing:
                octets = self._link.read()
                if octets:
                    self._keep(octets, time.monotonic())
        except DeviceLost:
            self._is_gone = True

    def _keep(self, octets: bytes, now_s: float) -> None:
        with self._changed:
            forces_n = self._decoder.feed(octets)
            if not forces_n:
                return
            self.dropped += max(len(self._waiting) + len(forces_n) - QUEUE_SAMPLES, 0)
            step_s = min((now_s - self._last_s) / len(forces_n), _LONGEST_STEP_S)
            for later, force_n in zip(reversed(range(len(forces_n))), forces_n, strict=True):
                self._last_s = max(now_s - later * step_s, self._last_s + _SHORTEST_STEP_S)
                self._waiting.append(ForceSample(force_n, self._last_s, source=self.path))
            self._changed.notify_all()

    def close(self) -> None:
        """Give the port back. May be called again."""
        self._closing = True
        self._thread.join()
        self._link.close()
