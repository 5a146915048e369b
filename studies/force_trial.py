# SPDX-License-Identifier: Apache-2.0
"""Force experiments on skins that do not exist: who presses where, and what a board reads then.

Simulation, all of it: cells follow `PressModel`, the circuit `ohmskin.circuit`, and an emulated
board reads it in 10 bits with its noise. The board is started for each frame wanted and stopped
after it, since most of an experiment's time is pauses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, readings
from ohmskin.emulate.board import DEFAULT_RATE_HZ, BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import SteppedLink, SteppedSkin
from ohmskin.link.protocol import ENUMS, MODES
from studies.press import LEAVE_S, PressModel, robot_presses
from studies.trials import BEND, NOISE_LSB, SPREAD, skin_at_rest, stretched

WEIGHT_N: Final = 0.981  # a weight of 100 g, as in the paper's experiment
FORCES_N: Final = (0.5, 8.0)  # the robot's least and largest. Chosen: the paper does not say.
REST_FRAMES: Final = 180  # of the untouched skin: two seconds, as `ohmskin record --tare 2` takes
_WEIGHT_LANDS_S: Final = 0.5  # until a weight presses in full. Chosen.
# Frames of a press are read at random times, but not in this share of it at its begin and its end,
# where there is hardly a force. Chosen.
_INSIDE: Final = 0.02


@dataclass(frozen=True)
class Plan:
    """How much is pressed and read.

    seeds: skins.
    presses: of each cell in the calibration.
    test_presses: of the robot, in each arrangement of weights.
    frames_per_press: read in each press, in the calibration and in the test.
    """

    seeds: int = 8
    presses: int = 6
    test_presses: int = 5
    frames_per_press: int = 4


@dataclass(frozen=True, eq=False)
class ForceTrial:
    """F frames of one skin, in order of time, and the truth behind them.

    time_s: when each frame was read, (F,).
    ratio, far_ratio: as read, in mode near and in mode far, (F, R, C, 4).
    rest_ratio, far_rest_ratio: mean of the readings of the untouched skin, (R, C, 4).
    force_n, rise_siemens: the truth, (F, R, C).
    cell: flat index of the cell that the robot presses, (F,).
    press: number of its press, (F,).
    group: of the test, -1 in the calibration, (F,).
    """

    time_s: Float
    ratio: Float
    rest_ratio: Float
    far_ratio: Float
    far_rest_ratio: Float
    force_n: Float
    rise_siemens: Float
    cell: NDArray[np.intp]
    press: NDArray[np.intp]
    group: NDArray[np.intp]


class Choreography:
    """Who presses where and when, written down step by step; `perform` makes it a `ForceTrial`.

    now_s: the end of what is written down. model: of the skin's cells.
    """

    def __init__(self, rows: int, columns: int, seed: int, model: PressModel) -> None:
        self.shape = (rows, columns)
        self.random = np.random.default_rng([seed, rows, columns])
        self.model = replace(model, seed=seed)
        self.now_s = 2.0
        self._skin = skin_at_rest(rows, columns, self.random)
        self._bend_s = np.inf
        self._bent = self._skin
        # Of each cell: times and forces, straight in between.
        self._knots: list[tuple[list[float], list[float]]] = [
            ([0.0], [0.0]) for _ in range(rows * columns)
        ]
        self._frames: list[tuple[float, int, int, int]] = []  # time, cell, press, group
        self._press = -1

    def robot(self, cell: int, peaks_n: Float, frames: int, group: int = -1) -> None:
        """Presses of one cell with these forces, and so many frames at random times in each."""
        times_s, forces_n = robot_presses(list(peaks_n), self.random, self.now_s)
        self.force(cell, times_s, forces_n)
        for begin_s, end_s in zip(times_s[::4], times_s[3::4], strict=True):
            self._press += 1
            inside = self.random.uniform(_INSIDE, 1 - _INSIDE, frames)
            for part in np.sort(inside):
                time_s = float(begin_s + part * (end_s - begin_s))
                self._frames.append((time_s, cell, self._press, group))
        self.now_s = float(times_s[-1])

    def watch(self, cell: int, times_s: Float, group: int) -> None:
        """Frames at these times."""
        self._frames += [(float(time_s), cell, self._press, group) for time_s in times_s]

    def force(self, cell: int, times_s: Float, forces_n: Float) -> None:
        """Forces on one cell at these times, straight in between, which stay until the next."""
        knots_s, knots_n = self._knots[cell]
        knots_s += [float(time_s) for time_s in times_s]
        knots_n += [float(force_n) for force_n in forces_n]

    def weights(self, cells: list[int], force_n: float) -> None:
        """Put weights on these cells, or take them off with 0 N, and wait."""
        landing_s = np.array([self.now_s, self.now_s + _WEIGHT_LANDS_S])
        for cell in cells:
            self.force(cell, landing_s, np.array([self._knots[cell][1][-1], force_n]))
        self.now_s = float(landing_s[-1])
        self.pause()

    def pause(self) -> None:
        """Let creep fade."""
        self.now_s += LEAVE_S

    def calibrate(self, presses: int, frames: int) -> None:
        """Press every cell alone, with forces that grow."""
        for cell in range(self.shape[0] * self.shape[1]):
            self.robot(cell, np.geomspace(*FORCES_N, presses), frames)
            self.pause()

    def bend(self) -> None:
        """From now on the wires are longer, by the same in a layer and each segment for itself."""
        longer = stretched(self._skin, BEND)
        top, bottom = (
            wire_ohm * np.exp(SPREAD * self.random.standard_normal(self.shape))
            for wire_ohm in (longer.top_wire_ohm, longer.bottom_wire_ohm)
        )
        self._bend_s = self.now_s
        self._bent = replace(self._skin, top_wire_ohm=top, bottom_wire_ohm=bottom)

    def perform(self) -> ForceTrial:
        """What the board reads, and the truth."""
        time_s, cell, press, group = (
            np.array(column) for column in zip(*self._frames, strict=True)
        )
        # All corners of the forces: between them the model's steps are exact.
        corners_s = [corner for knots_s, _ in self._knots for corner in knots_s]
        steps_s = np.unique(np.concatenate([time_s, corners_s]))
        forces_n = np.stack([np.interp(steps_s, *knots) for knots in self._knots], axis=-1)
        rises = self.model.rise(steps_s, forces_n.reshape(-1, *self.shape))
        seen = np.searchsorted(steps_s, time_s)
        seed = int(self.random.integers(1 << 32))
        read: dict[str, tuple[Float, Float]] = {}
        for mode in ("near", "far"):
            board = OneFrameBoard(self.shape, seed, mode)
            rest_ratio = board.rest_ratio(self._skin)
            ratio = [
                board.read(float(now_s), self._skin_at(float(now_s), rise))
                for now_s, rise in zip(time_s, rises[seen], strict=True)
            ]
            read[mode] = np.array(ratio), rest_ratio
        return ForceTrial(
            time_s,
            *read["near"],
            *read["far"],
            force_n=forces_n[seen].reshape(-1, *self.shape),
            rise_siemens=rises[seen],
            cell=cell.astype(np.intp),
            press=press.astype(np.intp),
            group=group.astype(np.intp),
        )

    def _skin_at(self, time_s: float, rise: Float) -> Skin:
        skin = self._bent if time_s >= self._bend_s else self._skin
        return replace(skin, cell_siemens=self._skin.cell_siemens + rise)


def surface_trial(
    rows: int, columns: int, seed: int, plan: Plan, model: PressModel, *, curved: bool
) -> ForceTrial:
    """Calibration by single touches on a flat skin, then the test on it or with its wires bent.

    On 2x2 group g of the test is the cell (g // 2, g % 2) pressed by the robot beside a weight on
    both cells of the other column. On larger skins group g is g + 3 touches, 3 to 6, at random
    places, one of them the robot's; three arrangements each.
    """
    steps = Choreography(rows, columns, seed, model)
    steps.calibrate(plan.presses, plan.frames_per_press)
    if curved:
        steps.bend()
    for group, pressed, weighted in _arrangements(rows, columns, steps.random):
        steps.weights(weighted, WEIGHT_N)
        peaks_n = steps.random.uniform(*FORCES_N, plan.test_presses)
        steps.robot(pressed, peaks_n, plan.frames_per_press, group)
        steps.weights(weighted, 0.0)
    return steps.perform()


def groups_of(rows: int, columns: int) -> list[str]:
    """What the groups of `surface_trial` are called; rows and columns as the paper counts them."""
    if (rows, columns) == (2, 2):
        return [f"({row}, {column})" for row in (1, 2) for column in (1, 2)]
    return [f"{touches} touches" for touches in range(3, 7)]


def _arrangements(
    rows: int, columns: int, random: np.random.Generator
) -> list[tuple[int, int, list[int]]]:
    """Group, the robot's cell, the weights' cells."""
    if (rows, columns) == (2, 2):
        return [(cell, cell, [1 - cell % 2, 3 - cell % 2]) for cell in range(4)]
    drawn = []
    for group in range(4):
        for _ in range(3):
            cells = random.choice(rows * columns, group + 3, replace=False)
            drawn.append((group, int(cells[0]), [int(cell) for cell in cells[1:]]))
    return drawn


class OneFrameBoard:
    """An emulated board that is started for one frame at a time."""

    def __init__(self, shape: tuple[int, int], seed: int, mode: str = "near") -> None:
        self._ratio, self._mode = np.empty(0), mode
        settings = BoardSettings(*shape, mode=mode, rate_hz=DEFAULT_RATE_HZ)
        board = EmulatedBoard(
            lambda _time_s, _mode: self._ratio, settings, noise_lsb=NOISE_LSB, seed=seed
        )
        self._board = SteppedSkin(SteppedLink(board))

    def rest_ratio(self, skin: Skin) -> Float:
        """Mean of the first readings (R, C, 4), which are those of the untouched skin."""
        frames = [self.read(index / DEFAULT_RATE_HZ, skin) for index in range(REST_FRAMES)]
        return np.asarray(np.mean(frames, axis=0))

    def read(self, time_s: float, skin: Skin) -> Float:
        """Readings (R, C, 4) of a frame begun at a time, or when the frame before is over."""
        if self._mode == "near":
            self._ratio = readings(skin)
        else:
            every = all_readings(skin, end_admittance(skin))
            self._ratio = every[..., [ENUMS["reading"].values[n] for n in MODES[self._mode]]]
        self._board.step(time_s - self._board.now_s)
        scan = self._board.latest()
        self._board.stop()
        return scan.ratio
