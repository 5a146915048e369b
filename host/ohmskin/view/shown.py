# SPDX-License-Identifier: Apache-2.0
"""What the page is sent of a board and of its scans."""

import json
import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.link.messages import Hello

# Attributes of `Hello` that the page shows of a board.
_OF_BOARD: Final = ("board", "unit_id", "version", "rows", "columns", "mode")


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
    def of(cls, content: dict[str, Any], planes: Mapping[str, Float | Bool]) -> "Shown":
        """The scan whose header has this content, and these planes."""
        header = json.dumps(content | {"planes": list(planes)}, allow_nan=False).encode()
        header += b" " * (-len(header) % 4)  # a page can read planes only from a multiple of 4
        values = np.stack(list(planes.values())).astype("<f4")
        message = struct.pack("<I", len(header)) + header + values.tobytes()
        return cls(content["scan"], message)


def of_board(board: Hello) -> dict[str, Any]:
    """What the page shows of a board, as values for JSON."""
    return {name: getattr(board, name) for name in _OF_BOARD}
