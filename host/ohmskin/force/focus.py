# SPDX-License-Identifier: Apache-2.0
"""Reading follows the contacts: a region around them, and whole scans in between.

A region of a few lines is read several times as often as the whole skin. It does not show a touch
that is elsewhere, so whole scans come in between, `WHOLE_HZ` times a second. And a new touch in a
region may be the ghost of touches outside. So may a touch that seems to grow along rows and columns
at once, as three touches outside let it, at the other corners of a rectangle. And where no touches
in the region explain what it reads, something has changed outside. In all these cases, the next
scan is a whole one.
"""

import threading
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool
from ohmskin.circuit.configurations import is_near
from ohmskin.errors import OhmskinError
from ohmskin.files import Closing
from ohmskin.link.device import Device, Region
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import MODES

# Whole scans come at least so often [Hz]. Chosen: a new touch is seen within a tenth of a second,
# even if it comes just after a whole scan; this includes the time of the scan, of its way to the
# host and of its estimate.
WHOLE_HZ: Final = 18.0
# So many lines on each side of the touched ones are read, too. Chosen: a fingertip that moves by a
# line is still inside when the next region is asked for.
MARGIN: Final = 1
# A region stays while it has at most so many lines more than it needs. Chosen: a fingertip that
# trembles needs no new region, and each command takes some milliseconds.
SPARE: Final = 1
# If a region would have a larger share of the cells, the whole skin is read, which takes hardly
# longer. Chosen.
MOST_SHARE: Final = 0.6
# How regions are read, unless told: as fast as they are still accurate (docs/accuracy.md).
FOLLOWING: Final = Region(mode="near", whole_mode="near")
# One in so many scans is a whole one, until the board has said how long scans take.
_FIRST_EVERY: Final = 20
# A region is asked for at most so often: once more if the board's answer shows that whole scans
# would come too often or too seldom.
_TRIES: Final = 2


class Lines(NamedTuple):
    """Rows and columns of a region, as ranges of their numbers."""

    rows: range
    columns: range


class Focus(Closing):
    """Tells a board where to read next, scan after scan, until it is closed.

    like: how the region is read, and the whole skin in between. Rows and columns are those of the
        contacts, and `whole_every` is what `WHOLE_HZ` needs. Where `settle_us` is 0, it is the one
        that the board was asked for.

    :raises CommandRefused: the board has no regions, or is a recording.
    :raises DeviceLost: the board does not answer.
    :raises ValueError: the board reads far ends, which no region shows, or `like` says so.
    """

    def __init__(self, device: Device, like: Region = FOLLOWING) -> None:
        # A settle time that the board was asked for is what the lines of this skin need.
        self._settle_us = device.info.settle_asked_us
        self._device = device
        self._like = replace(like, settle_us=like.settle_us or self._settle_us)
        self._lines: Lines | None = None
        self._contact_count = 0
        self._lock, self._closed = threading.Lock(), False
        self._before = Region.of(device.info)
        if (like.rows, like.columns, like.whole_every) != (None, None, 0):
            raise ValueError("rows, columns and whole_every follow the contacts: leave them out")
        if device.info.reads_far:
            raise ValueError(
                "only near ends can be followed: 'ohmskin configure PORT --mode near --save'"
            )
        for mode in (like.mode, like.whole_mode):
            if mode not in MODES or not is_near(MODES[mode]):
                raise ValueError(f"contacts are followed in mode near, half or quick, not {mode}")
        # How long a scan of a region takes for each of its cells, and a whole scan [s].
        self._cell_s = self._whole_s = 0.0
        self._ask(None)

    def follow(
        self, touched: Bool, contact_count: int, scan: Scan, *, is_doubted: bool = False
    ) -> None:
        """Tell what a scan has shown: touched cells (R, C), and so many contacts.

        is_doubted: its region does not explain what it reads.

        If another region is needed, this gives a command to the board. It takes some milliseconds,
        in which scans wait.

        :raises CommandRefused: the board refuses the region, as where it is too much for the rate.
        :raises DeviceLost: the board does not answer.
        """
        is_new, self._contact_count = contact_count > self._contact_count, contact_count
        lines = wanted_lines(touched, self._lines)
        if not scan.is_whole and (is_doubted or is_new or _has_grown(lines, self._lines)):
            lines = None
        with self._lock:
            if lines != self._lines and not self._closed:
                self._lines = lines
                self._ask(lines)

    def rest(self) -> None:
        """Let the board read the whole skin, until `follow` is called again."""
        with self._lock, suppress(OhmskinError, ValueError):
            if self._lines is not None and not self._closed:
                self._lines = None
                self._ask(None)

    def close(self) -> None:
        """Let the board scan as it did before this focus. May be called again."""
        with self._lock, suppress(OhmskinError, ValueError):  # it may be another skin by now
            if not self._closed:
                self._closed = True
                self._device.set_region(self._before)

    def _ask(self, lines: Lines | None) -> None:
        """Ask for these lines; None: for the whole skin."""
        if lines is None:
            whole = Region(mode=self._like.whole_mode, settle_us=self._settle_us)
            self._device.set_region(whole)
            return
        cells = len(lines.rows) * len(lines.columns)
        for _ in range(_TRIES):
            every = self._whole_every(cells)
            region = replace(self._like, rows=lines.rows, columns=lines.columns, whole_every=every)
            found = self._device.set_region(region)
            self._cell_s = found.scan_cycles / found.clock_hz / cells
            self._whole_s = found.whole_scan_cycles / found.clock_hz
            if abs(self._whole_every(cells) - every) <= 1 + every / 10:
                break

    def _whole_every(self, cells: int) -> int:
        """One in how many scans must be a whole one, for a region of so many cells."""
        if not self._cell_s:
            return _FIRST_EVERY
        return max(int((1 / WHOLE_HZ - self._whole_s) / (self._cell_s * cells)) + 1, 2)


def wanted_lines(touched: Bool, before: Lines | None) -> Lines | None:
    """What to read after a scan that showed these cells (R, C) touched; None: the whole skin.

    before: what is read now. It stays while it holds all that is touched, and little more.
    """
    if not touched.any():
        return None
    rows, columns = (_around(np.asarray(touched.any(axis=axis))) for axis in (1, 0))
    least = Lines(rows, columns)
    if len(rows) * len(columns) > MOST_SHARE * touched.size:
        return None
    before = before or least
    stays = (
        {*needed} <= {*now} and len(now) <= len(needed) + SPARE
        for now, needed in zip(before, least, strict=True)
    )
    return before if all(stays) else least


def _has_grown(lines: Lines | None, before: Lines | None) -> bool:
    """Whether both rows and columns are needed that were not read before."""
    if lines is None or before is None:
        return False
    return all({*new} - {*old} for new, old in zip(lines, before, strict=True))


def _around(touched: Bool) -> range:
    """From the first touched line to the last, and `MARGIN` around."""
    first, last = np.flatnonzero(touched)[[0, -1]].tolist()
    return range(max(first - MARGIN, 0), min(last + MARGIN + 1, touched.size))
