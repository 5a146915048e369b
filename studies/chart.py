# SPDX-License-Identifier: Apache-2.0
"""Speed against accuracy of all methods, beside what one frame can tell and what the paper printed.

Simulation, all of it. Every method gets the same frames of the same random skins (`trials`), in
order, each started from the one before; the first few of each skin are not counted. The paper's two
sweeps are added, each frame from a cold start. With one thread, whatever the libraries would take.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.estimate.methods import METHODS
from ohmskin.record.readings import estimate_file
from studies import published
from studies.information import pressed_limits
from studies.judge import Judged, judge_trial, pooled
from studies.rows import Progress, Steps, as_csv, field_names
from studies.trials import PAPER_METHODS, Trial, random_trial, reference_trial, trial_of

# The paper's methods read skins of so many cells at most: a frame of 9 takes them 0.1 s, one of 16
# up to 16 s, one of 64 a minute.
PAPER_CELLS: Final = 9
TAIL: Final = 0.9  # the quantile beside each median. Chosen: the worst frame of ten.
RANDOM: Final = "random"
FAR: Final = "random, far ends"  # both ends of all lines are sensed: another board
FAR_METHODS: Final = ("joint", "touch")
BOARD: Final = "board"  # the paper's own skin
MEASURED: Final = "measured"
PAPER: Final = "Su2024"
# |z| of a normal z, in equal steps of probability.
_NORMAL: Final[Float] = np.abs([NormalDist().inv_cdf((k + 0.5) / 400) for k in range(400)])


@dataclass(frozen=True)
class Size:
    """A skin, and the most touches in a frame of it."""

    rows: int
    columns: int
    touches: int


@dataclass(frozen=True)
class Plan:
    """What is measured.

    skins: of each size.
    frames: of each skin, those of the warm-up among them.
    warm_up: how many frames of each skin are not counted.
    repeats: of each frame of the paper's sweeps; one more is not counted.
    sizes: of the random skins.
    bits: of the readings; None: exact.
    methods: all that are measured.
    """

    skins: int
    frames: int
    warm_up: int = 3
    repeats: int = 5
    sizes: tuple[Size, ...] = (
        *(Size(2, 2, 2), Size(3, 3, 4), Size(4, 4, 5)),
        *(Size(8, 8, 8), Size(16, 16, 8)),
    )
    bits: tuple[int | None, ...] = (None, 10)
    methods: tuple[str, ...] = field(default_factory=lambda: tuple(METHODS))

    def methods_for(self, size: Size) -> list[str]:
        """Those that answer in reasonable time."""
        return [
            method
            for method in self.methods
            if size.rows * size.columns <= PAPER_CELLS or method not in PAPER_METHODS
        ]

    @property
    def far_methods(self) -> list[str]:
        """Those that take readings at far ends."""
        return [method for method in FAR_METHODS if method in self.methods]


FULL: Final = Plan(skins=8, frames=33)
QUICK: Final = Plan(skins=2, frames=11, repeats=2)


@dataclass(frozen=True)
class Row:
    """One method on one kind of frames; a line of the CSV. None: there is no such number.

    scene: what is read: "random"; "random, far ends", the same frames on a board that senses both
    ends of all lines and is told no wires, which is on no front; the paper's "cell_sweep" or
    "wire_sweep"; or "board", the paper's own skin.
    source: "measured", or "Su2024" for what the paper printed.
    rows, columns, bits, method: the skin, its readings, and what reads them.
    frames, pressed_cells: how many there were.
    ms, ms_p90: time of a frame, median and 90th percentile.
    error_percent, error_p90_percent: of the conductance of pressed cells, over the true one.
    rmse_megohm, rmse_p90_megohm: over all cells of a frame, median and 90th percentile of frames.
    converged_share: of the frames.
    on_front: whether no other method of this scene, size and resolution is as fast and as accurate
    (by error_percent; in the sweeps by rmse_megohm).
    limit_std_percent: the posterior's relative deviation at the truth (`information`), median over
    the pressed cells.
    limit_percent: the median error that goes with these deviations, were it normal (about 0.67 of
    that).
    limit_told_percent: the same where the mean wire of each layer and the cells at rest are known
    exactly.
    """

    scene: str
    source: str
    rows: int
    columns: int
    bits: int | None
    method: str
    frames: int | None = None
    pressed_cells: int | None = None
    ms: float | None = None
    ms_p90: float | None = None
    error_percent: float | None = None
    error_p90_percent: float | None = None
    rmse_megohm: float | None = None
    rmse_p90_megohm: float | None = None
    converged_share: float | None = None
    on_front: bool = False
    limit_std_percent: float | None = None
    limit_percent: float | None = None
    limit_told_percent: float | None = None

    @property
    def place(self) -> tuple[str, int, int, int | None]:
        """What rows must share to be compared."""
        return self.scene, self.rows, self.columns, self.bits

    @property
    def judged_by(self) -> float | None:
        """The error by which the front is found."""
        return self.error_percent if self.scene in (RANDOM, FAR) else self.rmse_megohm


# ------------------------------------------------------------------------------------ measuring


def measure(plan: Plan, progress: Progress | None = None) -> list[Row]:
    """Run every method of the plan. `progress` is called after each method on each skin.

    Rows are in the order of the plan's sizes, bits and methods, then the paper's sweeps.
    """
    steps = Steps(_steps(plan), progress)
    with threadpool_limits(limits=1):
        rows: list[Row] = []
        for size in plan.sizes:
            trials = [
                random_trial(size.rows, size.columns, size.touches, plan.frames, seed)
                for seed in range(plan.skins)
            ]
            for bits in plan.bits:
                rows += _random_rows(size, bits, trials, plan, steps)
        for name in published.RMSE_MEGOHM:
            rows += _sweep_rows(name, plan, steps)
    return [*_with_front(rows), *_published_rows()]


def _steps(plan: Plan) -> int:
    random = sum(len(plan.methods_for(size)) + len(plan.far_methods) for size in plan.sizes)
    conditions = sum(map(len, published.CONDITIONS_MEGOHM.values()))
    return random * len(plan.bits) * plan.skins + len(plan.methods) * conditions


def _row(parts: Iterable[Judged], **what: Any) -> Row:
    """The row of a method that has read these skins."""
    judged = pooled(parts)
    ms, ms_p90 = _middle_and_tail(1e3 * judged.seconds)
    error, error_p90 = _middle_and_tail(1e2 * judged.relative)
    rmse, rmse_p90 = _middle_and_tail(judged.rmse_megohm)
    return Row(
        source=MEASURED,
        frames=judged.seconds.size,
        pressed_cells=judged.relative.size,
        ms=ms,
        ms_p90=ms_p90,
        error_percent=error,
        error_p90_percent=error_p90,
        rmse_megohm=rmse,
        rmse_p90_megohm=rmse_p90,
        converged_share=float(np.mean(judged.converged)),
        **what,
    )


def _middle_and_tail(values: Float) -> tuple[float, float] | tuple[None, None]:
    if not values.size:
        return None, None
    return float(np.median(values)), float(np.quantile(values, TAIL))


def _random_rows(
    size: Size, bits: int | None, trials: Sequence[Trial], plan: Plan, steps: Steps
) -> list[Row]:
    judged: dict[tuple[str, str], list[Judged]] = defaultdict(list)
    counted = slice(plan.warm_up, None)
    # Method by method within a skin, so that a slow minute of the machine hits all alike.
    for trial in trials:
        near, far = trial.rounded(bits), trial.rounded(bits, mode="far", wires_told=False)
        of_near = [(RANDOM, near, method) for method in plan.methods_for(size)]
        for scene, readings, method in of_near + [(FAR, far, name) for name in plan.far_methods]:
            answers = estimate_file(readings, method)
            judged[scene, method].append(judge_trial(answers, trial, counted))
            steps.done()
    limits = _limits(trials, bits, plan.warm_up)
    place: dict[str, Any] = {"rows": size.rows, "columns": size.columns, "bits": bits}
    return [
        _row(parts, scene=scene, method=method, **place, **(limits if scene == RANDOM else {}))
        for (scene, method), parts in judged.items()
    ]


def _limits(trials: Sequence[Trial], bits: int | None, skip: int) -> dict[str, float]:
    """The columns `limit_...` of a row: what a perfect estimator of one frame could do."""
    late = slice(skip, None)
    untold, told = (
        [
            1e2 * pressed_limits(trial, late, bits=bits, rest_std=known, layer_std=known)
            for trial in trials
        ]
        for known in (None, 0.0)
    )
    stds, stds_told = np.concatenate(untold), np.concatenate(told)
    if not stds.size:
        return {}
    return {
        "limit_std_percent": float(np.median(stds)),
        "limit_percent": median_error(stds),
        "limit_told_percent": median_error(stds_told),
    }


def median_error(stds: Float) -> float:
    """Median of |e|, with e from normal distributions of these deviations in equal parts."""
    return float(np.median(np.outer(stds, _NORMAL)))


def _sweep_rows(name: str, plan: Plan, steps: Steps) -> list[Row]:
    """The paper's simulation with exact readings; rest readings and true wires are told."""
    by_method: dict[str, list[Judged]] = defaultdict(list)
    drawn = reference_trial(f"{name}_3x3")
    for pressed in drawn.frames:
        rest = replace(pressed, cell_siemens=drawn.rest.cell_siemens)
        wire_ohm = (float(rest.top_wire_ohm[0, 0]), float(rest.bottom_wire_ohm[0, 0]))
        trial = trial_of(rest, [pressed] * (plan.repeats + 1), wire_ohm)
        for method in plan.methods:
            answers = estimate_file(trial.readings, method, cold=True)
            by_method[method].append(judge_trial(answers, trial, slice(1, None)))
            steps.done()
    return [
        _row(parts, scene=name, rows=3, columns=3, bits=None, method=method)
        for method, parts in by_method.items()
    ]


def _published_rows() -> list[Row]:
    rows = [
        Row(BOARD, PAPER, 2, 2, 10, method, ms=milliseconds)
        for method, milliseconds in published.TIME_2X2_MS.items()
    ]
    for name, by_method in published.RMSE_MEGOHM.items():
        for method, rmse_megohm in by_method.items():
            middle, tail = _middle_and_tail(np.array(rmse_megohm))
            row = Row(name, PAPER, 3, 3, None, method, frames=len(rmse_megohm))
            rows.append(replace(row, rmse_megohm=middle, rmse_p90_megohm=tail))
    return rows


# ------------------------------------------------------------------------------------ the front


def pareto_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Whether each point is on the front: no other is as small in both numbers, smaller in one.

    Equal points are on it together. A point with a NaN is not on it, and keeps none off.
    """
    return [
        not np.isnan([x, y]).any()
        and not any(u <= x and v <= y and (u < x or v < y) for u, v in points)
        for x, y in points
    ]


def _with_front(rows: Sequence[Row]) -> list[Row]:
    by_place: dict[object, list[Row]] = defaultdict(list)
    for row in rows:
        by_place[row.place].append(row)
    return [
        replace(row, on_front=on_front and row.scene != FAR)
        for rivals in by_place.values()
        for row, on_front in zip(
            rivals,
            pareto_front([(or_nan(rival.ms), or_nan(rival.judged_by)) for rival in rivals]),
            strict=True,
        )
    ]


def or_nan(value: float | None) -> float:
    """The number, or NaN where there is none."""
    return np.nan if value is None else value


def csv_text(rows: Iterable[Row]) -> str:
    """The rows as CSV, columns named after the fields of `Row`; bits may be "exact"."""
    lines = ({**vars(row), "bits": row.bits or "exact"} for row in rows)
    return as_csv(field_names(Row), (line.values() for line in lines))
