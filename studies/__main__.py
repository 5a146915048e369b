# SPDX-License-Identifier: Apache-2.0
"""``python -m studies``: chart, stability, ablate and the paper's experiments, as commands."""

from __future__ import annotations

import typer

from ohmskin.cli.main import run
from studies.commands import ablate, chart, experiment, far, stability

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Simulated skins: time against error, where methods fail, the paper's experiments.",
)
app.command()(chart)
app.command()(stability)
app.command()(ablate)
app.command()(far)
app.add_typer(experiment, name="experiment")

if __name__ == "__main__":
    run(app, "studies")
