# SPDX-License-Identifier: Apache-2.0
"""A board whose skin is calibrated: its scans carry forces, and it can be tared."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ohmskin.errors import TareRefused
from ohmskin.force.calibration import Calibration
from ohmskin.force.force_reader import ForceReader, ForceScan
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.link.serial_port import Link
from ohmskin.record.recording import Tare

TARE_S = 1.0
_NAMED_CELLS = 4


class RecordedTares(Protocol):
    """What a replay knows of the tares in its recording."""

    def tare_before(self, scan: Scan) -> Tare | None:
        """The one that comes right before this scan."""

    def tare_at(self, host_time_s: float) -> Tare | None:
        """The newest before what has been played by then."""


class CalibratedDevice(Device):
    """A `Device` whose scans are `ForceScan`. Made by ``ohmskin.open(port, calibration=...)``.

    force: take the calibration of another unit. recorded: the tares of a replay.

    :raises ValueError: the calibration is of another unit or geometry.
    """

    def __init__(
        self,
        link: Link,
        calibration: Calibration,
        *,
        start: bool = True,
        baud: int | None = None,
        force: bool = False,
        recorded: RecordedTares | None = None,
    ) -> None:
        super().__init__(link, start=False, baud=baud)
        self._calibrations = [calibration]  # with each tare one more
        self._recorded = recorded
        self._newest: _Follower | None = None
        self._newest_lock = threading.Lock()
        try:
            board = self.info
            calibration.check(board.unit_id, board.rows, board.columns, force=force)
            ForceReader(board, calibration)  # even forced, it must have the same cells
            if start:
                self.start()
        except BaseException:
            self.close()
            raise

    @property
    def calibration(self) -> Calibration:
        """What forces are read by, with the latest tare; `Calibration.save` makes it last."""
        return self._calibrations[-1]

    # ------------------------------------------------------------------------------- reading

    def __iter__(self) -> Iterator[ForceScan]:
        """Every scan from now on, as `Device` gives them, with its forces."""
        recorded = self._recorded
        before = None if recorded is None else recorded.tare_before
        return map(_Follower(self, before).read, super().__iter__())

    def latest(self, timeout_s: float | None = None) -> ForceScan:
        """The newest scan, as `Device` gives it, with its forces."""
        scan = super().latest(timeout_s)
        with self._newest_lock:
            if self._newest is None:
                recorded = self._recorded
                # It skips scans, and with them what was recorded right before one.
                newest = None if recorded is None else lambda at: recorded.tare_at(at.host_time_s)
                self._newest = _Follower(self, newest)
            return self._newest.read(scan)

    # ---------------------------------------------------------------------------------- tare

    def tare(self, seconds: float = TARE_S, *, force: bool = False) -> Tare:
        """Take the mean of the coming scans for the skin's rest, from the next scan read on.

        seconds: of scans, at least one. force: even if cells seem touched, because rest has
        drifted. Returns what `ohmskin.record.recorder.Recorder.add` keeps.

        :raises TareRefused: something touches the skin.
        :raises DeviceLost: as `mean_ratio`.
        """
        rest_ratio = self.mean_ratio(seconds)
        reader = ForceReader(self.info, self.calibration)
        if not force:
            touched = reader.measure(rest_ratio).touched
            if touched.any():
                raise TareRefused(
                    f"{touched_cells(touched)}: take everything off the skin, or force the tare if "
                    "nothing is on it"
                )
        self._calibrations.append(reader.tared(rest_ratio, now()))
        return Tare(rest_ratio, time.monotonic())

    def undo_tare(self) -> Tare:
        """Return to the rest before the last tare. Returns that, for a `Recorder`.

        :raises TareRefused: there is no tare.
        """
        if len(self._calibrations) > 1:
            self._calibrations.pop()
        elif self.calibration.tare is not None:
            self._calibrations = [replace(self.calibration, tare=None)]
        else:
            raise TareRefused("there is no tare to undo: rest is that of the calibration")
        return Tare(self.calibration.untouched.ratio, time.monotonic())


class _Follower:
    """A reader for one way of reading a device, which goes on with its newest tare.

    recorded: the tare that a recording has for a scan, if it is one that is read.
    """

    def __init__(
        self, device: CalibratedDevice, recorded: Callable[[Scan], Tare | None] | None
    ) -> None:
        self._device = device
        self._recorded = recorded
        self._followed: Tare | None = None
        self._calibration = device.calibration
        self._reader = ForceReader(device.info, self._calibration)

    def read(self, scan: Scan) -> ForceScan:
        if self._calibration is not self._device.calibration:
            self._calibration = self._device.calibration
            self._reader.use(self._calibration)
        tare = None if self._recorded is None else self._recorded(scan)
        if tare is not None and tare is not self._followed:
            self._followed = tare
            self._reader.use(self._reader.tared(tare.rest_ratio, now()))
        return self._reader.read(scan)


def now() -> str:
    """The date and time of the host, ISO 8601, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def touched_cells(touched: NDArray[np.bool_]) -> str:
    """Which cells are touched, in words."""
    cells = [f"({row}, {column})" for row, column in np.argwhere(touched)]
    more = len(cells) - _NAMED_CELLS
    text = ", ".join(cells[:_NAMED_CELLS]) + (f" and {more} more" if more > 0 else "")
    return f"cell {text} is touched" if len(cells) == 1 else f"cells {text} are touched"
