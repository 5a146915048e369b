# SPDX-License-Identifier: Apache-2.0
"""The simulator's converter and its skin, against numbers from the data sheet."""

import math
import struct

import numpy as np
import pytest
from scipy.linalg import expm

from avr import BOARDS, FOREVER, ICR1, TCCR1B, Simulate, sts, sts_word
from lockstep import CPU_HZ, LockstepSim

ADCSRA, ADCSRB, ADMUX, OCR1A, OCR1B, TIMSK1 = 0x7A, 0x7B, 0x7C, 0x88, 0x8A, 0x6F
CLEAR_OCF1B_FOREVER = "1: sbi 0x16, 2\n rjmp 1b\n"
# The ADC runs freely and holds at 470, 886, ...; at 9.
FREE_RUNNING = sts(ADMUX, 0x40) + sts(ADCSRA, 0xA5) + sts(ADCSRA, 0xE5)


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


@pytest.mark.parametrize("early", range(8))
def test_a_hold_while_an_interrupt_begins_comes_before_the_end_of_the_run(
    simulate: Simulate, early: int
) -> None:
    """A run may end just as the processor has entered an interrupt, which takes four cycles."""
    program = "rjmp 2f\n .org 0x2C\n reti\n 2:\n"  # timer 1, compare A
    program += "ldi r16, 15\n out 0x04, r16\n ldi r16, 0xFC\n out 0x0A, r16\n"
    program += "ldi r16, 0x04\n out 0x0B, r16\n"  # configuration A, row 0
    program += sts_word(OCR1A, 75 - early) + sts(TIMSK1, 2) + "sei\n"
    sim = simulate(program + triggered(top=499, compare=8) + CLEAR_OCF1B_FOREVER)
    last = hold_cycles(sim, 2000)[-1]
    sim.run_cycles(last + 500 - 10 - int(sim.stats()["cycles"]))
    changes = []
    for code in range(20):
        sim.set_table(np.full((2, 2, 4), code / 1024))
        changes.append(sim.stats()["cycles"])
        sim.run_cycles(1)
    (hold,) = sim.drain_hold_log()
    assert hold["cycle"] == last + 500
    assert hold["code"] == np.searchsorted(changes, hold["cycle"]) - 1


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


@pytest.mark.parametrize(("slot", "adc_clocks"), [(416, 1.5), (694, 2.0)])
def test_a_late_sample_capacitor_joins_when_the_conversion_begins(
    simulate: Simulate, slot: int, adc_clocks: float
) -> None:
    """As above, but it has only the ADC clocks before the hold, whatever the slot's length is."""
    k = 14 / 114 * math.exp(-adc_clocks * 32 / (CPU_HZ * 30e3 * 114e-12))
    sim = simulate(ALTERNATELY.replace("SLOT", str(slot)))
    sim.set(sample_pf=14, node_pf=100, track_late=1)
    sim.run_cycles(10_000)
    codes = set(hold_log(sim, 10_000)["code"])
    assert codes == {math.floor(1024 * k / (1 + k)), math.floor(1024 / (1 + k))}


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
