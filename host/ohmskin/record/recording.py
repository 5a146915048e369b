# SPDX-License-Identifier: Apache-2.0
"""Recordings (.mcap): what a board said, as it said it, to be estimated now or years later.

A recording is an MCAP file (https://mcap.dev) of JSON messages with JSON schemas, in zstd chunks:

=============  ===============================================================================
topic          message
=============  ===============================================================================
/skin/hello    who the board is: first of all, and again whenever it changes
/skin/scan     all codes of a scan, with board time, host time and how many were missed before
/skin/tare     mean readings of the skin while nothing touched it
/skin/mark     a text at a time
/skin/force    a sample of a reference force
=============  ===============================================================================

Codes are stored as numbers, not as frames of the link: so a file outlives the protocol's layout,
and other programs can plot it. In chunks, 8x8 at 90 Hz take 27 kB/s; codes that are mere noise
would take 46 kB/s.
``host_time_s`` is that of `Scan`; log times are the same instants since 1970.

`recorder` writes them; `messages` reads one by one, `load_recording` all at once. A file
that was cut off anywhere is read up to its last whole chunk. `export` makes other files of one.

Files come from anywhere, so nothing in one is believed before it was checked:

=============  ===============================================================================
by             what could go wrong without it
=============  ===============================================================================
`_records`     a length that states more bytes than there are fills the memory
`_Allowance`   a small file unpacks to more than the memory holds
`_message`     a field that is missing, of another type or beyond any range gets into a `Scan`
=============  ===============================================================================
"""

import json
import math
import os
import struct
import zlib
from array import array
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, Self, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import is_near
from ohmskin.errors import RecordingError
from ohmskin.files import PathName, require_file, stored_bytes
from ohmskin.link import layouts
from ohmskin.link.clock import ScanClock
from ohmskin.link.codes import check_adc_bits
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import MODES, lines_of
from ohmskin.record.readings import check_size

# Largest record of a file, and what a chunk unpacks to. Chosen: a second of 16x16 at full rate is
# 0.2 MB, and tools that write files anew make chunks of 4 MB.
LARGEST_RECORD_BYTES: Final = 16_000_000
# Largest message, unpacked, without readings and with them. Chosen: a mark is a line of text, and
# the readings of `MAX_CELLS` in a tare are 4096 numbers of at most 24 characters.
_LARGEST_MESSAGE_BYTES: Final = (10_000, 120_000)
# A file may unpack to so many bytes, whatever its size. Chosen: a single message may pack better
# than the scans of a skin.
_UNPACKED_BYTES: Final = 1_000_000
# In addition, it may unpack to so many times its own bytes. Chosen: codes without noise pack best,
# 115 times.
_MOST_UNPACKED: Final = 130
# If a board answers, its line does not delay by more than this [s]. Chosen: the host waits a second
# for the answer to a command.
_LARGEST_DELAY_S: Final = 10.0
# Counters are kept in 64 bits.
_LARGEST_COUNTER: Final = np.iinfo(np.int64).max
# A record of a chunk counts as at least so many bytes. Chosen: a scan of one cell, or a force,
# takes as much memory; in a file they take more than ten bytes.
_LEAST_RECORD_BYTES: Final = 1000
# The format, by mcap.dev/spec: the first bytes of a file; the opcode and the length that each
# record begins with; the size and CRC in a chunk, after its times; how many bytes are before the
# topic in a channel, and before the content in a message.
_MAGIC: Final = b"\x89MCAP0\r\n"
_HEAD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<16xQI")
_CHANNEL_BYTES: Final = 4
_MESSAGE_BYTES: Final = 22
# A damaged chunk that ends in so many zeros, or is followed by them, is where a system crashed.
# Chosen: a byte of the chunk, and the head of a record. No sound chunk ends in as many.
_ZEROS: Final = 1 + _HEAD.size
# Where in a message's record the time is at which it was logged [ns since 1970].
_LOG_TIME: Final = slice(6, 14)
_READ: Final = frozenset((Opcode.FOOTER, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK))
# What the libraries that unpack bytes raise if these are damaged.
_DAMAGE: Final = (struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError, MemoryError)
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Tare:
    """Mean readings of the untouched skin.

    rest_ratio: shape (rows, columns, readings of `mode`) [V/Vdd].
    host_time_s: when it was taken, on the host's monotonic clock [s].
    mode: which readings these are.
    """

    rest_ratio: Float
    host_time_s: float
    mode: str = "near"

    @classmethod
    def of(cls, rest_ratio: Float, board: Hello, host_time_s: float) -> Self:
        """A tare from mean readings, of the first mode of this board that has as many a cell."""
        modes = (board.mode, board.whole_mode, *MODES)
        mode = next(name for name in modes if len(MODES[name]) == rest_ratio.shape[-1])
        return cls(rest_ratio, host_time_s, mode)

    def is_of(self, scan: Scan) -> bool:
        """Whether it is good for this scan: of the same cells, read at the same ends."""
        same_ends = self.mode == scan.mode or is_near((*MODES[self.mode], *scan.reading_names))
        return same_ends and self.rest_ratio.shape[:2] == scan.codes.shape[:2]


def tare_of(scan: Scan, tares: Sequence[Tare]) -> Tare | None:
    """The last of these tares that is good for this scan; None if there is none."""
    return next((tare for tare in reversed(tares) if tare.is_of(scan)), None)


@dataclass(frozen=True)
class Mark:
    """A text that somebody set.

    text: any text.
    host_time_s: when it was set, on the host's monotonic clock [s].
    time_ns: the same since 1970 [ns]; 0: `messages` was not asked for it.
    """

    text: str
    host_time_s: float
    time_ns: int = 0


@dataclass(frozen=True)
class ForceSample:
    """A reference force.

    force_n: the force [N].
    host_time_s: when it was measured, on the host's monotonic clock [s].
    source: what measured it.
    """

    force_n: float
    host_time_s: float
    source: str = ""


Recorded = Hello | Scan | Tare | Mark | ForceSample


def _is(kind: str, description: str, **more: Any) -> dict[str, Any]:
    """What JSON Schema says of a property."""
    return {"type": kind, "description": description, **more}


TOPIC: Final = "/skin/"
_TEXT: Final = {"type": "string"}
_OF_TYPE: Final[dict[object, dict[str, Any]]] = {
    int: {"type": "integer"},
    str: _TEXT,
    tuple[str, ...]: {"type": "array", "items": _TEXT},
}
_HOST_TIME: Final = _is("number", "host's monotonic clock [s]")
_SIZE: Final = {key: {"type": "integer", "minimum": 1} for key in ("rows", "columns")}
_ORDER: Final = "row by row, in it column by column, all readings of each cell"
# By what follows `TOPIC`: the properties of its messages, in the words of JSON Schema.
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "hello": {"host_time_s": _HOST_TIME, **{f.name: _OF_TYPE[f.type] for f in fields(Hello)}},
    "scan": {
        "number": _is("integer", "of the scan since the command start"),
        "time_us": _is("integer", "board time at which the scan began [us]"),
        "host_time_s": _HOST_TIME,
        "missed": _is("integer", "scans before this one that never came"),
        "mode": _is("string", f"readings of each cell, by mode: {MODES}"),
        "adc_bits": _is("integer", "of a code"),
        "row_mask": _is("integer", "rows that were read, bit 0 for the first"),
        "column_mask": _is("integer", "columns that were read, bit 0 for the first"),
        "delay_s": _is("number", "constant delays of both ways of the line [s]; 0: not known"),
        "slot_cycles": _is("integer", "from one reading to the next [clock]; 0: that of hello"),
        **_SIZE,
        "codes": _is("array", f"ADC codes: {_ORDER}", items={"type": "integer"}),
    },
    "tare": {
        "host_time_s": _HOST_TIME,
        "mode": _is("string", "that of the scans it was taken of"),
        **_SIZE,
        "rest_ratio": _is("array", f"V/Vdd: {_ORDER}", items={"type": "number"}),
    },
    "mark": {"host_time_s": _HOST_TIME, "text": _TEXT},
    "force": {
        "host_time_s": _HOST_TIME,
        "force_n": _is("number", "reference force [N]"),
        "source": _is("string", "what measured it"),
    },
}
KINDS: Final[dict[str, type[Recorded]]] = dict(
    zip(SCHEMAS, (Hello, Scan, Tare, Mark, ForceSample), strict=True)
)


@dataclass(eq=False)
class Recording:
    """All of a recording, each kind of message in order.

    hellos: at least one.
    scans, tares, marks, forces: any number of each.
    cut_off: whether the recording was not ended properly, so that its last second may be missing.
    name: of its file.
    """

    hellos: list[Hello]
    scans: list[Scan]
    tares: list[Tare]
    marks: list[Mark]
    forces: list[ForceSample]
    cut_off: bool
    name: str = ""


def load_recording(path: PathName) -> Recording:
    """Read a whole recording. If its recorder was killed, read up to the last whole chunk.

    `time_ns` of its scans and marks is 0: `messages`, `load_forces` and a replay find it.

    :raises RecordingError: one line that names the file and what is wrong with it.
    """
    in_order = list(messages(path))

    def of(kind: type[_T]) -> list[_T]:
        return [message for message in in_order if isinstance(message, kind)]

    cut_off = in_order[-1] is not None
    kinds = of(Hello), of(Scan), of(Tare), of(Mark), of(ForceSample)
    return Recording(*kinds, cut_off, Path(path).name)


def messages(
    path: PathName, *, timed: bool = False, watch: Callable[[int], object] | None = None
) -> Generator[Recorded | None, None, None]:
    """The messages of a recording in order, hello first; None last of all if it ended properly.

    timed: scans and marks get their `time_ns`, which takes half as long again.
    watch: is told how many bytes of the file were read.

    Topics that are not ours are passed over, so that other programs may write into a recording.

    :raises RecordingError: as `load_recording`.
    """
    topics: dict[int, str] = {}  # by the id of their channel
    is_whole = False
    board: Hello | None = None
    clock: ScanClock | None = None
    try:
        require_file(path)
        with open(path, "rb") as file:
            allowance = _Allowance(file)
            for opcode, content in _records(file, allowance):
                number = int.from_bytes(content[:2], "little")  # of the channel
                if opcode == Opcode.CHANNEL:
                    topic, at = _text(content, _CHANNEL_BYTES)
                    name = topic.removeprefix(TOPIC)
                    if name in SCHEMAS and (topic, _text(content, at)[0]) == (TOPIC + name, "json"):
                        topics[number] = name
                elif opcode == Opcode.MESSAGE and number in topics:
                    name, octets = topics[number], content[_MESSAGE_BYTES:]
                    message = _message(name, octets)
                    # In memory, texts and lists of zeros take four times the bytes of their JSON.
                    if name != "scan":
                        allowance.spend(3 * len(octets))
                    if isinstance(message, Hello):
                        board = message
                    elif board is None:
                        raise ValueError("no board says hello in it before the first message")
                    elif timed and isinstance(message, Scan | Mark):
                        log_ns = int.from_bytes(content[_LOG_TIME], "little")
                        clock = clock or ScanClock(log_ns - round(1e9 * message.host_time_s))
                        if isinstance(message, Scan):
                            log_ns = clock.time_ns(message, board)
                        message = replace(message, time_ns=log_ns)
                    if watch is not None:
                        watch(file.tell())
                    yield message
                is_whole = opcode == Opcode.FOOTER
        if board is None:
            raise ValueError("no recording of a skin, or cut off before a board says hello in it")
        if is_whole:
            yield None
    except OSError as exc:
        raise RecordingError(f"{path}: cannot be read: {exc.strerror or exc}") from exc
    except _DAMAGE as exc:
        raise RecordingError(f"{path}: damaged: {exc}") from exc
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as exc:
        text = f"no field {exc}" if isinstance(exc, KeyError) else str(exc).partition("\n")[0]
        raise RecordingError(f"{path}: {text}") from exc


class _Allowance:
    """How many bytes of memory the file may still take. Chunks and their messages spend them."""

    def __init__(self, file: BinaryIO) -> None:
        self._left_bytes = _UNPACKED_BYTES + _MOST_UNPACKED * stored_bytes(file)

    def spend(self, octets: int) -> None:
        self._left_bytes -= octets
        if self._left_bytes < 0:
            raise ValueError(f"damaged: it unpacks to over {_MOST_UNPACKED} times its size")


def _records(file: BinaryIO, allowance: _Allowance) -> Iterator[tuple[int, bytes]]:
    """Opcodes and contents of the records that matter, up to the footer or where it was cut off.

    A record is read only if its length is not too large. Lengths inside of it cannot take more
    memory: they only cut pieces from what was read.
    """
    if (magic := file.read(len(_MAGIC))) != _MAGIC:
        cut_off = "the file is cut off before its first record"
        raise ValueError(cut_off if _MAGIC.startswith(magic) else "no MCAP file")
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        opcode, size = _HEAD.unpack(head)
        if not opcode:
            return  # zeros, as a system that crashed leaves them in place of its last writes
        if size > LARGEST_RECORD_BYTES:
            raise ValueError(f"damaged: a record of {size} bytes, more than any recorder writes")
        if opcode not in _READ:
            file.seek(size, os.SEEK_CUR)
            continue
        content = file.read(size)
        if len(content) < size:
            return
        if opcode == Opcode.CHUNK:
            try:
                yield from _unpacked(content, allowance)
            except (*_DAMAGE, ValueError):
                if any((content[-_ZEROS:] + file.read(_HEAD.size))[-_ZEROS:]):
                    raise
                return  # those zeros begin in this chunk
        else:
            yield opcode, content
        if opcode == Opcode.FOOTER:
            return


def _unpacked(content: bytes, allowance: _Allowance) -> Iterator[tuple[int, bytes]]:
    """The records of a chunk. Raises ValueError if its stated size is false or out of proportion.

    At most one byte more than the stated size is unpacked: enough to see that the size is false.
    """
    size, crc = _CHUNK.unpack_from(content)
    kind, at = _text(content, _CHUNK.size)
    octets = content[at + 8 : at + 8 + int.from_bytes(content[at : at + 8], "little")]
    if size > LARGEST_RECORD_BYTES:
        raise ValueError("damaged: a chunk larger than any recorder writes")
    allowance.spend(size)
    if kind == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_RECORD_BYTES)
        octets = unpacker.stream_reader(octets).read(size + 1)
    elif kind == "lz4":
        octets = lz4.frame.LZ4FrameDecompressor().decompress(octets, size + 1)
    if len(octets) != size:
        raise ValueError(f"damaged: a chunk that states {size} bytes has not as many")
    if crc not in (0, zlib.crc32(octets)):
        raise ValueError("damaged: a chunk is not what was written")
    at = 0
    while at < size:
        opcode, length = _HEAD.unpack_from(octets, at)
        at += _HEAD.size + length
        if not opcode or at > size:
            raise ValueError("damaged: a record goes beyond its chunk")
        allowance.spend(max(_LEAST_RECORD_BYTES - length, 0))
        if opcode in _READ:
            yield opcode, octets[at - length : at]


def _text(content: bytes, at: int) -> tuple[str, int]:
    """The text that stands there, and where it ends."""
    end = at + 4 + int.from_bytes(content[at : at + 4], "little")
    return content[at + 4 : end].decode(), end


def check_message(name: str, octets: bytes) -> None:
    """Raise ValueError if a message is larger than any message of this topic."""
    if len(octets) > _LARGEST_MESSAGE_BYTES["rows" in SCHEMAS[name] and name != "hello"]:
        raise ValueError(f"a message {name} of {len(octets)} bytes: no recorder writes that")


def _message(name: str, octets: bytes) -> Recorded:
    """The message of a topic. Raises ValueError or KeyError for what no recorder writes."""
    check_message(name, octets)
    content = json.loads(octets)
    if not isinstance(content, dict):
        raise ValueError(f"a message {name} is no JSON object")
    # Old recordings do not state these fields: there was one mode, and delays were not measured.
    content.setdefault("mode", "near")
    content.setdefault("delay_s", 0.0)
    content = layouts.today(name, content)  # boards had other fields then
    values = {key: _value(key, content[key], form) for key, form in SCHEMAS[name].items()}
    if values.get("mode", "near") not in MODES:
        raise ValueError(f"no mode {values['mode']!r:.40}: there are {', '.join(MODES)}")
    if not 0 <= values.get("delay_s", 0.0) <= _LARGEST_DELAY_S:
        raise ValueError(f"delay_s {values['delay_s']:g}: no line delays so much, or so little")
    if name == "hello":
        return _hello(values)
    for of_cells in {"codes", "rest_ratio"} & values.keys():
        shape = values.pop("rows"), values.pop("columns"), len(MODES[values["mode"]])
        values[of_cells] = _cells(of_cells, values[of_cells], shape)
        if of_cells == "codes":
            for mask, count in zip(("row_mask", "column_mask"), shape, strict=False):
                lines_of(values[mask], count)  # raises ValueError for lines beyond the skin
        if of_cells == "codes" and values["codes"].max() >> check_adc_bits(values["adc_bits"]):
            raise ValueError("codes: one is out of range")
        if of_cells == "rest_ratio" and not np.all(abs(values[of_cells] - 0.5) <= 0.5):
            raise ValueError("rest_ratio: one is not in 0..1")
    return KINDS[name](**values)


def _hello(values: dict[str, Any]) -> Hello:
    del values["host_time_s"]
    values["reset_cause"] = tuple(map(str, values["reset_cause"]))
    hello = Hello(**values)
    if odd := hello.impossible():
        raise ValueError(f"hello says {odd}, which cannot be")
    return hello


def _cells(name: str, values: Any, shape: tuple[int, int, int]) -> NDArray[Any]:
    """The readings of all cells, of this shape, from the list that stands for them."""
    rows, columns, _ = shape
    check_size(rows, columns)
    try:
        # `array` refuses what is no number, and for codes what is no integer. And it takes a third
        # of the time of numpy.
        readings = array("H" if name == "codes" else "d", values)
    except (TypeError, OverflowError):
        raise ValueError(f"{name}: one is out of range") from None
    if len(readings) != math.prod(shape):
        raise ValueError(f"{len(readings)} {name} do not make {rows}x{columns} cells")
    return np.array(readings).reshape(shape)


def _value(name: str, value: Any, form: dict[str, Any]) -> Any:
    """A value, if it has this form. The elements of arrays are checked later, in `_cells`."""
    if form["type"] == "integer":
        least = form.get("minimum", 0)
        if type(value) is not int or not least <= value <= _LARGEST_COUNTER:
            raise ValueError(f"{name} is {value!r:.40}, not an integer from {least}")
    elif form["type"] == "number":
        if type(value) not in (int, float) or not math.isfinite(value):
            raise ValueError(f"{name} is {value!r:.40}, not a number")
        return float(value)
    return str(value) if form["type"] == "string" else value
