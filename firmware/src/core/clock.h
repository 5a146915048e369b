// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

namespace ohmskin {

// The processor's clock [Hz], which the compiler must know: divisions by it are shifts then.
// PlatformIO defines it; tests on other machines take that of the AVR boards.
#if defined(F_CPU) && defined(__AVR__)
constexpr uint32_t CLOCK_HZ = F_CPU;
#else
constexpr uint32_t CLOCK_HZ = 16000000;
#endif
constexpr uint8_t CYCLES_PER_US = CLOCK_HZ / 1000000;
static_assert(CLOCK_HZ == CYCLES_PER_US * 1000000UL, "whole cycles a microsecond");

}  // namespace ohmskin
