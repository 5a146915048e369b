# SPDX-License-Identifier: Apache-2.0
"""What bench_firmware.py measures of fewer readings and of regions, for each AVR board.

half_8x8_hz, quick_8x8_hz, half_16x16_hz, quick_16x16_hz
                      rate 0, 20 us to settle, 500 kbaud: scans that reached the host a second
region_3x3_quick_hz, region_3x3_half_hz, region_3x3_quick_whole10_hz
                      1700, 1200 and 1700 Hz asked for of 3x3 cells of 8x8, at 1 Mbaud; the last
                      with whole scans in mode quick ten times a second, which count
dropped_modes         scans that were lost in all of these
readings_modes, wrong_modes
                      readings of 500 regions at random, in all modes, with whole scans in between,
                      each asked for while the one before is scanned; and how many are wrong
..._second_simulator  the same in avr8js, half as many for each board
interrupt_cycles_max  the longest interrupt meanwhile, clock cycles
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bars import Part  # beside this file
from firmware_helpers import go_fast, numbers, random_region  # tests/helpers
from lockstep import CPU_HZ, Rig

_READINGS, _CHANGES = 2_000_000, 500
_WHOLE = {"rate_mhz": 0, "settle_us": 20}
_CELLS = {"row_mask": 0b11100, "column_mask": 0b1110}
# What is asked for, at 500 kbaud and then at 1 Mbaud.
_RATES: tuple[dict[str, dict[str, Any]], ...] = (
    {
        f"{mode}_{size}x{size}_hz": _WHOLE | {"mode": mode, "rows": size, "columns": size}
        for size in (8, 16)
        for mode in ("half", "quick")
    },
    {
        "region_3x3_quick_hz": _CELLS | {"mode": "quick", "rate_mhz": 1_700_000},
        "region_3x3_half_hz": _CELLS | {"mode": "half", "rate_mhz": 1_200_000},
        "region_3x3_quick_whole10_hz": _CELLS
        | {"mode": "quick", "rate_mhz": 1_700_000, "whole_mode": "quick", "whole_every": 156},
    },
)


def measure_rates(rig: Rig, seconds: float) -> dict[str, float]:
    """Scans a second that come, by what is asked for."""
    found, dropped = {}, 0
    for group in _RATES:
        for name, scan in group.items():
            rig.start_scan(**scan)
            rig.run(seconds)
            rig.must("stop")
            first, *_, last = (scan.header for scan in rig.scans)
            took_us = (last["time_us"] - first["time_us"]) % (1 << 32)
            found[name] = round(1e6 * (len(rig.scans) - 1) / took_us, 1)
            dropped += last["scan"] + 1 - len(rig.scans)
        go_fast(rig)
    return found | {"dropped_modes": dropped}


def measure_regions(rig: Rig, rng: np.random.Generator, part: Part, share: float) -> dict[str, int]:
    """Readings of regions that change, and wrong ones; of all that is wanted, this share."""
    changes = max(2, part.of(round(share * _CHANGES)))
    each = part.of(round(share * _READINGS)) / changes
    rig.randomize(rng)
    rig.start_scan()
    taken = seen = 0
    for change in range(1, changes + 1):
        rig.must("set_region", **random_region(rng))
        while taken < each * change:
            rig.run_cycles(int(rng.integers(CPU_HZ // 10)))
            rig.randomize(rng)
            rig.take_holds()
            taken += sum(scan.codes.size for scan in rig.scans[seen:])
            seen = len(rig.scans)
    rig.must("stop")
    check = rig.check_regions()
    missing = len(set(range(len(rig.scans))) ^ set(numbers(rig)))
    return {"readings": check.readings, "wrong": check.wrong + missing + rig.damaged}


def measure_modes(rig: Rig, rng: np.random.Generator, part: Part) -> dict[str, float]:
    """All figures in simavr, of a board that scans at 500 kbaud."""
    rates = measure_rates(rig, max(0.2, part.share))
    rig.sim.reset_stats()
    regions = measure_regions(rig, rng, part, 1.0)
    return rates | {
        **{f"{name}_modes": count for name, count in regions.items()},
        "interrupt_cycles_max": rig.sim.stats()["interrupts"]["cycles_max"],
    }


def measure_modes_second(rig: Rig, rng: np.random.Generator, part: Part) -> dict[str, int]:
    """Those of regions, in the second simulator."""
    found = measure_regions(rig, rng, part, 0.5)
    return {f"{name}_modes_second_simulator": count for name, count in found.items()}
