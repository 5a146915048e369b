// SPDX-License-Identifier: Apache-2.0
#include "core/self_test.h"

namespace ohmskin {

namespace {

// The largest code.
constexpr uint16_t FULL_SCALE = (1u << ADC_BITS) - 1;
// Codes that are surely below and above half of Vdd: 1/16 of the scale apart from it. If the larger
// reference resistor is a quarter above the smaller one, the half moves by 1/18. Chosen: that is
// more than resistors of a kit differ, and faults move a node to a rail.
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
    // Inputs beyond the skin do so on a sound board, but not all inputs.
    bool is_open() const { return own_max < HALF_LOW && other_min > HALF_HIGH; }
};

uint16_t bit_if(bool condition, frames::Finding finding) {
    return condition ? static_cast<uint16_t>(finding) : 0;
}

uint8_t index(frames::Reading reading) { return static_cast<uint8_t>(reading); }

}  // namespace

void SelfTest::begin(const ScanRequest &skin) {
    for (uint8_t i = 0; i < frames::READINGS; i++) {
        min_[i] = FULL_SCALE;
        max_[i] = 0;
    }
    far_ = skin.mode == static_cast<uint8_t>(frames::Mode::Far);
    // A far node that is connected to nothing still has the potential of the pass before when a
    // pass begins, and takes that of this pass from the sample capacitor bit by bit. After a
    // column's inputs, two readings a group, it has it. Where the skin has one column alone, no
    // other inputs are connected, and none can be left out.
    ignored_ = skin.columns > 1 ? ROWS_MAX / 2 : 0;
    pattern_ = 0;
    groups_ = 0;
}

bool SelfTest::next() {
    groups_ = 0;
    pattern_ = pattern_ < MODES ? MODES : pattern_ + 1;
    return far_ && pattern_ < PATTERNS;
}

void SelfTest::take(const uint16_t *codes) {
    // All patterns here have two passes. A group has the two readings of this pass of one cell, and
    // those of the next cell.
    static_assert(PATTERN_DEFINITIONS[0].per_pass == 2 && PATTERN_DEFINITIONS[0].count == 4, "two");
    constexpr uint16_t GROUPS_PER_PASS = ROWS_MAX * COLUMNS_MAX / 2;
    const bool second = groups_ >= GROUPS_PER_PASS;
    const uint16_t of_this_pass = second ? groups_ - GROUPS_PER_PASS : groups_;
    groups_++;
    if (pattern_ >= MODES && of_this_pass < ignored_)
        return;
    for (uint8_t n = 0; n < Scanner::GROUP; n++) {
        const uint8_t i = index(reading_of(pattern_, (n & 1) + (second ? 2 : 0)));
        const uint16_t code = codes[n];
        if (code < min_[i])
            min_[i] = code;
        if (code > max_[i])
            max_[i] = code;
    }
}

frames::SelfTestReport SelfTest::report() const {
    using frames::Finding;
    using frames::Reading;
    const auto node = [this](Reading own, Reading other) {
        return Node{min_[index(own)], max_[index(own)], min_[index(other)], max_[index(other)]};
    };
    const Node top = node(Reading::A, Reading::D), bottom = node(Reading::C, Reading::B);
    const Node far_top = node(Reading::E, Reading::H), far_bottom = node(Reading::G, Reading::F);
    frames::SelfTestReport report;
    report.findings = static_cast<uint16_t>(bit_if(top.stuck_low(), Finding::TopStuckLow) |
                                            bit_if(top.stuck_high(), Finding::TopStuckHigh) |
                                            bit_if(bottom.stuck_low(), Finding::BottomStuckLow) |
                                            bit_if(bottom.stuck_high(), Finding::BottomStuckHigh));
    // A node at a rail pulls others across half of Vdd: through a pressed cell, or at the far end.
    // So other faults are looked for only where no near node is at a rail, then no far node.
    if (report.findings == 0 && far_)
        report.findings =
            static_cast<uint16_t>(bit_if(far_top.stuck_low(), Finding::FarTopStuckLow) |
                                  bit_if(far_top.stuck_high(), Finding::FarTopStuckHigh) |
                                  bit_if(far_bottom.stuck_low(), Finding::FarBottomStuckLow) |
                                  bit_if(far_bottom.stuck_high(), Finding::FarBottomStuckHigh));
    if (report.findings == 0)
        report.findings =
            static_cast<uint16_t>(bit_if(top.floats(), Finding::TopReferenceMissing) |
                                  bit_if(bottom.floats(), Finding::BottomReferenceMissing) |
                                  bit_if(far_ && far_top.is_open(), Finding::FarTopOpen) |
                                  bit_if(far_ && far_bottom.is_open(), Finding::FarBottomOpen));
    for (uint8_t i = 0; i < frames::READINGS; i++) {
        report.code_min[i] = min_[i];
        report.code_max[i] = max_[i];
    }
    return report;
}

}  // namespace ohmskin
