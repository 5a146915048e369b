# SPDX-License-Identifier: Apache-2.0
"""Frames from bytes, and bytes from frames, without port, thread or clock.

encode   type, sequence, payload  ->  0x00 COBS(type sequence payload crc16) 0x00
Decoder  bytes as they come       ->  whole, valid frames, and counts of what was not

COBS takes the zero bytes out of a frame's content, so that a zero byte on the line always ends a
frame. A decoder that has lost its place, by damage or because it came late, waits for the next zero
and is right again. On the line, the content is a row of blocks: a byte that says how long the block
is, this byte included, and bytes other than zero. In the content a zero follows each block, but not
the last one, nor a block of the largest length.
"""

import math
import struct
from dataclasses import dataclass

from ohmskin.link import protocol

# The longest COBS block: its length is a byte, which counts itself [Cheshire1999].
MAX_BLOCK_BYTES = 0xFF
# Type and sequence number, and the CRC. frames.toml says so in the sentence of `framing`; a key of
# its own would change the layout CRC, and boards of before would have to be flashed.
_HEADER = struct.Struct("<BB")
_CRC = struct.Struct("<H")
# Sequence numbers go on with 0 after so many. An `ack` repeats that of its command, in this field.
SEQUENCE_SPAN = protocol.FRAMES["ack"].span("command_sequence")
# Type, sequence, payload and CRC of the largest scan: no frame has more.
_MOST_CODES = math.prod(protocol.CONSTANTS[f"{n}_max"] for n in ("rows", "columns", "readings"))
_MAX_CODES_BYTES = protocol.codes_size(_MOST_CODES, protocol.CONSTANTS["adc_bits_max"])
_MAX_SCAN_BYTES = protocol.FRAMES["scan"].struct.size + _MAX_CODES_BYTES
_MAX_CONTENT_BYTES = _HEADER.size + _MAX_SCAN_BYTES + _CRC.size
# The longest stretch between two delimiters that can be a frame: COBS adds a byte, and one for each
# block that is full.
MAX_FRAME_BYTES = _MAX_CONTENT_BYTES + 1 + _MAX_CONTENT_BYTES // (MAX_BLOCK_BYTES - 1)


@dataclass(frozen=True)
class RawFrame:
    """A frame whose CRC is right. This host may still not know its `type`.

    type: id of the kind of frame.
    sequence: the sender's count of frames, modulo `SEQUENCE_SPAN`.
    payload: all between these two and the CRC.
    """

    type: int
    sequence: int
    payload: bytes


@dataclass
class DecoderStats:
    """What a `Decoder` has been fed. A stretch is what stands between two delimiters.

    octets: bytes.
    frames: valid frames.
    crc_errors: stretches that are COBS, but whose CRC is wrong.
    cobs_errors: stretches that are not COBS, or too short for a frame.
    overlong: stretches longer than any frame.
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
    """`content` without zero bytes: consistent overhead byte stuffing [Cheshire1999].

    [Cheshire1999]: Cheshire, Baker, "Consistent overhead byte stuffing", IEEE/ACM Transactions on
    Networking 7(2).
    """
    out = bytearray()
    step = MAX_BLOCK_BYTES - 1
    for run in content.split(protocol.DELIMITER):
        while len(run) >= step:
            out.append(MAX_BLOCK_BYTES)
            out += run[:step]
            run = run[step:]
        out.append(len(run) + 1)
        out += run
    if not run and content[-1:] not in (b"", protocol.DELIMITER):
        out.pop()  # an empty block is written only where a zero stood, and none stands at the end
    return bytes(out)


def cobs_decode(stuffed: bytes) -> bytes | None:
    """The content, or None where `stuffed`, which has no zero byte, is not COBS."""
    out = bytearray()
    begin, size = 0, len(stuffed)
    while begin < size:
        block_size = stuffed[begin]
        end = begin + block_size
        if end > size:
            return None
        out += stuffed[begin + 1 : end]
        if block_size != MAX_BLOCK_BYTES and end < size:
            out.append(0)
        begin = end
    return bytes(out)


def encode(frame_type: int, sequence: int, payload: bytes) -> bytes:
    """The bytes on the line of one frame, its two delimiters included.

    The delimiter before it ends what noise may have left in the receiver. Without it, the first
    frame after a pause could be taken for the end of a damaged one, and be lost.
    """
    content = _HEADER.pack(frame_type, sequence % SEQUENCE_SPAN) + payload
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
        self._partial = b""  # of a stretch whose delimiter has not come yet
        # Whether this stretch is too long already, and counted. Its bytes are dropped as they come,
        # so that a line that never sends a delimiter does not fill the memory.
        self._skipping = False

    def feed(self, chunk: bytes) -> list[RawFrame]:
        """The frames that `chunk` completes, in order."""
        self.stats.octets += len(chunk)
        *stretches, self._partial = (self._partial + chunk).split(protocol.DELIMITER)
        frames = [frame for frame in map(self._decode, stretches) if frame is not None]
        if len(self._partial) > MAX_FRAME_BYTES:
            self._partial = b""
            self.stats.overlong += not self._skipping
            self._skipping = True
        return frames

    def _decode(self, stretch: bytes) -> RawFrame | None:
        if self._skipping or not stretch:
            self._skipping = False  # this delimiter ends what was too long
            return None
        if len(stretch) > MAX_FRAME_BYTES:
            self.stats.overlong += 1
            return None
        content = cobs_decode(stretch)
        if content is None or len(content) < _HEADER.size + _CRC.size:
            self.stats.cobs_errors += 1
            return None
        body = content[: -_CRC.size]
        if _CRC.unpack_from(content, len(body))[0] != protocol.crc16(body):
            self.stats.crc_errors += 1
            return None
        self.stats.frames += 1
        kind, sequence = _HEADER.unpack_from(body)
        return RawFrame(kind, sequence, body[_HEADER.size :])
