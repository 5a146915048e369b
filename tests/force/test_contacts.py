# SPDX-License-Identifier: Apache-2.0
"""Contacts: what is one thing, where it is, and that it stays itself while it moves."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.force.contacts import MEMORY_US, Contact, ContactTracker, found

SCAN_US = 11_111


def of_one_scan(*arrays: NDArray[Any]) -> list[Contact]:
    """Contacts by which cells are touched, their forces and deviations, (R, C) each."""
    return found(*(array[None] for array in arrays))[0]


def seen(
    tracker: ContactTracker, scan: int, force_n: NDArray[np.float64], std_n: float = 0.1
) -> tuple[Contact, ...]:
    std = np.full(force_n.shape, std_n)
    return tracker.follow(scan * SCAN_US, of_one_scan(force_n > 0, force_n, std))


def skin(text: str) -> NDArray[np.float64]:
    """Forces [N] of cells, a digit each; rows on lines."""
    return np.array([[float(cell) for cell in line] for line in text.split()])


def finger(row: float, column: float) -> NDArray[np.float64]:
    rows, columns = np.indices((8, 8))
    force_n: NDArray[np.float64] = np.exp(-((rows - row) ** 2 + (columns - column) ** 2))
    return np.where(force_n > 0.1, force_n, 0.0)


def test_what_adjoins_is_one_contact() -> None:
    contacts = seen(ContactTracker(), 0, skin("1000 0300 0000 0022"))
    assert [contact.identity for contact in contacts] == [1, 2]
    first, second = contacts
    np.testing.assert_array_equal(first.cells, skin("1000 0100 0000 0000") > 0)
    assert (first.force_n, first.row, first.column) == (4.0, 0.75, 0.75)
    assert (second.force_n, second.row, second.column) == (4.0, 3.0, 2.5)


def test_cells_that_share_wires_may_err_alike() -> None:
    """Wires that are taken for too short lower the force of every cell behind them."""
    force_n, std_n = skin("1300 0020"), skin("1200 0040") / 10
    (contact,) = of_one_scan(force_n > 0, force_n, std_n)
    for sign in (1, -1):
        error_n = (force_n + sign * std_n)[force_n > 0].sum() - contact.force_n
        assert abs(error_n) == pytest.approx(contact.force_n_std)


@pytest.mark.parametrize(
    ("force_n", "std_n", "text"),
    [
        (1.234, 0.1, "1.23 +- 0.10 N"),
        (0.5, 0.5, "0.50 +- 0.50 N"),
        (0.5, 0.51, "uncertain"),
        (0.0, 0.0, "0.00 +- 0.00 N"),
        (1.234, float("nan"), "1.23 N"),
    ],
)
def test_a_force_is_written_with_its_deviation(force_n: float, std_n: float, text: str) -> None:
    (contact,) = of_one_scan(*(np.array([[each]]) for each in (True, force_n, std_n)))
    assert contact.force_text == text


def test_a_touch_without_force_has_a_centre() -> None:
    touched = np.array([[True, True, False]])
    nothing = np.zeros((1, 3))
    (contact,) = of_one_scan(touched, nothing, nothing)
    assert (contact.row, contact.column, contact.force_n) == (0.0, 0.5, 0.0)


def test_two_fingers_keep_their_numbers_while_they_pass_each_other() -> None:
    tracker = ContactTracker()
    for scan in range(60):
        left, right = finger(1.0, scan / 10), finger(5.5, 6 - scan / 10)
        contacts = seen(tracker, scan, left + right)
        assert [contact.identity for contact in contacts] == [1, 2]
        assert [round(contact.row, 1) for contact in contacts] == [1.0, 5.5]


def test_a_finger_that_jumps_is_another() -> None:
    tracker = ContactTracker()
    seen(tracker, 0, finger(1, 1))
    (near,) = seen(tracker, 1, finger(2, 2))
    (far,) = seen(tracker, 2, finger(6, 6))
    assert (near.identity, far.identity) == (1, 2)


def test_a_flicker_is_the_same_touch_and_a_later_one_is_new() -> None:
    tracker = ContactTracker()
    nothing = np.zeros((8, 8))
    assert seen(tracker, 0, finger(3, 3))[0].identity == 1
    within = MEMORY_US // SCAN_US
    for scan in range(1, within):
        assert seen(tracker, scan, nothing) == ()
    assert seen(tracker, within, finger(3, 3))[0].identity == 1
    for scan in range(within + 1, 2 * within + 2):
        assert seen(tracker, scan, nothing) == ()
    assert seen(tracker, 2 * within + 2, finger(3, 3))[0].identity == 2


def test_a_slow_board_s_touch_stays_itself() -> None:
    """At 1 Hz a scan is all that memory has."""
    tracker = ContactTracker()
    nothing = np.zeros((8, 8))
    every = 1_000_000 // SCAN_US
    for scan in range(3):
        assert seen(tracker, scan * every, finger(3, 3))[0].identity == 1
    assert seen(tracker, 3 * every, nothing) == ()
    assert seen(tracker, 4 * every, finger(3, 3))[0].identity == 2


def test_merging_ends_the_farther_number() -> None:
    tracker = ContactTracker()
    assert len(seen(tracker, 0, skin("90003"))) == 2
    (merged,) = seen(tracker, 1, skin("99333"))
    assert merged.identity == 1
    assert merged.force_n == 27.0


def test_a_board_that_restarts_begins_anew() -> None:
    tracker = ContactTracker()
    assert seen(tracker, 1000, finger(3, 3))[0].identity == 1
    assert seen(tracker, 0, finger(3, 3))[0].identity == 2
