# SPDX-License-Identifier: Apache-2.0
"""Contacts: touched cells that adjoin are one thing on the skin, followed from scan to scan."""

from dataclasses import dataclass, replace
from itertools import count
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float

# A contact moves by at most so many cells between two scans; what is farther away is another one.
# Chosen: at 30 Hz, a finger at 0.5 m/s passes over 1.7 cells of 1 cm.
FARTHEST_CELLS: Final = 2.0
# A contact that is gone and comes back within this time keeps its number [us]. Chosen: a light
# touch flickers about its threshold for some scans, and no finger leaves a place and comes back
# within a tenth of a second.
MEMORY_US: Final = 100_000
# Contacts that were in the scan before are remembered for this longer time [us]. Chosen: a board
# may scan only once a second (rate_mhz_min of frames.toml), and one scan may be lost.
SLOWEST_SCAN_US: Final = 20 * MEMORY_US
# Which neighbours adjoin, for scipy: those along an edge or at a corner, in the same scan.
_EIGHT_NEIGHBOURS: Final = np.zeros((3, 3, 3), dtype=np.int_)
_EIGHT_NEIGHBOURS[1] = 1


@dataclass(frozen=True, eq=False)
class Contact:
    """Touched cells that adjoin, along an edge or at a corner.

    identity: the same number for as long as the contact lasts, from 1.
    row, column: the centre, sum of F_e position_e / sum of F_e over the contact's cells e, in cell
        units; 0 is the centre of the first cell. If the sum of F_e is 0, all cells count alike.
    force_n: sum of F_e [N]. Without forces, F_e is the rise of the level (`ForceScan.contacts`).
    force_n_std: sum of the cells' standard deviations [N]. (Not the root of a sum of squares: the
        cells share wires, so that their errors may all have one sign.)
    cells: which cells it covers, (R, C).
    position_m: the same centre in the frame of the skin's `Geometry` (3,) [m]; None: not known.
    normal: the mean of the cells' normals there (3,), of length 1; None: not known.
    """

    identity: int
    row: float
    column: float
    force_n: float
    force_n_std: float
    cells: Bool
    position_m: Float | None = None
    normal: Float | None = None

    @property
    def force_text(self) -> str:
        """Its newtons for people: "1.23 +- 0.10 N"; "uncertain" where the deviation is larger.

        "1.23 N" where the deviation is not known.
        """
        if np.isnan(self.force_n_std):
            return f"{self.force_n:.2f} N"
        if self.force_n_std > self.force_n:
            return "uncertain"
        return f"{self.force_n:.2f} +- {self.force_n_std:.2f} N"


class ContactTracker:
    """Numbers the contacts of each scan. One that was there before keeps its number.

    Contacts of two scans are matched so that the sum of the distances of their centres is least
    (the assignment problem). A contact is never matched with one that is farther away than
    `FARTHEST_CELLS`. A contact that is gone is remembered for `MEMORY_US`. Where two contacts
    merge, one of the two numbers ends.
    """

    def __init__(self) -> None:
        # By identity: a contact that is remembered, and the time of the last scan that had it [us].
        self._remembered: dict[int, tuple[Contact, int]] = {}
        self._new_identities = count(1)
        self._before_us = 0  # the time of the scan before

    def follow(self, time_us: int, contacts: list[Contact]) -> tuple[Contact, ...]:
        """These contacts of a scan with their numbers, the oldest first. time_us: the board's."""
        for identity, (_, last_us) in list(self._remembered.items()):
            longest_us = SLOWEST_SCAN_US if last_us == self._before_us else MEMORY_US
            # The board's time goes back when the board is reset: then nothing is remembered.
            if not 0 <= time_us - last_us <= longest_us:
                del self._remembered[identity]
        self._before_us = time_us
        identities = _identities(contacts, [contact for contact, _ in self._remembered.values()])
        numbered = [
            replace(contact, identity=identities.get(index) or next(self._new_identities))
            for index, contact in enumerate(contacts)
        ]
        self._remembered |= {contact.identity: (contact, time_us) for contact in numbered}
        return tuple(sorted(numbered, key=lambda contact: contact.identity))


def _identities(now: list[Contact], before: list[Contact]) -> dict[int, int]:
    """The identities of those contacts of now that were there before, by their index in `now`."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    if not now or not before:
        return {}
    centres = ([(each.row, each.column) for each in contacts] for contacts in (now, before))
    away = cdist(*centres)
    too_far = away > FARTHEST_CELLS
    # A pair that is too far apart costs more than all others together. So as few of them as
    # possible are made, and these are left out below.
    away[too_far] = FARTHEST_CELLS * (1 + sum(away.shape))
    pairs = zip(*linear_sum_assignment(away), strict=True)
    return {one: before[other].identity for one, other in pairs if not too_far[one, other]}


def found(touched: Bool, force_n: Float, force_n_std: Float) -> list[list[Contact]]:
    """The contacts of each of n scans, with the identity 0. Arrays (n, R, C)."""
    from scipy.ndimage import label

    labels, count = label(touched, structure=_EIGHT_NEIGHBOURS)
    places = np.nonzero(labels)
    of = labels[places] - 1  # which contact each touched cell is of

    def sums(values: Float) -> Float:
        """Of each contact."""
        return np.asarray(np.bincount(of, values, count), dtype=np.float64)

    of_cells_n = force_n[places]
    total_n, std_n = sums(of_cells_n), sums(force_n_std[places])
    # A touch that is too light for its curve has no force: then all its cells count alike.
    weights = np.where(total_n[of] > 0, of_cells_n, 1.0)
    whole = sums(weights)
    rows, columns = (sums(weights * place) / whole for place in places[1:])
    scans = np.zeros(count, dtype=np.intp)
    scans[of] = places[0]
    contacts: list[list[Contact]] = [[] for _ in touched]
    of_contacts = (values.tolist() for values in (scans, rows, columns, total_n, std_n))
    for k, (scan, row, column, of_contact_n, std) in enumerate(zip(*of_contacts, strict=True)):
        contacts[scan].append(Contact(0, row, column, of_contact_n, std, labels[scan] == k + 1))
    return contacts
