# SPDX-License-Identifier: Apache-2.0
"""``ohmskin tare``: a tare that lasts, in the calibration file."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

import ohmskin
from ohmskin.force.reader import TARE_S

_out = Console(soft_wrap=True)


def tare(
    port: Annotated[str, typer.Argument(help="serial port or URL; 'ohmskin ports' lists them")],
    calibration: Annotated[Path, typer.Argument(help="calibration file (.json), to be changed")],
    seconds: Annotated[
        float, typer.Option(help="so long nothing touches the skin, in seconds")
    ] = TARE_S,
    undo: Annotated[
        bool, typer.Option("--undo", help="return to the rest of the calibration")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="even if cells seem touched: rest has drifted")
    ] = False,
) -> None:
    """Take what the skin at PORT reads now for no force, from now on: nothing may touch it.

    Is refused while something does. The rest that was calibrated is kept, for --undo.
    """
    with ohmskin.open(port, calibration=calibration) as skin:
        if undo:
            skin.undo_tare()
        else:
            before_n = skin.latest().force_n
            skin.tare(seconds, force=force)
        skin.calibration.save(calibration)
    if undo:
        _out.print(f"{calibration}: rest of {skin.calibration.rest.date}", markup=False)
        return
    shift_n = abs(before_n).max()
    _out.print(f"{calibration}: tared, largest force before it {shift_n:.3f} N", markup=False)
