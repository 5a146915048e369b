// SPDX-License-Identifier: Apache-2.0
#include "core/self_test.h"

namespace ohmskin {

namespace {

constexpr uint16_t FULL_SCALE = (1u << frames::ADC_BITS) - 1;
// Half of Vdd less 1/16, for resistors that differ by up to a quarter.
constexpr uint16_t HALF_LOW = FULL_SCALE / 2 - FULL_SCALE / 16;
constexpr uint16_t HALF_HIGH = FULL_SCALE / 2 + FULL_SCALE / 16;

// What a node's readings show, with its pin high (`own`) and low (`other`), over all inputs. A
// short to a rail shows at every input; a node without its resistor floats wherever the skin does
// not hold it, so that one impossible reading is enough.
uint16_t judge(uint16_t own_max, uint16_t own_min, uint16_t other_max, uint16_t other_min,
               frames::Finding stuck_low, frames::Finding stuck_high, frames::Finding missing) {
    if (own_max < HALF_LOW && other_max < HALF_LOW)
        return static_cast<uint16_t>(stuck_low);
    if (own_min > HALF_HIGH && other_min > HALF_HIGH)
        return static_cast<uint16_t>(stuck_high);
    if (own_min < HALF_LOW || other_max > HALF_HIGH)
        return static_cast<uint16_t>(missing);
    return 0;
}

uint8_t index(frames::Reading reading) { return static_cast<uint8_t>(reading); }

}  // namespace

void SelfTest::begin() {
    for (uint8_t i = 0; i < frames::READINGS_PER_CELL; i++) {
        min_[i] = FULL_SCALE;
        max_[i] = 0;
    }
}

void SelfTest::take(const uint16_t *cell) {
    for (uint8_t i = 0; i < frames::READINGS_PER_CELL; i++) {
        const uint16_t code = cell[i] & Scanner::CODE;
        if (code < min_[i])
            min_[i] = code;
        if (code > max_[i])
            max_[i] = code;
    }
}

frames::SelfTestReport SelfTest::report() const {
    using frames::Finding;
    using frames::Reading;
    const uint8_t a = index(Reading::A), b = index(Reading::B);
    const uint8_t c = index(Reading::C), d = index(Reading::D);
    frames::SelfTestReport report;
    report.findings =
        static_cast<uint16_t>(judge(max_[a], min_[a], max_[d], min_[d], Finding::TopStuckLow,
                                    Finding::TopStuckHigh, Finding::TopReferenceMissing) |
                              judge(max_[c], min_[c], max_[b], min_[b], Finding::BottomStuckLow,
                                    Finding::BottomStuckHigh, Finding::BottomReferenceMissing));
    for (uint8_t i = 0; i < frames::READINGS_PER_CELL; i++) {
        report.code_min[i] = min_[i];
        report.code_max[i] = max_[i];
    }
    return report;
}

}  // namespace ohmskin
