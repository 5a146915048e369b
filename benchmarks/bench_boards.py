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
import select
import subprocess
import sys
import time
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from bars import at_least, at_most, report  # beside this file
from bench_force import PRESSES, board_8x8, calibration
from numpy.typing import NDArray

import ohmskin
from ohmskin.emulate.board import EmulatedBoard
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
        super().__init__(lambda *_: codes[0] / 1024, 8, 8, rate_hz=RATE_HZ, unit_id=unit_id)

    def codes_at(self, time_s: float, mode: str = "near") -> NDArray[np.uint16]:
        return self.made[round(time_s * RATE_HZ) % len(self.made)]


def made_codes() -> NDArray[np.uint16]:
    ratio = np.tile(load_readings(PRESSES).ratio, (NOISES, 1, 1, 1))
    random = np.random.default_rng(1)
    return quantise(ratio + NOISE_LSB / 1024 * random.standard_normal(ratio.shape))


def serve(count: int) -> None:
    """Serve so many boards until stdin closes: print their ports, and at the end what was."""
    codes = made_codes()
    boards: dict[int, CheapBoard] = {}
    dropped = 0
    for unit_id in range(1, count + 1):
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        boards[master] = CheapBoard(np.roll(codes, 97 * unit_id, axis=0), unit_id)
        print(os.ttyname(slave), flush=True)
    begin_s, before = time.monotonic(), os.times()
    while True:
        due_s = [board.next_scan_s for board in boards.values()]
        wake_s = min((due for due in due_s if due is not None), default=float("inf"))
        wait_s = min(max(0.0, wake_s - (time.monotonic() - begin_s)), 0.2)
        ready = select.select([*boards, sys.stdin], [], [], wait_s)[0]
        if sys.stdin in ready:
            break
        now_s = time.monotonic() - begin_s
        for master, board in boards.items():
            octets = board.advance(now_s)
            if master in ready:
                board.receive(os.read(master, 4096))
                octets += board.advance(now_s)
            if octets:
                try:
                    dropped += len(octets) - os.write(master, octets)
                except BlockingIOError:
                    dropped += len(octets)
    after, end_s = os.times(), time.monotonic()
    used_s = (after.user - before.user) + (after.system - before.system)
    percent = 100 * used_s / (end_s - begin_s)
    print(json.dumps({"begin_s": begin_s, "dropped": dropped, "cpu_percent": percent}))


class Served:
    """Boards in another process. ports: theirs. said: afterwards, what `serve` printed."""

    def __init__(self, count: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.ports = [self._process.stdout.readline().strip() for _ in range(count)]
        self.said: dict[str, float] = {}

    def end(self) -> None:
        out, _ = self._process.communicate(timeout=20)
        self.said = json.loads(out)


@contextmanager
def served(count: int) -> Iterator[Served]:
    boards = Served(count)
    try:
        yield boards
    finally:
        boards.end()


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
        served(BOARDS) as emulated,
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
                times_s.append((each.scan.time_us, each.time_s))
            if now_s - begin_s >= 60 * minutes:
                break
        after, end_s = os.times(), time.monotonic()
        lost = [skin.stats.overflowed + skin.stats.line.damaged for skin in skins.values()]
    took_s = end_s - begin_s
    used_s = (after.user - before.user) + (after.system - before.system)
    board_us, time_s = np.array(times_s).T
    middle_s = emulated.said["begin_s"] + 1e-6 * board_us + 0.5 / RATE_HZ
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
        serve(int(sys.argv[2]))
        return 0
    minutes = float(sys.argv[sys.argv.index("--minutes") + 1]) if "--minutes" in sys.argv else 5.0
    figures = measure(minutes)
    all_met = report(figures, BARS)
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
