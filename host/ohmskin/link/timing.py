# SPDX-License-Identifier: Apache-2.0
"""When each reading of a scan is taken, and when the scan's last byte leaves the board.

A board takes one reading a slot, cell after cell, column by column; its `hello` says how long a
slot is. The slots after the last reading, up to the start of the next scan, are idle.
"""

from functools import cache
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.link import protocol
from ohmskin.link.framing import cobs_encode
from ohmskin.link.messages import Hello, Scan

# A byte takes ten bits on a line of 8N1: a start bit, eight data bits and a stop bit.
_BITS_PER_BYTE: Final = 10
# Length byte of a COBS block that is full: no zero stands for its end.
_FULL_BLOCK: Final = 0xFF
# The CRC is not known here. It is taken to have no zeros, which would end a block earlier.
_UNKNOWN_CRC: Final = b"\x01\x01"
# The last conversion and the pass of the main loop that packs its cell [s]: 0.1 ms fits the built
# firmware in the simulator (tests/link/test_timing.py).
_FIRMWARE_S: Final = 0.1e-3


def slot_s(board: Hello) -> float:
    """Time from one reading of a scan to the next [s]."""
    return board.slot_cycles / board.clock_hz


def scan_s(board: Hello) -> float:
    """Time from a scan's first reading to its end [s]; idle slots come after that."""
    return board.rows * board.columns * board.readings_per_cell * slot_s(board)


def reading_offsets_s(board: Hello) -> Float:
    """Time of each reading since the first of its scan [s], shape (rows, columns, readings)."""
    shape = (board.columns, board.rows, board.readings_per_cell)
    order = np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
    return np.asarray(slot_s(board) * order.transpose(1, 0, 2))


def line_delay_s(scan: Scan, board: Hello) -> float:
    """Time from a scan's end to its last byte at the end of a serial line [s], without USB.

    The board sends a COBS block when it knows the block's last byte, because the length comes
    first. Up to 254 bytes (5 ms at 500 kbaud) wait for the next zero in the codes, so what a skin
    shows moves the arrival of its scans. The delay is the maximum over all blocks of (time from the
    scan's end until the block is known + time that the line takes from this block on). It leaves
    out the up to 10 ms for which frames wait where scans come faster than the line carries them.
    """
    if board.board == "emulated":
        # An emulated board sends a whole scan at the end of its period.
        return 1 / board.rate_hz - scan_s(board)
    header = _header(scan.rows, scan.columns)
    codes = protocol.pack_codes(scan.codes)
    wire = cobs_encode(header + codes + _UNKNOWN_CRC)
    byte_s = _BITS_PER_BYTE / board.baud
    known_byte_s = scan_s(board) / len(codes)
    delay_s, at, unknown = 0.0, 0, len(header) + len(codes)
    while at < len(wire):
        unknown -= wire[at] - (wire[at] == _FULL_BLOCK)
        line_s = (len(wire) + 1 - at) * byte_s
        delay_s = max(delay_s, line_s - max(unknown, 0) * known_byte_s)
        at += wire[at]
    return delay_s + _FIRMWARE_S


@cache
def _header(rows: int, columns: int) -> bytes:
    """What comes before the codes, with numbers of any scan: its zeros end blocks early anyway."""
    kind = protocol.FRAMES["scan"]
    fields = {"scan": 1, "time_us": 1, "dropped": 0, "rx_errors": 0}
    return bytes([kind.id, 1]) + kind.pack(**fields, rows=rows, columns=columns)
