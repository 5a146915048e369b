# SPDX-License-Identifier: Apache-2.0
"""Contacts: touched cells that adjoin are one thing on the skin, followed from scan to scan."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float

# A contact moves by at most so many cells between two scans: at 30 Hz a finger at 0.5 m/s passes
# over 1.7 cells of 1 cm.
FARTHEST_CELLS: Final = 2.0
# A contact that is gone for less [us] stays the same: a light touch flickers about its threshold.
MEMORY_US: Final = 100_000
# Contacts of the scan before are remembered for so long [us], because boards may scan slowly.
SLOWEST_SCAN_US: Final = 20 * MEMORY_US
# Cells that adjoin, for scipy: along an edge or at a corner.
_EIGHT_NEIGHBOURS: Final = np.ones((3, 3), dtype=np.int_)
# Distance of what must not be matched, in cells: more than any skin has.
_FAR: Final = 1e6


@dataclass(frozen=True, eq=False)
class Contact:
    """Touched cells that adjoin, along an edge or at a corner.

    identity: the same number for as long as the contact lasts, from 1. row, column: the centre,
    sum of F_e position_e / sum of F_e over its cells e, in cell units (0: centre of the first).
    force_n: sum of F_e [N]; force_n_std: its standard deviation, supposing independent cells.
    cells: shape (R, C), which cells it covers.
    """

    identity: int
    row: float
    column: float
    force_n: float
    force_n_std: float
    cells: NDArray[np.bool_]


class ContactTracker:
    """Finds the contacts of each scan, and tells which of them were there before.

    Contacts of two scans are matched so that the sum of the distances of their centres is least
    (the assignment problem). None is taken for one farther than `FARTHEST_CELLS` away. One that is
    gone is remembered for `MEMORY_US`. Where two merge, one number ends.
    """

    def __init__(self) -> None:
        self._known: list[tuple[Contact, int]] = []  # with the time it was last seen [us]
        self._last = 0
        self._before_us = 0

    def update(
        self, time_us: int, touched: NDArray[np.bool_], force_n: Float, force_n_std: Float
    ) -> tuple[Contact, ...]:
        """The contacts of a scan, the oldest first. Arrays (R, C); time_us: the board's."""
        limits_us = {self._before_us: SLOWEST_SCAN_US}
        self._known = [
            each
            for each in self._known
            if 0 <= time_us - each[1] <= limits_us.get(each[1], MEMORY_US)
        ]
        self._before_us = time_us
        found = _found(touched, force_n, force_n_std)
        same = self._matches(found)
        for index, contact in enumerate(found):
            if index in same:
                identity = self._known[same[index]][0].identity
            else:
                self._last = identity = self._last + 1
            found[index] = replace(contact, identity=identity)
        found.sort(key=lambda contact: contact.identity)
        gone = [each for index, each in enumerate(self._known) if index not in same.values()]
        self._known = [*gone, *((contact, time_us) for contact in found)]
        return tuple(found)

    def _matches(self, found: list[Contact]) -> dict[int, int]:
        """By the index of a contact that is found, the index of the known contact that it is."""
        from scipy.optimize import linear_sum_assignment

        if not found or not self._known:
            return {}
        new = np.array([(contact.row, contact.column) for contact in found])
        old = np.array([(known.row, known.column) for known, _ in self._known])
        away = np.hypot(*(new[:, None] - old[None]).transpose(2, 0, 1))
        away[away > FARTHEST_CELLS] = _FAR
        pairs = zip(*linear_sum_assignment(away), strict=True)
        return {int(one): int(other) for one, other in pairs if away[one, other] < _FAR}


def _found(touched: NDArray[np.bool_], force_n: Float, force_n_std: Float) -> list[Contact]:
    """The contacts of a scan, without their numbers."""
    from scipy.ndimage import label

    if not touched.any():
        return []
    labels, count = label(touched, structure=_EIGHT_NEIGHBOURS)
    contacts = []
    for number in range(1, count + 1):
        cells = labels == number
        rows, columns = np.nonzero(cells)
        weights = force_n[cells]
        total_n = float(weights.sum())
        if total_n <= 0:  # too light for its curve: all cells alike
            weights = np.ones(rows.size)
        contacts.append(
            Contact(
                identity=0,
                row=float(np.average(rows, weights=weights)),
                column=float(np.average(columns, weights=weights)),
                force_n=total_n,
                force_n_std=float(np.sqrt(np.sum(force_n_std[cells] ** 2))),
                cells=cells,
            )
        )
    return contacts
