# SPDX-License-Identifier: Apache-2.0
"""What the pictures of all studies have in common. matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Final

from ohmskin.errors import OhmskinError
from ohmskin.estimate.methods import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK: Final = "#333333"
_COLOURS: Final = ("#666666", "#0072b2", "#e69f00", "#d55e00", "#009e73", "#aa3fb4", "#000000")
_MARKERS: Final = ("s", "D", "^", "v", "o", "P", "X")


def require_matplotlib() -> None:
    """Nobody should wait for a picture that cannot be drawn.

    :raises OhmskinError: matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as exc:
        raise OhmskinError("pictures need matplotlib: pip install '.[plot]'") from exc


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """An empty picture whose panels make room for their words.

    :raises OhmskinError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

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


def prepare(axes: Axes, *, colour: str = "#e4e4e4", **grid: Any) -> None:
    """A faint grid below all else, and no frame."""
    axes.set_axisbelow(True)
    axes.grid(color=colour, linewidth=0.7, **grid)
    axes.spines[["top", "right"]].set_visible(False)


def write_plain_numbers(*axes: Any) -> None:
    """0.1 and 100 along each of these axes of a panel, not powers of ten."""
    for axis in axes:
        axis.set_major_formatter(lambda value, _: f"{value:g}")
