# SPDX-License-Identifier: Apache-2.0
"""Tables and pictures of a skin, for terminals and files. Scales are fixed, never a frame's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ohmskin.arrays import Float
from ohmskin.errors import OhmskinError

FULL_SCALE_US: Final = 200.0  # microsiemens: a cell of 5 kOhm
FULL_SCALE_N: Final = 10.0
_STEPS: Final = 5
_COLOURS: Final = ("grey50", "cyan", "green", "yellow", "red")


def cells_table(cell_siemens: Float, title: str) -> Table:
    """Conductances [S], shape (rows, columns), as a table in microsiemens, coloured by value."""
    return _table(1e6 * cell_siemens, title, 1.0, FULL_SCALE_US)


def forces_table(force_n: Float, title: str) -> Table:
    """Forces [N], shape (rows, columns), as a table, coloured by value."""
    return _table(force_n, title, FULL_SCALE_N / 100, FULL_SCALE_N)


def grid(cells: Sequence[Sequence[str | Text]], title: str) -> Table:
    """Texts of all cells, row by row, under the numbers of columns and beside those of rows."""
    table = Table(title=title, box=None)
    table.add_column("", justify="right", style="dim")
    for column in range(len(cells[0])):
        table.add_column(str(column), justify="right")
    for row, texts in enumerate(cells):
        table.add_row(str(row), *texts)
    return table


def _table(values: Float, title: str, low: float, high: float) -> Table:
    """Colours on a logarithmic scale from `low` to `high`."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 0, 0, 1), pad_edge=False)
    table.add_column("", justify="right", style="dim")
    for column in range(values.shape[1]):
        table.add_column(str(column), justify="right", min_width=3, header_style="dim")
    for row, cells in enumerate(values):
        styled = (Text(_short(value), style=_colour(value, low, high)) for value in cells)
        table.add_row(str(row), *styled)
    return table


def _short(value: float) -> str:
    if not np.isfinite(value):
        return "?"
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"


def _colour(value: float, low: float, high: float) -> str:
    if not value > low:
        return _COLOURS[0]
    share = np.log(value / low) / np.log(high / low)
    return _COLOURS[int(np.clip(share * _STEPS, 0, _STEPS - 1))]


def save_picture(
    path: Path, panels: Sequence[tuple[str, Float, NDArray[np.bool_]]], title: str
) -> None:
    """A PNG of skins side by side: title, conductances [S] and touched cells of each.

    :raises OhmskinError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as exc:
        raise OhmskinError("pictures need matplotlib: pip install 'ohmskin[plot]'") from exc
    figure = Figure(figsize=(3.4 * len(panels) + 0.8, 3.9), layout="constrained")
    figure.suptitle(title)
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    image = None
    for axes, (name, cell_siemens, touched) in zip(all_axes, panels, strict=True):
        image = axes.imshow(
            np.maximum(1e6 * cell_siemens, 0.1), norm="log", vmin=0.5, vmax=FULL_SCALE_US
        )
        image.set_cmap("viridis")
        for row, column in np.argwhere(touched):
            axes.text(
                column,
                row,
                f"{1e6 * cell_siemens[row, column]:.0f}",
                ha="center",
                va="center",
                color="white" if cell_siemens[row, column] < 5e-5 else "black",
                fontsize=8,
            )
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("column")
        axes.set_ylabel("row")
        axes.set_xticks(range(cell_siemens.shape[1]))
        axes.set_yticks(range(cell_siemens.shape[0]))
    assert image is not None
    figure.colorbar(image, ax=all_axes, label="cell conductance [µS]", shrink=0.9)
    figure.savefig(path, dpi=120)
