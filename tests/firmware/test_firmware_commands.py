# SPDX-License-Identifier: Apache-2.0
"""Commands to the built firmware: every one answered, what is refused changes nothing."""

import pytest

import ohmskin
from firmware_helpers import BAUD_DEFAULT, BAUD_FAST, COMMANDS, OTHER_SCAN, VECTORS, reset
from lockstep import CPU_HZ, DEFAULT_SCAN, Rig
from ohmskin.link import framing, protocol

pytestmark = pytest.mark.simavr


def test_boot_hello(rig: Rig) -> None:
    (only,) = rig.log
    assert only[0] == "hello"
    hello = only[1]
    assert hello["layout_crc"] == protocol.LAYOUT_CRC
    assert hello["board"] == rig.board
    version = [hello[f"version_{part}"] for part in ("major", "minor", "patch")]
    assert ".".join(map(str, version)) == ohmskin.__version__
    assert hello["settings"] == "defaults_blank"
    assert hello["reset_cause"] == ("power_on",)
    assert hello["baud"] == BAUD_DEFAULT
    assert hello["clock_hz"] == CPU_HZ
    assert (hello["rows"], hello["columns"]) == (8, 8)
    assert (hello["rate_asked_mhz"], hello["accuracy"]) == (90_000, "usual")
    assert (hello["unit_id"], hello["scanning"], hello["mode"]) == (0, 0, "near")
    assert rig.damaged == 0
    assert reset(rig)["reset_cause"] == ("external",)
    assert rig.hello() == hello | {"reset_cause": ("external",)}


def test_reset_causes_are_those_that_a_boot_loader_passes_in_r2(rig: Rig) -> None:
    mcusr, r2 = 0x54, 2
    for passed, causes in ({r2: 4}, ("brown_out",)), ({}, ()), ({r2: 3}, ("power_on",)), ({}, ()):
        assert reset(rig, {mcusr: 0} | passed)["reset_cause"] == causes


def test_golden_commands_are_acknowledged(rig: Rig) -> None:
    sent = 0
    for vector in VECTORS["valid"]:
        content = bytes.fromhex(vector["content"])
        if protocol.FRAMES_BY_ID[content[0]].sender != "host":
            continue
        sent += 1
        rig.sim.write(bytes.fromhex(vector["wire"]))
        rig.run(0.05)
        ack = {"command": content[0], "command_sequence": content[1], "result": "ok"}
        assert rig.frames("ack")[-1].items() >= ack.items(), vector["name"]
    assert sent >= 6
    assert len(rig.frames("ack")) == sent
    assert rig.damaged == 0


def test_golden_damaged_frames_are_not_answered(rig: Rig) -> None:
    for vector in VECTORS["damaged"]:
        rig.sim.write(bytes.fromhex(vector["wire"]))
        rig.run(0.01)
        assert rig.frames("ack") == [], vector["name"]
    assert rig.command("get_hello") == "ok"
    rig.start_scan()
    rig.run(0.05)
    assert len(VECTORS["damaged"]) - 1 <= rig.scans[-1].header["rx_errors"]
    assert rig.damaged == 0


def test_bad_commands_are_refused_by_name_and_change_nothing(rig: Rig) -> None:
    rig.must("configure", **OTHER_SCAN)
    rig.must("set_unit_id", unit_id=77)
    before = rig.hello()
    assert rig.command("configure", **(DEFAULT_SCAN | {"rows": 17})) == "bad_rows"
    for baud in (0, 115_200, 2_000_000, 0xFFFFFFFF):
        assert rig.command("set_baud", baud=baud) == "bad_baud"
    assert rig.hello() == before

    for command in COMMANDS:
        frame = protocol.FRAMES[command]
        sequence = 200 + COMMANDS.index(command)
        for payload in {bytes(frame.struct.size + 1), bytes(max(0, frame.struct.size - 1)), b"1"}:
            if len(payload) == frame.struct.size:
                continue
            rig.sim.write(framing.encode(frame.id, sequence, payload))
            assert rig.result_of(sequence) == "bad_length", command
    for unknown in (0x00, 0x01, 0x7F, 0x80, 0x8B, 0xFF):
        rig.sim.write(framing.encode(unknown, unknown & 0x7F, b""))
        assert rig.result_of(unknown & 0x7F) == "unknown_command"
    assert rig.hello() == before

    rig.must("start")
    for command, fields in (
        ("configure", DEFAULT_SCAN),
        ("load_defaults", {}),
        ("self_test", {}),
        ("set_baud", {"baud": BAUD_FAST}),
    ):
        assert rig.command(command, **fields) == "scanning"
    assert rig.hello() == before | {"scanning": 1}
    rig.must("stop")
    assert rig.hello() == before
    assert rig.damaged == 0


def test_set_baud_lasts_until_reset(rig: Rig) -> None:
    rig.sim.set_baud(BAUD_DEFAULT)
    rig.must("set_baud", baud=BAUD_FAST)
    rig.sim.set_baud(BAUD_FAST)
    for pause_s in (0.9, 1.2):
        rig.run(pause_s)
        assert rig.hello()["baud"] == BAUD_FAST
    rig.sim.set_baud(BAUD_DEFAULT)
    assert reset(rig)["baud"] == rig.hello()["baud"] == BAUD_DEFAULT
    assert rig.damaged == sum(rig.sim.stats()[of] for of in ("tx_let_go", "floating_pins")) == 0


def test_unconfirmed_baud_falls_back_after_a_second(rig: Rig) -> None:
    rig.sim.set_baud(BAUD_DEFAULT)
    rig.must("set_baud", baud=BAUD_FAST)
    confirm_s = protocol.CONSTANTS["baud_confirm_ms"] / 1000
    rig.run(confirm_s / 2)
    with pytest.raises(TimeoutError):  # the host's speed is not the board's
        rig.command("get_hello", limit_s=0.1)
    rig.run(confirm_s / 2)
    assert rig.hello()["baud"] == BAUD_DEFAULT
