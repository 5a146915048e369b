# SPDX-License-Identifier: Apache-2.0
"""Contacts: touched cells that adjoin are one thing on the skin, followed from scan to scan."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float

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
    force_n: sum of F_e [N]; force_n_std: the sum of the cells' standard deviations, because these
    cells share wires, and their errors may all have one sign. cells: which it covers, (R, C).
    """

    identity: int
    row: float
    column: float
    force_n: float
    force_n_std: float
    cells: Bool

    @property
    def force_text(self) -> str:
        """Its newtons for people: "1.23 +- 0.10 N"; "uncertain" where the deviation is larger."""
        if self.force_n_std > self.force_n:
            return "uncertain"
        return f"{self.force_n:.2f} +- {self.force_n_std:.2f} N"


class ContactTracker:
    """Finds the contacts of each scan, and tells which of them were there before.

    Contacts of two scans are matched so that the sum of the distances of their centres is least
    (the assignment problem). None is taken for one farther than `FARTHEST_CELLS` away. One that is
    gone is remembered for `MEMORY_US`. Where two merge, one number ends.
    """

    def __init__(self) -> None:
        self._known: dict[int, tuple[Contact, int]] = {}  # by identity, with when last seen [us]
        self._last = 0
        self._before_us = 0

    def update(
        self, time_us: int, touched: Bool, force_n: Float, force_n_std: Float
    ) -> tuple[Contact, ...]:
        """The contacts of a scan, the oldest first. Arrays (R, C); time_us: the board's."""
        for identity, (_, seen_us) in list(self._known.items()):
            longest_us = SLOWEST_SCAN_US if seen_us == self._before_us else MEMORY_US
            if not 0 <= time_us - seen_us <= longest_us:
                del self._known[identity]
        self._before_us = time_us
        found = _found(touched, force_n, force_n_std)
        identities = _identities(found, [contact for contact, _ in self._known.values()])
        for index, contact in enumerate(found):
            if index not in identities:
                self._last += 1
            found[index] = replace(contact, identity=identities.get(index, self._last))
        self._known |= {contact.identity: (contact, time_us) for contact in found}
        return tuple(sorted(found, key=lambda contact: contact.identity))


def _identities(found: list[Contact], known: list[Contact]) -> dict[int, int]:
    """By the index of each contact that is found and was known: the identity it had."""
    from scipy.optimize import linear_sum_assignment

    if not found or not known:
        return {}
    new, old = (np.array([(each.row, each.column) for each in some]) for some in (found, known))
    away = np.hypot(*(new[:, None] - old[None]).transpose(2, 0, 1))
    away[away > FARTHEST_CELLS] = _FAR
    pairs = zip(*linear_sum_assignment(away), strict=True)
    return {one: known[other].identity for one, other in pairs if away[one, other] < _FAR}


def _found(touched: Bool, force_n: Float, force_n_std: Float) -> list[Contact]:
    """The contacts of a scan, without their numbers."""
    from scipy.ndimage import center_of_mass, label

    labels, count = label(touched, structure=_EIGHT_NEIGHBOURS)
    contacts = []
    for number in range(1, count + 1):
        cells = labels == number
        total_n, std_n = (float(each[cells].sum()) for each in (force_n, force_n_std))
        # Where it is too light for its curve, all cells count alike.
        row, column = center_of_mass(force_n if total_n > 0 else cells, cells)
        contacts.append(Contact(0, float(row), float(column), total_n, std_n, cells))
    return contacts
