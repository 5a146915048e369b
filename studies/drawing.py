# SPDX-License-Identifier: Apache-2.0
"""What the pictures of all studies have in common."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ohmskin.estimate.methods import METHODS

INK: Final = "#333333"
_COLOURS: Final = ("#666666", "#0072b2", "#e69f00", "#d55e00", "#009e73", "#aa3fb4", "#000000")
_MARKERS: Final = ("s", "D", "^", "v", "o", "P", "X")


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """An empty picture whose panels make room for their words."""
    return Figure(figsize=(width_inch, height_inch), layout="constrained")


def png_of(figure: Figure, dpi: int = 110) -> bytes:
    """The picture as a file."""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=dpi)
    return png.getvalue()


def method_style(method: str) -> dict[str, Any]:
    """Colour and marker, the same in all panels: by the method's place in `METHODS`."""
    number = list(METHODS).index(method)
    return {
        "color": _COLOURS[number % len(_COLOURS)],
        "marker": _MARKERS[number % len(_MARKERS)],
        "markersize": 8.5,
        "markeredgewidth": 1.5,
        "linestyle": "",
    }


def write_notes(figure: Figure, notes: Iterable[str], columns: int) -> None:
    """What the panels show, below all of them, in lines of so many letters."""
    text = "\n".join(textwrap.fill(note, columns) for note in notes)
    figure.supxlabel(text, fontsize=9, color=INK, linespacing=1.4)


def prepare(axes: Axes, *, colour: str = "#e4e4e4", **grid: Any) -> None:
    """A faint grid below all else, and no frame."""
    axes.set_axisbelow(True)
    axes.grid(color=colour, linewidth=0.7, **grid)
    axes.spines[["top", "right"]].set_visible(False)


def write_plain_numbers(*axes: Any) -> None:
    """0.1 and 100 along each of these axes of a panel, not powers of ten."""
    for axis in axes:
        axis.set_major_formatter(lambda value, _: f"{value:g}")
