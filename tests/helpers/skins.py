# SPDX-License-Identifier: Apache-2.0
"""What a board would read of a skin, and what is told of the skin, for several test files."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READINGS_PER_CELL
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.faults import joined_readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.record.readings import Readings, load_readings
from places import DATA


def ten_bits(ratio: Float) -> Float:
    """Readings as a converter of 10 bits gives them."""
    return ratio_from_codes(quantise(ratio))


def uniform_skin(
    shape: tuple[int, int], cell_siemens: float = 1e-6, wire_ohm: Sequence[float] = (100.0, 200.0)
) -> Skin:
    """A skin whose cells are all alike, and so are the segments of a layer."""
    cell, top, bottom = (np.full(shape, value) for value in (cell_siemens, *wire_ohm))
    return Skin(cell, top, bottom)


def reference(name: str, bits: int | None = 10) -> tuple[Readings, dict[str, Float]]:
    """Readings of a file of tests/data, exact (None) or in 10 bits, and all that the file has.

    It has no leads, which is told.
    """
    exact = replace(load_readings(DATA / f"{name}.npz"), nominal_lead_ohm=np.array(0.0))
    with np.load(DATA / f"{name}.npz", allow_pickle=False) as file:
        arrays = dict(file)
    if bits is None:
        return exact, arrays
    ratio, rest_ratio = ten_bits(arrays["ratio"]), ten_bits(arrays["rest_ratio"])
    return replace(exact, ratio=ratio, rest_ratio=rest_ratio, adc_bits=bits), arrays


def told(rest_ratio: Float, *, wires: bool = True) -> SkinKnowledge:
    """Knowledge of a board of 10 bits: exact rest readings, no leads, perhaps wires."""
    return SkinKnowledge(
        *rest_ratio.shape[:2],
        adc_bits=10,
        rest_ratio=ten_bits(rest_ratio),
        nominal_wire_ohm=WireOhm(*(100.0, 200.0) * wires, lead=0.0),
    )


# Readings of each pass of a scan, by mode, as frames.toml says.
PASSES = {"near": ((0, 1), (2, 3)), "far": ((0, 1), (2, 3)), "half": ((0, 1),), "quick": ((0,),)}


def scan_order(rows: int, columns: int, mode: str = "near") -> list[tuple[int, int, int]]:
    """Row, column and reading of the codes of a scan, one after the other, as frames.toml says."""
    cells = [(row, column) for column in range(columns) for row in range(rows)]
    return [(*cell, n) for readings in PASSES[mode] for cell in cells for n in readings]


def placed(in_order: list[int], rows: int, columns: int, mode: str = "near") -> NDArray[np.uint16]:
    """Codes (rows, columns, readings) of a scan that come in this order."""
    codes = np.empty((rows, columns, sum(map(len, PASSES[mode]))), np.uint16)
    for place, code in zip(scan_order(rows, columns, mode), in_order, strict=True):
        codes[place] = code
    return codes


def shorted_readings(skin: Skin, first: int, second: int) -> Float:
    """`circuit.readings`, electrodes `first` and `second` (rows first) joined by 0.1 ohm."""
    ends = np.arange(2 * sum(skin.shape))
    return joined_readings(skin, [(first, second)], ends)[..., :READINGS_PER_CELL]
