// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// What an Uno, a Nano and a Mega say of themselves (board.h). Unit tests on other machines, and
// boards by Arduino's calls, take the same.
namespace ohmskin {

#if defined(F_CPU) && defined(__AVR__)
constexpr uint32_t CLOCK_HZ = F_CPU;  // PlatformIO defines it
#else
constexpr uint32_t CLOCK_HZ = 16000000;
#endif

namespace board {

#if defined(__AVR_ATmega328P__)
constexpr char NAME[] = "uno";
#elif defined(__AVR_ATmega2560__)
constexpr char NAME[] = "megaatmega2560";
#else
constexpr char NAME[] = "arduino";
#endif
constexpr uint8_t ADC_BITS = 10;

// Clock cycles of an ADC clock, the prescaler: at 16 MHz, 500, 250 and 125 kHz.
constexpr uint8_t prescaler(uint8_t accuracy) { return static_cast<uint8_t>(32 << accuracy); }
// A slot has 15 ADC clocks at least. Data sheets of ATmega328P and 2560, "Prescaling and Conversion
// Timing": a conversion that is triggered ends 13.5 ADC clocks and 3 clock cycles after its
// trigger, and holds its sample 2 ADC clocks and 3 clock cycles after it. A trigger that comes
// before the conversion's end is ignored, and its reading is lost. So a slot leaves the converter
// 1.5 ADC clocks to spare, at least 45 clock cycles. Chosen: tests and `make bench-firmware` let
// conversions be up to 32 cycles late.
constexpr uint16_t slot_min(uint8_t accuracy) {
    return static_cast<uint16_t>(15u * prescaler(accuracy));
}
// From the hold to the end of the conversion: 11.5 ADC clocks. Only then does the sample capacitor
// join the next channel, so the time to settle counts from there. The pins have changed long
// before.
constexpr uint16_t held_cycles(uint8_t accuracy) {
    return static_cast<uint16_t>(23u * prescaler(accuracy) / 2);
}

// Measured: tests/firmware, test_the_rate_that_is_said_is_the_rate_that_comes, fails where they are
// too small.
constexpr uint16_t BUSY_A_SLOT = 165, BUSY_A_READING = 240, BUSY_A_SCAN = 5000;

// Chosen: a quarter of the Uno's RAM. docs/timing.md, "What limits the rate", says what it costs.
constexpr uint16_t RING_SIZE = 512;
// 8N1: start bit, eight data bits, stop bit.
constexpr uint16_t cycles_per_byte(uint32_t baud) {
    return static_cast<uint16_t>(CLOCK_HZ * 10 / baud);
}

}  // namespace board
}  // namespace ohmskin
