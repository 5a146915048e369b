# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate``: with a force sensor, with weights, from a recording, from a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ohmskin
from ohmskin.calibrate.press_table import load_press_table
from ohmskin.cli.calibrate_live import sensor, weights
from ohmskin.cli.calibrate_parts import (
    DEFAULT_METHOD,
    BottomWire,
    Indenter,
    Method,
    Out,
    Port,
    TopWire,
    Wanted,
    from_recording,
    from_table,
)
from ohmskin.force.reader import TARE_S

calibrate = typer.Typer(
    no_args_is_help=True,
    help="Learn each cell's force from presses of single cells: a calibration file (.json).",
)
calibrate.command()(weights)
calibrate.command()(sensor)


@calibrate.command()
def recording(
    recording: Annotated[Path, typer.Argument(help="recording (.mcap) of presses of single cells")],
    out: Out,
    indenter_mm2: Indenter,
    forces: Annotated[
        Path | None,
        typer.Option(help="force sensor's log (.csv: time_s, force_n); default: the recording's"),
    ] = None,
    rest_s: Annotated[
        float,
        typer.Option("--rest", help="so long nothing touched the skin at first, in s; 0: its tare"),
    ] = 0.0,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a recording of presses, and a force sensor's log of the same time.

    The two clocks may differ: they are aligned by what both saw.
    """
    wanted = Wanted(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    from_recording(wanted, recording, forces, rest_s)


@calibrate.command()
def table(
    port: Port,
    table: Annotated[Path, typer.Argument(help="row,column,force_n,conductance (.csv)")],
    out: Out,
    indenter_mm2: Indenter,
    rest_s: Annotated[
        float, typer.Option("--rest", help="so long the untouched skin is measured, in s")
    ] = TARE_S,
    method: Method = DEFAULT_METHOD,
    top_wire_ohm: TopWire = None,
    bottom_wire_ohm: BottomWire = None,
) -> None:
    """From a table of presses (conductance in siemens), and the untouched skin at PORT."""
    wanted = Wanted(out, method, indenter_mm2, top_wire_ohm, bottom_wire_ohm)
    rows = load_press_table(table)
    with ohmskin.open(port) as skin:
        bench = wanted.bench(skin.info, skin.mean_ratio(rest_s))
    from_table(bench, rows, table, out)
