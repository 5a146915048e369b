# SPDX-License-Identifier: Apache-2.0
"""Boards that say what cannot be, or that do not keep what they say, and a defect of our own."""

import pytest

from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import EmulatorLink, SteppedSkin
from ohmskin.emulate.scenes import Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import DeviceLost, ProtocolError
from ohmskin.link.session import Session
from stepped import stepped, stepped_link

pytestmark = pytest.mark.usefixtures("nothing_left")

IMPOSSIBLE_HELLO = (
    "rows 0, rows 17, rows 255, columns 0, columns 17, rows_max 0, columns_max 33, row_mask 0, "
    "row_mask 256, column_mask 511, whole_mode 4, whole_scan_cycles 4294967295, adc_bits 0, "
    "adc_bits 17, ref_top_ohm 0, ref_bottom_ohm 0, clock_hz 0, scan_cycles 0, scan_cycles 1, "
    "baud 0, scan_cycles 4294967295, slot_cycles 0, slot_cycles 65535, accuracy 7, mode 4"
)


@pytest.mark.parametrize("said", IMPOSSIBLE_HELLO.split(", "))
def test_a_board_that_says_what_cannot_be(said: str) -> None:
    name, value = said.split()
    text = {"scan_cycles 1": "slot_cycles "}
    if name in ("accuracy", "mode", "whole_mode"):
        text[said] = f"{name} unknown_{value}"
    with pytest.raises(ProtocolError, match=f"hello says {text.get(said, said)}"):
        stepped(EmulatedBoard(Scene().ratio, BoardSettings(), says={name: int(value)}))


def test_a_board_that_says_what_cannot_be_while_it_scans() -> None:
    link = stepped_link("emulator://4x4?rate=100")
    with SteppedSkin(link) as skin:
        scans = iter(skin)
        link.board.says["scan_cycles"] = 0
        link.board.reset()
        with pytest.raises(ProtocolError, match="hello says scan_cycles 0"):
            list(scans)


def test_a_board_that_never_scans_as_told() -> None:
    says = {"rate_asked_mhz": 1000}
    with stepped(EmulatedBoard(Scene().ratio, BoardSettings(), says=says)) as skin:
        skin.configure(rate_hz=30)
        with pytest.raises(DeviceLost, match="does not keep how it was told to scan"):
            skin.latest()


def test_scans_of_another_size_than_hello_says() -> None:
    says = {"rows": 4, "row_mask": 15, "scan_cycles": 400_000}
    with (
        stepped(EmulatedBoard(Scene().ratio, BoardSettings(2, 4), says=says)) as skin,
        pytest.raises(ProtocolError, match="hello says 4x4 cells, its scans have 2x4"),
    ):
        skin.latest()


def test_a_defect_in_the_reading_thread_is_told_to_who_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = EmulatorLink(emulated("emulator://4x4")[0])
    with Session(link) as skin:
        scans = iter(skin)
        monkeypatch.setattr(link, "read", lambda: 1 // 0)
        with pytest.raises(DeviceLost, match=r"defect of this program.*ZeroDivisionError") as lost:
            list(scans)
        assert isinstance(lost.value.__cause__, ZeroDivisionError)
