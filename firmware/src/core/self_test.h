// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_plan.h"
#include "core/scanner.h"

namespace ohmskin {

// Judges the sense nodes by what one scan of all multiplexer inputs reads. With equal reference
// resistors a node cannot read below half of Vdd while its own pin is high, nor above it while the
// pin is low, whatever the skin does: current only ever flows through both resistors in series.
class SelfTest {
  public:
    OHMSKIN_RARE void begin();
    void take(const uint16_t *codes);  // the scan's groups, in order
    OHMSKIN_RARE frames::SelfTestReport report() const;

    // How all multiplexer inputs are scanned: slow enough for any skin's wiring to settle.
    static ScanRequest request() {
        return ScanRequest{frames::ROWS_MAX, frames::COLUMNS_MAX, 0, 50, 32};
    }

  private:
    uint16_t min_[frames::READINGS_PER_CELL] = {};
    uint16_t max_[frames::READINGS_PER_CELL] = {};
    uint16_t groups_ = 0;  // taken so far
};

}  // namespace ohmskin
