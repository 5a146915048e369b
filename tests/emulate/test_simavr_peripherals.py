# SPDX-License-Identifier: Apache-2.0
"""The simulator's timers, UART, resets and EEPROM, against numbers from the data sheet."""

import math
import struct
from collections.abc import Sequence

import pytest

from avr import BOARDS, ECHO, FOREVER, ICR1, SENDER, TCCR1B, TRANSMITTER, Simulate, sts, sts_word
from lockstep import CPU_HZ
from ohmskin.emulate.simavr import SimulationError
from ohmskin.link import session

OCR1A, TIMSK1 = 0x88, 0x6F
PORF, EXTRF, WDRF = 0x01, 0x02, 0x08
DOR0, FE0, RXC0 = 0x08, 0x10, 0x80
ENTRY_AND_RETI_CYCLES = {"uno": 8, "megaatmega2560": 10}
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
    (_, _, first_s), (_, _, second_s), (_, _, third_s), *_ = session.ATTEMPTS_AFTER_RESET[1:]
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
