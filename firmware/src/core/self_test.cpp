// SPDX-License-Identifier: Apache-2.0
#include "core/self_test.h"

#include "board.h"
#include "core/attributes.h"

namespace ohmskin {

namespace {

// The largest code.
constexpr uint16_t FULL_SCALE = (1u << board::ADC_BITS) - 1;
// So far beyond its limit a node is surely at fault: 1/16 of the scale. If a reference resistor is
// a quarter above what the firmware was told, limits move by 1/18 at most. Chosen: that is more
// than resistors of a kit differ, and faults move a node to a rail. (Where one resistor is more
// than 15 times the other, some limits are nearer to a rail than this: what lies beyond them is not
// seen.)
constexpr int16_t MARGIN = FULL_SCALE / 16;

// Where the codes of a reading are, over all inputs: whether all, or some, are surely below its
// limit, or above it.
enum Side : uint8_t { ALL_LOW = 1, ALL_HIGH = 2, SOME_LOW = 4, SOME_HIGH = 8 };

OHMSKIN_RARE uint8_t side_of(uint16_t min, uint16_t max, uint8_t reading) {
    const uint16_t limit = (reading & 2) ? FULL_SCALE - board::SHORT_CODE : board::SHORT_CODE;
    const int16_t low = static_cast<int16_t>(limit - MARGIN);
    const int16_t high = static_cast<int16_t>(limit + MARGIN);
    const int16_t least = static_cast<int16_t>(min), most = static_cast<int16_t>(max);
    uint8_t side = 0;
    if (least > most)  // none was taken: the converter was too slow
        return side;
    if (most < low)
        side |= ALL_LOW;
    if (least > high)
        side |= ALL_HIGH;
    if (least < low)
        side |= SOME_LOW;
    if (most > high)
        side |= SOME_HIGH;
    return side;
}

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
constexpr uint8_t STUCK = 3, LOOSE = 4;
static_assert(uint16_t(Finding::TopStuckLow) == 1 && uint16_t(Finding::TopStuckHigh) == 2 &&
                  uint16_t(Finding::TopReferenceMissing) == LOOSE &&
                  uint16_t(Finding::BottomStuckLow) == 1 << BITS_A_NODE &&
                  uint16_t(Finding::FarTopStuckLow) == 1 << 2 * BITS_A_NODE &&
                  uint16_t(Finding::FarBottomOpen) == LOOSE << 3 * BITS_A_NODE,
              "the order of nodes and bits");
static_assert(ALL_LOW == uint8_t(Finding::TopStuckLow) &&
                  ALL_HIGH == uint8_t(Finding::TopStuckHigh),
              "a node that is stuck is on one side, whichever pin is high");

// own, other: where a node is with its own pin high, and with the other one high. A short to a rail
// shows at every input. A near node without its resistor floats wherever the skin does not hold it,
// so that one impossible reading is enough. Far nodes have those on a sound board, too, at inputs
// beyond the skin, but not at all inputs.
uint8_t findings_of(uint8_t own, uint8_t other, bool far) {
    uint8_t found = own & other & STUCK;
    if (far ? (own & ALL_LOW) && (other & ALL_HIGH) : (own & SOME_LOW) || (other & SOME_HIGH))
        found |= LOOSE;
    return found;
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
        const uint8_t of_node =
            findings_of(side_of(min_[own(n)], max_[own(n)], own(n)),
                        side_of(min_[other(n)], max_[other(n)], other(n)), n >= NEAR_NODES);
        found = static_cast<uint16_t>(found << BITS_A_NODE | of_node);
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
