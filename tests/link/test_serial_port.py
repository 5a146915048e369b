# SPDX-License-Identifier: Apache-2.0
"""Which ports there are, what is probably behind them, and how long a bridge holds back bytes."""

from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ohmskin.link.serial_port import SerialPort, latency_timer, resets_board, serial_ports
from ports import Attach


def test_boards_are_told_by_their_usb_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the ids in boards.txt of Arduino's AVR core; a copy with a CH340 says nothing."""
    known = {
        "/dev/ttyACM3": (0x2341, 0x0043, "uno"),
        "/dev/ttyACM2": (0x2A03, 0x0043, "uno"),
        "/dev/ttyACM1": (0x2341, 0x0042, "megaatmega2560"),
        "/dev/ttyACM0": (0x2341, 0x0010, "megaatmega2560"),
        "/dev/ttyACM4": (0x1209, 0x0001, "pico"),
        "/dev/ttyACM5": (0x1209, 0x0043, ""),
        "/dev/ttyUSB0": (0x1A86, 0x7523, ""),
        "/dev/ttyS0": (None, None, ""),
    }
    ports = []
    for path, (vid, pid, _) in known.items():
        ports.append(ListPortInfo(path, skip_link_detection=True))
        ports[-1].vid, ports[-1].pid = vid, pid
    ports[0].description = "Uno R3"
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    found = serial_ports()
    assert [port.path for port in found] == sorted(known)
    assert {port.path: port.board for port in found} == {
        p: board for p, (*_, board) in known.items()
    }
    assert SerialPort("/dev/ttyACM3", "Uno R3", "uno") in found
    assert found[-1].description == ""


def test_opening_a_pico_does_not_reset_it(tmp_path: Path, attach: Attach) -> None:
    attach(("/dev/ttyACM0", "pico"), ("/dev/ttyACM1", "uno"))
    by_id = tmp_path / "by-id"
    by_id.symlink_to("/dev/ttyACM0")
    ports = "/dev/ttyACM0", str(by_id), "/dev/pts/7", "/dev/ttyACM1", "/dev/ttyUSB0"
    assert [resets_board(port) for port in ports] == [False, False, False, True, True]


def test_the_latency_timer_of_a_bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    devices = tmp_path / "devices"
    monkeypatch.setattr("ohmskin.link.serial_port.USB_SERIAL", devices)
    (devices / "ttyUSB3").mkdir(parents=True)
    timer = devices / "ttyUSB3" / "latency_timer"
    timer.write_text("16\n")
    by_id = tmp_path / "by-id"
    by_id.symlink_to("/dev/ttyUSB3")
    for port in ("/dev/ttyUSB3", str(by_id)):
        assert latency_timer(port) == (16, str(timer))
    assert latency_timer("/dev/ttyACM0") is None
    timer.write_text("no number")
    assert latency_timer("/dev/ttyUSB3") is None
