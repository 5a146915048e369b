# SPDX-License-Identifier: Apache-2.0
"""`ohmskin flash pico`: which drive it copies to, and how it knows that it worked."""

from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

import ohmskin
from command_line import Run, assert_one_line, well
from ohmskin.cli import board as flash_command
from ohmskin.cli import pico
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.scenes import Scene
from ports import USB_IDS, Serve

# As the chip's ROM has it (RP2040's data sheet, 2.8.4.2).
INFO = "UF2 Bootloader v3.0\r\nModel: Raspberry Pi RP2\r\nBoard-ID: RPI-RP2\r\n"
FIRMWARE = bytes(range(256)) * 8


@pytest.fixture
def media(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where drives appear; a wheel's firmware is there."""
    (tmp_path / "pico.uf2").write_bytes(FIRMWARE)
    monkeypatch.setattr(flash_command, "_ROOT", tmp_path)
    monkeypatch.setattr(flash_command, "_FIRMWARE", tmp_path)
    monkeypatch.setattr(pico, "_PLACES", (f"{tmp_path}/media/*",))
    monkeypatch.setattr(pico, "APPEARS_S", 0.0)
    return tmp_path / "media"


def drive(media: Path, name: str, info: str = INFO) -> Path:
    place = media / name
    place.mkdir(parents=True)
    (place / "INFO_UF2.TXT").write_text(info)
    return place


def appear(monkeypatch: pytest.MonkeyPatch, *ports: tuple[str, str]) -> None:
    found = [ListPortInfo(path, skip_link_detection=True) for path, _ in ports]
    for port, (_, board) in zip(found, ports, strict=True):
        port.vid, port.pid = USB_IDS[board]
    monkeypatch.setattr(list_ports, "comports", lambda: found)


@pytest.mark.parametrize("is_named", [False, True])
def test_it_copies_and_hears_from_the_board(
    is_named: bool, media: Path, run: Run, pty_board: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = drive(media, "RPI-RP2")
    drive(media, "stick", "a stick of another kind")
    port = pty_board(EmulatedBoard(Scene().ratio, BoardSettings())).path
    appear(monkeypatch, ("/dev/ttyS0", ""), (port, "pico"))
    done = well(run("flash", "pico", *(["--port", str(place)] if is_named else [])))
    assert (place / "pico.uf2").read_bytes() == FIRMWARE
    assert f"copied to {place}" in done.out
    assert f"{port}: pico, firmware {ohmskin.__version__}, answers" in done.out


@pytest.mark.parametrize("names", [[], ["RPI-RP2", "RPI-RP21"]])
def test_no_drive_or_two_are_asked_about(names: list[str], media: Path, run: Run) -> None:
    places = [drive(media, name) for name in names]
    drive(media, "stick", "a stick of another kind")
    words = (f"{len(names) or 'no'} Picos", "BOOTSEL", "--port DRIVE")
    assert_one_line(run("flash", "pico"), *words)
    assert [sorted(path.name for path in place.iterdir()) for place in places] == [
        ["INFO_UF2.TXT"] for _ in names
    ]


def test_a_drive_that_is_named_is_a_picos_or_refused(media: Path, run: Run) -> None:
    other = drive(media, "stick", "a stick of another kind")
    assert_one_line(run("flash", "pico", "--port", str(other)), "no Picos")
    assert not (other / "pico.uf2").exists()


def test_a_board_that_does_not_come_back_is_said(
    media: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive(media, "RPI-RP2")
    appear(monkeypatch, ("/dev/ttyS0", ""))
    done = run("flash", "pico")
    assert done.code == 2
    assert "no ports are those of a Pico" in done.err


def test_a_package_without_the_firmware_says_so(media: Path, run: Run) -> None:
    (media.parent / "pico.uf2").unlink()
    assert_one_line(run("flash", "pico"), "pico.uf2 is missing", "make pico")
