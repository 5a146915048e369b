# SPDX-License-Identifier: Apache-2.0
"""Measure one process that reads the forces of eight boards at once, for five minutes.

    make bench-boards

Prints a table of bars and, as the last line, one JSON object. The exit code is 1 when a bar is
missed. Takes a little longer than 5 minutes, or `--minutes N`. The boards are emulated, 8x8 at 90
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
import os
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from bars import at_least, at_most, report  # beside this file
from bench_force import PRESSES, board_8x8, calibration
from numpy.typing import NDArray
from served import serve, served  # beside this file

import ohmskin
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.record.readings import load_readings

BOARDS = 8
RATE_HZ = 90
NOISE_LSB = 0.3
NOISES = 10  # of each reading
SETTLED_S = 5.0

# ------------------------------------------------------------------ the boards, another process


class CheapBoard(EmulatedBoard):
    """A board whose codes (n, 8, 8, 4) are made beforehand."""

    def __init__(self, codes: NDArray[np.uint16], unit_id: int) -> None:
        self.made = codes
        settings = BoardSettings(rate_hz=RATE_HZ, unit_id=unit_id)
        super().__init__(lambda *_: codes[0] / 1024, settings)

    def codes_at(self, time_s: float, mode: str = "near") -> NDArray[np.uint16]:
        return self.made[round(time_s * RATE_HZ) % len(self.made)]


def made_codes() -> NDArray[np.uint16]:
    ratio = np.tile(load_readings(PRESSES).ratio, (NOISES, 1, 1, 1))
    random = np.random.default_rng(1)
    return quantise(ratio + NOISE_LSB / 1024 * random.standard_normal(ratio.shape))


def serve_boards() -> None:
    """Serve the boards, and print at the end what was."""
    codes, before, begin_s = made_codes(), os.times(), time.monotonic()
    shifted = (np.roll(codes, 97 * unit_id, axis=0) for unit_id in range(1, BOARDS + 1))
    servers = serve([CheapBoard(made, unit_id) for unit_id, made in enumerate(shifted, start=1)])
    after, end_s = os.times(), time.monotonic()
    used_s = (after.user - before.user) + (after.system - before.system)
    said = {
        "begins_s": [server.begin_s for server in servers],
        "dropped": sum(server.lost_bytes for server in servers),
        "cpu_percent": 100 * used_s / (end_s - begin_s),
    }
    print(json.dumps(said))


# --------------------------------------------------------------------------------- measurement


def measure(minutes: float) -> dict[str, Any]:
    untouched = load_readings(PRESSES).rest_ratio
    assert untouched is not None
    rest_ratio = ratio_from_codes(quantise(untouched))
    of_skin = calibration(board_8x8(), rest_ratio, "touch")
    calibrations = [replace(of_skin, unit_id=unit_id) for unit_id in range(1, BOARDS + 1)]
    counts, missed, pressed = Counter[int](), 0, 0
    ages_s, times_s = [], []
    with (
        served(__file__, BOARDS) as emulated,
        ohmskin.open_all(emulated.ports, calibrations=calibrations) as skins,
    ):
        before, begin_s = os.times(), time.monotonic()
        for each in skins.scans():
            now_s = time.monotonic()
            counts[each.unit_id] += 1
            missed += each.scan.missed
            pressed += bool(each.scan.contacts)
            ages_s.append(now_s - each.scan.host_time_s)
            if now_s - begin_s > SETTLED_S:
                times_s.append((each.unit_id, each.scan.time_us, each.time_s))
            if now_s - begin_s >= 60 * minutes:
                break
        after, end_s = os.times(), time.monotonic()
        lost = [skin.stats.overflowed + skin.stats.line.damaged for skin in skins.values()]
    took_s = end_s - begin_s
    used_s = (after.user - before.user) + (after.system - before.system)
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
        "cpu_percent": round(100 * used_s / took_s, 1),
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


def main() -> int:
    if sys.argv[1:2] == ["--serve"]:
        serve_boards()
        return 0
    minutes = float(sys.argv[sys.argv.index("--minutes") + 1]) if "--minutes" in sys.argv else 5.0
    figures = measure(minutes)
    all_met = report(figures, BARS)
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
