# SPDX-License-Identifier: Apache-2.0
"""What the force experiments found, as tables for a terminal, beside what the paper printed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from rich.table import Table

from studies.force_experiment import CHOICE, EVERY_GROUP, OURS, Row
from studies.force_limits import CrossTalk, SmallestForce
from studies.published import FORCE_RMSE_N


def surface_tables(rows: Sequence[Row]) -> list[Table]:
    """RMSE in newton by method: in the calibration, and in the test by group.

    "below": less than `voltage` by the same regression; "best": than `voltage` by whichever
    regression suits it best.
    """
    tables = []
    for places in dict.fromkeys(
        (row.rows, row.columns, row.frames, row.regression) for row in rows
    ):
        of_table = [
            row for row in rows if (row.rows, row.columns, row.frames, row.regression) == places
        ]
        first = of_table[0]
        groups = list(dict.fromkeys(row.group for row in of_table))
        skin = f"{first.surface} {places[0]}x{places[1]}, {places[3]}, simulated"
        title = f"{skin}: RMSE [N], {first.skins} skins, {first.frames} frames each"
        numbers = ("calibr.", *groups, "below", "best", "every cell", "below", "best")
        table = _table(title, ("cells", "method"), numbers)
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
        if places[:2] == (2, 2):
            _add_published(table, first.surface)
        tables.append(table)
    return tables


def _table(title: str, words: Iterable[str], numbers: Iterable[str]) -> Table:
    """An empty table with columns of words, then of numbers."""
    table = Table(box=None, title=title, title_justify="left")
    for heading in words:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


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


def best_of_ours(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """The better of `joint` and `touch` with the regression chosen, against "voltage"."""
    found: dict[tuple[int, int, str, int], Row] = {}
    for row in rows:
        if (row.group, row.regression) == (EVERY_GROUP, CHOICE) and row.method in OURS:
            place = (row.rows, row.columns, row.cells, row.frames)
            if place not in found or row.pressed_n < found[place].pressed_n:
                found[place] = row
    names = ["rows", "columns", "cells", "frames", "method", "pressed_n", "every_cell_n"]
    names += [field.name for field in fields(Row) if field.name.endswith("_percent")]
    return [{name: getattr(row, name) for name in names} for row in found.values()]


def talk_table(rows: Iterable[CrossTalk]) -> Table:
    """Cross-talk by method."""
    title = "largest false force on an unpressed cell over the largest on the pressed, simulated"
    table = _table(title, ("regression", "method"), ("skins", "mean %", "worst %"))
    for row in rows:
        numbers = (f"{row.percent:.2f}", f"{row.worst_percent:.2f}")
        table.add_row(row.regression, row.method, str(row.skins), *numbers)
    return table


def smallest_table(rows: Iterable[SmallestForce]) -> Table:
    """The smallest force told from none, by method and scene."""
    title = "smallest force told from none by one frame [N], simulated"
    cells = ("(1, 1)", "(1, 2)", "(2, 1)", "(2, 2)")
    table = _table(title, ("scene", "method"), ("median", "worst", *cells))
    for row in sorted(rows, key=lambda row: row.scene):
        numbers = (row.median_n, row.worst_n, *row.by_cell_n)
        table.add_row(
            row.scene,
            row.method,
            *("above 1" if number is None else f"{number:.3f}" for number in numbers),
        )
    return table
