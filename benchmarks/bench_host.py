# SPDX-License-Identifier: Apache-2.0
"""Measure the host: decoding, latency and load. No estimator runs here.

    make bench-host

What is measured how:

decode_scans_per_s     8x8 scans of random codes, bytes in, `scan.ratio` arrays out, on one core;
                       the median of a few runs. The bytes come in chunks of 4096.
latency_ms_p50, _p99   from just before another process writes the bytes of a scan, the last one
                       included, to a pseudo-terminal, until `latest()` has returned it in this
                       one. Both read CLOCK_MONOTONIC. 90 scans a second.
cpu_percent_at_90hz    of one core: user and system time of this process while it iterates over the
                       scans that another process writes to a pseudo-terminal, each at once; the
                       median of three runs of 6 s.
record_cpu_percent_at_90hz
                       the same while every scan is recorded besides.
record_bytes_per_s     size of the file by length of the recording, of the emulated scene `moving`
                       with 0.3 LSB of noise, 8x8 at 90 Hz.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import ohmskin
from bars import Part, at_least, at_most, run  # beside this file
from ohmskin.arrays import Float
from ohmskin.emulate.board import DEFAULT_RATE_HZ, BoardSettings, EmulatedBoard
from ohmskin.emulate.faults import LineFaults
from ohmskin.link import framing, protocol
from ohmskin.link.messages import BoardDecoder, Scan
from ohmskin.record.recorder import Recorder
from served import Load, serve, served  # beside this file
from wire import scan_payload

RATE_HZ = round(DEFAULT_RATE_HZ)
# These are chosen: so much that two runs on a quiet machine differ little.
DECODED_SCANS, DECODE_RUNS = 3000, 5  # scans that are decoded, and how often
LATENCY_SCANS = 400  # scans whose latency is measured
LOAD_S, LOAD_RUNS = 6.0, 3  # how long the load is measured, and how often
RECORDED_S = 10.0  # length of the recording whose size counts
CHUNK_BYTES = 4096  # in which the decoder gets its bytes: as a session reads them

# ------------------------------------------------------------------- the board, another process


class NotedLine(LineFaults):
    """A line without faults. passed: when octets began to be written [s], and these."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.passed: list[tuple[float, bytes]] = []

    def apply(self, chunk: bytes, now_s: float) -> bytes:
        if chunk:
            self.passed.append((time.monotonic(), chunk))
        return chunk


def serve_noted() -> None:
    """Serve a board, and print at the end when each scan was written."""
    ratio, line = np.random.default_rng(0).random((8, 8, 4)), NotedLine()
    serve([EmulatedBoard(lambda *_: ratio, BoardSettings(rate_hz=RATE_HZ))], line)
    decoder = BoardDecoder()
    times_s = {
        message.number: host_time_s
        for host_time_s, octets in line.passed
        for message in decoder.feed(octets, host_time_s)
        if isinstance(message, Scan)
    }
    print(json.dumps(times_s))


# -------------------------------------------------------------------------------- measurements


def decode_rate(codes: NDArray[np.uint16]) -> float:
    """Scans of these codes a second through `BoardDecoder.feed` and `ratio`."""
    kind = protocol.FRAMES["scan"]
    stream = bytearray()
    for number in range(DECODED_SCANS):
        payload = scan_payload(codes[number % len(codes)], scan=number, time_us=11_111 * number)
        stream += framing.encode(kind.id, number, payload)
    chunks = [bytes(stream[i : i + CHUNK_BYTES]) for i in range(0, len(stream), CHUNK_BYTES)]
    rates = []
    for _ in range(DECODE_RUNS):
        decoder, count, total = BoardDecoder(), 0, 0.0
        begin_s = time.perf_counter()
        for chunk in chunks:
            for message in decoder.feed(chunk, 0.0):
                assert isinstance(message, Scan)
                total += message.ratio[0, 0, 0]
                count += 1
        rates.append(count / (time.perf_counter() - begin_s))
        assert count == DECODED_SCANS
        assert total > 0
    return statistics.median(rates)


def latencies_ms(scans: int) -> Float:
    """Of every scan that `latest` gave out."""
    returned_s: dict[int, float] = {}
    with served(__file__) as board, ohmskin.open(board.ports[0]) as skin:
        for _ in range(scans):
            scan = skin.latest()
            returned_s[scan.number] = time.monotonic()
    return np.array([1e3 * (at_s - board.said[str(n)]) for n, at_s in returned_s.items()])


def reader_cpu_percent(seconds: float, *, is_recorded: bool) -> float:
    """CPU time of this process per wall time while it reads every scan, and perhaps records it."""
    with ExitStack() as stack:
        place = stack.enter_context(tempfile.TemporaryDirectory())
        board = stack.enter_context(served(__file__))
        skin = stack.enter_context(ohmskin.open(board.ports[0]))
        recorder = Recorder(Path(place) / "bench.mcap", skin.info) if is_recorded else None
        if recorder:
            stack.enter_context(recorder)
        scans = iter(skin)
        for _ in range(RATE_HZ):  # what is done once is not load
            next(scans)
        load = Load()
        count = missed = 0
        for scan in scans:
            count += 1
            missed += scan.missed
            if recorder:
                recorder.add(scan)
            if load.seconds() >= seconds:
                break
        rate_hz, percent = count / load.seconds(), load.percent()
    if missed or abs(rate_hz - RATE_HZ) > 1:
        print(f"{skin.name}: {rate_hz:.2f} scans a second, {missed} missed", file=sys.stderr)
    return percent


def record_bytes_per_s(seconds: float) -> float:
    """Of a scene that moves, with the noise of a converter."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "bench.mcap"
        with (
            ohmskin.open("emulator://8x8?scene=moving") as skin,
            Recorder(path, skin.info) as recorder,
        ):
            scans = iter(skin)
            first = newest = next(scans)
            while newest.time_us - first.time_us < 1e6 * seconds:
                recorder.add(newest)
                newest = next(scans)
        return 1e6 * path.stat().st_size / (newest.time_us - first.time_us)


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    random = np.random.default_rng(0)
    blocks = random.integers(0, 1024, (64, 8, 8, 4), dtype=np.uint16)
    rate = decode_rate(blocks)
    latency = latencies_ms(part.of(LATENCY_SCANS))
    load_s, runs = part.share * LOAD_S, range(part.of(LOAD_RUNS))
    cpu, record_cpu = (
        statistics.median(reader_cpu_percent(load_s, is_recorded=is_recorded) for _ in runs)
        for is_recorded in (False, True)
    )
    return {
        "decode_scans_per_s": round(rate),
        "latency_ms_p50": round(float(np.percentile(latency, 50)), 3),
        "latency_ms_p99": round(float(np.percentile(latency, 99)), 3),
        "cpu_percent_at_90hz": round(cpu, 2),
        "record_cpu_percent_at_90hz": round(record_cpu, 2),
        "record_bytes_per_s": round(record_bytes_per_s(part.share * RECORDED_S)),
    }


BARS = (
    at_least("decode_scans_per_s", 10_000),
    at_most("latency_ms_p50", 2),
    at_most("latency_ms_p99", 10),
    at_most("cpu_percent_at_90hz", 8),
    at_most("record_cpu_percent_at_90hz", 3),
    at_most("record_bytes_per_s", 40_000),
)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve_noted()
    else:
        sys.exit(run(__doc__, measure, BARS))
