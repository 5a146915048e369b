# SPDX-License-Identifier: Apache-2.0
"""``ohmskin skin``: what a calibration file holds, and where the cells of its skin are."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from typer import Argument, Option

from ohmskin.cli.board import TERMINAL, own_leads_in_words
from ohmskin.cli.picture import check_picture, picture
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import load_calibration
from ohmskin.force.geometry import Geometry

_NUMBER: Final = r"(?=[\d.]*[1-9])(\d+\.?\d*|\.\d+)"  # above 0


def skin(
    file: Annotated[Path, Argument(envvar="OHMSKIN_CALIBRATION", help="calibration file (.json)")],
    pitch_mm: Annotated[
        str, Option(help="from column to column and row to row, in mm: 10,10")
    ] = "",
    radius_mm: Annotated[float, Option(help="columns go round a cylinder, in mm; 0: flat")] = 0.0,
    taxels: Annotated[Path | None, Option(help="a file of taxels: iCub's lines, or URDF")] = None,
    frame: Annotated[str, Option(help="name of the frame of all positions")] = "",
    drawing: Annotated[
        Path | None, Option("--picture", help="draw the cells into this file (.svg, .png)")
    ] = None,
) -> None:
    """Show a calibration file; say where its cells are, and draw them."""
    known = load_calibration(file)
    if taxels is not None and (pitch_mm or radius_mm):
        raise ValueError("say either --taxels, or --pitch-mm and --radius-mm")
    if known.geometry is None and (frame or drawing) and not (taxels or pitch_mm or radius_mm):
        raise ValueError("nobody has said where the cells are: say --pitch-mm 10,10, too")
    if drawing is not None:
        check_picture(drawing, file)
    placed, frame = known.geometry, frame or (known.geometry.frame_id if known.geometry else "skin")
    if taxels is not None:
        placed = Geometry.of_file(taxels, known.rows, known.columns, frame)
    elif pitch_mm or radius_mm:
        if not pitch_mm:
            raise ValueError("--radius-mm needs --pitch-mm, too, as 10,10")
        if not re.fullmatch(f"{_NUMBER},{_NUMBER}", pitch_mm):
            raise ValueError(f"--pitch-mm wants two numbers above 0, as 10,10, not '{pitch_mm}'")
        told = {"pitch_m": 1e-3 * np.array([float(mm) for mm in pitch_mm.split(",")])}
        if radius_mm:
            told["radius_m"] = np.array(1e-3 * radius_mm)
        kind = "cylinder" if radius_mm else "flat"
        placed = Geometry(kind, frame, known.rows, known.columns, told)
    elif placed is not None and frame != placed.frame_id:
        placed = replace(placed, frame_id=frame)
    if placed is not known.geometry:
        replace(known, geometry=placed).save(file)
    size, tare = f"{known.rows}x{known.columns} cells", known.tare and f", tared {known.tare.date}"
    TERMINAL.print(f"{file}: unit {known.unit_id}, {size}, mode {known.mode}")
    TERMINAL.print(f"calibrated {known.date} by '{known.method}'{tare or ''}")
    TERMINAL.print(_wires_in_words(known.nominal_wire_ohm))
    if own_leads := own_leads_in_words(known):
        TERMINAL.print(own_leads)
    if placed is None:
        TERMINAL.print("nobody has said where the cells are: --pitch-mm 10,10 does")
        return
    corners = (placed.position_m[0, 0], placed.position_m[-1, -1])
    first, last = (", ".join(f"{1e3 * metres:.1f}" for metres in at_m) for at_m in corners)
    TERMINAL.print(f"{placed.kind}, in '{placed.frame_id}': from ({first}) to ({last}) mm")
    if drawing is not None:
        _draw(drawing, placed)


def _wires_in_words(wires: WireOhm) -> str:
    """Wires and leads, and how well they are known."""

    def known(ohm: float | None, std_ohm: float) -> str:
        if ohm is None:
            return "?"
        return f"{ohm:.0f} +- {std_ohm:.0f}" if std_ohm else f"{ohm:.0f}"

    top = known(wires.top, (wires.top or 0.0) * (wires.top_log_std or 0.0))
    bottom = known(wires.bottom, (wires.bottom or 0.0) * (wires.bottom_log_std or 0.0))
    lead_ohm, lead_std_ohm = wires.lead, wires.lead_std_ohm or 0.0
    lead = known(lead_ohm, lead_std_ohm)
    if lead_ohm is not None and lead_ohm < lead_std_ohm:  # no lead is below 0
        lead = f"up to {lead_ohm + 2 * lead_std_ohm:.0f}"
    return f"wires of {top} (top) and {bottom} (bottom) ohm a segment, leads of {lead} ohm"


def _draw(path: Path, placed: Geometry) -> None:
    """All cells in space, each with its normal and its row and column."""
    with picture(path, (6, 6), placed.frame_id) as figure:
        axes: Any = figure.add_subplot(projection="3d")
        x, y, z = np.moveaxis(1e3 * placed.position_m, -1, 0)
        axes.quiver(x, y, z, *np.moveaxis(placed.normal, -1, 0), length=5, color="red")
        for cell in np.ndindex(x.shape):
            axes.text(x[cell], y[cell], z[cell], "{},{}".format(*cell), fontsize=6)
        axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", zlim=(z.min(), z.max() + 20))
        axes.set_aspect("equal")
