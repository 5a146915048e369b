# SPDX-License-Identifier: Apache-2.0
"""What each number in `joint` and `touch` earns: each is halved, doubled and put off, in turn.

A constant is a public number that one of `MODULES` annotates as Final.
Every variant reads the same frames (`ablate_scenes`) as the estimators as they are. Every figure is
an error or a share of bad answers, so a ratio above 1 is a loss:

============ ====================================================================================
figure       meaning
============ ====================================================================================
error_median relative error of pressed cells, median; pressed: 1.5 times the conductance at rest
error_p90    the same, 90th percentile
sum_p90      |sum of a frame's rise over the true sum - 1|, 90th percentile
outside      share of all cells further from the truth than 4 stated deviations
alarm        share of frames that are not converged
wrong        share of frames that are wrong and not flagged, see `judge.verdict`
not_right    share of frames that are not right, likewise
stated       relative deviation that is stated of pressed cells, median: for information
ms           time a frame, median [ms]: for information
============ ====================================================================================

A frame at which a variant raises counts as one that is called untouched, for sure and not
converged. A ratio is significant if it is more than 3 % from 1, and the middle 95 % of 1000 paired
resamples of skins exclude 1. A file has one skin: there, ten pieces stand for skins. Of so
many figures some are significant by chance, most of all where skins are few (three of 32x32): what
a single figure says is to be tried again, on more skins.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from functools import lru_cache
from inspect import get_annotations
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.estimate import (
    cells_at_rest,
    full_fit,
    joint,
    prior,
    sparse_fit,
    staying_faults,
    wire_belief,
)
from studies.ablate_scenes import SCENES, Plan, Sample, observe
from studies.conditions import Case
from studies.rows import Progress, as_csv, field_names, in_processes

MODULES: Final = (
    *(prior, full_fit, sparse_fit, joint),
    *(cells_at_rest, wire_belief, staying_faults),
)
# What makes a constant do nothing, or, of a deviation, what is all but certain: 0 would divide.
OFF: Final[dict[str, float]] = {
    "prior.UNTOUCHED_STD": 10.0,
    "prior.REST_STD": 0.0,
    "prior.HIGHEST_TOUCH_SIEMENS": 1.0,
    "prior.TOUCHED_STDS": np.inf,
    "prior.UNLIMITED_STD": 0.0,
    "prior.HIDDEN_LOG": np.inf,
    "prior.UNKNOWN_LAYER_STD": 1e-3,
    "prior.LAYER_STD": 1e-3,
    "prior.SEGMENT_STD": 1e-3,
    "prior.CLEAR_LOG": np.inf,
    "prior.STEADY_FADE": 0.0,
    "prior.CHANGED_ODDS": 1e-9,
    "prior.WARY_ODDS": 1e-9,
    "prior.REACH_STDS": 1e-3,
    "prior.LEFT_OUT_STDS": 1e-3,
    "prior.CROWDED_SHARE": np.inf,
    "prior.SOFT_CORRELATION": 1.0,
    "sparse_fit.MAX_TOUCHES_PER_LINE": np.inf,
    "sparse_fit.DEMAND_STDS": 0.0,
    "sparse_fit.RIVAL_SHARE": 0.0,
    "prior.MAX_STEP_LOG": 1e9,
    "sparse_fit.HEAVY_SHARE": 0.0,
    "prior.MAX_CHI2": np.inf,
    "joint.LOSS_STDS": 0.0,
    "joint.PALM_TIMES": np.inf,
}
# What is kept of each frame, and the quantile that a figure takes of it; None: the mean.
FIGURES: Final[dict[str, tuple[str, float | None]]] = {
    "error_median": ("error", 0.5),
    "error_p90": ("error", 0.9),
    "sum_p90": ("sum", 0.9),
    **{name: (name, None) for name in ("outside", "alarm", "wrong", "not_right")},
    "stated": ("stated", 0.5),
    "ms": ("ms", 0.5),
}
INFORMATIVE: Final = ("stated", "ms")
# How often skins are drawn anew. Chosen: the ends of the middle 95 % are then those of 25 draws.
RESAMPLES: Final = 1000
# The least relative change of a figure that is called significant. Chosen: less is not worth a
# constant.
LEAST_CHANGE: Final = 0.03
# What is added to shares before they are compared. Chosen: one frame in a thousand is as good as
# none, and a ratio needs a number above 0.
LEAST_SHARE: Final = 1e-3

# ------------------------------------------------------------------------------------- constants


@dataclass(frozen=True)
class Constant:
    """A number of one of `MODULES`; module: the last part of its name."""

    module: str
    name: str
    value: float

    @property
    def label(self) -> str:
        """Module and name."""
        return f"{self.module}.{self.name}"

    @property
    def variants(self) -> dict[str, float]:
        """The values to try instead; of a whole number whole ones, 1 at least."""
        halved: float = self.value / 2
        if isinstance(self.value, int):
            halved = max(1, self.value // 2)
        off = {"off": OFF[self.label]} if self.label in OFF else {}
        return off | {"halved": halved, "doubled": 2 * self.value}


def constants() -> list[Constant]:
    """Those of `MODULES`, in the order of their lines."""
    return [
        Constant(module.__name__.rpartition(".")[2], name, value)
        for module in MODULES
        for name, annotation in get_annotations(module).items()
        if "Final" in str(annotation) and name.isupper() and not name.startswith("_")
        if isinstance(value := getattr(module, name), int | float)
    ]


@contextmanager
def changed(constant: Constant, value: float) -> Iterator[None]:
    """The constant has another value inside, in its module and in those that import it from there.

    A module that annotates the same name has a constant of its own.
    """
    home = sys.modules[f"{prior.__package__}.{constant.module}"]
    before = getattr(home, constant.name)
    places = [
        module
        for name, module in list(sys.modules.items())
        if name.startswith(f"{prior.__package__}.")
        if module is home
        or (
            vars(module).get(constant.name) is before
            and constant.name not in get_annotations(module)
        )
    ]
    try:
        for module in places:
            setattr(module, constant.name, value)
        yield
    finally:
        for module in places:
            setattr(module, constant.name, before)


# ------------------------------------------------------------------------------------- measuring


def resampled(values: Float, skins: NDArray[np.intp], quantile: float | None) -> Float:
    """A figure of all skins, then of `RESAMPLES` draws of as many skins, (1 + RESAMPLES,).

    values, skins: (n,), n > 0, of one kind. quantile: None for the mean. The draws depend on the
    number of skins alone. A draw without values has the least value there is.
    """
    count = int(skins.max()) + 1
    draws = np.random.default_rng(count).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    times = np.vstack([np.ones(count, dtype=int), draws])
    if quantile is None:
        total = times @ np.bincount(skins, values, count)
        return np.asarray(total / np.maximum(times @ np.bincount(skins, minlength=count), 1))
    order = values.argsort(kind="stable")
    reached = times[:, skins[order]].astype(np.int32).cumsum(axis=1)
    return np.asarray(values[order][(reached >= quantile * reached[:, -1:]).argmax(axis=1)])


@dataclass(frozen=True)
class Row:
    """One figure of one variant: a line of the CSV.

    constant, value: its label, and its value as it is.
    variant, tried: "off", "halved" or "doubled", and the value tried.
    scene, method: the frames, and what read them.
    figure: its name, as in the module's table.
    base, changed: the figure with the constant as it is, and with the variant.
    ratio: `changed` over `base`, both with `LEAST_SHARE` added if they are shares.
    low, high: the middle 95 % of the ratio over the resamples.
    significant: whether the ratio is.
    """

    constant: str
    value: float
    variant: str
    tried: float
    scene: str
    method: str
    figure: str
    base: float
    changed: float
    ratio: float
    low: float
    high: float
    significant: bool


@lru_cache(maxsize=2)
def _as_it_is(scene: str, method: str, plan: Plan) -> tuple[list[Case], dict[str, Float]]:
    """The frames of a scene, and the figures of a method."""
    cases = SCENES[scene].build(plan)
    return cases, _figures(observe(cases, method))


def _figures(sample: Sample) -> dict[str, Float]:
    return {
        figure: resampled(sample.values[kind], sample.skins[kind], quantile)
        for figure, (kind, quantile) in FIGURES.items()
        if sample.values.get(kind, np.zeros(0)).size
    }


# A scene, a method, a constant, and how many frames there are.
Task = tuple[str, str, Constant, Plan]


def compare(task: Task) -> list[Row]:
    """All figures of all variants of a constant, computed in one thread.

    Figures that do not change have no row. The time always changes.
    """
    scene, method, constant, plan = task
    rows = []
    with threadpool_limits(limits=1):
        cases, figures = _as_it_is(scene, method, plan)
        for variant, value in constant.variants.items():
            with changed(constant, value):
                sample = observe(cases, method)
            for figure, now in _figures(sample).items():
                base = figures[figure]
                if np.array_equal(now, base):
                    continue
                added = LEAST_SHARE if FIGURES[figure][1] is None else 0.0
                ratios = (now + added) / np.maximum(base + added, 1e-12)
                low, high = map(float, np.quantile(ratios[1:], (0.025, 0.975)))
                is_clear = not low <= 1 <= high and abs(ratios[0] - 1) > LEAST_CHANGE
                rows.append(
                    Row(
                        constant.label,
                        constant.value,
                        variant,
                        value,
                        scene,
                        method,
                        figure,
                        base=float(base[0]),
                        changed=float(now[0]),
                        ratio=float(ratios[0]),
                        low=low,
                        high=high,
                        significant=bool(is_clear) and figure not in INFORMATIVE,
                    )
                )
    return rows


def measure(
    tried: Sequence[Constant],
    plan: Plan,
    *,
    scenes: Iterable[str] = tuple(SCENES),
    jobs: int | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """Compare all these constants on all scenes: rows in the order of both.

    jobs: processes, as `in_processes` takes them. progress: called after each task. The figures,
    but for the time, depend neither on jobs nor on which constants are tried.
    """
    tasks: list[Task] = [
        (scene, method, constant, plan)
        for scene in scenes
        for method in SCENES[scene].methods
        for constant in tried
    ]
    rows = [row for part in in_processes(compare, tasks, jobs, progress) for row in part]
    labels, names = [constant.label for constant in tried], list(SCENES)
    # Stable: variants and figures stay in their order.
    return sorted(
        rows, key=lambda row: (labels.index(row.constant), names.index(row.scene), row.method)
    )


# --------------------------------------------------------------------------------------- answers


def csv_text(rows: Iterable[Row]) -> str:
    """A line for each row, numbers with five digits."""
    return as_csv(field_names(Row), map(astuple, rows), digits=5)


def _extremes(rows: Iterable[Row], constant: str, variant: str) -> str:
    """The worst significant loss and the best significant gain of a variant, as far as any."""
    clear = [row for row in rows if row.significant]
    mine = [row for row in clear if (row.constant, row.variant) == (constant, variant)]
    mine.sort(key=lambda row: row.ratio)
    losses, gains = [row for row in mine if row.ratio > 1], [row for row in mine if row.ratio < 1]
    words = [
        f"{100 * (row.ratio - 1):+.0f} % {row.figure} {row.scene} {row.method}"
        for row in losses[-1:] + gains[:1]
    ]
    return "\n".join(words) or "-"


def summary(rows: Sequence[Row], tried: Iterable[Constant]) -> Table:
    """A row a constant, and what each variant of it does most, for a terminal."""
    variants = ("off", "halved", "doubled")
    table = Table(box=None, title="worst loss, best gain: significant ones")
    for heading in ("constant", "value", *variants):
        table.add_column(heading)
    for constant in tried:
        words = [_extremes(rows, constant.label, variant) for variant in variants]
        table.add_row(constant.label, f"{constant.value:.4g}", *words)
    return table
