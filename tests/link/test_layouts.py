# SPDX-License-Identifier: Apache-2.0
"""Boards that were flashed before the definition changed: read, commanded, and refused by name."""

import json
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
import pytest

import ohmskin
from ohmskin.errors import CommandRefused
from ohmskin.link import framing, layouts, protocol
from ohmskin.link.device import Region
from ohmskin.link.messages import BoardDecoder, Hello, Scan
from ohmskin.link.session import Session
from places import DATA, ROOT
from skins import placed

# The definition of before there were regions, and golden frames of it, made by its own script.
BEFORE = 0x2FED
VECTORS = {
    vector["name"]: vector
    for vector in json.loads((DATA / "vectors_before_regions.json").read_text())["valid"]
}
# A scan of 8x8 in mode far; the vector's hello is of another day's layout.
SCAN = bytes.fromhex(VECTORS["scan 8x8"]["wire"])


def old(name: str) -> protocol.Frame:
    definition = protocol.definition(BEFORE)
    assert definition is not None
    return definition.frames[name]


def hello_fields() -> dict[str, Any]:
    fields = VECTORS["hello"]["fields"] | {"layout_crc": BEFORE}
    return fields | {"reset_cause": tuple(fields["reset_cause"]), "scan_cycles": 256 * 689}


def hello_wire(**says: Any) -> bytes:
    return framing.encode(old("hello").id, 0, old("hello").pack(**hello_fields() | says))


class OldBoard:
    """A `Link` to a board of before, which answers every command with ok."""

    name, resets_board = "old board", False

    def __init__(self) -> None:
        self._decoder, self._out = framing.Decoder(), SimpleQueue[bytes]()
        self.heard: list[tuple[str, dict[str, Any]]] = []
        self._says: dict[str, Any] = {}

    def write(self, octets: bytes) -> None:
        frames = protocol.definition(BEFORE).frames_by_id
        for raw in self._decoder.feed(octets):
            frame = frames[raw.type]
            self.heard.append((frame.name, frame.unpack(raw.payload)))
            if frame.name == "configure":
                asked = {"rate_mhz": "rate_asked_mhz", "settle_us": "settle_asked_us"}
                self._says = {asked.get(name, name): v for name, v in self.heard[-1][1].items()}
            if frame.name == "get_hello":
                self._out.put(hello_wire(**self._says))
            answer = {"command": raw.type, "command_sequence": raw.sequence, "result": "ok"}
            self._out.put(framing.encode(old("ack").id, 0, old("ack").pack(**answer)))
            if frame.name == "start":
                self._out.put(SCAN)

    def read(self) -> bytes:
        with suppress(Empty):
            return self._out.get(timeout=0.01)
        return b""

    def set_baud(self, baud: int) -> None:
        pass

    def close(self) -> None:
        pass


def test_every_definition_that_was_shipped_is_kept_unchanged() -> None:
    kept = {path.stem for path in (ROOT / "protocol" / "layouts").glob("*.toml")}
    assert kept >= {"2FED"}
    for name in kept:
        definition = protocol.definition(int(name, 16))
        assert f"{definition.layout_crc:04X}" == name


def test_an_old_board_is_read() -> None:
    decoder = BoardDecoder()
    hello, scan = decoder.feed(hello_wire() + SCAN, 1.0)
    assert isinstance(hello, Hello)
    assert isinstance(scan, Scan)
    assert (hello.layout_crc, hello.accuracy, hello.mode) == (BEFORE, "usual", "far")
    assert (hello.row_mask, hello.column_mask, hello.whole_every) == (0xFF, 0xFF, 0)
    assert hello.impossible() == ""
    codes = placed(VECTORS["scan 8x8"]["codes"], 8, 8)
    np.testing.assert_array_equal(scan.codes, codes)
    assert scan.is_whole
    assert np.isfinite(scan.ratio).all()


def test_an_old_board_is_configured_in_its_own_words_and_refused_what_it_cannot_do() -> None:
    board = OldBoard()
    with Session(board) as skin:
        skin.configure(accuracy="fine", settle_us=20)
        assert board.heard[-2] == (
            "configure",
            {"rows": 8, "columns": 8, "rate_mhz": 90_000, "settle_us": 20}
            | {"adc_prescaler": "clock_250khz", "mode": "far"},
        )
        for refused in (lambda: skin.configure(mode="quick"), lambda: skin.set_region(Region())):
            with pytest.raises(CommandRefused, match="too old: flash it") as told:
                refused()
            assert told.value.result == "unknown_command"
        assert skin.latest().mode == "far"


def test_frames_of_today_are_left_as_they_are() -> None:
    for name, frame in protocol.FRAMES.items():
        values = {field.name: field.name for field in frame.fields}
        assert layouts.today(name, values) == values
        assert layouts.asked(protocol.NOW, name, values) == values


def test_a_recording_of_the_oldest_layout_plays() -> None:
    """What the package of then has recorded, and its own export of it."""
    with np.load(DATA / "recording_2FED.npz") as told:
        ratio, numbers, time_us = (told[name] for name in ("ratio", "number", "time_us"))
    with ohmskin.open(f"replay://{DATA / 'recording_2FED.mcap'}?speed=0") as skin:
        assert skin.info.layout_crc == BEFORE
        scans = list(skin)
    np.testing.assert_array_equal([scan.ratio for scan in scans], ratio)
    assert [scan.number for scan in scans] == numbers.tolist()
    assert [scan.time_us for scan in scans] == time_us.tolist()
