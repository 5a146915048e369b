# SPDX-License-Identifier: Apache-2.0
"""One press as a series of time, and the smallest force that is told from none: simulated.

Sections V.C and V.D of [Su2024] (see `published`), 2x2.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from rich.table import Table
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READINGS_PER_CELL
from ohmskin.emulate.board import DEFAULT_RATE_HZ
from ohmskin.estimate.methods import VOLTAGE, make_estimator
from ohmskin.estimate.ohm import voltage_level
from studies.force_experiment import FAST, REGRESSIONS, SLOW, TRUTH, learn, rises
from studies.force_trial import Choreography, ForceTrial, OneFrameBoard, Plan, groups_of
from studies.press import PressModel
from studies.rows import Progress, Steps, text_table
from studies.trials import knowledge_of, skin_at_rest

SHAPE: Final = (2, 2)  # the paper's skin
PRESSED_CELL: Final = 3  # number of the cell (2, 2), as in the paper's figure
SERIES_S: Final = 4.0  # how long the series is, as in the paper's figure
SERIES_N: Final = 5.0  # how hard its press is, as in the paper's figure
# The paper's methods see one frame of the series in so many. Chosen: a frame takes them 0.1 s.
_SLOW_EVERY: Final = 10
# Force of the touches beside [N], and the largest force that is tried. Chosen: the weight of 100 g,
# about.
TOUCH_N: Final = 1.0
# The least force that is tried [N]. Chosen: below what any method tells from none.
_LEAST_N: Final = 0.005
FALSE_ALARMS: Final = 0.01  # share of the frames without a force that count as touched. Chosen.
DETECTED: Final = 0.99  # share of the frames with a force that must count as touched. Chosen.
ALONE: Final = "alone"
BESIDE: Final = "beside two touches"


@dataclass(frozen=True)
class CrossTalk:
    """Largest false force on an unpressed cell over the largest force on the pressed one.

    regression, method: what gave the forces.
    skins: how many there were.
    percent, worst_percent: mean over them, and the worst of them.
    """

    regression: str
    method: str
    skins: int
    percent: float
    worst_percent: float


def press_series(seed: int) -> ForceTrial:
    """A calibration, then group 0: 4 s at 90 Hz, in which one cell alone is pressed and left."""
    steps = Choreography(*SHAPE, seed, PressModel())
    steps.calibrate(Plan().presses, Plan().frames_per_press)
    frames = np.arange(round(SERIES_S * DEFAULT_RATE_HZ))
    # Not quite back to back: a frame has to be over before the next is begun.
    times_s = np.asarray(steps.now_s + frames * (1 + 1e-6) / DEFAULT_RATE_HZ, dtype=np.float64)
    corners_s = steps.now_s + np.array([0.4, 1.6, 2.4, 3.6])
    steps.force(PRESSED_CELL, corners_s, np.array([0.0, SERIES_N, SERIES_N, 0.0]))
    steps.watch(PRESSED_CELL, times_s, group=0)
    return steps.perform()


def cross_talk(
    seeds: int, slow_seeds: int, progress: Progress | None = None
) -> tuple[ForceTrial, list[CrossTalk]]:
    """The first skin's series, and what all of them show.

    The paper's methods read fewer skins, every tenth frame of the series, and one of each press.
    """
    steps = Steps(seeds * len(FAST) + slow_seeds * len(SLOW), progress)
    percents: dict[tuple[str, str], list[float]] = {}
    trials = [press_series(seed) for seed in range(seeds)]
    with threadpool_limits(limits=1):
        for method in (*FAST, *SLOW):
            for trial in trials if method not in SLOW else trials[:slow_seeds]:
                shown = _thinned(trial) if method in SLOW else trial
                rise = rises(method, shown)
                for regression in REGRESSIONS:
                    force_n = learn(shown, rise, regression)(rise)[shown.group == 0]
                    false_n = np.delete(force_n.reshape(len(force_n), -1), PRESSED_CELL, axis=1)
                    percents.setdefault((regression, method), []).append(
                        100 * float(np.abs(false_n).max()) / SERIES_N
                    )
                steps.done()
    return trials[0], [
        CrossTalk(*key, len(of_skins), round(float(np.mean(of_skins)), 3), round(max(of_skins), 3))
        for key, of_skins in percents.items()
    ]


def _thinned(trial: ForceTrial) -> ForceTrial:
    """The first frame of each press of the calibration, and some of the series."""
    first = np.unique(trial.press, return_index=True)[1]
    kept = np.zeros(len(trial.time_s), dtype=np.bool_)
    kept[first[trial.group[first] < 0]] = True
    kept[np.flatnonzero(trial.group == 0)[::_SLOW_EVERY]] = True
    return replace(
        trial,
        **{
            name: getattr(trial, name)[kept]
            for name in ("time_s", "ratio", "force_n", "rise_siemens", "cell", "press", "group")
        },
    )


@dataclass(frozen=True)
class SmallestForce:
    """Smallest force on a cell that one frame tells from none [N]; None: none up to 1 N.

    method, scene: what reads; `ALONE` or `BESIDE`.
    by_cell_n: the median over skins, cells row by row.
    median_n, worst_n: over cells and skins.
    """

    method: str
    scene: str
    by_cell_n: tuple[float | None, ...]
    median_n: float | None
    worst_n: float | None


@dataclass(frozen=True)
class Detection:
    """How much is read.

    seeds: skins.
    empty_frames: frames without force.
    frames: frames at each force.
    forces: how many forces are tried, up to 1 N.
    methods: what reads.
    """

    seeds: int = 4
    empty_frames: int = 400
    frames: int = 150
    forces: int = 14
    methods: tuple[str, ...] = tuple(method for method in FAST if method != TRUTH)


def smallest_forces(plan: Detection, progress: Progress | None = None) -> list[SmallestForce]:
    """Detection of one touch, alone and beside two of 1 N on two of the other three cells.

    A cell is said to be touched when its conductance (`voltage`: its level) exceeds the value that
    1 % of the frames without force on it exceed, in the same scene; a force is told from none when
    99 % of its frames are. Forces are held still; contacts are as noisy as in `PressModel`.
    """
    forces_n = np.geomspace(_LEAST_N, TOUCH_N, plan.forces)
    least_n: dict[tuple[str, str], Float] = {
        (method, scene): np.empty((plan.seeds, 4))
        for method in plan.methods
        for scene in (ALONE, BESIDE)
    }
    steps = Steps(plan.seeds * 8, progress)
    with threadpool_limits(limits=1):
        for seed in range(plan.seeds):
            for scene in (ALONE, BESIDE):
                for cell in range(4):
                    for method, levels in _levels(plan, forces_n, seed, scene, cell).items():
                        empty, touched = np.split(levels, [plan.empty_frames])
                        threshold = np.quantile(empty, 1 - FALSE_ALARMS)
                        weakest = np.quantile(
                            touched.reshape(plan.forces, -1), 1 - DETECTED, axis=1
                        )
                        margin = weakest - threshold
                        least_n[method, scene][seed, cell] = crossing_n(forces_n, margin)
                    steps.done()
    return [
        SmallestForce(
            method,
            scene,
            tuple(_number(value) for value in np.median(by_skin_n, axis=0)),
            _number(np.median(by_skin_n)),
            _number(by_skin_n.max()),
        )
        for (method, scene), by_skin_n in least_n.items()
    ]


def _levels(plan: Detection, forces_n: Float, seed: int, scene: str, cell: int) -> dict[str, Float]:
    """What each method shows at the cell: frames without force, then those at each force."""
    random = np.random.default_rng([seed, cell, scene == BESIDE])
    skin = skin_at_rest(*SHAPE, np.random.default_rng(seed))
    target_n = np.concatenate([np.zeros(plan.empty_frames), np.repeat(forces_n, plan.frames)])
    force_n = np.zeros((len(target_n), 4))
    force_n[:, cell] = target_n
    if scene == BESIDE:
        others = np.delete(np.arange(4), cell)
        free = random.choice(others, len(target_n))
        for other in others:
            force_n[free != other, other] = TOUCH_N
    # A second apart, so that no frame repeats the noise of another.
    model = PressModel(play_n=0.0, creep=0.0, seed=seed)
    rise = model.rise(np.arange(len(target_n), dtype=float), force_n.reshape(-1, *SHAPE))
    board = OneFrameBoard(SHAPE, int(random.integers(1 << 32)))
    known = knowledge_of(board.rest_ratio(skin))
    mixed = random.permutation(len(target_n))
    ratio = np.empty((*rise.shape, READINGS_PER_CELL))
    for number, frame in enumerate(mixed):
        pressed = replace(skin, cell_siemens=skin.cell_siemens + rise[frame])
        ratio[frame] = board.read(10.0 + number, pressed)
    levels: dict[str, Float] = {}
    for method in plan.methods:
        if method == VOLTAGE:
            levels[method] = voltage_level(ratio).reshape(-1, 4)[:, cell]
            continue
        estimator = make_estimator(method, known)
        level = levels[method] = np.empty(len(target_n))
        for frame in mixed:
            level[frame] = estimator.estimate(ratio[frame]).cell_siemens.flat[cell]
    return levels


def crossing_n(forces_n: Float, margin: Float) -> float:
    """The force [N] from which on the margin stays above 0; inf if it does not."""
    below = np.flatnonzero(margin <= 0)
    if not below.size:
        return float(forces_n[0])
    last = int(below[-1])
    if last + 1 == len(forces_n):
        return np.inf
    share = margin[last] / (margin[last] - margin[last + 1])
    logs = np.log(forces_n)
    return float(np.exp(logs[last] + share * (logs[last + 1] - logs[last])))


def _number(force_n: float) -> float | None:
    return round(float(force_n), 4) if np.isfinite(force_n) else None


# --------------------------------------------------------------------------------------- answers


def talk_table(rows: Iterable[CrossTalk]) -> Table:
    """Cross-talk by method."""
    title = "largest false force on an unpressed cell over the largest on the pressed, simulated"
    numbers = ("skins", "mean %", "worst %")
    table = text_table(("regression", "method"), numbers, title=title, title_justify="left")
    for row in rows:
        percents = (f"{row.percent:.2f}", f"{row.worst_percent:.2f}")
        table.add_row(row.regression, row.method, str(row.skins), *percents)
    return table


def smallest_table(rows: Iterable[SmallestForce]) -> Table:
    """The smallest force told from none, by method and scene."""
    title = "smallest force told from none by one frame [N], simulated"
    numbers = ("median", "worst", *groups_of(*SHAPE))
    table = text_table(("scene", "method"), numbers, title=title, title_justify="left")
    for row in sorted(rows, key=lambda row: row.scene):
        forces_n = (row.median_n, row.worst_n, *row.by_cell_n)
        table.add_row(
            row.scene,
            row.method,
            *("above 1" if number is None else f"{number:.3f}" for number in forces_n),
        )
    return table
