# SPDX-License-Identifier: Apache-2.0
"""What programs of several processes hand on: errors."""

import copy

from ohmskin import errors
from ohmskin.errors import CommandRefused, OhmskinError


def test_every_error_can_go_to_another_process() -> None:
    """A pool of processes waited for ever: it could not make a refused command anew."""
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, OhmskinError)]
    assert CommandRefused in kinds
    for kind in kinds:
        told = ("start", "busy", "so") if kind is CommandRefused else ("what", "why")
        one = kind(*told)
        again = copy.copy(one)  # as a process makes it anew
        assert (type(again), str(again), vars(again)) == (kind, str(one), vars(one))
