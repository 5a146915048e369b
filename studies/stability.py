# SPDX-License-Identifier: Apache-2.0
"""What each method does where methods fail: is it right, does it say that it is not, or neither?

Simulation, all of it. Every frame of every condition (`conditions`) gets one of three verdicts, see
`judge.verdict`. Methods get the same 8x8 skins; those of the paper, which take a second a frame
where they fail, fewer and smaller ones. A skin follows from its condition and number alone: the
results do not depend on how many processes there are.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from threadpoolctl import threadpool_limits

from ohmskin.estimate.base import Estimate
from ohmskin.estimate.methods import METHODS, make_estimator
from studies.conditions import SWEEPS, Case, Shape, Sweep
from studies.drawing import (
    INK,
    method_style,
    new_figure,
    png_of,
    prepare,
    write_notes,
    write_plain_numbers,
)
from studies.judge import Verdict, verdict
from studies.rows import Progress, as_csv, field_names, in_processes
from studies.trials import PAPER_METHODS
from studies.unmodelled import UNMODELLED

ALL_SWEEPS: Final = SWEEPS | UNMODELLED


@dataclass(frozen=True)
class Row:
    """Frames of one method under one condition, by verdict.

    sweep, x: the condition, see `conditions.Sweep`.
    frames: how many there were: the sum of the next three.
    right, flagged, wrong_unflagged: how many got this `Verdict`.
    raised: how many of the flagged ones made the method raise an exception instead of answering.
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
        counts = field_names(Row)[3:]
        sums = {name: getattr(self, name) + getattr(other, name) for name in counts}
        return replace(self, **sums)

    def counting(self, said: Verdict, raised: bool) -> Row:
        """One frame more."""
        count = {"frames": self.frames + 1, str(said): getattr(self, str(said)) + 1}
        return replace(self, **count, raised=self.raised + raised)


# ------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Plan:
    """How much is measured; the paper's two methods have numbers of their own.

    skins, paper_skins: of each condition.
    frames, paper_frames: of each skin.
    shape, paper_shape: of the skins.
    """

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


def tasks_of(plan: Plan, methods: Collection[str] = METHODS) -> list[Task]:
    """All tasks, the longest first: else the last process would work alone."""
    conditions = [(sweep, x) for sweep in ALL_SWEEPS.values() for x in sweep.values]
    # Each of the paper's two is a task of its own, too, because a frame takes it seconds.
    longest = [
        Task(sweep.name, x, (method,), plan.paper_shape, skin, plan.paper_frames)
        for sweep, x in conditions
        for method in methods
        if method in PAPER_METHODS and method in sweep.methods
        for skin in range(plan.paper_skins)
    ]
    return longest + [
        Task(sweep.name, x, others, plan.shape, skin, plan.frames)
        for sweep, x in conditions
        if (others := tuple(m for m in methods if m in sweep.methods and m not in PAPER_METHODS))
        for skin in range(plan.skins)
    ]


def verdicts_of(task: Task) -> list[Row]:
    """The verdicts of one task, a row a method, computed in one thread."""
    with threadpool_limits(limits=1):
        condition = zlib.crc32(f"{task.sweep} {task.x}".encode())
        random = np.random.default_rng([condition, task.skin])
        case = ALL_SWEEPS[task.sweep].build(task.x, task.shape, task.frames, random)
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
        estimate: Estimate | None = None
        # An exception of whatever kind misleads nobody, but it is counted.
        with suppress(Exception):
            estimate = estimator.estimate(frame.ratio)
        if frame.cell_siemens is not None:
            said = verdict(estimate, frame.cell_siemens)
            row = row.counting(said, raised=estimate is None)
    return row


def measure(
    tasks: Sequence[Task], *, jobs: int | None = None, progress: Progress | None = None
) -> list[Row]:
    """Do all tasks: a row a condition and method, in the order of `ALL_SWEEPS` and `METHODS`.

    jobs: processes, as `in_processes` takes them. progress: called after each task.
    """
    by_place: dict[tuple[str, float | str, str], Row] = {}
    for rows in in_processes(verdicts_of, tasks, jobs, progress):
        for row in rows:
            place = (row.sweep, row.x, row.method)
            by_place[place] = by_place[place].plus(row) if place in by_place else row
    conditions = [(sweep.name, x) for sweep in ALL_SWEEPS.values() for x in sweep.values]
    order = [(*condition, method) for condition in conditions for method in METHODS]
    return [by_place[place] for place in order if place in by_place]


# --------------------------------------------------------------------------------------- answers


def csv_text(rows: Iterable[Row]) -> str:
    """sweep, x, method, and how many frames there were, by verdict."""
    return as_csv(field_names(Row)[:-1], (astuple(row)[:-1] for row in rows))


def totals(rows: Iterable[Row]) -> dict[str, Row]:
    """All frames of each method under the conditions that its equations have."""
    by_method: dict[str, Row] = {}
    for row in rows:
        if row.sweep in SWEEPS:
            by_method[row.method] = by_method.get(row.method, Row("", "", row.method)).plus(row)
    return by_method


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


# -------------------------------------------------------------------------------------- picture

# More frames than this that are wrong and not flagged are red. Chosen: one frame in a hundred.
BAR_PERCENT: Final = 1.0
_RED: Final = "#b3001b"
_RED_TINT: Final = "#fdeae8"
_GROUP_WIDTH: Final = 0.8  # share of the distance between two labels that bars take
_FEW_FRAMES: Final = 10  # with fewer frames of a condition, the line is dotted
# A logarithmic axis whose ends differ by less than this factor has ticks at its conditions, because
# powers of ten would be too few.
_DECADES: Final = 100.0
_NOTES: Final = (
    "Right: converged, and every cell of the frame within 5 % of the truth, or 0.5 µS. "
    "Wrong and not flagged: converged, and a cell is neither that close nor within 4 of its stated "
    "standard deviations; a method that states none has no excuse. "
    "The rest is flagged: not converged, or uncertain by the method's own word. "
    "Dotted: fewer than 10 frames a condition, of smaller skins.",
    "Simulation. Readings of 10 bits, as are those at rest. What a panel does not vary: wire "
    "segments of 100 and 200 Ω, told; to 10 of 64 cells touched, with 1 to 100 kΩ, anew in each "
    "frame; each frame started from the one before. Truth is the cell's, whatever the fault. "
    "The lowest line of panels is what no equation has, or what nobody has told; it does not count "
    "in the totals. Leads are told nowhere there; far ends are read without wires told.",
)


def picture(rows: Sequence[Row]) -> bytes:
    """The rows of `stability.measure`, which are of all conditions, as a PNG."""
    figure = new_figure(17.0, 18.0)
    # Labels need more room than numbers: to the right, and below.
    lines = figure.add_gridspec(3, 1, height_ratios=(5.0, 5.6, 5.6))
    sweeps_of = [
        [sweep for sweep in SWEEPS.values() if not sweep.labelled],
        [sweep for sweep in SWEEPS.values() if sweep.labelled],
        list(UNMODELLED.values()),
    ]
    for line, sweeps in enumerate(sweeps_of):
        all_labelled = all(sweep.labelled for sweep in sweeps)
        widths = [len(sweep.values) if all_labelled else 1 for sweep in sweeps]
        places = lines[line].subgridspec(2, len(sweeps), width_ratios=widths, height_ratios=(3, 2))
        for column, sweep in enumerate(sweeps):
            upper = figure.add_subplot(places[0, column])
            lower = figure.add_subplot(places[1, column], sharex=upper)
            _prepare(upper, lower, sweep, leftmost=column == 0)
            _draw(upper, lower, sweep, rows)
    _explain(figure, rows)
    return png_of(figure)


def _draw(upper: Axes, lower: Axes, sweep: Sweep, rows: Sequence[Row]) -> None:
    """Lines over numbers, and bars over labels."""
    methods = [method for method in totals(rows) if method in sweep.methods]
    width = _GROUP_WIDTH / len(methods)
    for number, method in enumerate(methods):
        shown = [row for row in rows if (row.sweep, row.method) == (sweep.name, method)]
        style = method_style(method)
        for axes, said in ((upper, Verdict.RIGHT), (lower, Verdict.WRONG_UNFLAGGED)):
            percent = [100 * getattr(row, str(said)) / row.frames for row in shown]
            if sweep.labelled:
                shift = (number + 0.5) * width - _GROUP_WIDTH / 2
                at = shift + np.arange(len(percent))
                axes.bar(at, percent, width, color=style["color"], zorder=3)
            else:
                few = max(row.frames for row in shown) < _FEW_FRAMES
                style |= {"linestyle": ":" if few else "-", "linewidth": 1.8, "markersize": 5.5}
                at = np.array(sweep.values, dtype=float)
                axes.plot(at, percent, clip_on=False, zorder=3 + number / 10, **style)


def _prepare(upper: Axes, lower: Axes, sweep: Sweep, leftmost: bool) -> None:
    upper.set_title(sweep.title, fontsize=13, fontweight="bold", color=INK, pad=9)
    upper.set_ylim(0, 100)
    # Linear to the bar, logarithmic from there on: both 0.2 % and 60 % can be read.
    lower.set_yscale("symlog", linthresh=BAR_PERCENT, linscale=0.5)
    lower.set_ylim(0, 100)
    lower.set_yticks([0, BAR_PERCENT, 10, 100])
    lower.set_yticks([], minor=True)
    write_plain_numbers(lower.yaxis)
    lower.set_facecolor(_RED_TINT)
    lower.axhspan(0, BAR_PERCENT, color="white", zorder=0.6, linewidth=0)
    lower.axhline(BAR_PERCENT, color=_RED, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3.9)
    for axes, grey in ((upper, "#e4e4e4"), (lower, "#f0cfcb")):
        prepare(axes, colour=grey, axis="y")
        axes.tick_params(labelleft=leftmost)
    upper.tick_params(labelbottom=False)
    if leftmost:
        upper.set_ylabel("right [% of frames]", color=INK)
        lower.set_ylabel("wrong and\nnot flagged [%]", color=_RED)
    if sweep.labelled:
        _prepare_labels(upper, lower, sweep)
        return
    lower.set_xlabel(sweep.axis, color=INK)
    values = [float(x) for x in sweep.values]
    if sweep.logarithmic:
        upper.set_xscale("log")
        if max(values) / min(values) < _DECADES:
            lower.set_xticks(values[::2])
            lower.set_xticks([], minor=True)
    write_plain_numbers(lower.xaxis)
    upper.set_xlim(min(values), max(values))


def _prepare_labels(upper: Axes, lower: Axes, sweep: Sweep) -> None:
    places = range(len(sweep.values))
    upper.set_xlim(-0.5, len(places) - 0.5)
    lower.set_xticks(places, [str(x) for x in sweep.values], rotation=32, ha="right")
    for label in lower.get_xticklabels():
        label.set_rotation_mode("anchor")
    for axes in (upper, lower):
        axes.tick_params(axis="x", length=0)
        for place in places[1:]:
            axes.axvline(place - 0.5, color="#d5d5d5", linewidth=0.7, zorder=0.7)


def _explain(figure: Figure, rows: Sequence[Row]) -> None:
    """Title, and legend with totals, above all panels; notes below them."""
    handles = []
    for method, row in totals(rows).items():
        share = f"{100 * row.wrong_unflagged / row.frames:.2g} % of {row.frames} frames"
        label = f"{method}: wrong, not flagged\nin {share}"
        handles.append(Line2D([], [], label=label, **method_style(method)))
    figure.legend(
        handles=handles,
        title="Where methods fail, and whether they say so",
        title_fontsize=17,
        loc="outside upper center",
        ncols=len(handles),
        frameon=False,
        fontsize=11,
    )
    write_notes(figure, _NOTES, 200)
