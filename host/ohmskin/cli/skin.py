# SPDX-License-Identifier: Apache-2.0
"""``ohmskin skin``: what a calibration file holds, and where the cells of its skin are."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from typer import Argument, Option

from ohmskin.cli.board import TERMINAL
from ohmskin.files import check_place, whole_file
from ohmskin.force.calibration import load_calibration
from ohmskin.force.geometry import Geometry

# A picture is so wide and high [points]. Chosen: it fits into a page.
_PICTURE: Final = 480
# It is drawn as seen from beside: z moves a point by this share of it, to the right and up.
_BESIDE: Final = np.array([0.35, -0.35])


def skin(
    file: Annotated[Path, Argument(envvar="OHMSKIN_CALIBRATION", help="calibration file (.json)")],
    pitch_mm: Annotated[
        str, Option(help="from column to column and row to row, in mm: 10,10")
    ] = "",
    radius_mm: Annotated[float, Option(help="columns go round a cylinder, in mm; 0: flat")] = 0.0,
    taxels: Annotated[Path | None, Option(help="a file of taxels: iCub's lines, or URDF")] = None,
    frame: Annotated[str, Option(help="name of the frame of all positions")] = "",
    picture: Annotated[Path | None, Option(help="draw the cells into this file (.svg)")] = None,
) -> None:
    """Show a calibration file; say where its cells are, and draw them."""
    known = load_calibration(file)
    placed, frame = known.geometry, frame or (known.geometry.frame_id if known.geometry else "skin")
    if taxels is not None:
        placed = Geometry.of_file(taxels, known.rows, known.columns, frame)
    elif pitch_mm or radius_mm:
        if not re.fullmatch(r"[\d.]+,[\d.]+", pitch_mm):
            raise ValueError(f"--pitch-mm wants two numbers, as 10,10, not '{pitch_mm}'")
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
    if placed is None:
        TERMINAL.print("nobody has said where the cells are: --pitch-mm 10,10 does")
        return
    corners = (placed.position_m[0, 0], placed.position_m[-1, -1])
    first, last = (", ".join(f"{1e3 * metres:.1f}" for metres in at_m) for at_m in corners)
    TERMINAL.print(f"{placed.kind}, in '{placed.frame_id}': from ({first}) to ({last}) mm")
    if picture is not None:
        check_place(picture, file)
        with whole_file(picture) as out:
            out.write(_drawn(placed).encode())


def _drawn(placed: Geometry) -> str:
    """An SVG of all cells, each with its normal and its row and column."""
    feet, tips = (
        at_m[..., :2] * [1, -1] + at_m[..., 2:] * _BESIDE
        for at_m in (placed.position_m, placed.position_m + 5e-3 * placed.normal)
    )
    low, high = np.minimum(feet, tips).min((0, 1)), np.maximum(feet, tips).max((0, 1))
    scale = 0.9 * _PICTURE / max((high - low).max(), 1e-9)
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{_PICTURE}" height="{_PICTURE}">']
    for cell in np.ndindex(feet.shape[:2]):
        (x, y), (u, v) = (scale * (ends[cell] - low) + 0.05 * _PICTURE for ends in (feet, tips))
        parts.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="red"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2"/>')
        parts.append(f'<text x="{x + 3:.1f}" y="{y:.1f}" font-size="7">{cell[0]},{cell[1]}</text>')
    return "\n".join([*parts, "</svg>\n"])
