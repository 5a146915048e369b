# SPDX-License-Identifier: Apache-2.0
"""What bench_firmware.py measures of boards besides the Uno and the Mega, all of it simulated.

pico                  a Pico's firmware in rp2040js, 8x8 unless said otherwise:
  wrong, readings     as of the other boards, at 90 Hz and with the shortest slots
  max_scan_hz         with 20 us to settle, delivered
  half_8x8_hz         the same in mode half
  scan_hz_16x16       the same with 16x16
  saves_lost          of 500 saves that a cut of the supply ends, those after which the board had
                      neither the old settings nor the new ones
  storms_failed       of 40 storms of four commands at once, with the shortest slots, those with an
                      answer that did not come, or with a refusal
  flash_bytes         of the image, boot2 included
arduino               the Uno's firmware by Arduino's own calls, in simavr:
  wrong, scan_hz      at 17 Hz, 8x8: readings, and scans that came
  stamp_error_ms      largest difference of a scan's time from its first hold, offset apart
pins                  three other wirings each of Uno and Mega, in both simulators:
  maps, readings, wrong
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bars import Part  # beside this file
from lockstep import BOARDS, CPU_HZ, DEFAULT_SCAN, LockstepSim, Rig, elf_of
from pin_maps import MAPS, build
from second_simulator import PICO_ELF, PicoSim, SecondSim

# Readings that are wanted. Chosen: a fault of one in so many would show.
_PICO_READINGS, _ARDUINO_READINGS, _PINS_READINGS = 2_000_000, 100_000, 200_000
_SAVES, _STORMS = 500, 40
_STORM = ("get_hello", "start", "get_hello", "start")
_ARDUINO_MHZ = 17_000
_OTHER_SCAN = DEFAULT_SCAN | {"rows": 5, "columns": 3, "rate_mhz": 60_000}


def _scan(rig: Rig, rng: np.random.Generator, readings: int, **scan: Any) -> dict[str, float]:
    """Readings of a scan while the skin changes: how many, wrong ones, delivered scans a second."""
    rig.randomize(rng)
    rig.start_scan(**scan)
    period = rig.hello()["scan_cycles"]
    while sum(each.codes.size for each in rig.scans) < readings:
        rig.run_cycles(int(rng.integers(3 * period, 9 * period)))
        rig.take_holds()
        rig.randomize(rng)
    rig.must("stop", limit_s=2)
    check = rig.check()
    made = rig.scans[-1].header["scan"]
    took_s = float(check.start_cycles[made] - check.start_cycles[0]) / CPU_HZ
    starts = check.start_cycles[[each.header["scan"] for each in rig.scans]]
    stamps_us = np.array([each.header["time_us"] for each in rig.scans]) - starts * 1e6 / CPU_HZ
    return {
        "readings": check.readings,
        "wrong": check.wrong,
        "hz": (len(rig.scans) - 1) / took_s,
        "stamp_error_ms": float(np.abs(stamps_us - np.median(stamps_us)).max()) / 1e3,
    }


def _saves_lost(rig: Rig, rng: np.random.Generator, saves: int) -> int:
    """How often power that fails during a save leaves neither the old settings nor the new."""
    assert isinstance(rig.sim, PicoSim)
    names = ("rows", "columns", "rate_asked_mhz", "unit_id")
    lost = 0
    rig.must("save")
    old = rig.hello()
    for number in range(saves):
        rig.must("configure", **(_OTHER_SCAN if number % 2 else DEFAULT_SCAN))
        rig.must("set_unit_id", unit_id=int(rng.integers(1 << 32)))
        new = rig.hello()
        rig.send("save")
        rig.run(0.012 * rng.random())
        rig.sim.cut_power()
        rig.run(rig.sim.boot_s)
        now = rig.frames("hello")[-1]
        kept = [all(now[name] == hello[name] for name in names) for hello in (old, new)]
        lost += not any(kept)
        old = now
    return lost


def _storms_failed(rig: Rig, storms: int) -> int:
    rig.start_scan(rate_mhz=0, settle_us=1)
    failed = 0
    for _ in range(storms):
        before = len(rig.frames("ack"))
        rig.sim.write(b"".join(rig.encode(name) for name in _STORM))
        rig.run(0.03)
        answers = [ack["result"] for ack in rig.frames("ack")[before:]]
        failed += answers != ["ok"] * len(_STORM)
    rig.must("stop")
    return failed


def measure_pico(part: Part) -> dict[str, Any]:
    """The entry `pico`."""
    rng = np.random.default_rng(5)
    half = part.of(_PICO_READINGS) // 2
    with Rig("pico", PicoSim()) as rig:
        rig.run(rig.sim.boot_s)
        normal = _scan(rig, rng, half)
        shortest = _scan(rig, rng, half, rate_mhz=0, settle_us=1)
        settled = {"rate_mhz": 0, "settle_us": 20}
        fastest = _scan(rig, rng, half // 10, **settled)
        of_half = _scan(rig, rng, half // 10, **settled, mode="half")
        large = _scan(rig, rng, half // 10, **settled, rows=16, columns=16)
        runs = (normal, shortest, fastest, of_half, large)
        storms = _storms_failed(rig, _STORMS)
        lost = _saves_lost(rig, rng, part.of(_SAVES))
    return {
        "wrong": int(sum(run["wrong"] for run in runs)),
        "readings": int(sum(run["readings"] for run in runs)),
        "max_scan_hz": round(fastest["hz"], 2),
        "half_8x8_hz": round(of_half["hz"], 2),
        "scan_hz_16x16": round(large["hz"], 2),
        "saves_lost": lost,
        "storms_failed": storms,
        "flash_bytes": PICO_ELF.with_suffix(".bin").stat().st_size,
    }


def measure_arduino(part: Part) -> dict[str, Any]:
    """The entry `arduino`."""
    with Rig("uno", LockstepSim("uno", elf_of("uno_arduino"))) as rig:
        rig.run(0.05)
        readings = part.of(_ARDUINO_READINGS)
        found = _scan(rig, np.random.default_rng(6), readings, rate_mhz=_ARDUINO_MHZ)
    return {
        "wrong": int(found["wrong"]),
        "readings": int(found["readings"]),
        "scan_hz": round(found["hz"], 2),
        "stamp_error_ms": round(found["stamp_error_ms"], 3),
    }


def measure_pins(part: Part) -> dict[str, Any]:
    """The entry `pins`."""
    rng = np.random.default_rng(7)
    found = {"maps": 0, "readings": 0, "wrong": 0}
    with TemporaryDirectory() as place:
        for board in BOARDS:
            for number, pin_map in enumerate(MAPS[board]):
                elf = build(board, pin_map.flags, Path(place) / str(number))
                found["maps"] += 1
                for simulator in (LockstepSim, SecondSim):
                    sim = simulator(board, elf, pins=pin_map.pins(board))
                    with Rig(board, sim) as rig:
                        rig.run(sim.boot_s)
                        run = _scan(rig, rng, part.of(_PINS_READINGS), mode="far")
                    found["readings"] += int(run["readings"])
                    found["wrong"] += int(run["wrong"])
    return found
