# SPDX-License-Identifier: Apache-2.0
"""A force sensor at a serial port, which prints one number a line, as sketches for the HX711 do.

The HX711 is the usual converter of load cells. A sample's time is that of its arrival here, on the
same clock as the scans, so that both can be recorded side by side (`recorder.record`).
"""

import math
import re
import threading
import time
from collections import deque
from typing import Final

from ohmskin.errors import DeviceLost
from ohmskin.files import Closing
from ohmskin.link.device import SILENCE_TIMEOUT_S
from ohmskin.link.serial_port import SerialLink
from ohmskin.record.recording import ForceSample

# Speed of the sensor's line, unless the user says another. Chosen: that of most sketches.
DEFAULT_BAUD: Final = 115_200
# Samples that are kept for a slow reader. Chosen: 25 s of an HX711, which makes 80 a second at most
# (its data sheet).
QUEUE_SAMPLES: Final = 2000
# Lines that arrive together were printed one after another, with at most so much between them: the
# HX711 makes at least 10 samples a second (its data sheet).
_LONGEST_STEP_S: Final = 0.1
# Times of samples rise by so much at least, even where the clock has the same time for two of them.
# Chosen: shorter than the steps of any sensor.
_SHORTEST_STEP_S: Final = 1e-6
# A number, perhaps with the unit N. "nan" and "inf" are none.
_NUMBER: Final = re.compile(rb"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*N?\s*")


class ForceLineDecoder:
    """Forces from what a serial sensor prints: one number a line, perhaps with the unit N.

    What comes before the first end of a line is perhaps the end of a number: it is dropped. No more
    than `LARGEST_LINE_BYTES` are held, whatever comes.

    damaged: how many lines were no such number, blank ones apart.
    """

    LARGEST_LINE_BYTES: Final = 64

    def __init__(self, newtons_per_unit: float = 1.0) -> None:
        self.damaged = 0
        self._newtons_per_unit = newtons_per_unit
        self._partial = b""
        self._skips = True  # to the end of this line: it is the first one, or too long

    def feed(self, octets: bytes) -> list[float]:
        """The forces [N] of the lines that these bytes complete, in order."""
        forces_n: list[float] = []
        *lines, self._partial = re.split(rb"[\r\n]", self._partial + octets)
        for line in lines:
            if line.strip() and not self._skips:
                number = _NUMBER.fullmatch(line) if len(line) <= self.LARGEST_LINE_BYTES else None
                force_n = self._newtons_per_unit * float(number[1]) if number else math.inf
                if math.isfinite(force_n):
                    forces_n.append(force_n)
                else:
                    self.damaged += 1
            self._skips = False
        if len(self._partial) > self.LARGEST_LINE_BYTES:
            self._partial = b""
            self.damaged += not self._skips
            self._skips = True
        return forces_n


class ForceSensor(Closing):
    """Reads forces in a thread of its own, from opening to closing. `take` gives them.

    path: serial port.
    baud: speed of its line.
    newtons_per_unit: force of one unit of the printed number [N]; below 0 where the sensor is
        mounted upside down.

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
            `SILENCE_TIMEOUT_S`.
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
        """Raise DeviceLost if no sample is to be expected any more."""
        if self._is_gone:
            raise DeviceLost(f"{self.path} is gone: is the force sensor still plugged in?")
        if time.monotonic() - self._last_s <= SILENCE_TIMEOUT_S:
            return
        trouble = (
            f"no number from {self.path} for {SILENCE_TIMEOUT_S:g} s ({self.damaged} damaged lines)"
        )
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
        """Keep the samples that these bytes complete, which were read at `now_s`.

        The system may give several lines at once. Their times are spread over the time since the
        last sample, because the sensor printed them at equal steps.
        """
        with self._changed:
            forces_n = self._decoder.feed(octets)
            if not forces_n:
                return
            self.dropped += max(len(self._waiting) + len(forces_n) - QUEUE_SAMPLES, 0)
            step_s = min((now_s - self._last_s) / len(forces_n), _LONGEST_STEP_S)
            for number, force_n in enumerate(forces_n, start=1):
                time_s = now_s - (len(forces_n) - number) * step_s
                self._last_s = max(time_s, self._last_s + _SHORTEST_STEP_S)
                self._waiting.append(ForceSample(force_n, self._last_s, source=self.path))
            self._changed.notify_all()

    def close(self) -> None:
        """Give the port back. May be called again."""
        self._closing = True
        self._thread.join()
        self._link.close()
