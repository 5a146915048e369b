// SPDX-License-Identifier: Apache-2.0
// Packed codes, bit by bit, and microseconds of clock cycles. An Uno has no flash left for them.
#if !defined(__AVR__)
#include "../check.h"

#include "core/clock.h"
#include "core/packing.h"

using namespace ohmskin;

namespace {

// Bit n of four codes that follow each other without gaps.
template <uint8_t BITS> bool bit_of(const uint16_t *code, uint16_t n) {
    return code[n / BITS] >> n % BITS & 1;
}

template <uint8_t BITS> void packs_all_bits_in_order() {
    const uint16_t whole = static_cast<uint16_t>((uint32_t{1} << BITS) - 1);
    for (uint16_t seed = 0; seed < 200; seed++) {
        const uint16_t code[] = {static_cast<uint16_t>(seed * 40503u & whole),
                                 static_cast<uint16_t>(seed * 10007u & whole),
                                 seed % 3 != 0 ? whole : uint16_t{0},
                                 static_cast<uint16_t>(seed * 30011u & whole)};
        uint8_t octet[Packing<BITS>::BYTES];
        Packing<BITS>::pack(code, octet);
        for (uint16_t n = 0; n < 8 * Packing<BITS>::BYTES; n++)
            CHECK_EQ(bit_of<BITS>(code, n), octet[n / 8] >> n % 8 & 1);
    }
}

}  // namespace

TEST(codes_of_10_12_and_14_bits_are_packed_without_gaps) {
    packs_all_bits_in_order<10>();
    packs_all_bits_in_order<12>();
    packs_all_bits_in_order<14>();
    CHECK_EQ(0, Packing<10>::bytes_of(0));
    CHECK_EQ(2, Packing<10>::bytes_of(1));
    CHECK_EQ(1280, Packing<10>::bytes_of(1024));
    CHECK_EQ(5, Packing<12>::bytes_of(3));
    CHECK_EQ(7168, Packing<14>::bytes_of(4096));
}

TEST(microseconds_of_many_spans_do_not_drift) {
    UsRest rest = 0;
    uint32_t us = 0;
    uint64_t cycles = 0;
    for (uint32_t n = 0; n < 3000; n++) {
        const uint32_t span = n * 7919 % 70001;
        cycles += span;
        us += us_of(span, &rest);
    }
    CHECK(cycles * 1000000 / CLOCK_HZ == us);
    // The longest span there may be, after as much of a microsecond as there may be.
    const uint32_t longest = 0xFFFFFFFF - CYCLES;
    rest = CYCLES - 1;
    const uint64_t parts = uint64_t{longest} * CYCLES_US + rest;
    CHECK_EQ(parts / CYCLES, us_of(longest, &rest));
    CHECK_EQ(parts % CYCLES, rest);
    CHECK(uint64_t{cycles_of(43)} * 1000000 >= uint64_t{43} * CLOCK_HZ);
    CHECK(uint64_t{cycles_of(43) - 1} * 1000000 < uint64_t{43} * CLOCK_HZ);
}
#endif
