# SPDX-License-Identifier: Apache-2.0
"""What a force sensor said, by its own clock: from a CSV, or line by line from its serial port.

A log is a CSV with the columns time_s [s] and force_n [N], a press being positive; further columns
are ignored. A sensor on a serial port prints one number [N] a line.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.number_table import naming, other_units, read_numbers

MIN_SAMPLES: Final = 10
# A step is a gap only if it is both: slow sensors have long steps, fast ones short hiccups.
GAP_S: Final = 0.5
GAP_STEPS: Final = 10.0
# Noise about zero goes below it by so much: in newtons, or as a share of the largest force.
NEGATIVE_N: Final = 0.05
NEGATIVE_SHARE: Final = 0.02

# What a force in another unit is multiplied by.
NEWTONS: Final = {
    "n": "1",
    "mn": "0.001",
    "kn": "1000",
    "g": "0.00980665",
    "gf": "0.00980665",
    "kg": "9.80665",
    "kgf": "9.80665",
    "lb": "4.44822",
    "lbf": "4.44822",
}
_SECONDS: Final = {"s": "1", "ms": "0.001", "us": "1e-6", "ns": "1e-9", "min": "60", "h": "3600"}
_INSTEAD: Final = {
    **other_units("time_s", ("time", "t", "timestamp"), _SECONDS),
    **other_units("force_n", ("force", "f", "fz", "load", "weight", "mass"), NEWTONS),
}


@dataclass(frozen=True, eq=False)
class ForceLog:
    """Forces by the sensor's clock: time_s (n,) [s], increasing; force_n (n,) [N]; source: what by.

    Raises ValueError, naming the sample from 0, for fewer than 10 of them, for times that do not
    increase, for a force that never changes, and for presses that are negative. Sensor noise about
    zero may be: down to 0.05 N, or 2 % of the largest force.
    """

    time_s: Float
    force_n: Float
    source: str

    def __post_init__(self) -> None:
        if self.time_s.ndim != 1 or self.time_s.shape != self.force_n.shape:
            raise ValueError(
                f"time_s has shape {self.time_s.shape}, force_n {self.force_n.shape}: not (n,) both"
            )
        sample, fault = _fault(self.time_s, self.force_n)
        if fault:
            raise ValueError(fault if sample is None else f"sample {sample}: {fault}")

    @property
    def gaps(self) -> Float:
        """Begin and end of each gap [s], (k, 2): steps above 0.5 s and 10 times the median step."""
        before = np.flatnonzero(_is_gap(self.time_s))
        return np.stack([self.time_s[before], self.time_s[before + 1]], axis=1)

    def at(self, time_s: ArrayLike) -> Float:
        """Force [N] at these times of the sensor's clock, of any shape: linear between samples.

        NaN before the first sample, after the last, and inside gaps.
        """
        return between_gaps(time_s, self.time_s, self.force_n)


def between_gaps(at_s: ArrayLike, time_s: Float, values: Float) -> Float:
    """`values` (n,) of times `time_s` (n,), increasing, interpolated at `at_s` of any shape.

    NaN outside of `time_s`, and inside its gaps (see `ForceLog.gaps`).
    """
    wanted = np.asarray(at_s, dtype=np.float64)
    found = np.asarray(np.interp(wanted, time_s, values, left=np.nan, right=np.nan))
    after = np.searchsorted(time_s, wanted).clip(1, time_s.size - 1)
    inside = (wanted > time_s[after - 1]) & (wanted < time_s[after])
    return np.where(inside & _is_gap(time_s)[after - 1], np.nan, found)


def _is_gap(time_s: Float) -> NDArray[np.bool_]:
    steps = np.diff(time_s)
    return np.asarray((steps > GAP_S) & (steps > GAP_STEPS * np.median(steps)))


def _fault(time_s: Float, force_n: Float) -> tuple[int | None, str]:
    """What is wrong, and with which sample if with one; an empty text: nothing."""
    if time_s.size < MIN_SAMPLES:
        are = "sample is" if time_s.size == 1 else "samples are"
        return None, f"{time_s.size} {are} too few: {MIN_SAMPLES} are needed"
    for name, values in (("time_s", time_s), ("force_n", force_n)):
        bad = ~np.isfinite(values)
        if bad.any():
            return int(np.argmax(bad)), f"{name} is not finite"
    back = np.diff(time_s) <= 0
    if back.any():
        sample = int(np.argmax(back)) + 1
        was, now = float(time_s[sample - 1]), float(time_s[sample])
        return sample, f"time_s is {now!r} after {was!r}: it must increase"
    if np.all(force_n == force_n[0]):
        return None, f"force_n is {force_n[0]:g} throughout: does the sensor measure?"
    limit = max(NEGATIVE_N, NEGATIVE_SHARE * float(force_n.max()))
    below = force_n < -limit
    if np.count_nonzero(below) > np.count_nonzero(force_n > limit):
        least = float(force_n.min())
        return None, f"forces go down to {least:g} N, a press is negative: turn the sign"
    if below.any():
        sample = int(np.argmax(below))
        return sample, f"force_n is {force_n[sample]:g}, below -{limit:.2g} N: zero the sensor"
    return None, ""


def load_force_log(path: str | os.PathLike[str]) -> ForceLog:
    """Read a log; its source is the file's name.

    Raises ValueError, one line that names the file and the row (the header is row 1).
    """
    with naming(path):
        table = read_numbers(path, ("time_s", "force_n"), others=True, instead=_INSTEAD)
        time_s, force_n = table.columns["time_s"], table.columns["force_n"]
        sample, fault = _fault(time_s, force_n)
        if fault:
            raise ValueError(fault if sample is None else f"row {table.rows[sample]}: {fault}")
        return ForceLog(time_s, force_n, os.path.basename(os.fspath(path)))


class ForceLineDecoder:
    """Forces from what a serial sensor prints: one number [N] a line, perhaps with the unit N.

    What comes before the first end of a line is part of a line, and dropped. `damaged`: how many
    lines since then were not blank and no such number. Holds at most `LARGEST_LINE` bytes.
    """

    LARGEST_LINE: Final = 64

    def __init__(self) -> None:
        self.damaged = 0
        self._line = bytearray()
        self._skip = True  # the rest of this line: the first, or one too long

    def feed(self, octets: bytes) -> list[float]:
        """The forces [N] that these bytes complete, in order."""
        forces: list[float] = []
        *whole, rest = re.split(rb"[\r\n]", octets)
        for part in whole:
            self._take(part)
            if self._line.strip():
                force_n = _force_of(bytes(self._line))
                if force_n is None:
                    self.damaged += 1
                else:
                    forces.append(force_n)
            self._line.clear()
            self._skip = False
        self._take(rest)
        return forces

    def _take(self, part: bytes) -> None:
        if self._skip:
            return
        if len(self._line) + len(part) > self.LARGEST_LINE:
            self.damaged += 1
            self._line.clear()
            self._skip = True
        else:
            self._line += part


_LINE: Final = re.compile(rb"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*N?\s*")


def _force_of(line: bytes) -> float | None:
    match = _LINE.fullmatch(line)
    force_n = float(match[1]) if match else math.inf
    return force_n if math.isfinite(force_n) else None
