# SPDX-License-Identifier: Apache-2.0
"""A reference plate: known resistors at the crossings, in place of a skin.

Its file (.csv) has no header. It has a line for each row of the board, and a field for each column:
ohms, or nothing or ``open`` where there is no resistor.
"""

import csv
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.files import PathName, naming, read_bounded
from ohmskin.link.protocol import CONSTANTS

OPEN: Final = ("", "open")
MAX_FILE_BYTES: Final = 100_000  # 16 x 16 numbers are 5 kB.
# [ohm] Readings differ by less than a code beyond: it is a number in another unit.
LEAST_OHM: Final = 100.0
MOST_OHM: Final = 30e6


def load_plate(path: PathName) -> Float:
    """Conductances (R, C) [S] of a plate, 0 where it has no resistor. Raises ValueError."""
    with naming(path):
        text = read_bounded(path, MAX_FILE_BYTES).decode("utf-8-sig", errors="replace")
        lines = [fields for fields in csv.reader(text.splitlines()) if fields]
        sizes = {len(fields) for fields in lines}
        if not lines or len(lines) > CONSTANTS["rows_max"] or max(sizes) > CONSTANTS["columns_max"]:
            raise ValueError("a plate has 1 to 16 lines, of 1 to 16 fields each")
        if len(sizes) > 1:
            raise ValueError("its lines have different numbers of fields: write 'open' for none")
        plate = np.array(
            [
                [_siemens(field.strip(), row, column) for column, field in enumerate(fields)]
                for row, fields in enumerate(lines)
            ]
        )
        if not plate.any():
            raise ValueError("it has no resistor")
        return plate


def _siemens(field: str, row: int, column: int) -> float:
    if field.lower() in OPEN:
        return 0.0
    try:
        ohm = float(field)
    except ValueError:
        ohm = 0.0
    if not LEAST_OHM <= ohm <= MOST_OHM:
        raise ValueError(
            f"row {row}, column {column} is '{field:.20}': write 'open', or ohms from "
            f"{LEAST_OHM:g} to {MOST_OHM:g}, without a unit"
        )
    return 1 / ohm
