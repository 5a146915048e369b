// SPDX-License-Identifier: Apache-2.0
#include "core/self_test.h"

namespace ohmskin {

namespace {

constexpr uint16_t FULL_SCALE = (1u << frames::ADC_BITS) - 1;
// Half of Vdd less 1/16, for resistors that differ by up to a quarter.
constexpr uint16_t HALF_LOW = FULL_SCALE / 2 - FULL_SCALE / 16;
constexpr uint16_t HALF_HIGH = FULL_SCALE / 2 + FULL_SCALE / 16;

// What a node reads over all inputs, with its own pin high and with the other one high.
struct Node {
    uint16_t own_min, own_max, other_min, other_max;

    // A short to a rail shows at every input.
    bool stuck_low() const { return own_max < HALF_LOW && other_max < HALF_LOW; }
    bool stuck_high() const { return own_min > HALF_HIGH && other_min > HALF_HIGH; }
    // A node without its resistor floats wherever the skin does not hold it, so that one impossible
    // reading is enough.
    bool floats() const { return own_min < HALF_LOW || other_max > HALF_HIGH; }
};

uint16_t bit_if(bool condition, frames::Finding finding) {
    return condition ? static_cast<uint16_t>(finding) : 0;
}

uint8_t index(frames::Reading reading) { return static_cast<uint8_t>(reading); }

}  // namespace

void SelfTest::begin() {
    for (uint8_t i = 0; i < frames::READINGS_PER_CELL; i++) {
        min_[i] = FULL_SCALE;
        max_[i] = 0;
    }
    groups_ = 0;
}

void SelfTest::take(const uint16_t *codes) {
    constexpr uint16_t CELLS = frames::ROWS_MAX * frames::COLUMNS_MAX;
    const uint8_t first = groups_++ < CELLS / 2 ? 0 : frames::READINGS_PER_PASS;
    for (uint8_t n = 0; n < Scanner::GROUP; n++) {
        const uint8_t i = first + (n & (frames::READINGS_PER_PASS - 1));
        const uint16_t code = codes[n] & Scanner::CODE;
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
    const Node top = {min_[a], max_[a], min_[d], max_[d]};
    const Node bottom = {min_[c], max_[c], min_[b], max_[b]};
    frames::SelfTestReport report;
    report.findings = static_cast<uint16_t>(bit_if(top.stuck_low(), Finding::TopStuckLow) |
                                            bit_if(top.stuck_high(), Finding::TopStuckHigh) |
                                            bit_if(bottom.stuck_low(), Finding::BottomStuckLow) |
                                            bit_if(bottom.stuck_high(), Finding::BottomStuckHigh));
    // A rail at one node pulls the other across half of Vdd through a pressed cell.
    if (report.findings == 0)
        report.findings =
            static_cast<uint16_t>(bit_if(top.floats(), Finding::TopReferenceMissing) |
                                  bit_if(bottom.floats(), Finding::BottomReferenceMissing));
    for (uint8_t i = 0; i < frames::READINGS_PER_CELL; i++) {
        report.code_min[i] = min_[i];
        report.code_max[i] = max_[i];
    }
    return report;
}

}  // namespace ohmskin
