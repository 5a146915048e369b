# SPDX-License-Identifier: Apache-2.0
"""A reference plate: known resistors at the crossings, in place of a skin.

Its file (.csv) has no header. It has a line for each row of the board, and a field for each column:
ohms, or nothing or ``open`` where there is no resistor.
"""

import csv
from contextlib import suppress
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.files import PathName, naming, read_bounded
from ohmskin.link.protocol import CONSTANTS

# Largest file that is read. Chosen: 32 x 32 numbers are 20 kB, so a larger file is no plate.
MAX_FILE_BYTES: Final = 100_000
# Least resistor of a plate [ohm]. A lower number is taken for one in another unit. Chosen: beside
# references of 30 kOhm, it differs from a short by less than a code of 10 bits.
LEAST_OHM: Final = 100.0
# Largest resistor of a plate [ohm]. Chosen: it differs from an open crossing by one code.
MOST_OHM: Final = 30e6


def load_plate(path: PathName) -> Float:
    """Conductances (R, C) [S] of a plate, 0 where it has no resistor. Raises ValueError."""
    with naming(path):
        text = read_bounded(path, MAX_FILE_BYTES).decode("utf-8-sig", errors="replace")
        lines = [fields for fields in csv.reader(text.splitlines()) if fields]
        columns = len(lines[0]) if lines else 0
        most = CONSTANTS["rows_max"], CONSTANTS["columns_max"]
        if not (1 <= len(lines) <= most[0] and columns <= most[1]):
            raise ValueError("a plate has 1 to {} lines, of 1 to {} fields each".format(*most))
        plate = np.zeros((len(lines), columns))
        for row, fields in enumerate(lines):
            if len(fields) != columns:
                raise ValueError(f"row {row} has {len(fields)} fields, row 0 {columns}")
            for column, field in enumerate(fields):
                with naming(f"row {row}, column {column}"):
                    plate[row, column] = _siemens(field.strip())
        if not plate.any():
            raise ValueError("it has no resistor")
        return plate


def _siemens(field: str) -> float:
    """The conductance that a field of the file says [S]; 0 where it says that there is none."""
    if field.lower() in ("", "open"):
        return 0.0
    with suppress(ValueError):
        if LEAST_OHM <= (ohm := float(field)) <= MOST_OHM:
            return 1 / ohm
    most = f"ohms from {LEAST_OHM:g} to {MOST_OHM:g}, without a unit"
    raise ValueError(f"'{field:.20}': write 'open', or {most}")
