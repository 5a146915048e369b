# SPDX-License-Identifier: Apache-2.0
"""What is fuzzed: each target takes bytes, and lets no exception out but a defect.

A target's inputs begin with a byte that says how the rest is meant, so that mutations reach what
lies behind checksums and packing. `seeds` gives inputs that are right, to begin with.
"""

import atexit
import json
import os
import shutil
import struct
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from mcap.writer import CompressionType, Writer

from calibrations import calibration
from fuzz.page import Strangers
from ohmskin.calibrate.tables import load_force_log, load_press_table
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import SteppedLink, SteppedSkin
from ohmskin.emulate.scenes import Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import OhmskinError, PortError, RecordingError
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.geometry import Geometry
from ohmskin.force.reader import CalibratedSkin
from ohmskin.force.tables import export
from ohmskin.link import framing, protocol
from ohmskin.link.clock import BoardClock, line_delay_s, scan_s, scan_times_s
from ohmskin.link.device import configuration
from ohmskin.link.messages import BoardDecoder, Hello, Scan
from ohmskin.link.serial_port import READ_TIMEOUT_S
from ohmskin.record.force_sensor import ForceLineDecoder
from ohmskin.record.readings import MAX_CELLS, load_readings
from ohmskin.record.recording import SCHEMAS, TOPIC, load_recording, messages

Target = Callable[[bytes], None]
# Readers take names of files. They are made here: in memory, where there is a place for that.
_MEMORY = Path("/dev/shm")
_FOLDER = Path(tempfile.mkdtemp(dir=_MEMORY if _MEMORY.is_dir() else None))
atexit.register(shutil.rmtree, _FOLDER)
_PACKED = tuple(CompressionType)
# The byte for a file with a hole behind it, and its size with that: more than any limit of memory.
_SPARSE = bytes([len(_PACKED)])
_HOLE_BYTES = 3_000_000_000
# What a board says of itself is shorter, as text: 33 numbers and some words.
_LONGEST_HELLO = 2000
_KINDS = tuple(SCHEMAS)
_FRAMES = tuple(protocol.FRAMES_BY_ID)


def one_line(error: Exception) -> None:
    """A text for people."""
    assert str(error)
    assert "\n" not in str(error), str(error)


def file_of(octets: bytes, suffix: str = "") -> Path:
    path = _FOLDER / f"input{suffix}"
    path.write_bytes(octets)
    return path


# ---------------------------------------------------------------------------------------- frames


def _stretches(octets: bytes) -> Iterator[bytes]:
    """Each is a byte of its kind, two of its length, and what is framed, or comes as it is."""
    at = 0
    while at + 3 <= len(octets):
        kind, size = struct.unpack_from("<BH", octets, at)
        content = octets[at + 3 : at + 3 + size]
        at += 3 + size
        if kind < len(_FRAMES):
            content = framing.encode(_FRAMES[kind], at, content)
        yield content


def _cut(octets: bytes) -> Iterator[bytes]:
    """The same, each with its kind before it, and none framed."""
    at = 0
    while at + 3 <= len(octets):
        kind, size = struct.unpack_from("<BH", octets, at)
        yield bytes([kind]) + octets[at + 3 : at + 3 + size]
        at += 3 + size


def _stretch(kind: int, content: bytes) -> bytes:
    return struct.pack("<BH", kind, len(content)) + content


def frames(octets: bytes) -> None:
    """What a board sends, decoded, and all that is computed from its `hello`."""
    decoder, clock, board = BoardDecoder(), BoardClock(), None
    for number, stretch in enumerate(_stretches(octets)):
        for message in decoder.feed(stretch, number / 100):
            if isinstance(message, Hello) and not message.impossible():
                board = message
                protocol.FRAMES["configure"].pack(**configuration(board))
                assert board.rate_hz >= 0.1
            if isinstance(message, Scan):
                assert message.codes.size <= MAX_CELLS * protocol.CONSTANTS["readings"]
                assert len(message.reading_names) == message.codes.shape[2]
            if isinstance(message, Scan) and board is not None:
                end_us = message.time_us + 1e6 * scan_s(board, message)
                clock.add(end_us, message.host_time_s - line_delay_s(message, board))
                assert np.isfinite(clock.host_s(end_us))
                if message.codes.shape[:2] == (board.rows, board.columns):
                    try:
                        make_estimator("ohm", SkinKnowledge.of(board)).estimate(message.ratio)
                    except ValueError as error:
                        one_line(error)
                        assert board.mode != "near"  # the only one that `ohm` takes


class _Line(SteppedLink):
    """A line behind which boards change. `more` comes after what the board sends."""

    more = b""

    def read(self, limit_s: float = READ_TIMEOUT_S) -> bytes:
        octets, self.more = super().read(limit_s) + self.more, b""
        return octets


# Those that come: the one that was calibrated, another unit, and the same set otherwise.
_BOARDS = (
    BoardSettings(2, 3),
    BoardSettings(2, 3, unit_id=1),
    BoardSettings(3, 2),
    BoardSettings(2, 3, mode="far"),
    BoardSettings(2, 3, rate_hz=20.0),
)


@lru_cache
def _scene(number: int) -> Scene:
    return Scene("rest", _BOARDS[number].rows, _BOARDS[number].columns)


def _board(number: int) -> EmulatedBoard:
    return EmulatedBoard(_scene(number).ratio, _BOARDS[number])


@lru_cache
def _calibration() -> Calibration:
    """Of the first board."""
    return calibration(_scene(0).rest_ratio, "ohm")


def boards(octets: bytes) -> None:
    """Boards that change behind one line, and what they send besides, before a calibrated skin.

    A stretch of a kind below their number brings that board, any other comes as it is.
    """
    line = _Line(_board(0))
    try:
        with CalibratedSkin(SteppedSkin(line), _calibration()) as skin:
            for stretch in [b"", *_cut(octets)]:
                if stretch[:1] and stretch[0] < len(_BOARDS):
                    line.board = _board(stretch[0])
                else:
                    line.more = stretch[1:]
                for _ in range(3):
                    found = skin.latest()
                    assert found.force_n.shape == (2, 3)
                    told = skin.info
                    of = (told.unit_id, told.rows, told.columns, told.mode)
                    assert of == (0, 2, 3, "near"), f"forces of another board: {of}"
    except (OhmskinError, ValueError) as error:
        one_line(error)


def strangers(octets: bytes) -> None:
    """What those say to the page who have not its token."""
    server().meet([(each[0], each[1:]) for each in _cut(octets)])


@lru_cache
def server() -> Strangers:
    return Strangers()


def forces(octets: bytes) -> None:
    """What a force sensor prints; the first byte says which column is wanted."""
    decoder = ForceLineDecoder(column=("", "3", "Fz", "")[octets[0] % 4] if octets else "")
    for at in range(0, len(octets), 7):
        assert np.isfinite(decoder.feed(octets[at : at + 7])).all()


# ----------------------------------------------------------------------------------------- files


def recordings(octets: bytes) -> None:
    """A recording. 0 to 2: messages, a line each, packed so; 3: a file with a hole behind it.

    Else the file as it is.
    """
    how, path = octets[:1], file_of(octets[1:], ".mcap")
    if how == _SPARSE:
        os.truncate(path, _HOLE_BYTES)
    elif how and how[0] < len(_PACKED):
        with path.open("wb") as file:
            writer = Writer(file, compression=_PACKED[how[0]])
            writer.start()
            schema = writer.register_schema("x", "jsonschema", b"{}")
            known = [writer.register_channel(TOPIC + name, "json", schema) for name in _KINDS]
            for line in octets[1:].split(b"\n"):
                if line:
                    writer.add_message(known[line[0] % len(known)], 0, line[1:], 0)
            writer.finish()
    try:
        recording = load_recording(path)
        if recording.scans:  # as a calibration does of it
            assert len(scan_times_s(recording.scans)) == len(recording.scans)
        for message in messages(path, timed=True):  # as forces are read
            if isinstance(message, Hello):
                assert not message.impossible()
                assert len(repr(message)) < _LONGEST_HELLO
            if isinstance(message, Scan):
                assert message.codes_read.size, message.time_ns
        for suffix in (".npz", ".csv"):
            with suppress(RecordingError):
                export(path, path.with_suffix(suffix))
                if suffix == ".npz":
                    with suppress(ValueError):  # a rest from elsewhere may be out of range
                        load_readings(path.with_suffix(suffix))
    except RecordingError as error:
        one_line(error)


def readings(octets: bytes) -> None:
    """A readings file. 0: its arrays, each a line of name, type, shape and data; else as it is."""
    path = file_of(octets[1:], ".npz")
    if octets[:1] == b"\0":
        with ZipFile(path, "w", ZIP_DEFLATED) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a name that stands twice
            for line in octets[1:].split(b"\n"):
                name, descr, shape, data = (*line.split(b"|", 3), b"", b"", b"")[:4]
                header = b"{'descr':'%b','fortran_order':False,'shape':(%b)}\n" % (descr, shape)
                begin = b"\x93NUMPY\1\0" + struct.pack("<H", len(header) % 2**16)
                name_text = name.decode(errors="replace").replace("\0", "")
                archive.writestr(f"{name_text}.npy", begin + header + data)
    with suppress(ValueError):
        load_readings(path)


def calibrations(octets: bytes) -> None:
    """A calibration: what is read can be used, and is saved as it was read."""
    try:
        known = load_calibration(path := file_of(octets, ".json"))
    except ValueError as error:
        one_line(error)
        return
    level = known.untouched.level
    known.model.predict(0.1 * level, 0.01 * level)
    known.save(path)
    saved = path.read_bytes()
    load_calibration(path).save(path)
    assert path.read_bytes() == saved


def tables(octets: bytes) -> None:
    """A table of presses, a log of forces, or where taxels are."""
    path = file_of(octets, ".csv")
    for load in (
        load_press_table,
        load_force_log,
        partial(Geometry.of_file, rows=1, columns=2, frame_id="x"),
    ):
        try:
            load(path)
        except ValueError as error:
            one_line(error)


def urls(octets: bytes) -> None:
    """The options of an emulated board."""
    text = octets.decode(errors="replace")
    with suppress(PortError):  # its text repeats what was typed
        board, _, faults = emulated("emulator://2x2?" + text)
        board.heard(faults, 0.01)


TARGETS: dict[str, Target] = {
    each.__name__: each
    for each in (
        *(frames, boards, strangers, forces),
        *(recordings, readings, calibrations, tables, urls),
    )
}


def seeds() -> dict[str, Sequence[bytes]]:
    """Inputs that are right, of each target."""
    board, _, _ = emulated("emulator://2x3?scene=multi&begin=0")
    decoder = framing.Decoder()
    sent = decoder.feed(board.advance(0.0))
    start = protocol.FRAMES["start"]
    board.receive(framing.encode(start.id, 0, b""))
    sent += decoder.feed(board.advance(0.05))
    stream = b"".join(_stretch(_FRAMES.index(each.type), each.payload) for each in sent)
    found = [
        m for raw in sent for m in BoardDecoder().feed(framing.encode(raw.type, 0, raw.payload), 0)
    ]
    hello = next(m for m in found if isinstance(m, Hello))
    scan = next(m for m in found if isinstance(m, Scan))
    size = {"rows": 2, "columns": 3}
    said = {
        "hello": asdict(hello),
        "scan": {
            "number": 1,
            "time_us": 9,
            "missed": 0,
            **size,
            "row_mask": 3,
            "column_mask": 7,
            "adc_bits": 10,
            "slot_cycles": 0,
            "delay_s": 0.001,
            "codes": scan.codes.ravel().tolist(),
        },
        "tare": {**size, "rest_ratio": scan.ratio.ravel().round(3).tolist()},
        "mark": {"text": "here"},
        "force": {"force_n": 1.5, "source": "x"},
    }
    lines = b"\n".join(
        bytes([_KINDS.index(name)]) + json.dumps({"host_time_s": 1.0, **content}).encode()
        for name, content in said.items()
    )
    recordings(b"\0" + lines)
    calibration(scan.ratio).save(_FOLDER / "input.json")
    recorded, out = (_FOLDER / f"input{suffix}" for suffix in (".mcap", ".npz"))
    presses = "row,column,force_n,conductance\n" + "0,1,1.5,2e-5\n" * 3
    log = "time_s,force_n\n" + "".join(f"{n / 10},{n % 3}\n" for n in range(12))
    taxels = "0 .1 0 0 0 1\n" * 2, '<a><taxel idx="1" xyz="1 0 0" rpy="0 1 0"/><taxel/></a>'
    host, key = b"Host: 127.0.0.1\r\n", b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    asks = (
        *(b"GET / HTTP/1.1\r\n" + host + b"\r\n", b"GET /draw.js HTTP/1.1\r\n" + host + b"\r\n"),
        b"POST /boards?token=x HTTP/1.1\r\n" + host + b"Content-Length: 9\r\n\r\nx",
        b"GET /boards/0 HTTP/1.1\r\n" + host + upgrade + key + b"\r\n",
        *(b"GET", b"\x16\x03\x01\r\n\r\n", b""),
    )
    again = framing.encode(sent[0].type, 9, sent[0].payload)
    return {
        "frames": [stream, _stretch(255, board.advance(0.2))],
        "boards": [
            _stretch(8, b"\0") + _stretch(255, again),
            *(_stretch(kind, b"") + _stretch(9, b"\0") for kind in range(len(_BOARDS))),
        ],
        "strangers": [
            b"".join(_stretch(kind, said) for kind, said in enumerate(asks)),
            *(_stretch(0, said) + _stretch(24, b"") + _stretch(16, b"") for said in asks),
        ],
        "forces": [b"1.5\r\n-2 N\n\n3e-1N\nabc\n", b"2\nt,Fz\n1,2 g\n", b"0\nST,GS,+  1 kg\n9,5\n"],
        "recordings": [
            *(bytes([how]) + lines for how in range(len(_PACKED))),
            *(how + recorded.read_bytes() for how in (_SPARSE, b"\xff")),
        ],
        "readings": [
            b"\xff" + out.read_bytes(),
            b"\0ratio|<f8|1,1,1,4|" + bytes(32) + b"\nreading_names|<U1|4,|a\0\0\0b\0\0\0",
        ],
        "calibrations": [(_FOLDER / "input.json").read_bytes()],
        "tables": [presses.encode(), log.encode(), *(text.encode() for text in taxels)],
        "urls": [
            b"scene=ghost&begin=0&seed=3&noise=1",
            b"rate=100&wires=2&hum=50&dead=0,1&drop=0.5&reset=1",
        ],
    }
