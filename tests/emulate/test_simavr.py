# SPDX-License-Identifier: Apache-2.0
"""The simulator's bridge: what it refuses, how it ends, and its pseudo-terminal."""

import os
import select
import struct
import subprocess
import termios
import time
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from avr import ECHO, FOREVER, SENDER, TRANSMITTER, Build, Simulate, sts
from lockstep import LockstepSim
from ohmskin.emulate import simavr
from ohmskin.emulate.simavr import PROGRAM, SimulationError
from ohmskin.errors import DeviceLost
from waiting import until

CRASHES = ["jmp 0x7FF0\n", "sts 0xFFFF, r16\n", "lds r16, 0xF000\n"]
WITHOUT_INTERRUPTS = "cli\n ldi r16, 1\n out 0x33, r16\n sleep\n"


@pytest.mark.parametrize("fatal", [*CRASHES, WITHOUT_INTERRUPTS])
def test_an_end_is_reported_and_stats_still_work(simulate: Simulate, fatal: str) -> None:
    state = "crashed" if fatal in CRASHES else "done"
    sim = simulate(TRANSMITTER + sts(0xC6, 65) + fatal + FOREVER)
    with pytest.raises(SimulationError, match=state):
        sim.run(0.1)
    assert sim.stats()["state"] == state
    assert sim.run_cycles(0) in (b"", b"A")
    with pytest.raises(SimulationError, match=state):
        sim.run_cycles(1)
    sim.reset()
    assert sim.stats()["state"] == "running"


BAD_REQUESTS = {
    "?": [b""],
    "R": [b"\x01", b"\xff" * 8],
    "T": [bytes(16), bytes(16384 + 8), b"\xff" * 16384],  # of no size; not a number
    "O": [b"tau_us=-1", b"tau_us=nan", b"tau_us=1e10", b"tau_us=", b"tau_us", b"tau=1"],
    "C": [
        b"",
        b"\x01" + bytes(40),
        b"\x81" + bytes(3 * 3 * 8),
        b"\x21" + bytes(34 * 34 * 8),
        b"\x01" + b"\xff" * 32,
    ],
    "B": [struct.pack("<I", 7)],
    "L": [b"\x09"],
    "e": [b"\xff\xffx", b"x"],
    "S": [b"x"],
    "J": [b"\x03\x00\x00\x00", b"\x00\x80\x00\x00"],  # odd; beyond the end
}


def test_bad_requests_are_refused(simulate: Simulate) -> None:
    sim = simulate(FOREVER)
    for op, payloads in BAD_REQUESTS.items():
        for payload in payloads:
            with pytest.raises(SimulationError, match=r"^(?!skinsim)"):
                sim.request(op, payload)
    for shape in [(33, 1, 4), (1, 33, 4), (2, 2, 9)]:
        with pytest.raises(ValueError, match="shape"):
            sim.set_table(np.zeros(shape))
    assert sim.stats()["state"] == "running"


@pytest.mark.parametrize(
    ("setting", "wrong"),
    [
        (b"desk=2", "^desk must be 0 or 1$"),
        (b"desk=", "^desk must be 0 or 1$"),
        (b"tau_us=x", "^tau_us must be from 0 to 1e"),
        (b"tau=1", "^no setting 'tau': there are desk, tau_us,"),
    ],
)
def test_a_setting_that_is_refused_is_told_why(
    simulate: Simulate, setting: bytes, wrong: str
) -> None:
    with pytest.raises(SimulationError, match=wrong):
        simulate(FOREVER).request("O", setting)


def test_a_request_that_is_refused_takes_the_replies_of_those_after_it(simulate: Simulate) -> None:
    sim = simulate(FOREVER)
    with pytest.raises(SimulationError, match="tau"):
        sim.requests(("O", b"tau=1"), ("S", b""), ("E", b""))
    assert len(sim.request("E")) == 1024


@pytest.mark.parametrize(
    ("sent", "ops"), [(b"W\xff\xff\xff\xff", b"!"), (b"S\x00", b""), (b"Q" + bytes(4), b"Q")]
)
def test_what_ends_the_simulator(build: Build, sent: bytes, ops: bytes) -> None:
    command = [PROGRAM, "--board", "uno", build("uno", FOREVER)]
    done = subprocess.run(command, input=sent + b"S" + bytes(4), stdout=-1, timeout=10, check=False)
    assert done.stdout[:1] == ops
    assert len(done.stdout[5:]) == sum(done.stdout[1:5])  # one reply, and short


BAD_PINS = {
    "4,12": "--pins has 2 values: there should be 4 or 5 pins of rows and as many",
    "D4,D5,D6,D7,D8,D9,D10,D11,D2,D3,0,1,2,3": "'D4' is no pin: write port and bit, as PD4",
    "PD4,PD5,PD6,PD8,PB0,PB1,PB2,PB3,PD2,PD3,0,1,2,3": "'PD8' is no pin",
    "PD4,PD5,PD6,PD7,PB0,PB1,PB2,PB3,PD2,PD3,0,1,2,9": "'9' is no channel: there are 0 to 7",
}


def test_program_errors(build: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elf = build("uno", FOREVER)
    with pytest.raises(FileNotFoundError, match=r"none\.elf is missing: run 'make firm"):
        LockstepSim("uno", tmp_path / "none.elf")
    with pytest.raises(SimulationError, match="usage"):
        LockstepSim("due", elf)
    (tmp_path / "short.elf").write_bytes(b"no ELF")
    (tmp_path / "long.hex").write_bytes(b":100000000C9434000C945C000C945C000C945C00B4\n" * 99)
    for no_program in (tmp_path / "short.elf", tmp_path / "long.hex", PROGRAM):
        with pytest.raises(SimulationError, match=r"cannot load '.*' as an AVR ELF file"):
            LockstepSim("uno", no_program)
    for pins, wrong in BAD_PINS.items():
        with pytest.raises(SimulationError, match=wrong):
            LockstepSim("uno", elf, pins=pins)
    sim = LockstepSim("uno", elf)
    assert sim.stats()["ref_ohm"] is None  # this program says nothing of its wiring
    sim.close()
    sim.close()
    with pytest.raises(SimulationError, match="closed"):
        sim.run_cycles(1)
    monkeypatch.setattr(simavr, "PROGRAM", tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="none is missing: run 'make sim'"):
        LockstepSim("uno", elf)


def test_pty_echoes_in_real_time_from_power_on(simulate: Simulate) -> None:
    sim = simulate(ECHO.replace("sei();", "sei(); UDR0 = '!';"), pty=True)
    time.sleep(0.05)  # nothing is sent before the port is open
    port = os.open(sim.pty_path, os.O_RDWR | os.O_NOCTTY)
    try:
        termios.tcflush(port, termios.TCIFLUSH)
        sim.power_on()
        assert received(port, 1) == b"!"
        os.write(port, b"hello")
        assert received(port, 5) == b"hello"
        asked_s, before, told_s = time.monotonic(), sim.stats(), time.monotonic()
        time.sleep(0.3)
        least_s, after = time.monotonic() - told_s, sim.stats()
        passed_s = after["simulated_s"] - before["simulated_s"]
        dropped_s = 1e-3 * (after["late_slices"] - before["late_slices"])
        # The simulator may lag by 0.1 s; what it is later than that, it drops and counts.
        assert least_s - 0.12 < passed_s + dropped_s < time.monotonic() - asked_s + 0.12
        with pytest.raises(SimulationError, match="lock-step"):
            sim.run(1)
    finally:
        os.close(port)


def received(port: int, count: int) -> bytes:
    answer = b""
    while len(answer) < count and select.select([port], [], [], 2)[0]:
        answer += os.read(port, 100)
    return answer


def test_pty_without_a_reader_drops_bytes_and_goes_on(simulate: Simulate) -> None:
    fastest = SENDER.replace("FORMAT", "6").replace("UBRR0 = 3", "UBRR0 = 0")  # 200 kB/s
    sim = simulate(fastest, pty=True)
    sim.power_on()
    until(lambda: sim.stats()["pty_dropped"] > 20_000)  # the kernel buffers about 64 kB


@pytest.mark.simavr
@pytest.mark.parametrize(
    ("speed", "settle_us", "ask"),
    [("", 0, "lower rate"), ("&baud=1000000", 0, "lower rate"), ("", 20, "longer settle time")],
)
def test_a_board_whose_converter_is_late_says_so_when_no_scan_comes(
    speed: str, settle_us: int, ask: str
) -> None:
    """A silent board is asked for its hello, whose counter the host says in words.

    At the faster line it was asked at the default speed alone: it heard nothing, then or later.
    """
    said = rf"no scan for 3 s: \d+ conversions late: ask for a {ask}"
    with ohmskin.open(f"simavr://uno?late_cycles=800{speed}") as skin:
        skin.configure(settle_us=settle_us)
        with pytest.raises(DeviceLost, match=said):
            skin.latest(3.0)
        assert skin.info.late > 1000
        skin.stop()
