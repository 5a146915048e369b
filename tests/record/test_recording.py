# SPDX-License-Identifier: Apache-2.0
"""Recordings: what is written is read again, whatever ended the writing; replay is the same scans.

Files are read here by the `mcap` library's own readers as well, not by ours alone.
"""

import io
import json
import os
import signal
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

import ohmskin
from bench_board import Bench
from command_line import Command, Done, Run, assert_one_line, finish, well
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.errors import CommandRefused, DeviceLost, PortError, RecordingEnded, RecordingError
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Hello, Scan
from ohmskin.opening import emulated
from ohmskin.record.readings import estimate_file, load_readings
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import (
    SCHEMAS,
    ForceSample,
    Mark,
    Recording,
    Tare,
    export,
    load_recording,
    messages,
)
from recordings import write_recording
from waiting import until

pytestmark = pytest.mark.usefixtures("nothing_left")

URL = "emulator://3x4?scene=multi&begin=0&seed=3&rate=400"
TARE = Tare(np.full((3, 4, 4), 0.25), 1.0)
# Scans reach the file within half a second; on a busy machine, within this [s].
LATE_S = 3.0


@pytest.fixture(scope="module")
def hello() -> Hello:
    return Bench(URL).info


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a recording is written."""
    return tmp_path / "a.mcap"


def scan(number: int, rows: int = 3, columns: int = 4, at_s: float | None = None) -> Scan:
    codes = np.random.default_rng(number).integers(0, 1024, (rows, columns, 4)).astype(np.uint16)
    at_s = number / 400 if at_s is None else at_s
    return Scan(codes, number, 2500 * number, at_s, 0)


def assert_same(found: list[Scan], expected: list[Scan], host_time: bool = True) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.codes.dtype == other.codes.dtype
        np.testing.assert_array_equal(one.codes, other.codes)
        assert (one.number, one.time_us, one.missed) == (other.number, other.time_us, other.missed)
        assert one.host_time_s == other.host_time_s or not host_time


def replayed(path: Path, speed: float = 0) -> list[Scan]:
    with ohmskin.open(f"replay://{path}?speed={speed}") as skin:
        return list(skin)


# ----------------------------------------------------------------------------- write and read


def test_everything_is_read_again(path: Path, hello: Hello) -> None:
    scans = list(islice(Bench(URL), 50))
    tare = Tare(np.mean([each.ratio for each in scans], axis=0), 0.5)
    others = [Mark("pressed \u00fc", 1.5), ForceSample(0.25, 2.5, "scale")]
    write_recording(path, hello, [*scans, tare, *others])
    found = load_recording(path)
    assert not found.cut_off
    assert found.hellos == [hello]
    assert_same(found.scans, scans)
    np.testing.assert_array_equal(found.tares[0].rest_ratio, tare.rest_ratio)
    assert [*found.marks, *found.forces] == others


def test_scans_keep_their_mode(tmp_path: Path, path: Path, hello: Hello) -> None:
    """Two scans of each mode: read, replayed, exported, and read by methods that know but one."""
    modes = ["near", "near", "far", "far"]
    scans = [replace(scan(n), mode=mode) for n, mode in enumerate(modes)]
    far = replace(hello, mode="far")
    write_recording(path, hello, [*scans[:2], far, *scans[2:]])
    assert [each.mode for each in load_recording(path).hellos] == ["near", "far"]
    for found in (load_recording(path).scans, replayed(path)):
        assert [each.mode for each in found] == modes
    with pytest.raises(RecordingError, match=r"cells or mode change after 0\.005 s"):
        export(load_recording(path), tmp_path / "both.npz")
    for out in (tmp_path / "far.npz", tmp_path / "far.csv"):
        export(load_recording(path), out, begin_s=0.004)
    readings = load_readings(tmp_path / "far.npz")
    assert readings.reading_names == ("a", "e", "b", "f")
    np.testing.assert_array_equal(readings.ratio, [each.ratio for each in scans[2:]])
    with pytest.raises(ValueError, match="'matrix' takes the readings a b c d, not a e b f"):
        estimate_file(readings, "matrix")
    assert len(estimate_file(readings, "joint")["cell_siemens"]) == len(scans[2:])
    header = (tmp_path / "far.csv").read_text().splitlines()[0].split(",")
    assert header[4:8] == ["r0c0a", "r0c0e", "r0c0b", "r0c0f"]


def test_other_programs_read_it(path: Path, hello: Hello) -> None:
    """The library's seeking reader, with the index; each message fits its schema's properties."""
    before_ns = time.time_ns()
    write_recording(path, hello, [scan(n, at_s=time.monotonic()) for n in range(20)])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 21
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == {f"/skin/{name}" for name in ("hello", "scan", "tare", "mark", "force")}
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            definition, content = json.loads(schema.data), json.loads(message.data)
            assert definition["type"] == "object"
            assert list(content) == definition["required"] == list(definition["properties"])
            kinds = {"integer": int, "number": float, "string": str, "array": list}
            for name, value in content.items():
                assert type(value) is kinds[definition["properties"][name]["type"]]
            assert before_ns - 1e6 < message.log_time < time.time_ns() + 1e6
            if channel.topic == "/skin/scan":
                expected = scan(content["number"])
                assert content["codes"] == expected.codes.reshape(-1).tolist()


def test_size_on_disk(path: Path, hello: Hello) -> None:
    """At most 40 kB/s for 8x8 at 90 Hz, half a second in each chunk."""
    board, _, _ = emulated("emulator://8x8?scene=moving&noise=1")
    with Recorder(path, hello) as recorder:
        for number in range(450):
            recorder.add(
                Scan(board.codes_at(3 + number / 90), number, 11_111 * number, number / 90, 0)
            )
            if number % 45 == 44:
                recorder._flush()
    assert path.stat().st_size < 5 * 40_000


def test_an_existing_file_is_left_alone(tmp_path: Path, path: Path, hello: Hello) -> None:
    path.write_text("mine")
    with pytest.raises(RecordingError, match="there already"):
        Recorder(path, hello)
    assert path.read_text() == "mine"
    with pytest.raises(RecordingError, match="No such file"):
        Recorder(tmp_path / "nowhere" / "a.mcap", hello)


@pytest.mark.parametrize(
    ("limits", "scans", "tared"),
    [
        ({}, 20, None),
        ({"count": 7}, 7, None),
        ({"seconds": 0.02}, 9, None),  # at 400 Hz, and the one that comes then
        ({"tare_s": 0.01}, 20, slice(0, 5)),
        ({"tare_s": 0.03}, 20, slice(10, 13)),  # of the later size
        ({"tare_s": 1.0, "count": 15}, 15, slice(10, 15)),
    ],
)
def test_the_record_loop(
    path: Path, hello: Hello, limits: dict[str, Any], scans: int, tared: slice | None
) -> None:
    """Its board is configured anew after ten scans."""
    board = SimpleNamespace(info=hello)
    given = [scan(n, rows=3 if n < 10 else 2) for n in range(20)]
    seen: list[int] = []

    def scanned() -> Iterator[Scan]:
        for each in given:
            if each.number == 10:
                board.info = replace(hello, rows=2)
            yield each

    with Recorder(path, hello) as recorder:
        record(board, recorder, scanned(), beside=lambda each: seen.append(each.number), **limits)
    found = load_recording(path)
    assert_same(found.scans, given[:scans])
    assert seen == list(range(scans))
    assert [each.rows for each in found.hellos] == ([3, 2] if scans > 10 else [3])
    assert len(found.tares) == (tared is not None)
    if tared is not None:
        expected = np.mean([each.ratio for each in given[tared]], axis=0)
        np.testing.assert_allclose(found.tares[0].rest_ratio, expected, rtol=1e-12)


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


# ------------------------------------------------------------------------------ what ends badly


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


def test_cut_off_at_any_byte(tmp_path: Path, hello: Hello) -> None:
    """About the ends of records and of their heads, and at a hundred places between these."""
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    with Recorder(whole, hello) as recorder:
        for number in range(6):
            recorder.add(scan(number))
            recorder._flush()
    octets = whole.read_bytes()
    counts = []
    ends = ends_of_records(octets)
    sizes = {end + step for end in ends for step in (-1, 0, 1, 8, 9, 10)}
    sizes |= set(np.random.default_rng(1).integers(len(octets), size=100).tolist())
    for size in sorted(sizes & set(range(len(octets)))):
        cut.write_bytes(octets[:size])
        found = outcome(cut)
        if isinstance(found, str):
            assert "cut off" in found
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
        ("/skin/scan", {**head, "rows": 10**9, "columns": 9, "codes": []}, "no 10000"),
        ("/skin/scan", {**head, "rows": 1, "columns": 1, "codes": [10**30] * 4}, "range"),
        ("/skin/mark", {"host_time_s": 10**400, "text": ""}, "too large"),
        ("/skin/force", {"host_time_s": 1, "force_n": -(10**400), "source": ""}, "too large"),
        ("/skin/tare", {**head, "rows": 1, "columns": 1, "rest_ratio": [10**400] * 4}, "too large"),
        ("/skin/mark", {"host_time_s": 1, "text": "x" * 1_100_000}, "a message mark of 110"),
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
        (1, "zstd", 9_000_100, "200 times"),
        (12, "zstd", 900_100, "200 times"),
        (1, "zstd", 10**12, "larger than any recorder writes"),
        (1, "brotli", 100, "states 100 bytes"),
    ],
)
def test_chunks_that_unpack_to_far_more(
    path: Path, count: int, compression: str, stated: int, reason: str
) -> None:
    """Each is one record of spaces, of a type that no reader knows. No frame says its own size."""
    size = 50_000_000 if stated == 1000 else stated // 1000 * 1000
    content = struct.pack("<BQ", 0x80, size) + bytes(91) + b" " * size if size < 10**9 else b""
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
        until(lambda: not recorder._flusher.is_alive(), LATE_S)
        with refused():
            recorder.add(scan(1))
    finally:
        with refused():
            recorder.close()
    assert [each.read_text() for each in path.parent.iterdir()] == ["mine"] * replaced


class FullDisk(io.FileIO):
    """Of a write that does not fit, it takes what does."""

    room = 0

    def write(self, octets: Any) -> int:
        taken = bytes(octets)[: self.room]
        if not taken:
            raise OSError(28, "No space left on device")
        self.room -= len(taken)
        return super().write(taken)


def test_a_full_disk_is_told_with_the_number_of_scans_that_are_readable(
    tmp_path: Path, hello: Hello, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the last chunk is cut off, or the index after it."""
    numbers = set()

    def fill(recorder: Recorder) -> None:
        with recorder:
            for number in range(40):
                recorder.add(scan(number))
                if number % 5 == 4:
                    recorder._flush()

    for room in range(5200, 6800, 23):
        file = FullDisk(path := tmp_path / f"{room}.mcap", "wb")
        file.room = room
        with monkeypatch.context() as patched:
            patched.setattr(Path, "open", lambda path, mode, file=file: io.BufferedWriter(file))
            recorder = Recorder(path, hello)
        with pytest.raises(RecordingError, match="No space left on device; ") as full:
            fill(recorder)
        numbers.add(readable := len(load_recording(path).scans))
        assert f"; {readable} scans are in the file and can be read" in str(full.value)
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
    assert f"; {len(numbers)} scans are in the file and can be read\n" in done.err
    expected = quantise(Scene("multi", 3, 4, seed=3).ratio(BEGIN_S))
    for each in found.scans:
        np.testing.assert_array_equal(each.codes, expected)


# -------------------------------------------------------------------------------------- replay


def test_replay_is_the_recording_bit_for_bit(path: Path, hello: Hello) -> None:
    scans = list(islice(Bench(f"{URL}&drop=0.05"), 300))
    assert any(each.missed for each in scans)
    write_recording(path, hello, scans)
    assert_same(replayed(path), scans, host_time=False)
    assert_same(replayed(path, speed=4), scans, host_time=False)


def test_a_slow_reader_of_a_fast_replay_loses_nothing(path: Path, hello: Hello) -> None:
    scans = [scan(n, rows=1, columns=1) for n in range(3000)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        time.sleep(0.1)
        found = iter(skin)
        first = [next(found)]
        time.sleep(0.3)
        first += found
        assert skin.stats.overflowed == 0
    assert_same(first, scans, host_time=False)


def test_latest_of_a_fast_replay_gives_each(path: Path, hello: Hello) -> None:
    scans = [scan(n) for n in range(40)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        assert_same([skin.latest() for _ in scans], scans, host_time=False)
        with pytest.raises(RecordingEnded, match="played to its end"):
            skin.latest()
        assert list(skin) == []
        with pytest.raises(DeviceLost):
            skin.stop()


def test_replay_takes_the_recorded_time(path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(n, at_s=7 + n / 10) for n in range(6)])
    begin_s = time.monotonic()
    found = replayed(path, speed=1)
    assert time.monotonic() - begin_s >= 0.5
    assert found[-1].host_time_s - found[0].host_time_s == pytest.approx(0.5, abs=0.4)


def test_replay_shortens_long_pauses(
    path: Path, hello: Hello, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.record.replay.LONGEST_PAUSE_S", 0.1)
    write_recording(path, hello, [scan(0, at_s=0), scan(1, at_s=3600), scan(2, at_s=10)])
    begin_s = time.monotonic()
    assert len(replayed(path, speed=1)) == 3
    assert time.monotonic() - begin_s < 5


def test_a_recording_stays_as_it_is(path: Path, hello: Hello) -> None:
    scans = [scan(n) for n in range(30)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        assert (skin.info.rows, skin.info.columns, skin.info.board) == (3, 4, "emulated")
        first = [skin.latest()]
        uses: list[Callable[[], object]] = [
            lambda: skin.configure(rows=2),
            skin.save,
            skin.self_test,
            skin.load_defaults,
            lambda: skin.set_unit_id(1),
        ]
        for use in uses:
            with pytest.raises(CommandRefused, match="is a recording"):
                use()
        skin.stop()
        skin.start()
        rest = list(skin)
    # What had come before the pause may be forgotten, as with any board; nothing comes twice.
    numbers = [each.number for each in first + rest]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 29


def test_a_change_of_size_is_replayed(tmp_path: Path, path: Path, hello: Hello) -> None:
    scans = [scan(n, rows=3 if n < 5 else 2) for n in range(10)]
    write_recording(path, hello, [*scans[:5], replace(hello, rows=2), *scans[5:]])
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        assert_same(list(skin), scans, host_time=False)
        assert skin.info.rows == 2
    with pytest.raises(RecordingError, match="cells or mode change after "):
        export(load_recording(path), tmp_path / "a.npz")


def test_wrong_replays(tmp_path: Path, path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(0)])
    for query in ("speed=-1", "speed=nan", "speed=fast", "baud=9600"):
        with pytest.raises(PortError, match="speed"):
            ohmskin.open(f"replay://{path}?{query}")
    with pytest.raises(RecordingError, match="No such file"):
        ohmskin.open(f"replay://{tmp_path}/none.mcap")
    path.unlink()
    beyond = scan(1)
    beyond.codes[0, 0, 0] = 1024
    write_recording(path, hello, [scan(0), beyond])
    with pytest.raises(RecordingError, match="a code is out of range"):
        replayed(path)


def test_a_skin_larger_than_any_board_is_replayed(path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(0, rows=20)])
    assert replayed(path)[0].codes.shape == (20, 4, 4)


def test_scans_carry_the_tare_in_force(path: Path, hello: Hello) -> None:
    tares = [Tare(np.full((3, 4, 4), ratio), 1.0) for ratio in (0.25, 0.75)]
    write_recording(path, hello, [scan(0), tares[0], scan(1), scan(2), tares[1], scan(3)])
    rests = [each.rest_ratio for each in replayed(path)]
    assert rests[0] is None
    assert rests[1] is rests[2]
    for found, tare in ((rests[2], tares[0]), (rests[3], tares[1])):
        np.testing.assert_array_equal(found, tare.rest_ratio)


def test_a_tare_is_the_rest_of_scans_of_its_mode_alone(
    tmp_path: Path, path: Path, hello: Hello
) -> None:
    far = replace(hello, mode="far")
    tares = [Tare(np.full((3, 4, 4), 0.25), 1.0), Tare(np.full((3, 4, 4), 0.75), 1.0, "far")]
    of_far = [replace(scan(n), mode="far") for n in (1, 2)]
    write_recording(path, hello, [tares[0], scan(0), far, of_far[0], tares[1], of_far[1]])
    assert [each.mode for each in load_recording(path).tares] == ["near", "far"]
    first, other, last = (each.rest_ratio for each in replayed(path))
    assert other is None
    np.testing.assert_array_equal([first, last], [each.rest_ratio for each in tares])
    export(load_recording(path), tmp_path / "far.npz", begin_s=0.004)
    np.testing.assert_array_equal(load_readings(tmp_path / "far.npz").rest_ratio, last)
    write_recording(tmp_path / "near.mcap", far, [tares[0], *of_far])
    export(load_recording(tmp_path / "near.mcap"), tmp_path / "none.npz")
    assert load_readings(tmp_path / "none.npz").rest_ratio is None


def test_a_tare_that_says_no_mode_is_of_mode_near(path: Path, hello: Hello) -> None:
    """As recordings had them before tares said theirs."""
    properties = SCHEMAS["tare"]
    mode = properties.pop("mode")
    try:
        write_recording(path, hello, [TARE])
    finally:
        properties["mode"] = mode
    assert [each.mode for each in load_recording(path).tares] == ["near"]


def test_a_tare_is_recorded_with_the_mode_of_its_scans(tmp_path: Path) -> None:
    bench = Bench("emulator://3x4?mode=far")
    with Recorder(tmp_path / "far.mcap", bench.info) as recorder:
        record(bench, recorder, bench, count=20, tare_s=0.1)
    [tare] = load_recording(tmp_path / "far.mcap").tares
    assert tare.mode == "far"


# -------------------------------------------------------------------------------------- export


@pytest.fixture
def recorded(path: Path) -> Path:
    rest, touched = (
        Bench(f"emulator://3x4?scene={scene}&begin=0&noise=0") for scene in ("rest", "single")
    )
    tare = Tare(next(iter(rest)).ratio, 0.0)
    write_recording(path, rest.info, [tare, *islice(touched, 5)])
    return path


def test_export_is_estimated(tmp_path: Path, recorded: Path) -> None:
    out = tmp_path / "a.npz"
    recording = load_recording(recorded)
    assert export(recording, out) == 5
    readings = load_readings(out)
    expected = [each.ratio for each in recording.scans]
    np.testing.assert_array_equal(readings.ratio, expected)
    np.testing.assert_array_equal(readings.rest_ratio, recording.tares[0].rest_ratio)
    assert (readings.adc_bits, readings.ref_top_ohm) == (10, 30_000)
    assert estimate_file(readings, "joint")["converged"].all()
    with np.load(out) as arrays:
        assert arrays["time_us"].tolist() == [each.time_us for each in recording.scans]


def test_export_as_a_table(tmp_path: Path, recorded: Path) -> None:
    out = tmp_path / "a.csv"
    recording = load_recording(recorded)
    export(recording, out)
    header = out.read_text().splitlines()[0].split(",")
    assert header[:6] == ["number", "time_us", "host_time_s", "missed", "r0c0a", "r0c0b"]
    assert header[-1] == "r2c3d"
    table = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(
        table[:, 4:], [each.codes.reshape(-1) for each in recording.scans]
    )
    np.testing.assert_array_equal(table[:, 2], [each.host_time_s for each in recording.scans])


def test_export_of_a_part(tmp_path: Path, recorded: Path) -> None:
    recording = load_recording(recorded)
    times_s = [each.host_time_s - recording.scans[0].host_time_s for each in recording.scans]
    part = export(recording, tmp_path / "a.npz", begin_s=times_s[1], end_s=times_s[3] + 1e-6)
    assert part in (3, 2)  # the first may fall to rounding
    with pytest.raises(RecordingError, match="no scans"):
        export(recording, tmp_path / "b.npz", begin_s=1000)
    with pytest.raises(ValueError, match="no format"):
        export(recording, tmp_path / "b.txt")
    assert not list(tmp_path.glob("b*"))


def test_typed_lines_become_marks(path: Path, command: Command) -> None:
    far, near = os.openpty()
    process = command("record", URL, str(path), stdin=near)
    os.close(near)
    with os.fdopen(far, "wb", buffering=0) as keyboard:
        until(path.exists)
        keyboard.write(b"left hand\nright")
        time.sleep(0.3)
        keyboard.write(b" hand\n")
        until(lambda: len(load_recording(path).marks) == 2)
        process.send_signal(signal.SIGINT)
        assert finish(process).code == 0
    assert [mark.text for mark in load_recording(path).marks] == ["left hand", "right hand"]


def test_the_commands(tmp_path: Path, command: Command, run: Run) -> None:
    path, out = tmp_path / "a.mcap", tmp_path / "a.npz"
    quiet = "emulator://3x4?scene=rest"
    process = command(
        "record", quiet, str(path), "--scans", "60", "--tare", "0.2", "--mark", "left hand"
    )
    assert well(finish(process)).out.startswith(f"{path}: 60 scans, missed 0, ")
    assert [mark.text for mark in load_recording(path).marks] == ["left hand"]
    assert sum(isinstance(message, Tare) for message in messages(path)) == 1
    assert run("export", str(path), str(out)) == Done(0, f"{out}: 60 scans\n", "")
    done = run("stream", f"replay://{path}?speed=0", "--json", "--method", "none")
    assert (done.code, done.out.count("\n"), done.err) == (0, 60, "")
    path.write_bytes(path.read_bytes()[:100])
    out.unlink()
    assert_one_line(run("export", str(path), str(out)), "cut off")
    assert not out.exists()
