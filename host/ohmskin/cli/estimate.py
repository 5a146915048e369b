# SPDX-License-Identifier: Apache-2.0
"""``ohmskin estimate``: every cell of every frame of a readings file."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from ohmskin.estimate.methods import METHODS
from ohmskin.record.readings import estimate_file, load_readings, save_arrays

_out = Console()
_MESSAGES = 8  # of different ones that are printed for a file


def estimate(
    readings: Annotated[Path, typer.Argument(help="readings file (.npz)")],
    method: Annotated[str, typer.Option(help=" | ".join(METHODS))],
    out: Annotated[Path, typer.Option(help="file to write (.npz)")],
    cold: Annotated[bool, typer.Option(help="start every frame afresh")] = False,
) -> None:
    """Estimate every cell of every frame of a readings file."""
    given = load_readings(readings)
    errors = Console(stderr=True)
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task(method, total=len(given.ratio))

        def show_progress(done: int, _: int) -> None:
            progress.update(task, completed=done)

        answers = estimate_file(given, method, cold=cold, progress=show_progress)
    save_arrays(out, answers)
    frames = len(answers["converged"])
    _out.print(
        f"{out}: {frames} frames, {int(answers['converged'].sum())} converged, "
        f"median {1e3 * float(np.median(answers['seconds'])):.2f} ms a frame"
    )
    for message, count in Counter(answers["message"].tolist()).most_common(_MESSAGES):
        if message:
            _out.print(f"  {count} of {frames}: {message}")
