# SPDX-License-Identifier: Apache-2.0
"""``ohmskin flash pico``: copies the firmware to the drive that a Pico in its boot loader is."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from ohmskin.errors import OhmskinError, PortError
from ohmskin.files import read_bounded
from ohmskin.link.serial_port import serial_ports

# Where systems put a drive: Linux, macOS. Windows gives it a letter.
_PLACES: Final = ("/media/*", "/media/*/*", "/run/media/*/*", "/mnt/*", "/Volumes/*")
# A file on the drive says what it is; this is a line of it (uf2 of the chip's ROM).
_INFO: Final = "INFO_UF2.TXT"
_BOARD_ID: Final = b"Board-ID: RPI-RP2"
_INFO_MOST_BYTES: Final = 4096
# How long a Pico that was flashed may take until its port is there, and answers [s]. Chosen: USB
# takes one.
APPEARS_S: Final = 10.0


def copy_firmware(firmware: Path, drive: str) -> Path:
    """Copy the firmware to the drive, or to the one that is found; which it was.

    :raises OhmskinError: there is no firmware, or no drive of a Pico, or more than one.
    """
    if not firmware.is_file():
        raise OhmskinError(
            f"{firmware} is missing: run 'make pico', or take the wheel of 'make wheel'"
        )
    drives = [Path(drive)] if drive else list(_drives())
    found = [each for each in drives if _is_pico(each)]
    if len(found) != 1:
        raise OhmskinError(
            f"{len(found) or 'no'} Picos are found in their boot loader: hold BOOTSEL while you "
            "plug it in, mount the drive RPI-RP2 that appears, or name it: --port DRIVE"
        )
    try:
        with firmware.open("rb") as source, (found[0] / firmware.name).open("wb") as target:
            shutil.copyfileobj(source, target)
            target.flush()
            os.fsync(target.fileno())
    except OSError as exc:
        raise OhmskinError(f"copying to {found[0]} failed: {exc.strerror}") from exc
    return found[0]


def port_of_pico() -> str:
    """The serial port of the Pico that was flashed.

    :raises PortError: none is there, or more than one.
    """
    ports = [port.path for port in serial_ports() if port.board == "pico"]
    if len(ports) != 1:
        raise PortError(f"{len(ports) or 'no'} ports are those of a Pico: plug it in again")
    return ports[0]


def _drives() -> Iterator[Path]:
    if sys.platform == "win32":
        yield from (Path(f"{letter}:/") for letter in "DEFGHIJKLMNOPQRSTUVWXYZ")
    for pattern in _PLACES:
        yield from Path("/").glob(pattern[1:])


def _is_pico(drive: Path) -> bool:
    with suppress(OSError, ValueError):
        return _BOARD_ID in read_bounded(drive / _INFO, _INFO_MOST_BYTES)
    return False
