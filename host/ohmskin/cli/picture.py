# SPDX-License-Identifier: Apache-2.0
"""Pictures that commands write, drawn by matplotlib, which the extra `plot` installs."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ohmskin.errors import OhmskinError
from ohmskin.files import check_place, whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_picture(path: Path, *inputs: Path | None) -> None:
    """As `check_place`; raises ValueError, too, for an ending that no picture has."""
    check_place(path, *inputs)
    with suppress(ImportError):  # `picture` says what is missing
        from matplotlib.backend_bases import FigureCanvasBase

        if path.suffix[1:].lower() not in ("", *FigureCanvasBase.get_supported_filetypes()):
            raise ValueError(f"{path}: no picture ends in '{path.suffix}': say .png, .svg or .pdf")


@contextmanager
def picture(path: Path, inches: tuple[float, float], title: str) -> "Iterator[Figure]":
    """An empty figure to draw on, which is then written: as PNG, unless the name ends otherwise.

    :raises OhmskinError: matplotlib is not installed.
    :raises ValueError: the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as exc:
        hint = "run pip install '.[plot]' in the checkout, or 'FILE.whl[plot]' of a wheel"
        raise OhmskinError(f"pictures need matplotlib: {hint}") from exc
    figure = Figure(figsize=inches, layout="constrained")
    figure.suptitle(title, wrap=True)
    yield figure
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:] or "png", dpi=120)
