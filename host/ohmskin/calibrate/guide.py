# SPDX-License-Identifier: Apache-2.0
"""From scan to scan: which press of known force is wanted next, and when it is had. Sans-IO."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.presses import SECOND_SHARE

Cells = tuple[tuple[int, int], ...]

# So long something lasts before it counts: a weight that lands, a hand that brushes past.
CERTAIN_S: Final = 0.3
WINDOW_S: Final = 1.0
# Fewer scans do not tell a change from noise: at slow rates the window is longer.
MIN_SCANS: Final = 8
# A conductance that creeps by 30 % a decade of time changes by so little from 2 s after the touch.
MAX_CHANGE: Final = 0.03
# More than that creep scatters, less than a hand: a wiggle may leave both halves the same mean.
MAX_SCATTER: Final = 0.05


@dataclass(frozen=True)
class Ask:
    """A press that is wanted: cell and force [N]."""

    row: int
    column: int
    force_n: float


@dataclass(frozen=True)
class Steady:
    """A press that is had.

    rise: mean of the cell's conductance above rest, over the steady second [S]. rise_std: standard
    error of that mean, from the scatter of the scans [S]; what is the same in all of them, such as
    rounding by the converter, is not in it.
    """

    ask: Ask
    rise: float
    rise_std: float


class State(Enum):
    """What a `Guide` waits for."""

    PUT = "put"
    HOLD = "hold"
    WRONG = "wrong"
    TAKE_OFF = "take off"
    DONE = "done"


@dataclass(frozen=True)
class Event:
    """What a scan has led to.

    ask: what is wanted, or was had and is to be taken off; None when all is done. cells: what is
    pressed. change: of the cell's rise from one half of the last second to the other, relative;
    None before a whole second. had: the press that this scan completes.
    """

    state: State
    ask: Ask | None
    cells: Cells = ()
    change: float | None = None
    had: Steady | None = None


def pressed_cells(rise: Float, touched: NDArray[np.bool_]) -> Cells:
    """The touched cell that rises most, and all that rise by more than `SECOND_SHARE` of it."""
    top = float(np.max(rise, where=touched, initial=0.0))
    if top <= 0:
        return ()
    return tuple((int(row), int(column)) for row, column in np.argwhere(rise > SECOND_SHARE * top))


def still_asked(asked: Iterable[Ask], had: Iterable[Ask]) -> list[Ask]:
    """What is asked and not had, in order: each press counts once, for its cell and force."""
    left = list(had)
    missing = []
    for ask in asked:
        for index, press in enumerate(left):
            same_cell = (press.row, press.column) == (ask.row, ask.column)
            if same_cell and math.isclose(press.force_n, ask.force_n, rel_tol=1e-6):
                del left[index]
                break
        else:
            missing.append(ask)
    return missing


class OnSkin:
    """What is pressed, without what lasts for less than `CERTAIN_S`."""

    def __init__(self) -> None:
        self.cells: Cells = ()
        self._differs_s: float | None = None  # since when something else is seen

    def see(self, time_s: float, pressed: Cells) -> bool:
        """Of one more scan; returns whether `cells` is now another."""
        if pressed == self.cells:
            self._differs_s = None
            return False
        # Time goes back where a board was reset.
        if self._differs_s is None or time_s < self._differs_s:
            self._differs_s = time_s
        if time_s - self._differs_s < CERTAIN_S:
            return False
        self.cells, self._differs_s = pressed, None
        return True


class Guide:
    """Asks for one press after another, and has it when the cell's conductance is steady.

    ======== ======================================= ==============================================
    state    on the skin, for certain                goes on to
    ======== ======================================= ==============================================
    PUT      nothing                                 HOLD or WRONG, as something is put on it
    HOLD     the asked cell alone                    TAKE_OFF when steady: the press is had;
                                                     PUT or WRONG when it is no longer so
    WRONG    another cell, or several                HOLD or PUT, when it is no longer so
    TAKE_OFF what was had, or anything               PUT of the next, or DONE, when nothing is
    DONE     anything                                nothing: all were had
    ======== ======================================= ==============================================

    For certain: for `CERTAIN_S`, see `OnSkin`; scans that differ for less are left out. Steady,
    with the rises x (n,) of the last `WINDOW_S`, at least `MIN_SCANS`, of mean m:

        v = mean((x[i+1] - x[i])^2) / 2            the noise from scan to scan, which averages out
        |mean of half 2 - mean of half 1| <= `MAX_CHANGE` m + 2 sqrt(4 v / n)
        var(x) - v <= (`MAX_SCATTER` m)^2

    v is the estimate of von Neumann (1941), which a slow change hardly enters. The first condition
    sees creep and a load still coming, the second what goes to and fro.
    """

    def __init__(self, asked: Sequence[Ask]) -> None:
        self._asked = deque(asked)
        self._on = OnSkin()
        self._is_had = False
        self._window: deque[tuple[float, float]] = deque()

    def feed(self, time_s: float, rise: Float, touched: NDArray[np.bool_]) -> Event:
        """One scan, in order: time on any clock [s]; rise above rest [S], touched (R, C)."""
        if self._window and time_s <= self._window[-1][0]:
            self._window.clear()
        pressed = pressed_cells(rise, touched)
        if self._on.see(time_s, pressed):
            self._window.clear()
        if self._is_had and not self._on.cells:
            self._asked.popleft()
            self._is_had = False
        if not self._asked:
            return Event(State.DONE, None, self._on.cells)
        ask, cells = self._asked[0], self._on.cells
        if self._is_had:
            return Event(State.TAKE_OFF, ask, cells)
        if not cells:
            return Event(State.PUT, ask)
        if cells != ((ask.row, ask.column),):
            return Event(State.WRONG, ask, cells)
        if pressed == cells:
            self._window.append((time_s, float(rise[ask.row, ask.column])))
        change, had = self._judge(ask)
        self._is_had = had is not None
        return Event(State.TAKE_OFF if had else State.HOLD, ask, cells, change, had)

    def _judge(self, ask: Ask) -> tuple[float | None, Steady | None]:
        window = self._window
        while len(window) > MIN_SCANS and window[-1][0] - window[1][0] >= WINDOW_S:
            window.popleft()
        if len(window) < MIN_SCANS or window[-1][0] - window[0][0] < WINDOW_S:
            return None, None
        x = np.array([rise for _, rise in window])
        mean, half = float(x.mean()), x.size // 2
        noise = float(np.mean(np.diff(x) ** 2)) / 2
        change = abs(float(x[half:].mean() - x[:half].mean()))
        steady = (
            change <= MAX_CHANGE * mean + 2 * math.sqrt(4 * noise / x.size)
            and float(x.var()) - noise <= (MAX_SCATTER * mean) ** 2
        )
        std = float(x.std(ddof=1)) / math.sqrt(x.size)
        return change / mean, Steady(ask, mean, std) if steady else None
