// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

namespace ohmskin {

// Codes as a scan frame has them: BITS each, without gaps, least significant bit first. Four of
// them fill whole bytes.
template <uint8_t BITS> struct Packing {
    static constexpr uint8_t CODES = 4, BYTES = CODES * BITS / 8;
    static_assert(BITS % 2 == 0 && BITS > 8 && BITS < 16, "four codes fill whole bytes");

    // Bytes of the first `count` codes.
    static constexpr uint16_t bytes_of(uint16_t count) {
        return static_cast<uint16_t>(count / CODES * BYTES + (count % CODES * BITS + 7) / 8);
    }
    // Packs four codes into BYTES bytes.
    static void pack(const uint16_t *code, uint8_t *octet) { First<BYTES>::pack(code, octet); }

  private:
    // The first bytes, up to BYTES. A template, so that the compiler knows every shift: while a
    // scan runs, the interrupt leaves an AVR little time for more.
    template <uint8_t COUNT, class = void> struct First {
        // The last byte begins in this code, at this bit, and may end in the next code.
        static constexpr uint8_t BIT = 8 * (COUNT - 1), CODE = BIT / BITS, SHIFT = BIT % BITS;
        static constexpr bool ENDS_IN_NEXT = SHIFT + 8 > BITS;
        static void pack(const uint16_t *code, uint8_t *octet) {
            First<COUNT - 1>::pack(code, octet);
            // Where the byte ends in the same code, the second shift leaves no bit of it.
            octet[COUNT - 1] = static_cast<uint8_t>(code[CODE] >> SHIFT | code[CODE + ENDS_IN_NEXT]
                                                                              << (BITS - SHIFT));
        }
    };
    template <class None> struct First<0, None> {
        static void pack(const uint16_t *, uint8_t *) {}
    };
};

}  // namespace ohmskin
