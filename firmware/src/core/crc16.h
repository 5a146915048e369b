// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "frames.h"

namespace ohmskin {

static_assert(frames::CRC_POLYNOMIAL == 0x1021, "Crc16::add() holds this polynomial");

// CRC-16/IBM-3740, a byte at a time and without a table. Its two halves are kept apart because an
// AVR shifts bytes: 16 instructions a byte.
class Crc16 {
  public:
    constexpr Crc16() : Crc16(frames::CRC_INITIAL & 0xFF, frames::CRC_INITIAL >> 8) {}
    // Of no use before another is assigned. It is all zeros, so that static objects that hold one
    // take no flash for their initial values.
    static constexpr Crc16 none() { return Crc16(0, 0); }
    void add(uint8_t octet) {
        uint8_t x = high_ ^ octet;
        x ^= x >> 4;
        high_ = low_ ^ static_cast<uint8_t>(x << 4) ^ (x >> 3);
        low_ = x ^ static_cast<uint8_t>(x << 5);
    }
    uint8_t low() const { return low_; }
    uint8_t high() const { return high_; }

  private:
    constexpr Crc16(uint8_t low, uint8_t high) : low_(low), high_(high) {}
    uint8_t low_, high_;
};

inline OHMSKIN_RARE Crc16 crc_of(const uint8_t *octets, uint8_t size) {
    Crc16 crc;
    for (; size != 0; size--)
        crc.add(*octets++);
    return crc;
}

// Bytes of a CRC: the low one comes first.
constexpr uint8_t CRC_BYTES = 2;

// Whether so many bytes end in the CRC of those before it.
inline OHMSKIN_RARE bool ends_in_crc(const uint8_t *octets, uint8_t size) {
    const uint8_t before = static_cast<uint8_t>(size - CRC_BYTES);
    const Crc16 crc = crc_of(octets, before);
    return octets[before] == crc.low() && octets[before + 1] == crc.high();
}

}  // namespace ohmskin
