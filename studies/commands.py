# SPDX-License-Identifier: Apache-2.0
"""Studies as commands of the command line: the answer on stdout, everything else on stderr."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import Progress

from ohmskin.files import whole_file
from studies import ablate as constants_tried
from studies import chart as speed_accuracy
from studies import chart_figure, force_experiment, force_figure, force_kneading, force_limits
from studies import far as far_ends
from studies import stability as verdicts
from studies.ablate_scenes import Plan
from studies.rows import Progress as ShowProgress

DOCS: Final = Path(__file__).parents[1] / "docs"
Out = Annotated[Path, typer.Option(help="folder to write to", show_default="docs")]
Jobs = Annotated[int, typer.Option(min=0, help="processes; 0: one a core")]
QuickExperiment = Annotated[
    bool, typer.Option("--quick", help="fewer skins and frames: rough, in seconds")
]
Json = Annotated[bool, typer.Option("--json", help="no tables and no progress bar: JSON alone")]
# Where stderr is a file, tables of forces are cut to so many columns, not to 80: they need that.
_TABLE_WIDTH: Final = 128
QUICK_DETECTION: Final = force_limits.Detection(seeds=1, empty_frames=100, frames=40, forces=8)

experiment = typer.Typer(
    help="The paper's experiments with force, on simulated skins.", no_args_is_help=True
)


def _machine() -> str:
    """The processor that the times are of, as far as the system tells."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "an unknown processor"


class StudyRun:
    """One command: where it writes, what it says on stderr, and its answer.

    is_quiet: whether it shows neither a progress bar nor `messages`.
    least_width: columns of the messages, where stderr is a file.
    """

    def __init__(self, out: Path, *, is_quiet: bool = False, least_width: int = 0) -> None:
        self._folder = out
        self._folder.mkdir(parents=True, exist_ok=True)
        self._started_s = time.monotonic()
        self._written: dict[str, str] = {}
        self.messages = Console(stderr=True, quiet=is_quiet)
        self.messages.width = max(self.messages.width, least_width)

    @contextmanager
    def progress(self, what: str, redraws_hz: float = 10.0) -> Iterator[ShowProgress]:
        """A function that shows how many are done, and how many there are."""
        hidden = self.messages.quiet or not self.messages.is_terminal
        with Progress(
            console=self.messages, transient=True, disable=hidden, refresh_per_second=redraws_hz
        ) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)

    def write(self, name: str, *, picture: bytes = b"", table: str = "") -> None:
        """Write the picture NAME.png and the table NAME.csv, as far as there are any, or none."""
        contents = {"picture": (".png", picture), "table": (".csv", table.encode())}
        with ExitStack() as stack:
            for kind, (suffix, content) in contents.items():
                if content:
                    path = self._folder / f"{name}{suffix}"
                    file = stack.enter_context(whole_file(path))
                    file.write(content)
                    file.flush()
                    self._written[kind] = str(path)

    def answer(self, asked: dict[str, Any], **figures: Any) -> None:
        """Print the answer: what was written, what was asked, and the figures."""
        seconds = round(time.monotonic() - self._started_s, 1)
        answer = {**self._written, **asked, "seconds": seconds, **figures}
        print(json.dumps(answer, allow_nan=False))  # noqa: T201


def chart(
    out: Out = DOCS,
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
    picture = chart_figure.picture(rows, _machine())
    run.write("speed-accuracy", picture=picture, table=speed_accuracy.csv_text(rows))
    run.answer({"quick": quick})


def stability(
    out: Out = DOCS,
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
    run.write("stability", picture=verdicts.picture(rows), table=verdicts.csv_text(rows))
    run.answer({"quick": quick}, methods=verdicts.shares(rows))


def ablate(
    out: Out = DOCS,
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
        unknown = names - {name for constant in tried for name in (constant.name, constant.label)}
        if unknown:
            raise typer.BadParameter(f"no constant {', '.join(sorted(unknown))}")
        tried = [constant for constant in tried if names & {constant.name, constant.label}]
    run = StudyRun(out)
    with run.progress("constants on sets of frames") as show:
        rows = constants_tried.measure(tried, Plan(skins, frames), jobs=jobs or -1, progress=show)
    run.write("ablate", table=constants_tried.csv_text(rows))
    run.messages.print(constants_tried.summary(rows, tried))
    run.answer({"skins": skins, "frames": frames})


def far(
    out: Out = DOCS,
    quick: Annotated[bool, typer.Option("--quick", help="fewer frames: rough")] = False,
) -> None:
    """Compare lines sensed at both ends with near ends, and with zero potential: a PNG and a CSV.

    Takes minutes on one core. Simulated skins. Tables go to stderr; the last line printed is one
    JSON object.
    """
    run = StudyRun(out)
    with run.progress("conditions") as show:
        rows = far_ends.measure(far_ends.QUICK if quick else far_ends.FULL, show)
    run.write("far-ends", picture=far_ends.picture(rows), table=far_ends.csv_text(rows))
    run.messages.print(far_ends.tables(rows), markup=False, highlight=False, soft_wrap=True)
    run.answer({"quick": quick})


# ------------------------------------------------------------------------ experiments with force


@experiment.command()
def flat(out: Out = DOCS, quick: QuickExperiment = False, only_json: Json = False) -> None:
    """Calibrate with single touches, test with several: a PNG. About two minutes.

    Errors of force of all methods on a flat skin. The last line printed is one JSON object.
    """
    _surface(_run(out, only_json), "flat", quick)


@experiment.command()
def curved(out: Out = DOCS, quick: QuickExperiment = False, only_json: Json = False) -> None:
    """The same, but the wires of the skin change between calibration and test: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    _surface(_run(out, only_json), "curved", quick)


@experiment.command()
def kneaded(out: Out = DOCS, quick: QuickExperiment = False, only_json: Json = False) -> None:
    """The same skins kneaded over a scale, beside single touches: a PNG. About three minutes.

    The last line printed is one JSON object.
    """
    run = _run(out, only_json)
    with run.progress("steps") as show:
        plan = force_kneading.QUICK if quick else force_kneading.FULL
        rows = force_kneading.measure(*plan, show)
    run.write("force-kneaded", picture=force_figure.kneading_picture(rows))
    run.messages.print(force_kneading.kneading_table(rows))
    run.answer(_asked(quick), rows=[row.figures() for row in rows])


@experiment.command()
def timeseries(out: Out = DOCS, quick: QuickExperiment = False, only_json: Json = False) -> None:
    """Four seconds of one press, and what the other cells show meanwhile: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    run = _run(out, only_json)
    with run.progress("steps") as show:
        trial, rows = force_limits.cross_talk(1 if quick else 8, 0 if quick else 2, show)
    run.write("force-timeseries", picture=force_figure.series_picture(trial))
    run.messages.print(force_limits.talk_table(rows))
    run.answer(_asked(quick), cross_talk=[asdict(row) for row in rows])


@experiment.command()
def minimum(out: Out = DOCS, quick: QuickExperiment = False, only_json: Json = False) -> None:
    """The smallest force told from none, alone and beside two touches of 1 N: a table.

    About two minutes. The last line printed is one JSON object.
    """
    run = _run(out, only_json)
    with run.progress("steps") as show:
        plan = QUICK_DETECTION if quick else force_limits.Detection()
        rows = force_limits.smallest_forces(plan, show)
    run.messages.print(force_limits.smallest_table(rows))
    run.answer(_asked(quick), smallest_forces=[asdict(row) for row in rows])


def _run(out: Path, only_json: bool) -> StudyRun:
    return StudyRun(out, is_quiet=only_json, least_width=_TABLE_WIDTH)


def _asked(quick: bool) -> dict[str, Any]:
    return {"simulated": True, "quick": quick}


def _surface(run: StudyRun, surface: str, quick: bool) -> None:
    plan = force_experiment.QUICK if quick else force_experiment.FULL
    with run.progress("steps") as show:
        rows = force_experiment.measure(plan, curved=surface == "curved", progress=show)
    run.write(f"force-{surface}", picture=force_figure.surface_picture(rows))
    for table in force_experiment.surface_tables(rows):
        run.messages.print(table)
    run.answer(_asked(quick), rows=[asdict(row) for row in rows])
