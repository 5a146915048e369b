# SPDX-License-Identifier: Apache-2.0
"""How well each cell is known while a skin is kneaded over a scale, before anything is fitted.

The scale shows the sum of the cells' forces. So each number of the scale tells something of a cell,
the more the larger the cell's share of the force is.

======== ====== ===================================================================== ======
symbol   shape  meaning                                                               unit
======== ====== ===================================================================== ======
x        (N,)   rise of each cell above rest; 0 where it is not touched               S
s        (N,)   share of each cell in the force, by the usual curve: x^`USUAL_EXPONENT`  1
t        (N,)   log of the ratio of each cell's force to that of the usual curve       1
F, v            force; variance of its log                                             N, 1
A        (N, N) information on t                                                        1
======== ====== ===================================================================== ======

    d log F / d t = s ,   A = A_0 + sum over numbers of s s^T / v ,

    v = `CONTACT_STD`^2 + (`SCALE_STD_N` / F)^2 ,

    A_0 = (I - 1 1^T / N) / `GAIN_STD`^2 + 1 1^T / (N `LEVEL_STD`)^2 .

A_0 is what is known before any number: cells scatter about a level that nobody knows. The standard
deviation of t is the root of diag(A^-1). A needs the force only to know how large v is, and not how
far the force is from what a curve predicts. So it is known before any curve is fitted, as in the
theory of the design of experiments.
"""

from bisect import bisect_right
from dataclasses import replace
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.totals import GAIN_STD
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.reader import DEFAULT_METHOD
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recording import ForceSample, Recording, Tare

# A cell is known when its t has a smaller standard deviation. Chosen: presses of a contact of
# textile repeat as well.
KNOWN_LOG: Final = 0.15
# Standard deviation of the mean t of all cells, before any number. Chosen: a factor of e.
LEVEL_STD: Final = 1.0
# Force grows with this power of the rise. Chosen: that of rough contacts (docs/force.md).
USUAL_EXPONENT: Final = 0.6
# Standard deviation of the log of a force about the sum that right curves predict, by the contacts.
# Chosen: noise and hysteresis of one contact, less because a fingertip covers a few cells.
CONTACT_STD: Final = 0.08
# Standard deviation of a force by the scale itself [N]. Chosen: a few grams, and what is left of
# the lag of its filter.
SCALE_STD_N: Final = 0.05
# A number that comes sooner after the last one tells nothing new [s]. Chosen: the noise of a
# contact lasts about as long, and most scales show ten numbers a second, which come a little sooner
# or later.
NEWS_S: Final = 0.08
# A skin is known when the scale has shown so many numbers for each of its cells. Chosen: those of
# one or two presses a cell. The curve of all cells and the wires, which are not in t, need them.
NUMBERS_A_CELL: Final = 8
# A cell whose t has a larger deviation does not answer. Chosen: a little less than that of a cell
# that nobody presses, so that some numbers which are wrong make no dead cell answer.
SILENT_LOG: Final = 0.9 * GAIN_STD
# Since all other cells are known, the scale must have shown so many numbers for each cell that does
# not answer. Chosen: those of five seconds of presses, which should reach it if it is alive.
NUMBERS_A_SILENT_CELL: Final = 50
# A smaller force is not counted [N]. Chosen: the error of a scale's zero is a large share of it.
LEAST_N: Final = 0.3
# So many numbers below zero during touches, and more than above zero, show a scale whose sign is
# wrong. Chosen: the first touches tell it, and one bad zero does not.
LEAST_BELOW: Final = 20


class Coverage:
    """What a skin of N cells has been kneaded to show so far. See the module."""

    def __init__(self, cells: int) -> None:
        ones = np.ones((cells, cells)) / cells
        self._information = (np.eye(cells) - ones) / GAIN_STD**2 + ones / (cells * LEVEL_STD**2)
        self._last_s = -np.inf
        self.numbers = 0
        """How many were added."""

    def is_news(self, time_s: float, force_n: float) -> bool:
        """Whether a number of the scale, shown then [s], tells something if the skin is touched."""
        return force_n > LEAST_N and not 0 <= time_s - self._last_s < NEWS_S

    def add(self, time_s: float, rise: Float, force_n: float) -> None:
        """One number of the scale: when [s], the rise of touched cells (N,) [S], the force [N]."""
        self.pass_over(time_s)
        self.numbers += 1
        share = np.maximum(rise, 0.0) ** USUAL_EXPONENT
        share /= share.sum()
        variance = CONTACT_STD**2 + (SCALE_STD_N / force_n) ** 2
        self._information += np.outer(share, share) / variance

    def pass_over(self, time_s: float) -> None:
        """A number of then [s] that tells nothing of the cells."""
        self._last_s = time_s

    def log_std(self) -> Float:
        """Deviation of t of each cell, (N,)."""
        return np.asarray(np.sqrt(np.linalg.inv(self._information).diagonal()))


class LiveCoverage:
    """Follows recordings of a skin that is kneaded: how well each of its cells is known.

    board: the one that scans it.
    log_std: deviation of t of each cell, (R, C).
    """

    def __init__(self, board: Hello) -> None:
        self._board = board
        self._coverage = Coverage(board.rows * board.columns)
        self.log_std = self._coverage.log_std().reshape(board.rows, board.columns)
        self._least = 0  # numbers that are needed
        # How many cells are not known, and since which number so many do not answer.
        self._unknown, self._since = self.log_std.size, 0
        self.ask_more()
        self.begin()

    def ask_more(self) -> None:
        """As many numbers are wanted from now on as for a new skin."""
        self._least = self._coverage.numbers + NUMBERS_A_CELL * self.log_std.size

    def begin(self) -> None:
        """Another recording begins: its rest and the zero of its scale are its own."""
        self._zeros_n: list[float] = []
        self._below, self._above = 0, 0  # numbers of the scale during touches, by their sign
        self._estimator: Estimator | None = None

    def look(self, scan: Scan, tare: Tare | None, sample: ForceSample | None) -> bool:
        """Take in a scan. Returns whether it has told something of the cells.

        A scan that the estimator doubts tells nothing, as it teaches nothing later (`kneading`).

        tare: of the recording; None: it is not taken yet.
        sample: the newest force; None: there is none.
        """
        if sample is None or tare is None or not tare.is_of(scan):
            self._zeros_n += [] if sample is None else [sample.force_n]
            return False
        if self._estimator is None:
            knowledge = SkinKnowledge.of(self._board, tare.rest_ratio)
            self._estimator = make_estimator(DEFAULT_METHOD, replace(knowledge, may_be_bent=False))
        force_n = sample.force_n - float(np.median(self._zeros_n or [0.0]))
        if not self._coverage.is_news(sample.host_time_s, abs(force_n)):
            return False
        frame = self._estimator.estimate(scan.ratio)
        rise = np.where(frame.touched, frame.level - self._estimator.rest_level(), 0.0)
        if not (frame.converged and (rise > 0).any()):
            return False
        if force_n < 0:
            self._below += 1
            self._coverage.pass_over(sample.host_time_s)
            return False
        self._above += 1
        self._coverage.add(sample.host_time_s, rise.ravel(), force_n)
        self.log_std = self._coverage.log_std().reshape(self.log_std.shape)
        unknown = ~self.known
        if unknown.sum() != self._unknown or (self.log_std[unknown] < SILENT_LOG).any():
            self._unknown, self._since = int(unknown.sum()), self._coverage.numbers
        return True

    def look_at(self, recording: Recording) -> None:
        """All of a recording."""
        self.begin()
        if not (recording.scans and recording.tares):
            return
        tare, times_s = recording.tares[0], [sample.host_time_s for sample in recording.forces]
        for scan in recording.scans:
            shown = bisect_right(times_s, scan.host_time_s)
            is_later = scan.host_time_s > tare.host_time_s
            sample = recording.forces[shown - 1] if shown else None
            self.look(scan, tare if is_later else None, sample)

    @property
    def moved_n(self) -> float:
        """By how much the scale moved while the rest was measured [N]."""
        least, most = np.quantile(self._zeros_n or [0.0], [0.1, 0.9]).tolist()
        return float(most - least)

    @property
    def is_upside_down(self) -> bool:
        """Whether the scale shows less, not more, where this recording's touches press it."""
        return self._below > max(LEAST_BELOW, self._above)

    @property
    def known(self) -> Bool:
        """Which cells are known, (R, C)."""
        return np.asarray(self.log_std <= KNOWN_LOG)

    @property
    def silent(self) -> Bool:
        """Which cells do not answer, though all others are known and more was pressed, (R, C)."""
        waited = self._coverage.numbers - self._since
        return ~self.known & (waited >= NUMBERS_A_SILENT_CELL * self._unknown)

    @property
    def numbers_left(self) -> int:
        """How many numbers of the scale are still needed for curve and wires."""
        return max(self._least - self._coverage.numbers, 0)

    @property
    def is_done(self) -> bool:
        """Whether all cells that answer, the curve and the wires are known."""
        return bool((self.known | self.silent).all()) and not self.numbers_left

    @property
    def next_cell(self) -> tuple[int, int]:
        """The cell that is known least, of those that answer: where to press next."""
        log_std = np.where(self.silent, 0.0, self.log_std)
        row, column = np.unravel_index(np.argmax(log_std), log_std.shape)
        return int(row), int(column)
