# SPDX-License-Identifier: Apache-2.0
"""The picture of `chart`: a panel for each size and resolution, and the paper's two sweeps."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ohmskin.emulate.board import DEFAULT_RATE_HZ
from ohmskin.estimate.methods import METHODS
from studies.chart import BOARD, FAR, MEASURED, PAPER, RANDOM, Row, or_nan
from studies.drawing import INK, method_style, new_figure, png_of, prepare, write_plain_numbers

DEADLINE_MS: Final = 1e3 / DEFAULT_RATE_HZ  # a scan of the board takes so long at its usual rate
_FAINT: Final = "#777777"
_BAND: Final = "#f5e3ad"
_SMALL_POINTS: Final = 8.0  # size of the smallest letters
_PRINTED: Final = (0, (5, 2))  # dashes of lines that show what the paper printed
_SWEEPS: Final = {
    "cell_sweep": "the paper's cell sweep, 3x3",
    "wire_sweep": "the paper's wire sweep, 3x3",
}
_STAR: Final[dict[str, Any]] = {"marker": "*", "markersize": 12, "linestyle": ""}
_PANELS_FOR_NOTES: Final = 3  # widths of panels beside the sweeps
_NOTES: Final = (
    "Upper rows: the same random skins for all methods, 1 to 100 kΩ where touched, each frame "
    "touched anew and started from the one before. A percentage under a marker: so many frames "
    "converged; the others count as well. Without it: all did. 'lsq' and 'regularized' read 2x2 "
    "and 3x3 alone.",
    "Stars: the same frames, read by a board that senses both ends of all lines, by 'joint' and "
    "'touch', which are told nothing of the wires there. Near ends are told the nominal wires.",
    "Limit, of near ends: the median error of the best possible estimator of one frame alone, from "
    "the posterior at the truth (0.67 of its standard deviation, if all cells had the same). Upper "
    "edge: told which cells are pressed, else with the priors of 'joint'; lower edge: told the "
    "cells at rest and each layer's mean wire as well. What learns the wires from earlier frames "
    "can fall below.",
    "Paper (Su et al. 2024): of its 2x2 skin it prints the times, 40 and 90 ms (AMD 7940HS), "
    "and no error of resistance; of simulated 3x3 skins errors, and no time. Lines: median of its "
    "five conditions.",
    "Sweeps: exact readings, each frame cold. All methods are told the true wires and the readings "
    "at rest; 'ohm', 'matrix' and the paper's two use neither.",
)


def picture(rows: Sequence[Row], machine: str) -> bytes:
    """The rows of `chart.measure`, taken on this machine, as a PNG."""
    random = [row for row in rows if row.scene == RANDOM]
    sizes = list(dict.fromkeys((row.rows, row.columns) for row in random))
    resolutions = list(dict.fromkeys(row.bits for row in random))
    width = max(len(sizes), len(_SWEEPS) + _PANELS_FOR_NOTES)
    lines = len(resolutions) + 1
    figure = new_figure(3.1 * width, 2.95 * lines + 1.1)
    grid = figure.add_gridspec(lines, width, hspace=0.06)
    first: Axes | None = None
    for line, bits in enumerate(resolutions):
        for column, size in enumerate(sizes):
            axes = figure.add_subplot(grid[line, column], sharex=first, sharey=first)
            first = first or axes
            of_panel = [row for row in random if (row.rows, row.columns, row.bits) == (*size, bits)]
            of_panel += [row for row in rows if row.place == (FAR, *size, bits)]
            _random_panel(axes, of_panel)
            _mark_times(axes, [row for row in rows if row.place == (BOARD, *size, bits)])
            axes.tick_params(labelleft=column == 0)
            if line == 0:
                axes.set_title(f"{size[0]}x{size[1]}", fontsize=13, fontweight="bold", color=INK)
            if line == len(resolutions) - 1:
                axes.set_xlabel("time a frame [ms]", color=INK)
            if column == 0:
                readings = "exact readings" if bits is None else f"{bits}-bit readings"
                axes.set_ylabel(f"{readings}\nerror of pressed cells [%]", color=INK)
    below: Axes | None = None
    for column, (scene, title) in enumerate(_SWEEPS.items()):
        axes = figure.add_subplot(grid[-1, column], sharex=first, sharey=below)
        below = below or axes
        _sweep_panel(axes, [row for row in rows if row.scene == scene])
        axes.set_title(title, fontsize=10.5, color=INK)
        axes.set_xlabel("time a frame [ms]", color=INK)
        axes.tick_params(labelleft=column == 0)
        if column == 0:
            axes.set_ylabel("exact readings\nRMSE of all cells [MΩ]", color=INK)
    for axes in figure.axes:
        write_plain_numbers(axes.xaxis, axes.yaxis)
    title = f"Time a frame against error: simulated skins, one thread on {machine}"
    _explain(figure, title, {row.method for row in rows})
    _write_notes(figure.add_subplot(grid[-1, len(_SWEEPS) :]))
    return png_of(figure, dpi=120)


# --------------------------------------------------------------------------------------- panels


def _random_panel(axes: Axes, rows: Sequence[Row]) -> None:
    _prepare_panel(axes)
    limits = (rows[0].limit_told_percent, rows[0].limit_percent)
    if limits[0] is not None and limits[1] is not None:
        axes.axhspan(limits[0], limits[1], color=_BAND, zorder=0.5, linewidth=0)
    _points(axes, [(row, row.error_percent, row.error_p90_percent) for row in rows])


def _sweep_panel(axes: Axes, rows: Sequence[Row]) -> None:
    _prepare_panel(axes)
    measured = [row for row in rows if row.source == MEASURED]
    _points(axes, [(row, row.rmse_megohm, row.rmse_p90_megohm) for row in measured])
    for row in rows:
        if row.source == PAPER and row.rmse_megohm is not None:
            colour = method_style(row.method)["color"]
            axes.axhline(row.rmse_megohm, color=colour, linestyle=_PRINTED, linewidth=1.3, zorder=1)


def _prepare_panel(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    prepare(axes)
    axes.axvline(DEADLINE_MS, color=_FAINT, linestyle=":", linewidth=1.3, zorder=1)


def _points(axes: Axes, points: Sequence[tuple[Row, float | None, float | None]]) -> None:
    """Markers at (row, median, 90th percentile), and a line through those on the front."""
    front: list[tuple[float, float]] = []
    for row, middle, tail in points:
        if row.ms is None or middle is None or tail is None:
            continue
        style = method_style(row.method)
        # Broad and pale, for the line of the front often runs along it.
        axes.plot(
            [row.ms, row.ms],
            [middle, tail],
            color=style["color"],
            alpha=0.3,
            linewidth=4,
            solid_capstyle="butt",
            zorder=1.5,
        )
        face = style["color"] if row.on_front else "white"
        marker = _STAR if row.scene == FAR else {"markerfacecolor": face}
        axes.plot([row.ms], [middle], **style | marker, zorder=4)
        if row.on_front:
            front.append((row.ms, middle))
        if row.converged_share is not None and row.converged_share < 0.995:
            axes.annotate(
                f"{100 * row.converged_share:.0f} %",
                (row.ms, middle),
                xytext=(0, -8),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=_SMALL_POINTS,
                color=style["color"],
                zorder=5,
            )
    if front:
        times, errors = zip(*sorted(front), strict=True)
        axes.plot(times, errors, drawstyle="steps-post", color=INK, linewidth=1.1, zorder=2)


def _mark_times(axes: Axes, rows: Sequence[Row]) -> None:
    """The paper's times, without an error: at the axis."""
    for row in rows:
        style = {**method_style(row.method), "marker": "^", "zorder": 5}
        at_axis = axes.get_xaxis_transform()
        axes.plot([or_nan(row.ms)], [0.025], transform=at_axis, clip_on=False, **style)


# ---------------------------------------------------------------------------------------- notes


def _explain(figure: Figure, title: str, methods: set[str]) -> None:
    """Title and legend, above all panels."""
    handles: list[Any] = [
        Line2D([], [], **method_style(method), label=method)
        for method in METHODS
        if method in methods
    ]
    mark: dict[str, Any] = {"color": INK, "linestyle": ""}
    handles += [
        Line2D([], [], color=INK, linewidth=1.1, label="Pareto front (filled markers)"),
        Line2D([], [], **mark, marker="o", markerfacecolor="white", label="median"),
        Line2D([], [], color=_FAINT, alpha=0.5, linewidth=4, label="up to the 90th percentile"),
        Line2D([], [], color=_FAINT, linestyle=":", label="90 Hz: 11.1 ms"),
        Line2D([], [], color=INK, **_STAR, label="far ends, wires not told"),
        Patch(color=_BAND, label="limit of one frame, near ends"),
        Line2D([], [], color=INK, linestyle=_PRINTED, label="printed RMSE, no time"),
        Line2D([], [], **mark, marker="^", markersize=8.5, label="printed time, no error"),
    ]
    legend = figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=7,
        frameon=False,
        fontsize=9,
        title=title,
        title_fontsize=14,
    )
    legend.get_title().set_color(INK)


def _write_notes(axes: Axes) -> None:
    """What the panels show, in a place of their own."""
    axes.set_axis_off()
    notes = axes.text(
        0.02,
        1.05,
        "\n".join(textwrap.fill(note, 108) for note in _NOTES),
        transform=axes.transAxes,
        va="top",
        fontsize=9.5,
        color=INK,
        linespacing=1.45,
    )
    notes.set_in_layout(False)  # its length is not the panels' business
