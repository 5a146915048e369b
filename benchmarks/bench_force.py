# SPDX-License-Identifier: Apache-2.0
"""Measure the way from scan to force: time, live for ten minutes, and replay bit for bit.

    make bench-force

Takes a little longer than the live run: 10 minutes, or `--minutes N`. All skins are
simulated, 8x8. What is measured how:

force_ms_*              median wall time of one scan, from codes to forces and contacts, one core,
                        warm. `presses`: one second of four overlapping presses, readings made with
                        ngspice (tests/data). `finger`: a fingertip with soft edges that covers
                        some 15 cells. By `touch`; p99: 99th percentile.
live_*                  a process that iterates over the forces of a board, emulated by another
                        process at a pseudo-terminal, which a finger touches: scans in all, scans
                        missed, age of the newest scan at the end [ms], load of the reading process
                        [% of a core]. By `touch`.
replay_scans, _differ   scans of the first ten seconds of that, recorded and replayed, and how many
                        of these differ in any bit of a force or its standard deviation.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import ohmskin
from bars import at_least, at_most, run_minutes  # beside this file
from ohmskin.arrays import Float
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.tables import load_press_table
from ohmskin.emulate.scenes import BEGIN_S, BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Scene
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import Calibration
from ohmskin.force.reader import ForceScan, SkinReader
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recorder import Recorder
from places import ROOT  # tests/helpers
from served import Load, started  # beside this file
from studies.trials import reference_trial, rounded

PRESSES = "presses_8x8"  # of tests/data
FINGER = "emulator://8x8?scene=moving&seed=1"
SCANS, WARM_UP = 360, 20  # scans that are timed; the first ones do not count
RECORDED_S = 10.0  # of the live run


def calibration(board: Hello, rest_ratio: Float, method: str) -> Calibration:
    """By the example's presses: what a force costs does not depend on them."""
    wires = WireOhm(TOP_WIRE_OHM, BOTTOM_WIRE_OHM)
    calibrator = Calibrator(board, rest_ratio, method, 1e-4, wires)
    table = load_press_table(ROOT / "examples" / "presses.csv")
    return calibrator.calibration(calibrator.presses_in_table(table))[0]


def board_8x8() -> Hello:
    with ohmskin.open("emulator://8x8", start=False) as skin:
        return skin.info


def times_ms(reader: SkinReader, ratios: Float) -> Float:
    """Of every frame of readings (F, 8, 8, 4) after the first few."""
    taken_ms = []
    for number, codes in enumerate(quantise(ratios)):
        scan = Scan(codes, number, 11_111 * number, number / 90, 0)
        begin_s = time.perf_counter()
        reader.read(scan)
        taken_ms.append(1e3 * (time.perf_counter() - begin_s))
    return np.array(taken_ms[WARM_UP:])


def scan_times() -> dict[str, float]:
    board = board_8x8()
    pressed = reference_trial(PRESSES).readings
    pressed_rest = rounded(pressed).rest_ratio
    assert pressed_rest is not None
    scene = Scene("moving", 8, 8, seed=1)
    finger = np.array([scene.ratio(BEGIN_S + number / 90) for number in range(SCANS)])
    presses = np.tile(pressed.ratio, (-(-SCANS // len(pressed.ratio)), 1, 1, 1))
    figures = {}
    for name, rest, ratios in (
        ("presses", pressed_rest, presses),
        ("finger", scene.rest_ratio, finger),
    ):
        taken_ms = times_ms(SkinReader(board, calibration(board, rest, "touch")), ratios)
        figures[f"force_ms_{name}"] = round(float(np.median(taken_ms)), 3)
        figures[f"force_ms_{name}_p99"] = round(float(np.percentile(taken_ms, 99)), 3)
    return figures


def live(minutes: float) -> dict[str, Any]:
    rest = Scene("moving", 8, 8, seed=1).rest_ratio
    seen: list[ForceScan] = []
    with tempfile.TemporaryDirectory() as place, started("emulate", FINGER) as (_, port):
        path = Path(place) / "live.mcap"
        with ohmskin.open(port, start=False) as skin:
            of_skin = calibration(skin.info, rest, "touch")
        with ohmskin.open(port, calibration=of_skin, start=False) as skin:
            recorder = Recorder(path, skin.info)
            load = Load()
            count = missed = 0
            for scan in skin:
                count += 1
                missed += scan.missed
                if load.seconds() < RECORDED_S:
                    recorder.add(scan)
                    seen.append(replace(scan, contacts=()))
                else:
                    recorder.close()
                if load.seconds() >= 60 * minutes:
                    break
            recorder.close()
            age_s = time.monotonic() - scan.host_time_s
            scans_per_s, cpu_percent = count / load.seconds(), load.percent()
        with ohmskin.open(f"replay://{path}?speed=0", calibration=of_skin) as skin:
            again = list(skin)
    return {
        "live_minutes": minutes,
        "live_scans": count,
        "live_missed": missed,
        "live_scans_per_s": round(scans_per_s, 2),
        "live_age_ms": round(1e3 * age_s, 2),
        "live_cpu_percent": round(cpu_percent, 1),
        "replay_scans": len(again),
        "replay_differ": abs(len(again) - len(seen))
        + sum(bits(one) != bits(other) for one, other in zip(seen, again, strict=False)),
    }


def bits(scan: ForceScan) -> tuple[int, bytes, bytes]:
    return scan.number, scan.force_n.tobytes(), scan.force_n_std.tobytes()


BARS = (
    at_most("force_ms_presses", 1.0),
    at_most("live_missed", 0),
    at_least("live_scans_per_s", 89.5),
    at_least("replay_scans", 0.95 * 90 * RECORDED_S),
    at_most("replay_differ", 0),
)


def measure(minutes: float) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    return scan_times() | live(minutes)


if __name__ == "__main__":
    sys.exit(run_minutes(__doc__, measure, BARS, minutes=10.0, least_minutes=0.05))
