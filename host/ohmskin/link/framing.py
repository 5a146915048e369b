# SPDX-License-Identifier: Apache-2.0
"""Frames from bytes and bytes from frames; no port, no thread, no clock.

encode   type, sequence, payload  ->  0x00 COBS(type sequence payload crc16) 0x00
Decoder  bytes as they come       ->  whole, valid frames, and counts of what was not
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from ohmskin.link import protocol

_MAX_BLOCK = 0xFF
_HEADER_SIZE = 2
_CRC = struct.Struct("<H")
_LARGEST_CONTENT = (
    _HEADER_SIZE
    + protocol.FRAMES["scan"].struct.size
    + protocol.codes_size(protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
    + _CRC.size
)
# The longest run of bytes between two delimiters that can be a frame.
LARGEST_FRAME = _LARGEST_CONTENT + 1 + _LARGEST_CONTENT // (_MAX_BLOCK - 1)


@dataclass(frozen=True)
class RawFrame:
    """A frame whose CRC is right: `type` may still be unknown to this host."""

    type: int
    sequence: int
    payload: bytes


@dataclass
class DecoderStats:
    """What a `Decoder` has seen, in frames unless said otherwise."""

    octets: int = 0
    frames: int = 0
    crc_errors: int = 0
    """Right COBS, wrong CRC."""
    cobs_errors: int = 0
    """No COBS at all, or too short for a frame."""
    overlong: int = 0
    """More bytes without a delimiter than any frame has."""

    @property
    def damaged(self) -> int:
        """Stretches between two delimiters that were no valid frame."""
        return self.crc_errors + self.cobs_errors + self.overlong


def cobs_encode(content: bytes) -> bytes:
    """`content` without zero bytes (consistent overhead byte stuffing, Cheshire & Baker 1999)."""
    out = bytearray()
    stretches = content.split(protocol.DELIMITER)
    last = len(stretches) - 1
    for i, stretch in enumerate(stretches):
        while len(stretch) >= _MAX_BLOCK - 1:
            out.append(_MAX_BLOCK)
            out += stretch[: _MAX_BLOCK - 1]
            stretch = stretch[_MAX_BLOCK - 1 :]
            if not stretch and i == last:
                return bytes(out)
        out.append(len(stretch) + 1)
        out += stretch
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
        if block != _MAX_BLOCK and end < size:
            out.append(0)
        at = end
    return bytes(out)


def encode(frame_type: int, sequence: int, payload: bytes) -> bytes:
    """The bytes on the line of one frame, its two delimiters included."""
    content = bytes((frame_type, sequence & 0xFF)) + payload
    content += _CRC.pack(protocol.crc16(content))
    return protocol.DELIMITER + cobs_encode(content) + protocol.DELIMITER


class Decoder:
    """Finds the frames in a byte stream, however it is cut into chunks.

    The buffer never holds more than one frame's bytes; nothing that arrives raises.

    >>> decoder = Decoder()
    >>> [f.payload for f in decoder.feed(encode(3, 0, b"ok"))]
    [b'ok']
    """

    def __init__(self) -> None:
        self.stats = DecoderStats()
        self._partial = b""
        self._skipping = False  # inside a stretch that is already too long

    def feed(self, chunk: bytes) -> list[RawFrame]:
        """The frames that `chunk` completes, in order."""
        self.stats.octets += len(chunk)
        stretches = (self._partial + chunk).split(protocol.DELIMITER)
        self._partial = stretches.pop()
        frames = list(self._frames(stretches))
        if len(self._partial) > LARGEST_FRAME:
            self._partial = b""
            if not self._skipping:
                self._skipping = True
                self.stats.overlong += 1
        return frames

    def _frames(self, stretches: list[bytes]) -> Iterator[RawFrame]:
        for stretch in stretches:
            if self._skipping:
                self._skipping = False  # the rest of it: counted when it became too long
            elif len(stretch) > LARGEST_FRAME:
                self.stats.overlong += 1
            elif stretch:
                frame = self._decode(stretch)
                if frame is not None:
                    self.stats.frames += 1
                    yield frame

    def _decode(self, stretch: bytes) -> RawFrame | None:
        content = cobs_decode(stretch)
        if content is None or len(content) < _HEADER_SIZE + _CRC.size:
            self.stats.cobs_errors += 1
            return None
        body = content[: -_CRC.size]
        if _CRC.unpack_from(content, len(body))[0] != protocol.crc16(body):
            self.stats.crc_errors += 1
            return None
        return RawFrame(body[0], body[1], body[_HEADER_SIZE:])
