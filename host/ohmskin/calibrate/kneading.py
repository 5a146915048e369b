# SPDX-License-Identifier: Apache-2.0
"""From scans of a skin that is pressed anywhere, and the total force meanwhile, to its calibration.

`totals` learns the force curves from the presses. Before that, `kneaded_wires` learns the wires
from the same presses, by trials. For the next trial it asks how the rises follow the wires.

Symbols

====== ======= ========================================================================= =======
symbol shape   meaning                                                                   unit
====== ======= ========================================================================= =======
x      (n, C)  rise of each cell above rest, by an estimator that is told the wires      S
g      (n, C)  conductance of each cell                                                  S
u      (2,)    logs of a top and of a bottom segment                                     1
A, B           slopes of the ports' currents, over their noise: A by log g of the pressed
               cells, B by u
====== ======= ========================================================================= =======

The measured currents of the ports are the same, whatever wires are believed. So if the believed
wires change by du, the estimated cells must change so that the currents stay:

    d log g = -(A^T A + 1 / 3^2)^-1 A^T B du ,    d log x = (g / x) d log g .

3 is the deviation that a touch may have (`UNLIMITED_STD`); without it, cells that the currents
hardly show would change without limit.
"""

from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.kneaded_wires import Shown, WireSearch, held
from ohmskin.calibrate.presses import Calibrator, Progress, number_presses, scan_period_s
from ohmskin.calibrate.tables import ForceLog, gaps
from ohmskin.calibrate.totals import TotalFit, Totals, check_weighed
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.small import one_blas_thread, solve_positive
from ohmskin.estimate.base import TOUCH_SIEMENS, Estimator
from ohmskin.estimate.knowledge import MIN_CELL_SIEMENS, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.estimate.prior import UNLIMITED_STD
from ohmskin.force.reader import DEFAULT_METHOD
from ohmskin.link.clock import scan_times_s
from ohmskin.record.recording import Recording

# Of the scans of a press, those are estimated that are so far apart [s]. Chosen: a finger comes, or
# goes, within four of them.
SCAN_STEP_S: Final = 0.04
# For the curves, at most so many scans of presses are estimated. Chosen: 16x16 cells then take some
# minutes.
MOST_SCANS: Final = 8000
# Where a trial does not take all presses, it takes stretches of so many that follow each other.
# Chosen: a slow scale still shows the press before a stretch, which spoils one press of so many.
STRETCH: Final = 12
# So many scans of pauses are estimated, to see which rises untouched cells show by error. Chosen:
# enough for a median.
PAUSE_SCANS: Final = 200
# A rise below so many times the largest one of a usual pause counts as none. Chosen: errors in
# pauses are seldom twice as large. A rise above `TOUCH_SIEMENS` always counts.
PAUSE_TIMES: Final = 2.0
# While a board is reset, nobody sees what presses the skin. The scale still shows it for so long
# after this gap of the scans [s]. Chosen: the slowest scales need it.
AFTER_GAP_S: Final = 1.0


class _Levels(NamedTuple):
    """What an estimator shows of the scans.

    rise: x, (n, C); 0 where nothing is pressed.
    rest: level of the untouched cells in each recording, (k, C) [S].
    used: which scans were used, (n,).
    estimator: the one that has read the last recording.
    """

    rise: Float
    rest: Float
    used: Bool
    estimator: Estimator


class Kneading:
    """Scans of presses anywhere, by which a calibrator learns.

    recordings: one after another, by one clock. Each is read above its own rest, which is its first
        tare; the rest of the last one is that of the calibrator.

    time_s: time of each scan, (n,) [s].
    of_skin: rise of the currents of all ports together, (n,) [S].
    shape: (R, C).
    """

    def __init__(self, calibrator: Calibrator, recordings: list[Recording]) -> None:
        self._calibrator, knowledge = calibrator, calibrator.knowledge
        self.shape = knowledge.rows, knowledge.columns
        self._rests = [given.tares[0].rest_ratio for given in recordings[:-1]]
        self._rests.append(calibrator.rest_ratio)
        self._scans = scans = [scan for given in recordings for scan in given.scans]
        numbers = np.arange(len(recordings))
        self._recording = np.repeat(numbers, [len(given.scans) for given in recordings])
        currents = []
        for rest_ratio, given in zip(self._rests, recordings, strict=True):
            reader = PortReader(replace(knowledge, rest_ratio=rest_ratio))
            rest = reader.read(rest_ratio).current
            for scan in given.scans:
                currents.append(reader.read(scan.ratio, in_order=True).current - rest)
        rise = np.array(currents).reshape(len(scans), -1)
        rises = rise > TOUCH_SIEMENS
        self.time_s = scan_times_s(scans)
        self._weighed: Bool | None = None  # scans whose force is known, if the scale does not lag
        self.of_skin: Float = np.sum(rise, axis=1, where=rises)
        is_pressed = rises.any(axis=1)
        scan_s = scan_period_s(self.time_s)
        self._press = number_presses(np.where(is_pressed, 0, -1), self.of_skin, scan_s)
        self._is_clear = (self._press >= 0) | ~is_pressed  # a press that is too short is neither

    def learn(self, log: ForceLog, progress: Progress = iter, *, lags: bool = True) -> TotalFit:
        """Find the wires, unless the estimator shows them, and fit the curves.

        log: forces of the scale, on the clock of the scans; only the scale's own lag is in them.
        progress: passes on the scans that are read, once for each trial of wires, and at last.
        lags: as in `Totals`. A scale that does not lag shows the force of some scans, such as
            known weights do: then only scans whose force is known are used.
        """
        check_weighed(int(self._press.max()) + 1)
        calibrator = self._calibrator
        if not lags:
            self._weighed = np.isfinite(log.at(self.time_s)) & (self._press >= 0)
        told = calibrator.knowledge
        if not calibrator.shows_wires:
            show = partial(self._shown, log, progress)
            calibrator.take_wires(WireSearch(told.nominal_wire_ohm, self.shape, show).found())
            # The curves are of the wires that were found, and not of what scans would teach.
            wires = held(calibrator.knowledge.nominal_wire_ohm)
            told = replace(calibrator.knowledge, nominal_wire_ohm=wires, are_wires_sure=True)
        levels = self._levels(calibrator.method, told, self._spaced(), progress)
        calibrator.estimator = levels.estimator
        return TotalFit(self._totals(levels, log)).fit()

    def recording_at(self, time_s: float) -> tuple[int, float]:
        """Number of the recording that has a scan of this time, and the time of its first [s]."""
        number = self._recording[np.searchsorted(self.time_s, time_s)]
        return int(number), float(self.time_s[np.searchsorted(self._recording, number)])

    @property
    def _every(self) -> int:
        """How many scans of a press there are for one that is used."""
        step_s = float(np.median(np.diff(self.time_s)))
        pressed = int(np.count_nonzero(self._press >= 0))
        return max(round(SCAN_STEP_S / step_s), pressed // MOST_SCANS + 1)

    def _spaced(self) -> Bool:
        """Which scans to use, (n,): pauses, ends of presses, and at most `MOST_SCANS` others."""
        counts = np.cumsum(self._press >= 0)
        is_edge = np.diff(self._press, append=-1) != 0
        is_edge[1:] |= is_edge[:-1]
        return np.asarray(
            self._is_clear & ((self._press < 0) | is_edge | (counts % self._every == 0))
        )

    def _in_stretches(self, log: ForceLog, most_cells: int) -> Bool:
        """Which scans to use, (n,): those of `_spaced` in some stretches of presses of known force.

        most_cells: the cells of all these scans together are about as many at most.
        """
        press = np.where(np.isfinite(log.at(self.time_s)), self._press, -1)
        used = self._spaced() & (press == self._press)
        cells = int(np.count_nonzero(used & (press >= 0))) * self.shape[0] * self.shape[1]
        count = np.cumsum(np.diff(np.maximum.accumulate(press), prepend=-1) > 0) - 1
        return np.asarray(used & (count // STRETCH % (cells // most_cells + 1) == 0))

    def _shown(
        self, log: ForceLog, progress: Progress, wires: WireOhm, own_ohm: Float, most_cells: int
    ) -> Shown:
        """What these wires, and what single leads have above them, make of some presses."""
        known, used = self._calibrator.knowledge, self._in_stretches(log, most_cells)
        told = replace(known, nominal_wire_ohm=wires, own_lead_ohm=own_ohm)
        levels = self._levels(DEFAULT_METHOD, told, used, progress)
        wires = levels.estimator.wires()
        return Shown(self._totals(levels, log), *self._slopes(wires, levels), wires)

    def _levels(self, method: str, told: SkinKnowledge, used: Bool, progress: Progress) -> _Levels:
        """What a method shows of the scans to use, (n,); those that it doubts are left out.

        told: what is known, but for the rest, which each recording has of its own. What a recording
            teaches of the wires is known in the next one.
        """
        pressed = self._press >= 0
        pauses = np.flatnonzero(used & ~pressed)
        wanted = used & pressed
        wanted[pauses[:: pauses.size // PAUSE_SCANS + 1]] = True
        cells, estimator = self.shape[0] * self.shape[1], self._calibrator.estimator
        rise, good = np.zeros((used.size, cells)), used.copy()
        rests = np.zeros((len(self._rests), cells))
        numbers, doubt = np.flatnonzero(wanted), ""
        scans = zip(numbers, progress([self._scans[n] for n in numbers]), strict=True)
        for recording, given in groupby(scans, lambda scan: self._recording[scan[0]]):
            told = replace(told, rest_ratio=self._rests[recording])
            estimator = make_estimator(method, told)
            rest = rests[recording] = estimator.rest_level().ravel()
            for n, scan in given:
                answer = estimator.estimate(scan.ratio)
                good[n], rise[n] = answer.converged, answer.level.ravel() - rest
                doubt = answer.message or doubt
            # Levels of all recordings are of one curve. What far ends show is no part of it.
            wires = estimator.wires()
            if not self._calibrator.shows_wires:
                wires = wires.for_curves_of(told.nominal_wire_ohm)
            told = replace(told, nominal_wire_ohm=wires)
        read = wanted & pressed
        if read.any() and not good[read].any():
            remedy = "'ohmskin doctor PORT' looks for the cause"
            raise ValueError(f"no press can be read ({doubt}): {remedy}")
        of_nothing = rise[good & wanted & ~pressed].max(axis=1, initial=0.0)
        least = PAUSE_TIMES * float(np.median(of_nothing)) if of_nothing.size else 0.0
        rise[(rise < min(least, TOUCH_SIEMENS)) | ~pressed[:, None]] = 0.0
        if self._weighed is not None:
            good &= self._weighed
        return _Levels(rise, rests, good, estimator)

    def _totals(self, levels: _Levels, log: ForceLog) -> Totals:
        """What skin and scale have shown.

        Numbers of the scale amid unused scans, and those of gaps of the scans, are left out. If the
        scale has shown more numbers than scans are used, forces are taken at these scans.
        """
        time_s, used = self.time_s, levels.used
        rise = levels.rise[used]
        of_scans = time_s[used], rise, self._press[used], self._margin(rise)
        if self._weighed is not None:
            return Totals(self.shape, *of_scans, time_s[used], log.at(time_s[used]), lags=False)
        inside = (log.time_s >= time_s[0]) & (log.time_s <= time_s[-1])
        at_s = log.time_s[inside]
        if at_s.size > np.count_nonzero(used):
            at_s = time_s[used]
        shown_n = log.at(at_s)
        known = np.isfinite(shown_n) & self._amid(used, at_s) & ~self._unseen(at_s)
        if not known.any():
            raise ValueError("skin and scale were not read at the same time")
        return Totals(self.shape, *of_scans, at_s[known], shown_n[known])

    def _amid(self, used: Bool, at_s: Float) -> Bool:
        """Whether a time, (m,) [s], is between used scans of its press or pause, without others.

        Those that are skipped because they are near (`SCAN_STEP_S`) are no others.
        """
        scan = np.searchsorted(self.time_s, at_s).clip(0, self.time_s.size - 1)
        numbers = np.flatnonzero(used)
        after = numbers[np.searchsorted(numbers, scan).clip(max=numbers.size - 1)]
        before = numbers[(np.searchsorted(numbers, scan, "right") - 1).clip(0)]
        alike = (self._press[[before, after]] == self._press[scan]).all(axis=0)
        return np.asarray(alike & (np.abs(after - before) <= self._every))

    def _unseen(self, at_s: Float) -> Bool:
        """Whether what the scale shows then, (m,) [s], may be of a gap of the scans."""
        before = np.flatnonzero(gaps(self.time_s))
        begun = np.searchsorted(self.time_s[before], at_s)
        until_s = np.concatenate([[-np.inf], self.time_s[before + 1] + AFTER_GAP_S])
        return np.asarray(at_s < until_s[begun])

    def _margin(self, rise: Float) -> Float:
        """How many cells that seem untouched are beside touched ones, (n,)."""
        from scipy.ndimage import binary_dilation

        on = (rise > 0).reshape(-1, *self.shape)
        near = binary_dilation(on, np.ones((1, 3, 3)))
        return np.asarray(np.sum(near & ~on, axis=(1, 2)), dtype=np.float64)

    @one_blas_thread
    def _slopes(self, wires: WireOhm, levels: _Levels) -> tuple[Float, NDArray[np.intp]]:
        """d log x / du of the module's equations, (2+R+C, m, C), and its scans of those used, (m,).

        The first two are by u, the others by the lead of each line [1/ohm].
        """
        knowledge = self._calibrator.knowledge
        assert wires.both is not None
        series_ohm = knowledge.ref_ohm + 2 * (wires.lead or 0.0)
        rises, rests = levels.rise[levels.used], levels.rest[self._recording[levels.used]]
        rows, columns = np.indices(self.shape).reshape(2, -1, 1)
        by_leads = np.hstack(
            [rows == np.arange(self.shape[0]), columns == np.arange(self.shape[1])]
        )
        scans = np.flatnonzero(rises.any(axis=1))
        slopes = np.zeros((2 + sum(self.shape), scans.size, rises.shape[1]))
        for number, n in enumerate(scans):
            siemens = np.maximum(rises[n] + rests[n], MIN_CELL_SIEMENS)
            circuit = PortCircuit(siemens.reshape(self.shape), *wires.both)
            weight = (circuit.port_ohm + series_ohm)[:, None] ** -2.0 / knowledge.current_std
            pressed = rises[n] > 0
            by_cells = weight * circuit.by_cell()[:, pressed]
            system = by_cells.T @ by_cells + np.eye(by_cells.shape[1]) / UNLIMITED_STD**2
            by_wires = by_cells.T @ (weight * np.hstack([circuit.by_layers(), by_leads]))
            log_siemens = solve_positive(system, by_wires)  # slopes of ports are those by log ohm
            slopes[:, number, pressed] = log_siemens.T * (siemens[pressed] / rises[n, pressed])
        return slopes, scans
