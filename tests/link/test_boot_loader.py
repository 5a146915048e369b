# SPDX-License-Identifier: Apache-2.0
"""A board that the opening of its port resets is in its boot loader, which must be left alone.

The numbers are those of the Mega's loader (firmware/sim/README.md): left alone, it starts the
program after 0.83 s; a byte that it hears keeps it for 5 s more.
"""

import threading
from collections.abc import Callable
from itertools import pairwise

import pytest

from ohmskin.errors import DeviceSilent
from ohmskin.link.session import Session

QUIET_S = 2.0  # from the opening of the port to the first question
AGAIN_S = 6.0  # from a question to the next, so that a loader that has heard it is done
AT_ONCE_S = 0.5


class SilentLink:
    """A port at which nothing answers. Its time passes only while the host waits."""

    name = "silent"
    resets_board = True

    def __init__(self) -> None:
        self.now_s, self.baud = 0.0, 0
        self.asked_s: dict[int, list[float]] = {}

    def read(self) -> bytes:
        return b""

    def write(self, octets: bytes) -> None:
        self.asked_s.setdefault(self.baud, []).append(self.now_s)

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        pass


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> SilentLink:
    silent = SilentLink()

    def wait_for(_: object, ready: Callable[[], bool], limit_s: float) -> bool:
        silent.now_s += limit_s
        return ready()

    monkeypatch.setattr(threading.Condition, "wait_for", wait_for)
    return silent


@pytest.mark.usefixtures("nothing_left")
def test_a_boot_loader_hears_nothing_and_then_is_not_asked_again_too_soon(link: SilentLink) -> None:
    with pytest.raises(DeviceSilent):
        Session(link)
    every_s = sorted(time_s for asked_s in link.asked_s.values() for time_s in asked_s)
    assert every_s[0] >= QUIET_S
    assert len(every_s) >= 2
    for asked_s in link.asked_s.values():
        assert all(later - before >= AGAIN_S for before, later in pairwise(asked_s))
    # The same question at the line's other speed comes at once, or as late.
    steps_s = [later - before for before, later in pairwise(every_s)]
    assert all(step_s <= AT_ONCE_S or step_s >= AGAIN_S for step_s in steps_s)


def test_a_board_that_was_not_reset_is_asked_at_once(link: SilentLink) -> None:
    link.resets_board = False
    with pytest.raises(DeviceSilent):
        Session(link)
    assert min(map(min, link.asked_s.values())) == 0
