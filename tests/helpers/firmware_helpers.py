# SPDX-License-Identifier: Apache-2.0
"""What the tests of the built firmware share besides fixtures."""

import json
from typing import Any

import numpy as np

from lockstep import CPU_HZ, Rig
from ohmskin.link import protocol
from places import ROOT

CYCLES_PER_US = CPU_HZ // 1_000_000
BAUD_DEFAULT = protocol.CONSTANTS["baud_default"]
BAUD_FAST = protocol.CONSTANTS["baud_fast"]
VECTORS = json.loads((ROOT / "protocol" / "vectors.json").read_text(encoding="utf-8"))
COMMANDS = [f.name for f in protocol.FRAMES.values() if f.sender == "host"]
RECORD_AT, RECORD_SIZE = 32, 29  # of the first record of settings in EEPROM
OTHER_SCAN = {
    "rows": 5,
    "columns": 3,
    "rate_mhz": 123_456,
    "settle_us": 60,
    "accuracy": "fine",
    "mode": "far",
}


def reset(rig: Rig, registers: dict[int, int] | None = None) -> dict[str, Any]:
    """Pull the reset pin, leave registers as a boot loader does; what the board says by itself."""
    before = len(rig.frames("hello"))
    rig.sim.reset()
    for address, value in (registers or {}).items():
        rig.sim.poke(address, value)
    rig.run(rig.sim.boot_s)
    (hello,) = rig.frames("hello")[before:]
    return hello


def go_fast(rig: Rig) -> None:
    rig.must("set_baud", baud=BAUD_FAST)
    rig.run(0.002)
    rig.must("get_hello")


def numbers(rig: Rig) -> list[int]:
    return [scan.header["scan"] for scan in rig.scans]


def assert_whole(rig: Rig) -> None:
    """No scan since start_scan is missing, damaged or wrong."""
    assert rig.damaged == 0
    assert rig.scans
    assert numbers(rig) == list(range(len(rig.scans)))
    assert {scan.header["dropped"] for scan in rig.scans} == {0}
    assert rig.check().wrong == 0


def random_region(rng: np.random.Generator) -> dict[str, Any]:
    """Any rows and columns of 8x8, in any mode, with whole scans now and then."""
    return {
        "row_mask": int(rng.integers(1, 256)),
        "column_mask": int(rng.integers(1, 256)),
        "rate_mhz": int(rng.choice([0, 0, 20_000])),
        "settle_us": int(rng.choice([0, 15, 60])),
        "mode": str(rng.choice(list(protocol.MODES))),
        "whole_mode": str(rng.choice(list(protocol.MODES))),
        "whole_every": int(rng.choice([0, 1, 2, 5])),
    }
