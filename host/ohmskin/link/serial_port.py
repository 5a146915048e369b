# SPDX-License-Identifier: Apache-2.0
"""Ways for bytes to and from a board: `Link`, and the serial ports of this machine.

`Link` is all that a session knows of its port. An emulated board is a `Link` too.
"""

import errno
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import serial
from serial.tools import list_ports

from ohmskin.errors import DeviceLost, PortUnusable
from ohmskin.link import protocol

# A read waits so long when nothing comes. Chosen: closing a device takes at most this long, and an
# idle thread wakes no more than five times a second.
READ_TIMEOUT_S: Final = 0.2
# A write waits at most so long for the system's buffer. Chosen: on a line that works, the buffer
# empties in a tenth of this.
_WRITE_TIMEOUT_S: Final = 2.0
# At most so many bytes of a socket are taken at once. Chosen: a second of a fast line.
_SOCKET_BYTES: Final = 100_000
# Linux shows the settings of USB serial bridges here.
USB_SERIAL: Final = Path("/sys/bus/usb-serial/devices")
# Boards by USB ids: Arduino's products, under both of its vendor ids (boards.txt of its AVR core),
# and the firmware's own (firmware/pico/usb_descriptors.h). Other makers' boards have ids of USB
# bridges, which do not tell what is behind them.
_PRODUCTS: Final = {1: "uno", 0x43: "uno", 0x10: "megaatmega2560", 0x42: "megaatmega2560"}
_BOARDS: Final = {0x2341: _PRODUCTS, 0x2A03: _PRODUCTS, 0x1209: {1: "pico"}}


class Link(Protocol):
    """What a `Device` needs of its port. `read` is called by one thread, `write` by any.

    Both raise DeviceLost when the port has gone.
    """

    name: str
    resets_board: bool  # whether opening it resets the board

    def read(self) -> bytes:
        """What has arrived. It is ``b""`` when nothing arrives for about `READ_TIMEOUT_S`."""

    def write(self, octets: bytes) -> None:
        """Send."""

    def set_baud(self, baud: int) -> None:
        """Change the speed of the line, if it has one."""

    def close(self) -> None:
        """Give the port back. May be called again."""


class SerialLink:
    """A serial port, opened for this program alone, or one elsewhere by a URL of pyserial.

    :raises PortUnusable: it does not exist, is in use, or may not be opened.
    """

    def __init__(self, path: str, baud: int = protocol.CONSTANTS["baud_default"]) -> None:
        self.name = path
        # pyserial refuses such a limit for rfc2217://: there, its socket has one of 5 s.
        limit_s = None if path.startswith("rfc2217://") else _WRITE_TIMEOUT_S
        try:
            self._port = serial.serial_for_url(
                path, baud, timeout=READ_TIMEOUT_S, write_timeout=limit_s, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as exc:
            raise PortUnusable(*_explain(path, exc)) from exc
        self.resets_board = resets_board(path)

    def read(self) -> bytes:
        """See `Link.read`: waits for one byte, then takes all there are."""
        try:
            octets: bytes = self._port.read(1)
            if not octets or not self.name.startswith("socket://"):
                return octets and octets + self._port.read(self._port.in_waiting)
            # A socket does not say how much there is: take it without waiting.
            self._port.timeout = 0.0
            octets += self._port.read(_SOCKET_BYTES)
            self._port.timeout = READ_TIMEOUT_S
            return octets
        except (serial.SerialException, OSError, TypeError) as exc:
            # pyserial raises TypeError when another thread closes the port meanwhile.
            raise DeviceLost(f"{self.name} is gone: is the board still plugged in?") from exc

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
            raise PortUnusable(f"{self.name} cannot do {baud} baud: {exc}") from exc

    def close(self) -> None:
        """See `Link.close`."""
        self._port.close()


def _explain(path: str, exc: Exception) -> tuple[str, str]:
    """Problem and remedy, in words.

    Systems call the same problem by different numbers and texts, and pyserial keeps either of them.
    """
    number = getattr(exc, "errno", None)
    text, remedy = str(exc), "'ohmskin ports' lists the ports there are"
    if path.endswith(".mcap"):
        remedy = f"a recording is read as replay://{path}"
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFound" in text:
        return f"no port {path}", remedy
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return f"{path} is busy", "close the other program that uses it"
    if number in (errno.EACCES, errno.EPERM) or "PermissionError" in text:
        return (
            f"no permission for {path}",
            "on Linux run 'sudo usermod -aG dialout $USER' and log in again; on Windows close the "
            "other program that uses it",
        )
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or "configure port" in text:
        return f"{path} is no serial port", remedy
    return f"cannot open {path}: {text}", ""


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine.

    path: what opens it.
    description: what the system calls it, ``""`` if nothing.
    board: what is probably behind it, as `Hello.board` names it; ``""`` if nothing tells.
    """

    path: str
    description: str
    board: str


def serial_ports() -> list[SerialPort]:
    """The serial ports of this machine, by path."""
    return [
        SerialPort(
            port.device,
            "" if port.description in (None, "n/a") else port.description,
            _BOARDS.get(port.vid, {}).get(port.pid, ""),
        )
        for port in sorted(list_ports.comports(), key=lambda port: port.device)
    ]


def resets_board(port: str) -> bool:
    """Whether opening a port resets its board.

    The line DTR does that. A pseudo-terminal has no such line, and on a Pico it says no more than
    that a program reads.
    """
    real = os.path.realpath(port)
    picos = (os.path.realpath(each.path) for each in serial_ports() if each.board == "pico")
    return not real.startswith("/dev/pts/") and real not in picos


def latency_timer(port: str) -> tuple[int, str] | None:
    """The latency timer of a USB serial bridge [ms], and the file in which Linux sets it.

    A bridge waits for more bytes until this timer ends, before it passes a few of them on. `port`
    may be a symbolic link. None: the port has no such timer, or the system does not show it.
    """
    file = USB_SERIAL / Path(os.path.realpath(port)).name / "latency_timer"
    try:
        return int(file.read_text(encoding="ascii")), str(file)
    except (OSError, ValueError):
        return None
