// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "frames.h"

namespace ohmskin {

static_assert(frames::CRC_POLYNOMIAL == 0x1021, "crc16_update holds this polynomial");

// CRC-16/IBM-3740 of one more byte. Works on two 8-bit halves because an AVR has no 16-bit shifts;
// 18 instructions there, and no table.
inline uint16_t crc16_update(uint16_t crc, uint8_t octet) {
    uint8_t x = static_cast<uint8_t>((crc >> 8) ^ octet);
    x ^= x >> 4;
    const uint8_t high = static_cast<uint8_t>(crc) ^ static_cast<uint8_t>(x << 4) ^ (x >> 3);
    const uint8_t low = x ^ static_cast<uint8_t>(x << 5);
    return static_cast<uint16_t>(high << 8 | low);
}

}  // namespace ohmskin
