# SPDX-License-Identifier: Apache-2.0
"""A Pico's firmware as it is copied to the board, in rp2040js: boot, scan, USB, flash, watchdog."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_firmware_commands as commands
import test_firmware_regions as regions
import test_firmware_scan as scans
import test_firmware_self_test as self_test
import test_firmware_settings as settings

from firmware_helpers import OTHER_SCAN, assert_whole, go_fast, reset
from lockstep import DEFAULT_SCAN, Rig
from pin_maps import PinMap
from places import ROOT
from ports import USB_IDS
from second_simulator import PICO_ELF, PicoSim

pytestmark = pytest.mark.pico

saved = settings.saved
settings_in = settings.settings_in
test_boot_hello = commands.test_boot_hello
test_golden_commands = commands.test_golden_commands_are_acknowledged
test_golden_damaged_frames = commands.test_golden_damaged_frames_are_not_answered
test_bad_commands = commands.test_bad_commands_are_refused_by_name_and_change_nothing
test_codes_order_time_and_settling = scans.test_codes_order_time_and_settling_are_exact
test_settle_time_is_kept = scans.test_settle_time_is_kept_while_commands_arrive
test_board_clock_runs_on = scans.test_board_clock_runs_on_between_scans
test_stop = scans.test_stop_ends_with_a_whole_scan_and_its_ack
test_start_and_stop = scans.test_start_and_stop_at_random_phases_damage_nothing
test_no_load_damages_a_frame = scans.test_no_load_damages_a_frame
test_commands_at_the_highest_rate = scans.test_commands_back_to_back_at_the_highest_rate
test_commands_that_wait = scans.test_commands_that_wait_for_the_same_event_are_all_answered
test_more_commands_than_can_wait = scans.test_more_commands_than_can_wait_do_not_silence_the_board
test_a_command_at_the_highest_rate = scans.test_a_command_at_the_highest_rate_loses_no_scan
test_every_scan_arrives = scans.test_the_fast_line_carries_every_scan
test_random_bytes = scans.test_random_bytes_change_nothing
test_regions = regions.test_regions_that_change_while_scanning_are_read_as_their_scans_say
test_second_scan = regions.test_the_second_scan_begun_after_the_command_has_the_new_region
test_whole_scans = regions.test_whole_scans_come_in_between
test_the_rate_that_is_said = regions.test_the_rate_that_is_said_is_the_rate_that_comes
test_save_while_scanning = settings.test_save_while_scanning_loses_no_scan
test_load_defaults = settings.test_load_defaults_leaves_the_eeprom_alone
test_self_test = self_test.test_self_test_of_a_sound_board
test_self_test_of_far_nodes = self_test.test_self_test_judges_far_nodes

SECTOR_BYTES, ENTRY_BYTES = 4096, 4


@pytest.fixture
def rig(rng: np.random.Generator) -> Iterator[Rig]:
    with Rig("pico", PicoSim()) as rig:
        rig.run(rig.sim.boot_s)
        rig.randomize(rng)
        yield rig


def cut_power(rig: Rig) -> dict[str, Any]:
    """Switch the board off and on; what it says by itself."""
    before = len(rig.frames("hello"))
    assert isinstance(rig.sim, PicoSim)
    rig.sim.cut_power()
    rig.run(rig.sim.boot_s)
    (hello,) = rig.frames("hello")[before:]
    return hello


def entries(content: bytes) -> list[int]:
    """How many entries each of the two sectors has."""
    words = np.frombuffer(content, "<u4").reshape(2, -1)
    return [int((sector != 0xFFFFFFFF).sum()) for sector in words]


def test_pins_and_channel_stay_until_a_conversion_has_ended(rig: Rig) -> None:
    go_fast(rig)
    rig.start_scan(rate_mhz=0, settle_us=1)
    rig.run(0.1)
    rig.must("stop")
    assert_whole(rig)
    assert rig.sim.stats()["changed_while_converting"] == 0


def test_a_pico_that_is_wired_otherwise_reads_right(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    pin_map = PinMap((12, 0, 25, 14), (22, 21, 20, 3), (1, 16), (3, 1, 2, 0), (10_000, 47_000))
    pico = ROOT / "firmware" / "pico"
    command = ["make", "-s", "-C", pico, f"BUILD={tmp_path}", f"OHMSKIN_FLAGS={pin_map.flags}"]
    subprocess.run(command, check=True, capture_output=True)
    pins = (*pin_map.rows, *pin_map.columns, *pin_map.drive, *pin_map.sense)
    sim = PicoSim(tmp_path / "ohmskin.elf", ",".join(map(str, pins)))
    with Rig("pico", sim) as rig:
        rig.run(sim.boot_s)
        rig.randomize(rng)
        rig.start_scan(mode="far", rows=16, columns=5)
        hello = rig.hello()
        assert (hello["ref_top_ohm"], hello["ref_bottom_ohm"]) == pin_map.ref_ohm
        assert hello["wiring"] == pin_map.crc
        rig.run(0.05)
        rig.must("stop")
        assert_whole(rig)


def test_usb_keeps_to_the_rules(rig: Rig) -> None:
    assert isinstance(rig.sim, PicoSim)
    said = rig.sim.described()
    assert said["device"] == said["begin"]
    ids = tuple(int.from_bytes(said["device"][at : at + 2], "little") for at in (8, 10))
    assert ids == USB_IDS["pico"]  # by which the host finds it
    configuration = said["configuration"]
    assert int.from_bytes(configuration[2:4], "little") == len(configuration)
    assert said["serial_number"][2:].decode("utf-16-le") == "D0D1D2D3D4D5D6D7"
    rig.start_scan()
    rig.run(0.1)
    rig.must("stop")
    stats = rig.sim.stats()
    assert stats["wrong_toggles"] == stats["stalls"] == 0
    assert stats["usb_packets"] > 20


@pytest.mark.parametrize("endpoint", [0x02, 0x82])
def test_after_a_cleared_halt_packets_begin_with_data0(rig: Rig, endpoint: int) -> None:
    """A controller throws a packet away that is not the one it waits for."""
    assert isinstance(rig.sim, PicoSim)
    for _ in range(3):  # with an even number of packets before, and with an odd one
        rig.hello()
        rig.sim.clear_halt(endpoint)
        rig.run(0.005)
        rig.hello()
    stats = rig.sim.stats()
    assert stats["wrong_toggles"] == stats["stalls"] == 0


def test_a_port_that_nobody_reads_stops_no_scan(rig: Rig) -> None:
    assert isinstance(rig.sim, PicoSim)
    rig.start_scan()
    rig.run(0.1)
    rig.sim.open_port(False)
    rig.run(0.3)
    rig.sim.open_port(True)
    rig.run(0.1)
    rig.must("stop")
    numbers = [scan.header["scan"] for scan in rig.scans]
    assert 20 < max(np.diff(numbers)) < 32
    assert rig.scans[-1].header["dropped"] == 0
    assert rig.damaged <= 2  # frames of which the host has a part
    assert rig.check().wrong == 0


def test_saved_settings_survive_a_reset_and_power(rig: Rig, saved: dict[str, Any]) -> None:
    for start in (reset, cut_power):
        hello = start(rig)
        assert hello["settings"] == "stored"
        assert settings_in(hello) == saved
    content = rig.sim.eeprom()
    rig.must("save")
    assert rig.sim.eeprom() == content


def save(rig: Rig, unit_id: int) -> dict[str, Any]:
    """Save other settings; what `hello` says of them."""
    rig.must("configure", **(OTHER_SCAN if unit_id % 2 else DEFAULT_SCAN))
    rig.must("set_unit_id", unit_id=unit_id * 0x01010101)
    rig.must("save")
    return settings_in(rig.hello())


def test_a_full_sector_moves_to_the_other_one(rig: Rig) -> None:
    now = save(rig, 0)
    full = [entries(rig.sim.eeprom())]
    for unit_id in range(1, 150):
        now = save(rig, unit_id)
        full.append(entries(rig.sim.eeprom()))
    assert settings_in(cut_power(rig)) == now
    most = SECTOR_BYTES // ENTRY_BYTES
    assert max(map(max, full)) > most - 40
    assert {number[1] > 0 for number in full} == {False, True}
    stats = rig.sim.stats()
    assert stats["flash_refused"] == 0
    assert 2 <= stats["flash_erases"] <= 4


@pytest.mark.parametrize("begun", [0, 900])
def test_power_cut_during_save_leaves_the_old_settings_or_the_new(
    rig: Rig, rng: np.random.Generator, begun: int
) -> None:
    """With a new sector, and with one that is full soon: its erasing is cut, too."""
    old = save(rig, 1)
    while max(entries(rig.sim.eeprom())) < begun:
        old = save(rig, int(rng.integers(256)))
    seen = set()
    for unit_id in range(25):
        rig.must("configure", **(OTHER_SCAN if unit_id % 2 else DEFAULT_SCAN))
        rig.must("set_unit_id", unit_id=unit_id * 0x01010101)
        new = settings_in(rig.hello())
        rig.send("save")
        rig.run((0.02 if begun == 0 or unit_id % 4 else 0.09) * rng.random())
        hello = cut_power(rig)
        assert hello["settings"] == "stored"
        assert settings_in(hello) in (old, new)
        seen.add(settings_in(hello) == new)
        old = settings_in(hello)
    assert seen == {False, True}


def test_a_power_cut_amid_a_packet_leaves_a_board_that_answers(rig: Rig) -> None:
    """The simulated host waited for the packet's end for ever, and sent the board nothing more."""
    rig.send("save")
    rig.run(11e-6)
    cut_power(rig)
    rig.must("get_hello")


def address_of(symbol: str) -> int:
    listing = subprocess.check_output(["arm-none-eabi-nm", PICO_ELF], text=True)
    return {line.split()[-1]: int(line.split()[0], 16) for line in listing.splitlines()}[symbol]


def test_a_board_that_goes_to_sleep_misses_no_command(rig: Rig, rng: np.random.Generator) -> None:
    """One that comes amid the pass before the sleep is answered as soon as any other."""
    rig.run(0.01)
    step_cycles = 160  # 10 us
    waits = set()
    for _ in range(200):
        rig.sim.run_cycles(int(rng.integers(16_000, 40_000)))
        rig.send("get_hello")
        steps = 1
        while not rig.sim.run_cycles(step_cycles):
            steps += 1
            assert steps < 100
        waits.add(steps)
    assert max(waits) - min(waits) <= 1


def test_new_firmware_says_of_no_watchdog_that_it_hung(rig: Rig) -> None:
    """The ROM's boot loader has the watchdog restart the chip once the file is there."""
    assert isinstance(rig.sim, PicoSim)
    for _ in range(2):
        before = len(rig.frames("hello"))
        rig.sim.restart_by_rom()
        rig.run(rig.sim.boot_s)
        (hello,) = rig.frames("hello")[before:]
        assert hello["reset_cause"] == ()


def test_the_simulated_host_finds_a_board_that_was_reset_amid_packets(rig: Rig) -> None:
    for n in range(6):
        rig.start_scan(rows=16, columns=16, rate_mhz=0, settle_us=1)
        rig.run(0.01 + 13e-6 * n)  # a packet takes 51 us, and most of the time one is on its way
        assert reset(rig)["reset_cause"] == ("external",)


@pytest.mark.parametrize("scanning", [False, True])
def test_watchdog_restarts_a_hung_main_loop(rig: Rig, scanning: bool) -> None:
    if scanning:
        rig.start_scan()
        rig.run(0.1)
    hellos, resets = len(rig.frames("hello")), rig.sim.stats()["resets"]
    rig.sim.jump(address_of("hang"))
    rig.run(0.2)
    assert rig.sim.stats()["resets"] == resets
    rig.run(0.05 + rig.sim.boot_s)
    assert rig.sim.stats()["resets"] == resets + 1
    (hello,) = rig.frames("hello")[hellos:]
    assert (hello["reset_cause"], hello["scanning"]) == (("watchdog",), 0)
    rig.start_scan()
    rig.run(0.5)  # and it does not come again
    rig.must("stop")
    assert rig.damaged <= scanning  # the frame in which it hung
    assert [scan.header["scan"] for scan in rig.scans] == list(range(len(rig.scans)))
    assert rig.check().wrong == 0
    assert reset(rig)["reset_cause"] == ("external",)
