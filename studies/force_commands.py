# SPDX-License-Identifier: Apache-2.0
"""`python -m studies experiment`: the paper's experiments with force, on simulated skins."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from studies import chart_figure, force_experiment, force_figure, force_limits, force_table
from studies.commands import default_folder as default_folder
from studies.commands import save_whole

experiment = typer.Typer(
    help="The paper's experiments with force, on simulated skins.", no_args_is_help=True
)

Out = Annotated[
    Path | None, typer.Option(help="folder to write to: else docs of a checkout, or here")
]
Quick = Annotated[bool, typer.Option("--quick", help="fewer skins and frames: rough, in seconds")]
Json = Annotated[bool, typer.Option("--json", help="no tables and no progress bar: JSON alone")]
_TABLE_WIDTH: Final = 128  # where stderr is a file, tables are not cut to 80 columns
QUICK_DETECTION: Final = force_limits.Detection(seeds=1, empty_frames=100, frames=40, forces=8)


@experiment.command()
def flat(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """Calibrate with single touches, test with several: a PNG. About two minutes.

    Errors of force of all methods on a flat skin. The last line printed is one JSON object.
    """
    _surface(_Run("force-flat.png", out, quick, only_json), curved=False)


@experiment.command()
def curved(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """The same, but the wires of the skin change between calibration and test: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    _surface(_Run("force-curved.png", out, quick, only_json), curved=True)


@experiment.command()
def timeseries(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """Four seconds of one press, and what the other cells show meanwhile: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    run = _Run("force-timeseries.png", out, quick, only_json)
    with run.progress() as show:
        trial, rows = force_limits.cross_talk(1 if quick else 8, 0 if quick else 2, show)
    run.finish(
        force_figure.series_picture(trial),
        [force_table.talk_table(rows)],
        {"cross_talk": [asdict(row) for row in rows]},
    )


@experiment.command()
def minimum(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """The smallest force told from none, alone and beside two touches of 1 N: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    run = _Run("force-minimum.png", out, quick, only_json)
    with run.progress() as show:
        plan = QUICK_DETECTION if quick else force_limits.Detection()
        rows = force_limits.smallest_forces(plan, show)
    run.finish(
        force_figure.smallest_picture(rows),
        [force_table.smallest_table(rows)],
        {"smallest_forces": [asdict(row) for row in rows]},
    )


@dataclass
class _Run:
    """One command: where it writes, and what it says."""

    name: str
    out: Path | None
    quick: bool
    only_json: bool

    def __post_init__(self) -> None:
        chart_figure.require_matplotlib()
        self._folder = default_folder() if self.out is None else self.out
        self._folder.mkdir(parents=True, exist_ok=True)
        wide = Console(stderr=True).width
        self._messages = Console(stderr=True, width=max(wide, _TABLE_WIDTH))
        self._started_s = time.monotonic()

    @contextmanager
    def progress(self) -> Iterator[force_experiment.Progress]:
        shown = self._messages.is_terminal and not self.only_json
        with Progress(console=self._messages, transient=True, disable=not shown) as bar:
            task = bar.add_task("steps", total=None)
            yield lambda done, steps: bar.update(task, completed=done, total=steps)

    def finish(self, picture: bytes, tables: list[Table], answer: dict[str, Any]) -> None:
        path = self._folder / self.name
        save_whole({path: picture})
        if not self.only_json:
            for table in tables:
                self._messages.print(table)
        heading = {
            "simulated": True,
            "picture": str(path),
            "quick": self.quick,
            "seconds": round(time.monotonic() - self._started_s, 1),
        }
        print(json.dumps({**heading, **answer}, allow_nan=False))  # noqa: T201


def _surface(run: _Run, *, curved: bool) -> None:
    plan = force_experiment.QUICK if run.quick else force_experiment.FULL
    with run.progress() as show:
        rows = force_experiment.measure(plan, curved=curved, progress=show)
    run.finish(
        force_figure.surface_picture(rows),
        force_table.surface_tables(rows),
        {"best": force_table.best_of_ours(rows), "rows": [asdict(row) for row in rows]},
    )
