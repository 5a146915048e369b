# SPDX-License-Identifier: Apache-2.0
"""Recordings for several test files, one of presses with what a force sensor says."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from bench_board import Bench
from ohmskin.arrays import Float
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Recorded
from press_scene import PressScene

HOST_BEGIN_S = 1000.0
PRESSES = PressScene(1, 2, seed=1)
SENSOR_HZ = 80
SENSOR_NOISE_N = 0.02
SENSOR_ZERO_N = 0.07


def write_recording(path: Path, hello: Hello, messages: Iterable[Recorded]) -> None:
    with Recorder(path, hello) as recorder:
        for each in messages:
            recorder.add(each)


def record_presses(path: Path, seconds: float, mode: str = "near") -> None:
    """Record what a board reads of `PRESSES`, with a jitter of 1 ms in host times."""
    board = PRESSES.board(rate_hz=30.0, unit_id=3, seed=1, noise_lsb=0.3, mode=mode)
    bench, random = Bench(board), np.random.default_rng(2)
    hello = bench.info

    def arrived(scan: Scan) -> Scan:
        middle_s = 1e-6 * scan.time_us + 0.5 / hello.rate_hz
        return replace(scan, host_time_s=HOST_BEGIN_S + middle_s + random.exponential(1e-3))

    scans = takewhile(lambda scan: scan.host_time_s < seconds, bench)
    write_recording(path, hello, map(arrived, scans))


def sensor_log(seconds: float) -> tuple[Float, Float]:
    """Times [s] from the board's start and forces [N], with noise, and a zero that is off."""
    random = np.random.default_rng(3)
    times_s = np.arange(0, seconds, 1 / SENSOR_HZ)
    force_n = np.array([PRESSES.force_n(time_s).sum() for time_s in times_s])
    return times_s, force_n + SENSOR_ZERO_N + SENSOR_NOISE_N * random.standard_normal(times_s.size)


def write_log(path: Path, times_s: Float, force_n: Float, header: str = "time_s,force_n") -> None:
    rows = [f"{time_s:.6f},{force:.4f}" for time_s, force in zip(times_s, force_n, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
