# SPDX-License-Identifier: Apache-2.0
"""Recordings that end badly: what is lost, and what is said of damaged and foreign files."""

import io
import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk
from mcap.writer import CompressionType, Writer

from command_line import EMPTY_MB, Command, Done, assert_one_line, bounded, finish, well
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.errors import RecordingError
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Hello
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import SCHEMAS, TOPIC, Mark, Recording, load_recording
from recordings import URL, assert_same, replayed, scan, write_recording
from waiting import until

pytestmark = pytest.mark.usefixtures("nothing_left")

# Scans reach the file within half a second; on a busy machine, within this [s].
LATE_S = 3.0


def test_a_closed_recording_takes_no_more(path: Path, hello: Hello) -> None:
    recorder = Recorder(path, hello)
    recorder.close()
    recorder.close()
    with pytest.raises(RecordingError, match="closed"):
        recorder.add(scan(0))


def test_a_silent_board_s_last_scans_reach_the_file(path: Path, hello: Hello) -> None:
    with Recorder(path, hello) as recorder:
        recorder.add(scan(0))
        until(lambda: load_recording(path).scans, LATE_S)
        found = load_recording(path)
    assert found.cut_off
    assert_same(found.scans, [scan(0)])


def test_a_program_that_closes_no_recording_ends_and_has_recorded_all(path: Path) -> None:
    program = f"""
import itertools, ohmskin
from ohmskin.record.recorder import Recorder
skin = ohmskin.open("emulator://3x4?speed=0")
recorder = Recorder({str(path)!r}, skin.info)
for scan in itertools.islice(skin, 30):
    recorder.add(scan)
raise SystemExit(3)
"""
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 3
    found = load_recording(path)
    assert (len(found.scans), found.cut_off) == (30, False)


def kept_waiting_s(process: int) -> float:
    """How long a busy machine has kept the threads of a process waiting for a processor [s]."""
    threads = Path(f"/proc/{process}/task").glob("*/schedstat")
    return sum(1e-9 * int(each.read_text().split()[1]) for each in threads)


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="needs Linux")
@pytest.mark.parametrize("seed", range(int(os.environ.get("OHMSKIN_KILLS", "5"))))
def test_killed_at_any_moment(path: Path, command: Command, seed: int) -> None:
    """It lacks at most half a second, and what a busy machine kept it waiting in that.

    Moments are random, one in each fifth of two seconds. OHMSKIN_KILLS=50 tries more of them.
    """
    process = command("record", URL, str(path))
    until(lambda: path.exists() and path.stat().st_size > 20_000)
    time.sleep((seed % 5 + np.random.default_rng(seed).uniform()) * 0.4)
    before_s = kept_waiting_s(process.pid)
    time.sleep(0.5)
    waited_s = kept_waiting_s(process.pid) - before_s
    killed_s = time.monotonic()
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    found = load_recording(path)
    assert found.cut_off
    assert len(found.hellos) == 1
    numbers = [each.number for each in found.scans]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    lost_s = killed_s - found.scans[-1].host_time_s
    print(f"lost {lost_s:.3f} s, kept waiting {waited_s:.3f} s")
    assert lost_s < 0.5 + waited_s
    assert_same(replayed(path), found.scans, host_time=False)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_properly(path: Path, command: Command, number: signal.Signals) -> None:
    process = command("record", URL, str(path))
    until(lambda: path.exists() and path.stat().st_size > 10_000)
    renamed = path.rename(path.with_name("b.mcap"))
    process.send_signal(number)
    out = well(finish(process)).out
    found = load_recording(renamed)
    assert not found.cut_off
    assert f": {len(found.scans)} scans, missed 0, {renamed.stat().st_size} bytes" in out


def outcome(path: Path) -> Recording | str:
    """The recording, or the one line that says why not."""
    try:
        return load_recording(path)
    except RecordingError as exc:
        text = str(exc)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


def ends_of_records(octets: bytes) -> list[int]:
    """Where the records of an MCAP file end: each has an opcode, 8 bytes of length, and those."""
    ends = [8]  # of the magic bytes
    while ends[-1] < len(octets) - 8:
        ends.append(ends[-1] + 9 + int.from_bytes(octets[ends[-1] + 1 : ends[-1] + 9], "little"))
    return ends


@pytest.mark.parametrize("zeros", [0, 20_000])
def test_cut_off_at_any_byte(tmp_path: Path, hello: Hello, zeros: int) -> None:
    """About the ends of records and of their heads, and at a hundred places between these.

    A system that crashed leaves zeros in place of what it had not yet written.
    """
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    with Recorder(whole, hello) as recorder:
        for number in range(6):
            recorder.add(scan(number))
            recorder.flush()
    octets = whole.read_bytes()
    counts = []
    ends = ends_of_records(octets)
    sizes = {end + step for end in ends for step in (-1, 0, 1, 8, 9, 10)}
    sizes |= set(np.random.default_rng(1).integers(len(octets), size=100).tolist())
    for size in sorted(sizes & set(range(len(octets)))):
        cut.write_bytes(octets[:size] + bytes(zeros))
        found = outcome(cut)
        if isinstance(found, str):
            assert "cut off" in found or (zeros and size < 8)
            assert not counts
        else:
            assert_same(found.scans, [scan(n) for n in range(len(found.scans))])
            counts.append(len(found.scans))
    assert counts == sorted(counts)
    assert set(counts) == set(range(7))


def test_damage_is_named(path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(n) for n in range(5)])
    octets = bytearray(path.read_bytes())
    outcomes = set()
    for at in range(0, len(octets), 7):
        octets[at] ^= 0x41
        path.write_bytes(octets)
        outcomes.add(type(outcome(path)))
        octets[at] ^= 0x41
    assert outcomes == {Recording, str}


def foreign(path: Path, topic: str, content: object) -> None:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel(topic, "json", schema)
        writer.add_message(channel, 0, json.dumps(content).encode(), 0)
        writer.finish()


def test_foreign_files(tmp_path: Path, path: Path, hello: Hello) -> None:
    path.write_bytes(b"")
    assert "cut off" in outcome(path)
    path.write_bytes(os.urandom(5000))
    assert "no MCAP file" in outcome(path)
    assert "No such file" in outcome(tmp_path / "none.mcap")
    assert "directory" in outcome(tmp_path)
    head = {"number": 1, "time_us": 1, "host_time_s": 1, "missed": 0}
    known = {**asdict(hello), "host_time_s": 1}
    of_region = {"row_mask": 1, "column_mask": 1, "adc_bits": 10, "slot_cycles": 0}
    region = {**head, "rows": 1, "columns": 1, "codes": [1] * 4, **of_region}
    cell = {"host_time_s": 1, "rows": 1, "columns": 1}
    for topic, content, reason in (
        ("/camera", {}, "no recording of a skin"),
        ("/skin/mark", {"host_time_s": 1.0, "text": ""}, "no board says hello"),
        ("/skin/hello", {"host_time_s": 1}, "layout_crc"),
        ("/skin/hello", [1], "no JSON object"),
        ("/skin/hello", {**known, "columns": 0}, "hello says columns 0"),
        ("/skin/hello", {**known, "adc_bits": 80}, "hello says adc_bits 80"),
        ("/skin/hello", {**known, "scan_cycles": 0}, "hello says scan_cycles 0"),
        ("/skin/hello", {**known, "ref_top_ohm": 0}, "hello says ref_top_ohm 0"),
        ("/skin/hello", {**known, "rows": 10**9}, "hello says rows 1000000000"),
        ("/skin/scan", {**head, "rows": 1, "columns": 1, "codes": [1] * 5}, "5 codes"),
        ("/skin/scan", {**head, "rows": 1, "columns": 1, "codes": [-1] * 4}, "range"),
        ("/skin/scan", {**region, "row_mask": 2}, "a mask has lines beyond the 1"),
        ("/skin/scan", {**region, "column_mask": 10**18}, "a mask has lines beyond the 1"),
        ("/skin/scan", {**head, "rows": 10**9, "columns": 9, "codes": []}, "no skin has 10000"),
        ("/skin/scan", {**head, "rows": 1, "columns": 1, "codes": [10**30] * 4}, "range"),
        ("/skin/mark", {"host_time_s": 10**400, "text": ""}, "too large"),
        ("/skin/force", {"host_time_s": 1, "force_n": -(10**400), "source": ""}, "too large"),
        ("/skin/tare", {**head, "rows": 1, "columns": 1, "rest_ratio": [10**400] * 4}, "range"),
        *(
            ("/skin/tare", {**cell, "rest_ratio": [0.5] * 3 + [ratio]}, "rest_ratio: one is not in")
            for ratio in (float("nan"), 1e300, 1.01, -5, -0.01)
        ),
        ("/skin/mark", {"host_time_s": 1, "text": "x" * 10_000}, "a message mark of 100"),
        (
            "/skin/scan",
            {**head, "rows": 1, "columns": 1, "codes": [1] * 4, "mode": "x"},
            "no mode 'x': there are near, far",
        ),
    ):
        foreign(path, topic, content)
        assert reason in outcome(path)


@pytest.mark.parametrize(
    ("count", "compression", "stated", "reason"),
    [
        (1, "lz4", 1000, "states 1000 bytes"),
        (1, "zstd", 1000, "states 1000 bytes"),
        (1, "zstd", 9_000_100, "130 times"),
        (12, "zstd", 900_100, "130 times"),
        (1, "zstd", 10**12, "larger than any recorder writes"),
        (1, "brotli", 100, "states 100 bytes"),
    ],
)
def test_chunks_that_unpack_to_far_more(
    path: Path, count: int, compression: str, stated: int, reason: str
) -> None:
    """Each is one record of spaces, of a type that no reader knows. No frame says its own size."""
    size = 50_000_000 if stated == 1000 else stated // 1000 * 1000
    content = struct.pack("<BQ", 0x80, size + 91) + bytes(91) + b" " * size if size < 10**9 else b""
    packed = {
        "lz4": lambda: lz4.frame.compress(content, store_size=False),
        "zstd": lambda: zstandard.ZstdCompressor(write_content_size=False).compress(content),
    }.get(compression, lambda: b"?")()
    records = RecordBuilder()
    for _ in range(count):
        Chunk(compression, packed, 0, 0, 0, stated).write(records)
    path.write_bytes(b"\x89MCAP0\r\n" + records.end())
    assert path.stat().st_size < 250_000
    tracemalloc.start()
    found = outcome(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reason in found
    assert most < 5_000_000


def record_of(opcode: int, content: bytes, size: int | None = None) -> bytes:
    """A record that states this size, or its own."""
    return struct.pack("<BQ", opcode, len(content) if size is None else size) + content


def hello_records(hello: Hello) -> bytes:
    """A file's begin: the channels of all topics, by their numbers, and a board that says hello."""
    channels = RecordBuilder()
    for number, name in enumerate(SCHEMAS):
        Channel(number, TOPIC + name, "json", {}, 0).write(channels)
    return b"\x89MCAP0\r\n" + channels.end() + message_of("hello", vars(hello))


def message_of(name: str, content: dict[str, object]) -> bytes:
    octets = json.dumps({"host_time_s": 1, **content}, ensure_ascii=False).encode()
    return record_of(5, struct.pack("<H20x", list(SCHEMAS).index(name)) + octets)


# Lengths inside of records that go beyond them: into a hole of the file, which is larger.
INSIDE: dict[str, bytes] = {
    "attachment": record_of(9, bytes(24) + struct.pack("<Q", 10**9), 50),
    "chunk": record_of(6, bytes(16) + struct.pack("<QII4sQ", 100, 0, 4, b"zstd", 10**9), 60),
    "message index": record_of(7, struct.pack("<HI", 1, 10**8), 6),
    "channel": record_of(4, struct.pack("<HHI", 1, 1, 10**9), 8),
    "message": record_of(5, b"", 0),
}


@pytest.mark.parametrize("what", INSIDE)
def test_a_length_inside_of_a_record_takes_no_memory(path: Path, hello: Hello, what: str) -> None:
    """4 kB on a disk took 952 MB."""
    path.write_bytes(hello_records(hello) + INSIDE[what])
    os.truncate(path, 1_200_000_000)
    tracemalloc.start()
    found = outcome(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert isinstance(found, str) or found.cut_off
    assert most < 1_000_000


def chunk_of(content: bytes) -> bytes:
    records = RecordBuilder()
    packed = zstandard.ZstdCompressor(level=19).compress(content)
    Chunk("zstd", packed, 0, 0, 0, len(content)).write(records)
    return records.end()


# Messages that take more memory than their JSON, or more time than others.
SCAN = {"number": 1, "time_us": 1, "missed": 0, "rows": 1, "columns": 1, "codes": [0] * 4}
LARGER: dict[str, bytes] = {
    "scans of a cell": message_of("scan", SCAN),
    "zeros": message_of("tare", {"rows": 32, "columns": 32, "rest_ratio": [0] * 4096}),
    "wide letters": message_of("mark", {"text": "\U0001f600" + "x" * 9000}),
    "empty records": record_of(0x80, b""),
}


@pytest.mark.parametrize("what", LARGER)
def test_what_is_larger_in_memory_than_in_a_file_counts_so(
    tmp_path: Path, path: Path, hello: Hello, what: str
) -> None:
    """A megabyte on the disk, most of which is padding."""
    begin, one = hello_records(hello), LARGER[what]
    chunk = chunk_of(one * (4_000_000 // len(one)))
    padding = record_of(0x80, os.urandom(900_000))
    path.write_bytes(begin + padding + 39 * chunk)
    assert path.stat().st_size < 1_000_000
    done, peak_mb = bounded("export", path, tmp_path / "out.npz")
    assert_one_line(done, "unpacks to over 130 times")
    assert peak_mb < EMPTY_MB + 250


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_an_export_takes_no_more_memory_for_many_scans(
    tmp_path: Path, path: Path, hello: Hello, suffix: str
) -> None:
    """80 MB of readings, in a file of a megabyte. Most took 320 MB."""
    scan = message_of("scan", SCAN | {"rows": 32, "columns": 32, "codes": [0] * 4096})
    chunk = chunk_of(scan * 240)
    count = 4800 if suffix == ".npz" else 1200
    padding = record_of(0x80, os.urandom(900_000))
    path.write_bytes(hello_records(hello) + padding + count // 240 * chunk)
    done, peak_mb = bounded("export", path, out := tmp_path / f"out{suffix}")
    assert done == Done(
        0, f"{out}: {count} scans\n", f"{path} was cut off: its last second may be missing\n"
    )
    assert peak_mb < EMPTY_MB + 40


def test_holes_allow_nothing(path: Path, hello: Hello) -> None:
    content = record_of(0x80, b" " * 4_000_000)
    octets = hello_records(hello) + 10 * chunk_of(content)
    path.write_bytes(octets + record_of(0x80, b"", 10_000_000))
    os.truncate(path, 10_000_000)
    assert "unpacks to over 130 times" in str(outcome(path))


def test_a_hello_has_no_more_causes_than_a_board(path: Path, hello: Hello) -> None:
    """330,000 of them took 1.5 GB."""
    for causes, said in ((["x" * 50] * 3, "says reset_cause"), ([[]] * 5000, "hello of 20")):
        content = {**vars(hello), "reset_cause": causes}
        path.write_bytes(hello_records(hello) + message_of("hello", content))
        assert said in str(outcome(path))


def test_a_mark_that_no_reader_takes_is_not_recorded(path: Path, hello: Hello) -> None:
    with Recorder(path, hello) as recorder:
        with pytest.raises(ValueError, match="a message mark of 10"):
            recorder.add(Mark("x" * 10_000, 1.0))
        recorder.add(Mark("here", 1.0))
    assert [mark.text for mark in load_recording(path).marks] == ["here"]


class AddedMeanwhile(io.FileIO):
    """While its next write goes on, another thread adds."""

    other: threading.Thread | None = None
    is_kept_waiting = False

    def write(self, octets: object) -> int:
        if self.other is not None and self.other.ident is None:
            self.other.start()
            self.other.join(0.2)  # an `add` that waits for nobody takes less
            self.is_kept_waiting = self.other.is_alive()
        return super().write(octets)  # type: ignore[arg-type]


def test_one_thread_writes_at_a_time(
    path: Path, hello: Hello, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = AddedMeanwhile(path, "wb")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", lambda path, mode: io.BufferedWriter(file))
        recorder = Recorder(path, hello)
    with recorder:
        file.other = threading.Thread(target=recorder.add, args=(scan(1),))
        recorder.add(scan(0))
        until(lambda: recorder.scans == 2)
    assert file.is_kept_waiting
    assert_same(load_recording(path).scans, [scan(0), scan(1)])


@pytest.mark.skipif(os.name == "nt", reason="there, an open file cannot be removed")
@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_is_removed_ends_the_recording(
    path: Path, hello: Hello, replaced: bool
) -> None:
    """Within a second, while the board is silent too."""
    recorder = Recorder(path, hello)
    recorder.add(scan(0))
    if replaced:
        other = path.with_name("b.mcap")
        other.write_text("mine")
        other.replace(path)
    else:
        path.unlink()
    refused = partial(pytest.raises, RecordingError, match="has removed the file, and 1 scans")
    try:
        until(lambda: recorder.failure, LATE_S)
        with refused():
            recorder.add(scan(1))
    finally:
        with refused():
            recorder.close()
    assert [each.read_text() for each in path.parent.iterdir()] == ["mine"] * replaced


def scans_told(error: str) -> int:
    """How many scans can be read, as the end of a recording says."""
    told = re.search(r"; (\d+) scans are in the file and can be read\n?$", error)
    assert told, error
    return int(told[1])


class FullDisk(io.FileIO):
    """Of a write that does not fit, it takes what does."""

    room = 0

    def write(self, octets: Any) -> int:
        taken = bytes(octets)[: self.room]
        if not taken:
            raise OSError(28, "No space left on device")
        self.room -= len(taken)
        return super().write(taken)


def test_a_full_disk_is_told_with_a_number_of_scans_that_are_readable(
    tmp_path: Path, hello: Hello, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the last chunk is cut off, or the index after it."""
    numbers = set()

    def fill(recorder: Recorder) -> None:
        with recorder:
            for number in range(40):
                recorder.add(scan(number))
                if number % 5 == 4:
                    recorder.flush()

    for room in range(5320, 7520, 31):
        file = FullDisk(path := tmp_path / f"{room}.mcap", "wb")
        file.room = room
        with monkeypatch.context() as patched:
            patched.setattr(Path, "open", lambda path, mode, file=file: io.BufferedWriter(file))
            recorder = Recorder(path, hello)
        with pytest.raises(RecordingError, match="No space left on device; ") as full:
            fill(recorder)
        numbers.add(readable := len(load_recording(path).scans))
        # The last chunk may be whole, and only the index after it cut off.
        assert 0 <= readable - scans_told(str(full.value)) <= 5
    assert numbers == {20, 25, 30}


def test_a_file_that_may_not_grow_ends_the_recording(path: Path, command: Command) -> None:
    """The last write is in part, as on a full disk."""
    resource = pytest.importorskip("resource")
    process = command("record", f"{URL}&noise=0", str(path))
    if not hasattr(resource, "prlimit"):
        pytest.skip("needs prlimit")
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (20_000, 20_000))
    done = finish(process)
    assert_one_line(done, "recording ended: File too large; ")
    assert path.stat().st_size == 20_000
    found = load_recording(path)
    assert found.cut_off
    numbers = [each.number for each in found.scans]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) > 50
    assert 0 < scans_told(done.err) <= len(numbers)
    expected = quantise(Scene("multi", 3, 4, seed=3).ratio(BEGIN_S))
    for each in found.scans:
        np.testing.assert_array_equal(each.codes, expected)
