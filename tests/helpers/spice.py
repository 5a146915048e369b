# SPDX-License-Identifier: Apache-2.0
"""Skins as netlists, solved by ngspice. Nothing here imports `ohmskin`: a second opinion.

Every cell is two circuits, one for each direction of the current, in one netlist: instances of one
subcircuit. Electrodes that are not selected float.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESULT_FILE = "readings.txt"


def resistors(cell_ohm: Array, top_ohm: Array, bottom_ohm: Array, end: str = "") -> list[str]:
    """Lines of a skin's cells, inf if open, and wires (R, C) [ohm]; `end` is added to each name."""
    lines = []
    for i, j in np.ndindex(*cell_ohm.shape):
        cell = f"{i}_{j}{end}"
        before_top = f"t{i}_{j - 1}{end}" if j else f"row{i}{end}"
        before_bottom = f"b{i - 1}_{j}{end}" if i else f"column{j}{end}"
        lines += [
            f"rt{cell} {before_top} t{cell} {top_ohm[i, j]:.17g}",
            f"rb{cell} {before_bottom} b{cell} {bottom_ohm[i, j]:.17g}",
        ]
        if np.isfinite(cell_ohm[i, j]):
            lines.append(f"rc{cell} t{cell} b{cell} {cell_ohm[i, j]:.17g}")
    return lines


def solved(
    cell_ohm: Array,
    top_ohm: Array,
    bottom_ohm: Array,
    ref_ohm: Sequence[float] = (30e3, 30e3),
    lead_ohm: Array | None = None,
) -> Array:
    """Readings a to h of every cell, (R, C, 8), with these references at rows and columns.

    lead_ohm: in front of each line, rows first (R+C,), all > 0; None: nothing is there.
    """
    rows, columns = cell_ohm.shape
    near = [f"row{i}" for i in range(rows)] + [f"column{j}" for j in range(columns)]
    far = [f"t{i}_{columns - 1}" for i in range(rows)]
    far += [f"b{rows - 1}_{j}" for j in range(columns)]
    ports, sensed = [], []
    for i, j in np.ndindex(rows, columns):
        for direction, top_end, bottom_end in (("ab", "vdd", "0"), ("cd", "0", "vdd")):
            port = f"{direction}{i}_{j}"
            ends = [f"{name}{port}" for name in near + far]
            if lead_ohm is not None:
                for line in (i, rows + j):
                    behind = f"behind_{ends[line]}"
                    ports.append(f"rl{ends[line]} {ends[line]} {behind} {lead_ohm[line]:.17g}")
                    ends[line] = behind
            ports += [
                f"rt{port} {top_end} row{i}{port} {ref_ohm[0]:.17g}",
                f"rb{port} {bottom_end} column{j}{port} {ref_ohm[1]:.17g}",
                f"x{port} {' '.join(ends)} skin",
            ]
        a, c = f"ab{i}_{j}", f"cd{i}_{j}"
        far_row, far_column = far[i], far[rows + j]
        sensed += [f"row{i}{a}", f"column{j}{a}", f"column{j}{c}", f"row{i}{c}"]
        sensed += [far_row + a, far_column + a, far_column + c, far_row + c]
    inside = resistors(cell_ohm, top_ohm, bottom_ohm)
    lines = [f".subckt skin {' '.join(near + far)}", *inside, ".ends", "vdd vdd 0 1", *ports]
    return run_ngspice(lines, [f"v({node})" for node in sensed]).reshape(rows, columns, 8)


def run_ngspice(lines: Sequence[str], wanted: Sequence[str]) -> Array:
    """The wanted vectors at the operating point of a netlist, (n,)."""
    control = [".control", "set numdgt=15", "set wr_singlescale", "op"]
    control += [f"wrdata {RESULT_FILE} {' '.join(wanted)}", ".endc", ".end", ""]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "skin.cir").write_text("\n".join(["a skin", *lines, *control]))
        command = ["ngspice", "-n", "-b", "skin.cir"]
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
        if not (folder / RESULT_FILE).exists():
            raise RuntimeError(f"ngspice wrote no result: {run.stdout}{run.stderr}")
        # The first number is the scale, of which an operating point has none.
        return np.loadtxt(folder / RESULT_FILE)[1:]
