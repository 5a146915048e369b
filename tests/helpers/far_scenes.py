#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw skins whose lines are sensed at both ends, let ngspice solve them: tests/data/far/*.npz.

python tests/helpers/far_scenes.py    write the files again; takes ten minutes

Nothing here imports `ohmskin`: scenes, circuit and readings are a second opinion.
tests/data/README.md describes the files. In each netlist a cell of the skin is two circuits, one
for each direction of the current, and all circuits are instances of one subcircuit.
"""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parents[1] / "data" / "far"
NAMES = "abcdefgh"
REF_OHM = 30e3
REST_OHM = 1e6
SPREAD = 0.1  # standard deviation of the log of rest resistances and wire segments
TOUCH_OHM = (1e3, 1e5)  # log-uniform
MOST_TOUCHES = 8
FINGER_CELLS = (0.75, 0.9)  # standard deviation of a fingertip's pressure
FINGER_SIEMENS = (3e-5, 1.5e-4)  # its peak in each frame, log-uniform
FRAMES = 40
SEED = 20_261_122
STEP = 2.0**-30  # what readings in the files are rounded to: 1e-9 of Vdd
RESULT_FILE = "readings.txt"


@dataclass(frozen=True)
class Kind:
    """Two skins of one kind: rows, columns, and the wires of each, a segment of a row, a column."""

    shape: tuple[int, int]
    wire_ohm: tuple[tuple[float, float], tuple[float, float]]
    finger: bool = False


KINDS = {
    "random_8x8": Kind((8, 8), ((100, 200), (150, 300))),
    "random_5x9": Kind((5, 9), ((200, 100), (300, 150))),
    "harsh_8x8": Kind((8, 8), ((1000, 2000), (1200, 2400))),
    "finger_8x8": Kind((8, 8), ((100, 200), (100, 200)), finger=True),
}


# -------------------------------------------------------------------------------------- scenes


def skin(kind: Kind, number: int) -> tuple[Array, Array, Array, Array]:
    """Cells of all frames (F, R, C), at rest (R, C), segments of rows and columns (R, C) [ohm]."""
    random = np.random.default_rng([SEED, list(KINDS.values()).index(kind), number])
    rest_ohm, top_ohm, bottom_ohm = (
        middle * np.exp(SPREAD * random.standard_normal(kind.shape))
        for middle in (REST_OHM, *kind.wire_ohm[number])
    )
    draw = finger if kind.finger else touches
    return draw(rest_ohm, random), rest_ohm, top_ohm, bottom_ohm


def touches(rest_ohm: Array, random: np.random.Generator) -> Array:
    """0 to 8 touches in each frame, at random places."""
    cell_ohm = np.repeat(rest_ohm[None], FRAMES, axis=0)
    for cells in cell_ohm:
        count = random.integers(0, MOST_TOUCHES + 1)
        places = random.choice(cells.size, count, replace=False)
        cells.flat[places] = np.exp(random.uniform(*np.log(TOUCH_OHM), count))
    return cell_ohm


def finger(rest_ohm: Array, random: np.random.Generator) -> Array:
    """A soft fingertip on a circle, the first tenth of the frames untouched."""
    rows, columns = rest_ohm.shape
    row, column = np.indices(rest_ohm.shape)
    sigma = random.uniform(*FINGER_CELLS)
    start, radius = random.uniform(0, 2 * np.pi), random.uniform(1.2, 2.0)
    siemens = np.repeat(1 / rest_ohm[None], FRAMES, axis=0)
    for number in range(FRAMES // 10, FRAMES):
        angle = start + 2 * np.pi * number / FRAMES
        peak = np.exp(random.uniform(*np.log(FINGER_SIEMENS)))
        away = (row - (rows - 1) / 2 - radius * np.cos(angle)) ** 2
        away = away + (column - (columns - 1) / 2 - radius * np.sin(angle)) ** 2
        siemens[number] += peak * np.exp(-away / (2 * sigma**2))
    return np.asarray(1 / siemens)


# ------------------------------------------------------------------------------------- ngspice


def netlist(cell_ohm: Array, top_ohm: Array, bottom_ohm: Array) -> str:
    """SPICE that writes readings a to h of every cell, in the order of (R, C, 8); Vdd is 1 V."""
    rows, columns = cell_ohm.shape
    inside, ports, sensed = [], [], []
    for i in range(rows):
        for j in range(columns):
            cell = f"{i}_{j}"
            before_top = f"t{i}_{j - 1}" if j else f"row{i}"
            before_bottom = f"b{i - 1}_{j}" if i else f"column{j}"
            inside += [
                f"rt{cell} {before_top} t{cell} {top_ohm[i, j]:.17g}",
                f"rb{cell} {before_bottom} b{cell} {bottom_ohm[i, j]:.17g}",
                f"rc{cell} t{cell} b{cell} {cell_ohm[i, j]:.17g}",
            ]
    near = [f"row{i}" for i in range(rows)] + [f"column{j}" for j in range(columns)]
    far = [f"t{i}_{columns - 1}" for i in range(rows)] + [
        f"b{rows - 1}_{j}" for j in range(columns)
    ]
    for i in range(rows):
        for j in range(columns):
            for direction, top_end, bottom_end in (("ab", "vdd", "0"), ("cd", "0", "vdd")):
                port = f"{direction}{i}_{j}"
                ends = [f"{name}{port}" for name in near + far]
                ports += [
                    f"rt{port} {top_end} row{i}{port} {REF_OHM:.17g}",
                    f"rb{port} {bottom_end} column{j}{port} {REF_OHM:.17g}",
                    f"x{port} {' '.join(ends)} skin",
                ]
            a, c = f"ab{i}_{j}", f"cd{i}_{j}"
            far_row, far_column = far[i], far[rows + j]
            sensed += [f"row{i}{a}", f"column{j}{a}", f"column{j}{c}", f"row{i}{c}"]
            sensed += [far_row + a, far_column + a, far_column + c, far_row + c]
    vectors = " ".join(f"v({node})" for node in sensed)
    lines = ["all readings of a skin", f".subckt skin {' '.join(near + far)}", *inside, ".ends"]
    lines += ["vdd vdd 0 1", *ports]
    lines += [".control", "set numdgt=15", "set wr_singlescale", "op"]
    lines += [f"wrdata {RESULT_FILE} {vectors}", ".endc", ".end", ""]
    return "\n".join(lines)


def run_ngspice(circuit: str) -> Array:
    """The numbers that a netlist writes to its file."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "skin.cir").write_text(circuit)
        command = ["ngspice", "-n", "-b", "skin.cir"]
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
        if not (folder / RESULT_FILE).exists():
            raise RuntimeError(f"ngspice wrote no result: {run.stdout}{run.stderr}")
        # The first number is the scale, of which an operating point has none.
        return np.loadtxt(folder / RESULT_FILE)[1:]


def solved(cell_ohm: Array, top_ohm: Array, bottom_ohm: Array) -> Array:
    """Readings a to h of one frame, (R, C, 8)."""
    ratio = run_ngspice(netlist(cell_ohm, top_ohm, bottom_ohm)).reshape(*cell_ohm.shape, 8)
    return np.asarray(np.round(ratio / STEP) * STEP)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, kind in KINDS.items():
        for number in range(2):
            cell_ohm, rest_ohm, *wires = skin(kind, number)
            np.savez_compressed(
                FOLDER / f"{name}_{number}.npz",
                ratio=np.array([solved(cells, *wires) for cells in cell_ohm]),
                rest_ratio=solved(rest_ohm, *wires),
                reading_names=np.array(list(NAMES)),
                cell_ohm=cell_ohm,
                rest_ohm=rest_ohm,
                top_wire_ohm=wires[0],
                bottom_wire_ohm=wires[1],
                ref_top_ohm=REF_OHM,
                ref_bottom_ohm=REF_OHM,
            )
            print(f"{name}_{number}", flush=True)


if __name__ == "__main__":
    main()
