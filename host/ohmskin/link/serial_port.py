# SPDX-License-Identifier: Apache-2.0
"""A way for bytes to and from a board, and the serial port as one."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import serial
from serial.tools import list_ports

from ohmskin.errors import DeviceLost, PortError
from ohmskin.link import protocol

# How long a read waits when nothing comes; closing a device takes at most this long.
READ_TIMEOUT_S = 0.2


class Link(Protocol):
    """What a `Device` needs of its port. `read` is called by one thread, `write` by any."""

    name: str

    def read(self) -> bytes:
        """What has arrived, or ``b""`` when nothing does for about `READ_TIMEOUT_S`.

        :raises DeviceLost: the port has gone.
        """

    def write(self, octets: bytes) -> None:
        """Send.

        :raises DeviceLost: the port has gone.
        """

    def set_baud(self, baud: int) -> None:
        """Change the speed of the line, where it has one."""

    def close(self) -> None:
        """Give the port back. May be called again."""


@runtime_checkable
class PausableLink(Link, Protocol):
    """A link whose scans can wait, such as those of a file."""

    def pause(self, paused: bool) -> None:
        """Hold scans back while nobody takes them. It begins paused."""


class SerialLink:
    """A serial port, opened for this program alone.

    :raises PortError: it does not exist, is in use, or may not be opened.
    """

    def __init__(self, path: str, baud: int = protocol.CONSTANTS["baud_default"]) -> None:
        self.name = path
        try:
            self._port = serial.Serial(
                path, baud, timeout=READ_TIMEOUT_S, write_timeout=2.0, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as exc:
            raise PortError(*_explain(path, exc)) from exc

    def read(self) -> bytes:
        """See `Link.read`: waits for one byte, then takes all there are."""
        try:
            octets: bytes = self._port.read(1)
            if octets:
                octets += self._port.read(self._port.in_waiting)
        except (serial.SerialException, OSError, TypeError) as exc:
            # pyserial raises TypeError when another thread closes the port meanwhile.
            raise DeviceLost(f"{self.name} is gone: is the board still plugged in?") from exc
        return octets

    def write(self, octets: bytes) -> None:
        """See `Link.write`."""
        try:
            self._port.write(octets)
        except (serial.SerialException, OSError) as exc:
            raise DeviceLost(f"{self.name} takes no bytes: is the board still plugged in?") from exc

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`."""
        try:
            self._port.baudrate = baud
        except (serial.SerialException, OSError, ValueError) as exc:
            raise PortError(f"{self.name} cannot do {baud} baud: {exc}") from exc

    def close(self) -> None:
        """See `Link.close`."""
        self._port.close()


def _explain(path: str, exc: Exception) -> tuple[str, str]:
    """Problem and remedy."""
    number = getattr(exc, "errno", None)
    text = str(exc)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFound" in text:
        return f"no port {path}", "'ohmskin ports' lists the ports there are"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return f"{path} is busy", "close the other program that uses it"
    if number in (errno.EACCES, errno.EPERM) or "PermissionError" in text:
        return (
            f"no permission for {path}",
            "on Linux run 'sudo usermod -aG dialout $USER' and log in again; on Windows close the "
            "other program that uses it",
        )
    if number in (errno.ENOTTY, errno.EINVAL):
        return f"{path} is no serial port", "'ohmskin ports' lists the ports there are"
    return f"cannot open {path}: {text}", ""


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine. `board`: what is probably behind it, or ``""``."""

    path: str
    description: str
    board: str


# USB vendor and product ids of the boards and of the bridges their copies use.
_BOARDS = {
    (0x2341, 0x0043): "uno",
    (0x2341, 0x0001): "uno",
    (0x2A03, 0x0043): "uno",
    (0x2341, 0x0010): "megaatmega2560",
    (0x2341, 0x0042): "megaatmega2560",
    (0x2A03, 0x0042): "megaatmega2560",
}


def serial_ports() -> list[SerialPort]:
    """The serial ports of this machine, by path."""
    found = [
        SerialPort(
            port.device,
            "" if port.description in (None, "n/a") else port.description,
            _BOARDS.get((port.vid or 0, port.pid or 0), ""),
        )
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: port.path)
