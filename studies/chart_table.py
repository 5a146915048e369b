# SPDX-License-Identifier: Apache-2.0
"""The rows of `chart` as CSV, as a table for a terminal, and who is on which front."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import fields

from rich.table import Table

from studies.casadi_circuit import COMPILER, GENERATED_C
from studies.chart import FAR, LINEARISATION, MEASURED, RANDOM, Row, or_nan


def csv_text(rows: Iterable[Row]) -> str:
    """The rows as CSV, columns named after the fields of `Row`; None is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        columns = {**vars(row), "bits": row.bits or "exact"}
        writer.writerow(map(_cell, columns.values()))
    return text.getvalue()


def _cell(value: object) -> object:
    match value:
        case None:
            return ""
        case bool():
            return int(value)
        case float():
            return f"{value:.4g}"
    return value


def fronts(rows: Iterable[Row]) -> dict[str, list[str]]:
    """The methods on each front, fastest first, by scene, size and resolution."""
    found: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row.on_front:
            found[f"{row.scene} {row.rows}x{row.columns} {row.resolution}"].append(row)
    return {
        place: [row.method for row in sorted(on_front, key=lambda row: or_nan(row.ms))]
        for place, on_front in found.items()
    }


def summary(rows: Iterable[Row]) -> Table:
    """What was measured, for a terminal."""
    rows = list(rows)
    caption = "*: no method is as fast and as accurate"
    evaluations = {row.method for row in rows if row.scene == LINEARISATION}
    if evaluations and GENERATED_C not in evaluations:
        caption += f"\nno C compiler ({COMPILER}): what CasADi generates was not measured"
    table = Table(box=None, caption=caption)
    for heading in ("skin", "method"):
        table.add_column(heading, no_wrap=True)
    for heading in ("ms", "error %", "90th", "RMSE MΩ", "conv. %"):
        table.add_column(heading, justify="right", no_wrap=True)
    before: object = None
    for row in rows:
        if row.source != MEASURED:
            continue
        names = {RANDOM: row.resolution, FAR: f"{row.resolution} far"}
        size = f"{row.rows}x{row.columns} {names.get(row.scene, row.scene)}"
        share = row.converged_share
        table.add_row(
            size if row.place != before else "",
            f"{row.method} *" if row.on_front else row.method,
            *(
                "" if number is None else f"{number:#.3g}"
                for number in (row.ms, row.error_percent, row.error_p90_percent, row.rmse_megohm)
            ),
            "" if share is None else f"{100 * share:.0f}",
        )
        before = row.place
    return table
