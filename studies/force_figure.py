# SPDX-License-Identifier: Apache-2.0
"""The pictures of `python -m studies experiment`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ohmskin.estimate.methods import METHODS, VOLTAGE
from ohmskin.estimate.ohm import voltage_level
from studies.drawing import (
    INK,
    method_style,
    new_figure,
    png_of,
    prepare,
    write_plain_numbers,
)
from studies.force_experiment import CHOICE, EVERY_GROUP, FAR, TRUTH, UNTOLD, Row, learn, rises
from studies.force_limits import ALONE, BESIDE, PRESSED_CELL, SmallestForce
from studies.force_trial import ForceTrial, groups_of
from studies.published import FORCE_RMSE_N

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CELL_COLOURS: Final = ("#0072b2", "#000000", "#d55e00", "#8a8a8a")  # as in the paper's figure
_CELL_NAMES: Final = groups_of(2, 2)
_PAPER: Final = {"naive": "x", "solved": "+"}
_PAPER_MARK: Final[dict[str, Any]] = {
    "color": INK,
    "linestyle": "",
    "markersize": 9,
    "markeredgewidth": 2,
}


def surface_picture(rows: Sequence[Row]) -> bytes:
    """The rows of `force_experiment.measure` as a PNG: the regression chosen, cells as measured."""
    shown = [
        row
        for row in rows
        if (row.regression, row.cells) == (CHOICE, "whole") and row.method != UNTOLD
    ]
    places = list(dict.fromkeys((row.rows, row.columns, row.frames) for row in shown))
    figure = new_figure(15.5, 8.2)
    surface = shown[0].surface
    bent = "" if surface == "flat" else ", wires 35 % longer since the calibration"
    figure.suptitle(
        f"Force under several touches, {surface} skin{bent}: simulated", fontsize=14, color=INK
    )
    grid = figure.subplots(2, len(places), sharey="row", width_ratios=[1.2, 0.8, 1.2])
    for column, place in enumerate(places):
        of_place = [row for row in shown if (row.rows, row.columns, row.frames) == place]
        few = column == 1
        for line, quantity in enumerate(("pressed_n", "every_cell_n")):
            axes = grid[line, column]
            _bars(axes, of_place, quantity, only_mean=few)
            if line == 0:
                number = of_place[0].skins
                skins = f"{number} skin{'s' * (number > 1)}, {place[2]} frames each"
                axes.set_title(f"{place[0]}x{place[1]}: {skins}", fontsize=11, color=INK)
                if column == 0:
                    _mark_published(axes, surface)
        if not few:
            meaning = "robot's cell" if place[:2] == (2, 2) else "touches at once"
            grid[1, column].set_xlabel(meaning, color=INK)
    grid[0, 0].set_ylabel("RMSE on the robot's cell [N]", color=INK)
    grid[1, 0].set_ylabel("RMSE over every cell [N]", color=INK)
    paper = [row.method for row in shown if row.frames == places[1][2]]
    _explain(figure, [*paper, *(row.method for row in shown if row.method == FAR)])
    return png_of(figure)


def _bars(axes: Axes, rows: Sequence[Row], quantity: str, *, only_mean: bool) -> None:
    methods = list(dict.fromkeys(row.method for row in rows))
    groups = [EVERY_GROUP] if only_mean else list(dict.fromkeys(row.group for row in rows))
    width = 0.84 / len(methods)
    value = {(row.group, row.method): row for row in rows}
    for number, method in enumerate(methods):
        for place, group in enumerate(groups):
            row = value[group, method]
            left = place - 0.42 + number * width
            axes.bar(left, getattr(row, quantity), width, align="edge", **_fill(method))
            if quantity == "pressed_n":
                for colour, linewidth in (("white", 3.2), (INK, 1.4)):
                    axes.plot(
                        [left + 0.1 * width, left + 0.9 * width],
                        [row.calibration_n] * 2,
                        color=colour,
                        linewidth=linewidth,
                        solid_capstyle="butt",
                    )
            if only_mean:
                axes.text(
                    left + width / 2,
                    getattr(row, quantity) + 0.03,
                    f"{getattr(row, quantity):.2f}",
                    ha="center",
                    fontsize=8.5,
                    color=INK,
                )
    if only_mean:
        centres = -0.42 + width * (np.arange(len(methods)) + 0.5)
        axes.set_xticks(centres, methods, rotation=40, ha="right", rotation_mode="anchor")
    else:
        labels = [
            "mean" if group == EVERY_GROUP else group.removesuffix(" touches") for group in groups
        ]
        axes.set_xticks(range(len(groups)), labels)
    prepare(axes, axis="y")


def _mark_published(axes: Axes, surface: str) -> None:
    for method, marker in _PAPER.items():
        by_cell = FORCE_RMSE_N[surface][method, "estimation"]
        axes.plot(range(5), [*by_cell, float(np.mean(by_cell))], marker=marker, **_PAPER_MARK)


def _explain(figure: Figure, methods: Sequence[str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(label=_label(method), **_fill(method)) for method in dict.fromkeys(methods)
    ]
    handles.append(Line2D([], [], color=INK, linewidth=1.4, label="in the calibration"))
    handles += [
        Line2D([], [], marker=marker, label=f"paper's {method}, a real skin", **_PAPER_MARK)
        for method, marker in _PAPER.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, fontsize=9.5)


def series_picture(trial: ForceTrial) -> bytes:
    """Force, readings, conductances and false forces of `force_limits.press_series`, as a PNG."""
    window = trial.group == 0
    time_s = trial.time_s[window] - trial.time_s[window][0]
    figure = new_figure(9.5, 11.5)
    figure.suptitle(
        "One press of cell (2, 2) of a 2x2 skin, 90 Hz, 10 bit: simulated", fontsize=14, color=INK
    )
    top, middle, low, bottom = figure.subplots(4, 1, sharex=True)
    touch_rise = rises("touch", trial)
    by_touch, by_voltage = (
        learn(trial, rise, CHOICE)(rise)[window].reshape(-1, 4)
        for rise in (touch_rise, rises(VOLTAGE, trial))
    )
    true_n = trial.force_n[window].reshape(-1, 4)[:, PRESSED_CELL]
    colours = {"touch": method_style("touch")["color"], VOLTAGE: "#cc3311"}
    top.plot(time_s, by_voltage[:, PRESSED_CELL], color=colours[VOLTAGE], linewidth=1.1)
    top.plot(time_s, by_touch[:, PRESSED_CELL], color=colours["touch"], linewidth=1.1)
    top.plot(time_s, true_n, color=INK, linewidth=2)
    for name, colour in (("true", INK), ("'touch'", colours["touch"]), (VOLTAGE, colours[VOLTAGE])):
        top.plot([], [], color=colour, linewidth=2, label=name)
    top.set_ylabel("force on cell (2, 2) [N]", color=INK)
    level = voltage_level(trial.ratio[window]).reshape(-1, 4)
    micro = 1e6 * (touch_rise[window].reshape(-1, 4))
    for cell in range(4):
        line: dict[str, Any] = {"color": _CELL_COLOURS[cell], "linewidth": 1.3}
        middle.plot(time_s, level[:, cell], label=_CELL_NAMES[cell], **line)
        low.plot(time_s, micro[:, cell], label=_CELL_NAMES[cell], **line)
    middle.set_ylabel("raw voltage [V/Vdd]", color=INK)
    low.set_ylabel("conductance above rest\nby 'touch' [µS]", color=INK)
    others = [cell for cell in range(4) if cell != PRESSED_CELL]
    for name, force_n in ((VOLTAGE, by_voltage), ("touch", by_touch)):
        false_mn = 1e3 * np.abs(force_n[:, others]).max(axis=1)
        label = "'touch'" if name == "touch" else name
        bottom.plot(time_s, false_mn, color=colours[name], linewidth=1.1, label=label)
    bottom.set_ylabel("largest false force on\nthe other cells [mN]", color=INK)
    bottom.set_xlabel("time [s]", color=INK)
    for axes in (top, middle, low, bottom):
        prepare(axes, axis="y")
        axes.legend(loc="upper left", frameon=False, fontsize=9.5)
        axes.set_xlim(0, time_s[-1])
    return png_of(figure)


def smallest_picture(rows: Sequence[SmallestForce]) -> bytes:
    """The rows of `force_limits.smallest_forces` as a PNG."""
    figure = new_figure(8.5, 4.6)
    figure.suptitle(
        "Smallest force told from none by one frame of a 2x2 skin: simulated",
        fontsize=13,
        color=INK,
    )
    axes = figure.subplots()
    methods = list(dict.fromkeys(row.method for row in rows))
    marks = {ALONE: ("o", -0.14), BESIDE: ("D", 0.14)}
    style: dict[str, Any] = {"markersize": 9, "markeredgewidth": 1.6}
    for row in rows:
        marker, aside = marks[row.scene]
        at = methods.index(row.method) + aside
        colour = _fill(row.method)["color"]
        if row.median_n is None:
            axes.annotate("above 1", (at, 1.0), ha="center", fontsize=9, color=colour)
            continue
        top_n = 1.0 if row.worst_n is None else row.worst_n
        axes.plot([at, at], [row.median_n, top_n], color=colour, alpha=0.4, linewidth=5)
        face = "white" if row.scene == ALONE else colour
        axes.plot([at], [row.median_n], marker, color=colour, markerfacecolor=face, **style)
        axes.annotate(
            f"{row.median_n:.3f}",
            (at, row.median_n),
            xytext=(9, -4),
            textcoords="offset points",
            fontsize=9,
            color=INK,
        )
    for scene, (marker, _) in marks.items():
        face = "white" if scene == ALONE else INK
        name = scene if scene == ALONE else f"{scene} of 1 N"
        axes.plot([], [], marker, color=INK, markerfacecolor=face, label=name, **style)
    axes.plot([], [], color=INK, alpha=0.4, linewidth=5, label="up to the worst cell and skin")
    axes.set_yscale("log")
    axes.set_ylim(0.004, 1.0)
    axes.set_xticks(range(len(methods)), methods)
    axes.set_xlim(-0.6, len(methods) - 0.3)
    axes.set_ylabel("force [N], 99 % detected at 1 % false alarms", color=INK)
    write_plain_numbers(axes.yaxis)
    prepare(axes, axis="y")
    axes.legend(loc="upper right", frameon=False, fontsize=9.5)
    return png_of(figure)


def _fill(method: str) -> dict[str, Any]:
    if method in METHODS:
        return {"color": method_style(method)["color"]}
    if method == FAR:
        return {"color": "#7fd4b8"}
    return {"color": "#cc3311" if method == VOLTAGE else "#c8c8c8"}


def _label(method: str) -> str:
    return {VOLTAGE: "voltage (baseline)", TRUTH: "truth: the true conductances"}.get(
        method, method
    )
