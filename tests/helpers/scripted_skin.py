# SPDX-License-Identifier: Apache-2.0
"""A device whose time goes on when a scan is taken: minutes of scans within a second."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench_board import Bench
from ohmskin.arrays import Float
from ohmskin.circuit.skin import readings
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.scenes import Scene
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan

REST = Scene("rest", 1, 2, seed=1).skin(0.0)


def rise(force_n: float | Float) -> Float:
    """Conductance above rest of a cell that has crept [S]."""
    return np.asarray(30e-6 * force_n**1.7)


class ScriptedSkin(Bench):
    """An emulated 1x2 skin, in place of a `Device`.

    rise: gives the conductances (1, 2) above those of `REST` [S] at a time since the script began
    [s]: since `begin` was called. happens: what is called when, by the same clock.
    """

    mean_ratio = Device.mean_ratio

    def __init__(
        self,
        rise: Callable[[float], Float],
        rate_hz: float,
        happens: Sequence[tuple[float, Callable[[], object]]] = (),
    ) -> None:
        self.begin_s = float("inf")
        self._rise = rise
        self._happens = sorted(happens, key=lambda each: each[0])
        super().__init__(
            EmulatedBoard(self._ratio, 1, 2, rate_hz=rate_hz, noise_lsb=0.3, unit_id=7)
        )
        self._scans = super().__iter__()

    @property
    def script_s(self) -> float:
        """Time since the script began."""
        return self.now_s - self.begin_s

    def begin(self) -> None:
        """Let the script begin now."""
        self.begin_s = self.now_s

    def latest(self) -> Scan:
        """The next scan, when it is complete by the board's clock, which is the host's too."""
        due_s = self.board.next_scan_s or 0.0
        while self._happens and due_s - self.begin_s >= self._happens[0][0]:
            self._happens.pop(0)[1]()
        return next(self._scans)

    def __iter__(self) -> Iterator[Scan]:
        """Every scan, without end."""
        return iter(self.latest, None)

    def _ratio(self, time_s: float, _mode: str) -> Float:
        rise = self._rise(time_s - self.begin_s) if time_s >= self.begin_s else np.zeros((1, 2))
        return readings(replace(REST, cell_siemens=REST.cell_siemens + rise))
