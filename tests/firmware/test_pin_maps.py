# SPDX-License-Identifier: Apache-2.0
"""Boards that are wired otherwise, by flags: the firmware compiles for them, and reads right."""

import re
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from firmware_helpers import assert_whole, numbers
from lockstep import BOARDS, DEFAULT_SCAN, LockstepSim, Rig, elf_of
from ohmskin.circuit.configurations import ratio_from_current
from ohmskin.emulate import simavr
from ohmskin.emulate.scenes import LEAD_OHM
from ohmskin.emulate.simavr import SimulationError
from ohmskin.errors import PortError
from ohmskin.estimate.knowledge import SkinKnowledge
from pin_maps import DEFAULT, MAPS, WIDE, build, told_by
from places import ROOT
from second_simulator import SecondSim

pytestmark = [pytest.mark.simavr, pytest.mark.any_wiring]
HALF_ADC_CLOCK = 16  # clock cycles


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A function that builds a board's first wiring, once."""
    return cache(lambda board: build(board, MAPS[board][0].flags, tmp_path_factory.mktemp(board)))


# With the wiring from an independent table, in both simulators; and as the firmware tells it.
SIMULATORS = {
    "simavr": lambda board, elf, pins: LockstepSim(board, elf, pins=pins),
    "avr8js": lambda board, elf, pins: SecondSim(board, elf, pins),
    "as the firmware tells": lambda board, elf, pins: LockstepSim(board, elf),
}


@pytest.mark.parametrize(
    "simulator",
    ["simavr", pytest.param("avr8js", marks=pytest.mark.second_sim), "as the firmware tells"],
)
@pytest.mark.parametrize("board", BOARDS)
def test_a_board_that_is_wired_otherwise_reads_right(
    board: str, simulator: str, rng: np.random.Generator, built: Callable[[str], Path]
) -> None:
    pin_map, elf = MAPS[board][0], built(board)
    assert told_by(elf) == (pin_map.numbers, pin_map.ref_ohm)
    with Rig(board, SIMULATORS[simulator](board, elf, pin_map.pins(board))) as rig:
        rig.run(rig.sim.boot_s)
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
        assert stats.get("change_after_hold_cycles_min", HALF_ADC_CLOCK) >= HALF_ADC_CLOCK


def test_the_self_test_knows_unequal_references(built: Callable[[str], Path]) -> None:
    """10 kOhm at the rows, 47 kOhm at the columns: C and B then read beyond half of Vdd.

    A fault of the top node: its resistor is open, and cells hold it at the bottom's potential.
    """
    current = 1 / (57e3 + np.geomspace(100.0, 1e6, 256).reshape(16, 16))
    sound = ratio_from_current(current, 10e3, 47e3)
    faulty = np.tile([0.0, 0.0, 1.0, 1.0], (16, 16, 1))
    with Rig("uno", LockstepSim("uno", built("uno"))) as rig:
        rig.run(rig.sim.boot_s)
        for ratio, findings in (sound, ()), (faulty, ("top_reference_missing",)):
            rig.sim.set_table(ratio)
            rig.must("self_test", limit_s=1.0)
            assert rig.frames("self_test_report")[-1]["findings"] == findings


def test_a_simulated_port_has_the_references_that_the_firmware_tells(
    built: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A plate's resistors come out right over 10 and 47 kOhm, with capacitances, too."""
    plate = tmp_path / "plate.csv"
    plate.write_text("5000,open\nopen,47000\n")
    monkeypatch.setattr(simavr, "_BUILT", built("uno").parents[1])
    for options in ("", "&node_pf=100&sample_pf=14&input_ohm=10000", "&node_pf=100&line_pf=30"):
        with ohmskin.open(f"simavr://uno?rows=2&columns=2&plate={plate}{options}") as skin:
            skin.configure(rows=2, columns=2, settle_us=200)
            scan = skin.latest()
        assert scan.board.wiring == MAPS["uno"][0].crc
        refs = {"ref_top_ohm": scan.board.ref_top_ohm, "ref_bottom_ohm": scan.board.ref_bottom_ohm}
        assert tuple(refs.values()) == (10_000, 47_000)
        estimate = ohmskin.make_estimator("ohm", SkinKnowledge(2, 2, **refs)).estimate(scan.ratio)
        leads_ohm = 2 * LEAD_OHM
        assert 1 / np.diag(estimate.cell_siemens) - leads_ohm == pytest.approx(
            np.array([5e3, 47e3]), rel=0.02
        )


def test_firmware_that_does_not_tell_its_wiring_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "uno").mkdir()
    bare = tmp_path / "uno" / "firmware.elf"
    command = ["avr-objcopy", "--remove-section", ".ohmskin.wiring", elf_of("uno"), bare]
    subprocess.run(command, check=True)
    monkeypatch.setattr(simavr, "_BUILT", tmp_path)
    with pytest.raises(PortError, match="does not tell its wiring: run 'make firmware sim'"):
        ohmskin.open("simavr://uno")


def test_firmware_of_another_board_is_named() -> None:
    with pytest.raises(SimulationError, match="none of this board: is it another board's"):
        LockstepSim("uno", elf_of("megaatmega2560"))


def test_a_build_that_fails_says_the_compilers_lines(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"wiring\.h:\d+:\d+: error: .*four pins, S0 to S3"):
        build("uno", "-DOHMSKIN_ROW_PINS=4,5,6", tmp_path)


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


def test_an_avr_with_another_clock_does_not_compile(tmp_path: Path) -> None:
    """Its microseconds would be of another length."""
    source = ROOT / "firmware" / "src" / "board_avr.cpp"
    command = ["avr-g++", "-std=gnu++11", "-O2", "-mmcu=atmega328p", "-fsyntax-only", str(source)]
    include = [f"-I{ROOT / 'firmware' / 'src'}", f"-I{ROOT / 'protocol'}"]
    for clock_hz, code in ("16000000", 0), ("8000000", 1):
        flag = f"-DF_CPU={clock_hz}UL"
        done = subprocess.run([*command, *include, flag], capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        assert ("another clock has other times" in done.stderr) == (code == 1)


def test_the_default_wiring_is_that_of_the_table(tmp_path: Path) -> None:
    """What docs/build.md shows, by flags, in the simulators without a wiring of their own."""
    elf = build("uno", DEFAULT["uno"].flags, tmp_path)
    with Rig("uno", LockstepSim("uno", elf)) as rig:
        rig.run(rig.sim.boot_s)
        rig.randomize(np.random.default_rng(1))
        rig.start_scan(**DEFAULT_SCAN)
        rig.run(0.1)
        rig.must("stop")
        assert_whole(rig)
