# SPDX-License-Identifier: Apache-2.0
"""What the scans of one skin show, by a method and a rest that may change meanwhile."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.errors import TareRefused
from ohmskin.estimate.base import Estimate, Estimator, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import METHODS, PAPER_METHODS, make_estimator
from ohmskin.estimate.ohm import OhmEstimator
from ohmskin.force.calibrated_device import now, touched_cells
from ohmskin.force.calibration import Calibration
from ohmskin.force.contacts import MEMORY_US, Contact, ContactTracker
from ohmskin.force.force_reader import ForceReader
from ohmskin.link.messages import Hello, Scan
from ohmskin.view.shown import Counts, Shown

LIVE_METHODS: Final = tuple(name for name in METHODS if name not in PAPER_METHODS)
DEFAULT_METHOD: Final = "joint"


class SkinReader:
    """Reads the scans of `board`, and keeps what rest they are read against. For any thread.

    calibration: gives newtons, as long as the method is its own; None: there are conductances.
    """

    def __init__(self, board: Hello, calibration: Calibration | None) -> None:
        self.board = board
        self._calibration = calibration
        # What rest was before each tare, and is now: readings (R, C, 4) and their date.
        self._rests: list[tuple[Float, str] | None] = [None]
        if calibration is not None:
            known = (calibration.rest, calibration.tare)
            self._rests = [(rest.ratio, rest.date) for rest in known if rest is not None]
        self._newest: Scan | None = None
        self._time_us = 0
        self._lock = threading.Lock()
        own = calibration.method if calibration is not None else DEFAULT_METHOD
        self.methods = LIVE_METHODS if own in LIVE_METHODS else (*LIVE_METHODS, own)
        self.method = own
        self._forces: ForceReader | None = None
        self._estimator: Estimator | None = None
        self._remake()

    @property
    def force_method(self) -> str | None:
        """The method that gives newtons, if there is one."""
        return None if self._calibration is None else self._calibration.method

    def use(self, method: str) -> None:
        """Go on with another method. Raises ValueError, with the names there are, for no such."""
        if method not in self.methods:
            raise ValueError(f"no method '{method[:40]}': there are {', '.join(self.methods)}")
        with self._lock:
            self.method = method
            self._remake()

    # ------------------------------------------------------------------------------------ rest

    @property
    def rest(self) -> tuple[Float, str] | None:
        """Readings (R, C, 4) of the untouched skin, and of when; None where they are not known."""
        return self._rests[-1]

    @property
    def is_tared(self) -> bool:
        """Whether there is a tare to undo."""
        return len(self._rests) > 1

    def tare(self, rest_ratio: Float, *, force: bool = False) -> None:
        """Take these readings (R, C, 4) for the skin's rest.

        :raises TareRefused: they show touched cells, and the tare is not forced.
        """
        touched = self._measure_once(rest_ratio)
        if touched.any() and not force:
            raise TareRefused(
                f"{touched_cells(touched)}: take everything off the skin, or tare anyway"
            )
        self._take(rest_ratio)

    def replayed(self, rest_ratio: Float) -> None:
        """Take the tare of a recording, as it was taken then."""
        if rest_ratio.shape[:2] == (self.board.rows, self.board.columns):
            self._take(rest_ratio)

    def undo_tare(self) -> Float | None:
        """Return to the rest before the last tare, and give its readings; None: it is not known.

        :raises TareRefused: there is no tare.
        """
        with self._lock:
            if not self.is_tared:
                raise TareRefused("there is no tare to undo")
            self._rests.pop()
            self._remake()
            return None if self.rest is None else self.rest[0]

    def _take(self, rest_ratio: Float) -> None:
        with self._lock:
            self._rests.append((rest_ratio, now()))
            self._remake()

    def _measure_once(self, ratio: Float) -> NDArray[np.bool_]:
        """Cells that readings show to be touched, beside the scans."""
        reader = SkinReader(self.board, self._calibration)
        reader._rests, reader.method = self._rests, self.method
        reader._remake()
        return reader._read(ratio).touched

    # ----------------------------------------------------------------------------------- scans

    def read(self, scan: Scan, counts: Counts) -> Shown:
        """What a scan shows. Raises ValueError if it is of other cells."""
        with self._lock:
            raw = self._raw.estimate(scan.ratio)
            force_n = force_n_std = None
            seen = replace(scan, time_us=self._seen_us(scan))
            if self._forces is not None:
                found = self._forces.read(seen)
                estimate, contacts = found.estimate, found.contacts
                force_n, force_n_std = found.force_n, found.force_n_std
            else:
                estimate = self._read(scan.ratio)
                contacts = self._contacts(seen, estimate)
            return Shown(scan, raw, estimate, self.method, contacts, force_n, force_n_std, counts)

    def _seen_us(self, scan: Scan) -> int:
        """Time without gaps: contacts that nobody looked at meanwhile have not gone."""
        if self._newest is not None:
            step_us = max(scan.time_us - self._newest.time_us, 0)
            self._time_us += min(step_us, MEMORY_US // 2)
        self._newest = scan
        return self._time_us

    def _read(self, ratio: Float) -> Estimate:
        if self._forces is not None:
            return self._forces.measure(ratio)
        assert self._estimator is not None
        return self._estimator.estimate(ratio)

    def _contacts(self, scan: Scan, estimate: Estimate) -> tuple[Contact, ...]:
        """Weighed by the rise of conductance above rest [S] instead of by force."""
        assert self._estimator is not None
        rest = self._estimator.rest()
        at_rest = np.median(estimate.cell_siemens) if rest is None else rest.cell_siemens
        rise = np.maximum(estimate.cell_siemens - at_rest, 0.0)
        return self._tracker.update(scan.time_us, estimate.touched, rise, estimate.cell_siemens_std)

    def _remake(self) -> None:
        calibration, rest = self._calibration, self.rest
        rest_ratio = None if rest is None else rest[0]
        knowledge = SkinKnowledge.of(
            self.board,
            rest_ratio,
            WireOhm() if calibration is None else calibration.nominal_wire_ohm,
        )
        self._raw = make_estimator(OhmEstimator.name, knowledge)
        self._tracker = ContactTracker()
        self._forces = self._estimator = None
        if calibration is not None and self.method == calibration.method:
            self._forces = ForceReader(self.board, replace(calibration, tare=None))
            if self.is_tared and rest is not None:
                self._forces.use(self._forces.tared(*rest))
        else:
            self._estimator = make_estimator(self.method, knowledge)
