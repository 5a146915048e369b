# SPDX-License-Identifier: Apache-2.0
"""Presses of single cells, found in what a skin showed while a force sensor measured.

A scan belongs to the cell that rises most above rest, if that one is touched. Scans in a row of one
cell are a press, flickers of at most `FLICKER_SCANS` bridged, or several where the rise falls to a
fifth in between; fewer scans than `MIN_SCANS` are left out, and so is every scan in which another
cell rises by more than `SECOND_SHARE` of the first: two share the force, and nothing tells how.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing
from scipy.signal import find_peaks

from ohmskin.arrays import Float
from ohmskin.calibrate.force_log import ForceLog
from ohmskin.link.clock import scan_times_s
from ohmskin.link.messages import Scan

FLICKER_SCANS: Final = 3
MIN_SCANS: Final = 5
SECOND_SHARE: Final = 0.25
# Fewer scans of a time without touch do not tell the zero of a force sensor.
MIN_ZERO_SCANS: Final = 10
# Creep keeps a cell touched for a while: presses in quick succession meet in a valley.
VALLEY_LOG: Final = np.log(5.0)
_NOISE_FLOOR: Final = 1e-3
_NOTHING: Final = -1


@dataclass(frozen=True, eq=False)
class Presses:
    """What `ForceRegression.fit` learns from, n rows: arrays (n,).

    cells: flat indices. rise, rise_std: of that cell [S, or 1 for `voltage`]. force_n [N]. press:
    number of the press that a row is of. shape: (R, C). shared: scans left out because two cells
    were pressed. zero_n: what the force sensor showed without touch, already taken off [N].
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
        return np.bincount(self.cells[first], minlength=self.shape[0] * self.shape[1]).reshape(
            self.shape
        )


@dataclass(frozen=True, eq=False)
class LevelHistory:
    """Levels above rest of n scans. time_s (n,) [s]; rise, rise_std, touched (n, R, C)."""

    time_s: Float
    rise: Float
    rise_std: Float
    touched: NDArray[np.bool_]

    @classmethod
    def empty(cls, scans: list[Scan]) -> Self:
        """Room for what an estimator will say of these scans."""
        shape = (len(scans), *scans[0].codes.shape[:2])
        return cls(
            scan_times_s(scans), np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.bool_)
        )


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
    # Of many scans, for the force begins before a touch is certain.
    enough = np.count_nonzero(untouched) >= MIN_ZERO_SCANS
    zero_n = float(np.median(force_n[untouched])) if enough else 0.0

    flat = history.rise.reshape(scans, -1)
    pressed = _pressed(flat, history.touched.reshape(scans, -1))
    index = np.arange(scans)
    top = flat[index, pressed]
    press = _numbered(pressed, top)
    others = flat.copy()
    others[index, pressed] = -np.inf
    shared = (press >= 0) & (others.max(axis=1) > SECOND_SHARE * top)
    good = (press >= 0) & ~shared & known
    if not good.any():
        raise ValueError("no cell is pressed alone while the force is known")
    return Presses(
        cells=pressed[good],
        rise=top[good],
        rise_std=history.rise_std.reshape(scans, -1)[index, pressed][good],
        # Below zero is the sensor's noise: `ForceLog` refuses more than that.
        force_n=np.maximum(force_n[good] - zero_n, 0.0),
        press=press[good],
        shape=(rows, columns),
        shared=int(np.count_nonzero(shared)),
        zero_n=zero_n,
    )


def _pressed(rise: Float, touched: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Index of the cell that each scan belongs to, or `_NOTHING`."""
    top = rise.argmax(axis=1)
    bridge = np.ones(FLICKER_SCANS + 1, dtype=np.bool_)
    pressed = np.full(top.size, _NOTHING, dtype=np.intp)
    for cell in np.unique(top):
        of_cell = (top == cell) & touched[:, cell]
        padded = np.pad(of_cell, FLICKER_SCANS + 1)
        closed = binary_closing(padded, bridge)[FLICKER_SCANS + 1 : -FLICKER_SCANS - 1]
        pressed[closed & (pressed == _NOTHING)] = cell
        pressed[of_cell] = cell
    return pressed


def _numbered(pressed: NDArray[np.intp], top: Float) -> NDArray[np.intp]:
    """Number of the press that each scan is of, or `_NOTHING`."""
    starts = np.flatnonzero(np.diff(pressed, prepend=_NOTHING - 1))
    press = np.full(pressed.size, _NOTHING, dtype=np.intp)
    number = 0
    for start, end in zip(starts, [*starts[1:], pressed.size], strict=True):
        if pressed[start] == _NOTHING or end - start < MIN_SCANS:
            continue
        valleys = _valleys(top[start:end])
        for begin, stop in zip([0, *valleys], [*valleys, end - start], strict=True):
            press[start + begin : start + stop] = number
            number += 1
    return press


def _valleys(rise: Float) -> list[int]:
    """Where the presses of a run (n,) meet: the least between peaks that stand out of it."""
    floor = _NOISE_FLOOR * float(rise.max())
    height = np.log(np.maximum(rise, floor))
    peaks, _ = find_peaks(np.pad(height, 1, constant_values=np.log(floor)), prominence=VALLEY_LOG)
    peaks -= 1
    return [int(before + height[before:after].argmin()) for before, after in pairwise(peaks)]
