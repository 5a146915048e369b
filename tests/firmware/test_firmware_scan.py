# SPDX-License-Identifier: Apache-2.0
"""Scans of the built firmware: codes, order, time, settling; under load; after a hang."""

import math
import subprocess
from typing import Any

import numpy as np
import pytest

from firmware_helpers import CYCLES_PER_US, assert_whole, go_fast, numbers, reset
from lockstep import CPU_HZ, DEFAULT_SCAN, READINGS, TABLE_SHAPE, Rig, elf_of
from ohmskin.link import protocol

pytestmark = pytest.mark.simavr


# The interrupt begins and ends within so many cycles after a hold; no slot is as short.
MOST_INTERRUPT_CYCLES = 400
# Slots of 15 ADC clocks.
HIGHEST = {"rate_mhz": 0, "settle_us": 1}
SCANS = [
    {},
    {"rate_mhz": 900_000, "rows": 1, "columns": 1},
    {"rate_mhz": 380_000, "rows": 3, "columns": 5},
    {"rate_mhz": 30_000, "rows": 16, "columns": 16},
    {"rate_mhz": 300_000, "rows": 16, "columns": 1, "settle_us": 25},
    {"rate_mhz": 300_000, "rows": 1, "columns": 16, "settle_us": 20},
    {"rate_mhz": 0, "settle_us": 40},
    {"rate_mhz": 60_000, "accuracy": "fine"},
    {"rate_mhz": 0, "accuracy": "fine"},
    {"rate_mhz": 30_000, "accuracy": "finest"},
    {"rate_mhz": 0, "accuracy": "finest", "settle_us": 200},
    {"rate_mhz": 7_000, "rows": 2, "columns": 2, "settle_us": 3000},
    {"rate_mhz": 1_000, "rows": 16, "columns": 16, "accuracy": "finest"},
    {"mode": "far"},
    {"mode": "far", "rate_mhz": 0},
    {"mode": "far", "rate_mhz": 380_000, "rows": 3, "columns": 5},
    {"mode": "far", "rate_mhz": 30_000, "rows": 16, "columns": 16},
    {"mode": "half", "rate_mhz": 0},
    {"mode": "half", "rate_mhz": 45_000, "rows": 16, "columns": 16},
    {"mode": "half", "rate_mhz": 700_000, "rows": 3, "columns": 1},
    {"mode": "quick", "rate_mhz": 0},
    {"mode": "quick", "rate_mhz": 350_000, "settle_us": 20},
    {"mode": "quick", "rate_mhz": 90_000, "rows": 16, "columns": 16},
    {"mode": "quick", "rate_mhz": 500_000, "rows": 5, "columns": 1},
]


def scan_name(scan: dict[str, Any]) -> str:
    return "-".join(str(v) for v in (DEFAULT_SCAN | scan).values())


@pytest.mark.parametrize("scan", SCANS, ids=scan_name)
def test_codes_order_time_and_settling_are_exact(
    rig: Rig, rng: np.random.Generator, scan: dict[str, Any]
) -> None:
    rig.start_scan(**scan)
    hello = rig.hello()
    rig.sim.reset_stats()
    for _ in range(4):
        rig.run_cycles(max(hello["scan_cycles"], round(0.01 * CPU_HZ)))
        rig.randomize(rng)
    stats = rig.sim.stats()  # before `stop`, which lets the pins go
    rig.must("stop", limit_s=2.5)
    assert_whole(rig)
    assert len(rig.scans) >= 4
    shape = (hello["rows"], hello["columns"], len(protocol.MODES[hello["mode"]]))
    assert {s.codes.shape for s in rig.scans} == {shape}

    starts = rig.check().start_cycles[: len(rig.scans)]
    jitter = rig.sim.jitter_cycles
    np.testing.assert_allclose(np.diff(starts), hello["scan_cycles"], atol=jitter, rtol=0)
    slots = np.diff(rig.holds()["cycle"].astype(np.int64))
    np.testing.assert_allclose(slots, hello["slot_cycles"], atol=jitter, rtol=0)
    if hello["rate_asked_mhz"]:
        asked = CPU_HZ * 1000 / hello["rate_asked_mhz"]
        assert hello["scan_cycles"] == pytest.approx(asked, rel=1e-3)
    times = np.array([s.header["time_us"] for s in rig.scans])
    since_start = (starts - starts[0]) / CYCLES_PER_US
    assert np.abs(times - times[0] - since_start).max() <= 1

    assert hello["settle_us"] >= hello["settle_asked_us"]
    for settled in ("settle_cycles_min", "channel_settle_cycles_min"):
        assert stats[settled] >= hello["settle_us"] * CYCLES_PER_US
    faults = ("lost_results", "undriven", "reference_not_avcc", "changed_while_converting")
    assert [stats.get(fault, 0) for fault in faults] == [0] * 4


def test_scan_starts_do_not_jitter(rig: Rig) -> None:
    rig.start_scan()
    period = rig.hello()["scan_cycles"]
    for command in ("get_hello", "save", "start", "get_hello") * 6:
        rig.send(command)
        rig.run(0.0413)
    rig.must("stop")
    starts = rig.check().start_cycles
    assert len(starts) > 80
    deviation_us = np.abs(starts - starts[0] - period * np.arange(len(starts))) / CYCLES_PER_US
    assert deviation_us.max() <= 2
    assert CPU_HZ / period == pytest.approx(90, abs=0.05)
    assert_whole(rig)


@pytest.mark.parametrize("scan", [{}, HIGHEST])
def test_settle_time_is_kept_while_commands_arrive(rig: Rig, scan: dict[str, int]) -> None:
    go_fast(rig)
    rig.start_scan(**scan)
    hello = rig.hello()
    rig.sim.reset_stats()
    for _ in range(100):
        rig.send("get_hello")
        rig.run(0.00613)
    assert rig.sim.stats()["settle_cycles_min"] >= hello["settle_us"] * CYCLES_PER_US


def test_board_clock_runs_on_between_scans(rig: Rig) -> None:
    """The time of the first scan follows the simulator's clock, to the clock's 4 us."""
    ahead_us = []
    for rows, rate_mhz in (8, 90_000), (1, 90_000), (1, 50_000), (2, 7_000), (8, 90_000):
        rig.run(0.0123 * rows)
        rig.start_scan(rows=rows, columns=rows, rate_mhz=rate_mhz)
        rig.run(0.1)
        rig.must("stop")
        start = rig.check().start_cycles[0]
        ahead_us.append(rig.scans[0].header["time_us"] - start / CYCLES_PER_US)
    assert max(ahead_us) - min(ahead_us) <= 5


def test_stop_ends_with_a_whole_scan_and_its_ack(rig: Rig) -> None:
    for pause_s in (0.0, 0.0002, 0.0031, 0.0111, 0.0207):
        rig.start_scan()
        rig.run(pause_s)
        rig.must("stop")
        if rig.scans:
            assert [name for name, _ in rig.log[-2:]] == ["scan", "ack"]
            assert_whole(rig)
        rig.run(0.05)
        assert rig.log[-1][0] == "ack"
        assert rig.sim.stats()["state"] == "running"
        holds = len(rig.holds())
        rig.run(0.01)
        assert len(rig.holds()) == holds  # the converter rests


def test_start_and_stop_at_random_phases_damage_nothing(rig: Rig, rng: np.random.Generator) -> None:
    for _ in range(40):
        scan: dict[str, Any] = {
            "rows": int(rng.integers(3, 9)),
            "columns": int(rng.integers(3, 9)),
            "rate_mhz": int(rng.choice([0, 60_000, 90_000])),
            "settle_us": int(rng.choice([0, 0, 15])),
        }
        rig.start_scan(**scan)
        rig.run_cycles(int(rng.integers(300_000)))
        rig.randomize(rng)
        rig.run_cycles(int(rng.integers(100_000)))
        rig.must("stop")
        assert rig.damaged == 0, scan
        assert rig.check().wrong == 0, scan
        assert numbers(rig) == sorted(set(numbers(rig)))
        if rig.scans:
            assert rig.scans[0].header["dropped"] == rig.scans[0].header["scan"]


LOADS = [
    ((8, 8), 0),
    ((16, 16), 0),
    ((12, 12), 0),
    ((16, 10), 0),
    ((5, 3), 0),
    ((2, 2), 0),
    ((16, 16), protocol.CONSTANTS["rate_mhz_max"]),
    ((8, 8), protocol.CONSTANTS["rate_mhz_max"]),
    ((10, 10), protocol.CONSTANTS["rate_mhz_max"]),
    ((2, 2), protocol.CONSTANTS["rate_mhz_max"]),
]


@pytest.mark.parametrize("ratio", [None, 0.0, 0.9999], ids=["random", "zeros", "ones"])
def test_no_load_damages_a_frame(rig: Rig, ratio: float | None) -> None:
    """At 500 kbaud, as fast as line and chip carry; zeros and ones are COBS's extremes."""
    if ratio is not None:
        code = int(ratio * (1 << rig.sim.adc_bits))
        rig.set_codes(np.full(TABLE_SHAPE, code, np.uint16), np.random.default_rng(0))
    for (rows, columns), rate_mhz in LOADS:
        scan = DEFAULT_SCAN | {"rows": rows, "columns": columns, "settle_us": int(not rate_mhz)}
        refused = rig.command("configure", **(scan | {"rate_mhz": rate_mhz}))
        if rate_mhz:  # each is more than can be carried, and is answered by what can be
            assert refused in ("line_too_slow", "too_fast")
            rate_mhz = rig.frames("ack")[-1]["rate_mhz"]
        rig.start_scan(**(scan | {"rate_mhz": rate_mhz}))
        rig.run(0.15)
        rig.must("stop")
        assert rig.damaged == 0, (rows, columns, rate_mhz)
        assert rig.scans
        assert rig.check().wrong == 0
        assert numbers(rig) == list(range(len(rig.scans)))


@pytest.mark.parametrize("mode", ["near", "far"])
def test_settle_time_before_each_hold(rig: Rig, mode: str) -> None:
    """Pins change before every other reading, a slot earlier for the rest; not in idle slots."""
    rig.start_scan(mode=mode)
    slots_per_scan = 258
    slot_cycles = rig.hello()["scan_cycles"] // slots_per_scan
    rig.sim.reset_stats()
    rig.run(0.2)
    log = rig.holds()[-10 * slots_per_scan :]
    slots, since_change = np.divmod(log["settle_cycles"].astype(np.int64), slot_cycles)
    assert 0 <= since_change.min() - rig.sim.stats()["settle_cycles_min"] <= 8
    assert np.ptp(since_change) <= 8  # the longest instruction that an interrupt waits for
    first_cell = (log["row"] == 0) & (log["column"] == 0)
    within = ~first_cell
    order = [READINGS.index(name) for name in protocol.MODES[mode]]
    second = np.isin(log["configuration"], order[1::2])
    np.testing.assert_array_equal(slots[within], second[within])
    # The idle slots already stand at the first reading of the next scan.
    assert set(slots[first_cell]) == {0, 1, 2, 3}


@pytest.mark.parametrize(("accuracy", "adc_clock"), [("usual", 32), ("fine", 64), ("finest", 128)])
def test_pins_change_after_the_hold_and_not_before(rig: Rig, accuracy: str, adc_clock: int) -> None:
    """The data sheet leaves half an ADC clock open, and the compiler decides how soon it is.

    What is later by more is taken from the time to settle.
    """
    rig.start_scan(rate_mhz=0, accuracy=accuracy)
    rig.sim.reset_stats()
    rig.run(0.1)
    spare = rig.sim.stats()["change_after_hold_cycles_min"] - adc_clock // 2
    print(f"{rig.board}, {accuracy}: {spare} cycles to spare (PINS_SPARE in board_avr.cpp)")
    assert 0 <= spare <= 12


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 1), (3, 1), (4, 3)])
def test_small_scans_at_the_highest_rate_are_dropped_whole_and_carry_their_own_number(
    rig: Rig, rng: np.random.Generator, rows: int, columns: int
) -> None:
    """Answers take most of the line; a share of the scans still arrives."""
    rig.start_scan(**HIGHEST, rows=rows, columns=columns)
    for asked in range(600):
        if asked % 3 == 0:
            rig.send("get_hello")
        rig.run_cycles(int(rng.integers(1000, 5000)))
        rig.randomize(rng)
    rig.run(0.05)
    rig.must("stop")
    assert rig.damaged == 0
    check = rig.check()
    assert check.wrong == 0  # a scan with another's number has another skin's codes
    missing = [scan.header["scan"] - i for i, scan in enumerate(rig.scans)]
    assert missing == [scan.header["dropped"] for scan in rig.scans]
    assert missing[-1] > 3
    assert len(rig.scans) > 0.2 * len(check.start_cycles)


def test_commands_back_to_back_at_the_highest_rate(rig: Rig, rng: np.random.Generator) -> None:
    commands = ("get_hello", "start", "get_hello", "start")
    go_fast(rig)
    rig.start_scan(**HIGHEST)
    for _ in range(40):
        before = len(rig.frames("ack"))
        rig.sim.write(b"".join(rig.encode(name) for name in commands))
        rig.run(0.03)
        answers = rig.frames("ack")[before:]
        assert [a["command"] for a in answers] == [protocol.FRAMES[c].id for c in commands]
        assert {a["result"] for a in answers} == {"ok"}
        rig.run_cycles(int(rng.integers(100_000)))
        rig.randomize(rng)
    rig.must("stop")
    check = rig.check()
    assert check.wrong == 0
    assert check.readings > 30_000
    assert rig.sim.stats().get("rx_overruns", 0) == 0
    assert rig.scans[-1].header["rx_errors"] == 0


def test_commands_that_wait_for_the_same_event_are_all_answered(rig: Rig) -> None:
    rig.start_scan()
    rig.run(0.03)
    before = len(rig.frames("ack"))
    rig.sim.write(b"".join(rig.encode(name) for name in ("stop", "save", "stop", "save")))
    rig.run(0.2)
    answers = [
        (protocol.FRAMES_BY_ID[ack["command"]].name, ack["result"])
        for ack in rig.frames("ack")[before:]
    ]
    assert sorted(answers) == [("save", "busy"), ("save", "ok"), ("stop", "ok"), ("stop", "ok")]


def test_more_commands_than_can_wait_do_not_silence_the_board(rig: Rig) -> None:
    for _ in range(5):
        rig.start_scan()
        rig.run(0.0301)
        names = ("get_hello", "get_hello", "get_hello", "get_hello", "stop")
        rig.sim.write(b"".join(rig.encode(name) for name in names))
        rig.run(0.1)
        assert rig.command("stop") == "ok"
        assert rig.hello()["scanning"] == 0


@pytest.mark.parametrize("command", ["start", "get_hello", "save"])
def test_a_command_at_the_highest_rate_loses_no_scan(
    rig: Rig, rng: np.random.Generator, command: str
) -> None:
    go_fast(rig)
    rig.start_scan(**HIGHEST)
    for unit_id in range(40):
        rig.must("set_unit_id", unit_id=unit_id * 0x01010101)
        rig.must(command)
        rig.run_cycles(int(rng.integers(200_000)))
    rig.must("stop")
    assert_whole(rig)


@pytest.mark.parametrize("cells", [(8, 8), (16, 16)])
def test_the_fast_line_carries_every_scan(
    rig: Rig, rng: np.random.Generator, cells: tuple[int, int]
) -> None:
    go_fast(rig)
    rig.start_scan(**HIGHEST, rows=cells[0], columns=cells[1])
    for _ in range(10):
        rig.run(0.07)
        rig.randomize(rng)
    rig.must("stop")
    assert_whole(rig)
    assert rig.check().readings > 0.69 * 33_000


def test_random_bytes_change_nothing(rig: Rig, rng: np.random.Generator) -> None:
    before = rig.hello()
    resets = rig.sim.stats()["resets"]
    for _ in range(10):
        rig.sim.write(rng.bytes(7000))
        rig.run(0.145)
    rig.sim.write(protocol.DELIMITER)
    assert rig.hello() == before
    rig.start_scan()
    for _ in range(6):
        rig.sim.write(rng.bytes(5000))
        rig.run(0.105)
        rig.randomize(rng)
    rig.sim.write(protocol.DELIMITER)
    rig.must("stop")
    assert rig.hello() == before
    assert rig.check().wrong == 0
    assert rig.scans[-1].header["rx_errors"] > 300
    assert rig.sim.stats()["resets"] == resets
    assert len(rig.frames("hello")) == 4  # at boot, and the three asked for
    assert rig.damaged == 0


def interrupts_of(board: str) -> list[int]:
    """Vectors of the built firmware that lead somewhere else than an unused one."""
    command = ["avr-objcopy", "-O", "binary", "-j", ".text", str(elf_of(board)), "/dev/stdout"]
    code = subprocess.run(command, check=True, capture_output=True).stdout
    vectors = {"uno": 26, "megaatmega2560": 57}[board]
    jumps = np.frombuffer(code[: 4 * vectors], "<u2").reshape(vectors, 2)  # jmp and its address
    assert set(jumps[:, 0]) == {0x940C}
    targets, counts = np.unique(jumps[:, 1], return_counts=True)
    return [n for n in range(1, vectors) if jumps[n, 1] != targets[counts.argmax()]]


def test_the_firmware_has_no_interrupt_but_its_own(rig: Rig) -> None:
    """The Arduino core's would make that of the slots late, and takes flash."""
    watchdog, slots, received = {"uno": (6, 11, 18), "megaatmega2560": (12, 17, 25)}[rig.board]
    assert interrupts_of(rig.board) == [watchdog, slots, received]


def address_of(board: str, symbol: str) -> int:
    listing = subprocess.check_output(["avr-nm", elf_of(board)], text=True)
    return {line.split()[-1]: int(line.split()[0], 16) for line in listing.splitlines()}[symbol]


@pytest.mark.parametrize("hang", ["__stop_program", "_exit"])  # `rjmp .`, and `cli` before it
@pytest.mark.parametrize("scanning", [False, True])
def test_watchdog_restarts_a_hung_main_loop(rig: Rig, scanning: bool, hang: str) -> None:
    """Its first time-out is an interrupt; where that cannot come, the second is a reset."""
    if scanning:
        rig.start_scan()
        rig.run(0.1)
        # On to where the interrupt after a hold is over: a jump out of it would leave them off.
        *_, before, last = rig.holds()["cycle"].astype(int)
        over = last + MOST_INTERRUPT_CYCLES - int(rig.sim.stats()["cycles"])
        rig.run_cycles(int(over % (last - before)))
    hellos, resets = len(rig.frames("hello")), rig.sim.stats()["resets"]
    rig.sim.jump(address_of(rig.board, hang))
    rig.run(0.2 if hang == "__stop_program" else 0.45)
    assert len(rig.frames("hello")) == hellos
    rig.run(0.1)
    assert rig.sim.stats()["resets"] == resets + (hang == "_exit")
    assert rig.log[-1][0] == "hello"
    hello = rig.log[-1][1]
    assert (hello["reset_cause"], hello["scanning"]) == (("watchdog",), 0)
    rig.start_scan()
    rig.run(0.5)  # and it does not come again
    rig.must("stop")
    assert numbers(rig) == list(range(len(rig.scans)))
    assert reset(rig)["reset_cause"] == ("external",)


RC_RATIO = (0.9, 0.1, 0.8, 0.3)  # of even rows
OTHER_RATIO = (0.6, 0.4, 0.5, 0.45)  # of odd rows


def readings_with_time_constant(rig: Rig, tau_us: float, **scan: Any) -> tuple[np.ndarray, dict]:
    """Codes (n, 4) of cells of even rows, and counters; all rows of a kind are the same."""
    table = np.tile(OTHER_RATIO, (16, 16, 1))
    table[::2] = RC_RATIO
    rig.sim.set_table(table)
    rig.sim.set(tau_us=tau_us)
    rig.start_scan(**scan)
    rig.run(0.02)
    rig.sim.reset_stats()
    rig.run(0.1)
    stats = rig.sim.stats()
    codes = np.stack([scan.codes[2::2] for scan in rig.scans[1:]])
    rig.must("stop")  # its bytes may make one slot's interrupt late
    return codes.reshape(-1, 4).astype(int), stats


@pytest.mark.parametrize("tau_us", [1.0, 3.0, 5.0])
def test_nodes_of_a_few_us_settle_within_a_code_at_90_hz(rig: Rig, tau_us: float) -> None:
    codes, _ = readings_with_time_constant(rig, tau_us)
    assert np.abs(codes - np.floor(np.array(RC_RATIO) * 1024)).max() <= 1


@pytest.mark.parametrize("tau_us", [6.0, 10.0])
def test_a_shortfall_is_that_of_the_settle_time(rig: Rig, tau_us: float) -> None:
    go_fast(rig)
    codes, stats = readings_with_time_constant(rig, tau_us, rate_mhz=130_000)
    slot = stats["trigger_gap_cycles_min"]
    # A and C come right after a change of row; B and D one slot later, of the other node. Each node
    # swings between the values of two rows, both for two slots.
    shortest = stats["settle_cycles_min"]
    longest = stats["settle_cycles_max"] - slot
    swing = 1 / (1 + math.exp(-2 * slot / CYCLES_PER_US / tau_us))
    for reading, (target, before) in enumerate(zip(RC_RATIO, OTHER_RATIO, strict=True)):
        later = reading % 2 * slot
        expected = [
            1024 * (target + (before - target) * swing * math.exp(-s / CYCLES_PER_US / tau_us))
            for s in (shortest + later, longest + later)
        ]
        seen = codes[:, reading]
        assert seen.min() >= math.floor(min(expected)) - 1
        assert seen.max() <= math.floor(max(expected)) + 1
        if later == 0:
            assert np.abs(seen - 1024 * target).min() > 2  # there is a shortfall to be explained
