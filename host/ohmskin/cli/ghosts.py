# SPDX-License-Identifier: Apache-2.0
"""What methods make of an emulated skin, beside the truth: what ``ohmskin demo`` shows."""

import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from rich.columns import Columns
from rich.console import Console
from rich.progress import Progress

import ohmskin
from ohmskin.arrays import Bool, Float
from ohmskin.cli.stream import FULL_SCALE_US, conductances
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.opening import emulated

_METHODS: Final = ("ohm", "joint")
_out = Console()


def compare(port: str, seconds: float, picture: Path) -> None:
    """Scan `port`, an emulated board, print truth and estimates, and write them as a PNG."""
    _, scene, _ = emulated(port)
    with ohmskin.open(port) as skin:
        board = skin.info
        rest_ratio = ratio_from_codes(quantise(scene.rest_ratio))
        knowledge = SkinKnowledge.of(board, rest_ratio)
        estimators = [make_estimator(method, knowledge) for method in _METHODS]
        found = []
        for scan in _limited(skin, seconds):
            found.append([estimator.estimate(scan.ratio) for estimator in estimators])
        stats = skin.stats
    now_s = 1e-6 * scan.time_us
    truth = scene.touched(now_s)
    views = [("truth", scene.skin(now_s).cell_siemens, truth)]
    views += [
        (method, estimate.cell_siemens, estimate.touched)
        for method, estimate in zip(_METHODS, found[-1], strict=True)
    ]
    title = f"scene '{scene.name}', simulated {board.rows}x{board.columns} skin"
    out = _out if _out.is_terminal else Console(width=160)  # three tables side by side
    out.print(f"{title}: cell conductance in microsiemens")
    out.print(Columns([conductances(cell_siemens, name) for name, cell_siemens, _ in views]))
    for (name, _, touched), estimates in zip(views[1:], zip(*found, strict=True), strict=True):
        ghosts = int((touched & ~truth).sum())
        said = f"{ghosts or 'no'} ghost{'s' if ghosts > 1 else ''}"
        took_ms = 1e3 * float(np.median([estimate.seconds for estimate in estimates]))
        out.print(f"{name:>8}: {said}, {took_ms:.2f} ms a scan")
    out.print(
        f"{stats.scans} scans at {board.rate_hz:.2f} Hz, {stats.missed} missed, "
        f"{stats.line.damaged} damaged"
    )
    try:
        _save_picture(picture, views, title)
    except ImportError:
        out.print(
            "no picture: pictures need matplotlib: "
            "run pip install '.[plot]' in the checkout, or 'FILE.whl[plot]' of a release's wheel",
            markup=False,
        )
    else:
        out.print(f"picture: {picture}")


def _limited(scans: Iterable[Scan], seconds: float) -> Iterator[Scan]:
    """Those of so long; in a terminal, a bar says how long it still takes."""
    begin_s = time.monotonic()
    with Progress(console=_out, transient=True, disable=not _out.is_terminal) as progress:
        bar = progress.add_task("scanning", total=seconds)
        for scan in scans:
            yield scan
            progress.update(bar, completed=(now_s := time.monotonic()) - begin_s)
            if now_s >= begin_s + seconds:
                return


def _save_picture(path: Path, views: Sequence[tuple[str, Float, Bool]], title: str) -> None:
    """A PNG of views side by side: name, conductances [S] and touched cells, each (R, C).

    :raises ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(views) + 0.8, 3.9), layout="constrained")
    figure.suptitle(title)
    all_axes = figure.subplots(1, len(views), squeeze=False)[0]
    for axes, (name, cell_siemens, touched) in zip(all_axes, views, strict=True):
        seen_us = np.maximum(1e6 * cell_siemens, 0.1)
        axes.imshow(seen_us, cmap="viridis", norm="log", vmin=0.5, vmax=FULL_SCALE_US)
        for row, column in np.argwhere(touched):
            text = f"{seen_us[row, column]:.0f}"
            colour = "white" if seen_us[row, column] < 50 else "black"
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=8)
        rows, columns = map(range, cell_siemens.shape)
        axes.set(title=name, xlabel="column", ylabel="row", xticks=columns, yticks=rows)
    figure.colorbar(all_axes[0].images[0], ax=all_axes, label="cell conductance [µS]", shrink=0.9)
    figure.savefig(path, dpi=120)
