# SPDX-License-Identifier: Apache-2.0
"""A skin on which things happen by a script: minutes of scans within a second."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import readings
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import Scene
from stepped import stepped_link

REST = Scene("rest", 1, 2, seed=1).skin(0.0)


def rise(force_n: float | Float) -> Float:
    """Conductance above rest of a cell that has crept [S]."""
    return np.asarray(30e-6 * force_n**1.7)


class ScriptedSkin(SteppedSkin):
    """An emulated 1x2 skin in stepped time.

    rise: gives the conductances (1, 2) above those of `REST` [S] at a time since the script began
    [s]: since `begin` was called. happens: what is called when, by the same clock.
    """

    def __init__(
        self,
        rise: Callable[[float], Float],
        rate_hz: float,
        happens: Sequence[tuple[float, Callable[[], object]]] = (),
    ) -> None:
        self.begin_s = float("inf")
        self._rise = rise
        self._happens = sorted(happens, key=lambda event: event[0])
        board = EmulatedBoard(
            self._ratio, BoardSettings(1, 2, rate_hz=rate_hz, unit_id=7), noise_lsb=0.3
        )
        super().__init__(stepped_link(board))

    @property
    def script_s(self) -> float:
        """Time since the script began."""
        return self.now_s - self.begin_s

    def begin(self) -> None:
        """Let the script begin now."""
        self.begin_s = self.now_s

    def _ratio(self, time_s: float, _mode: str) -> Float:
        while self._happens and time_s - self.begin_s >= self._happens[0][0]:
            self._happens.pop(0)[1]()
        rise = self._rise(time_s - self.begin_s) if time_s >= self.begin_s else np.zeros((1, 2))
        return readings(replace(REST, cell_siemens=REST.cell_siemens + rise))
