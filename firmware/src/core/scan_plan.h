// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "frames.h"

namespace ohmskin {

// How to scan, as asked for: the fields of the command `configure`.
using ScanRequest = frames::Configure;

// How the scan is kept: slots of equal length, one conversion each, a whole number of them a scan.
struct ScanPlan {
    uint16_t slot_cycles;
    uint16_t slots_per_scan;
    uint16_t idle_slots;  // of slots_per_scan, those after the last reading
    uint32_t scan_cycles() const { return static_cast<uint32_t>(slot_cycles) * slots_per_scan; }
};

// Clock cycles of the converter and the slot interrupt (ATmega328P and 2560 data sheets,
// "Prescaling and Conversion Timing").
namespace timing {
// Trigger to end of a conversion: 13.5 ADC clocks and 3 cycles of synchronisation. A trigger before
// that is ignored, and the reading lost, so a slot leaves the converter 1.5 ADC clocks to spare.
constexpr uint16_t slot_min(uint8_t prescaler) { return 15u * prescaler; }
// Hold to the end of the conversion: only then does the sample capacitor join the next channel. The
// pins have changed long before.
constexpr uint16_t held_cycles(uint8_t prescaler) {
    return static_cast<uint16_t>(11u * prescaler + prescaler / 2);
}
// What a slot leaves for settling where a request names neither rate nor settle time: 14 pF of
// sample capacitor and 100 pF at a node of 30 kOhm come to half a code.
constexpr uint16_t SETTLE_US = 20;
// The same in mode far, where the far node's 100 pF and the line's 30 pF come on top.
constexpr uint16_t SETTLE_FAR_US = 35;
constexpr uint16_t SLOT_CYCLES_MAX = 60000;
}  // namespace timing

// The plan for a request, or why there is none. With settle_us 0 the slots fill the period;
// otherwise they are as short as the settle time allows and the rest of the period is idle. Rate 0:
// as fast as the settle time allows.
OHMSKIN_RARE frames::Result plan_scan(const ScanRequest &request, uint32_t clock_hz,
                                      ScanPlan *plan);

inline uint16_t readings_in(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(rows * columns * frames::READINGS_PER_CELL);
}

// Settle time that a plan keeps, at least: of pins and sample capacitor.
inline uint16_t settle_us(const ScanPlan &plan, uint8_t prescaler, uint32_t clock_hz) {
    return static_cast<uint16_t>((plan.slot_cycles - timing::held_cycles(prescaler)) /
                                 static_cast<uint16_t>(clock_hz / 1000000));
}

}  // namespace ohmskin
