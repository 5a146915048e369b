# SPDX-License-Identifier: Apache-2.0
"""Settings of the built firmware in EEPROM."""

import struct
from typing import Any

import numpy as np
import pytest

from firmware_helpers import OTHER_SCAN, RECORD_SIZE, assert_whole, reset
from lockstep import DEFAULT_SCAN, Rig
from ohmskin.link import protocol

pytestmark = pytest.mark.simavr


def settings_in(hello: dict[str, Any]) -> dict[str, Any]:
    names = ("rows", "columns", "rate_asked_mhz", "settle_asked_us", "adc_prescaler", "unit_id")
    return {name: hello[name] for name in names}


@pytest.fixture
def saved(rig: Rig) -> dict[str, Any]:
    """Saves settings other than the defaults; what `hello` then says of them."""
    rig.must("configure", **OTHER_SCAN)
    rig.must("set_unit_id", unit_id=0xC0FFEE)
    rig.must("save")
    return settings_in(rig.hello())


def test_saved_settings_survive_a_reset(rig: Rig, saved: dict[str, Any]) -> None:
    hello = reset(rig)
    assert hello["settings"] == "stored"
    assert settings_in(hello) == saved
    content = rig.sim.eeprom()
    assert content[RECORD_SIZE:] == b"\xff" * (len(content) - RECORD_SIZE)
    rig.must("save")
    assert rig.sim.eeprom() == content


def test_a_record_with_any_one_byte_damaged_yields_the_defaults(
    rig: Rig, rng: np.random.Generator, saved: dict[str, Any]
) -> None:
    sound = rig.sim.eeprom()
    for offset in range(RECORD_SIZE):
        rig.sim.write_eeprom(bytes([sound[offset] ^ int(rng.integers(1, 256))]), offset)
        hello = reset(rig)
        assert hello["settings"] == "defaults_damaged", offset
        assert (hello["rows"], hello["columns"], hello["unit_id"]) == (8, 8, 0)
        rig.sim.write_eeprom(sound)
    assert settings_in(reset(rig)) == saved
    rig.sim.write_eeprom(b"\xff" * len(sound))
    assert reset(rig)["settings"] == "defaults_blank"


def test_a_record_of_impossible_settings_yields_the_defaults(
    rig: Rig, saved: dict[str, Any]
) -> None:
    scan = protocol.FRAMES["configure"].pack(**(DEFAULT_SCAN | {"rows": 200}))
    record = struct.pack("<HI", protocol.LAYOUT_CRC, 5) + scan
    rig.sim.write_eeprom(record + struct.pack("<H", protocol.crc16(record)))
    hello = reset(rig)
    assert (hello["settings"], hello["rows"], hello["unit_id"]) == ("defaults_damaged", 8, 0)


def test_a_reset_during_save_leaves_old_settings_new_ones_or_defaults(
    rig: Rig, saved: dict[str, Any]
) -> None:
    sound = rig.sim.eeprom()
    seen = set()
    for pause_ms in (0, 1, 4, 9, 17, 25, 40, 60):
        rig.must("configure", **DEFAULT_SCAN)
        rig.must("set_unit_id", unit_id=1)
        new = settings_in(rig.hello())
        rig.send("save")
        rig.run(0.0005 + pause_ms / 1000)
        hello = reset(rig)
        seen.add(hello["settings"])
        if hello["settings"] == "stored":
            assert settings_in(hello) in (saved, new)
        else:
            assert hello["settings"] == "defaults_damaged"
            assert (hello["rows"], hello["unit_id"]) == (8, 0)
        rig.sim.write_eeprom(sound)
        reset(rig)
    assert seen == {"stored", "defaults_damaged"}


def test_save_while_scanning_loses_no_scan(rig: Rig, rng: np.random.Generator) -> None:
    rig.start_scan()
    for unit_id in (0xFFFFFFFF, 0x01020304, 0xFFFFFFFF):
        rig.must("set_unit_id", unit_id=unit_id)
        rig.must("save")
        rig.run_cycles(int(rng.integers(200_000)))
    rig.must("stop")
    assert_whole(rig)
    assert reset(rig)["unit_id"] == 0xFFFFFFFF


def test_load_defaults_leaves_the_eeprom_alone(rig: Rig, saved: dict[str, Any]) -> None:
    content = rig.sim.eeprom()
    rig.must("load_defaults")
    hello = rig.hello()
    asked = {"rate_mhz": "rate_asked_mhz", "settle_us": "settle_asked_us"}
    defaults = {asked.get(name, name): value for name, value in DEFAULT_SCAN.items()}
    assert settings_in(hello) == defaults | {"unit_id": 0}
    assert rig.sim.eeprom() == content
    assert settings_in(reset(rig)) == saved
