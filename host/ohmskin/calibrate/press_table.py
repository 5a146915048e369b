# SPDX-License-Identifier: Apache-2.0
"""Presses of single cells with known forces (CSV): what force curves are learned from.

=============== ============================================================
column          meaning
=============== ============================================================
row, column     the cell, counted from 0
force_n         force on it [N]
conductance     of it, meanwhile [S]
conductance_std standard deviation of that [S]; the column may be absent: 0
=============== ============================================================

In any order, and no other columns: a misspelt conductance_std would be lost without a word.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from dataclasses import dataclass
from io import TextIOWrapper
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.force_log import NEWTONS
from ohmskin.calibrate.number_table import naming, other_units, read_numbers
from ohmskin.files import whole_file
from ohmskin.record.readings import MAX_CELLS

# A cell of 1 ohm: less than its wires have. More is a number in another unit.
MAX_CONDUCTANCE: Final = 1.0
_NEEDED: Final = ("row", "column", "force_n", "conductance")
_STD: Final = "conductance_std"
_SIEMENS: Final = {"s": "1", "ms": "1e-3", "us": "1e-6", "ns": "1e-9"}
_OHMS: Final = ("resistance", "resistance_ohm", "resistance_kohm", "resistance_mohm", "cell_ohm")
_INSTEAD: Final = {
    "col": ("column", "rename it"),
    "cell_siemens": ("conductance", "rename it"),
    "cell_siemens_std": (_STD, "rename it"),
    **dict.fromkeys(_OHMS, ("conductance", "write 1 / resistance in ohm")),
    **other_units("force_n", ("force",), NEWTONS),
    **other_units("conductance", ("conductance",), _SIEMENS),
    **other_units(_STD, (_STD,), _SIEMENS),
}


@dataclass(frozen=True, eq=False)
class PressTable:
    """row, column (n,), integers from 0; force_n (n,) [N]; conductance, conductance_std (n,) [S].

    Raises ValueError, naming the press from 0, for values that cannot be. Whether the skin has such
    cells is not known here.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    force_n: Float
    conductance: Float
    conductance_std: Float

    def __post_init__(self) -> None:
        for name in (*_NEEDED, _STD):
            array = getattr(self, name)
            if array.ndim != 1 or array.shape != self.row.shape:
                raise ValueError(f"{name} has shape {array.shape}, row {self.row.shape}")
        for name in ("row", "column"):
            if getattr(self, name).dtype.kind not in "iu":
                raise ValueError(f"{name} holds {getattr(self, name).dtype}, not integers")
        press, fault = _fault({name: getattr(self, name) for name in (*_NEEDED, _STD)})
        if fault:
            raise ValueError(fault if press is None else f"press {press}: {fault}")


def _fault(columns: Mapping[str, Float | NDArray[np.int64]]) -> tuple[int | None, str]:
    """What is wrong, and with which press if with one; an empty text: nothing."""
    if not columns["row"].size:
        return None, "no press is in it"
    for name, values in columns.items():
        whole = name in ("row", "column")
        siemens = name in ("conductance", _STD)
        most = MAX_CELLS - 1 if whole else MAX_CONDUCTANCE if siemens else np.finfo(np.float64).max
        bad = ~((values >= 0) & (values <= most))
        if whole:
            bad |= values != np.floor(values)
        if not bad.any():
            continue
        press = int(np.argmax(bad))
        value = float(values[press])
        if whole:
            must = f"it must be a whole number from 0 to {MAX_CELLS - 1}"
        elif siemens and value > MAX_CONDUCTANCE:
            must = "above 1 S: give siemens; of microsiemens, 1e-6 times as much"
        elif name == "force_n" and value < 0:
            must = "it must be 0 or more: zero the force sensor, or leave the row out"
        else:
            must = "it must be finite and 0 or more"
        return press, f"{name} is {value:g}, {must}"
    return None, ""


def load_press_table(path: str | os.PathLike[str]) -> PressTable:
    """Read a table.

    Raises ValueError, one line that names the file and the row (the header is row 1).
    """
    with naming(path):
        table = read_numbers(path, _NEEDED, optional=(_STD,), others=False, instead=_INSTEAD)
        columns = {_STD: np.zeros(table.rows.size), **table.columns}
        press, fault = _fault(columns)
        if fault:
            raise ValueError(fault if press is None else f"row {table.rows[press]}: {fault}")
        return PressTable(
            columns["row"].astype(np.int64),
            columns["column"].astype(np.int64),
            *(columns[name] for name in ("force_n", "conductance", _STD)),
        )


def save_press_table(path: str | os.PathLike[str], table: PressTable) -> None:
    """Write a file that is either complete or not there, and is read back bit for bit.

    Raises ValueError if it cannot be written.
    """
    names = (*_NEEDED, _STD)
    with whole_file(path) as file:
        text = TextIOWrapper(file, encoding="ascii", newline="", write_through=True)
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*(getattr(table, name).tolist() for name in names), strict=True))
        text.detach()
