# SPDX-License-Identifier: Apache-2.0
"""The guide, in simulated scans: what counts as a press, and what is said of what does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ohmskin.calibrate.guide import CERTAIN_S, Ask, Event, Guide, State, Steady, still_asked

RATE_HZ = 50.0
FIRST, SECOND = Ask(0, 1, 1.0), Ask(1, 0, 2.0)
AT_FIRST, AT_SECOND = (0, 1), (1, 0)
# Rise of a cell [S] as a function of the time since it was touched [s].
Course = Callable[[float], float]


class Bench:
    """A 2x2 skin with its own clock; `put` is what a person does for some time."""

    def __init__(self, *asked: Ask, rate_hz: float = RATE_HZ, noise: float = 0.002) -> None:
        self.guide = Guide(asked)
        self.now_s = 100.0
        self.rate_hz = rate_hz
        self.noise = noise
        self.random = np.random.default_rng(1)

    def put(self, seconds: float, **rises: Course | float) -> list[Event]:
        """Events of so many seconds; rises: by name "c01", of cell (0, 1)."""
        events = []
        for scan in range(round(seconds * self.rate_hz)):
            rise = np.full((2, 2), 1e-9)
            touched = np.zeros((2, 2), dtype=np.bool_)
            for name, course in rises.items():
                cell = int(name[1]), int(name[2])
                value = course(scan / self.rate_hz) if callable(course) else course
                rise[cell] = value * (1 + self.noise * self.random.standard_normal())
                touched[cell] = True
            events.append(self.guide.feed(self.now_s, rise, touched))
            self.now_s += 1 / self.rate_hz
        return events


def had(events: list[Event]) -> list[Steady]:
    return [event.had for event in events if event.had is not None]


def seconds_until_had(events: list[Event]) -> float:
    return next(i for i, event in enumerate(events) if event.had is not None) / RATE_HZ


def test_a_steady_press_is_had_once_and_the_next_is_asked() -> None:
    bench = Bench(FIRST, SECOND)
    assert {event.state for event in bench.put(1)} == {State.PUT}
    events = bench.put(5, c01=40e-6)
    (press,) = had(events)
    assert press.ask == FIRST
    assert press.rise == pytest.approx(40e-6, rel=0.002)
    assert press.rise_std == pytest.approx(0.002 * 40e-6 / np.sqrt(RATE_HZ), rel=0.4)
    assert 1.0 <= seconds_until_had(events) < 1.5
    assert events[-1].state is State.TAKE_OFF
    off = bench.put(1)
    assert off[-1] == Event(State.PUT, SECOND)
    assert had(bench.put(2, c10=80e-6))[0].ask == SECOND
    assert bench.put(1)[-1].state is State.DONE
    assert had(bench.put(2, c10=80e-6)) == []


@pytest.mark.parametrize(
    ("course", "most_s"),
    [
        # `PressModel`: 9 % of the force relaxes with 0.6 s, the exponent is 1.7.
        (lambda t: 40e-6 * (1 - 0.15 * np.exp(-t / 0.6)), 2.0),
        # 10, and 30 % a decade of time, without end.
        (lambda t: 40e-6 * (1 + 0.1 * np.log10(t + 0.01)), 2.0),
        (lambda t: 40e-6 * (1 + 0.3 * np.log10(t + 0.01)), 4.0),
    ],
)
def test_a_creeping_press_is_had_within_seconds(course: Course, most_s: float) -> None:
    events = Bench(FIRST).put(6, c01=course)
    assert seconds_until_had(events) < most_s
    assert had(events)[0].rise == pytest.approx(course(most_s), rel=0.1)


@pytest.mark.parametrize("frequency_hz", [0.5, 0.7, 1.0, 2.0, 4.0])
def test_a_wiggling_finger_is_not_a_press(frequency_hz: float) -> None:
    for rate_hz in (20.0, 90.0):
        bench = Bench(FIRST, rate_hz=rate_hz)
        events = bench.put(
            12, c01=lambda t: 40e-6 * (1 + 0.4 * np.sin(2 * np.pi * frequency_hz * t))
        )
        assert had(events) == []
        assert events[-1].state is State.HOLD


def test_a_load_that_grows_is_not_a_press_until_it_stays() -> None:
    bench = Bench(FIRST)
    assert had(bench.put(5, c01=lambda t: 4e-6 * (1 + t))) == []
    assert had(bench.put(3, c01=24e-6))[0].rise == pytest.approx(24e-6, rel=0.03)


def test_noise_of_single_scans_is_no_wiggle() -> None:
    # As of cells that conduct so much that the converter's steps are large.
    for rate_hz in (10.0, 90.0):
        bench = Bench(FIRST, rate_hz=rate_hz, noise=0.15)
        (press,) = had(bench.put(6, c01=4e-3))
        assert press.rise == pytest.approx(4e-3, abs=4 * press.rise_std)


def test_a_press_is_left_out_if_it_lasts_less_than_a_second() -> None:
    bench = Bench(FIRST)
    for _ in range(5):
        assert had(bench.put(CERTAIN_S + 0.8, c01=40e-6)) == []
        bench.put(0.5)


def test_a_flicker_does_not_interrupt_a_press() -> None:
    bench = Bench(FIRST)
    events = bench.put(0.8, c01=40e-6) + bench.put(0.1) + bench.put(0.5, c01=40e-6)
    assert had(events)[0].rise == pytest.approx(40e-6, rel=0.002)


def test_another_cell_is_named_until_it_is_the_right_one() -> None:
    bench = Bench(FIRST, SECOND)
    events = bench.put(3, c10=40e-6)
    assert events[-1] == Event(State.WRONG, FIRST, (AT_SECOND,))
    assert had(events) == []
    # At first it might only brush past.
    assert events[0].state is State.PUT
    assert bench.put(1)[-1].state is State.PUT
    assert len(had(bench.put(2, c01=40e-6))) == 1


def test_two_cells_are_named() -> None:
    bench = Bench(FIRST)
    events = bench.put(3, c01=40e-6, c10=15e-6)
    assert events[-1] == Event(State.WRONG, FIRST, (AT_FIRST, AT_SECOND))
    assert had(events) == []
    # A quarter of it and less is what a neighbour shows.
    assert len(had(bench.put(3, c01=40e-6, c10=8e-6))) == 1


def test_a_second_cell_in_between_begins_the_second_anew() -> None:
    bench = Bench(FIRST)
    assert had(bench.put(1.0, c01=40e-6)) == []
    assert bench.put(0.5, c01=40e-6, c10=40e-6)[-1].state is State.WRONG
    assert had(bench.put(1.2, c01=40e-6)) == []
    assert len(had(bench.put(0.5, c01=40e-6))) == 1


def test_a_weight_that_stays_is_asked_off() -> None:
    again = Ask(0, 1, 1.0)
    bench = Bench(FIRST, again)
    bench.put(2, c01=40e-6)
    events = bench.put(20, c01=40e-6)
    assert {event.state for event in events} == {State.TAKE_OFF}
    assert had(events) == []
    # Lifted for less than is certain.
    assert bench.put(0.1)[-1].state is State.TAKE_OFF
    assert bench.put(1, c10=40e-6)[-1].state is State.TAKE_OFF
    assert bench.put(1)[-1].state is State.PUT
    assert len(had(bench.put(2, c01=40e-6))) == 1


def test_a_board_that_was_reset_begins_the_second_anew() -> None:
    bench = Bench(FIRST)
    bench.put(1.0, c01=40e-6)
    bench.now_s = 0.0
    assert had(bench.put(0.9, c01=40e-6)) == []
    assert len(had(bench.put(0.5, c01=40e-6))) == 1


def test_slow_scans_take_longer_not_fewer() -> None:
    bench = Bench(FIRST, rate_hz=4.0)
    events = bench.put(6, c01=40e-6)
    first = next(i for i, event in enumerate(events) if event.had is not None)
    assert first >= 8


def test_nothing_asked_is_done() -> None:
    assert Bench().put(1)[0].state is State.DONE


def test_what_is_had_is_not_asked_again() -> None:
    asked = [FIRST, SECOND, FIRST, SECOND]
    assert still_asked(asked, []) == asked
    # From a file, or another way to compute it.
    close = Ask(0, 1, 1.0 + 1e-12)
    assert still_asked(asked, [SECOND, close]) == [FIRST, SECOND]
    assert still_asked(asked, [FIRST] * 5) == [SECOND, SECOND]
    other = Ask(0, 1, 1.001)
    assert still_asked(asked, [other, Ask(1, 1, 1.0)]) == asked


def test_redone_cells_are_asked_again() -> None:
    asked = [FIRST, SECOND, FIRST]
    kept = [press for press in asked if (press.row, press.column) != AT_FIRST]
    assert still_asked(asked, kept) == [FIRST, FIRST]
