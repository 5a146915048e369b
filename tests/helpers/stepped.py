# SPDX-License-Identifier: Apache-2.0
"""Emulated boards in stepped time: no test depends on how busy the machine is."""

from dataclasses import replace

from ohmskin.doctor.examine import Evidence
from ohmskin.doctor.gather import gather
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.driver import SteppedLink, SteppedSkin
from ohmskin.emulate.urls import emulated


def stepped_link(of: str | EmulatedBoard) -> SteppedLink:
    """A board, or that of an ``emulator://`` URL, in stepped time."""
    board, _, faults = emulated(of) if isinstance(of, str) else (of, "", None)
    return SteppedLink(board, str(of), faults)


def stepped(of: str | EmulatedBoard) -> SteppedSkin:
    """What `ohmskin.open` gives for such a URL with ``speed=0``; it does not scan yet."""
    return SteppedSkin(stepped_link(of))


def evidence(url: str, **told: object) -> Evidence:
    """What the doctor reads of the board at an `emulator://` URL, and what it is told besides."""
    return replace(gather(stepped(url)), **told)
