# SPDX-License-Identifier: Apache-2.0
"""Frames from bytes, and bytes from frames, without port, thread or clock.

encode   type, sequence, payload  ->  0x00 COBS(type sequence payload crc16) 0x00
Decoder  bytes as they come       ->  whole, valid frames, and counts of what was not
"""

import struct
from dataclasses import dataclass

from ohmskin.link import protocol

# The longest COBS block [bytes]: its length byte and 254 others.
MAX_BLOCK = 0xFF
_HEADER_SIZE = 2
_CRC = struct.Struct("<H")
_LARGEST_CONTENT = (
    _HEADER_SIZE
    + protocol.FRAMES["scan"].struct.size
    + protocol.codes_size(protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
    + _CRC.size
)
# The longest stretch between two delimiters that can be a frame [bytes].
LARGEST_FRAME = _LARGEST_CONTENT + 1 + _LARGEST_CONTENT // (MAX_BLOCK - 1)


@dataclass(frozen=True)
class RawFrame:
    """A frame whose CRC is right. This host may still not know its `type`."""

    type: int
    sequence: int
    payload: bytes


@dataclass
class DecoderStats:
    """What a `Decoder` has seen: bytes (octets), valid frames, and damaged stretches.

    crc_errors: COBS with a wrong CRC. cobs_errors: not COBS, or too short for a frame. overlong:
    longer than any frame.
    """

    octets: int = 0
    frames: int = 0
    crc_errors: int = 0
    cobs_errors: int = 0
    overlong: int = 0

    @property
    def damaged(self) -> int:
        """All stretches between two delimiters that were no valid frame."""
        return self.crc_errors + self.cobs_errors + self.overlong


def cobs_encode(content: bytes) -> bytes:
    """`content` without zero bytes (consistent overhead byte stuffing, Cheshire & Baker 1999)."""
    out = bytearray()
    for stretch in content.split(protocol.DELIMITER):
        *full, rest = (
            stretch[at : at + MAX_BLOCK - 1] for at in range(0, len(stretch) + 1, MAX_BLOCK - 1)
        )
        for block in full:
            out += bytes([MAX_BLOCK]) + block
        out += bytes([len(rest) + 1]) + rest
    if full and not rest:
        out.pop()  # nothing follows a full block at the end
    return bytes(out)


def cobs_decode(stuffed: bytes) -> bytes | None:
    """The content, or None where `stuffed`, which has no zero byte, is not COBS."""
    out = bytearray()
    at, size = 0, len(stuffed)
    while at < size:
        block = stuffed[at]
        end = at + block
        if end > size:
            return None
        out += stuffed[at + 1 : end]
        if block != MAX_BLOCK and end < size:
            out.append(0)
        at = end
    return bytes(out)


def encode(frame_type: int, sequence: int, payload: bytes) -> bytes:
    """The bytes on the line of one frame, its two delimiters included."""
    content = bytes((frame_type, sequence & 0xFF)) + payload
    content += _CRC.pack(protocol.crc16(content))
    return protocol.DELIMITER + cobs_encode(content) + protocol.DELIMITER


class Decoder:
    """Finds the frames in a byte stream, however the stream is cut into chunks.

    It never keeps more bytes than one frame has, and nothing that arrives raises.

    >>> decoder = Decoder()
    >>> [f.payload for f in decoder.feed(encode(3, 0, b"ok"))]
    [b'ok']
    """

    def __init__(self) -> None:
        self.stats = DecoderStats()
        self._partial = b""
        self._skipping = False  # inside a stretch that is too long already

    def feed(self, chunk: bytes) -> list[RawFrame]:
        """The frames that `chunk` completes, in order."""
        self.stats.octets += len(chunk)
        *stretches, self._partial = (self._partial + chunk).split(protocol.DELIMITER)
        frames = [frame for each in stretches if (frame := self._decode(each)) is not None]
        if len(self._partial) > LARGEST_FRAME:
            self._partial = b""
            self.stats.overlong += not self._skipping
            self._skipping = True
        return frames

    def _decode(self, stretch: bytes) -> RawFrame | None:
        if self._skipping or not stretch:
            self._skipping = False  # the rest of a stretch that was counted when it became too long
            return None
        if len(stretch) > LARGEST_FRAME:
            self.stats.overlong += 1
            return None
        content = cobs_decode(stretch)
        if content is None or len(content) < _HEADER_SIZE + _CRC.size:
            self.stats.cobs_errors += 1
            return None
        body = content[: -_CRC.size]
        if _CRC.unpack_from(content, len(body))[0] != protocol.crc16(body):
            self.stats.crc_errors += 1
            return None
        self.stats.frames += 1
        return RawFrame(body[0], body[1], body[_HEADER_SIZE:])
