# SPDX-License-Identifier: Apache-2.0
"""The simulator and its bridge, against small programs and numbers from the data sheet.

Assembler programs start at the reset vector, so that the cycle of each of their instructions is
known: comments give the cycle at which an instruction takes effect.
"""

import math
import os
import select
import shutil
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from lockstep import CPU_HZ, LockstepSim
from ohmskin.emulate import simavr
from ohmskin.emulate.simavr import PROGRAM, SimulationError
from ohmskin.link import session
from waiting import until

pytestmark = pytest.mark.skipif(
    shutil.which("avr-gcc") is None or not PROGRAM.exists(),
    reason="needs avr-gcc and 'make -C firmware/sim'",
)

MCU = {"uno": "atmega328p", "megaatmega2560": "atmega2560"}
BOARDS = pytest.mark.parametrize("board", list(MCU))

ADCSRA, ADCSRB, ADMUX = 0x7A, 0x7B, 0x7C
TCCR1A, TCCR1B, ICR1, OCR1A, OCR1B, TIMSK1 = 0x80, 0x81, 0x86, 0x88, 0x8A, 0x6F
PORF, EXTRF, WDRF = 0x01, 0x02, 0x08
DOR0, FE0, RXC0 = 0x08, 0x10, 0x80
ENTRY_AND_RETI_CYCLES = {"uno": 8, "megaatmega2560": 10}

Build = Callable[[str, str], Path]
Simulate = Callable[..., LockstepSim]


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Compile C, or assembler without start-up code, once per program and board."""
    folder = tmp_path_factory.mktemp("firmware")

    @cache
    def compile_for(board: str, source: str) -> Path:
        stem = folder / f"f{len(list(folder.iterdir()))}"
        assembler = "int main" not in source
        path = stem.with_suffix(".S" if assembler else ".c")
        path.write_text(source if assembler else C + source)
        options = ["-nostartfiles", "-nostdlib"] if assembler else ["-std=gnu99"]
        command = ["avr-gcc", f"-mmcu={MCU[board]}", "-DF_CPU=16000000UL", "-Os", *options]
        subprocess.run([*command, "-o", stem.with_suffix(".elf"), path], check=True)
        return stem.with_suffix(".elf")

    return compile_for


@pytest.fixture
def simulate(build: Build) -> Iterator[Simulate]:
    """A function that simulates a board with a program."""
    with ExitStack() as stack:

        def start(source: str, board: str = "uno", **options: Any) -> LockstepSim:
            return stack.enter_context(LockstepSim(board, build(board, source), **options))

        yield start


def sts(address: int, value: int) -> str:
    """Three cycles, the store takes effect at the end of the third."""
    return f"ldi r16, {value}\n sts {address}, r16\n"


def sts_word(address: int, value: int) -> str:
    """Six cycles; high byte first, as 16-bit registers want it."""
    return sts(address + 1, value >> 8) + sts(address, value & 0xFF)


FOREVER = "1: rjmp 1b\n"
CLEAR_OCF1B_FOREVER = "1: sbi 0x16, 2\n rjmp 1b\n"
# The ADC runs freely and holds at 470, 886, ...; at 9.
FREE_RUNNING = sts(ADMUX, 0x40) + sts(ADCSRA, 0xA5) + sts(ADCSRA, 0xE5)
# The transmitter at 500 kbaud; at 6.
TRANSMITTER = sts(0xC0, 2) + sts(0xC1, 8)

# Begin of all C programs: two functions to send with.
C = """
#include <avr/io.h>
#include <util/delay.h>
static void send(uint8_t b) { while (!(UCSR0A & 0x20)) {} UDR0 = b; }
static void transmitter(void) { UCSR0A = 2; UBRR0L = 3; UCSR0B = 8; }
"""


def triggered(top: int, compare: int, adps: int = 5) -> str:
    """Timer 1 counts to `top` and triggers the ADC at `compare`; it runs from 24 on."""
    adc = sts(ADMUX, 0x40) + sts(ADCSRB, 5) + sts(ADCSRA, 0xA0 | adps)
    return adc + sts_word(ICR1, top) + sts_word(OCR1B, compare) + sts(TCCR1B, 0x19)


def hold_log(sim: LockstepSim, cycles: int) -> np.ndarray:
    sim.hold_log(True)
    sim.run_cycles(cycles)
    return sim.drain_hold_log()


def hold_cycles(sim: LockstepSim, cycles: int) -> list[int]:
    return [int(cycle) for cycle in hold_log(sim, cycles)["cycle"]]


# ---- ADC ---------------------------------------------------------------------------------------


@BOARDS
@pytest.mark.parametrize("adps", [1, 2, 3, 4, 5, 6, 7])
def test_free_running_holds_and_period(simulate: Simulate, board: str, adps: int) -> None:
    program = sts(ADMUX, 0x40) + sts(ADCSRA, 0xA0 | adps) + sts(ADCSRA, 0xE0 | adps) + FOREVER
    clock = 1 << adps
    start = 6 + clock * (3 // clock + 1)  # ADEN at 6, ADSC at 9: the next ADC clock edge
    end_of_first = start + 25 * clock
    expected = [start + int(13.5 * clock)]
    expected += [end_of_first + int(1.5 * clock) + 13 * clock * i for i in range(9)]
    sim = simulate(program, board)
    assert hold_cycles(sim, 200 * clock)[:10] == expected
    assert sim.stats()["trigger_gap_cycles_max"] == 25 * clock


def test_single_conversion_takes_13_clocks_from_the_next_edge(simulate: Simulate) -> None:
    program = sts(ADMUX, 0x40) + sts(ADCSRA, 0x85) + sts(ADCSRA, 0xC5)
    # ADEN at 6; the first conversion starts at 38 and ends at 838
    program += "1: lds r17, 0x7A\n sbrc r17, 6\n rjmp 1b\n" + sts(ADCSRA, 0xC5) + FOREVER
    holds = hold_cycles(simulate(program), 3000)
    # The loop reads the cleared ADSC within 6 cycles of 838 and restarts before the edge at 870.
    assert holds == [38 + 432, 870 + 48]


@BOARDS
@pytest.mark.parametrize("compare", [0, 10, 693])
def test_timer_triggered_hold_is_67_cycles_after_the_match(
    simulate: Simulate, board: str, compare: int
) -> None:
    matches = [24 + compare + 1 + 694 * i for i in range(12)]
    # The first conversion takes 3 + 800 cycles: it swallows the second match.
    expected = [matches[0] + 3 + 432] + [match + 3 + 64 for match in matches[2:]]
    sim = simulate(triggered(693, compare) + CLEAR_OCF1B_FOREVER, board)
    assert hold_cycles(sim, 694 * 14)[:11] == expected


def test_what_does_not_trigger(simulate: Simulate) -> None:
    """A trigger during a conversion, and one for which OCF1B has not been cleared."""
    holds = hold_cycles(simulate(triggered(399, 399) + CLEAR_OCF1B_FOREVER), 40_000)
    assert set(np.diff(holds[1:])) == {800}  # 3 + 432 cycles do not fit into 400
    assert len(hold_cycles(simulate(triggered(693, 10) + FOREVER), 100_000)) == 1


@pytest.mark.parametrize(("late", "gap"), [(0, 437), (1, 437), (2, 874), (32, 874)])
def test_late_conversions_swallow_the_next_trigger(simulate: Simulate, late: int, gap: int) -> None:
    """Slots of 143 scans/s: 437 cycles, of which a conversion takes 3 + 13.5 * 32 = 435."""
    triggers = triggered(436, 10) + CLEAR_OCF1B_FOREVER
    for program, gaps in ((triggers, gap), (FREE_RUNNING + FOREVER, 13 * 32 + late)):
        sim = simulate(program)
        sim.set(late_cycles=late)
        assert set(np.diff(hold_cycles(sim, 40_000)[1:])) == {gaps}


def test_a_million_timer_periods_are_exact(simulate: Simulate) -> None:
    sim = simulate(triggered(99, 10, adps=1) + CLEAR_OCF1B_FOREVER)
    sim.run_cycles(1000)
    sim.reset_stats()
    sim.run_cycles(100_000_000)
    stats = sim.stats()
    assert (stats["trigger_gap_cycles_min"], stats["trigger_gap_cycles_max"]) == (100, 100)
    assert stats["conversions"] == 1_000_000


def test_data_register_is_locked_between_adcl_and_adch(simulate: Simulate) -> None:
    program = """
    int main(void) {
        DDRB = 15; DDRD = 0xFC; PORTD = 4;
        transmitter();
        ADMUX = 0x40; ADCSRA = 0xE3;
        _delay_us(50);
        uint8_t low = ADCL;
        PORTD = 4 | 16;
        _delay_us(100);
        send(low); send(ADCH);
        _delay_us(50);
        ADMUX |= 0x20;
        low = ADCL;
        send(low); send(ADCH);
        for (;;) {}
    }"""
    table = np.zeros((2, 1, 4))
    table[0, 0, 0], table[1, 0, 0] = 0x155 / 1024, 0x2AA / 1024
    sim = simulate(program)
    sim.set_table(table)
    sent = sim.run(0.01)
    assert sim.stats()["lost_results"] > 10
    assert struct.unpack("<2H", sent) == (0x155, 0x2AA << 6)


SCAN = """
#ifdef __AVR_ATmega2560__
#define SELECT(r, c, top) (PORTA = (r), PORTC = (c), PORTL = (top) ? 1 : 2)
#define OUTPUTS() (DDRA = 15, DDRC = 15, DDRL = 3)
#else
#define SELECT(r, c, top) (PORTB = (c), PORTD = (r) << 4 | ((top) ? 4 : 8))
#define OUTPUTS() (DDRB = 15, DDRD = 0xFC)
#endif
int main(void) {
    OUTPUTS();
    transmitter();
    ADCSRA = 0x82;
    for (uint8_t c = 0; c < 16; c++)
        for (uint8_t r = 0; r < 16; r++)
            for (uint8_t k = 0; k < 4; k++) {
                SELECT(r, c, k < 2);
                ADMUX = 0x40 | (k == 1 || k == 2);
                ADCSRA |= 0x40;
                while (ADCSRA & 0x40) {}
                uint16_t code = ADC;
                send(code); send(code >> 8);
            }
    for (;;) {}
}
"""


@BOARDS
def test_codes_of_every_cell_and_configuration(simulate: Simulate, board: str) -> None:
    rng = np.random.default_rng(7)
    ratio = rng.random((16, 16, 4))
    codes = np.minimum(np.floor(ratio * 1024), 1023)
    ratio[:8, 3, 1] = [0.0, 1.0, 1023.999 / 1024, 1 / 1024, 0.999 / 1024, 0.5, -0.1, 1.5]
    codes[:8, 3, 1] = [0, 1023, 1023, 1, 0, 512, 0, 1023]
    sim = simulate(SCAN, board)
    sim.set_table(ratio)
    sim.hold_log(True)
    sent = sim.run(0.1)
    holds = sim.drain_hold_log()
    assert sim.stats()["undriven"] == 0
    received = np.frombuffer(sent, "<u2").reshape(16, 16, 4).transpose(1, 0, 2)  # rows run fastest
    np.testing.assert_array_equal(received, codes)
    np.testing.assert_array_equal(holds["code"], received.transpose(1, 0, 2).ravel())
    assert list(holds["configuration"][:8]) == [0, 1, 2, 3, 0, 1, 2, 3]
    assert list(holds["row"][::4][:3]) == [0, 1, 2]
    assert holds["column"][-1] == 15
    sim.set_table(np.full((2, 2, 4), 0.5))  # cells beyond it carry no current
    sim.reset()
    codes = np.frombuffer(sim.run(0.1), "<u2").reshape(16, 16, 4)
    assert list(codes[1, 1]) == [512] * 4
    assert list(codes[2, 0]) == [1023, 0, 1023, 0]


@pytest.mark.parametrize(("adps", "offset"), [(5, 1.5), (7, -2.0)])
def test_errors_of_the_converter_by_clock(simulate: Simulate, adps: int, offset: float) -> None:
    """Codes over a ramp follow a parabola; what is left is rounding, of 1/12, and noise."""
    sim = simulate(SCAN.replace("0x82", f"0x8{adps}"))
    ramp = np.linspace(0.01, 0.99, 1024)
    sim.set_table(ramp.reshape(16, 16, 4))
    sim.set(half_code=1, offset_lsb=1.5, offset_lsb_125khz=-2, gain_lsb=3, inl_lsb=-1.5)
    sim.set(noise_lsb=0.6, seed=1)
    codes = np.frombuffer(sim.run(0.2), "<u2").reshape(16, 16, 4).transpose(1, 0, 2).ravel()
    errors = codes - 1024 * ramp  # a code's centre is code / 1024, as the data sheet draws it
    found = np.polyfit(ramp, errors, 2)
    at_0_half_1 = np.polyval(found, [0, 0.5, 1]) - offset
    np.testing.assert_allclose(at_0_half_1, [0, 3 / 2 - 1.5, 3], atol=0.2)
    assert (errors - np.polyval(found, ramp)).var() == pytest.approx(0.6**2 + 1 / 12, rel=0.15)


def test_undriven_pins_and_equal_drive(simulate: Simulate) -> None:
    program = sts(ADMUX, 0x40) + sts(ADCSRA, 0xA2) + sts(ADCSRA, 0xE2)
    delay = "ldi r24, 0\n 2: dec r24\n brne 2b\n"
    program += delay + "ldi r16, 15\n out 0x04, r16\n ldi r16, 0xFC\n out 0x0A, r16\n"
    program += delay + "ldi r16, 12\n out 0x0B, r16\n" + FOREVER
    sim = simulate(program)
    holds = hold_log(sim, 3000)
    undriven = sim.stats()["undriven"]
    states = [(int(h["configuration"]), int(h["code"])) for h in holds]
    assert sorted(set(states)) == [(8, 0), (8, 1023), (9, 0)]
    assert undriven == states.count((9, 0)) > 5


# Pins: outputs first, drive top high at row 0, then row 1 a little later.
SETTLING = sts(ADMUX, 0x40) + sts(ADCSRA, 0x83)  # ADEN at 6, ADC clock 8 cycles
SETTLING += "ldi r16, 15\n out 0x04, r16\n ldi r16, 0xFC\n out 0x0A, r16\n"  # driven low: 0.0
SETTLING += "ldi r16, 0x04\n out 0x0B, r16\n"  # 12: configuration A, row 0
SETTLING += "ldi r24, 20\n 2: dec r24\n brne 2b\n"  # 1 + 20 * 3 - 1 cycles: 72
SETTLING += "ldi r16, 0x14\n out 0x0B, r16\n"  # 74: row 1
SETTLING += sts(ADCSRA, 0xC3) + FOREVER  # 77: first conversion, from the edge at 78


def test_settling_is_exponential_and_continues_from_an_unsettled_value(simulate: Simulate) -> None:
    changed, changed_again, held = 12, 74, 78 + 108
    table = np.zeros((2, 1, 4))
    table[0, 0, 0], table[1, 0, 0] = 0.9, 0.3
    tau_us = 4.0
    sim = simulate(SETTLING)
    sim.set_table(table)
    sim.set(tau_us=tau_us)
    record = hold_log(sim, 1000)[0]
    stats = sim.stats()
    decay = [math.exp(-d / 16 / tau_us) for d in (changed_again - changed, held - changed_again)]
    unsettled = 0.9 * (1 - decay[0])
    expected = 0.3 + (unsettled - 0.3) * decay[1]
    assert int(record["cycle"]) == held
    assert int(record["code"]) == math.floor(expected * 1024)
    assert stats["settle_cycles_min"] == held - changed_again


@pytest.mark.parametrize("input_ohm", [1, 1e5])
@pytest.mark.parametrize(("line_pf", "cell_pf"), [(30, 0), (30, 2), (300, 20)])
def test_lines_settle_as_the_matrix_exponential_says(
    simulate: Simulate, line_pf: float, cell_pf: float, input_ohm: float
) -> None:
    """States: two rows and two columns, both nodes, the sample capacitor."""
    siemens, farad, joint = np.zeros((7, 7)), np.zeros((7, 7)), np.array([[1, -1], [-1, 1]])
    for row, column, ohm in ((0, 2, 20e3), (0, 3, 1e6), (1, 2, 50e3), (1, 3, 5e3)):
        siemens[np.ix_([row, column], [row, column])] += joint / ohm
        farad[np.ix_([row, column], [row, column])] += joint * 1e-12 * cell_pf
    sim = simulate(SETTLING)
    sim.request("C", b"\x02" + siemens[:4, :4].tobytes())
    sim.set(line_pf=line_pf, cell_pf=cell_pf, node_pf=50, sample_pf=14, input_ohm=input_ohm)
    siemens[4:6, 4:6] += np.eye(2) / 30e3
    siemens[np.ix_([4, 6], [4, 6])] += joint / input_ohm
    farad += 1e-12 * np.diag([line_pf] * 4 + [50, 50, 14])
    volt = np.zeros(7)
    for row, cycles in ((0, 74 - 12), (1, 78 + 108 - 74)):
        # The multiplexers make one node of two: their charges add.
        merged = np.eye(7)[:, [0, 1, 2, 3, 6]]
        merged[[4, 5], [row, 2]] = 1
        g, c = merged.T @ siemens @ merged, merged.T @ farad @ merged
        goal = np.linalg.solve(g, merged[4] / 30e3)
        off = np.linalg.solve(c, merged.T @ farad @ volt) - goal
        volt = merged @ (goal + expm(np.linalg.solve(c, -g) * cycles / CPU_HZ) @ off)
    assert hold_log(sim, 1000)[0]["code"] == pytest.approx(1024 * volt[6] - 0.5, abs=0.6)


ALTERNATELY = """
int main(void) {
    DDRB = 15; DDRD = 0xFC; PORTD = 4;
    ADMUX = 0x40; ADCSRB = SLOT > 416 ? 5 : 0;
    TCCR1B = 0x18; ICR1 = SLOT - 1; OCR1B = 8; OCR1A = 100; TCCR1B = 0x19;
    ADCSRA = 0xE5;
    for (;;) { while (!(TIFR1 & 2)) {} TIFR1 = 6; ADMUX ^= 1; }
}
"""


@pytest.mark.parametrize(
    ("slot", "joined", "known_lsb"),
    [(416, 80, (16, 28)), (437, 101, (8, 19)), (509, 173, (0.8, 5)), (694, 358, (0, 0))],
)
def test_sample_capacitor_remembers_the_reading_before(
    simulate: Simulate, slot: int, joined: int, known_lsb: tuple[float, float]
) -> None:
    """Nodes at 0 and Vdd, behind 30 kOhm each, read in turn at 150, 143, 120 and 90 scans/s.

    The last ADC clock of a conversion and the time to the hold (`joined`, cycles) leave a share k
    of the difference. An error e leaves (1 - e) of Vdd for the next: e = (1 - e) k.
    """
    for node_pf, known in zip((50, 100), known_lsb, strict=True):
        tau_cycles = CPU_HZ * 30e3 * 1e-12 * (14 + node_pf)
        k = 14 / (14 + node_pf) * math.exp(-joined / tau_cycles)
        sim = simulate(ALTERNATELY.replace("SLOT", str(slot)))
        sim.set(sample_pf=14, node_pf=node_pf)
        sim.run_cycles(10_000)
        sim.reset_stats()
        codes = set(hold_log(sim, 10_000)["code"])
        assert codes == {math.floor(1024 * k / (1 + k)), math.floor(1024 / (1 + k))}
        assert min(codes) == pytest.approx(known, abs=1)
        assert sim.stats()["channel_settle_cycles_max"] == joined


def test_gaps_between_changes_and_holds(simulate: Simulate) -> None:
    """Those of row, column and drive pins are told apart from those of the ADC's channel."""
    program = FREE_RUNNING + "ldi r16, 0x10\n out 0x0B, r16\n"  # row 1 at 11
    program += "ldi r24, 159\n 2: dec r24\n brne 2b\n"  # to 11 + 477 = 488
    program += "ldi r16, 0x20\n out 0x0B, r16\n"  # row 2 at 490
    program += sts(ADMUX, 0x41) + FOREVER  # at 493; in effect 1 ADC clock before the end, at 806
    sim = simulate(program)
    sim.run_cycles(1000)
    stats = sim.stats()
    assert stats["settle_cycles_max"] == 470 - 11
    assert stats["settle_cycles_min"] == 886 - 490
    assert stats["change_after_hold_cycles_min"] == 490 - 470
    assert stats["channel_settle_cycles_min"] == 886 - 806


# ---- timers ------------------------------------------------------------------------------------


VECTOR_TIMER1_A = {"uno": 11, "megaatmega2560": 17}


def with_vectors(board: str, main: str, handler: str = "reti") -> str:
    """Vector table whose every entry is `handler`, and a stack."""
    stack = {"uno": 0x08FF, "megaatmega2560": 0x21FF}[board]
    table = "jmp main\n" + "".join(f".org {4 * v}\n {handler}\n" for v in range(1, 35))
    set_stack = f"ldi r16, {stack >> 8}\n out 0x3E, r16\n ldi r16, 255\n out 0x3D, r16\n"
    return f"{table} main: {set_stack} {main}"


@BOARDS
@pytest.mark.parametrize("wait", [FOREVER, "1: sleep\n rjmp 1b\n"])
def test_compare_a_interrupts_come_every_period(simulate: Simulate, board: str, wait: str) -> None:
    main = sts_word(ICR1, 693) + sts_word(OCR1A, 5) + sts(TIMSK1, 2) + sts(TCCR1B, 0x19)
    program = with_vectors(board, main + "ldi r16, 1\n out 0x33, r16\n sei\n" + wait)
    sim = simulate(program, board)
    sim.run_cycles(10_000)
    sim.reset_stats()
    sim.run_cycles(694 * 20_000)
    stats = sim.stats()
    vector = str(VECTOR_TIMER1_A[board])
    cycles = ENTRY_AND_RETI_CYCLES[board]
    assert stats["vectors"] == {
        vector: {"count": 20_000, "cycles": 20_000 * cycles, "cycles_max": cycles}
    }
    assert stats["interrupts"]["cycles"] == 20_000 * cycles


@BOARDS
@pytest.mark.parametrize("enable", ["sei\n", "rcall 5f\n"])
def test_one_instruction_runs_between_enabling_interrupts_and_the_interrupt(
    simulate: Simulate, board: str, enable: str
) -> None:
    main = TRANSMITTER + "clr r20\n"
    main += sts_word(OCR1A, 5) + sts(TIMSK1, 2) + sts(TCCR1B, 1) + "nop\n" * 20
    main += enable + "inc r20\n" * 5 + FOREVER + "5: reti\n"
    program = with_vectors(board, main, "rjmp 4f") + "4: sts 0xC6, r20\n cli\n" + FOREVER
    sim = simulate(program, board)
    assert sim.run(0.001) == b"\x01"


@BOARDS
def test_sleep_ends_at_once_if_an_interrupt_waits(simulate: Simulate, board: str) -> None:
    main = sts_word(OCR1A, 5) + sts(TIMSK1, 2) + sts(TCCR1B, 1) + "nop\n" * 20
    main += TRANSMITTER
    main += "ldi r16, 1\n out 0x33, r16\n sei\n sleep\n" + sts(0xC6, 7) + FOREVER
    sim = simulate(with_vectors(board, main), board)
    assert sim.run_cycles(500) == b"\x07"


TIMER0 = """
int main(void) {
    transmitter();
    TCCR0A = 0; TCCR0B = 3;
    for (;;) { while (!(TIFR0 & 1)) {} UDR0 = TCNT0; TCNT0 = PRELOAD; TIFR0 = 1; }
}
"""


@pytest.mark.parametrize(("preload", "ticks"), [("TCNT0", 256), ("6", 250), ("128", 128)])
def test_timer0_polled_overflows(simulate: Simulate, preload: str, ticks: int) -> None:
    sim = simulate(TIMER0.replace("PRELOAD", preload))
    sim.run(0.01)
    sent = sim.run_cycles(64 * ticks * 100)
    assert len(sent) == 100
    assert set(sent) == {0}


# ---- UART --------------------------------------------------------------------------------------

SENDER = """
int main(void) {
    UCSR0C = FORMAT; UCSR0A = 2; UBRR0 = 3; UCSR0B = 8;
    for (uint8_t n = 0;; n++) { while (!(UCSR0A & 0x20)) {} UDR0 = n; }
}
"""


@BOARDS
@pytest.mark.parametrize(("frame", "cycles"), [("0x06", 320), ("0x0E", 352), ("0x26", 352)])
def test_back_to_back_bytes(simulate: Simulate, board: str, frame: str, cycles: int) -> None:
    sim = simulate(SENDER.replace("FORMAT", frame), board)
    first = sim.run_cycles(10_000)
    sent = sim.run_cycles(cycles * 5000)
    assert sim.stats()["tx_ignored"] == 0
    assert len(sent) == 5000
    assert all(b == a + 1 & 0xFF for a, b in zip(first + sent, (first + sent)[1:], strict=False))


def test_transmitter_holds_two_bytes_and_ignores_a_third(simulate: Simulate) -> None:
    program = sts(0xC0, 2) + sts(0xC4, 3) + sts(0xC1, 8)
    program += "".join(sts(0xC6, byte) for byte in b"abc") + FOREVER
    sim = simulate(program)
    assert sim.run_cycles(12 + 320 - 2) == b""  # UDR written at 12
    assert sim.run_cycles(2) == b"a"
    assert sim.run_cycles(1000) == b"b"
    assert sim.stats()["tx_ignored"] == 1


RECEIVER = """
int main(void) {
    UCSR0A = 2; UBRR0L = 3; UCSR0B = 0x18;
    for (;;) {
        _delay_ms(1);
        uint8_t status[8], got[8], n = 0;
        while (UCSR0A & 0x80) { status[n] = UCSR0A & 0x9C; got[n++] = UDR0; }
        for (uint8_t i = 0; i < n; i++) { send(status[i]); send(got[i]); }
    }
}
"""


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        (b"abc", [(RXC0, "a"), (RXC0, "b"), (RXC0, "c")]),
        (b"abcd", [(RXC0, "a"), (RXC0, "b"), (RXC0 | DOR0, "d")]),
        (b"abcdefg", [(RXC0, "a"), (RXC0, "b"), (RXC0 | DOR0, "g")]),
    ],
)
def test_receiver_overruns_after_three_bytes(
    simulate: Simulate, sent: bytes, received: list[tuple[int, str]]
) -> None:
    sim = simulate(RECEIVER)
    sim.run_cycles(1000)
    sim.write(sent)
    answer = sim.run(0.003)
    assert sim.stats()["rx_overruns"] == len(sent) - 3
    assert [(answer[i], chr(answer[i + 1])) for i in range(0, len(answer), 2)] == received


ECHO = """
#include <avr/interrupt.h>
#include <avr/sleep.h>
#ifndef USART_RX_vect
#define USART_RX_vect USART0_RX_vect
#endif
ISR(USART_RX_vect) { UDR0 = UDR0; }
int main(void) {
    UCSR0A = 2; UBRR0L = 3; UCSR0B = 0x98;
    sei();
    for (;;) sleep_mode();
}
"""


@BOARDS
def test_bytes_arrive_one_after_the_other_at_line_speed(simulate: Simulate, board: str) -> None:
    text = bytes(range(200))
    sim = simulate(ECHO, board)
    sim.run_cycles(1000)
    sim.write(text)
    echoed = sim.run_cycles(100 * 320)
    assert sim.stats()["rx_bytes"] == 100
    echoed += sim.run_cycles(110 * 320)
    assert sim.stats()["rx_overruns"] == 0
    assert echoed == text


def test_baud_mismatch_garbles_both_ways(simulate: Simulate) -> None:
    sim = simulate(RECEIVER)
    sim.set_baud(510_000)  # 2 % off
    sim.run_cycles(1000)
    sim.write(b"x")
    assert sim.run(0.003) == bytes([RXC0]) + b"x"
    # Bits of 8.68 us, which the board looks at every 2 us. The start bit and three zeros outlast a
    # frame of 20 us; the last zero, after four ones, reads as a start bit and 0, 0, 0, 1, ...
    frames = bytes([RXC0 | FE0, 0, RXC0, 0xF8])
    for baud in (115_200, 0):
        sim.set_baud(115_200)
        sim.write(b"x")
        sim.run_cycles(1500)
        sim.set_baud(baud)
        answer = sim.run(0.003)
        assert len(answer) == len(frames)
        assert (answer == frames) == (baud == 0)  # else it is garbled on the way back as well


# ---- resets, EEPROM, idle time -----------------------------------------------------------------

RESETS = """
#include <avr/wdt.h>
uint8_t kept __attribute__((section(".noinit")));
int main(void) {
    uint8_t flags = MCUSR, ddr = DDRB;
    MCUSR = 0;
    wdt_disable();
    DDRB = 15;
    if (flags & 1) kept = 40;
    transmitter();
    send(flags); send(kept++); send(ddr);
    _delay_ms(1);
    if (flags & 1) wdt_enable(WDTO_15MS);
    for (;;) {}
}
"""


@BOARDS
def test_power_on_watchdog_and_external_reset(simulate: Simulate, board: str) -> None:
    sim = simulate(RESETS, board)
    assert sim.run(0.015) == bytes([PORF, 40, 0])
    assert sim.run(0.010) == bytes([WDRF, 41, 0])
    sim.reset()
    assert sim.run(0.050) == bytes([EXTRF, 42, 0])
    stats = sim.stats()
    assert stats["resets"] == 2
    assert stats["cycles"] >= 0.075 * CPU_HZ


@pytest.mark.parametrize(
    ("board", "asked", "starts"),
    [
        ("uno", [], 37.5 + 102.4),  # optiboot.c: 6 flashes of 1/16 s; the watchdog's "1 s"
        ("uno", range(0, 600, 30), 37.5 + 1.6),
        ("megaatmega2560", [], 83),
        ("megaatmega2560", [40], 540),
        ("megaatmega2560", range(0, 600, 30), math.inf),
    ],
)
def test_boot_loader_takes_every_byte_for_a_programmer(
    simulate: Simulate, board: str, asked: Sequence[int], starts: float
) -> None:
    """Units of 10 ms from the port's opening, as the same files took in another simulator."""
    program = "int main(void) { transmitter(); send('!'); send('O'); for (;;) {} }"
    sim = simulate(program, board, bootloader="board")
    sim.set_baud(500_000)
    sim.reset()
    sent = b""
    for now in range(600):
        sim.write(bytes.fromhex("00058101872500") if now in asked else b"")  # get_hello
        sent += sim.run(0.01)
        if b"!O" in sent:
            break
    assert (now if b"!O" in sent else math.inf) == pytest.approx(starts, abs=2)


def test_a_mega_s_boot_loader_is_done_before_the_host_asks_again(simulate: Simulate) -> None:
    """It hears the host's first questions, at both speeds, if the board was reset late."""
    program = "int main(void) { transmitter(); send('!'); send('O'); for (;;) {} }"
    sim = simulate(program, "megaatmega2560", bootloader="board")
    question = bytes.fromhex("00058101872500")  # get_hello
    (_, _, first_s), (_, _, second_s), (_, _, third_s), *_ = session._SELDOM[1:]
    sim.reset()
    sim.run(0.7)  # shortly before it starts the program
    for baud, listen_s in ((500_000, first_s), (1_000_000, second_s)):
        sim.set_baud(baud)
        sim.write(question)
        assert b"!O" not in sim.run(listen_s)
    sim.set_baud(500_000)
    assert b"!O" not in sim.run(4.0)  # it did hear them
    assert b"!O" in sim.run(third_s - 4.0)


EEPROM = """
#include <avr/eeprom.h>
int main(void) {
    transmitter();
    send(eeprom_read_byte((uint8_t *)9));
    TCCR1B = 3;
    EEAR = 5; EEDR = 0x5A; EECR = 4; EECR = 2;
    TCNT1 = 0;
    while (EECR & 2) {}
    uint16_t ticks = TCNT1;
    send(ticks); send(ticks >> 8);
    for (;;) {}
}
"""


@BOARDS
def test_eeprom_takes_its_time_and_survives_resets(simulate: Simulate, board: str) -> None:
    size = {"uno": 1024, "megaatmega2560": 4096}[board]
    sim = simulate(EEPROM, board)
    assert sim.eeprom() == b"\xff" * size
    sim.write_eeprom(b"\x77", 9)
    assert sim.run(0.003) == b"\x77"
    (ticks,) = struct.unpack("<H", sim.run(0.002))
    assert abs(ticks - 850) <= 1  # 3.4 ms in units of 4 us
    sim.reset()
    assert sim.run(0.001) == b"\x77"
    assert sim.eeprom() == b"\xff" * 5 + b"\x5a" + b"\xff" * 3 + b"\x77" + b"\xff" * (size - 10)
    with pytest.raises(SimulationError, match="EEPROM"):
        sim.write_eeprom(b"ab", size - 1)


def test_idle_time_between_markers(simulate: Simulate) -> None:
    # A pass of 300 cycles that worked, then one of 100 that did not.
    program = "clr r0\n ldi r16, 1\n"
    program += "3: ldi r24, 99\n 1: dec r24\n brne 1b\n rjmp 4f\n 4: out 0x1E, r16\n"
    program += "ldi r24, 33\n 2: dec r24\n brne 2b\n out 0x1E, r0\n rjmp 3b\n"
    # worked: rjmp 2, ldi 1, loop 296, rjmp 2, out 1 = 302; idle: ldi 1, loop 98, out 1 = 100
    sim = simulate(program)
    sim.run_cycles(302)
    sim.reset_stats()
    sim.run_cycles(402 * 1000)
    stats = sim.stats()
    assert abs(stats["idle_cycles"] - 100 * 1000) <= 100
    assert stats["cpu_percent"] == pytest.approx(100 * 302 / 402, abs=0.05)


def test_jump_goes_on_at_the_address(simulate: Simulate) -> None:
    sim = simulate(TRANSMITTER + FOREVER + sts(0xC6, 65) + FOREVER)
    assert sim.run(0.001) == b""
    sim.jump(2 * (3 + 3 + 1))
    assert sim.run(0.001) == b"A"


# ---- the bridge --------------------------------------------------------------------------------


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
    "T": [bytes(16), b"\xff" * 8192],  # too short; not a number
    "O": [b"tau_us=-1", b"tau_us=nan", b"tau_us=1e10", b"tau_us=", b"tau_us", b"tau=1"],
    "C": [
        b"",
        b"\x01" + bytes(40),
        b"\x81" + bytes(3 * 3 * 8),
        b"\x11" + bytes(18 * 18 * 8),
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
    for shape in [(17, 1, 4), (1, 17, 4), (2, 2, 9)]:
        with pytest.raises(ValueError, match="shape"):
            sim.set_table(np.zeros(shape))
    assert sim.stats()["state"] == "running"


@pytest.mark.parametrize(
    ("sent", "ops"), [(b"W\xff\xff\xff\xff", b"!"), (b"S\x00", b""), (b"Q" + bytes(4), b"Q")]
)
def test_what_ends_the_simulator(build: Build, sent: bytes, ops: bytes) -> None:
    command = [PROGRAM, "--board", "uno", build("uno", FOREVER)]
    done = subprocess.run(command, input=sent + b"S" + bytes(4), stdout=-1, timeout=10, check=False)
    assert done.stdout[:1] == ops
    assert len(done.stdout[5:]) == sum(done.stdout[1:5])  # one reply, and short


def test_program_errors(build: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elf = build("uno", FOREVER)
    with pytest.raises(FileNotFoundError, match=r"none\.elf is missing: run 'make firm"):
        LockstepSim("uno", tmp_path / "none.elf")
    with pytest.raises(SimulationError, match="usage"):
        LockstepSim("due", elf)
    (tmp_path / "not.elf").write_bytes(b"no ELF")
    with pytest.raises(SimulationError, match="cannot load"):
        LockstepSim("uno", tmp_path / "not.elf")
    sim = LockstepSim("uno", elf)
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
