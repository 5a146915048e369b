# SPDX-License-Identifier: Apache-2.0
"""A board that the opening of its port resets is in its boot loader, which must be left alone.

The numbers are those of the Mega's loader (firmware/sim/README.md): left alone, it starts the
program after 0.83 s; a byte that it hears keeps it for 5 s more.
"""

from itertools import pairwise

import pytest

from ohmskin.emulate.driver import SteppedLink, SteppedSkin
from ohmskin.emulate.urls import emulated
from ohmskin.errors import DeviceSilent
from ohmskin.link import framing
from ohmskin.link.protocol import FRAMES

QUIET_S = 2.0  # from the opening of the port to the first question
AGAIN_S = 6.0  # from a question to the next, so that a loader that has heard it is done
AT_ONCE_S = 0.5
QUESTION = framing.encode(FRAMES["get_hello"].id, 0, b"")


class DeafLink(SteppedLink):
    """A board that says hello by itself and then hears nothing: it is reset once more."""

    def __init__(self) -> None:
        board, _, faults = emulated("emulator://1x1")
        super().__init__(board, "deaf", faults)
        super().write(QUESTION)

    def write(self, octets: bytes) -> None:
        pass


class SilentLink(SteppedLink):
    """A board that says nothing. asked_s: when it was asked, by the speed of the line."""

    resets_board = True

    def __init__(self) -> None:
        board, _, faults = emulated("emulator://1x1?silent=1")
        super().__init__(board, "silent", faults)
        self.baud = 0
        self.asked_s: dict[int, list[float]] = {}

    def write(self, octets: bytes) -> None:
        self.asked_s.setdefault(self.baud, []).append(self.now_s())

    def set_baud(self, baud: int) -> None:
        self.baud = baud


def test_a_boot_loader_hears_nothing_and_then_is_not_asked_again_too_soon() -> None:
    link = SilentLink()
    with pytest.raises(DeviceSilent):
        SteppedSkin(link)
    every_s = sorted(time_s for asked_s in link.asked_s.values() for time_s in asked_s)
    assert every_s[0] >= QUIET_S
    assert len(every_s) >= 2
    for asked_s in link.asked_s.values():
        assert all(later - before >= AGAIN_S for before, later in pairwise(asked_s))
    # The same question at the line's other speed comes at once, or as late.
    steps_s = [later - before for before, later in pairwise(every_s)]
    assert all(step_s <= AT_ONCE_S or step_s >= AGAIN_S for step_s in steps_s)


def test_a_board_that_was_not_reset_is_asked_at_once() -> None:
    link = SilentLink()
    link.resets_board = False
    with pytest.raises(DeviceSilent):
        SteppedSkin(link)
    assert min(map(min, link.asked_s.values())) == 0


def test_a_board_that_is_reset_when_it_has_said_hello_is_open_all_the_same() -> None:
    link = DeafLink()
    with SteppedSkin(link) as skin:
        assert not skin.info.scanning
        assert link.now_s() < AT_ONCE_S
