# SPDX-License-Identifier: Apache-2.0
"""The picture of `far`: the error of each readout against the wires, and against a bend."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from studies.chart_figure import INK, png_of, prepare, require_matplotlib
from studies.far import (
    BEND,
    BENT_OHM,
    BITS,
    COLUMN_OVER_ROW,
    FAR,
    NEAR,
    NEAR_TOLD,
    SCENES,
    WIRES,
    ZERO_BEST,
    ZERO_PATH,
    ZERO_SOLVED,
    Row,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLES: Final[dict[str, dict[str, Any]]] = {
    FAR: {"color": "#009e73", "marker": "o", "linewidth": 2.2, "label": "far ends, nothing told"},
    NEAR: {"color": "#d55e00", "marker": "v", "label": "near ends, nothing told"},
    NEAR_TOLD: {"color": "#e69f00", "marker": "^", "label": "near ends, wires told"},
    ZERO_BEST: {"color": "#666666", "marker": "s", "label": "zero potential, as read"},
    ZERO_PATH: {"color": "#56b4e9", "marker": "D", "label": "…, less the wires told"},
    ZERO_SOLVED: {"color": "#0072b2", "marker": "P", "label": "…, solved with the wires told"},
}
_APART: Final = {WIRES: 1.06, BEND: 1.006}  # from readout to readout, that bars do not hide bars
_LIMITS: Final = (0.03, 200.0)  # per cent
_NOTE: Final = (
    "Simulation: 8x8 cells, 1 MΩ at rest, touches of 1 to 100 kΩ at random places, or a fingertip "
    "over some 20 cells; wire segments spread by 10 %. Told: the middle of the segments of each "
    "layer, of the unbent skin. Estimator: 'joint', each frame anew. Zero potential: ideal "
    "amplifiers, and the least full scale that holds all frames of the skin. Markers: median; pale "
    "bars: up to the 90th percentile."
)


def picture(rows: Sequence[Row]) -> bytes:
    """The rows of `far.measure` as a PNG.

    :raises OhmskinError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15.0, 7.6), layout="constrained")
    grid = figure.subplots(len(BITS), len(SCENES) + 1, sharey=True, squeeze=False)
    for bits, line in zip(BITS, grid, strict=True):
        for axes, scene in zip(line, SCENES, strict=False):
            chosen = [
                row for row in rows if (row.sweep, row.scene, row.bits) == (WIRES, scene, bits)
            ]
            _panel(axes, chosen, WIRES)
        _panel(line[-1], [row for row in rows if (row.sweep, row.bits) == (BEND, bits)], BEND)
        line[0].set_ylabel(f"{bits} bit\nerror of a pressed cell [%]", color=INK)
    for axes, title in zip(grid[0], (*SCENES, f"{SCENES[1]}, the skin bent"), strict=True):
        axes.set_title(title, fontsize=11.5, color=INK)
    for axes in grid[-1, :-1]:
        axes.set_xlabel(f"row segment [Ω]; column: x {COLUMN_OVER_ROW:g}", color=INK)
    grid[-1, -1].set_xlabel(
        f"all wires over those at rest ({BENT_OHM:g} and {COLUMN_OVER_ROW * BENT_OHM:g} Ω)",
        color=INK,
    )
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    figure.supxlabel(textwrap.fill(_NOTE, 190), fontsize=8, color=INK)
    return png_of(figure)


def _panel(axes: Axes, rows: Sequence[Row], sweep: str) -> None:
    """Medians as lines, and bars up to the 90th percentiles."""
    axes.set_yscale("log")
    axes.set_ylim(*_LIMITS)
    if sweep == WIRES:
        axes.set_xscale("log")
    prepare(axes)
    for number, (readout, style) in enumerate(_STYLES.items()):
        of_readout = [row for row in rows if row.readout == readout]
        shift = _APART[sweep] ** (number - (len(_STYLES) - 1) / 2)
        places = [shift * (row.wire_ohm if sweep == WIRES else row.bend) for row in of_readout]
        medians = [row.error_percent for row in of_readout]
        tails = [row.error_p90_percent for row in of_readout]
        axes.plot(places, medians, **{"linewidth": 1.2, "markersize": 5.0, **style})
        axes.vlines(places, medians, tails, color=style["color"], alpha=0.3, linewidth=3.5)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    if sweep == BEND:
        axes.set_xticks(sorted({row.bend for row in rows}))
