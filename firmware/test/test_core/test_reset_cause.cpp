// SPDX-License-Identifier: Apache-2.0
// Why the board started, from what chip, RAM and boot loader say.
#ifndef __AVR_ATmega328P__  // the other tests fill the flash
#include "../check.h"

#include "core/reset_cause.h"

using namespace ohmskin;

namespace {
// Bits of the chip's MCUSR (data sheets of both chips: PORF, EXTRF, BORF, WDRF), which are those of
// the protocol.
constexpr uint8_t POWER = 1, PIN = 2, DIP = 4, DOG = 8;
constexpr Mark LOST = static_cast<Mark>(0x1234);
}  // namespace

TEST(reset_causes_are_those_that_are_known) {
    const struct {
        uint8_t status;
        Mark mark;
        uint8_t loader_status, cause;
    } cases[] = {
        // No boot loader, or one that leaves MCUSR alone: the chip knows best.
        {POWER, LOST, 0x5A, POWER},
        {POWER | DIP, LOST, 0, POWER | DIP},
        {PIN, Mark::Ran, PIN | DOG, PIN},
        {DIP, Mark::Ran, 0, DIP},
        {DOG, Mark::Ran, 0, DOG},
        {POWER, Mark::Hung, 0, POWER},  // RAM holds anything after a loss of power
        {0xF0 | PIN, Mark::Ran, 0, PIN},
        // Loaders that clear it and leave r2 alone.
        {0, Mark::Ran, 0, 0},
        {0, Mark::Hung, 0, DOG},
        {0, LOST, 0, 0},
        {0, LOST, DIP, 0},  // r2 holds anything, too
        {0, LOST, DOG | PIN, 0},
        {0, Mark::Ran, 0xA6, 0},
        // Loaders that clear it and pass it in r2.
        {0, LOST, POWER, POWER},
        {0, LOST, POWER | DIP, POWER},
        {0, Mark::Ran, POWER, POWER},  // RAM may outlast a short loss of power
        {0, Mark::Ran, DIP, DIP},
        {0, Mark::Ran, PIN, PIN},
        {0, Mark::Ran, PIN | DOG, PIN},
        {0, Mark::Ran, DOG, 0},  // the loader's own way out
        {0, Mark::Hung, DOG, DOG},
    };
    for (const auto &c : cases)
        CHECK_EQ(c.cause, reset_cause(c.status, c.mark, c.loader_status));
}

#endif
