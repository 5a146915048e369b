# SPDX-License-Identifier: Apache-2.0
"""A recording of the scene "press" in simulated time, with what a force sensor says of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ohmskin.arrays import Float
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.scenes import Scene
from ohmskin.link import framing, protocol
from ohmskin.link.messages import BoardDecoder, Hello, Scan
from ohmskin.record.recorder import Recorder

HOST_BEGIN_S = 1000.0
SCAN_HZ = 30.0
SENSOR_HZ = 80
SENSOR_NOISE_N = 0.02
SENSOR_ZERO_N = 0.07


def record_presses(path: Path, scene: Scene, seconds: float, unit_id: int = 3) -> None:
    """Record what an emulated board reads of the scene, with a jitter of 1 ms in host times."""
    board = EmulatedBoard(
        *(scene.ratio, scene.rows, scene.columns),
        rate_hz=SCAN_HZ,
        noise_lsb=0.3,
        seed=1,
        unit_id=unit_id,
    )
    decoder, random = BoardDecoder(), np.random.default_rng(2)
    start = protocol.FRAMES["start"]
    board.receive(framing.encode(start.id, 1, start.pack()))
    found = decoder.feed(board.advance(seconds), 0.0)
    hello = next(message for message in found if isinstance(message, Hello))
    with Recorder(path, hello) as recorder:
        for scan in found:
            if isinstance(scan, Scan):
                middle_s = 1e-6 * scan.time_us + 0.5 / hello.rate_hz
                arrived_s = HOST_BEGIN_S + middle_s + random.exponential(1e-3)
                recorder.add(replace(scan, host_time_s=arrived_s))


def sensor_log(scene: Scene, seconds: float) -> tuple[Float, Float]:
    """Times [s] from the board's start and forces [N], with noise, and a zero that is off."""
    random = np.random.default_rng(3)
    times_s = np.arange(0, seconds, 1 / SENSOR_HZ)
    force_n = np.array([scene.force_n(time_s).sum() for time_s in times_s])
    return times_s, force_n + SENSOR_ZERO_N + SENSOR_NOISE_N * random.standard_normal(times_s.size)


def write_log(path: Path, times_s: Float, force_n: Float, header: str = "time_s,force_n") -> None:
    rows = [f"{time_s:.6f},{force:.4f}" for time_s, force in zip(times_s, force_n, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
