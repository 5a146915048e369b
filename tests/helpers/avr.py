# SPDX-License-Identifier: Apache-2.0
"""Small programs for the simulated processor, for several test files.

Assembler programs start at the reset vector, so that the cycle of each of their instructions is
known: comments give the cycle at which an instruction takes effect.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

from lockstep import LockstepSim

MCU = {"uno": "atmega328p", "megaatmega2560": "atmega2560"}
BOARDS = pytest.mark.parametrize("board", list(MCU))

TCCR1B, ICR1 = 0x81, 0x86

Build = Callable[[str, str], Path]
Simulate = Callable[..., LockstepSim]

# Begin of all C programs: two functions to send with.
SENDING = """
#include <avr/io.h>
#include <util/delay.h>
static void send(uint8_t b) { while (!(UCSR0A & 0x20)) {} UDR0 = b; }
static void transmitter(void) { UCSR0A = 2; UBRR0L = 3; UCSR0B = 8; }
"""

SENDER = """
int main(void) {
    UCSR0C = FORMAT; UCSR0A = 2; UBRR0 = 3; UCSR0B = 8;
    for (uint8_t n = 0;; n++) { while (!(UCSR0A & 0x20)) {} UDR0 = n; }
}
"""

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


def sts(address: int, value: int) -> str:
    """Three cycles, the store takes effect at the end of the third."""
    return f"ldi r16, {value}\n sts {address}, r16\n"


def sts_word(address: int, value: int) -> str:
    """Six cycles; high byte first, as 16-bit registers want it."""
    return sts(address + 1, value >> 8) + sts(address, value & 0xFF)


FOREVER = "1: rjmp 1b\n"
# The transmitter at 500 kbaud; at 6.
TRANSMITTER = sts(0xC0, 2) + sts(0xC1, 8)
