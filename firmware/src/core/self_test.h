// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "board.h"
#include "core/scan_plan.h"
#include "core/scanner.h"

namespace ohmskin {

// Judges the sense nodes by one scan of all multiplexer inputs; in mode far by two more, for the
// far nodes.
//
// Current only ever flows through both reference resistors in series. So with its own pin high a
// node reads at least the other resistor's share of the two, and with the other pin high at most
// its own resistor's share, whatever the skin does: half of Vdd where the resistors are equal. What
// reads otherwise is a fault of the wiring.
//
// A far node has no resistor. One that is connected to nothing keeps the potential that the sample
// capacitor brings, that of the reading before. The self-test's patterns therefore read a near node
// of the other layer first: such a far node reads low where it should read high.
class SelfTest {
  public:
    OHMSKIN_RARE void begin(const ScanRequest &skin);
    // How the next scan takes all inputs, whatever the skin's size: a wire may be in the wrong one.
    Route route(uint16_t cycles_per_byte) const {
        return plan_whole(ROWS_MAX, COLUMNS_MAX, pattern_, board::SELF_TEST_SETTLE_US,
                          cycles_per_byte);
    }
    OHMSKIN_RARE void take(const uint16_t *codes);  // the scan's groups, in order
    OHMSKIN_RARE bool next();                       // to the next scan; false: it was the last one
    OHMSKIN_RARE frames::SelfTestReport report() const;

  private:
    // Smallest and largest code of each reading, over all inputs.
    uint16_t min_[frames::READINGS] = {};
    uint16_t max_[frames::READINGS] = {};
    uint16_t groups_ = 0;   // taken so far of this scan
    uint16_t ignored_ = 0;  // groups at the start of each pass that are not judged
    uint8_t pattern_ = 0;   // of this scan
    bool far_ = false;      // whether the far nodes are judged
};

}  // namespace ohmskin
