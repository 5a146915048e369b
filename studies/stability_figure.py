# SPDX-License-Identifier: Apache-2.0
"""The picture of `stability`: of each sweep the share that is right, and that misleads below it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from ohmskin.estimate.methods import METHODS
from studies.chart_figure import INK, method_style, png_of, prepare, require_matplotlib
from studies.conditions import SWEEPS, Sweep
from studies.stability import Row, Verdict, totals

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BAR_PERCENT: Final = 1.0
_RED: Final = "#b3001b"
_RED_TINT: Final = "#fdeae8"
_GROUP_WIDTH: Final = 0.8  # of the distance between two labels
_FEW_FRAMES: Final = 10  # of a condition: the line is dotted
_DECADES: Final = 100.0  # a logarithmic axis over less than this has its ticks at conditions
_NOTES: Final = (
    "Right: converged, and every cell of the frame within 5 % of the truth, or 0.5 µS. "
    "Wrong and not flagged: converged, and a cell is neither that close nor within 4 of its stated "
    "standard deviations; a method that states none has no excuse. "
    "The rest is flagged: not converged, or uncertain by the method's own word. "
    "Dotted: fewer than 10 frames a condition, of smaller skins.",
    "Simulation. Readings of 10 bits, as are those at rest. What a panel does not vary: wire "
    "segments of 100 and 200 Ω, told; to 10 of 64 cells touched, with 1 to 100 kΩ, anew in each "
    "frame; each frame started from the one before. Truth is the cell's, whatever the fault.",
)


def picture(rows: Sequence[Row]) -> bytes:
    """The rows of `stability.measure` as a PNG.

    :raises OhmskinError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    measured = {row.sweep for row in rows}
    figure = Figure(figsize=(17.0, 12.6), layout="constrained")
    figure.suptitle("Where methods fail, and whether they say so", fontsize=17, color=INK)
    # Labels need more room than numbers: to the right, and below.
    lines = figure.add_gridspec(3, 1, height_ratios=(5.0, 5.6, 1.3))
    for line, labelled in enumerate((False, True)):
        sweeps = [s for s in SWEEPS.values() if s.name in measured and s.labelled == labelled]
        if not sweeps:
            continue
        widths = [len(sweep.values) if labelled else 1 for sweep in sweeps]
        places = lines[line].subgridspec(2, len(sweeps), width_ratios=widths, height_ratios=(3, 2))
        for column, sweep in enumerate(sweeps):
            upper = figure.add_subplot(places[0, column])
            lower = figure.add_subplot(places[1, column], sharex=upper)
            _prepare(upper, lower, sweep, leftmost=column == 0)
            _draw(upper, lower, sweep, rows)
    _explain(figure.add_subplot(lines[2]), rows)
    return png_of(figure)


def _draw(upper: Axes, lower: Axes, sweep: Sweep, rows: Sequence[Row]) -> None:
    """Lines over numbers, and bars over labels."""
    methods = list(totals(rows))
    width = _GROUP_WIDTH / len(methods)
    for number, method in enumerate(methods):
        found = {row.x: row for row in rows if (row.sweep, row.method) == (sweep.name, method)}
        style = method_style(method)
        for axes, said in ((upper, Verdict.RIGHT), (lower, Verdict.WRONG_UNFLAGGED)):
            percent = [
                100 * getattr(found[x], str(said)) / found[x].frames if x in found else np.nan
                for x in sweep.values
            ]
            if sweep.labelled:
                shift = (number + 0.5) * width - _GROUP_WIDTH / 2
                at = shift + np.arange(len(percent))
                axes.bar(at, percent, width, color=style["color"], zorder=3)
            else:
                few = max((row.frames for row in found.values()), default=0) < _FEW_FRAMES
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
    lower.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
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
    lower.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
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


def _explain(axes: Axes, rows: Sequence[Row]) -> None:
    """Legend with totals, and notes."""
    from matplotlib.lines import Line2D

    axes.set_axis_off()
    all_frames = totals(rows)
    handles = [
        Line2D([], [], label=f"{method}\n{_share(all_frames[method])}", **method_style(method))
        for method in METHODS
        if method in all_frames
    ]
    axes.legend(
        handles=handles,
        title="wrong and not flagged, in all panels together",
        title_fontproperties={"size": 11, "weight": "bold"},
        loc="upper center",
        bbox_to_anchor=(0.5, 1.05),
        ncols=len(handles),
        frameon=False,
        fontsize=11,
        columnspacing=3.0,
    ).get_title().set_color(_RED)
    axes.text(
        0.5,
        0.2,
        "\n".join(textwrap.fill(note, 200) for note in _NOTES),
        transform=axes.transAxes,
        va="top",
        ha="center",
        fontsize=9,
        color=INK,
        linespacing=1.4,
    )


def _share(row: Row) -> str:
    return f"{100 * row.wrong_unflagged / row.frames:.2g} % of {row.frames} frames"
