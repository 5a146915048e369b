# SPDX-License-Identifier: Apache-2.0
"""Recordings for several test files, one of presses with what a force sensor says."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

import ohmskin
from ohmskin.arrays import Float
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Recorded
from press_scene import PressScene
from stepped import stepped

URL = "emulator://3x4?scene=multi&begin=0&seed=3&rate=400"
HOST_BEGIN_S = 1000.0
PRESSES = PressScene(1, 2, seed=1)
SENSOR_HZ = 80
SENSOR_NOISE_N = 0.02
SENSOR_ZERO_N = 0.07


def write_recording(path: Path, hello: Hello, messages: Iterable[Recorded]) -> None:
    with Recorder(path, hello) as recorder:
        for each in messages:
            recorder.add(each)


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


def record_presses(path: Path, seconds: float, mode: str = "near") -> None:
    """Record what a board reads of `PRESSES`, with a jitter of 1 ms in host times."""
    settings = BoardSettings(PRESSES.rows, PRESSES.columns, mode, rate_hz=30.0, unit_id=3)
    skin = stepped(EmulatedBoard(PRESSES.ratio, settings, seed=1, noise_lsb=0.3))
    hello, random = skin.info, np.random.default_rng(2)

    def arrived(scan: Scan) -> Scan:
        middle_s = 1e-6 * scan.time_us + 0.5 / hello.rate_hz
        return replace(scan, host_time_s=HOST_BEGIN_S + middle_s + random.exponential(1e-3))

    scans = takewhile(lambda scan: scan.host_time_s < seconds, skin)
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
