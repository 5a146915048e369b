# SPDX-License-Identifier: Apache-2.0
"""From a port's URL to a device: the one place that knows the kinds of ports.

docs/commands.md lists them. Modules that only one kind of port needs are imported when such a port
is opened.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from typing import overload
from urllib.parse import urlsplit

from ohmskin.errors import PortError
from ohmskin.files import PathName
from ohmskin.force.calibration import CalibrationLike, loaded
from ohmskin.force.reader import CalibratedSkin
from ohmskin.link.device import Device, Region
from ohmskin.link.serial_port import SerialLink
from ohmskin.link.session import Session
from ohmskin.link.url import PortUrl


@overload
def open(url: PathName, *, start: bool = True) -> Device: ...


@overload
def open(
    url: PathName,
    *,
    start: bool = True,
    calibration: CalibrationLike,
    force: bool = False,
    focus: bool | Region = False,
) -> CalibratedSkin: ...


def open(
    url: PathName,
    *,
    start: bool = True,
    calibration: CalibrationLike | None = None,
    force: bool = False,
    focus: bool | Region = False,
) -> Device | CalibratedSkin:
    """Connect to a board, and start scanning unless told otherwise.

    calibration: a `Calibration` or the path of its file; scans then carry forces.
    force: take the calibration even if it is of another unit.
    focus: while somebody iterates, a region around the contacts is read hundreds of times a second,
        and the whole skin `focus.WHOLE_HZ` times a second. A `Region` says how the region is read:
        ``Region(settle_us=20)`` reads 3x3 cells a thousand times a second, but less exactly where
        lines take time to charge.

    >>> with open("emulator://8x8?scene=ghost") as skin:
    ...     skin.latest().ratio.shape
    (8, 8, 4)

    :raises PortError: the port is unknown, busy or not permitted, or the URL is wrong.
    :raises DeviceSilent: nothing that is a skin board answers.
    :raises ProtocolMismatch: the board was built from another protocol definition.
    :raises ProtocolError: the board says what cannot be.
    :raises RecordingError: the recording of a ``replay://`` port cannot be read.
    :raises ValueError: the calibration cannot be read, or is of another unit, size or mode; with
        `focus`: there is no calibration, its method takes no regions, or the board reads far ends.
    :raises CommandRefused: with `focus`: the board has no regions, or is a recording.
    """
    if focus and calibration is None:
        raise ValueError("focus follows contacts, which scans have with a calibration: give one")
    # The file first: a board may take seconds to boot, and a wrong file is known at once.
    known = None if calibration is None else loaded(calibration)
    with ExitStack() as opened:
        device = opened.enter_context(_device(os.fsdecode(url)))
        skin = device if known is None else CalibratedSkin(device, known, force=force, focus=focus)
        if start:
            device.start()
        opened.pop_all()
        return skin


def _device(text: str) -> Device:
    """The device of a URL, connected and not started."""
    url = PortUrl.of(text)
    match url.scheme:
        case "" | "socket" | "rfc2217":
            url.check_options("baud")
            if url.scheme == "socket" and url.options:
                raise PortError(f"{text}: a socket cannot change the speed: rfc2217:// can")
            baud = url.baud  # raises for a wrong URL, before a port is opened
            with url.blamed():
                if url.scheme and urlsplit(text).port is None:
                    raise ValueError(f"which of its ports? Write {url.scheme}://{url.place}:4000")
            return Session(SerialLink(text.partition("?")[0]), baud)
        case "emulator":
            from ohmskin.emulate.urls import open_emulator

            return open_emulator(text)
        case "simavr":
            from ohmskin.emulate.urls import open_simavr

            return open_simavr(text)
        case "replay":
            from ohmskin.record.replay import Replay

            url.check_options("speed")
            if not url.place:
                raise PortError(f"{text} names no recording: write replay://FILE.mcap")
            with url.blamed():
                return Replay(url.place, url.number("speed", 1.0), text)
    kinds = "serial ports by name, socket://, rfc2217://, emulator://, simavr:// and replay://"
    raise PortError(f"no kind of port '{url.scheme}://': there are {kinds}")
