# SPDX-License-Identifier: Apache-2.0
"""Force from voltages against force from estimated conductances: flat and curved skins, simulated.

Section V.B of [Su2024] (see `published`), with our methods beside theirs. Each cell's regression is
learned from single touches and used on several touches at once. Three kinds of regression, the same
for voltage and for every method:

    "line"     F = a x + c by ordinary least squares, nothing else: the paper's
    "squares"  F = a x^b by ordinary least squares, b up to 50, nothing else
    "choice"   `ForceRegression`: a line or a power law, scatter that may grow; never below 0

A voltage saturates, so "squares" follows its heavy presses by exponents of 4 to 11, which none of
the laws of "choice" has: it is there so that the baseline is compared at its best, too.

Errors are root mean squares in newton over frames, then the mean over skins. Besides the methods
there are "voltage", the paper's baseline, and "truth", the true conductances: what the regression,
the cells' memory and their noise leave to the best readout there can be.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from rich.table import Table
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.calibrate.regression import ForceRegression, fit_power
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import METHODS, VOLTAGE, make_estimator
from ohmskin.estimate.ohm import voltage_level
from ohmskin.link.protocol import MODES
from studies.force_trial import ForceTrial, Plan, groups_of, surface_trial
from studies.press import PressModel
from studies.published import FORCE_RMSE_N
from studies.rows import Progress, Steps, text_table
from studies.trials import PAPER_METHODS, knowledge_of

TRUTH: Final = "truth"
UNTOLD: Final = "joint, wires not told"
FAR: Final = "joint, far ends, wires not told"
LINE: Final = "line"
SQUARES: Final = "squares"
CHOICE: Final = "choice"
REGRESSIONS: Final = (LINE, SQUARES, CHOICE)
# Exponents that "squares" tries. Chosen: so far apart that the best one is met to 4 %.
_EXPONENTS: Final = np.geomspace(0.1, 50, 81)
EVERY_GROUP: Final = "mean"
# A frame takes these a tenth of a second.
SLOW: Final = PAPER_METHODS
FAST: Final = (VOLTAGE, *(name for name in METHODS if name not in SLOW), TRUTH)
ALL: Final = (VOLTAGE, *METHODS, TRUTH)
CELLS: Final = {
    "whole": PressModel(),
    "no memory": PressModel(play_n=0.0, creep=0.0),
    "ideal": PressModel(play_n=0.0, creep=0.0, noise=0.0, drift=0.0),
}


@dataclass(frozen=True)
class Comparison:
    """Methods on the same frames.

    rows, columns: the skin.
    plan: how much is pressed and read.
    methods: what reads.
    cells: names of `CELLS`: how the skin's cells answer to force.
    """

    rows: int
    columns: int
    plan: Plan
    methods: tuple[str, ...]
    cells: tuple[str, ...]


# The second has so few frames that the paper's methods can be run on them as well.
FULL: Final = (
    Comparison(2, 2, Plan(), (*FAST, UNTOLD, FAR), tuple(CELLS)),
    Comparison(2, 2, Plan(4, 5, 4, 1), ALL, ("whole",)),
    Comparison(8, 8, Plan(4, 6, 3, 3), (*FAST, UNTOLD, FAR), tuple(CELLS)),
)
QUICK: Final = (
    Comparison(2, 2, Plan(1, 6, 2, 2), FAST, tuple(CELLS)),
    Comparison(2, 2, Plan(1, 2, 1, 1), ALL, ("whole",)),
    Comparison(4, 4, Plan(1, 6, 2, 1), FAST, ("whole",)),
)


@dataclass(frozen=True)
class Row:
    """One method's errors [N], mean over skins.

    surface, rows, columns: the skin, "flat" or "curved".
    cells: "whole", "no memory" (no hysteresis, no creep), "ideal" (no noise either).
    skins, frames: how many there were, and how many frames of each.
    regression, method: what gave the forces.
    group: see `surface_trial`; "mean": the mean over groups.
    calibration_n: of the pressed cell, in the calibration's own frames (2x2: of the group's cell).
    pressed_n: of the robot's cell in the test.
    every_cell_n: of all cells in the test, be they pressed, under a weight or free.
    pressed_below_percent, every_cell_below_percent: how much less than "voltage" by the same
    regression.
    pressed_below_best_percent, every_cell_below_best_percent: how much less than "voltage" by the
    regression with which it errs least.
    """

    surface: str
    rows: int
    columns: int
    cells: str
    skins: int
    frames: int
    regression: str
    method: str
    group: str
    calibration_n: float
    pressed_n: float
    every_cell_n: float
    pressed_below_percent: float
    every_cell_below_percent: float
    pressed_below_best_percent: float
    every_cell_below_best_percent: float


def measure(
    comparisons: Sequence[Comparison], *, curved: bool, progress: Progress | None = None
) -> list[Row]:
    """All comparisons on a flat skin, or on one bent after its calibration.

    `progress(done, steps)` is called after each method on each skin.
    """
    total = sum(len(c.cells) * c.plan.seeds * len(c.methods) for c in comparisons)
    steps = Steps(total, progress)
    rows: list[Row] = []
    with threadpool_limits(limits=1):
        for comparison in comparisons:
            for cells in comparison.cells:
                by_skin: dict[tuple[str, str], list[Float]] = {}
                frames = 0
                for seed in range(comparison.plan.seeds):
                    trial = surface_trial(
                        comparison.rows,
                        comparison.columns,
                        seed,
                        comparison.plan,
                        CELLS[cells],
                        curved=curved,
                    )
                    frames = len(trial.time_s)
                    for method in comparison.methods:
                        rise = rises(method, trial)
                        for regression in REGRESSIONS:
                            of_method = by_skin.setdefault((regression, method), [])
                            force_n = learn(trial, rise, regression)(rise)
                            of_method.append(errors(trial, force_n))
                        steps.done()
                means = {key: np.mean(skins, axis=0) for key, skins in by_skin.items()}
                rows += _rows("curved" if curved else "flat", comparison, cells, frames, means)
    return rows


def rises(method: str, trial: ForceTrial) -> Float:
    """What a method shows above rest in every frame, (F, R, C) [S]; [1] for "voltage"."""
    if method == TRUTH:
        return trial.rise_siemens
    if method == VOLTAGE:
        return voltage_level(trial.ratio) - voltage_level(trial.rest_ratio)
    knowledge, ratio = knowledge_of(trial.rest_ratio), trial.ratio
    if method in (UNTOLD, FAR):
        knowledge = replace(knowledge, nominal_wire_ohm=WireOhm(lead=0.0))
    if method == FAR:
        names, ratio = MODES["far"], trial.far_ratio
        knowledge = replace(knowledge, rest_ratio=trial.far_rest_ratio, reading_names=names)
    estimator = make_estimator("joint" if method in (UNTOLD, FAR) else method, knowledge)
    assert knowledge.rest_ratio is not None
    rest = estimator.estimate(knowledge.rest_ratio).cell_siemens
    return np.array([estimator.estimate(frame).cell_siemens - rest for frame in ratio])


def learn(trial: ForceTrial, rise: Float, regression: str) -> Callable[[Float], Float]:
    """The curves of all cells from the calibration's frames: from rises (F, R, C) to forces [N]."""
    frames = np.flatnonzero(trial.group < 0)
    rows, columns = rise.shape[1:]
    cell = trial.cell[frames]
    x = rise.reshape(len(rise), -1)[frames, cell]
    force_n = trial.force_n.reshape(len(rise), -1)[frames, cell]
    if regression == SQUARES:
        # In units of each cell's largest rise: a siemens to the power of 50 is no number.
        unit = np.array([x[cell == k].max() for k in range(rows * columns)])
        curves = [
            fit_power(x[cell == k] / unit[k], force_n[cell == k], exponents=_EXPONENTS)
            for k in range(rows * columns)
        ]
        if None not in curves:
            of_cell = np.array([(c.slope, c.exponent) for c in curves if c]).T
            slope, exponent = of_cell.reshape(2, rows, columns)
            return lambda seen: slope * np.maximum(seen / unit.reshape(slope.shape), 0) ** exponent
        regression = LINE
    if regression == LINE:
        lines = [np.polyfit(x[cell == k], force_n[cell == k], 1) for k in range(rows * columns)]
        slope, intercept = np.array(lines).T.reshape(2, rows, columns)
        return lambda seen: slope * seen + intercept
    learned = ForceRegression().fit(
        cell, x, force_n, shape=(rows, columns), press=trial.press[frames]
    )
    nothing = np.zeros((rows, columns))
    return lambda seen: np.array([learned.model_.predict(frame, nothing)[0] for frame in seen])


def errors(trial: ForceTrial, force_n: Float) -> Float:
    """Errors (groups, 3) [N]: `Row`'s calibration_n, pressed_n, every_cell_n.

    force_n: what a method makes of the frames, (F, R, C).
    """
    shape = force_n.shape[1:]
    off_n = (force_n - trial.force_n).reshape(len(force_n), -1)
    of_robot_n = off_n[np.arange(len(force_n)), trial.cell]
    single = trial.group < 0
    names = groups_of(*shape)
    own = len(names) == len(off_n.T)
    return np.array(
        [
            [
                _rms(of_robot_n[single & (trial.cell == group) if own else single]),
                _rms(of_robot_n[trial.group == group]),
                _rms(off_n[trial.group == group]),
            ]
            for group in range(len(names))
        ]
    )


def _rms(off_n: Float) -> float:
    return float(np.sqrt(np.mean(off_n**2)))


def _rows(
    surface: str,
    comparison: Comparison,
    cells: str,
    frames: int,
    means: dict[tuple[str, str], Float],
) -> list[Row]:
    rows = []
    shape = (comparison.rows, comparison.columns)
    with_mean = {
        key: np.vstack([by_group, by_group.mean(axis=0)]) for key, by_group in means.items()
    }
    best = np.min([with_mean[regression, VOLTAGE] for regression in REGRESSIONS], axis=0)
    for (regression, method), values in with_mean.items():
        below = 100 * (1 - values / with_mean[regression, VOLTAGE])
        below_best = 100 * (1 - values / best)
        for place, group in enumerate([*groups_of(*shape), EVERY_GROUP]):
            rows.append(
                Row(
                    surface,
                    *shape,
                    cells,
                    comparison.plan.seeds,
                    frames,
                    regression,
                    method,
                    group,
                    *(round(float(value), 4) for value in values[place]),
                    *(round(float(value), 1) for value in below[place, 1:]),
                    *(round(float(value), 1) for value in below_best[place, 1:]),
                )
            )
    return rows


# --------------------------------------------------------------------------------------- answers


def surface_tables(rows: Sequence[Row]) -> list[Table]:
    """RMSE in newton by method: in the calibration, and in the test by group.

    "below": less than `voltage` by the same regression; "best": than `voltage` by whichever
    regression suits it best.
    """
    by_place: dict[tuple[int, int, int, str], list[Row]] = defaultdict(list)
    for row in rows:
        by_place[row.rows, row.columns, row.frames, row.regression].append(row)
    tables = []
    for (count, columns, frames, regression), of_table in by_place.items():
        first = of_table[0]
        groups = list(dict.fromkeys(row.group for row in of_table))
        skin = f"{first.surface} {count}x{columns}, {regression}, simulated"
        title = f"{skin}: RMSE [N], {first.skins} skins, {frames} frames each"
        numbers = ("calibr.", *groups, "below", "best", "every cell", "below", "best")
        table = text_table(("cells", "method"), numbers, title=title, title_justify="left")
        before = ""
        for cells, method in dict.fromkeys((row.cells, row.method) for row in of_table):
            by_group = {
                row.group: row for row in of_table if (row.cells, row.method) == (cells, method)
            }
            mean = by_group[EVERY_GROUP]
            table.add_row(
                cells if cells != before else "",
                method,
                f"{mean.calibration_n:.2f}",
                *(f"{by_group[group].pressed_n:.2f}" for group in groups),
                f"{mean.pressed_below_percent:.0f} %",
                f"{mean.pressed_below_best_percent:.0f} %",
                f"{mean.every_cell_n:.2f}",
                f"{mean.every_cell_below_percent:.0f} %",
                f"{mean.every_cell_below_best_percent:.0f} %",
            )
            before = cells
        if (count, columns) == (2, 2):
            _add_published(table, first.surface)
        tables.append(table)
    return tables


def _add_published(table: Table, surface: str) -> None:
    printed = FORCE_RMSE_N[surface]
    naive_n = np.mean(printed["naive", "estimation"])
    for method in ("naive", "solved"):
        by_cell = printed[method, "estimation"]
        below = 100 * (1 - np.mean(by_cell) / naive_n)
        table.add_row(
            "paper" if method == "naive" else "",
            method,
            f"{np.mean(printed[method, 'calibration']):.2f}",
            *(f"{error_n:.2f}" for error_n in (*by_cell, np.mean(by_cell))),
            f"{below:.0f} %",
        )
