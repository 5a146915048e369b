# SPDX-License-Identifier: Apache-2.0
"""Names for the arrays that all rooms pass around, and how JSON and a notebook show one.

Docstrings where arrays are passed say their shapes and units.
"""

from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
# Conductance at which colours end [microsiemens]. Chosen: a firm press makes 5 kOhm.
FULL_SCALE_USIEMENS: Final = 200.0
# Force at which colours end [N]. Chosen: more than a fingertip usually presses.
FULL_SCALE_N: Final = 10.0


def numbers(values: ArrayLike) -> Any:
    """Values as lists for JSON, with null in place of what is not finite, which JSON cannot say."""
    return np.where(np.isfinite(values), values, np.array(None)).tolist()


def shades(values: Float, full_scale: float) -> Float:
    """0 to 1 on a logarithmic scale from a hundredth of `full_scale` to all of it; NaN is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shade = 1 + np.log10(values / full_scale) / 2
    return np.asarray(np.clip(np.nan_to_num(shade, nan=0.0), 0.0, 1.0))


def heat_map(values: Float, full_scale: float, text: str) -> str:
    """HTML for a notebook: `text`, and cells (R, C) in colours that end at `full_scale`."""
    rows = "".join(
        "<tr>"
        + "".join(
            f'<td title="{value:.3g}" style="background: hsl({60 - 60 * shade:.0f} 90% '
            f'{95 - 50 * shade:.0f}%); width: 1.5em; height: 1.5em; padding: 0"></td>'
            for value, shade in zip(*of_row, strict=True)
        )
        + "</tr>"
        for of_row in zip(values, shades(values, full_scale), strict=True)
    )
    return f"<table><caption>{escape(text)}</caption>{rows}</table>"
