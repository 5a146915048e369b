# SPDX-License-Identifier: Apache-2.0
"""Board messages from bytes, and what is counted between them: gaps, wraps, restarts, strangers."""

import copy
import pickle
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import wire
from ohmskin.link import framing, protocol
from ohmskin.link.messages import Ack, BoardDecoder, ForeignHello, Hello, Scan, SelfTestReport

SCAN = protocol.FRAMES["scan"]
MINUTE_US = 60_000_000


def scan_payload(number: int, **header: Any) -> bytes:
    codes = np.arange(8, dtype=np.uint16).reshape(1, 2, 4)
    return wire.scan_payload(codes, **({"scan": number, "mode": "far"} | header))


def scan_wire(number: int, **header: int) -> bytes:
    return framing.encode(SCAN.id, 0, scan_payload(number, **header))


def hello_payload(**changed: Any) -> bytes:
    values: dict[str, Any] = {f.name: 1 for f in protocol.FRAMES["hello"].fields}
    values |= {"layout_crc": protocol.LAYOUT_CRC, "board": "uno", "reset_cause": ("external",)}
    values |= {"accuracy": "usual", "mode": "far", "whole_mode": "near", "settings": "stored"}
    return protocol.FRAMES["hello"].pack(**(values | {"scanning": 0} | changed))


def hello_wire(**changed: Any) -> bytes:
    return framing.encode(protocol.FRAMES["hello"].id, 0, hello_payload(**changed))


def scans(decoder: BoardDecoder, octets: bytes, host_time_s: float = 0.0) -> list[Scan]:
    return [m for m in decoder.feed(octets, host_time_s) if isinstance(m, Scan)]


TOP = (1 << 32) - 1
# What comes first, the numbers of the scans after it, and how many were missed before each.
NUMBERS = {
    "gaps": (hello_wire(), [0, 1, 5, 6, 9], [0, 0, 3, 0, 2]),
    "lost right after the start": (hello_wire(), [4], [4]),
    "a board that runs already": (hello_wire(scanning=1), [700, 702], [0, 1]),
    "the number wraps": (b"", [TOP - 1, TOP, 0, 3], [0, 0, 0, 2]),
    "a restart that nobody has seen": (b"", [1000, 1001, 1, 2], [0, 0, 1, 0]),
}


@pytest.mark.parametrize("what", NUMBERS)
def test_numbers_tell_which_scans_are_missed(what: str) -> None:
    before, numbers, missed = NUMBERS[what]
    decoder = BoardDecoder()
    found = scans(decoder, before + b"".join(map(scan_wire, numbers)))
    assert [s.number for s in found] == numbers
    assert [s.missed for s in found] == missed
    assert (decoder.stats.scans, decoder.stats.missed) == (len(numbers), sum(missed))


def test_what_a_running_board_dropped_before_is_not_missed() -> None:
    decoder = BoardDecoder()
    scans(decoder, hello_wire(scanning=1) + scan_wire(700, dropped=9) + scan_wire(702, dropped=9))
    assert decoder.stats.missed == 1


def test_the_board_time_does_not_wrap() -> None:
    decoder = BoardDecoder()
    stream = b"".join(
        scan_wire(number, time_us=number * 20 * MINUTE_US % (1 << 32)) for number in range(12)
    )
    assert [s.time_us for s in scans(decoder, stream)] == [n * 20 * MINUTE_US for n in range(12)]


def test_the_counters_of_the_board_are_passed_on_and_that_of_dropped_scans_wraps() -> None:
    decoder = BoardDecoder()
    for number, (dropped, errors) in enumerate([(65530, 3), (65535, 3), (2, 5), (2, 5)]):
        scans(decoder, scan_wire(number, dropped=dropped, rx_errors=errors))
    assert (decoder.stats.dropped_by_board, decoder.stats.board_rx_errors) == (8, 5)


def test_the_counter_of_dropped_scans_starts_again_with_the_board() -> None:
    decoder = BoardDecoder()
    scans(decoder, hello_wire() + scan_wire(2, dropped=2) + scan_wire(4, dropped=3))
    assert (decoder.stats.dropped_by_board, decoder.stats.missed) == (3, 3)
    scans(decoder, hello_wire() + scan_wire(1, dropped=1) + scan_wire(2, dropped=1))
    assert (decoder.stats.dropped_by_board, decoder.stats.missed) == (4, 4)


def test_a_restart_in_between_starts_the_numbers_again() -> None:
    decoder = BoardDecoder()
    stream = hello_wire() + scan_wire(0, time_us=9000) + scan_wire(1, time_us=20_000)
    stream += hello_wire() + scan_wire(2, time_us=400) + scan_wire(3, time_us=11_500)
    found = scans(decoder, stream)
    assert [s.missed for s in found] == [0, 0, 2, 0]
    assert [s.time_us for s in found] == [9000, 20_000, 400, 11_500]
    assert decoder.stats.missed == 2


def test_board_time_goes_on_after_a_stop_later_than_its_first_wrap() -> None:
    decoder = BoardDecoder()
    found = []
    for number in range(5):  # 80 minutes; the counter wraps after 71.6
        time_us = number * 20 * MINUTE_US
        found += scans(decoder, scan_wire(number, time_us=time_us % (1 << 32)), time_us * 1e-6)
    assert found[-1].time_us == 80 * MINUTE_US
    # Configured anew, and started two minutes later.
    stopped = hello_wire() + scan_wire(0, time_us=82 * MINUTE_US % (1 << 32))
    assert scans(decoder, stopped, 82 * 60.0)[0].time_us == 82 * MINUTE_US
    # A reset, however, starts the time again.
    restarted = hello_wire() + scan_wire(0, time_us=1_200_000)
    assert scans(decoder, restarted, 83 * 60.0)[0].time_us == 1_200_000


def test_board_time_starts_small_whatever_the_host_has_been_doing() -> None:
    decoder = BoardDecoder()
    (first,) = scans(decoder, hello_wire() + scan_wire(0, time_us=500), host_time_s=1e6)
    assert first.time_us == 500


def test_hello_of_another_definition() -> None:
    other = protocol.LAYOUT_CRC ^ 1
    kind = protocol.FRAMES["hello"]
    for payload in (
        hello_payload(layout_crc=other),
        other.to_bytes(2, "little"),
        other.to_bytes(2, "little") + bytes(range(200)),
    ):
        messages = BoardDecoder().feed(framing.encode(kind.id, 0, payload), 0.0)
        assert messages == [ForeignHello(other)]
    # Of this definition by its CRC, but not by its length.
    messages = BoardDecoder().feed(framing.encode(kind.id, 0, hello_payload()[:-1]), 0.0)
    assert messages == [ForeignHello(protocol.LAYOUT_CRC)]


PAYLOADS = {
    "ack": bytes(protocol.FRAMES["ack"].struct.size),
    "self_test_report": bytes(protocol.FRAMES["self_test_report"].struct.size),
    "scan": scan_payload(5),
}
STRANGE = {
    **{f"type {kind:#x}": (kind, b"abc") for kind in (0x00, 0x05, 0x40, 0x7F, 0xFF, 0x81, 0x89)},
    **{f"short {name}": (protocol.FRAMES[name].id, x[:-1]) for name, x in PAYLOADS.items()},
    **{f"long {name}": (protocol.FRAMES[name].id, x + b"\0") for name, x in PAYLOADS.items()},
    "a scan of readings that nobody knows": (SCAN.id, scan_payload(5, mode=4)),
    "a scan of no rows": (SCAN.id, scan_payload(5, row_mask=0)),
    "a scan of rows beyond the skin": (SCAN.id, scan_payload(5, row_mask=2)),
    "a scan of codes of no bits": (SCAN.id, scan_payload(5)[:15] + b"\0" + scan_payload(5)[16:]),
    "one cell out of more than a board has": (
        SCAN.id,
        SCAN.pack(**wire.scan_fields(255, 255, row_mask=1, column_mask=1)) + bytes(5),
    ),
    "an empty hello": (protocol.FRAMES["hello"].id, b""),
    "a hello without its layout": (protocol.FRAMES["hello"].id, b"\1"),
}


@pytest.mark.parametrize("what", STRANGE)
def test_frames_of_unknown_type_or_wrong_length_are_counted(what: str) -> None:
    frame_type, payload = STRANGE[what]
    decoder = BoardDecoder()
    assert decoder.feed(framing.encode(frame_type, 0, payload), 0.0) == []
    assert (decoder.stats.unknown, decoder.stats.scans, decoder.stats.line.damaged) == (1, 0, 0)
    assert len(scans(decoder, scan_wire(0))) == 1


def test_a_scan_of_no_cells_does_no_harm() -> None:
    decoder = BoardDecoder()
    for rows, columns in [(0, 0), (0, 8), (255, 255)]:
        payload = SCAN.pack(**wire.scan_fields(rows, columns))
        decoder.feed(framing.encode(SCAN.id, 0, payload), 0.0)
    assert scans(decoder, scan_wire(0))[0].codes.shape == (1, 2, 4)


@pytest.mark.parametrize(
    ("message", "name"), [(Hello, "hello"), (Ack, "ack"), (SelfTestReport, "self_test_report")]
)
def test_a_message_has_the_fields_of_its_frame(message: type[Any], name: str) -> None:
    assert [f.name for f in fields(message)] == [f.name for f in protocol.FRAMES[name].fields]


def test_values_of_a_newer_definition_have_a_name() -> None:
    octets = framing.encode(protocol.FRAMES["ack"].id, 0, bytes([0x83, 7, 200, *bytes(8)]))
    assert BoardDecoder().feed(octets, 0.0) == [Ack(0x83, 7, "unknown_200", 0, 0)]


@pytest.mark.parametrize("name", ["contacts", "estimate", "force_n", "touch_force_n", "wrench"])
def test_a_scan_without_forces_says_how_to_get_them(name: str) -> None:
    """Its AttributeError said only that there are none."""
    (scan,) = scans(BoardDecoder(), scan_wire(1))
    with pytest.raises(AttributeError, match=rf"'{name}': .* calibration is given: ohmskin\.open"):
        getattr(scan, name)
    with pytest.raises(AttributeError, match=r"^'Scan' object has no attribute 'contact'$"):
        scan.contact  # type: ignore[attr-defined]  # noqa: B018
    assert not hasattr(scan, name)
    assert repr(copy.deepcopy(pickle.loads(pickle.dumps(scan)))) == repr(scan)
