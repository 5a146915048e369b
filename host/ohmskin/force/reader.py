# SPDX-License-Identifier: Apache-2.0
"""From a scan to forces: the one way that the whole package takes.

    scan -> estimate (a method, told the untouched skin) -> forces (a calibration) -> contacts

`SkinReader` goes it for one scan after the other. `CalibratedSkin` is a device and such readers.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.errors import TareRefused
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.files import Closing
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.contacts import Contact, ContactTracker
from ohmskin.link.device import Device
from ohmskin.link.messages import BoardStats, Hello, Scan

if TYPE_CHECKING:
    from ohmskin.record.recording import Tare

# The method where neither a calibration nor the user says one.
DEFAULT_METHOD: Final = "joint"
# Scans of so many seconds make a tare, unless told.
TARE_S: Final = 1.0
# An error text names so many touched cells at most.
_NAMED_CELLS: Final = 4


@dataclass(frozen=True, eq=False)
class ForceScan(Scan):
    """A scan, and what it shows.

    force_n, force_n_std: normal force of each cell and its standard deviation, (R, C) [N]; NaN
    where `ForceModel.predict` has none, and everywhere without a calibration. contacts: touched
    cells that adjoin; without a calibration their force is the rise of their conductance [S].
    estimate: what all of this is from; its ``message`` says why readings cannot be trusted.
    """

    force_n: Float
    force_n_std: Float
    contacts: tuple[Contact, ...]
    estimate: Estimate


@dataclass(frozen=True, eq=False)
class Untouched:
    """Readings (R, C, 4) of the untouched skin, and when they were taken (ISO 8601)."""

    ratio: Float
    date: str


class SkinReader:
    """Reads scan after scan of one skin: the same scans in the same order give the same forces.

    board: the one that scans it. calibration: gives newtons, as long as the method is its own.
    method: a name of `LEVEL_METHODS`; by default the calibration's, or `DEFAULT_METHOD`.
    rest_ratio: readings (R, C, 4) of the untouched skin, where there is no calibration.

    Of recorded tares (`Scan.rest_ratio`) and those taken by `tare`, the latest is the rest. Scans
    are read by one thread; all else may be called from any thread.

    :raises ValueError: no such method, or other cells or another mode than were calibrated.
    """

    def __init__(
        self,
        board: Hello,
        calibration: Calibration | None = None,
        *,
        method: str = "",
        rest_ratio: Float | None = None,
    ) -> None:
        self.board = board
        self._calibration = calibration
        self._wanted = method or DEFAULT_METHOD
        # The rests before each tare, and the one in force. All readers of one skin share it, and
        # the recorded tares that one of them has come to.
        self._rests: list[Rest | Untouched | None] = [None]
        self._replayed: list[Float] = []
        self._lock = threading.Lock()
        if calibration is not None:
            calibration.check(board, force=True)
            self._wanted = method or calibration.method
            known = (calibration.rest, calibration.tare)
            self._rests = [each for each in known if each is not None]
        elif rest_ratio is not None:
            self._rests = [Untouched(rest_ratio, now())]
        self._begin()
        self._taught = [self._estimator]  # of all readers of this skin, the one that read last

    def another(self) -> Self:
        """A reader of the same skin, with the same tares, for another way of reading its scans."""
        other = copy.copy(self)
        other._begin()
        return other

    @property
    def method(self) -> str:
        """The method of the scan that was read last, and of the next one before the first."""
        return self._made[0]

    @property
    def force_method(self) -> str | None:
        """The method that gives newtons: that of the calibration, if there is one."""
        return None if self._calibration is None else self._calibration.method

    @property
    def has_forces(self) -> bool:
        """Whether scans get newtons: there is a calibration, and the method is its own."""
        return self.method == self.force_method

    @property
    def rest(self) -> Rest | Untouched | None:
        """The rest in force; None where it is not known."""
        return self._rests[-1]

    @property
    def is_tared(self) -> bool:
        """Whether there is a tare to undo."""
        return len(self._rests) > 1

    @property
    def calibration(self) -> Calibration | None:
        """The calibration with the latest tare and the wires learned since; `save` keeps them."""
        if self._calibration is None:
            return None
        calibration = replace(self._calibration, nominal_wire_ohm=self._taught[0].wires())
        rest = self.rest
        if isinstance(rest, Untouched):
            rest = Rest.of(calibration.method, self._knowledge(rest), rest.date)
        return replace(calibration, tare=None if rest is calibration.rest else rest)

    def use(self, method: str) -> None:
        """Go on with another method, from the next scan on. Raises ValueError for no such."""
        make_estimator(method, self._knowledge(self.rest))
        self._wanted = method

    def tare(self, rest_ratio: Float, *, force: bool = False) -> Tare:
        """Take these readings (R, C, 4) for the rest. Returns what a `Recorder` keeps.

        force: even if cells seem touched: rest may have drifted.

        :raises TareRefused: something touches the skin.
        """
        touched = self.another().estimate(rest_ratio).touched
        if touched.any() and not force:
            remedy = "take everything off the skin, or force the tare if nothing is on it"
            raise TareRefused(touched_cells(touched), remedy)
        self._rests.append(Untouched(rest_ratio, now()))
        return self._recorded(rest_ratio)

    def undo_tare(self) -> Tare | None:
        """Return to the rest before the last tare. Returns that, for a `Recorder`, if it is known.

        :raises TareRefused: there is no tare.
        """
        if not self.is_tared:
            raise TareRefused("there is no tare to undo")
        self._rests.pop()
        return None if self.rest is None else self._recorded(self.rest.ratio)

    def _recorded(self, rest_ratio: Float) -> Tare:
        from ohmskin.record.recording import Tare  # its library is loaded when needed

        return Tare(rest_ratio, time.monotonic(), self.board.mode)

    def estimate(self, ratio: Float) -> Estimate:
        """What readings (R, C, 4) show, without forces. Raises ValueError for other cells."""
        return self._estimator.estimate(ratio)

    def check_mode(self, mode: str) -> None:
        """Raise ValueError if the board scans in another mode now."""
        if mode != self.board.mode:
            raise ValueError(f"the board scanned in mode {self.board.mode}, now in {mode}")

    def rise(self, found: Estimate) -> Float:
        """Level above rest, (R, C) [S; 1 for `voltage`]; above its median where rest is unknown."""
        at_rest = float(np.median(found.level)) if self._rest_level is None else self._rest_level
        return np.asarray(found.level - at_rest)

    def read(self, scan: Scan) -> ForceScan:
        """What a scan shows. Raises ValueError if it is of other cells, or of another mode."""
        self.check_mode(scan.mode)
        if scan.rest_ratio is not None and scan.rest_ratio.shape == scan.codes.shape:
            self._replay(scan.rest_ratio)
        if self._made != (self._wanted, self.rest):
            self._make()
        found = self.estimate(scan.ratio)
        self._taught[:] = [self._estimator]
        rise = self.rise(found)
        force_n = force_n_std = np.full(rise.shape, np.nan)
        weights = np.maximum(rise, 0.0), found.level_std
        if self._calibration is not None and self.has_forces:
            weights = force_n, force_n_std = self._calibration.model.predict(rise, found.level_std)
        contacts = self._tracker.update(scan.time_us, found.touched, *weights)
        seen = {"force_n": force_n, "force_n_std": force_n_std}
        return ForceScan(**(vars(scan) | seen | {"contacts": contacts, "estimate": found}))

    def _replay(self, ratio: Float) -> None:
        """Take a recorded tare, when the first reader comes to it."""
        with self._lock:
            if not any(ratio is each for each in self._replayed):
                self._replayed.append(ratio)
                self._rests.append(Untouched(ratio, now()))

    def _begin(self) -> None:
        """Begin with no contact, and as if no scan had come before."""
        self._tracker = ContactTracker()
        self._make()

    def _make(self) -> None:
        """Estimate anew with the method and the rest that are in force."""
        method, rest = self._made = self._wanted, self.rest
        self._estimator = make_estimator(method, self._knowledge(rest))
        self._rest_level: Float | None = None
        if isinstance(rest, Rest) and self.has_forces:
            self._rest_level = rest.level
        elif rest is not None:
            self._rest_level = np.maximum(self._estimator.rest_level(), 0.0)

    def _knowledge(self, rest: Rest | Untouched | None) -> SkinKnowledge:
        wires = NO_WIRES if self._calibration is None else self._calibration.nominal_wire_ohm
        return SkinKnowledge.of(self.board, None if rest is None else rest.ratio, wires)


class CalibratedSkin(Closing):
    """A device whose scans carry forces, and which can be tared. Made by ``ohmskin.open``.

    device: the board or recording alone, with all its commands. force: take the calibration of
    another unit. Iterating and `latest` are those of `Device`, with forces.

    :raises ValueError: the calibration is of another unit or geometry.
    """

    def __init__(self, device: Device, calibration: Calibration, *, force: bool = False) -> None:
        self.device = device
        self.name = device.name
        """See `Device.name`."""
        board = device.info
        calibration.check(board, force=force)
        self._reader = SkinReader(board, calibration)
        self._lock = threading.Lock()

    @property
    def info(self) -> Hello:
        """See `Device.info`."""
        return self.device.info

    @property
    def stats(self) -> BoardStats:
        """See `Device.stats`."""
        return self.device.stats

    @property
    def calibration(self) -> Calibration:
        """What forces are read by, with the latest tare and learned wires; `save` keeps them."""
        found = self._reader.calibration
        assert found is not None
        return found

    def start(self) -> None:
        """See `Device.start`."""
        self.device.start()

    def __iter__(self) -> Iterator[ForceScan]:
        """Every scan from now on, with its forces."""
        return map(self._reader.another().read, self.device)

    def latest(self, timeout_s: float | None = None) -> ForceScan:
        """The newest scan, with its forces."""
        scan = self.device.latest(timeout_s)
        with self._lock:
            return self._reader.read(scan)

    def tare(self, seconds: float = TARE_S, *, force: bool = False) -> Tare:
        """`SkinReader.tare` with the mean of the coming scans, of so many seconds.

        :raises TareRefused: something touches the skin.
        :raises DeviceLost: as `Device.mean_ratio`.
        :raises ValueError: the board scans in another mode than was calibrated.
        """
        rest_ratio = self.device.mean_ratio(seconds)
        self._reader.check_mode(self.info.mode)
        return self._reader.tare(rest_ratio, force=force)

    def undo_tare(self) -> Tare:
        """Return to the rest before the last tare. Returns that, for a `Recorder`.

        :raises TareRefused: there is no tare.
        """
        undone = self._reader.undo_tare()
        assert undone is not None  # a calibration has a rest
        return undone

    def close(self) -> None:
        """Close the device. May be called again."""
        self.device.close()


def now() -> str:
    """The date and time of the host, ISO 8601, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def touched_cells(touched: Bool) -> str:
    """Which cells are touched, in words."""
    cells = [f"({row}, {column})" for row, column in np.argwhere(touched)]
    more = len(cells) - _NAMED_CELLS
    text = ", ".join(cells[:_NAMED_CELLS]) + (f" and {more} more" if more > 0 else "")
    return f"cell {text} is touched" if len(cells) == 1 else f"cells {text} are touched"
