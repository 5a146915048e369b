# SPDX-License-Identifier: Apache-2.0
"""Alignment of two clocks: known offsets of simulated sessions, found again or refused.

The simulation shares nothing with the alignment but time: presses are drawn by their ramps, each
cell's conductance is a power of the force, with play and creep, and both sensors have noise.
"""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ohmskin.calibrate.alignment import MAX_SPAN_S, Alignment, align, correlations
from ohmskin.calibrate.tables import ForceLog

FINE_S = 1e-3
OFFSET_S = 1.7e9 + 0.123456  # one clock since boot, the other since 1970


@dataclass(frozen=True)
class Session:
    """What scans and sensor saw; the truth: log time + offset_s = scan time."""

    scan_time_s: np.ndarray
    rise: np.ndarray
    log: ForceLog
    offset_s: float

    def aligned(self) -> Alignment:
        return align(self.scan_time_s, self.rise, self.log)


def presses(random: np.random.Generator, seconds: float, *, evenly: bool) -> np.ndarray:
    """Forces [N] and pressed cells of 16, (2, n), every FINE_S."""
    force_n, cell = np.zeros((2, round(seconds / FINE_S)))
    start_s = 2.0
    while True:
        low, high = ([0.08, 0.3, 0.05, 0.4, 1.0], [0.6, 3.0, 0.5, 2.0, 20.0])
        on, hold, off, pause, peak = random.uniform(low, high)
        if evenly:
            on, hold, off, pause, peak = 0.2, 1.0, 0.2, 0.6, 10.0
        if start_s + on + hold + off + 2.0 > seconds:
            return np.stack([force_n, cell])
        steps = np.arange(0.0, on + hold + off, FINE_S)
        corners = [0.0, on, on + hold, on + hold + off]
        shape = np.sin(np.pi / 2 * np.interp(steps, corners, [0.0, 1.0, 1.0, 0.0])) ** 2
        first = round(start_s / FINE_S)
        wobble = 1 + 0.1 * np.sin(random.uniform(2, 9) * steps)
        force_n[first : first + steps.size] = peak * shape * wobble
        cell[first : first + round((on + hold + off + pause) / FINE_S)] = random.integers(16)
        start_s += on + hold + off + pause


def with_play(force_n: np.ndarray, play_n: float) -> np.ndarray:
    """What follows only once the force is `play_n` ahead of it: hysteresis."""
    followed = np.empty_like(force_n)
    at = 0.0
    for step, force in enumerate(force_n.tolist()):
        at = min(max(at, force - play_n), force + play_n)
        followed[step] = at
    return np.maximum(followed, 0.0)


def session(
    seed: int,
    seconds: float = 60.0,
    *,
    log_hz: float = 80.0,
    creep: float = 0.15,
    play: float = 0.1,
    noise: float = 0.01,
    faster_ppm: float = 0.0,
    evenly: bool = False,
) -> Session:
    """creep: share that comes with a delay of 2 s. play: share of the force. noise: of a press."""
    random = np.random.default_rng(seed)
    force_n, cells = presses(random, seconds, evenly=evenly)
    cell = cells.astype(int)
    time_s = FINE_S * np.arange(force_n.size)
    exponent = random.uniform(0.6, 2.0, 16)
    gain = 2e-5 * np.exp(0.5 * random.standard_normal(16))
    felt_n = (1 - play) * force_n + play * (with_play(force_n, 2.0) if play else 0.0)
    rise = gain[cell] * (felt_n / 10) ** exponent[cell]
    share = FINE_S / 2.0
    rise = rise + creep * lfilter([share], [1, share - 1], rise)
    scan_s = np.arange(random.uniform(0, 0.01), seconds - 0.02, 1 / 90)
    scan_s = scan_s[random.random(scan_s.size) > 0.03]  # some are missed
    noise_s = noise * np.percentile(rise[rise > 0], 90)
    log_s = np.cumsum(random.normal(1 / log_hz, 0.02 / log_hz, int(log_hz * seconds)))
    sensed_n = np.interp(log_s, time_s, force_n) + 3 * noise * random.standard_normal(log_s.size)
    # By a clock that is faster and right in the middle of the session.
    log_s = seconds / 2 + (log_s - seconds / 2) * (1 + 1e-6 * faster_ppm)
    return Session(
        scan_s + OFFSET_S,
        np.interp(scan_s, time_s, rise) + noise_s * random.standard_normal(scan_s.size),
        ForceLog(log_s + 77.0, np.maximum(sensed_n, -0.04)),
        OFFSET_S - 77.0,
    )


def errors_ms(sessions: list[Session]) -> np.ndarray:
    return np.array([1e3 * (each.aligned().offset_s - each.offset_s) for each in sessions])


@pytest.mark.parametrize(
    ("name", "arguments", "largest_ms", "rms_ms"),
    [
        ("elastic cells, 80 Hz log", {"creep": 0.0, "play": 0.0}, 5.0, 2.5),
        ("creep and hysteresis, 80 Hz log", {}, 10.0, 5.0),
        ("5 % noise", {"noise": 0.05}, 12.0, 6.0),
        ("10 Hz log", {"log_hz": 10.0}, 15.0, 7.0),
        ("creep of 40 %, hysteresis of 25 %", {"creep": 0.4, "play": 0.25}, 20.0, 11.0),
        ("20 s", {"seconds": 20.0}, 20.0, 9.0),
    ],
)
def test_known_offsets_are_found(
    name: str, arguments: dict[str, float], largest_ms: float, rms_ms: float
) -> None:
    errors = errors_ms([session(seed, **arguments) for seed in range(12)])
    rms = float(np.sqrt(np.mean(errors**2)))
    print(
        f"{name}: error {np.median(errors):+.1f} ms, rms {rms:.1f}, max {np.abs(errors).max():.1f}"
    )
    assert np.abs(errors).max() < largest_ms
    assert rms < rms_ms


def test_clocks_of_different_rate_are_aligned_on_average() -> None:
    for faster_ppm in (0.0, 100.0):
        error = errors_ms([session(1, 600.0, faster_ppm=faster_ppm)])[0]
        print(f"10 minutes, {faster_ppm:g} ppm: error {error:+.1f} ms in the middle")
        assert abs(error) < 8.0  # at the ends of 100 ppm 30 ms more


def test_the_log_of_a_part_is_enough() -> None:
    whole = session(3)
    part = slice(1600, 3200)
    found = replace(whole, log=ForceLog(whole.log.time_s[part], whole.log.force_n[part])).aligned()
    assert abs(found.offset_s - whole.offset_s) < 0.02
    assert found.overlap_s == pytest.approx(20.0, abs=0.2)
    assert found.correlation > 0.8


def test_correlations_are_those_of_numpy_at_every_lag() -> None:
    random = np.random.default_rng(1)
    x, y = random.standard_normal(40).cumsum(), 5 + random.standard_normal(23).cumsum()
    in_x, in_y = random.random(40) < 0.8, random.random(23) < 0.8
    y[:6] = y[0]  # nothing varies where only these overlap
    r, shared = correlations(x, in_x, y, in_y)
    assert r.size == shared.size == 62
    for index, lag in enumerate(range(-22, 40)):
        first, last = max(0, lag), min(40, lag + 23)
        both = in_x[first:last] & in_y[first - lag : last - lag]
        one, other = x[first:last][both], y[first - lag : last - lag][both]
        assert shared[index] == both.sum()
        varies = one.size > 1 and np.ptp(one) > 0 and np.ptp(other) > 0
        assert r[index] == pytest.approx(np.corrcoef(one, other)[0, 1] if varies else 0, abs=1e-6)


def without(time_s: np.ndarray, gaps: list[tuple[float, float]]) -> np.ndarray:
    since = time_s - time_s[0]
    return ~np.any([(since > first) & (since < last) for first, last in gaps], axis=0)


def test_gaps_are_left_out() -> None:
    whole = session(4)
    scans = without(whole.scan_time_s, [(5.0, 9.0), (30.2, 31.0)])
    samples = without(whole.log.time_s, [(15.0, 22.0), (40.0, 40.7), (50.0, 53.0)])
    # Forces in a gap that no press made: a line through it would show them.
    log = ForceLog(whole.log.time_s[samples], whole.log.force_n[samples])
    found = align(whole.scan_time_s[scans], whole.rise[scans], log)
    assert abs(found.offset_s - whole.offset_s) < 0.01
    assert found.overlap_s == pytest.approx(60 - 4.8 - 10.7, abs=0.5)
    assert found.correlation > 0.85


def test_large_presses_that_only_one_of_them_saw_do_not_win() -> None:
    """At the true offset both are outside the overlap; 36 s away they would match each other."""
    whole = session(5)
    boost = [
        1 + 5 * np.exp(-((time_s - time_s[0] - at_s) ** 2))
        for time_s, at_s in ((whole.scan_time_s, 48.0), (whole.log.time_s, 12.0))
    ]
    scans = whole.scan_time_s - OFFSET_S > 20
    samples = whole.log.time_s - 77 < 40
    force_n = whole.log.force_n * boost[1]
    found = align(
        whole.scan_time_s[scans],
        (whole.rise * boost[0])[scans],
        ForceLog(whole.log.time_s[samples], force_n[samples]),
    )
    assert abs(found.offset_s - whole.offset_s) < 0.02
    assert found.overlap_s == pytest.approx(20, abs=0.2)


def test_glitches_of_the_sensor_do_not_win() -> None:
    whole = session(5)
    force_n = whole.log.force_n.copy()
    force_n[np.random.default_rng(2).integers(0, force_n.size, 20)] = 1e4
    found = replace(whole, log=ForceLog(whole.log.time_s, force_n)).aligned()
    assert abs(found.offset_s - whole.offset_s) < 0.01


def test_neither_units_nor_a_drifting_rest_matter() -> None:
    one = session(6)
    drift = 0.3 * one.rise.max() * (1 - np.exp(-(one.scan_time_s - one.scan_time_s[0]) / 30))
    base = one.aligned()
    scaled = replace(one, rise=1e6 * one.rise).aligned()
    assert scaled.offset_s == pytest.approx(base.offset_s, abs=1e-6)
    drifting = replace(one, rise=one.rise + drift).aligned()
    assert abs(drifting.offset_s - one.offset_s) < 0.01


@pytest.mark.parametrize("seconds", [60.0, 200.0])
def test_even_presses_without_a_beginning_are_refused(seconds: float) -> None:
    even = session(7, seconds, evenly=True)
    inner = slice(700, -900)
    even = replace(even, scan_time_s=even.scan_time_s[inner], rise=even.rise[inner])
    with pytest.raises(ValueError, match=r"an offset \d+\.\d\d s away fits nearly as well.*even"):
        even.aligned()


def test_one_irregular_press_makes_even_ones_tell_the_time() -> None:
    """By forces that differ, too: see what the message advises."""
    even = session(8, evenly=True)
    random = np.random.default_rng(1)
    since_s = even.scan_time_s - even.scan_time_s[0]
    number = (since_s / 2.0).astype(int)
    weight = random.uniform(0.05, 1.0, number.max() + 2)
    log_number = ((even.log.time_s - even.log.time_s[0]) / 2.0).astype(int)
    varied = Session(
        even.scan_time_s,
        even.rise * weight[number],
        ForceLog(even.log.time_s, even.log.force_n * weight[log_number]),
        even.offset_s,
    )
    assert abs(varied.aligned().offset_s - varied.offset_s) < 0.02


def test_sessions_that_have_nothing_in_common_are_refused() -> None:
    sessions = [session(seed, creep=0.0, play=0.0) for seed in range(20, 26)]
    messages = set()
    for scans in sessions:
        for other in sessions:
            if other is not scans:
                with pytest.raises(ValueError, match=r"fits nearly|fit at no offset") as caught:
                    replace(scans, log=other.log).aligned()
                messages.add(re.sub(r"[\d.]+", "#", str(caught.value)))
    assert any("their best correlation is #" in message for message in messages)


TIME_S = np.arange(0.0, 30.0, 0.02)
FORCE_N = 5.0 * (np.sin(TIME_S**1.5) > 0)
LOG = ForceLog(TIME_S, FORCE_N)


@pytest.mark.parametrize(
    ("time_s", "rise", "log", "words"),
    [
        (TIME_S[:1], FORCE_N[:1], LOG, "the skin's rise lasts 0 s, 15 s are needed: record longer"),
        (TIME_S, np.where(TIME_S == 0.02, np.nan, 1.0), LOG, "scan 1: its rise is not finite"),
        (
            np.where(TIME_S == 0.04, 0.02, TIME_S),
            FORCE_N,
            LOG,
            "scan 2: its rise is not finite, or",
        ),
        (TIME_S, np.full(1500, 1e-6), LOG, "the skin's rise does not rise: nothing was pressed"),
        (TIME_S, -FORCE_N, LOG, "the skin's rise does not rise: nothing was pressed"),
        (TIME_S, np.eye(1500)[700], LOG, "the skin's rise rises during less than 1 % of the time"),
        (TIME_S / 100, FORCE_N, LOG, "the skin's rise lasts 0.3 s, 15 s are needed"),
        (TIME_S, FORCE_N, ForceLog(TIME_S / 4, FORCE_N), "the force lasts 7.5 s, 15 s are"),
        (TIME_S * MAX_SPAN_S / 20, FORCE_N, LOG, "the skin's rise lasts 9.0 h, more than 6"),
        (TIME_S, FORCE_N, ForceLog(1000 * TIME_S, FORCE_N), "are its times in seconds?"),
        (
            np.where(TIME_S < 4, TIME_S, TIME_S + 100),
            np.where(TIME_S < 7, FORCE_N, 0.0),
            ForceLog(np.where(TIME_S < 4, TIME_S, TIME_S + 50 * np.floor(TIME_S)), FORCE_N),
            "scans and force log overlap at no offset for 15 s, and for half of the shorter",
        ),
    ],
)
def test_what_cannot_be_aligned_is_refused(
    time_s: np.ndarray, rise: np.ndarray, log: ForceLog, words: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        align(time_s, rise, log)
    assert "\n" not in str(caught.value)
