# SPDX-License-Identifier: Apache-2.0
"""Settings of the built firmware in EEPROM."""

import struct
from typing import Any

import numpy as np
import pytest

from firmware_helpers import OTHER_SCAN, RECORD_AT, RECORD_SIZE, assert_whole, reset
from lockstep import DEFAULT_SCAN, Rig
from ohmskin.link import protocol

pytestmark = pytest.mark.simavr


def settings_in(hello: dict[str, Any]) -> dict[str, Any]:
    names = ("rows", "columns", "rate_asked_mhz", "settle_asked_us", "accuracy", "mode")
    return {name: hello[name] for name in (*names, "unit_id")}


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
    assert content.strip(b"\xff") == content[RECORD_AT : RECORD_AT + RECORD_SIZE]
    rig.must("save")
    assert rig.sim.eeprom() == content


def test_a_record_with_any_one_byte_damaged_yields_the_defaults(
    rig: Rig, rng: np.random.Generator, saved: dict[str, Any]
) -> None:
    sound = rig.sim.eeprom()
    for offset in range(RECORD_AT, RECORD_AT + RECORD_SIZE):
        rig.sim.write_eeprom(bytes([sound[offset] ^ int(rng.integers(1, 256))]), offset)
        hello = reset(rig)
        assert hello["settings"] == "defaults_damaged", offset
        assert (hello["rows"], hello["columns"], hello["unit_id"]) == (8, 8, 0)
        rig.sim.write_eeprom(sound)
    assert settings_in(reset(rig)) == saved
    rig.sim.write_eeprom(b"\xff" * len(sound))
    assert reset(rig)["settings"] == "defaults_blank"


@pytest.mark.parametrize(
    ("at", "head", "mode"),
    [(RECORD_AT, b"\x02\x09", "far"), (RECORD_AT, b"\x01\x09", ""), (0, b"\xbe\xef", "")],
)
def test_the_unit_id_outlives_protocol_and_scan(rig: Rig, at: int, head: bytes, mode: str) -> None:
    """At 0 is the record of older firmware, which begins with its protocol's layout CRC.

    Records of before there were modes have none: they are near.
    """
    for rows, source, kept in (200, "defaults_damaged", 8), (5, "stored", 5):
        wanted = DEFAULT_SCAN | {"rows": rows, "mode": mode or "near"}
        scan = struct.pack("<BBIHB", rows, 8, wanted["rate_mhz"], 0, 32)
        record = head + struct.pack("<I", 5) + scan + (b"\1" if mode else b"")
        rig.sim.write_eeprom(record + struct.pack("<H", protocol.crc16(record)), at)
        hello = reset(rig)
        assert (hello["settings"], hello["rows"], hello["unit_id"]) == (source, kept, 5)
        assert hello["mode"] == (wanted["mode"] if source == "stored" else "near")


def test_a_reset_during_save_leaves_the_old_settings_or_the_new(
    rig: Rig, rng: np.random.Generator, saved: dict[str, Any]
) -> None:
    seen = set()
    for unit_id in range(60):
        rig.must("configure", **(OTHER_SCAN if unit_id % 2 else DEFAULT_SCAN))
        rig.must("set_unit_id", unit_id=unit_id * 0x01010101)
        old, saved = saved, settings_in(rig.hello())
        rig.send("save")
        rig.run(0.06 * rng.random())
        hello = reset(rig)
        assert hello["settings"] == "stored"
        assert settings_in(hello) in (old, saved)
        seen.add(settings_in(hello) == saved)
        saved = settings_in(hello)
    assert seen == {False, True}


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
    defaults = rig.frames("hello")[0]  # at boot with a blank EEPROM
    assert settings_in(rig.hello()) == settings_in(defaults) != saved
    assert rig.sim.eeprom() == content
    assert settings_in(reset(rig)) == saved
