# SPDX-License-Identifier: Apache-2.0
"""The constant delays of a line, found by commands: against delays that are made."""

import itertools

import numpy as np
import pytest

from lockstep import CPU_HZ, first_holds
from lockstep_skin import BOOT_S, LockstepLink, lockstep_skin
from ohmskin.emulate.scenes import Scene
from ohmskin.link.clock import BoardClock, scan_s

OUT_S, IN_S = 0.5e-3, 4e-3  # constant delays to the board and from it
HZ = 90.0


@pytest.mark.parametrize("rate_error", [0.0, 3e-3, -3e-3])
@pytest.mark.parametrize("begins_us", [0, 2**32 - 5e6])
def test_commands_among_scans_show_both_delays(rate_error: float, begins_us: float) -> None:
    """The counter of the board wraps in its answers, and not in its scans."""
    random, clock = np.random.default_rng(2), BoardClock()
    for number in range(30 * int(HZ)):
        board_us = begins_us + 1e6 * number / HZ
        true_s = 70 + (1 + rate_error) * number / HZ
        clock.add(board_us, true_s + IN_S + random.exponential(2e-3))
        if number % 45 == 10:
            sent_s = true_s - 3e-3
            read_us = board_us - 1e6 * (3e-3 - OUT_S - random.exponential(1e-3))
            clock.answered(read_us % 2**32, sent_s, true_s + 20e-3)
        if number > 10 * HZ:
            assert clock.delay_s == pytest.approx(OUT_S + IN_S, abs=0.3e-3)


def test_answers_of_a_board_that_is_still_show_both_delays() -> None:
    clock = BoardClock()
    assert clock.delay_s == 0
    for late_s in (3e-3, 0.0, 1e-3):
        clock.answered(1e6, 5.0, 5.0 + OUT_S + IN_S + late_s)
    assert clock.delay_s == pytest.approx(OUT_S + IN_S)


def test_delays_stay_known_when_a_board_restarts() -> None:
    clock = BoardClock()
    clock.add(90e6, 100.0 + IN_S)
    clock.answered(90e6, 100.0 - OUT_S, 100.0 + IN_S)
    for number in range(200):
        clock.add(1e6 * number / HZ, 200.0 + number / HZ + IN_S)
    clock.answered(50e6, 201.0, 201.0 + 1)  # a number of before
    assert clock.delay_s == pytest.approx(OUT_S + IN_S)


@pytest.mark.simavr
def test_half_of_the_delays_is_taken_off_the_times_of_scans(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Against the cycles at which the simulated board held its readings."""
    monkeypatch.setattr("ohmskin.link.session.time.time_ns", lambda: 0)
    rest = Scene().rest
    link = LockstepLink(lambda _: rest, delay_s=IN_S)
    with lockstep_skin(link) as skin:
        link.sim.hold_log(True)
        scans = list(itertools.islice(skin, 200))
        holds = link.sim.drain_hold_log()
        first = holds["cycle"][first_holds(holds)][[scan.number for scan in scans]]
        middle_s = first / CPU_HZ - BOOT_S + scan_s(skin.info, scans[0]) / 2
    for scan in scans:
        assert scan.delay_s == pytest.approx(IN_S, abs=0.3e-3)
    late_s = 1e-9 * np.array([scan.time_ns for scan in scans]) - middle_s
    # The line's own time is known to 0.5 ms (tests/link/test_timing.py).
    assert np.abs(late_s[50:] - IN_S / 2).max() < 0.6e-3
