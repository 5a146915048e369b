# SPDX-License-Identifier: Apache-2.0
"""Leads a person from press to press: which one is wanted next, and when it is read.

A `Guide` is fed with scans and says what it waits for. It has no clock, no terminal and no board:
who feeds it has them.
"""

import math
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.calibrate.presses import SECOND_SHARE
from ohmskin.link.messages import Scan

# Cells as (row, column).
Cells = tuple[tuple[int, int], ...]

# Something counts when it has lasted for so long. Chosen: a weight that lands, or a hand that
# brushes past, takes less.
CERTAIN_S: Final = 0.3
# A press is read over a window of so long. Chosen: noise averages out, and nobody loses patience.
READING_S: Final = 1.0
# A press is read over so many scans at least. Chosen: fewer do not tell a change from noise.
MIN_READING_SCANS: Final = 8
# Largest change from one half of the window to the other, as a share of the mean. Chosen: a
# conductance that creeps by 30 % a decade of time changes by less from 2 s after the touch on.
MAX_CHANGE_SHARE: Final = 0.03
# Largest standard deviation in the window, noise apart, as a share of the mean. Chosen: creep
# scatters less, a hand more, even where its wiggle leaves both halves the same mean.
MAX_SCATTER_SHARE: Final = 0.05


class Press(NamedTuple):
    """A press of one cell (row, column) by a known force [N]."""

    cell: tuple[int, int]
    force_n: float


class State(Enum):
    """What a `Guide` waits for."""

    PUT = "put"
    HOLD = "reading"
    WRONG = "wrong"
    TAKE_OFF = "take off"
    DONE = "done"


class Step(NamedTuple):
    """Where a scan has led to.

    state: what the guide waits for now.
    wanted: the press that is wanted, or was read and is to be taken off; None when all are done.
    cells: what is pressed.
    change: of the rise from one half of the window to the other, as a share of its mean; None
        before a whole window.
    rise: mean conductance of the cell above rest over the window [S], if this scan completes the
        press; else None.
    rise_std: standard error of that mean [S], from the scatter of the scans.
    scans: those of the window, if this scan completes the press.
    """

    state: State
    wanted: Press | None
    cells: Cells = ()
    change: float | None = None
    rise: float | None = None
    rise_std: float = math.nan
    scans: Sequence[Scan] = ()


def pressed_cells(rise: Float, touched: Bool) -> Cells:
    """The touched cell that rises most, and all that rise by more than `SECOND_SHARE` of it."""
    top = float(np.max(rise, where=touched, initial=0.0))
    if top <= 0:
        return ()
    return tuple((int(row), int(column)) for row, column in np.argwhere(rise > SECOND_SHARE * top))


def still_wanted(wanted: Iterable[Press], read: Iterable[Press]) -> list[Press]:
    """What is wanted and not read yet, in order. Each press that was read counts once.

    Forces that were kept in a file may differ in their last digit, so they are rounded.
    """

    def alike(press: Press) -> Press:
        return press._replace(force_n=round(press.force_n, 9))

    spare = Counter(map(alike, read))
    missing = []
    for press in wanted:
        if spare[alike(press)] <= 0:
            missing.append(press)
        spare[alike(press)] -= 1
    return missing


class OnSkin:
    """What is on the skin, without what lasts for less than `CERTAIN_S`.

    cells: what is pressed, for certain.
    """

    def __init__(self) -> None:
        self.cells: Cells = ()
        self._differs_s = math.inf  # since when something else is seen

    def see(self, time_s: float, pressed: Cells) -> bool:
        """One more scan, at a time of any clock [s]. Returns whether `cells` has changed."""
        if pressed == self.cells:
            self._differs_s = math.inf
            return False
        self._differs_s = min(self._differs_s, time_s)  # time goes back where a board was reset
        if time_s - self._differs_s < CERTAIN_S:
            return False
        self.cells, self._differs_s = pressed, math.inf
        return True


class Guide:
    """Wants one press after another, and reads it when the cell's conductance is steady.

    ======== ======================================= ==============================================
    state    on the skin, for certain                goes on to
    ======== ======================================= ==============================================
    PUT      nothing                                 HOLD or WRONG
    HOLD     the wanted cell alone                   TAKE_OFF when it is steady, else PUT or WRONG
    WRONG    another cell, or several                HOLD or PUT
    TAKE_OFF what was read, or anything              PUT of the next or DONE, when nothing is
    DONE     anything                                nothing: all were read
    ======== ======================================= ==============================================

    For certain: see `OnSkin`. A press is steady if, with the rises x (n,) of its cell in the last
    `READING_S` and their mean m,

        v = mean((x[i+1] - x[i])^2) / 2             noise from scan to scan, without what is slower
        |mean of half 2 - mean of half 1| <= `MAX_CHANGE_SHARE` m + 2 sqrt(4 v / n)   no creep
        var(x) - v <= (`MAX_SCATTER_SHARE` m)^2                                       no wiggle

    v is von Neumann's (1941). 4 v / n is the variance of the difference of two means of n / 2 each,
    so noise alone is taken for creep in one of twenty windows at most.
    """

    def __init__(self, wanted: Sequence[Press]) -> None:
        self._wanted = deque(wanted)
        self._on = OnSkin()
        self._is_read = False
        # Times [s], rises of the wanted cell, scans.
        self._window: deque[tuple[float, float, Scan]] = deque()

    def feed(self, time_s: float, rise: Float, touched: Bool, scan: Scan) -> Step:
        """One scan, in order: time on any clock [s]; rise above rest [S], touched (R, C)."""
        if self._window and time_s <= self._window[-1][0]:
            self._window.clear()  # the board was reset: its clock begins anew
        pressed = pressed_cells(rise, touched)
        if self._on.see(time_s, pressed):
            self._window.clear()
        cells = self._on.cells
        if self._is_read and not cells:
            self._wanted.popleft()
            self._is_read = False
        if not self._wanted:
            return Step(State.DONE, None, cells)
        press = self._wanted[0]
        if self._is_read:
            return Step(State.TAKE_OFF, press, cells)
        if cells != (press.cell,):
            return Step(State.WRONG if cells else State.PUT, press, cells)
        if pressed == cells:  # and not a glimpse of something else
            self._window.append((time_s, float(rise[press.cell]), scan))
        return self._held(press)

    def _held(self, press: Press) -> Step:
        """What the window says of the press: that it is steady, and so read, or not yet."""
        window, step = self._window, Step(State.HOLD, press, (press.cell,))
        while len(window) > MIN_READING_SCANS and window[-1][0] - window[1][0] >= READING_S:
            window.popleft()
        if len(window) < MIN_READING_SCANS or window[-1][0] - window[0][0] < READING_S:
            return step
        _, rises, scans = zip(*window, strict=True)
        x = np.array(rises)
        change, is_steady = steady(x)
        step = step._replace(change=change)
        if not is_steady:
            return step
        self._is_read = True
        std = float(x.std(ddof=1)) / math.sqrt(x.size)
        return step._replace(state=State.TAKE_OFF, rise=float(x.mean()), rise_std=std, scans=scans)


def steady(x: Float) -> tuple[float, bool]:
    """Change of a window (n,) from half to half, as a share of its mean; and if it is steady.

    By the equations of `Guide`.
    """
    mean, half = abs(float(x.mean())), x.size // 2
    noise = float(np.mean(np.diff(x) ** 2)) / 2
    change = abs(float(x[half:].mean() - x[:half].mean()))
    creeps = change > MAX_CHANGE_SHARE * mean + 2 * math.sqrt(4 * noise / x.size)
    wiggles = float(x.var()) - noise > (MAX_SCATTER_SHARE * mean) ** 2
    return change / max(mean, 1e-300), not (creeps or wiggles)
