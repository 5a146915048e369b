// SPDX-License-Identifier: Apache-2.0
#include "core/self_test.h"

namespace ohmskin {

namespace {

// The largest code.
constexpr uint16_t FULL_SCALE = (1u << board::ADC_BITS) - 1;
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

uint8_t index(frames::Reading reading) { return static_cast<uint8_t>(reading); }

// Nodes: top, bottom, far top, far bottom. The reading of each with its own pin high, and that with
// the other one high.
using frames::Finding;
using frames::Reading;
constexpr uint8_t NEAR_NODES = 2, NODES = 4;
constexpr uint8_t own(uint8_t node) { return 2 * node; }
constexpr uint8_t other(uint8_t node) { return own(node) ^ 3; }
static_assert(own(1) == uint8_t(Reading::C) && other(1) == uint8_t(Reading::B) &&
                  own(2) == uint8_t(Reading::E) && other(2) == uint8_t(Reading::H) &&
                  own(3) == uint8_t(Reading::G) && other(3) == uint8_t(Reading::F),
              "A and D, C and B, E and H, G and F");

// Each node has three bits of the findings: stuck low, stuck high; and that a near node floats, or
// that a far one is open.
constexpr uint8_t BITS_A_NODE = 3;
constexpr uint16_t STUCK = 3, LOOSE = 4;
static_assert(uint16_t(Finding::TopStuckLow) == 1 && uint16_t(Finding::TopStuckHigh) == 2 &&
                  uint16_t(Finding::TopReferenceMissing) == LOOSE &&
                  uint16_t(Finding::BottomStuckLow) == 1 << BITS_A_NODE &&
                  uint16_t(Finding::FarTopStuckLow) == 1 << 2 * BITS_A_NODE &&
                  uint16_t(Finding::FarBottomOpen) == LOOSE << 3 * BITS_A_NODE,
              "the order of nodes and bits");
uint16_t findings_of(const Node &node, bool far) {
    const bool loose = far ? node.is_open() : node.floats();
    return static_cast<uint16_t>(node.stuck_low() | node.stuck_high() << 1 | loose << 2);
}

// What is looked for first. A node at a rail pulls others across half of Vdd: through a pressed
// cell, or at the far end. So other faults count only where no near node is at a rail, then no far
// node.
constexpr uint16_t NEAR_STUCK = STUCK | STUCK << BITS_A_NODE;
constexpr uint16_t ORDER[] = {NEAR_STUCK, NEAR_STUCK << NEAR_NODES * BITS_A_NODE, 0xFFFF};

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
    uint16_t found = 0;
    for (uint8_t n = far_ ? NODES : NEAR_NODES; n-- != 0;) {
        const Node node = {min_[own(n)], max_[own(n)], min_[other(n)], max_[other(n)]};
        found = static_cast<uint16_t>(found << BITS_A_NODE | findings_of(node, n >= NEAR_NODES));
    }
    frames::SelfTestReport report;
    for (uint8_t n = 0; n < sizeof ORDER / sizeof *ORDER; n++) {
        report.findings = found & ORDER[n];
        if (report.findings != 0)
            break;
    }
    for (uint8_t i = 0; i < frames::READINGS; i++) {
        report.code_min[i] = min_[i];
        report.code_max[i] = max_[i];
    }
    return report;
}

}  // namespace ohmskin
