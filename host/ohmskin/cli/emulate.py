# SPDX-License-Identifier: Apache-2.0
"""Without a board: ``ohmskin emulate``, and the comparison with the truth of ``ohmskin demo``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from rich.columns import Columns
from rich.console import Console
from typer import Argument

import ohmskin
from ohmskin.arrays import Bool, Float
from ohmskin.cli.board import Seconds
from ohmskin.cli.demo import URL
from ohmskin.cli.record import progress
from ohmskin.cli.stream import FULL_SCALE_US, WIDE, coloured
from ohmskin.ctrl_c import ends_by_ctrl_c
from ohmskin.emulate.board import PtyServer
from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS
from ohmskin.emulate.scenes import SCENES
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.files import check_place, whole_file
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.device import scans_for
from ohmskin.opening import emulated

_METHODS: Final = ("ohm", "joint")
_out = Console()
_OPTIONS: Final = {
    "Scenes (scene=ghost)": SCENES,
    "Faults of the line (drop=0.1)": LINE_FAULTS,
    "Faults of the skin (open_row=3)": SKIN_FAULTS,
}
EPILOGS: Final = {
    "emulate": "\n".join(
        line
        for title, known in _OPTIONS.items()
        for line in (f"{title}:", *(f"- {name}: {text}" for name, text in known.items()))
    )
}


def emulate(
    url: Annotated[str, Argument(help="an emulator:// URL")] = URL,
    seconds: Seconds = 0.0,
) -> None:
    """Serve an emulated board at a pseudo-terminal. Ctrl-C ends it."""
    board, _, faults = emulated(url)
    with PtyServer(board, faults) as server, ends_by_ctrl_c():
        print(server.path, flush=True)  # noqa: T201
        server.serve(seconds or float("inf"))


def compare(port: str, seconds: float, picture: Path) -> None:
    """Scan `port`, an emulated board, print truth and estimates, and write them as a PNG."""
    check_place(picture)
    _, scene, _ = emulated(port)
    with ohmskin.open(port) as skin:
        board = skin.info
        rest_ratio = ratio_from_codes(quantise(scene.rest_ratio))
        knowledge = SkinKnowledge.of(board, rest_ratio)
        estimators = [make_estimator(method, knowledge) for method in _METHODS]
        found = []
        for scan in progress("scanning")(scans_for(skin, seconds)):
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
    out = _out if _out.is_terminal else WIDE
    out.print(f"{title}: cell conductance in microsiemens")
    tables = [coloured(1e6 * siemens, FULL_SCALE_US, name) for name, siemens, _ in views]
    out.print(Columns(tables))
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
        hint = "run pip install '.[plot]' in the checkout, or 'FILE.whl[plot]' of a wheel"
        out.print(f"no picture: pictures need matplotlib: {hint}", markup=False)
    else:
        out.print(f"picture: {picture}")


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
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:] or "png", dpi=120)
