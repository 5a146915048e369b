# SPDX-License-Identifier: Apache-2.0
"""When readings are taken and when scans arrive: against the emulated and the simulated board."""

import re
from dataclasses import replace

import numpy as np
import pytest

from lockstep import CPU_HZ, Rig, first_holds
from ohmskin.arrays import Float
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.link.clock import byte_s, line_delay_s, scan_s, slot_s
from ohmskin.link.messages import Hello, Scan
from places import ROOT
from stepped import stepped


@pytest.mark.parametrize(
    ("rows", "columns", "rate_hz"),
    [(8, 8, None), (16, 16, None), (8, 8, 20), (3, 5, 0), (1, 1, None), (1, 1, 1)],
)
def test_slots_and_scans_last_as_the_emulated_board_takes_them(
    rows: int, columns: int, rate_hz: float | None
) -> None:
    slots_s = []

    def sampled(ratio: Float, _start_s: float, slot_s: float, *_: object) -> Float:
        slots_s.append(slot_s)
        return ratio

    still = np.full((rows, columns, 4), 0.5)
    settings = BoardSettings(rows, columns, rate_hz=rate_hz)
    skin = stepped(EmulatedBoard(lambda *_: still, settings, sampled=sampled))
    scan = skin.latest()
    hello = skin.info
    assert slot_s(hello) == slots_s[0]
    last_s = (rows * columns * 4 - 1) * slots_s[0]  # from the scan's first reading to its last
    assert last_s < scan_s(hello, scan) < (hello.scan_cycles + 1) / hello.clock_hz


def test_a_picos_bytes_take_as_long_as_its_firmware_reckons() -> None:
    """It has no serial line, but USB, and says a speed like all boards."""
    header = (ROOT / "firmware" / "pico" / "pico_numbers.h").read_text()
    (cycles,) = re.findall(r"cycles_per_byte\(uint32_t\) { return (\d+); }", header)
    (clock_hz,) = re.findall(r"CLOCK_HZ = (\d+);", header)
    skin = stepped("emulator://8x8")
    board = replace(skin.info, board="pico", baud=500_000)
    assert byte_s(board) == int(cycles) / int(clock_hz)
    assert line_delay_s(skin.latest(), board) < 0.5e-3  # a full block of COBS on a line takes 5 ms


@pytest.mark.simavr
@pytest.mark.parametrize(
    "scan",
    [
        {},
        {"rows": 4, "columns": 4},
        {"rows": 16, "columns": 16, "rate_mhz": 20_000},
        {"rate_mhz": 30_000, "settle_us": 40},
    ],
)
def test_the_line_delay_is_that_of_the_firmware(scan: dict[str, int]) -> None:
    random = np.random.default_rng(1)
    step_s = 25e-6
    with Rig("uno") as rig:
        rig.run(0.3)
        rig.start_scan(**scan)
        board = Hello(**rig.hello())
        numbers, left_s, modelled_s = [], [], []
        while len(left_s) < 22:
            before = len(rig.scans)
            rig.run(step_s)
            if len(rig.scans) > before:
                now_s = rig.sim.stats()["cycles"] / CPU_HZ
                received = rig.scans[-1]
                header = received.header
                numbers.append(header["scan"])
                left_s.append(now_s - step_s / 2)
                found = Scan(received.codes, header["scan"], header["time_us"], 0.0, 0)
                modelled_s.append(scan_s(board, found) + line_delay_s(found, board))
                # Codes with few zeros, and with many.
                rig.sim.set_table(random.random((16, 16, 4)) ** random.integers(1, 9))
        holds = rig.holds()
    took_s = np.array(left_s) - holds["cycle"][first_holds(holds)[numbers]] / CPU_HZ
    error_s = (took_s - modelled_s)[4:]  # at first, hello and acks go before scans
    spread_s = np.ptp(took_s[4:])
    print(f"{scan}: error {1e6 * np.abs(error_s).max():.0f} us of {1e6 * spread_s:.0f} us")
    assert np.abs(error_s).max() < 0.5e-3
    assert spread_s > 1e-3
