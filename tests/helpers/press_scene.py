# SPDX-License-Identifier: Apache-2.0
"""A skin that a robot presses with known forces; its cells follow `studies.press`."""

from dataclasses import replace

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.scenes import Scene
from studies.press import LEAVE_S, PressModel, robot_presses

UNTOUCHED_S = 2.0
PEAKS_N = (0.5, 0.9, 1.5, 2.6, 4.4, 7.3)
PEAK_SPREAD = 0.1  # relative, to either side
STEP_S = 0.01  # at which a press is simulated


class PressScene(Scene):
    """A robot presses cell after cell, six times each with 0.4 to 8 N, 20 s a cell, once."""

    def __init__(self, rows: int, columns: int, *, seed: int = 0) -> None:
        super().__init__("rest", rows, columns, seed=seed)
        random = np.random.default_rng([seed, rows, columns])
        starts_s = [UNTOUCHED_S]
        self._histories: list[tuple[Float, Float, Float]] = []
        for _ in range(rows * columns):
            lift = 1 + PEAK_SPREAD * random.uniform(-1, 1, len(PEAKS_N))
            knots_s, knots_n = robot_presses(PEAKS_N * lift, random, starts_s[-1])
            starts_s.append(float(knots_s[-1]) + LEAVE_S)
            times_s = np.arange(starts_s[-2], starts_s[-1], STEP_S)
            forces_n = np.interp(times_s, knots_s, knots_n)
            # Each cell has its own model: one of all cells would take 64 times the memory.
            model = PressModel(seed=int(random.integers(1 << 32)))
            self._histories.append((times_s, forces_n, model.rise(times_s, forces_n)))
        self._starts_s = np.array(starts_s)

    def skin(self, time_s: float) -> Skin:
        rest = super().skin(time_s)
        return replace(rest, cell_siemens=rest.cell_siemens + self._pressed(time_s)[0])

    def ratio(self, time_s: float, mode: str = "near") -> Float:
        return self.faults.readings(self.skin(time_s), mode)

    def force_n(self, time_s: float) -> Float:
        """Force on every cell [N], shape (rows, columns)."""
        return self._pressed(time_s)[1]

    def _pressed(self, time_s: float) -> tuple[Float, Float]:
        """Rises [S] and forces [N] at a time, each (rows, columns)."""
        rise, force_n = np.zeros((2, self.rows, self.columns))
        cell = int(np.searchsorted(self._starts_s, time_s, side="right")) - 1
        if 0 <= cell < rise.size:
            times_s, forces_n, rises = self._histories[cell]
            force_n.flat[cell] = np.interp(time_s, times_s, forces_n)
            rise.flat[cell] = np.interp(time_s, times_s, rises)
        return rise, force_n
