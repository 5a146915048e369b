// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// What a Pico says of itself (board_numbers.h). A slot's clock is an eighth of the processor's:
// with 16 bits, slots are up to 4 ms.
namespace ohmskin {

constexpr uint32_t CLOCK_HZ = 16000000;

namespace board {

constexpr char NAME[] = "pico";
constexpr uint8_t ADC_BITS = 12;

// The converter has one clock: accuracies do not differ. Chosen: 10 us, of which the slot's
// interrupt takes 2.6.
constexpr uint16_t slot_min(uint8_t) { return 160; }
// A conversion takes 2 us (RP2040's data sheet, 4.9.2: 96 clocks of 48 MHz), and pins and channel
// change within 0.875 us after it: the processor sees its end, and sets them.
constexpr uint16_t held_cycles(uint8_t) { return 46; }

// Measured: tests/firmware/test_pico.py, test_the_rate_that_is_said_is_the_rate_that_comes, fails
// where they are too small.
constexpr uint16_t BUSY_A_SLOT = 45, BUSY_A_READING = 50, BUSY_A_SCAN = 1000;

// Chosen: a hundredth of the RAM. Room for 16x16 cells twice, so that a host may be late.
constexpr uint16_t RING_SIZE = 4096;
// Full-speed USB carries up to 1.2 MB/s in packets of 64 bytes, whatever the line's speed is
// called. Chosen: 0.5 MB/s, so that other devices have their part.
constexpr uint16_t cycles_per_byte(uint32_t) { return 32; }

}  // namespace board
}  // namespace ohmskin
