# SPDX-License-Identifier: Apache-2.0
"""`python -m studies experiment`: the paper's experiments with force, on simulated skins."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from studies import force_experiment, force_figure, force_limits, force_table
from studies.commands import Out, StudyRun

experiment = typer.Typer(
    help="The paper's experiments with force, on simulated skins.", no_args_is_help=True
)

Quick = Annotated[bool, typer.Option("--quick", help="fewer skins and frames: rough, in seconds")]
Json = Annotated[bool, typer.Option("--json", help="no tables and no progress bar: JSON alone")]
_TABLE_WIDTH: Final = 128  # where stderr is a file, tables are not cut to 80 columns
QUICK_DETECTION: Final = force_limits.Detection(seeds=1, empty_frames=100, frames=40, forces=8)


@experiment.command()
def flat(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """Calibrate with single touches, test with several: a PNG. About two minutes.

    Errors of force of all methods on a flat skin. The last line printed is one JSON object.
    """
    _surface(_run(out, only_json), "flat", quick)


@experiment.command()
def curved(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """The same, but the wires of the skin change between calibration and test: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    _surface(_run(out, only_json), "curved", quick)


@experiment.command()
def timeseries(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """Four seconds of one press, and what the other cells show meanwhile: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    run = _run(out, only_json)
    with run.progress("steps") as show:
        trial, rows = force_limits.cross_talk(1 if quick else 8, 0 if quick else 2, show)
    run.write({"force-timeseries.png": force_figure.series_picture(trial)})
    run.messages.print(force_table.talk_table(rows))
    run.answer(_asked(quick), cross_talk=[asdict(row) for row in rows])


@experiment.command()
def minimum(out: Out = None, quick: Quick = False, only_json: Json = False) -> None:
    """The smallest force told from none, alone and beside two touches of 1 N: a PNG.

    About two minutes. The last line printed is one JSON object.
    """
    run = _run(out, only_json)
    with run.progress("steps") as show:
        plan = QUICK_DETECTION if quick else force_limits.Detection()
        rows = force_limits.smallest_forces(plan, show)
    run.write({"force-minimum.png": force_figure.smallest_picture(rows)})
    run.messages.print(force_table.smallest_table(rows))
    run.answer(_asked(quick), smallest_forces=[asdict(row) for row in rows])


def _run(out: Path | None, only_json: bool) -> StudyRun:
    return StudyRun(out, is_quiet=only_json, least_width=_TABLE_WIDTH)


def _asked(quick: bool) -> dict[str, Any]:
    return {"simulated": True, "quick": quick}


def _surface(run: StudyRun, surface: str, quick: bool) -> None:
    plan = force_experiment.QUICK if quick else force_experiment.FULL
    with run.progress("steps") as show:
        rows = force_experiment.measure(plan, curved=surface == "curved", progress=show)
    run.write({f"force-{surface}.png": force_figure.surface_picture(rows)})
    for table in force_table.surface_tables(rows):
        run.messages.print(table)
    best = force_table.best_of_ours(rows)
    run.answer(_asked(quick), best=best, rows=[asdict(row) for row in rows])
