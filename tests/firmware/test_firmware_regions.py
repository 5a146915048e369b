# SPDX-License-Identifier: Apache-2.0
"""Regions of the built firmware: their codes, order and times, changed while it scans."""

import itertools
from typing import Any

import numpy as np
import pytest

from firmware_helpers import go_fast, numbers, random_region
from lockstep import DEFAULT_SCAN, Rig
from ohmskin.link import framing, protocol

pytestmark = pytest.mark.simavr

MODES = list(protocol.MODES)
REGION: dict[str, Any] = {
    "row_mask": 0b11100,
    "column_mask": 0b1110,
    "rate_mhz": 0,
    "settle_us": 0,
    "mode": "quick",
    "whole_mode": "near",
    "whole_every": 0,
}


def test_regions_that_change_while_scanning_are_read_as_their_scans_say(
    rig: Rig, rng: np.random.Generator
) -> None:
    """Every code is of its cell, its reading and its time, and no scan is lost or torn."""
    go_fast(rig)
    rig.start_scan()
    for _ in range(12):
        region = random_region(rng)
        rig.must("set_region", **region)
        for _ in range(3):
            rig.run_cycles(int(rng.integers(100_000)))
            rig.randomize(rng)
    rig.must("stop")
    check = rig.check_regions()
    assert check.wrong == 0
    assert rig.damaged == 0
    assert numbers(rig) == list(range(len(rig.scans)))
    assert len({scan.header["mode"] for scan in rig.scans}) == 4


def test_the_second_scan_begun_after_the_command_has_the_new_region(rig: Rig) -> None:
    for before in {}, {"mode": "quick", "rate_mhz": 0}, {"rate_mhz": 0, "settle_us": 1}:
        rig.start_scan(**before)
        rig.run(0.04)
        rig.must("set_region", **REGION)
        heard_us = rig.frames("ack")[-1]["time_us"]
        rig.run(0.02)
        rig.must("stop")
        after = [s.header for s in rig.scans if s.header["time_us"] > heard_us]
        assert all(header["row_mask"] == REGION["row_mask"] for header in after[1:])
        assert len(after) > 4
        assert rig.check_regions().wrong == 0


def test_the_smallest_regions_are_read_by_short_interrupts(
    rig: Rig, rng: np.random.Generator
) -> None:
    """A scan of one to four readings begins, ends and changes in the same few slots.

    At rate 0 they leave the processor no time to plan a region, so that a few scans are dropped.
    """
    go_fast(rig)
    rig.start_scan()
    rig.sim.reset_stats()
    for mode, lines, whole_every in itertools.product(MODES, range(1, 5), (0, 1, 3)):
        small = {"mode": mode, "row_mask": 1, "column_mask": protocol.all_lines(lines)}
        by_row = {"row_mask": small["column_mask"], "column_mask": 2}
        for region in small, small | by_row:
            rig.must("set_region", **(REGION | region | {"whole_every": whole_every}))
            rig.run(float(rng.uniform(0.01, 0.03)))
            rig.randomize(rng)
    rig.must("stop")
    assert rig.check_regions().wrong == 0
    last = rig.scans[-1].header
    assert last["scan"] + 1 - len(rig.scans) == last["dropped"] < 10
    assert rig.sim.stats()["interrupts"]["cycles_max"] <= 270


def test_whole_scans_come_in_between(rig: Rig) -> None:
    rig.start_scan()
    rig.must("set_region", **(REGION | {"whole_every": 6, "whole_mode": "half"}))
    rig.run(0.2)
    rig.must("stop")
    modes = [scan.header["mode"] for scan in rig.scans]
    first = modes.index("half")
    assert set(modes[:first]) <= {"near", "quick"}
    for n, scan in enumerate(rig.scans[first:]):
        whole = n % 6 == 0
        assert scan.header["mode"] == ("half" if whole else "quick")
        assert scan.header["row_mask"] == (0xFF if whole else REGION["row_mask"])
    assert rig.check_regions().wrong == 0
    assert rig.scans[-1].header["dropped"] == 0


def test_a_region_that_cannot_be_is_refused_and_changes_nothing(rig: Rig) -> None:
    refused = {
        "bad_rows": ({"row_mask": 0}, {"row_mask": 0x100}, {"row_mask": 0x80000001}),
        "bad_columns": ({"column_mask": 0}, {"column_mask": 0x100}),
        "bad_rate": ({"rate_mhz": 999},),
        "bad_settle": ({"settle_us": 3001},),
        "line_too_slow": ({"rate_mhz": 2_000_000},),
    }
    rig.start_scan()
    for scanning in 1, 0:
        before = rig.hello()
        assert before["scanning"] == scanning
        for result, changes in refused.items():
            for change in changes:
                assert rig.command("set_region", **(REGION | change)) == result
        unknown = protocol.FRAMES["set_region"].pack(**(REGION | {"mode": 4}))
        rig.sim.write(framing.encode(protocol.FRAMES["set_region"].id, 77, unknown))
        assert rig.result_of(77) == "bad_mode"
        assert rig.hello() == before
        if scanning:
            rig.send("stop")
            assert rig.command("set_region", **REGION) == "busy"
            rig.run(0.05)
    rig.send("self_test")
    assert rig.command("set_region", **REGION) == "busy"
    rig.run(0.3)
    assert {scan.header["mode"] for scan in rig.scans} == {"near"}


@pytest.mark.parametrize("fast", [False, True])
def test_the_rate_that_is_said_is_the_rate_that_comes(rig: Rig, *, fast: bool) -> None:
    """Of the smallest skins and of large ones, in each mode, at rate 0: none is dropped."""
    if fast:
        go_fast(rig)
    for mode in protocol.MODES:
        for rows, columns in (1, 1), (2, 2), (3, 3), (5, 4), (8, 8):
            rig.start_scan(rows=rows, columns=columns, mode=mode, rate_mhz=0, settle_us=1)
            rig.run(0.12)
            rig.must("stop")
            assert rig.scans[-1].header["dropped"] == 0, (mode, rows, columns)
            assert numbers(rig) == list(range(len(rig.scans)))
            kept_hz = rig.frames("ack")[-3]["rate_mhz"] / 1000
            took_s = 1e-6 * (rig.scans[-1].header["time_us"] - rig.scans[0].header["time_us"])
            assert (len(rig.scans) - 1) / took_s == pytest.approx(kept_hz, rel=1e-3)
    assert rig.damaged == 0


def test_small_regions_keep_their_rate_for_long(rig: Rig) -> None:
    """A processor that is a little too slow drops the first scan after a quarter of a second."""
    rate_hz = 1700 if rig.hello()["board"] == "uno" else 1675
    go_fast(rig)
    rig.start_scan()
    rig.must("set_region", **(REGION | {"rate_mhz": 1000 * rate_hz}))
    rig.run(0.7)
    rig.must("stop")
    assert rig.scans[-1].header["dropped"] == 0
    assert len(rig.scans) > 0.6 * rate_hz
    assert rig.damaged == 0


def test_the_rate_that_is_answered_is_kept_for_long(rig: Rig) -> None:
    """Of regions that fill groups of four readings, and that do not: "at most" was too much."""
    go_fast(rig)
    for rows, columns, whole_every in (1, 1, 0), (1, 7, 0), (3, 3, 0), (3, 3, 156), (2, 5, 0):
        region = REGION | {"whole_every": whole_every, "whole_mode": "quick"}
        region |= {"row_mask": protocol.all_lines(rows), "column_mask": protocol.all_lines(columns)}
        assert rig.command("set_region", **(region | {"rate_mhz": 20_000_000})) != "ok"
        most = rig.frames("ack")[-1]["rate_mhz"]
        assert most > 1_700_000 or rows == 2  # bench-firmware asks for as much
        for share in 1.0, 0.99, 0.97, 0.95:  # they are divided into slots in other ways
            rig.must("set_region", **(region | {"rate_mhz": int(share * most)}))
            rig.must("start")
            rig.run(0.7)
            rig.must("stop")
            assert rig.scans[-1].header["dropped"] == 0, (region, most, share)
            rig.scans.clear()
    assert rig.damaged == 0


def test_settings_of_a_region_outlive_a_reset(rig: Rig) -> None:
    rig.must("configure", **DEFAULT_SCAN)
    rig.must("set_region", **(REGION | {"whole_every": 300}))
    rig.must("save")
    before = rig.hello()
    rig.sim.reset()
    rig.run(0.02)
    after = rig.hello()
    names = ("row_mask", "column_mask", "mode", "whole_mode", "whole_every", "scan_cycles")
    assert {name: after[name] for name in names} == {name: before[name] for name in names}
    assert after["settings"] == "stored"
