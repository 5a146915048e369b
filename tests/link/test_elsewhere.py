# SPDX-License-Identifier: Apache-2.0
"""A board on another computer: what a socket brings is what a port would bring."""

import socket
import threading
import time
from collections.abc import Iterator
from itertools import islice, pairwise

import pytest
import serial
from serial.rfc2217 import PortManager

import ohmskin
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.faults import LineFaults
from ohmskin.emulate.urls import emulated
from ohmskin.errors import DeviceLost, PortError

# pyserial's thread that reads the socket is made in the old way.
pytestmark = pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")


class Serving:
    """An emulated board behind a socket of this machine, as socat serves one, or ser2net."""

    def __init__(self, board: EmulatedBoard, scheme: str) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"{scheme}://127.0.0.1:{self._server.getsockname()[1]}"
        self._board, self.ends = board, threading.Event()
        self.port = serial.serial_for_url("loop://")  # whose speed a host sets
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        begin_s, faults = time.monotonic(), LineFaults()
        connection, _ = self._server.accept()
        with connection, connection.makefile("wb", 0) as writing:
            connection.settimeout(0.005)
            manager = None
            if self.url.startswith("rfc2217"):
                manager = PortManager(self.port, writing)
            while not self.ends.is_set():
                try:
                    if not (octets := connection.recv(4096)):
                        return
                    self._board.receive(b"".join(manager.filter(octets)) if manager else octets)
                except TimeoutError:
                    pass
                sent = self._board.heard(faults, time.monotonic() - begin_s)
                connection.sendall(b"".join(manager.escape(sent)) if manager else sent)

    def close(self) -> None:
        self.ends.set()
        self._thread.join()
        self._server.close()


@pytest.fixture(params=["socket", "rfc2217"])
def serving(request: pytest.FixtureRequest) -> Iterator[Serving]:
    board = emulated("emulator://8x8?scene=ghost&seed=1&begin=0&unit=7")[0]
    served = Serving(board, request.param)
    yield served
    served.close()


def test_a_board_behind_a_socket_is_a_board(serving: Serving) -> None:
    with ohmskin.open(serving.url) as skin:
        assert skin.info.unit_id == 7
        scans = list(islice(skin, 30))
        assert skin.configure(rate_hz=45.0).rate_hz == pytest.approx(45.0, rel=1e-3)
    assert all(b.number == a.number + 1 for a, b in pairwise(scans))
    # What is waiting is taken at once, and not byte by byte.
    assert skin.stats.line.damaged == 0


@pytest.mark.parametrize("serving", ["rfc2217"], indirect=True)
def test_the_speed_of_a_port_elsewhere_is_set(serving: Serving) -> None:
    with ohmskin.open(f"{serving.url}?baud=1000000") as skin:
        skin.latest()
        assert skin.info.baud == serving.port.baudrate == 1_000_000


def test_a_plain_socket_takes_no_speed() -> None:
    """It was taken, and the board was told to change its speed alone."""
    with pytest.raises(PortError, match="a socket cannot change the speed: rfc2217:// can"):
        ohmskin.open("socket://127.0.0.1:9?baud=1000000")


def test_a_connection_that_ends_is_a_board_that_is_gone(serving: Serving) -> None:
    with ohmskin.open(serving.url) as skin:
        skin.latest()
        serving.ends.set()
        with pytest.raises(DeviceLost, match="is gone"):
            list(skin)


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_nobody_serves(scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(PortError, match=f"{scheme}://127.0.0.1:{port}"):
        ohmskin.open(f"{scheme}://127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("robot", "which of its ports? Write {}://robot:4000"),
        ("robot:usb", "Port could not be cast to integer value as 'usb'"),
        ("robot:99999", "Port out of range 0-65535"),
    ],
)
@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_a_port_is_a_number(scheme: str, place: str, reason: str) -> None:
    """It said that '<=' is not supported between 'int' and 'NoneType', as pyserial does."""
    with pytest.raises(PortError) as raised:
        ohmskin.open(f"{scheme}://{place}")
    assert str(raised.value) == f"{scheme}://{place}: {reason.format(scheme)}"


def test_no_other_scheme_is_opened() -> None:
    """One of pyserial's writes what it hears to a file."""
    with pytest.raises(PortError, match="no kind of port 'spy://': there are"):
        ohmskin.open("spy:///dev/ttyACM0?file=heard.txt")
