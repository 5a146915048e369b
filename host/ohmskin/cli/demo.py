# SPDX-License-Identifier: Apache-2.0
"""``ohmskin demo``: the main job on an emulated skin, compared with the truth."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final
from urllib.parse import parse_qs, urlsplit

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import ohmskin
from ohmskin.arrays import Float
from ohmskin.cli.stream import FULL_SCALE_US, cells_table
from ohmskin.emulate.scenes import Scene
from ohmskin.errors import OhmskinError, PortError
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.messages import BoardStats

URL: Final = "emulator://8x8?scene=ghost&seed=1"
_METHODS: Final = ("ohm", "joint")
_WIDTH: Final = 160
_out = Console()


def demo(
    seconds: Annotated[float, typer.Option(help="how long to scan")] = 3.0,
    port: Annotated[str, typer.Option(help="an emulator:// URL")] = URL,
    picture: Annotated[Path, typer.Option(help="PNG to write")] = Path("ohmskin-demo.png"),
) -> None:
    """Scan an emulated skin, and show what a ghost is and how it goes. Needs no board."""
    result = run(port, seconds)
    # Three tables stand side by side where nothing says how wide the output is.
    wide = Console(width=_WIDTH) if not _out.is_terminal else _out
    report(result, wide)
    try:
        save_picture(picture, result.panels, result.title)
    except OhmskinError as exc:
        _out.print(f"no picture: {exc}", markup=False)
    else:
        _out.print(f"picture: {picture}")


@dataclass(frozen=True)
class Demo:
    """What was seen. panels: name, conductance [S] and touched cells of truth and each method."""

    title: str
    panels: list[tuple[str, Float, NDArray[np.bool_]]]
    rate_hz: float
    stats: BoardStats
    estimate_ms: dict[str, float]

    @property
    def ghosts(self) -> dict[str, int]:
        """Cells that a method takes for touched and nothing touches."""
        truth = self.panels[0][2]
        return {name: int((touched & ~truth).sum()) for name, _, touched in self.panels[1:]}


def run(url: str, seconds: float) -> Demo:
    """Scan `url`, an emulated port, for so long, with every scan through every method.

    :raises PortError: the truth behind this port is not known.
    """
    scene = _scene_of(url)
    with ohmskin.open(url) as skin:
        board = skin.info
        knowledge = SkinKnowledge(
            board.rows,
            board.columns,
            ref_top_ohm=board.ref_top_ohm,
            ref_bottom_ohm=board.ref_bottom_ohm,
            adc_bits=board.adc_bits,
            rest_ratio=ratio_from_codes(quantise(scene.rest_ratio)),
        )
        estimators = [make_estimator(method, knowledge) for method in _METHODS]
        times: dict[str, list[float]] = {method: [] for method in _METHODS}
        estimates = {}
        scan = first = skin.latest()
        end_s = time.monotonic() + seconds
        for scan in skin:
            for estimator in estimators:
                estimates[estimator.name] = estimator.estimate(scan.ratio)
                times[estimator.name].append(estimates[estimator.name].seconds)
            if time.monotonic() >= end_s:
                break
        rate_hz = (scan.number - first.number) * 1e6 / (scan.time_us - first.time_us)
        stats = skin.stats
    now_s = scan.time_us * 1e-6
    panels = [("truth", scene.skin(now_s).cell_siemens, scene.touched(now_s))]
    panels += [(name, e.cell_siemens, e.touched) for name, e in estimates.items()]
    milliseconds = {name: 1e3 * float(np.median(taken)) for name, taken in times.items()}
    title = f"scene '{scene.name}', simulated {board.rows}x{board.columns} skin"
    return Demo(title, panels, rate_hz, stats, milliseconds)


def _scene_of(url: str) -> Scene:
    parts = urlsplit(url)
    options = {key: values[-1] for key, values in parse_qs(parts.query).items()}
    if parts.scheme != "emulator" or "readings" in options:
        raise PortError(f"{url}: the demo needs the truth: use {URL}")
    try:
        rows, columns = map(int, parts.netloc.split("x"))
        seed = int(options.get("seed", "0"))
        return Scene(options.get("scene", "rest"), rows, columns, seed=seed)
    except ValueError as exc:
        raise PortError(f"{url}: {exc}") from exc


def report(demo: Demo, console: Console) -> None:
    """Print truth and estimates side by side, and what they say."""
    console.print(f"{demo.title}: cell conductance in microsiemens")
    tables = [cells_table(cells, name) for name, cells, _ in demo.panels]
    widths = [console.measure(table).maximum for table in tables]
    if sum(widths) <= console.width:
        beside = Table.grid()
        beside.add_row(*tables)
        console.print(beside)
    else:
        console.print(*tables, sep="\n")
    for name, ghosts in demo.ghosts.items():
        verdict = f"{ghosts} ghosts" if ghosts != 1 else "1 ghost"
        console.print(
            f"{name:>8}: {verdict if ghosts else 'no ghost'}, "
            f"{demo.estimate_ms[name]:.2f} ms a scan"
        )
    console.print(
        f"{demo.stats.scans} scans at {demo.rate_hz:.2f} Hz, {demo.stats.missed} missed, "
        f"{demo.stats.line.damaged} damaged"
    )


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
