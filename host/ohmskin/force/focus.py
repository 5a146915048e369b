# SPDX-License-Identifier: Apache-2.0
"""Reading follows the contacts: a region around them, and whole scans in between.

A region of a few lines is read ten times as often as the whole skin. What it cannot show is a touch
elsewhere, so whole scans come `WHOLE_HZ` times a second; and a touch that is new may be the ghost
of others outside, so the scan after it is a whole one.
"""

import threading
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool
from ohmskin.errors import CommandRefused, DeviceLost
from ohmskin.files import Closing
from ohmskin.link.device import Device, Region
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import MODES

# Whole scans come so often at least [Hz]. Chosen: a new touch is seen within a tenth of a second,
# estimate and command included.
WHOLE_HZ: Final = 15.0
# Lines around the touched ones that are read, too. Chosen: a fingertip that moves by a line is
# still inside when the next region is asked for.
MARGIN: Final = 1
# A region that has so many lines more than it needs stays. Chosen: each command takes some
# milliseconds, and a fingertip that trembles needs none.
SPARE: Final = 1
# A region of more of the cells is no faster than all of them. Chosen.
MOST_SHARE: Final = 0.6
# A small scan on the line: its header, its codes and what frames them. Chosen: that of 3x3 cells.
_FRAME_BYTES: Final = 54
_BITS_OF_BYTE: Final = 10  # one start bit and one stop bit


class Lines(NamedTuple):
    """Rows and columns of a region, first and behind the last of each."""

    rows: range
    columns: range

    def holds(self, other: "Lines") -> bool:
        """Whether all cells of the other one are in this one."""
        return all(
            mine.start <= others.start and others.stop <= mine.stop
            for mine, others in zip(self, other, strict=True)
        )


class Focus(Closing):
    """Tells a board where to read next, scan after scan, until it is closed.

    mode: which readings a region has. whole_mode: which the whole skin has.

    :raises CommandRefused: the board has no regions, or is a recording.
    :raises ValueError: the board reads far ends, which no region shows.
    """

    def __init__(self, device: Device, mode: str = "quick", whole_mode: str = "near") -> None:
        self._device, self._mode, self._whole_mode = device, mode, whole_mode
        self._lines: Lines | None = None
        self._contacts = 0
        self._lock, self._closed = threading.Lock(), False
        self._before = Region.of(device.info)
        if device.info.reads_far:
            raise ValueError("only near ends can be followed: 'ohmskin configure PORT --mode near'")
        device.set_region(Region(mode=whole_mode))

    def follow(self, touched: Bool, contacts: int, scan: Scan) -> None:
        """After a scan that showed these cells (R, C) touched, and so many contacts.

        A command takes some milliseconds, in which scans wait.
        """
        is_new, self._contacts = contacts > self._contacts, contacts
        lines = wanted_lines(touched, self._lines)
        if is_new and not scan.is_whole:
            lines = None
        with self._lock:
            if lines != self._lines and not self._closed:
                self._lines = lines
                self._device.set_region(self._region(lines))

    def close(self) -> None:
        """Let the board scan as before. May be called again."""
        with self._lock, suppress(DeviceLost, CommandRefused):
            if not self._closed:
                self._closed = True
                self._device.set_region(self._before)

    def _region(self, lines: Lines | None) -> Region:
        if lines is None:
            return Region(mode=self._whole_mode)
        board = self._device.info
        reading_s = board.slot_cycles / board.clock_hz
        cells = len(lines.rows) * len(lines.columns)
        scan_s = max(
            cells * len(MODES[self._mode]) * reading_s, _FRAME_BYTES * _BITS_OF_BYTE / board.baud
        )
        whole_s = board.rows * board.columns * len(MODES[self._whole_mode]) * reading_s
        every = max(round((1 / WHOLE_HZ - whole_s) / scan_s), 2)
        return Region(*lines, mode=self._mode, whole_every=every, whole_mode=self._whole_mode)


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
    if before is not None and before.holds(least):
        spare = (len(mine) - len(needed) for mine, needed in zip(before, least, strict=True))
        if max(spare) <= SPARE:
            return before
    return least


def _around(touched: Bool) -> range:
    """From the first touched line to the last, and `MARGIN` around."""
    first, last = np.flatnonzero(touched)[[0, -1]].tolist()
    return range(max(first - MARGIN, 0), min(last + MARGIN + 1, touched.size))
