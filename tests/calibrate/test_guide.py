# SPDX-License-Identifier: Apache-2.0
"""The guide, in simulated scans: what counts as a press, and what is said of what does not."""

from collections.abc import Callable

import numpy as np
import pytest

from ohmskin.calibrate.guide import CERTAIN_S, Guide, Press, State, Step, still_wanted

RATE_HZ = 50.0
FIRST, SECOND = Press((0, 1), 1.0), Press((1, 0), 2.0)
AT_FIRST, AT_SECOND = (0, 1), (1, 0)
# Rise of a cell [S] as a function of the time since it was touched [s].
Course = Callable[[float], float]


class Scripted:
    """A 2x2 skin with its own clock; `put` is what a person does for some time."""

    def __init__(self, *wanted: Press, rate_hz: float = RATE_HZ, noise: float = 0.002) -> None:
        self.guide = Guide(wanted)
        self.now_s = 100.0
        self.rate_hz = rate_hz
        self.noise = noise
        self.random = np.random.default_rng(1)

    def put(self, seconds: float, **rises: Course | float) -> list[Step]:
        """Events of so many seconds; rises: by name "c01", of cell (0, 1)."""
        steps = []
        for scan in range(round(seconds * self.rate_hz)):
            rise = np.full((2, 2), 1e-9)
            touched = np.zeros((2, 2), dtype=np.bool_)
            for name, course in rises.items():
                cell = int(name[1]), int(name[2])
                value = course(scan / self.rate_hz) if callable(course) else course
                rise[cell] = value * (1 + self.noise * self.random.standard_normal())
                touched[cell] = True
            steps.append(self.guide.feed(self.now_s, rise, touched, scan))
            self.now_s += 1 / self.rate_hz
        return steps


def read(steps: list[Step]) -> list[Step]:
    """Those which complete a press."""
    return [step for step in steps if step.rise is not None]


def seconds_until_read(steps: list[Step]) -> float:
    return next(i for i, step in enumerate(steps) if step.rise is not None) / RATE_HZ


def test_a_steady_press_is_read_once_and_the_next_is_asked() -> None:
    person = Scripted(FIRST, SECOND)
    assert {step.state for step in person.put(1)} == {State.PUT}
    steps = person.put(5, c01=40e-6)
    (press,) = read(steps)
    assert press.wanted == FIRST
    assert press.rise == pytest.approx(40e-6, rel=0.002)
    assert press.rise_std == pytest.approx(0.002 * 40e-6 / np.sqrt(RATE_HZ), rel=0.4)
    assert 1.0 <= seconds_until_read(steps) < 1.5
    assert steps[-1].state is State.TAKE_OFF
    off = person.put(1)
    assert off[-1] == Step(State.PUT, SECOND)
    assert read(person.put(2, c10=80e-6))[0].wanted == SECOND
    assert person.put(1)[-1].state is State.DONE
    assert read(person.put(2, c10=80e-6)) == []


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
def test_a_creeping_press_is_read_within_seconds(course: Course, most_s: float) -> None:
    steps = Scripted(FIRST).put(6, c01=course)
    assert seconds_until_read(steps) < most_s
    assert read(steps)[0].rise == pytest.approx(course(most_s), rel=0.1)


@pytest.mark.parametrize("frequency_hz", [0.5, 0.7, 1.0, 2.0, 4.0])
def test_a_wiggling_finger_is_not_a_press(frequency_hz: float) -> None:
    for rate_hz in (20.0, 90.0):
        person = Scripted(FIRST, rate_hz=rate_hz)
        steps = person.put(
            12, c01=lambda t: 40e-6 * (1 + 0.4 * np.sin(2 * np.pi * frequency_hz * t))
        )
        assert read(steps) == []
        assert steps[-1].state is State.HOLD


def test_a_load_that_grows_is_not_a_press_until_it_stays() -> None:
    person = Scripted(FIRST)
    assert read(person.put(5, c01=lambda t: 4e-6 * (1 + t))) == []
    assert read(person.put(3, c01=24e-6))[0].rise == pytest.approx(24e-6, rel=0.03)


def test_noise_of_single_scans_is_no_wiggle() -> None:
    # As of cells that conduct so much that the converter's steps are large.
    for rate_hz in (10.0, 90.0):
        person = Scripted(FIRST, rate_hz=rate_hz, noise=0.15)
        (press,) = read(person.put(6, c01=4e-3))
        assert press.rise == pytest.approx(4e-3, abs=4 * press.rise_std)


def test_a_press_is_left_out_if_it_lasts_less_than_a_second() -> None:
    person = Scripted(FIRST)
    for _ in range(5):
        assert read(person.put(CERTAIN_S + 0.8, c01=40e-6)) == []
        person.put(0.5)


def test_a_flicker_does_not_interrupt_a_press() -> None:
    person = Scripted(FIRST)
    steps = person.put(0.8, c01=40e-6) + person.put(0.1) + person.put(0.5, c01=40e-6)
    assert read(steps)[0].rise == pytest.approx(40e-6, rel=0.002)


def test_another_cell_is_named_until_it_is_the_right_one() -> None:
    person = Scripted(FIRST, SECOND)
    steps = person.put(3, c10=40e-6)
    assert steps[-1] == Step(State.WRONG, FIRST, (AT_SECOND,))
    assert read(steps) == []
    # At first it might only brush past.
    assert steps[0].state is State.PUT
    assert person.put(1)[-1].state is State.PUT
    assert len(read(person.put(2, c01=40e-6))) == 1


def test_two_cells_are_named() -> None:
    person = Scripted(FIRST)
    steps = person.put(3, c01=40e-6, c10=15e-6)
    assert steps[-1] == Step(State.WRONG, FIRST, (AT_FIRST, AT_SECOND))
    assert read(steps) == []
    # A quarter of it and less is what a neighbour shows.
    assert len(read(person.put(3, c01=40e-6, c10=8e-6))) == 1


def test_a_second_cell_in_between_begins_the_second_anew() -> None:
    person = Scripted(FIRST)
    assert read(person.put(1.0, c01=40e-6)) == []
    assert person.put(0.5, c01=40e-6, c10=40e-6)[-1].state is State.WRONG
    assert read(person.put(1.2, c01=40e-6)) == []
    assert len(read(person.put(0.5, c01=40e-6))) == 1


def test_a_weight_that_stays_is_asked_off() -> None:
    again = Press((0, 1), 1.0)
    person = Scripted(FIRST, again)
    person.put(2, c01=40e-6)
    steps = person.put(20, c01=40e-6)
    assert {step.state for step in steps} == {State.TAKE_OFF}
    assert read(steps) == []
    # Lifted for less than is certain.
    assert person.put(0.1)[-1].state is State.TAKE_OFF
    assert person.put(1, c10=40e-6)[-1].state is State.TAKE_OFF
    assert person.put(1)[-1].state is State.PUT
    assert len(read(person.put(2, c01=40e-6))) == 1


def test_a_board_that_was_reset_begins_the_second_anew() -> None:
    person = Scripted(FIRST)
    person.put(1.0, c01=40e-6)
    person.now_s = 0.0
    assert read(person.put(0.9, c01=40e-6)) == []
    assert len(read(person.put(0.5, c01=40e-6))) == 1


def test_slow_scans_take_longer_not_fewer() -> None:
    person = Scripted(FIRST, rate_hz=4.0)
    assert seconds_until_read(person.put(6, c01=40e-6)) >= 8 / RATE_HZ


def test_nothing_asked_is_done() -> None:
    assert Scripted().put(1)[0].state is State.DONE


def test_what_is_read_is_not_asked_again() -> None:
    asked = [FIRST, SECOND, FIRST, SECOND]
    assert still_wanted(asked, []) == asked
    # From a file, or another way to compute it.
    close = Press((0, 1), 1.0 + 1e-12)
    assert still_wanted(asked, [SECOND, close]) == [FIRST, SECOND]
    assert still_wanted(asked, [FIRST] * 5) == [SECOND, SECOND]
    other = Press((0, 1), 1.001)
    assert still_wanted(asked, [other, Press((1, 1), 1.0)]) == asked


def test_redone_cells_are_asked_again() -> None:
    asked = [FIRST, SECOND, FIRST]
    kept = [press for press in asked if press.cell != AT_FIRST]
    assert still_wanted(asked, kept) == [FIRST, FIRST]
