# SPDX-License-Identifier: Apache-2.0
"""Studies as commands of the command line: the answer on stdout, everything else on stderr."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from ohmskin.files import whole_file
from studies import ablate as constants_tried
from studies import chart as speed_accuracy
from studies import chart_figure, chart_table, far_figure, stability_figure
from studies import far as far_ends
from studies import stability as verdicts
from studies.ablate_scenes import Plan


def _machine() -> str:
    """The processor that the times are of, as far as the system tells."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "an unknown processor"


def default_folder() -> Path:
    """Where pictures go: docs of a checkout, or here."""
    root = Path(__file__).parents[1]
    return root / "docs" if (root / "platformio.ini").is_file() else Path()


def save_whole(contents: Mapping[Path, bytes]) -> None:
    """Write all of these files, or none."""
    with ExitStack() as stack:
        for path, content in contents.items():
            file = stack.enter_context(whole_file(path))
            file.write(content)
            file.flush()


def chart(
    out: Annotated[
        Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="fewer frames: rough, in a minute")
    ] = False,
) -> None:
    """Measure time a frame against error, of all methods on simulated skins: a PNG and a CSV.

    Takes a few minutes on one core. The last line printed is one JSON object.
    """
    chart_figure.require_matplotlib()
    folder = default_folder() if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    started_s = time.monotonic()
    messages = Console(stderr=True)
    # Redrawn seldom, because the bar's thread runs beside what is being timed.
    with Progress(
        console=messages, transient=True, disable=not messages.is_terminal, refresh_per_second=2
    ) as progress:
        task = progress.add_task("frames", total=None)

        def show_progress(done: int, frames: int) -> None:
            progress.update(task, completed=done, total=frames)

        plan = speed_accuracy.QUICK if quick else speed_accuracy.FULL
        rows = speed_accuracy.measure(plan, show_progress)
    picture, table = (folder / f"speed-accuracy.{kind}" for kind in ("png", "csv"))
    save_whole(
        {
            picture: chart_figure.picture(rows, _machine()),
            table: chart_table.csv_text(rows).encode(),
        }
    )
    messages.print(chart_table.summary(rows))
    answer = {
        "picture": str(picture),
        "table": str(table),
        "quick": quick,
        "seconds": round(time.monotonic() - started_s, 1),
        "fronts": chart_table.fronts(rows),
    }
    print(json.dumps(answer))  # noqa: T201


def stability(
    out: Annotated[
        Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="fewer frames, smaller skins: rough, in a minute")
    ] = False,
    jobs: Annotated[int, typer.Option(min=0, help="processes; 0: one a core")] = 0,
) -> None:
    """Count where methods are wrong and do not say so, under faults and extremes: a PNG and a CSV.

    Takes minutes. Simulated skins; the verdicts do not depend on --jobs. The last line printed is
    one JSON object.
    """
    chart_figure.require_matplotlib()
    folder = default_folder() if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    started_s = time.monotonic()
    messages = Console(stderr=True)
    tasks = verdicts.tasks_of(verdicts.QUICK if quick else verdicts.FULL)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as progress:
        task = progress.add_task("skins", total=len(tasks))

        def show_progress(done: int) -> None:
            progress.update(task, completed=done)

        rows = verdicts.measure(tasks, jobs=jobs or -1, progress=show_progress)
    picture, table = (folder / f"stability.{kind}" for kind in ("png", "csv"))
    save_whole(
        {
            picture: stability_figure.picture(rows),
            table: verdicts.csv_text(rows).encode(),
        }
    )
    messages.print(verdicts.summary(rows))
    answer = {
        "picture": str(picture),
        "table": str(table),
        "quick": quick,
        "seconds": round(time.monotonic() - started_s, 1),
        "methods": verdicts.shares(rows),
    }
    print(json.dumps(answer))  # noqa: T201


def ablate(
    out: Annotated[
        Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
    ] = None,
    skins: Annotated[int, typer.Option(min=2, help="simulated skins of a kind")] = Plan.skins,
    frames: Annotated[int, typer.Option(min=2, help="frames of each")] = Plan.frames,
    only: Annotated[
        str, typer.Option(metavar="NAME,...", help="constants: NAME, or MODULE.NAME")
    ] = "",
    jobs: Annotated[int, typer.Option(min=0, help="processes; 0: one a core")] = 0,
) -> None:
    """Halve, double and put off each number in joint and touch, and count what it earns: a CSV.

    Takes half an hour on two cores. Frames of ngspice and simulated ones. The last line printed is
    one JSON object.
    """
    tried = constants_tried.constants()
    if only:
        names = set(only.split(","))
        known = {name for each in tried for name in (each.name, each.label)}
        if names - known:
            raise typer.BadParameter(f"no constant {', '.join(sorted(names - known))}")
        tried = [each for each in tried if names & {each.name, each.label}]
    folder = default_folder() if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    started_s = time.monotonic()
    messages = Console(stderr=True)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as progress:
        task = progress.add_task("constants on sets of frames", total=None)

        def show_progress(done: int, tasks: int) -> None:
            progress.update(task, completed=done, total=tasks)

        plan = Plan(skins, frames)
        rows = constants_tried.measure(tried, plan, jobs=jobs or -1, progress=show_progress)
    table = folder / "ablate.csv"
    save_whole({table: constants_tried.csv_text(rows).encode()})
    messages.print(constants_tried.summary(rows, tried))
    answer = {
        "table": str(table),
        "skins": skins,
        "frames": frames,
        "seconds": round(time.monotonic() - started_s, 1),
        "moved": constants_tried.moved(rows, tried),
    }
    print(json.dumps(answer))  # noqa: T201


def far(
    out: Annotated[
        Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer frames: rough")] = False,
) -> None:
    """Compare lines sensed at both ends with near ends, and with zero potential: a PNG and a CSV.

    Takes minutes on one core. Simulated skins. Tables go to stderr; the last line printed is one
    JSON object.
    """
    chart_figure.require_matplotlib()
    folder = default_folder() if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    started_s = time.monotonic()
    messages = Console(stderr=True)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as progress:
        task = progress.add_task("conditions", total=None)

        def show_progress(done: int, conditions: int) -> None:
            progress.update(task, completed=done, total=conditions)

        rows = far_ends.measure(far_ends.QUICK if quick else far_ends.FULL, show_progress)
    picture, table = (folder / f"far-ends.{kind}" for kind in ("png", "csv"))
    save_whole({picture: far_figure.picture(rows), table: far_ends.csv_text(rows).encode()})
    messages.print(far_ends.tables(rows), markup=False, highlight=False, soft_wrap=True)
    answer = {
        "picture": str(picture),
        "table": str(table),
        "quick": quick,
        "seconds": round(time.monotonic() - started_s, 1),
    }
    print(json.dumps(answer))  # noqa: T201
