# SPDX-License-Identifier: Apache-2.0
"""Studies as commands of the command line: the answer on stdout, everything else on stderr."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

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

Out = Annotated[
    Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
]
Jobs = Annotated[int, typer.Option(min=0, help="processes; 0: one a core")]


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


class StudyRun:
    """One command: where it writes, what it says on stderr, and its answer.

    is_quiet: neither a progress bar nor `messages`. least_width: of these, where stderr is a file.
    """

    def __init__(
        self, out: Path | None, *, draws: bool = True, is_quiet: bool = False, least_width: int = 0
    ) -> None:
        if draws:
            chart_figure.require_matplotlib()
        self._folder = default_folder() if out is None else out
        self._folder.mkdir(parents=True, exist_ok=True)
        self._started_s = time.monotonic()
        self._written: dict[str, str] = {}
        self.messages = Console(stderr=True, quiet=is_quiet)
        self.messages.width = max(self.messages.width, least_width)

    @contextmanager
    def progress(self, what: str, redraws_hz: float = 10.0) -> Iterator[Callable[[int, int], None]]:
        """A function that shows how many are done, and how many there are."""
        hidden = self.messages.quiet or not self.messages.is_terminal
        with Progress(
            console=self.messages, transient=True, disable=hidden, refresh_per_second=redraws_hz
        ) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write all of these pictures (.png) and tables (.csv), by name, or none."""
        paths = {self._folder / name: content for name, content in files.items()}
        save_whole(paths)
        kinds = {".png": "picture", ".csv": "table"}
        self._written = {kinds[path.suffix]: str(path) for path in paths}

    def answer(self, asked: dict[str, Any], **found: Any) -> None:
        """Print the answer: what was written, asked and found."""
        seconds = round(time.monotonic() - self._started_s, 1)
        answer = {**self._written, **asked, "seconds": seconds, **found}
        print(json.dumps(answer, allow_nan=False))  # noqa: T201


def chart(
    out: Out = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="fewer frames: rough, in a minute")
    ] = False,
) -> None:
    """Measure time a frame against error, of all methods on simulated skins: a PNG and a CSV.

    Takes a few minutes on one core. The last line printed is one JSON object.
    """
    run = StudyRun(out)
    plan = speed_accuracy.QUICK if quick else speed_accuracy.FULL
    # Redrawn seldom, because the bar's thread runs beside what is being timed.
    with run.progress("frames", redraws_hz=2) as show:
        rows = speed_accuracy.measure(plan, show)
    run.write(
        {
            "speed-accuracy.png": chart_figure.picture(rows, _machine()),
            "speed-accuracy.csv": chart_table.csv_text(rows).encode(),
        }
    )
    run.messages.print(chart_table.summary(rows))
    run.answer({"quick": quick}, fronts=chart_table.fronts(rows))


def stability(
    out: Out = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="fewer frames, smaller skins: rough, in a minute")
    ] = False,
    jobs: Jobs = 0,
) -> None:
    """Count where methods are wrong and do not say so, under faults and extremes: a PNG and a CSV.

    Takes minutes. Simulated skins; the verdicts do not depend on --jobs. The last line printed is
    one JSON object.
    """
    run = StudyRun(out)
    tasks = verdicts.tasks_of(verdicts.QUICK if quick else verdicts.FULL)
    with run.progress("skins") as show:
        rows = verdicts.measure(tasks, jobs=jobs or -1, progress=show)
    run.write(
        {
            "stability.png": stability_figure.picture(rows),
            "stability.csv": verdicts.csv_text(rows).encode(),
        }
    )
    run.messages.print(verdicts.summary(rows))
    run.answer({"quick": quick}, methods=verdicts.shares(rows))


def ablate(
    out: Out = None,
    skins: Annotated[int, typer.Option(min=2, help="simulated skins of a kind")] = Plan.skins,
    frames: Annotated[int, typer.Option(min=2, help="frames of each")] = Plan.frames,
    only: Annotated[
        str, typer.Option(metavar="NAME,...", help="constants: NAME, or MODULE.NAME")
    ] = "",
    jobs: Jobs = 0,
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
    run = StudyRun(out, draws=False)
    with run.progress("constants on sets of frames") as show:
        plan = Plan(skins, frames)
        rows = constants_tried.measure(tried, plan, jobs=jobs or -1, progress=show)
    run.write({"ablate.csv": constants_tried.csv_text(rows).encode()})
    run.messages.print(constants_tried.summary(rows, tried))
    asked = {"skins": skins, "frames": frames}
    run.answer(asked, moved=constants_tried.moved(rows, tried))


def far(
    out: Out = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer frames: rough")] = False,
) -> None:
    """Compare lines sensed at both ends with near ends, and with zero potential: a PNG and a CSV.

    Takes minutes on one core. Simulated skins. Tables go to stderr; the last line printed is one
    JSON object.
    """
    run = StudyRun(out)
    with run.progress("conditions") as show:
        rows = far_ends.measure(far_ends.QUICK if quick else far_ends.FULL, show)
    run.write(
        {
            "far-ends.png": far_figure.picture(rows),
            "far-ends.csv": far_ends.csv_text(rows).encode(),
        }
    )
    run.messages.print(far_ends.tables(rows), markup=False, highlight=False, soft_wrap=True)
    run.answer({"quick": quick})
