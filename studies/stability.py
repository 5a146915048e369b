# SPDX-License-Identifier: Apache-2.0
"""What each method does where methods fail: is it right, does it say that it is not, or neither?

Simulation, all of it. Every frame of every condition (`conditions`) gets one of three verdicts, see
`verdict`. Methods get the same 8x8 skins; those of the paper, which take a second a frame where
they fail, fewer and smaller ones. A skin follows from its condition and number alone: the results
do not depend on how many processes there are.
"""

from __future__ import annotations

import csv
import io
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, fields, replace
from enum import StrEnum
from typing import Final

import numpy as np
from joblib import Parallel, delayed
from rich.table import Table
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate, Estimator
from ohmskin.estimate.methods import METHODS, make_estimator
from studies.conditions import SWEEPS, Case, Shape
from studies.trials import PAPER_METHODS

# An error within either counts as none: a share of the truth, the least rise called a touch.
CLOSE_SHARE: Final = 0.05
CLOSE_SIEMENS: Final = 0.5e-6
STATED_STDS: Final = 4.0


class Verdict(StrEnum):
    """Of one frame; see `verdict`."""

    RIGHT = "right"
    FLAGGED = "flagged"
    WRONG_UNFLAGGED = "wrong_unflagged"


def verdict(
    cell_siemens: Float, cell_siemens_std: Float, converged: bool, true_siemens: Float
) -> Verdict:
    """Judge a frame's answer against the true cells, all (R, C) [S].

    A cell is off when |g - g_true| > max(5 % of g_true, 0.5e-6 S), or when g is NaN; it is stated
    when |g - g_true| <= 4 of its standard deviations (NaN counts as 0).

    - right: converged, and no cell is off.
    - wrong_unflagged: converged, and a cell is off and not stated. The reader is misled.
    - flagged: the rest. Not converged, or all that is off is stated.

    A fault excuses nothing: the truth is the cell's conductance, whether or not readings tell it.
    """
    if not converged:
        return Verdict.FLAGGED
    error = np.abs(cell_siemens - true_siemens)
    # Written so that NaN is off and not stated.
    off = ~(error <= np.maximum(CLOSE_SHARE * true_siemens, CLOSE_SIEMENS))
    stated = error <= STATED_STDS * np.where(np.isnan(cell_siemens_std), 0.0, cell_siemens_std)
    if not off.any():
        return Verdict.RIGHT
    return Verdict.WRONG_UNFLAGGED if (off & ~stated).any() else Verdict.FLAGGED


@dataclass(frozen=True)
class Row:
    """Frames of one method under one condition, by verdict: these add up to `frames`.

    raised: those of the flagged ones at which the method raised an exception instead of answering.
    """

    sweep: str
    x: float | str
    method: str
    frames: int = 0
    right: int = 0
    flagged: int = 0
    wrong_unflagged: int = 0
    raised: int = 0

    def plus(self, other: Row) -> Row:
        """Both rows' frames."""
        names = [field.name for field in fields(Row)[3:]]
        return replace(self, **{name: getattr(self, name) + getattr(other, name) for name in names})

    def counting(self, said: Verdict, raised: bool) -> Row:
        """One frame more."""
        count = {"frames": self.frames + 1, str(said): getattr(self, str(said)) + 1}
        return replace(self, **count, raised=self.raised + raised)


# ------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Plan:
    """How many skins a condition, frames a skin, of what shape; paper_...: for its two methods."""

    skins: int
    frames: int
    paper_skins: int
    paper_shape: Shape
    paper_frames: int = 1
    shape: Shape = (8, 8)


FULL: Final = Plan(skins=10, frames=20, paper_skins=2, paper_shape=(3, 3))
QUICK: Final = Plan(skins=2, frames=8, paper_skins=1, paper_shape=(2, 2))


@dataclass(frozen=True)
class Task:
    """Some methods on one skin under one condition: what a process does in one go."""

    sweep: str
    x: float | str
    methods: tuple[str, ...]
    shape: Shape
    skin: int
    frames: int


def tasks_of(plan: Plan, methods: Iterable[str] = METHODS) -> list[Task]:
    """All tasks, the longest first: else the last process would work alone."""
    papers: list[str] = []
    others: list[str] = []
    for method in methods:
        (papers if method in PAPER_METHODS else others).append(method)
    conditions = [(sweep.name, x) for sweep in SWEEPS.values() for x in sweep.values]
    # The paper's two apart, too: each takes seconds.
    longest = [
        Task(*condition, (method,), plan.paper_shape, skin, plan.paper_frames)
        for condition in conditions
        for method in papers
        for skin in range(plan.paper_skins)
    ]
    return longest + [
        Task(*condition, tuple(others), plan.shape, skin, plan.frames)
        for condition in conditions
        for skin in range(plan.skins if others else 0)
    ]


def judge(task: Task) -> list[Row]:
    """The verdicts of one task, a row a method, computed in one thread."""
    with threadpool_limits(limits=1):
        condition = zlib.crc32(f"{task.sweep} {task.x}".encode())
        random = np.random.default_rng([condition, task.skin])
        case = SWEEPS[task.sweep].build(task.x, task.shape, task.frames, random)
        return [_judge_method(task, method, case) for method in task.methods]


def _judge_method(task: Task, method: str, case: Case) -> Row:
    knowledge = case.knowledge
    if method in PAPER_METHODS:
        # It serves these methods for `touched` alone, and costs them a second.
        knowledge = replace(knowledge, rest_ratio=None)
    estimator = make_estimator(method, knowledge)
    row = Row(task.sweep, task.x, method)
    for frame in case.frames:
        if frame.afresh:
            estimator.reset()
        found = _answer(estimator, frame.ratio)
        if frame.cell_siemens is None:
            continue
        said = Verdict.FLAGGED
        if found is not None:
            said = verdict(
                found.cell_siemens, found.cell_siemens_std, found.converged, frame.cell_siemens
            )
        row = row.counting(said, raised=found is None)
    return row


def _answer(estimator: Estimator, ratio: Float) -> Estimate | None:
    try:
        return estimator.estimate(ratio)
    except Exception:
        # Of whatever kind: it misleads nobody, but has a count of its own.
        return None


def measure(
    tasks: Sequence[Task],
    *,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Do all tasks: a row a condition and method, in the order of `SWEEPS` and `METHODS`.

    jobs: processes, -1 for one a core; None for what a `joblib.parallel_backend` around this call
    says, which may be a cluster, else one. progress: called with the tasks done and all tasks.
    """
    found: dict[tuple[str, float | str, str], Row] = {}
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
    # Closed on whatever way out, so that no process goes on without a reader.
    with closing(parallel(delayed(judge)(task) for task in tasks)) as answers:
        for done, rows in enumerate(answers, start=1):
            for row in rows:
                key = (row.sweep, row.x, row.method)
                found[key] = found[key].plus(row) if key in found else row
            if progress is not None:
                progress(done, len(tasks))
    order = [(s.name, x, method) for s in SWEEPS.values() for x in s.values for method in METHODS]
    return [found[key] for key in order if key in found]


# --------------------------------------------------------------------------------------- answers


def csv_text(rows: Iterable[Row]) -> str:
    """sweep, x, method, and how many frames there were, by verdict."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Row)[:-1]])
    for row in rows:
        x = row.x if isinstance(row.x, str) else f"{row.x:.4g}"
        writer.writerow([row.sweep, x, *astuple(row)[2:-1]])
    return text.getvalue()


def totals(rows: Iterable[Row]) -> dict[str, Row]:
    """All frames of each method."""
    found: dict[str, Row] = {}
    for row in rows:
        found[row.method] = found.get(row.method, Row("", "", row.method)).plus(row)
    return found


def shares(rows: Iterable[Row]) -> dict[str, dict[str, float]]:
    """Of each method's frames, by verdict; they add up to 1."""
    return {
        method: {
            "frames": row.frames,
            **{f"{said}_share": round(getattr(row, said) / row.frames, 5) for said in Verdict},
            "raised": row.raised,
        }
        for method, row in totals(rows).items()
    }


def summary(rows: Sequence[Row]) -> Table:
    """Two of the three shares per sweep and method, for a terminal."""
    table = Table(box=None, title="right / wrong and not flagged [% of frames]")
    methods = list(totals(rows))
    for heading in ("sweep", *methods):
        table.add_column(heading, justify="left" if heading == "sweep" else "right")
    parts = {name: [row for row in rows if row.sweep == name] for name in SWEEPS}
    for name, part in {**parts, "all": rows}.items():
        by_method = totals(part)
        table.add_row(name, *(_percent(by_method[method]) for method in methods))
    return table


def _percent(row: Row) -> str:
    right, wrong = (100 * count / row.frames for count in (row.right, row.wrong_unflagged))
    return f"{right:.0f} / {wrong:.{0 if wrong >= 10 else 1}f}"
