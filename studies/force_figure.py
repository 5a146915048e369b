# SPDX-License-Identifier: Apache-2.0
"""The pictures of `python -m studies experiment`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ohmskin.estimate.methods import METHODS, VOLTAGE
from ohmskin.estimate.ohm import voltage_level
from studies.drawing import INK, method_style, new_figure, png_of, prepare
from studies.force_experiment import CHOICE, FAR, SLOW, TRUTH, UNTOLD, Row, learn, rises
from studies.force_kneading import METHOD, SINGLE_VOLTAGE, SURFACES
from studies.force_kneading import Row as KneadedRow
from studies.force_limits import PRESSED_CELL
from studies.force_trial import FORCES_N, ForceTrial, groups_of
from studies.published import FORCE_RMSE_N

_CELL_COLOURS: Final = ("#0072b2", "#000000", "#d55e00", "#8a8a8a")  # as in the paper's figure
_CELL_NAMES: Final = groups_of(2, 2)
_LABELS: Final = {VOLTAGE: "voltage (baseline)", TRUTH: "truth: the true conductances"}
_PAPER: Final = {"naive": "x", "solved": "+"}
_PAPER_MARK: Final[dict[str, Any]] = {
    "color": INK,
    "linestyle": "",
    "markersize": 9,
    "markeredgewidth": 2,
}


def surface_picture(rows: Sequence[Row]) -> bytes:
    """The rows of `force_experiment.measure` as a PNG: the regression chosen, cells as measured.

    The paper's methods are left to the tables, because they read fewer frames.
    """
    read_fewer = {(row.rows, row.columns, row.frames) for row in rows if row.method in SLOW}
    by_place: dict[tuple[int, int, int], list[Row]] = defaultdict(list)
    for row in rows:
        place = (row.rows, row.columns, row.frames)
        chosen = (row.regression, row.cells) == (CHOICE, "whole") and row.method != UNTOLD
        if chosen and place not in read_fewer:
            by_place[place].append(row)
    figure = new_figure(13.5, 8.2)
    surface = rows[0].surface
    bent = "" if surface == "flat" else ", wires 35 % longer since the calibration"
    figure.suptitle(
        f"Force under several touches, {surface} skin{bent}: simulated", fontsize=14, color=INK
    )
    grid = figure.subplots(2, len(by_place), sharey="row", squeeze=False)
    for (upper, lower), (place, of_place) in zip(grid.T, by_place.items(), strict=True):
        _bars(upper, of_place, "pressed_n")
        _bars(lower, of_place, "every_cell_n")
        number = of_place[0].skins
        skins = f"{number} skin{'s' * (number > 1)}, {place[2]} frames each"
        upper.set_title(f"{place[0]}x{place[1]}: {skins}", fontsize=11, color=INK)
        meaning = "robot's cell" if place[:2] == (2, 2) else "touches at once"
        lower.set_xlabel(meaning, color=INK)
    _mark_published(grid[0, 0], surface)
    grid[0, 0].set_ylabel("RMSE on the robot's cell [N]", color=INK)
    grid[1, 0].set_ylabel("RMSE over every cell [N]", color=INK)
    _explain(
        figure, dict.fromkeys(row.method for of_place in by_place.values() for row in of_place)
    )
    return png_of(figure)


def _bars(axes: Axes, rows: Sequence[Row], quantity: str) -> None:
    methods = list(dict.fromkeys(row.method for row in rows))
    groups = list(dict.fromkeys(row.group for row in rows))
    width = 0.84 / len(methods)
    for row in rows:
        left = groups.index(row.group) - 0.42 + methods.index(row.method) * width
        axes.bar(left, getattr(row, quantity), width, align="edge", **_fill(row.method))
        if quantity == "pressed_n":
            for colour, linewidth in (("white", 3.2), (INK, 1.4)):
                ends = (left + 0.1 * width, left + 0.9 * width)
                axes.hlines(row.calibration_n, *ends, color=colour, linewidth=linewidth)
    labels = [group.removesuffix(" touches") for group in groups]
    axes.set_xticks(range(len(groups)), labels)
    prepare(axes, axis="y")


def _mark_published(axes: Axes, surface: str) -> None:
    for method, marker in _PAPER.items():
        by_cell = FORCE_RMSE_N[surface][method, "estimation"]
        axes.plot(range(5), [*by_cell, float(np.mean(by_cell))], marker=marker, **_PAPER_MARK)


def _explain(figure: Figure, methods: Iterable[str]) -> None:
    labels = {method: _LABELS.get(method, method) for method in methods}
    handles: list[Any] = [Patch(label=label, **_fill(method)) for method, label in labels.items()]
    handles.append(Line2D([], [], color=INK, linewidth=1.4, label="in the calibration"))
    handles += [
        Line2D([], [], marker=marker, label=f"paper's {method}, a real skin", **_PAPER_MARK)
        for method, marker in _PAPER.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9.5)


def series_picture(trial: ForceTrial) -> bytes:
    """Force, readings, conductances and false forces of `force_limits.press_series`, as a PNG."""
    window = trial.group == 0
    time_s = trial.time_s[window] - trial.time_s[window][0]
    figure = new_figure(9.5, 11.5)
    figure.suptitle(
        "One press of cell (2, 2) of a 2x2 skin, 90 Hz, 10 bit: simulated", fontsize=14, color=INK
    )
    top, middle, low, bottom = figure.subplots(4, 1, sharex=True)
    for method, label in ((VOLTAGE, VOLTAGE), ("touch", "'touch'")):
        rise = rises(method, trial)
        force_n = learn(trial, rise, CHOICE)(rise)[window].reshape(-1, 4)
        style = {"label": label, "linewidth": 1.1, **_fill(method)}
        top.plot(time_s, force_n[:, PRESSED_CELL], **style)
        false_n = np.delete(force_n, PRESSED_CELL, axis=1)
        bottom.plot(time_s, 1e3 * np.abs(false_n).max(axis=1), **style)
    true_n = trial.force_n[window].reshape(-1, 4)[:, PRESSED_CELL]
    top.plot(time_s, true_n, color=INK, linewidth=2, label="true")
    level, micro = voltage_level(trial.ratio[window]), 1e6 * rise[window]
    for axes, by_cell in ((middle, level), (low, micro)):
        for name, colour, of_cell in zip(
            _CELL_NAMES, _CELL_COLOURS, by_cell.reshape(-1, 4).T, strict=True
        ):
            axes.plot(time_s, of_cell, label=name, color=colour, linewidth=1.3)
    top.set_ylabel("force on cell (2, 2) [N]", color=INK)
    middle.set_ylabel("raw voltage [V/Vdd]", color=INK)
    low.set_ylabel("conductance above rest\nby 'touch' [µS]", color=INK)
    bottom.set_ylabel("largest false force on\nthe other cells [mN]", color=INK)
    bottom.set_xlabel("time [s]", color=INK)
    for axes in (top, middle, low, bottom):
        prepare(axes, axis="y")
        axes.legend(loc="upper left", frameon=False, fontsize=9.5)
        axes.set_xlim(0, time_s[-1])
    return png_of(figure)


def kneading_picture(rows: Sequence[KneadedRow]) -> bytes:
    """The rows of `force_kneading.measure` as a PNG: estimated over true force of touched cells."""
    first, most_n = rows[0], FORCES_N[1]
    top_n = max(most_n, *(float(row.force_n.max()) for row in rows))
    figure = new_figure(12, 8.4)
    skins = f"{first.rows}x{first.columns}, {first.skins} skins, {first.frames} frames each"
    figure.suptitle(
        f"Touched cells under 3 to 6 touches, by way of calibrating: simulated, {skins}",
        fontsize=14,
        color=INK,
    )
    grid = figure.subplots(len(SURFACES), len(rows) // len(SURFACES), sharex=True, sharey=True)
    for axes, row in zip(grid.flat, rows, strict=True):
        colour = _fill(VOLTAGE if row.calibrated == SINGLE_VOLTAGE else METHOD)["color"]
        axes.plot(row.true_n, row.force_n, ".", color=colour, markersize=5, alpha=0.5)
        axes.plot([0, most_n], [0, most_n], color=INK, linewidth=1)
        axes.set_title(f"{row.surface}: {row.calibrated}", fontsize=12, color=INK)
        words = f"RMSE: robot's cell {row.pressed_n:.2f} N\nevery cell {row.every_cell_n:.3f} N"
        axes.text(0.04, 0.96, words, transform=axes.transAxes, va="top", fontsize=11, color=INK)
        axes.set_xlim(0, most_n)
        axes.set_ylim(0, 1.05 * top_n)
        prepare(axes)
    figure.supxlabel("true force [N]", color=INK)
    figure.supylabel("estimated force [N]", color=INK)
    return png_of(figure)


def _fill(method: str) -> dict[str, Any]:
    if method in METHODS:
        return {"color": method_style(method)["color"]}
    if method == FAR:
        return {"color": "#7fd4b8"}
    return {"color": "#cc3311" if method == VOLTAGE else "#c8c8c8"}
