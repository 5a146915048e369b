# SPDX-License-Identifier: Apache-2.0
"""The board by Arduino's own calls, built for an Uno: slow, but what it sends is right."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware_helpers import CYCLES_PER_US, assert_whole
from lockstep import DEFAULT_SCAN, LockstepSim, Rig, elf_of
from pin_maps import build

pytestmark = [
    pytest.mark.simavr,
    pytest.mark.skipif(not elf_of("uno_arduino").exists(), reason="needs 'make firmware'"),
]
KEPT_MHZ = 17_000  # at 8x8


@pytest.fixture
def rig(rng: np.random.Generator) -> Iterator[Rig]:
    with Rig("uno", LockstepSim("uno", elf_of("uno_arduino"))) as rig:
        rig.run(0.05)
        rig.randomize(rng)
        yield rig


def stamp_errors_us(rig: Rig) -> np.ndarray:
    """How far each scan's time is from its first hold, all boards' clocks apart."""
    starts = rig.check().start_cycles[[scan.header["scan"] for scan in rig.scans]]
    errors = np.array([scan.header["time_us"] for scan in rig.scans]) - starts / CYCLES_PER_US
    return errors - np.median(errors)


def test_codes_and_times_are_right(rig: Rig, rng: np.random.Generator) -> None:
    rig.start_scan(rate_mhz=KEPT_MHZ)
    for _ in range(6):
        rig.run(0.2)
        rig.randomize(rng)
    rig.must("stop")
    assert_whole(rig)
    assert len(rig.scans) > 19
    assert np.abs(stamp_errors_us(rig)).max() < 1000


def test_far_ends_are_read_too(rig: Rig) -> None:
    rig.start_scan(rate_mhz=20_000, rows=16, columns=3, mode="far")
    rig.run(0.5)
    rig.must("stop")
    assert_whole(rig)


def test_a_rate_that_it_cannot_keep_costs_scans_and_nothing_is_wrong(rig: Rig) -> None:
    """Nothing comes late with another time; commands are answered meanwhile.

    Slots that are late leave little time for anything else: answers may take more than a second.
    """
    for rate_mhz in (19_000, 30_000, 90_000):
        rig.start_scan(rate_mhz=rate_mhz)
        rig.run(0.5)
        rig.must("get_hello", limit_s=2)
        rig.must("stop", limit_s=2)
        if rig.scans:
            assert rig.check().wrong == 0
            assert np.abs(stamp_errors_us(rig)).max() < 1000
            last = rig.scans[-1].header
            assert last["scan"] + 1 == len(rig.scans) + last["dropped"]


def test_its_self_test_reads_all_that_it_judges(rig: Rig) -> None:
    """Once its slots were too short for these calls: c and d were not read, and so judged wrong."""
    rig.sim.set_table(np.tile([1.0, 0.0], (16, 16, 4)))
    for mode, readings in (("near", 4), ("far", 8)):
        rig.must("configure", **(DEFAULT_SCAN | {"rate_mhz": 1000, "mode": mode}))
        rig.must("self_test", limit_s=1.0)
        report = rig.frames("self_test_report")[-1]
        assert report["findings"] == ()
        assert report["code_max"][:readings] == report["code_min"][:readings]
        assert report["code_max"][:readings] == (1023, 0) * (readings // 2)


def test_a_save_while_scanning_loses_no_scan(rig: Rig) -> None:
    """Each byte of it waited for the byte before, 3.4 ms, and so did the slots."""
    rig.start_scan(rate_mhz=20_000, rows=4, columns=4)
    for unit_id in (0x12345678, 0x23456789):
        rig.must("set_unit_id", unit_id=unit_id)
        rig.must("save", limit_s=2)
        rig.run(0.2)
    rig.must("stop")
    assert_whole(rig)
    assert len(rig.scans) >= 8


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        ("-DOHMSKIN_SENSE_INPUTS=0,1,2,4", "OHMSKIN_ANALOG_PINS has no such input"),
        ("-DOHMSKIN_DRIVE_TOP_PIN=16", "a pin drives and senses"),
        ("-DOHMSKIN_SENSE_INPUTS=0,1,2,4 -DOHMSKIN_ANALOG_PINS=A0,A1,A2,A3,A4", ""),
    ],
)
def test_a_wiring_that_cannot_be_does_not_compile(flags: str, why: str, tmp_path: Path) -> None:
    if why:
        with pytest.raises(RuntimeError, match=f"static assertion failed: .*{why}"):
            build("uno_arduino", flags, tmp_path)
    else:
        build("uno_arduino", flags, tmp_path)


def test_settings_last(rig: Rig) -> None:
    rig.must("set_unit_id", unit_id=77)
    rig.must("save")
    before = len(rig.frames("hello"))
    rig.sim.reset()
    rig.run(0.05)
    (hello,) = rig.frames("hello")[before:]
    assert (hello["unit_id"], hello["settings"]) == (77, "stored")
