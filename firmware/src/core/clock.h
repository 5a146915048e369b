// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "board_numbers.h"

namespace ohmskin {

constexpr uint32_t common_divisor(uint32_t a, uint32_t b) {
    return b == 0 ? a : common_divisor(b, a % b);
}
// So many clock cycles take so many microseconds: 16 and 1 at 16 MHz; 9216 and 625 at 14.7456 MHz.
constexpr uint32_t CYCLES = CLOCK_HZ / common_divisor(CLOCK_HZ, 1000000);
constexpr uint32_t CYCLES_US = 1000000 / common_divisor(CLOCK_HZ, 1000000);
static_assert(CYCLES * CYCLES_US < 0x10000000 && CYCLES < 0x10000, "us_of() would overflow");

// What is left of a microsecond, in parts of it: CYCLES are one.
using UsRest = uint16_t;

// Whole microseconds of these clock cycles and the rest of those before, which stays below one.
inline uint32_t us_of(uint32_t cycles, UsRest *rest) {
    uint32_t whole = 0;
    // A microsecond of whole cycles needs no multiplication, which could overflow, and so one
    // division alone: spans are shorter than 2^32 - CYCLES.
    if (CYCLES_US != 1) {
        whole = cycles / CYCLES * CYCLES_US;
        cycles = cycles % CYCLES * CYCLES_US;
    }
    const uint32_t parts = cycles + *rest;
    *rest = static_cast<UsRest>(parts % CYCLES);
    return whole + parts / CYCLES;
}
// Clock cycles of so many microseconds, rounded up.
constexpr uint32_t cycles_of(uint16_t us) {
    return (uint32_t{us} * CYCLES + CYCLES_US - 1) / CYCLES_US;
}

}  // namespace ohmskin
