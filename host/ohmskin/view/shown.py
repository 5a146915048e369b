# SPDX-License-Identifier: Apache-2.0
"""What the page is sent of a board and of its scans."""

import json
import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, Self

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.link.messages import Hello, Scan

# Attributes of `Hello` that the page shows of a board.
_OF_BOARD: Final = ("board", "unit_id", "version", "rows", "columns", "mode")
# Attributes of `Scan` that are in the header of every scan.
_OF_SCAN: Final = ("host_time_s", "rows", "columns")


class Shown(NamedTuple):
    """One scan as a page shows it: its number, and the message that the page is sent.

    ==============  ==================================================================
    4 bytes         length of the header, little-endian
    header          JSON, padded with spaces to a multiple of 4 bytes
    planes          in the order of "planes" in the header, each R x C float32, little-endian, by
                    row
    ==============  ==================================================================
    """

    number: int
    message: bytes

    @classmethod
    def of(cls, scan: Scan, content: dict[str, Any], planes: Mapping[str, Float | Bool]) -> Self:
        """This scan, with more content of the header, and planes."""
        of_scan = {name: getattr(scan, name) for name in _OF_SCAN}
        content = content | of_scan | {"scan": scan.number, "planes": list(planes)}
        header = json.dumps(content, allow_nan=False).encode()
        header += b" " * (-len(header) % 4)  # a page can read planes only from a multiple of 4
        values = np.stack(list(planes.values())).astype("<f4")
        message = struct.pack("<I", len(header)) + header + values.tobytes()
        return cls(scan.number, message)


def of_board(board: Hello) -> dict[str, Any]:
    """What the page shows of a board, as values for JSON."""
    return {name: getattr(board, name) for name in _OF_BOARD}
