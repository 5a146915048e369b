# SPDX-License-Identifier: Apache-2.0
"""Presses of single cells, found in what a skin showed while a force sensor measured.

A scan belongs to the cell that rises most above rest, if that cell is touched. Consecutive scans of
one cell are a press. Where its rise falls to a fifth in between, they are several presses.

Two kinds of scans are left out: those of a run of less than `MIN_SCANS`, and those in which another
cell rises by more than `SECOND_SHARE` of the first, for nothing tells how two cells share a force.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.tables import ForceLog

# So many scans without touch may interrupt a press: a light touch flickers about its threshold.
FLICKER_SCANS: Final = 3
# Fewer scans in a row are a bounce, not a press.
MIN_SCANS: Final = 5
# A cell that rises by more than this share of the strongest one is pressed, too; a neighbour of
# one pressed cell rises by less.
SECOND_SHARE: Final = 0.25
# Fewer scans without touch do not tell the zero of a force sensor.
MIN_ZERO_SCANS: Final = 10
# Creep keeps a cell touched for a while, so that quick presses meet in a valley: two presses are
# told apart if the logarithm of the rise falls by so much between them.
VALLEY_LOG: Final = np.log(5.0)
# What rises by less than this share of the strongest rise is noise to that logarithm.
_NOISE_FLOOR: Final = 1e-3
# Stands for a cell, or a press, where a scan has none.
_NOTHING: Final = -1


@dataclass(frozen=True, eq=False)
class Presses:
    """What `ForceRegression.fit` learns from, n rows: arrays (n,).

    cells: flat indices, row * columns + column. rise, rise_std: of that cell [S, or 1 for
    `voltage`]. force_n [N]. press: number of the press that a row is of. shape: (R, C). shared:
    scans left out because two cells were pressed. zero_n: what the force sensor showed without
    touch, already taken off [N].
    """

    cells: NDArray[np.intp]
    rise: Float
    rise_std: Float
    force_n: Float
    press: NDArray[np.intp]
    shape: tuple[int, int]
    shared: int = 0
    zero_n: float = 0.0

    @property
    def counts(self) -> NDArray[np.intp]:
        """Number of presses of each cell, (R, C)."""
        _, first = np.unique(self.press, return_index=True)
        rows, columns = self.shape
        return np.bincount(self.cells[first], minlength=rows * columns).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class LevelHistory:
    """What n scans showed, by the times (n,) of their middles [s].

    rise, rise_std (n, R, C): levels above rest and their standard deviations [S, or 1 for
    `voltage`]. touched (n, R, C).
    """

    time_s: Float
    rise: Float
    rise_std: Float
    touched: NDArray[np.bool_]

    @property
    def of_skin(self) -> Float:
        """Rise of all touched cells together, (n,)."""
        return np.asarray(np.sum(self.rise, axis=(1, 2), where=self.touched))


def find_presses(history: LevelHistory, log: ForceLog, offset_s: float) -> Presses:
    """The presses, with the force at each scan: log time + offset_s = scan time.

    Raises ValueError where no scan of a single pressed cell has a force.
    """
    scans, rows, columns = history.rise.shape
    force_n = log.at(history.time_s - offset_s)
    known = np.isfinite(force_n)
    if not known.any():
        raise ValueError("scans and force log never overlap: are they of the same session?")
    untouched = known & ~history.touched.any(axis=(1, 2))
    # The median of many scans, because the force begins before a touch is certain.
    enough = np.count_nonzero(untouched) >= MIN_ZERO_SCANS
    zero_n = float(np.median(force_n[untouched])) if enough else 0.0

    rise = history.rise.reshape(scans, -1)
    pressed = _pressed(rise, history.touched.reshape(scans, -1))
    every = np.arange(scans)
    top = rise[every, pressed]
    press = _numbered(pressed, top)
    others = rise.copy()
    others[every, pressed] = -np.inf
    shared = (press != _NOTHING) & (others.max(axis=1) > SECOND_SHARE * top)
    good = (press != _NOTHING) & ~shared & known
    if not good.any():
        raise ValueError("no cell is pressed alone while the force is known")
    return Presses(
        cells=pressed[good],
        rise=top[good],
        rise_std=history.rise_std.reshape(scans, -1)[every, pressed][good],
        # Below zero is the sensor's noise: `ForceLog` refuses more than that.
        force_n=np.maximum(force_n[good] - zero_n, 0.0),
        press=press[good],
        shape=(rows, columns),
        shared=int(np.count_nonzero(shared)),
        zero_n=zero_n,
    )


def _pressed(rise: Float, touched: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Index of the cell that each scan belongs to, or `_NOTHING`. Arrays (n, R * C)."""
    from scipy.ndimage import binary_closing

    top = rise.argmax(axis=1)
    pressed = np.full(top.size, _NOTHING, dtype=np.intp)
    for cell in np.unique(top):
        of_cell = (top == cell) & touched[:, cell]
        padded = np.pad(of_cell, FLICKER_SCANS + 1)
        closed = binary_closing(padded, np.ones(FLICKER_SCANS + 1))
        pressed[closed[FLICKER_SCANS + 1 : -FLICKER_SCANS - 1] & (pressed == _NOTHING)] = cell
        pressed[of_cell] = cell
    return pressed


def _numbered(pressed: NDArray[np.intp], top: Float) -> NDArray[np.intp]:
    """Number of the press that each scan is of, or `_NOTHING`."""
    press = np.full(pressed.size, _NOTHING, dtype=np.intp)
    number = 0
    changes = np.flatnonzero(np.diff(pressed)) + 1
    for run in np.split(np.arange(pressed.size), changes):
        if pressed[run[0]] == _NOTHING or run.size < MIN_SCANS:
            continue
        for part in np.split(run, _valleys(top[run])):
            press[part] = number
            number += 1
    return press


def _valleys(rise: Float) -> list[int]:
    """Where the presses of a run (n,) meet: the least rise between peaks that stand out of it."""
    from scipy.signal import find_peaks

    floor = _NOISE_FLOOR * float(rise.max())
    height = np.log(np.maximum(rise, floor))
    peaks, _ = find_peaks(np.pad(height, 1, constant_values=np.log(floor)), prominence=VALLEY_LOG)
    peaks -= 1
    return [int(before + height[before:after].argmin()) for before, after in pairwise(peaks)]
