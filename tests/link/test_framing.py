# SPDX-License-Identifier: Apache-2.0
"""Frames from byte streams: however they are cut, and whatever happens to them on the way.

Streams are made with the `cobs` package and a CRC written here, so that encoder and decoder cannot
share an error.
"""

import itertools
import struct
import tracemalloc

import numpy as np
import pytest
from cobs import cobs
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ohmskin.link import framing, protocol
from ohmskin.link.framing import MAX_FRAME_BYTES, Decoder, RawFrame
from ohmskin.link.messages import BoardDecoder, Scan
from wire import scan_payload


def textbook_crc(octets: bytes) -> int:
    crc = 0xFFFF
    for octet in octets:
        crc ^= octet << 8
        for _ in range(8):
            crc = ((crc << 1) ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def wire(frame: RawFrame) -> bytes:
    content = bytes([frame.type, frame.sequence]) + frame.payload
    return b"\0" + cobs.encode(content + struct.pack("<H", textbook_crc(content))) + b"\0"


octet = st.integers(0, 255)
# Short ones, ones of mostly zeros or none, and ones around the 254 bytes of a COBS block.
payloads = st.one_of(
    st.binary(max_size=40),
    st.lists(st.sampled_from([0, 0, 1, 255]), max_size=40).map(bytes),
    st.integers(240, 520).map(lambda size: b"\xaa" * size),
    st.integers(240, 520).map(lambda size: bytes(i % 255 for i in range(size))),
)
frames = st.builds(RawFrame, octet, octet, payloads)


@settings(max_examples=300)
@given(st.one_of(payloads, st.binary(max_size=1200)))
@example(b"")
@example(b"\0")
@example(b"\1" * 254)
@example(b"\1" * 254 + b"\0")
@example(b"\0" + b"\1" * 254)
@example(b"\1" * 255)
@example(b"\1" * 508)
def test_the_same_bytes_as_the_cobs_package(content: bytes) -> None:
    stuffed = cobs.encode(content)
    assert framing.cobs_encode(content) == stuffed
    assert framing.cobs_decode(stuffed) == content


@settings(max_examples=300)
@given(st.binary(max_size=600).map(lambda octets: octets.replace(b"\0", b"\1")))
@example(b"\1")
@example(b"\2")
@example(b"\xff" + b"\1" * 253)
def test_the_same_refusals_as_the_cobs_package(stuffed: bytes) -> None:
    try:
        expected = cobs.decode(stuffed)
    except cobs.DecodeError:
        expected = None
    assert framing.cobs_decode(stuffed) == expected


@given(frames, st.integers(0, 1 << 20))
def test_encode_writes_the_same_bytes_and_wraps_numbers(frame: RawFrame, wraps: int) -> None:
    sequence = frame.sequence + 256 * wraps
    assert framing.encode(frame.type, sequence, frame.payload) == wire(frame)


pieces = st.lists(
    st.one_of(
        frames.map(wire),
        st.binary(max_size=60),
        st.integers(1, 2 * MAX_FRAME_BYTES).map(lambda size: b"\x11" * size),
    ),
    max_size=8,
)


@settings(max_examples=200)
@given(pieces, st.lists(st.integers(0, 1 << 16), max_size=30))
@example([b"\x11" * MAX_FRAME_BYTES, b"\0"], [MAX_FRAME_BYTES - 1])
@example([b"\x11" * (MAX_FRAME_BYTES + 1), b"\0"], [MAX_FRAME_BYTES, MAX_FRAME_BYTES + 1])
def test_how_the_stream_is_cut_changes_nothing(pieces: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(pieces)
    whole, parts = Decoder(), Decoder()
    expected = whole.feed(stream)
    places = sorted(cut % (len(stream) + 1) for cut in cuts)
    found = []
    for start, end in zip([0, *places], [*places, len(stream)], strict=True):
        found += parts.feed(stream[start:end])
    # What is still open may have been found to be too long earlier or later: end it in both.
    assert found + parts.feed(b"\0") == expected + whole.feed(b"\0")
    assert parts.stats == whole.stats
    assert whole.stats.octets == len(stream) + 1


@given(st.lists(frames, max_size=6))
def test_all_frames_of_a_clean_stream_are_found(sent: list[RawFrame]) -> None:
    decoder = Decoder()
    assert decoder.feed(b"".join(wire(frame) for frame in sent)) == sent
    assert decoder.stats.frames == len(sent)
    assert decoder.stats.damaged == 0


@settings(max_examples=300)
@given(st.binary(max_size=400), frames)
def test_the_first_whole_frame_after_anything_is_found(before: bytes, frame: RawFrame) -> None:
    assert Decoder().feed(before + wire(frame))[-1] == frame


@settings(max_examples=150)
@given(frames, frames, frames, st.data())
def test_damage_to_one_frame_takes_no_other_along(
    first: RawFrame, middle: RawFrame, last: RawFrame, data: st.DataObject
) -> None:
    damaged = bytearray(wire(middle))
    for _ in range(data.draw(st.integers(1, 4), label="errors")):
        at = data.draw(st.integers(0, max(0, len(damaged) - 1)), label="at")
        match data.draw(st.sampled_from(["flip", "lose", "add"]), label="kind"):
            case "flip" if damaged:
                damaged[at] ^= 1 << data.draw(st.integers(0, 7), label="bit")
            case "lose" if damaged:
                del damaged[at]
            case _:
                damaged.insert(at, data.draw(octet, label="added"))
    found = Decoder().feed(wire(first) + bytes(damaged) + wire(last))
    assert found[0] == first
    assert found[-1] == last
    assert [f for f in found[1:-1] if f != middle] == []


@pytest.mark.parametrize(("size", "count"), [(4096, 2500), (1, 20 * MAX_FRAME_BYTES)])
def test_an_endless_stretch_does_not_fill_the_memory(size: int, count: int) -> None:
    """10 MB without a delimiter, or fewer bytes one by one."""
    decoder, chunk = Decoder(), b"\x11" * size
    for _ in range(10):
        decoder.feed(chunk)
    tracemalloc.start()
    for _ in range(count):
        assert decoder.feed(chunk) == []
    held, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10_000
    assert most < 100_000
    assert decoder.stats.overlong == 1
    good = RawFrame(1, 2, b"three")
    assert decoder.feed(wire(good)) == [good]
    assert decoder.stats.damaged == 1


def test_the_largest_frame_of_the_definition_fits() -> None:
    scan = protocol.FRAMES["scan"]
    limits = protocol.CONSTANTS
    codes = limits["rows_max"] * limits["columns_max"] * limits["readings_max"]
    size = scan.struct.size + protocol.codes_size(codes, limits["adc_bits_max"])
    for payload in (b"\x55" * size, bytes(size)):
        largest = RawFrame(scan.id, 0, payload)
        assert Decoder().feed(wire(largest)) == [largest]
    longer = Decoder()
    assert longer.feed(wire(RawFrame(scan.id, 0, b"\x55" * (size + 16)))) == []
    assert longer.stats.overlong == 1


def test_a_million_random_bytes_make_no_scan() -> None:
    noise = np.random.default_rng(1).bytes(1_000_000)
    cuts = np.sort(np.random.default_rng(2).integers(0, len(noise), 3000))
    decoder = BoardDecoder()
    messages = []
    for start, end in zip([0, *cuts], [*cuts, len(noise)], strict=True):
        messages += decoder.feed(noise[start:end], 0.0)
    line = decoder.stats.line
    print(f"10^6 random bytes: {line}, {decoder.stats.unknown} of an unknown type")
    assert messages == []
    assert decoder.stats.scans == 0
    assert line.octets == len(noise)
    # All that stands between two zeros, of which there are more than 3000.
    stretches = sum(1 for stretch in noise.split(b"\0")[:-1] if stretch)
    assert stretches > 3000
    assert line.frames + line.damaged == stretches


def test_bit_errors_never_deliver_a_damaged_scan() -> None:
    count, error_rate = 3_000, 1e-4
    random = np.random.default_rng(3)
    kind = protocol.FRAMES["scan"]
    sent = random.integers(0, 1024, (count, 8, 8, 4), dtype=np.uint16)
    decoder = BoardDecoder()
    delivered: list[Scan] = []
    hit = 0
    for number in range(count):
        payload = scan_payload(sent[number], scan=number, time_us=number * 11_111)
        octets = np.frombuffer(framing.encode(kind.id, number, payload), dtype=np.uint8)
        flips = np.packbits(random.random((octets.size, 8)) < error_rate, axis=1)[:, 0]
        hit += bool(flips.any())
        delivered += [
            m for m in decoder.feed((octets ^ flips).tobytes(), 0.0) if isinstance(m, Scan)
        ]
    stats = decoder.stats
    print(
        f"{count} scans, bit error rate {error_rate}: {hit} hit, {len(delivered)} delivered, "
        f"{stats.missed} missed, {stats.line}"
    )
    for scan in delivered:
        np.testing.assert_array_equal(scan.codes, sent[scan.number])
        assert scan.time_us == scan.number * 11_111
    assert hit > 600
    # An error in a delimiter costs a frame nothing where the next one's stands right behind it.
    assert count - hit <= len(delivered) < count - 0.97 * hit
    assert delivered[0].number + len(delivered) + stats.missed == delivered[-1].number + 1
    numbers = [scan.number for scan in delivered]
    assert [scan.missed for scan in delivered[1:]] == [
        after - before - 1 for before, after in itertools.pairwise(numbers)
    ]
