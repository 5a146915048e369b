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

Codes are stored as numbers, not as frames of the link: a file outlives the protocol's layout, and
other programs can plot it. Packed, 8x8 at 90 Hz make 27 kB/s; codes that were all noise, 46 kB/s.
``host_time_s`` is that of `Scan`; log times are the same instants since 1970.

`recorder` writes them; `messages` reads one by one, `load_recording` all at once. A file
that was cut off anywhere is read up to its last whole chunk.
"""

import json
import math
import os
import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, fields
from typing import IO, Any, Final, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Footer, McapRecord
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READINGS_PER_CELL
from ohmskin.errors import RecordingError
from ohmskin.link.messages import Hello, Scan

# A second of 16x16 at full rate is 0.2 MB; rewriting tools make chunks of 4 MB.
LARGEST_RECORD: Final = 16_000_000
_LARGEST_CELLS: Final = 4096
_LARGEST_CODE: Final = 0xFFFF
_LARGEST_COUNTER: Final = (1 << 63) - 1

_NUMBER: Final = {"type": "number"}
_INTEGER: Final = {"type": "integer"}
_TEXT: Final = {"type": "string"}
_HOST_TIME: Final = {"type": "number", "description": "host's monotonic clock [s]"}
_SIZE: Final = {"rows": _INTEGER, "columns": _INTEGER}
_OF_TYPE: Final[dict[object, dict[str, Any]]] = {str: _TEXT, int: _INTEGER}
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "hello": {
        "host_time_s": _HOST_TIME,
        **{f.name: _OF_TYPE.get(f.type, {"type": "array", "items": _TEXT}) for f in fields(Hello)},
    },
    "scan": {
        "number": {"type": "integer", "description": "of the scan since the board was started"},
        "time_us": {"type": "integer", "description": "board time at the scan's start [us]"},
        "host_time_s": _HOST_TIME,
        "missed": {"type": "integer", "description": "scans before this one that never came"},
        **_SIZE,
        "codes": {
            "type": "array",
            "items": _INTEGER,
            "description": "ADC codes: row by row, in it column by column, A B C D of each cell",
        },
    },
    "tare": {
        "host_time_s": _HOST_TIME,
        **_SIZE,
        "rest_ratio": {"type": "array", "items": _NUMBER, "description": "V/Vdd, order of codes"},
    },
    "mark": {"host_time_s": _HOST_TIME, "text": _TEXT},
    "force": {
        "host_time_s": _HOST_TIME,
        "force_n": {"type": "number", "description": "reference force [N]"},
        "row": {"type": "integer", "description": "of the cell it acts on; -1: not known"},
        "column": {"type": "integer", "description": "of the cell it acts on; -1: not known"},
        "source": {"type": "string", "description": "what measured it"},
    },
}
TOPIC: Final = "/skin/"


@dataclass(frozen=True, eq=False)
class Tare:
    """Mean readings of the untouched skin, `rest_ratio` of shape (rows, columns, 4)."""

    rest_ratio: Float
    host_time_s: float


@dataclass(frozen=True)
class Mark:
    """A text that somebody set at a time."""

    text: str
    host_time_s: float


@dataclass(frozen=True)
class ForceSample:
    """A reference force [N]; `row`, `column`: the cell it acts on, -1 where that is not known."""

    force_n: float
    host_time_s: float
    row: int = -1
    column: int = -1
    source: str = ""


Recorded = Hello | Scan | Tare | Mark | ForceSample


@dataclass(eq=False)
class Recording:
    """All of a recording. `cut_off`: it was not ended properly, and its last second may be gone."""

    hellos: list[Hello] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    tares: list[Tare] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    forces: list[ForceSample] = field(default_factory=list)
    cut_off: bool = True


def load_recording(path: str | os.PathLike[str]) -> Recording:
    """Read a whole recording; that of a recorder that was killed, up to its last whole chunk.

    :raises RecordingError: one line that names the file and what is wrong with it.
    """
    recording = Recording()
    for message in messages(path):
        match message:
            case Hello():
                recording.hellos.append(message)
            case Scan():
                recording.scans.append(message)
            case Tare():
                recording.tares.append(message)
            case Mark():
                recording.marks.append(message)
            case ForceSample():
                recording.forces.append(message)
            case None:
                recording.cut_off = False
    return recording


def messages(path: str | os.PathLike[str]) -> Generator[Recorded | None, None, None]:
    """The messages of a recording in order, hello first; None last of all if it ended properly.

    :raises RecordingError: as `load_recording`.
    """
    topics: dict[int, str] = {}
    known = ended = False
    try:
        with open(path, "rb") as file:
            for record in _records(_Bounded(file)):
                match record:
                    case Channel(message_encoding="json", topic=topic) if topic.startswith(TOPIC):
                        topics[record.id] = topic.removeprefix(TOPIC)
                    case McapMessage() if topics.get(record.channel_id) in SCHEMAS:
                        message = _message(topics[record.channel_id], record.data)
                        if not known and not isinstance(message, Hello):
                            raise ValueError("no board says hello in it before the first message")
                        known = True
                        yield message
                    case Footer():
                        ended = True
        if not known and not ended:
            raise ValueError("cut off before the first message: nothing in it can be read")
        if not known:
            raise ValueError("no recording of a skin: no board says hello in it")
        if ended:
            yield None
    except OSError as exc:
        raise RecordingError(f"{path}: cannot be read: {exc.strerror or exc}") from exc
    except (ValueError, KeyError, TypeError, RecursionError) as exc:
        text = f"no field {exc}" if isinstance(exc, KeyError) else str(exc).partition("\n")[0]
        raise RecordingError(f"{path}: {text}") from exc


class _Bounded:
    """A file that never gives less than was asked for, nor tries to hold what is not there."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size

    def read(self, size: int) -> bytes:
        if size > self._left:
            raise EndOfFile
        self._left -= size
        return self._file.read(size)


def _records(file: _Bounded) -> Iterator[McapRecord]:
    """The records of an MCAP file, up to its footer or to where it was cut off."""
    reader = StreamReader(cast(IO[bytes], file), emit_chunks=True, record_size_limit=LARGEST_RECORD)
    records = reader.records
    first = True
    while True:
        try:
            record = next(records)
        except (StopIteration, EndOfFile):
            if first:
                raise ValueError("the file is cut off before its first record") from None
            return
        except (McapError, struct.error, UnicodeDecodeError) as exc:
            raise ValueError("no MCAP file" if first else f"damaged: {exc}") from exc
        first = False
        if not isinstance(record, Chunk):
            yield record
            if isinstance(record, Footer):
                return
            continue
        try:
            if _unpacked_size(record) > LARGEST_RECORD:
                raise ValueError("damaged: a chunk larger than any recorder writes")
            inside = breakup_chunk(record, validate_crc=True)
        except (
            *(CRCValidationError, McapError, struct.error, UnicodeDecodeError),
            *(zstandard.ZstdError, RuntimeError, MemoryError),
        ) as exc:
            raise ValueError(f"damaged: {exc}") from exc
        yield from inside


def _unpacked_size(chunk: Chunk) -> int:
    """What a chunk will take in memory: what its packed data say, not only its header."""
    declared = chunk.uncompressed_size
    if chunk.compression == "zstd":
        return max(declared, zstandard.frame_content_size(chunk.data))
    if chunk.compression == "lz4":
        return max(declared, int(lz4.frame.get_frame_info(chunk.data)["content_size"]))
    return declared


def _message(name: str, octets: bytes) -> Recorded:
    content = json.loads(octets)
    if not isinstance(content, dict):
        raise ValueError(f"a message {name} is no JSON object")
    if name == "hello":
        return _hello(content)
    host_time_s = _real(content, "host_time_s")
    if name == "scan":
        rows, columns, codes = _cells(content, "codes")
        if any(type(code) is not int or not 0 <= code <= _LARGEST_CODE for code in codes):
            raise ValueError("a code is out of range")
        return Scan(
            np.array(codes, np.uint16).reshape(rows, columns, READINGS_PER_CELL),
            _integer(content, "number"),
            _integer(content, "time_us"),
            host_time_s,
            _integer(content, "missed"),
        )
    if name == "tare":
        rows, columns, ratio = _cells(content, "rest_ratio")
        rest_ratio = np.array(ratio, np.float64).reshape(rows, columns, READINGS_PER_CELL)
        return Tare(rest_ratio, host_time_s)
    if name == "mark":
        return Mark(str(content["text"]), host_time_s)
    cell = (_integer(content, "row", least=-1), _integer(content, "column", least=-1))
    return ForceSample(_real(content, "force_n"), host_time_s, *cell, str(content["source"]))


def _hello(content: dict[str, Any]) -> Hello:
    values: dict[str, Any] = {}
    for each in fields(Hello):
        if each.name == "slot_cycles" and each.name not in content:
            # Older boards did not say it: their readings filled the scan, in slots of at most
            # 60,000 cycles, unless a settle time was asked for.
            readings = values["rows"] * values["columns"] * values["readings_per_cell"]
            values[each.name] = min(values["scan_cycles"] // max(readings, 1), 60_000)
        elif each.type is int:
            values[each.name] = _integer(content, each.name)
        elif each.type is str:
            values[each.name] = str(content[each.name])
        else:
            values[each.name] = tuple(map(str, content[each.name]))
    if not values["clock_hz"] or not values["scan_cycles"]:
        raise ValueError("hello: a board without a clock")
    return Hello(**values)


def _cells(content: dict[str, Any], name: str) -> tuple[int, int, list[Any]]:
    rows, columns = _integer(content, "rows", least=1), _integer(content, "columns", least=1)
    values = content[name]
    if rows * columns > _LARGEST_CELLS or not isinstance(values, list):
        raise ValueError(f"{name}: no {rows}x{columns} cells")
    if len(values) != rows * columns * READINGS_PER_CELL:
        raise ValueError(f"{len(values)} {name} do not make {rows}x{columns} cells")
    return rows, columns, values


def _integer(content: dict[str, Any], name: str, least: int = 0) -> int:
    number = content[name]
    if type(number) is not int or not least <= number <= _LARGEST_COUNTER:
        raise ValueError(f"{name} is {number!r:.40}, not an integer from {least}")
    return number


def _real(content: dict[str, Any], name: str) -> float:
    number = content[name]
    if type(number) not in (int, float) or not math.isfinite(number):
        raise ValueError(f"{name} is {number!r:.40}, not a number")
    return float(number)
