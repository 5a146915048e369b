#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw skins whose lines are sensed at both ends, let ngspice solve them: tests/data/far/*.npz.

python tests/helpers/far_scenes.py    write the files again; takes ten minutes

Nothing here imports `ohmskin`: scenes, circuit and readings are a second opinion.
tests/data/README.md describes the files. In each netlist a cell of the skin is two circuits, one
for each direction of the current, and all circuits are instances of one subcircuit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spice import Array, solved  # beside this file

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


def rounded(cell_ohm: Array, top_ohm: Array, bottom_ohm: Array) -> Array:
    """Readings a to h of one frame, (R, C, 8), as the files have them."""
    return np.asarray(np.round(solved(cell_ohm, top_ohm, bottom_ohm) / STEP) * STEP)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, kind in KINDS.items():
        for number in range(2):
            cell_ohm, rest_ohm, *wires = skin(kind, number)
            np.savez_compressed(
                FOLDER / f"{name}_{number}.npz",
                ratio=np.array([rounded(cells, *wires) for cells in cell_ohm]),
                rest_ratio=rounded(rest_ohm, *wires),
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
