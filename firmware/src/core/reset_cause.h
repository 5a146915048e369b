// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "frames.h"

namespace ohmskin {

// What a start leaves for the next one, in RAM that no start clears. Any other value: the RAM has
// lost its content, or other firmware ran.
enum class Mark : uint16_t { Ran = 0x5AC3, Hung = 0x3CA5 };

// Why the board started: bits of frames::ResetCause, and only those that are known.
//
// status: the chip's register of reset flags (MCUSR). Most boot loaders clear it.
// loader_status: what it was before that, if the boot loader says so. Optiboot from 4.6 on and
// urboot put it into r2. Others leave r2 alone. This firmware sets it to 0 and never uses it, so
// another value was put there since; but after a loss of power it may hold anything. Its watchdog
// bit says nothing: these loaders start the firmware by a watchdog reset of their own.
inline uint8_t reset_cause(uint8_t status, Mark mark, uint8_t loader_status) {
    constexpr uint8_t POWER_ON = static_cast<uint8_t>(frames::ResetCause::PowerOn);
    constexpr uint8_t EXTERNAL = static_cast<uint8_t>(frames::ResetCause::External);
    constexpr uint8_t BROWN_OUT = static_cast<uint8_t>(frames::ResetCause::BrownOut);
    constexpr uint8_t WATCHDOG = static_cast<uint8_t>(frames::ResetCause::Watchdog);
    constexpr uint8_t ALL = POWER_ON | EXTERNAL | BROWN_OUT | WATCHDOG;
    if ((status & ALL) != 0)
        return status & ALL;
    if (mark == Mark::Hung)
        return WATCHDOG;
    if ((loader_status & ~ALL) != 0)
        return 0;
    if ((loader_status & POWER_ON) != 0)
        return POWER_ON;  // the supply also passes the brown-out's threshold when it comes up
    return mark == Mark::Ran ? loader_status & (EXTERNAL | BROWN_OUT) : 0;
}

}  // namespace ohmskin
