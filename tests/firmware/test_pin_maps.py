# SPDX-License-Identifier: Apache-2.0
"""Boards that are wired otherwise, by flags: the firmware compiles for them, and reads right."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import second_simulator
from firmware_helpers import assert_whole, numbers
from lockstep import BOARDS, DEFAULT_SCAN, LockstepSim, Rig
from pin_maps import MAPS, WIDE, PinMap, build
from places import ROOT

pytestmark = pytest.mark.simavr
ADC_CLOCK = 32


def simulators(board: str, elf: Path, pin_map: PinMap) -> list[LockstepSim]:
    wired: list[LockstepSim] = [LockstepSim(board, elf, pins=pin_map.pins(board))]
    if second_simulator.is_installed("avr8js"):
        wired.append(second_simulator.SecondSim(board, elf, pin_map.pins(board)))
    return wired


@pytest.mark.parametrize("board", BOARDS)
def test_a_board_that_is_wired_otherwise_reads_right(
    board: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    pin_map = MAPS[board][0]
    for sim in simulators(board, build(board, pin_map.flags, tmp_path), pin_map):
        with Rig(board, sim) as rig:
            rig.run(sim.boot_s)
            rig.randomize(rng)
            rig.start_scan(mode="far", rows=16, columns=5)
            hello = rig.hello()
            assert (hello["ref_top_ohm"], hello["ref_bottom_ohm"]) == pin_map.ref_ohm
            assert hello["wiring"] == pin_map.crc
            for _ in range(4):
                rig.run(0.03)
                rig.randomize(rng)
            stats = rig.sim.stats()
            rig.must("stop")
            assert_whole(rig)
            assert stats.get("undriven", 0) == stats.get("floating_pins", 0) == 0
            # Pins change after the sample is held: PINS_AFTER_INTERRUPT of board_avr.cpp holds.
            assert stats.get("change_after_hold_cycles_min", ADC_CLOCK) >= ADC_CLOCK


def test_a_mega_reads_multiplexers_of_32_channels(rng: np.random.Generator, tmp_path: Path) -> None:
    """Two whole scans of 32x32 cells, and a region that has lines of both halves."""
    board, seconds = "megaatmega2560", 0.5
    elf = build(board, WIDE.flags, tmp_path)
    with Rig(board, LockstepSim(board, elf, pins=WIDE.pins(board)), WIDE.lines) as rig:
        rig.run(0.05)
        rig.randomize(rng)
        rig.start_scan(rate_mhz=0, rows=32, columns=32)
        hello = rig.hello()
        assert (hello["rows_max"], hello["columns_max"], hello["wiring"]) == (32, 32, WIDE.crc)
        rig.run(seconds)
        rig.must("set_region", **REGION_OF_32)
        rig.run(seconds)
        rig.must("stop")
        check = rig.check_regions()
        assert numbers(rig) == list(range(len(rig.scans)))
        assert check.wrong == rig.damaged == 0
        assert {scan.codes.shape for scan in rig.scans} == {(32, 32, 4), (3, 2, 1)}
        assert rig.sim.stats()["interrupts"]["cycles_max"] <= LONGEST_INTERRUPT


REGION_OF_32 = {
    "row_mask": 1 | 1 << 15 | 1 << 31,
    "column_mask": 1 << 7 | 1 << 16,
    "rate_mhz": 0,
    "settle_us": 20,
    "mode": "quick",
    "whole_mode": "near",
    "whole_every": 0,
}
# Clock cycles: 50 less than the shortest slot has after it.
LONGEST_INTERRUPT = 360
REFUSED = {
    "-DOHMSKIN_ROW_PINS=4,5,6,8": "a pin is used twice",
    "-DOHMSKIN_ROW_PINS=4,5,6": "four pins, S0 to S3",
    "-DOHMSKIN_DRIVE_TOP_PIN=1": "the serial line's",
    "-DOHMSKIN_DRIVE_TOP_PIN=20": "no such pin",
    "-DOHMSKIN_DRIVE_TOP_PIN=15": "a pin drives and senses",
    "-DOHMSKIN_SENSE_INPUTS=0,1,2,2": "an input is used twice",
    "-DOHMSKIN_SENSE_INPUTS=0,1,2,6": "no such input",
    "-DOHMSKIN_ROWS_MAX=32": "more than 16 lines want a Mega",
    "-DOHMSKIN_COLUMNS_MAX=17": "more than 16 lines want a Mega",
    "-DOHMSKIN_REF_TOP_OHM=30": "in ohms, 30000 for 30 kOhm",
}


REFUSED_BY_A_MEGA = {
    "-DOHMSKIN_ROWS_MAX=32": "five pins for more than 16 lines",
    "-DOHMSKIN_COLUMNS_MAX=32": "five pins for more than 16 lines",
}


@pytest.mark.parametrize(
    ("chip", "flag", "why"),
    [
        *(("atmega328p", *refused) for refused in REFUSED.items()),
        *(("atmega2560", *refused) for refused in REFUSED_BY_A_MEGA.items()),
    ],
)
def test_a_wiring_that_cannot_be_does_not_compile(
    chip: str, flag: str, why: str, tmp_path: Path
) -> None:
    """By the header alone, with avr-gcc: a whole build takes seconds."""
    (tmp_path / "wired.cpp").write_text('#include "avr_pins.h"\n')
    command = ["avr-g++", "-std=gnu++11", f"-mmcu={chip}", "-fsyntax-only", flag, "wired.cpp"]
    include = [f"-I{ROOT / 'firmware' / 'src'}", f"-I{ROOT / 'protocol'}"]
    done = subprocess.run([*command, *include], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.search(f"(static assertion failed:|#error) .*{why}", done.stderr)


def test_the_default_wiring_is_that_of_the_table(tmp_path: Path) -> None:
    """What docs/build.md shows, by flags, in the simulators without a wiring of their own."""
    default = PinMap((4, 5, 6, 7), (8, 9, 10, 11), (2, 3), (0, 1, 2, 3))
    elf = build("uno", default.flags, tmp_path)
    with Rig("uno", LockstepSim("uno", elf)) as rig:
        rig.run(rig.sim.boot_s)
        rig.randomize(np.random.default_rng(1))
        rig.start_scan(**DEFAULT_SCAN)
        rig.run(0.1)
        rig.must("stop")
        assert_whole(rig)
