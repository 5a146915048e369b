# SPDX-License-Identifier: Apache-2.0
"""A board's clock on the host's, against known clocks."""

import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.link.clock import BoardClock, scan_times_s
from ohmskin.link.messages import Scan

HZ = 90.0
START_S = 5000.0  # of the board's clock, on the host's


def mapped(board_s: Float, arrival_s: Float) -> tuple[Float, BoardClock]:
    """What a clock says of each time when it has just been added."""
    clock = BoardClock()
    found_s = []
    for at_s, known_s in zip(board_s, arrival_s, strict=True):
        clock.add(1e6 * at_s, known_s)
        found_s.append(clock.host_s(1e6 * at_s))
    return np.array(found_s), clock


def usb_latency_timer(random: np.random.Generator, true_s: Float) -> Float:
    """A bridge hands over what it has every 16 ms; the host is a little late at times."""
    return np.ceil(true_s / 16e-3) * 16e-3 + random.exponential(0.5e-3, true_s.size)


def jitter(random: np.random.Generator, true_s: Float) -> Float:
    return true_s + random.exponential(5e-3, true_s.size)


def bursts(random: np.random.Generator, true_s: Float) -> Float:
    """Every second the host is busy for up to 300 ms, then takes all that has waited."""
    busy_s = 0.3 * random.random(int(true_s[-1]) + 2)
    until_s = np.floor(true_s) + busy_s[true_s.astype(int) - int(true_s[0])]
    return np.maximum(true_s, until_s) + random.exponential(0.3e-3, true_s.size)


def in_order(arrival_s: Float) -> Float:
    return np.maximum.accumulate(arrival_s)


@pytest.mark.parametrize("rate_error", [0.0, 100e-6, -100e-6, 5e-3, -5e-3])
@pytest.mark.parametrize("delays", [usb_latency_timer, jitter, bursts])
def test_delays_and_drift_leave_less_than_a_millisecond(delays, rate_error) -> None:  # type: ignore[no-untyped-def]
    random = np.random.default_rng(3)
    board_s = np.arange(60 * HZ) / HZ
    true_s = START_S + (1 + rate_error) * board_s
    arrival_s = in_order(delays(random, true_s))
    found_s, _ = mapped(board_s, arrival_s)
    settled = board_s > 5
    error_s = (found_s - true_s)[settled]
    late_s = (arrival_s - true_s)[settled]
    print(
        f"{delays.__name__}, {1e6 * rate_error:+.0f} ppm: "
        f"median {1e3 * np.median(error_s):.3f} ms, largest {1e3 * np.abs(error_s).max():.2f} ms, "
        f"of arrivals {1e3 * np.median(late_s):.1f} ms"
    )
    assert abs(np.median(error_s)) < 0.5e-3
    assert np.abs(error_s).max() < 2e-3
    assert np.diff(found_s).min() > 0
    assert np.abs(np.diff(found_s) - 1 / HZ).max() < 1e-3


def test_a_resonator_that_warms_is_followed() -> None:
    random = np.random.default_rng(4)
    board_s = np.arange(120 * HZ) / HZ
    true_s = START_S + board_s + 0.5 * 5e-6 * board_s**2  # 5 ppm a second
    found_s, _ = mapped(board_s, in_order(jitter(random, true_s)))
    error_s = (found_s - true_s)[board_s > 5]
    assert abs(np.median(error_s)) < 1e-3
    assert np.abs(error_s).max() < 3e-3


def test_the_first_scan_has_a_time_and_no_later_one_goes_back() -> None:
    clock = BoardClock()
    with pytest.raises(ValueError, match="no scan has been added"):
        clock.host_s(0)
    board_s = np.arange(3 * HZ) / HZ
    true_s = START_S + board_s
    arrival_s = true_s.copy()
    arrival_s[:60] = np.maximum(true_s[:60], true_s[59])  # the first 0.7 s came at once
    found_s, clock = mapped(board_s, arrival_s)
    assert found_s[0] == arrival_s[0]
    assert np.diff(found_s).min() >= 0
    assert np.abs(found_s - true_s)[-1] < 5e-3


@pytest.mark.parametrize("pause_s", [0.5, 100.0])
def test_a_board_that_restarts_begins_anew(pause_s: float) -> None:
    random = np.random.default_rng(5)
    run_s = np.arange(20 * HZ) / HZ
    board_s = np.concatenate([run_s + 50, run_s])
    true_s = START_S + 1.001 * np.concatenate([run_s, run_s + run_s[-1] + pause_s])
    found_s, _ = mapped(board_s, in_order(jitter(random, true_s)))
    error_s = found_s - true_s
    assert np.abs(error_s[run_s.size :]).max() < 20e-3
    assert np.abs(error_s[run_s.size + 180 :]).max() < 2e-3
    assert np.diff(found_s).min() > 0


def young_board(last_s: float) -> tuple[Float, Float]:
    """Times of the board's clock, and of the host's: it is reset at 3 s, and scans from 8 s on."""
    run_s = np.arange(0, last_s, 1 / HZ)
    before_s, after_s = run_s[run_s < 3], run_s[run_s >= 8]
    true_s = np.concatenate([before_s, after_s + 4])
    return np.concatenate([before_s, after_s]), START_S + true_s


def test_a_young_board_that_restarts_begins_anew() -> None:
    """Its clock does not go back: at its first scan it is older than it was at its last."""
    board_s, true_s = young_board(40.0)
    found_s, _ = mapped(board_s, in_order(jitter(np.random.default_rng(8), true_s)))
    error_s = np.abs(found_s - true_s)
    assert error_s[board_s < 10].max() < 20e-3
    assert error_s[board_s > 10].max() < 2e-3


@pytest.mark.parametrize(("hz", "busy_s"), [(HZ, 5.0), (1.0, 3.5)])
def test_a_host_that_was_busy_for_seconds_does_not_confuse(hz: float, busy_s: float) -> None:
    board_s = np.arange(0, 60, 1 / hz)
    true_s = START_S + board_s
    from_s = START_S + 30.5
    is_late = (true_s > from_s) & (true_s < from_s + busy_s)
    found_s, _ = mapped(board_s, np.where(is_late, from_s + busy_s, true_s))
    np.testing.assert_allclose(found_s, true_s, atol=1e-6)


def test_a_clock_that_steps_is_followed() -> None:
    """The host was asleep, and its clock stood still."""
    random = np.random.default_rng(6)
    board_s = np.arange(40 * HZ) / HZ
    true_s = START_S + board_s + np.where(board_s > 20, -0.3, 0.0)
    found_s, _ = mapped(board_s, true_s + random.exponential(1e-3, board_s.size))
    assert np.abs(found_s - true_s)[board_s > 25].max() < 2e-3


def test_a_pause_of_the_scans_does_not_confuse() -> None:
    random = np.random.default_rng(7)
    board_s = np.concatenate([np.arange(0, 20, 1 / HZ), np.arange(600, 620, 1 / HZ)])
    true_s = START_S + 1.0001 * board_s
    found_s, _ = mapped(board_s, in_order(jitter(random, true_s)))
    assert np.abs(found_s - true_s)[board_s > 601].max() < 2e-3


def scans_at(board_s: Float, host_s: Float) -> list[Scan]:
    codes: NDArray[np.uint16] = np.zeros((1, 1, 4), dtype=np.uint16)
    return [
        Scan(codes, number, round(1e6 * board), host, 0)
        for number, (board, host) in enumerate(zip(board_s, host_s, strict=True))
    ]


@pytest.mark.parametrize("seconds", [10, 100])
def test_scan_times_are_free_of_the_jitter_of_their_arrival(seconds: int) -> None:
    random = np.random.default_rng(1)
    board_s = np.arange(seconds * HZ) / HZ
    true_s = 77.0 + 1.0002 * board_s  # a crystal that is 200 ppm off
    late_s = random.exponential(5e-3, board_s.size)
    off_s = scan_times_s(scans_at(board_s, true_s + late_s)) - true_s
    assert np.abs(off_s).max() < 0.5e-3
    assert late_s.max() > 20e-3


def test_scan_times_follow_a_board_that_restarts() -> None:
    board_s = np.concatenate([np.arange(50), np.arange(50)]) / HZ
    host_s = np.concatenate([np.arange(50), 200 + np.arange(50)]) / HZ + 9.0
    np.testing.assert_allclose(scan_times_s(scans_at(board_s, host_s)), host_s, atol=1e-6)


def test_scan_times_follow_a_young_board_that_restarts() -> None:
    board_s, host_s = young_board(60.0)
    np.testing.assert_allclose(scan_times_s(scans_at(board_s, host_s)), host_s, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_few_scans_have_the_times_of_their_arrival(count: int) -> None:
    board_s = np.arange(count) / HZ
    np.testing.assert_allclose(scan_times_s(scans_at(board_s, board_s + 9)), board_s + 9)


def test_scan_times_bridge_a_pause() -> None:
    board_s = np.concatenate([np.arange(0, 20, 1 / HZ), np.arange(600, 620, 1 / HZ)])
    host_s = 9.0 + 1.0001 * board_s
    np.testing.assert_allclose(scan_times_s(scans_at(board_s, host_s)), host_s, atol=2e-6)


@pytest.mark.parametrize("jump_s", [1e6, 1e9, 4.6e12])
def test_scan_times_of_a_clock_that_jumps(jump_s: float) -> None:
    """A recording may say any time: a knot every 15 s of it would take 2 TiB."""
    host_s = np.arange(400) / HZ
    board_s = host_s + jump_s * (np.arange(400) // 100)
    tracemalloc.start()
    times_s = scan_times_s(scans_at(board_s, host_s))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Of a large time, a double keeps fewer digits.
    np.testing.assert_allclose(times_s, host_s, atol=2e-6 + 4 * np.spacing(3 * jump_s))
    assert most < 1_000_000
