# SPDX-License-Identifier: Apache-2.0
"""How long after a scan's end its last byte leaves the board."""

from __future__ import annotations

from functools import cache
from typing import Final

from ohmskin.link import protocol
from ohmskin.link.framing import cobs_encode
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.scan_times import slot_s

_BITS_PER_BYTE: Final = 10  # 8N1
_FULL_BLOCK: Final = 0xFF
_UNKNOWN_CRC: Final = b"\x01\x01"
# The last conversion, and the pass of the main loop that packs its cell.
_FIRMWARE_S: Final = 0.1e-3


def scan_s(board: Hello) -> float:
    """Time from a scan's first reading to its end [s]; idle slots come after that."""
    return board.rows * board.columns * board.readings_per_cell * slot_s(board)


def line_delay_s(scan: Scan, board: Hello) -> float:
    """Time from a scan's end to its last byte at the end of a serial line [s], without USB.

    A block of a frame leaves the board when its last byte is known: COBS tells its length first. So
    up to 254 bytes, 5 ms at 500 kbaud, wait for the next zero in the codes: what a skin shows moves
    the arrival of its scans. The delay is max over blocks of (time from the scan's end until its
    bytes are known + time that the line takes from it on). Not in it: up to 10 ms for which frames
    wait where scans come faster than the line carries them.
    """
    if board.board == "emulated":
        return 1 / board.rate_hz - scan_s(board)  # it says all of a scan as its period ends
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
    """What comes before the codes; its zeros end blocks so early that it may be of any scan."""
    kind = protocol.FRAMES["scan"]
    fields = {"scan": 1, "time_us": 1, "dropped": 0, "rx_errors": 0}
    return bytes([kind.id, 1]) + kind.pack(**fields, rows=rows, columns=columns)
