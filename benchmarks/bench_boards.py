# SPDX-License-Identifier: Apache-2.0
"""Measure one process that reads the forces of eight boards at once, for five minutes.

    make bench-boards

Takes a little longer than 5 minutes, or `--minutes N`. The boards are emulated, 8x8 at 90
Hz, by one other process at pseudo-terminals. All repeat a second of four overlapping presses, whose
readings were made with ngspice (tests/data), with 0.3 LSB of noise; each is at another place of it.
Forces by `touch`. What is measured how:

scans, missed           of all boards together; pressed_percent: scans with a contact
scans_per_s_least       of the board that gave fewest
age_ms_p50, _p99        from the arrival of a scan's last byte until its forces are there, in order
                        of time: about a scan's duration, for the boards that come after are waited
                        for
age_ms_end              the same, mean of the last second: it does not grow
clock_error_ms_p50, _p99
                        from when the middle of a scan was, as the emulating process knows, to what
                        the scan says of it; both on CLOCK_MONOTONIC, absolute, after 5 s
cpu_percent             of one core: user and system time of the reading process
emulator_cpu_percent    the same of the emulating process
emulator_dropped_bytes  that the pseudo-terminals did not take: more than 4 KiB were not read
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ohmskin
from bars import at_least, at_most, run_minutes  # beside this file
from bench_force import PRESSES, board_8x8, calibration
from ohmskin.emulate.board import DEFAULT_RATE_HZ, BoardSettings, EmulatedBoard
from ohmskin.link.codes import quantise
from served import Load, serve, served  # beside this file
from studies.conditions import converted
from studies.trials import NOISE_LSB, reference_trial, rounded

BOARDS = 8  # that are read at once. Chosen.
RATE_HZ = round(DEFAULT_RATE_HZ)
NOISES = 10  # how often each frame is made, each time with other noise. Chosen.
SETTLED_S = 5.0  # until a board's clock is known. Chosen.

# ------------------------------------------------------------------ the boards, another process


class CheapBoard(EmulatedBoard):
    """A board whose codes (n, 8, 8, 4) are made beforehand."""

    def __init__(self, codes: NDArray[np.uint16], unit_id: int) -> None:
        self.made = codes
        settings = BoardSettings(rate_hz=RATE_HZ, unit_id=unit_id)
        super().__init__(lambda *_: codes[0] / 1024, settings)

    def codes_at(self, time_s: float, mode: str = "near") -> NDArray[np.uint16]:
        codes: NDArray[np.uint16] = self.made[round(time_s * RATE_HZ) % len(self.made)]
        return codes


def serve_boards() -> None:
    """Serve the boards, and print at the end what was."""
    ratio = np.tile(reference_trial(PRESSES).readings.ratio, (NOISES, 1, 1, 1))
    codes = quantise(converted(ratio, np.random.default_rng(1), NOISE_LSB))
    load = Load()
    shifted = (np.roll(codes, 97 * unit_id, axis=0) for unit_id in range(1, BOARDS + 1))
    servers = serve([CheapBoard(made, unit_id) for unit_id, made in enumerate(shifted, start=1)])
    said = {
        "begins_s": [server.begin_s for server in servers],
        "dropped": sum(server.lost_bytes for server in servers),
        "cpu_percent": load.percent(),
    }
    print(json.dumps(said))


# --------------------------------------------------------------------------------- measurement


def measure(minutes: float) -> dict[str, Any]:
    rest_ratio = rounded(reference_trial(PRESSES).readings).rest_ratio
    assert rest_ratio is not None
    of_skin = calibration(board_8x8(), rest_ratio, "touch")
    calibrations = [replace(of_skin, unit_id=unit_id) for unit_id in range(1, BOARDS + 1)]
    counts, missed, pressed = Counter[int](), 0, 0
    ages_s, times_s = [], []
    with (
        served(__file__, BOARDS) as emulated,
        ohmskin.open_all(emulated.ports, calibrations=calibrations) as skins,
    ):
        load, epoch_ns = Load(), time.time_ns() - time.monotonic_ns()
        for timed in skins.scans():
            counts[timed.unit_id] += 1
            missed += timed.scan.missed
            pressed += bool(timed.scan.contacts)
            ages_s.append(time.monotonic() - timed.scan.host_time_s)
            if load.seconds() > SETTLED_S:
                times_s.append(
                    (timed.unit_id, timed.scan.time_us, 1e-9 * (timed.scan.time_ns - epoch_ns))
                )
            if load.seconds() >= 60 * minutes:
                break
        took_s, cpu_percent = load.seconds(), load.percent()
        lost = [skin.stats.overflowed + skin.stats.line.damaged for skin in skins.values()]
    unit_id, board_us, time_s = np.array(times_s).T
    begin_s = np.array(emulated.said["begins_s"])[unit_id.astype(int) - 1]
    middle_s = begin_s + 1e-6 * board_us + 0.5 / RATE_HZ
    error_ms, age_ms = 1e3 * np.abs(time_s - middle_s), 1e3 * np.array(ages_s)
    return {
        "boards": len(counts),
        "minutes": minutes,
        "scans": counts.total(),
        "pressed_percent": round(100 * pressed / counts.total(), 1),
        "missed": missed,
        "overflowed_or_damaged": sum(lost),
        "scans_per_s_least": round(min(counts.values()) / took_s, 2),
        "age_ms_p50": round(float(np.percentile(age_ms, 50)), 2),
        "age_ms_p99": round(float(np.percentile(age_ms, 99)), 2),
        "age_ms_end": round(float(np.mean(age_ms[-BOARDS * RATE_HZ :])), 2),
        "clock_error_ms_p50": round(float(np.percentile(error_ms, 50)), 3),
        "clock_error_ms_p99": round(float(np.percentile(error_ms, 99)), 3),
        "cpu_percent": round(cpu_percent, 1),
        "emulator_cpu_percent": round(emulated.said["cpu_percent"], 1),
        "emulator_dropped_bytes": emulated.said["dropped"],
    }


BARS = (
    at_least("boards", BOARDS),
    at_most("missed", 0),
    at_most("overflowed_or_damaged", 0),
    at_least("scans_per_s_least", 89.5),
    at_most("clock_error_ms_p50", 1.0),
)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve_boards()
    else:
        sys.exit(run_minutes(__doc__, measure, BARS, minutes=5.0, least_minutes=0.15))
