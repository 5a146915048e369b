# SPDX-License-Identifier: Apache-2.0
"""What the page shows of one scan, and its bytes.

==============  ======================================================================
4 bytes         length of the header, little-endian
header          JSON, padded with spaces to a multiple of 4 bytes
planes          those that the header names, each R x C float32, little-endian, by row
==============  ======================================================================
"""

import json
import math
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from ohmskin.force.contacts import Contact
from ohmskin.force.reader import ForceScan
from ohmskin.link.messages import BoardStats


@dataclass(frozen=True, eq=False)
class Shown:
    """One scan of a page. raw: by the method `ohm`, what the electrodes read, ghosts included.

    method: that of `found`. has_forces: there are newtons. stats: of the connection. rate_hz: the
    scan rate of late [Hz]. recorded: scans in the recording that goes on, if one does.
    """

    found: ForceScan
    raw: Estimate
    method: str
    has_forces: bool
    stats: BoardStats
    rate_hz: float
    recorded: int

    @cached_property
    def message(self) -> bytes:
        """The bytes of it, as in the table above."""
        planes: dict[str, Float | NDArray[np.bool_]] = {
            "raw": self.raw.cell_siemens,
            "raw_touched": self.raw.touched,
            "siemens": self.found.estimate.cell_siemens,
            "siemens_std": self.found.estimate.cell_siemens_std,
            "touched": self.found.estimate.touched,
        }
        if self.has_forces:
            planes |= {"force": self.found.force_n, "force_std": self.found.force_n_std}
        header = json.dumps(self._header(list(planes)), allow_nan=False).encode()
        header += b" " * (-len(header) % 4)
        values = np.stack(list(planes.values())).astype("<f4")
        return struct.pack("<I", len(header)) + header + values.tobytes()

    def _header(self, planes: list[str]) -> dict[str, Any]:
        scan, estimate, stats = self.found, self.found.estimate, self.stats
        return {
            "scan": scan.number,
            "host_time_s": scan.host_time_s,
            "rows": scan.rows,
            "columns": scan.columns,
            "planes": planes,
            "method": self.method,
            "chi2": _number(estimate.chi2),
            "iterations": estimate.iterations,
            "estimate_s": estimate.seconds,
            "text": estimate.message,
            "rate_hz": self.rate_hz,
            "missed": stats.missed,
            "damaged": stats.line.damaged,
            "restarts": stats.restarts,
            "recorded": self.recorded,
            "contacts": [[each.identity, *map(_number, _numbers(each))] for each in scan.contacts],
        }


def _numbers(contact: Contact) -> tuple[float, ...]:
    return contact.row, contact.column, contact.force_n, contact.force_n_std


def _number(value: float) -> float | None:
    """As JSON has it, which knows no NaN."""
    return value if math.isfinite(value) else None
