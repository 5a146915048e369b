# SPDX-License-Identifier: Apache-2.0
"""The HEX files that boards are flashed with, in avr8js: what simavr says, a second time."""

from collections.abc import Iterator

import numpy as np
import pytest
import test_firmware_commands as commands
import test_firmware_regions as regions
import test_firmware_scan as scans
import test_firmware_self_test as self_test
import test_firmware_settings as settings

from firmware_helpers import CYCLES_PER_US, assert_whole, go_fast
from lockstep import BOARDS, TABLE_SHAPE, Rig, elf_of, first_holds
from ohmskin.circuit.skin import Skin, all_readings, end_admittance
from ohmskin.link.codes import quantise
from second_simulator import SecondSim

pytestmark = [pytest.mark.second_sim, pytest.mark.simavr]  # simavr for the built firmware

saved = settings.saved
test_boot_hello = commands.test_boot_hello
test_golden_commands = commands.test_golden_commands_are_acknowledged
test_golden_damaged_frames = commands.test_golden_damaged_frames_are_not_answered
test_bad_commands = commands.test_bad_commands_are_refused_by_name_and_change_nothing
test_commands_at_the_highest_rate = scans.test_commands_back_to_back_at_the_highest_rate
test_saved_settings = settings.test_saved_settings_survive_a_reset
test_save_while_scanning = settings.test_save_while_scanning_loses_no_scan
test_self_test = self_test.test_self_test_of_a_sound_board
test_self_test_of_far_nodes = self_test.test_self_test_judges_far_nodes
test_regions = regions.test_regions_that_change_while_scanning_are_read_as_their_scans_say
test_whole_scans_between = regions.test_whole_scans_come_in_between
test_watchdog = scans.test_watchdog_restarts_a_hung_main_loop


@pytest.fixture(params=BOARDS)
def rig(request: pytest.FixtureRequest, rng: np.random.Generator) -> Iterator[Rig]:
    with Rig(request.param, SecondSim(request.param)) as rig:
        rig.run(rig.sim.boot_s)
        rig.randomize(rng)
        yield rig


def test_a_nano_gets_what_an_uno_gets() -> None:
    uno, nano = (elf_of(each).with_suffix(".hex").read_bytes() for each in ("uno", "nano"))
    assert uno == nano


@pytest.mark.parametrize(
    ("mode", "rate_mhz"), [("near", 90_000), ("near", 120_000), ("near", 0), ("far", 90_000)]
)
def test_codes_times_and_settling(
    rig: Rig, rng: np.random.Generator, mode: str, rate_mhz: int
) -> None:
    """Circuits that change; their references differ, so no two configurations read alike."""
    go_fast(rig)
    rig.start_scan(rate_mhz=rate_mhz, mode=mode)
    hello = rig.hello()
    for _ in range(5):
        cells, wires_ohm = 10 ** rng.uniform(-6, -3, (8, 8)), rng.uniform(0, 300, (2, 8, 8))
        codes = np.zeros(TABLE_SHAPE, np.uint16)
        skin = Skin(cells, *wires_ohm, ref_top_ohm=20e3)
        codes[:8, :8] = quantise(all_readings(skin, end_admittance(skin)))
        rig.set_codes(codes, rng)
        rig.run_cycles(int(rng.integers(300_000, 700_000)))
    rig.must("stop")
    assert_whole(rig)
    check, holds = rig.check(), rig.holds()
    assert check.readings > 2000
    np.testing.assert_array_equal(np.diff(check.start_cycles), hello["scan_cycles"])
    second_scan = first_holds(holds, mode)[1]
    settled = holds["settle_cycles"][second_scan:-1]  # `stop` may come before the last
    assert settled.min() >= hello["settle_us"] * CYCLES_PER_US
    assert rig.sim.stats()["ignored_triggers"] == 0
