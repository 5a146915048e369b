# SPDX-License-Identifier: Apache-2.0
"""A force sensor at a serial port: a load cell's board, a scale, a force-torque sensor.

A sample's time is that of its arrival here, on the same clock as the scans, so that both can be
recorded side by side (`recorder.record`). docs/calibrate.md lists the lines that are read.
"""

import math
import re
import threading
import time
from collections import deque
from typing import Final

from ohmskin.ctrl_c import Condition
from ohmskin.errors import DeviceLost
from ohmskin.files import Closing
from ohmskin.link.device import SILENCE_TIMEOUT_S
from ohmskin.link.serial_port import SerialLink
from ohmskin.record.recording import ForceSample

# Speed of the sensor's line, unless the user says another. Chosen: that of most sketches.
DEFAULT_BAUD: Final = 115_200
# So many samples are kept for a slow reader. Chosen: 25 s of an HX711, which makes at most 80 a
# second (its data sheet).
QUEUE_SAMPLES: Final = 2000
# Lines that arrive together were printed one after another, with at most this time between them
# [s]: the HX711 makes at least 10 samples a second (its data sheet).
_LONGEST_STEP_S: Final = 0.1
# The time of a sample is later than that of the one before by at least this, even where the clock
# has the same time for both [s]. Chosen: shorter than the steps of any sensor.
_SHORTEST_STEP_S: Final = 1e-6
# One of each unit in newtons [N]. Weights are by standard gravity (CGPM, 1901).
NEWTONS: Final = {"N": 1.0, "g": 0.00980665, "kg": 9.80665}
_NEWTONS_BY_LOWER: Final = {unit.lower(): newtons for unit, newtons in NEWTONS.items()}
# A number, perhaps with its unit. "nan" and "inf" are no numbers here, nor is a text with more
# digits than any sensor prints. Scales may print spaces after the sign.
_NUMBER: Final = r"(?P<number>[-+]? *(?:\d{1,20}\.?\d{0,20}|\.\d{1,20})(?:E[-+]?\d{1,3})?)"
_UNIT: Final = r"(?P<unit>kg|g|N)"
_FIELD: Final = re.compile(rf"\s*{_NUMBER}\s*{_UNIT}?\s*", re.IGNORECASE)
# Before the number, a scale may print whether the number is stable, and whether it is gross or net;
# some scales print "?" after it. Whatever else a scale says (that it is overloaded, a preset tare)
# is no force.
_STATE: Final = r"(?:(?:ST|US|S|D)[ ,]+)?(?:(?:S|D|GS|NT|G|N)[ ,]+)?"
_OF_SCALE: Final = re.compile(rf"\s*{_STATE}{_NUMBER}(?:[\s,]*{_UNIT})?[\s?]*", re.IGNORECASE)
_COMMAS: Final = re.compile(r"[,;\t]")
# Two numbers with a comma between them that may be one number with a decimal comma.
_DECIMAL_COMMA: Final = re.compile(r"[-+\s]*\d+,\d+[^.\d]*")
# They are taken for a time and a force once the first of them has risen so often. A number that has
# a unit is never such a force. Chosen: as long as nobody presses, the whole part of a force does
# not rise so often.
_RISES_OF_TIME: Final = 8
# Where the first of them does not rise, as a time where the sensor is reset, so many rises more are
# needed. Chosen: a force that is pressed and let go rises more seldom for each time that it falls.
_RISES_OF_BREAK: Final = 100
# If so many lines in a row have another number of fields than those before, it counts from now on.
# Chosen: no damage does the same to so many lines.
_LINES_THAT_AGREE: Final = 10
# An error shows so many characters of a line. Chosen: enough to recognise the line.
_SHOWN_CHARS: Final = 40


class ForceLineDecoder:
    """Forces from what a serial sensor prints; docs/calibrate.md lists the lines that it knows.

    newtons_per_unit: the force is so many times what a line says.
    unit: of lines that state none, a key of `NEWTONS`; "": newtons, unless other lines state one.
    column: which field of a line has the force: its name in a header, or its number from 1; "": the
        only field, or the second of two.

    What comes before the first end of a line is dropped, unless it is a header, because it may be
    the last part of a number. No more than `LARGEST_LINE_BYTES` are held, whatever comes.

    damaged: how many lines had no force that could be read; blank lines and headers do not count.
    last_damaged: the newest of these lines, cut to some characters.

    :raises ValueError: no such unit, or column is 0.
    """

    LARGEST_LINE_BYTES: Final = 256

    def __init__(self, newtons_per_unit: float = 1.0, unit: str = "", column: str = "") -> None:
        if unit and unit not in NEWTONS:
            raise ValueError(f"no unit '{unit:.20}' of force: there are {', '.join(NEWTONS)}")
        self.damaged = 0
        self.last_damaged = ""
        self._newtons_per_unit, self._unit, self._column = newtons_per_unit, unit, column
        self._place = int(column) - 1 if column.isdecimal() else -1  # -1: no header has come
        if column and not column.strip("0"):
            raise ValueError("there is no column 0 of force: the first one is 1")
        # How many fields lines with a force have; 0: none has come. Of the newest such lines, too,
        # unless a header has told: a sensor may print something else first.
        self._fields, self._newest = 0, deque[int](maxlen=_LINES_THAT_AGREE)
        self._is_stated = False  # whether a line has stated its unit
        # The first number of the last line, if it may be a time, and how often it has risen; below
        # 0: how many rises more it takes to make good what did not rise.
        self._time, self._rises = -math.inf, -1
        self._partial = b""
        self._skips = True  # what comes until this line ends: the line is the first, or too long

    def feed(self, octets: bytes) -> list[float]:
        """The forces [N] of the lines that these bytes complete, in order."""
        forces_n: list[float] = []
        *lines, self._partial = re.split(rb"[\r\n]", self._partial + octets)
        for each in lines:
            line = each[: self.LARGEST_LINE_BYTES + 1].decode("ascii", "replace")
            # The first line is a header where opening the port resets the sensor.
            if line.strip() and not self._is_header(line) and not self._skips:
                force_n = self._force_n(line) if len(line) <= self.LARGEST_LINE_BYTES else math.inf
                if math.isfinite(force_n):
                    forces_n.append(force_n)
                else:
                    self._damage(line)
            self._skips = False
        if len(self._partial) > self.LARGEST_LINE_BYTES:
            if not self._skips:
                self._damage(self._partial[:_SHOWN_CHARS].decode("ascii", "replace"))
            self._partial = b""
            self._skips = True
        return forces_n

    def _damage(self, line: str) -> None:
        self.damaged += 1
        self.last_damaged = line[:_SHOWN_CHARS]

    def _is_header(self, line: str) -> bool:
        """Whether a line names the column that is wanted. If so, its place is noted."""
        names = [name.strip().lower() for name in _COMMAS.split(line)]
        if not self._column or self._column.isdecimal() or self._column.lower() not in names:
            return False
        self._place, self._fields = names.index(self._column.lower()), len(names)
        return True

    def _force_n(self, line: str) -> float:
        """The force that a line states [N]; infinite: it states none, or it is not sure which."""
        found = self._in_column(line) if self._column else self._alone(line)
        if found is None:
            return math.inf
        unit = (found["unit"] or "").lower()
        if unit:
            self._is_stated = True
        elif self._is_stated and not self._unit:  # some scales print no unit while they move
            return math.inf
        scale = self._newtons_per_unit * _NEWTONS_BY_LOWER[unit or self._unit.lower() or "n"]
        return scale * float(found["number"].replace(" ", ""))

    def _in_column(self, line: str) -> re.Match[str] | None:
        """The wanted column of a line; None if the line has not as many fields as the others."""
        fields = _COMMAS.split(line)
        if not 0 <= self._place < len(fields):
            return None
        found = _FIELD.fullmatch(fields[self._place])
        if found and self._column.isdecimal():
            self._newest.append(len(fields))
            agree = self._newest.count(len(fields)) == _LINES_THAT_AGREE
            if agree or not self._fields:
                self._fields = len(fields)
        return found if len(fields) == self._fields else None

    def _alone(self, line: str) -> re.Match[str] | None:
        """The number of a line that has only this number, or a time and this number."""
        if found := _OF_SCALE.fullmatch(line):
            return found
        time, *others = map(_FIELD.fullmatch, _COMMAS.split(line))
        if time is None or time["unit"] or len(others) != 1:
            return None
        time_s = float(time["number"].replace(" ", ""))
        rises = time_s > self._time
        self._rises = self._rises + 1 if rises else min(self._rises, 0) - _RISES_OF_BREAK
        self._time = time_s
        is_time = self._rises >= _RISES_OF_TIME and others[0] and not others[0]["unit"]
        return None if _DECIMAL_COMMA.fullmatch(line) and not is_time else others[0]


class ForceSensor(Closing):
    """Reads forces in a thread of its own, from opening to closing. `take` gives them.

    path: serial port.
    baud: speed of its line.
    newtons_per_unit, unit, column: as for `ForceLineDecoder`; newtons_per_unit is below 0 where the
        sensor is mounted upside down.

    :raises PortError: as `SerialLink`.
    :raises ValueError: newtons_per_unit is 0 or not finite, or there is no such unit or column.
    """

    def __init__(
        self,
        path: str,
        baud: int = DEFAULT_BAUD,
        newtons_per_unit: float = 1.0,
        unit: str = "",
        column: str = "",
    ) -> None:
        if not (math.isfinite(newtons_per_unit) and newtons_per_unit):
            raise ValueError(f"scale is {newtons_per_unit:g}: give the newtons of one unit")
        self.path = path
        self.dropped = 0
        """Samples that nobody took in time."""
        self._baud = baud
        self._decoder = ForceLineDecoder(newtons_per_unit, unit, column)
        self._link = SerialLink(path, baud)
        self._changed = Condition()
        self._waiting: deque[ForceSample] = deque(maxlen=QUEUE_SAMPLES)
        self._last_s = time.monotonic()
        self._closing = self._is_gone = False
        self._thread = threading.Thread(target=self._read, name=f"read {path}", daemon=True)
        self._thread.start()

    @property
    def damaged(self) -> int:
        """How many lines could not be read."""
        return self._decoder.damaged

    def take(self) -> list[ForceSample]:
        """The samples since the last call, in order of time. Never waits.

        If there were more than `QUEUE_SAMPLES`, the oldest of them are lost, and `dropped` counts
        them.

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
        last = f", the last one {self._decoder.last_damaged!r}" if self.damaged else ""
        lines = f"{self.damaged} damaged lines{last}"
        problem = f"no force from {self.path} for {SILENCE_TIMEOUT_S:g} s ({lines})"
        remedy = (
            f"the force sensor must print one number a line at {self._baud} baud, without being "
            "asked; of several numbers, say the --force-column"
        )
        raise DeviceLost(problem, remedy)

    def _read(self) -> None:
        try:
            while not self._closing:
                self._keep(self._link.read(), time.monotonic())
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
