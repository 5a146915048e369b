// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_plan.h"
#include "core/scanner.h"

namespace ohmskin {

// Judges the sense nodes by what one scan of all multiplexer inputs reads, in mode far by three.
// With equal reference resistors a node cannot read below half of Vdd while its own pin is high,
// nor above it while the pin is low, whatever the skin does: current only ever flows through both
// resistors in series. A far node that is connected to nothing follows the sample capacitor, which
// brings the potential of the other layer: it reads low where the rows are high.
class SelfTest {
  public:
    OHMSKIN_RARE void begin(const ScanRequest &skin);
    // How the next scan takes all inputs: slow enough for any skin's wiring to settle.
    static ScanRequest request() {
        return ScanRequest{frames::ROWS_MAX, frames::COLUMNS_MAX, 0, 50, 32, 0};
    }
    uint8_t order() const { return order_; }        // of its readings
    OHMSKIN_RARE void take(const uint16_t *codes);  // its groups, in order
    OHMSKIN_RARE bool next();                       // false: it was the last one
    OHMSKIN_RARE frames::SelfTestReport report() const;

  private:
    uint16_t min_[frames::READINGS] = {};
    uint16_t max_[frames::READINGS] = {};
    uint16_t groups_ = 0;  // taken so far of this scan
    uint16_t forgets_ = 0;
    uint8_t order_ = 0;
    bool far_ = false;
};

}  // namespace ohmskin
