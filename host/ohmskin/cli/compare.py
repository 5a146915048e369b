# SPDX-License-Identifier: Apache-2.0
"""The comparison of ``ohmskin demo``: what is true of an emulated skin, and what methods find."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from rich.columns import Columns

import ohmskin
from ohmskin.arrays import FULL_SCALE_USIEMENS, Bool, Float
from ohmskin.cli.picture import check_picture, picture
from ohmskin.cli.record import progress
from ohmskin.cli.stream import WIDE, coloured
from ohmskin.cli.terminal import Terminal
from ohmskin.emulate.urls import emulated
from ohmskin.errors import OhmskinError
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.device import scans_for

# The methods that are compared: one that shows ghosts, and one that does not.
_METHODS: Final = ("ohm", "joint")
_out = Terminal()


def compare(port: str, seconds: float, path: Path) -> None:
    """Scan an emulated board, print truth and estimates, and write a picture of them."""
    check_picture(path)
    _, scene, _ = emulated(port)
    with ohmskin.open(port) as skin:
        board = skin.info
        rest_ratio = ratio_from_codes(quantise(scene.rest_ratio))
        knowledge = SkinKnowledge.of(board, rest_ratio)
        estimators = [make_estimator(method, knowledge) for method in _METHODS]
        frames = []
        for scan in progress("scanning")(scans_for(skin, seconds)):
            frames.append([estimator.estimate(scan.ratio) for estimator in estimators])
        stats = skin.stats
    now_s = 1e-6 * scan.time_us
    truth = scene.touched(now_s)
    views = [("truth", scene.skin(now_s).cell_siemens, truth)]
    views += [
        (method, estimate.cell_siemens, estimate.touched)
        for method, estimate in zip(_METHODS, frames[-1], strict=True)
    ]
    title = f"scene '{scene.name}', simulated {board.rows}x{board.columns} skin"
    out = _out if _out.is_terminal else WIDE
    out.print(f"{title}: cell conductance in microsiemens")
    tables = [coloured(1e6 * siemens, FULL_SCALE_USIEMENS, name) for name, siemens, _ in views]
    out.print(Columns(tables))
    for (name, _, touched), estimates in zip(views[1:], zip(*frames, strict=True), strict=True):
        ghosts = int((touched & ~truth).sum())
        verdict = f"{ghosts or 'no'} ghost{'s' if ghosts > 1 else ''}"
        took_ms = 1e3 * float(np.median([estimate.seconds for estimate in estimates]))
        out.print(f"{name:>8}: {verdict}, {took_ms:.2f} ms a scan")
    out.print(
        f"{len(frames)} scans at {board.rate_hz:.2f} Hz, {stats.missed} missed, "
        f"{stats.line.damaged} damaged"
    )
    try:
        _draw(path, views, title)
        out.print(f"picture: {path}")
    except OhmskinError as exc:
        out.print(f"no picture: {exc}")


def _draw(path: Path, views: Sequence[tuple[str, Float, Bool]], title: str) -> None:
    """Views side by side: name, conductances [S] and touched cells, each (R, C)."""
    with picture(path, (3.4 * len(views) + 0.8, 3.9), title) as figure:
        all_axes = figure.subplots(1, len(views), squeeze=False)[0]
        for axes, (name, cell_siemens, touched) in zip(all_axes, views, strict=True):
            drawn_us = np.maximum(1e6 * cell_siemens, 0.1)  # the logarithm of 0 is no colour
            axes.imshow(drawn_us, cmap="viridis", norm="log", vmin=0.5, vmax=FULL_SCALE_USIEMENS)
            for row, column in np.argwhere(touched):
                text = f"{drawn_us[row, column]:.0f}"
                colour = "white" if drawn_us[row, column] < 50 else "black"
                axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=8)
            rows, columns = map(range, cell_siemens.shape)
            axes.set(title=name, xlabel="column", ylabel="row", xticks=columns, yticks=rows)
        scale = all_axes[0].images[0]
        figure.colorbar(scale, ax=all_axes, label="cell conductance [µS]", shrink=0.9)
