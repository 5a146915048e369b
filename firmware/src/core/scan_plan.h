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
    bool free_running;    // the converter paces itself, not the timer
    uint32_t scan_cycles() const { return static_cast<uint32_t>(slot_cycles) * slots_per_scan; }
};

// Clock cycles of the converter and the slot interrupt (ATmega328P and 2560 data sheets,
// "Prescaling and Conversion Timing").
namespace timing {
// Conversion that the converter starts by itself after another: 13 ADC clocks.
constexpr uint16_t free_running_slot(uint8_t prescaler) { return 13u * prescaler; }
// Trigger to end of a conversion started by the timer: 13.5 ADC clocks and 3 cycles of
// synchronisation; a trigger before that is ignored.
constexpr uint16_t triggered_slot_min(uint8_t prescaler) {
    return static_cast<uint16_t>(13u * prescaler + prescaler / 2 + 4);
}
// Hold to the change of pins in the interrupt, at most, with a byte received in the same moment:
// measured in the simulator, with room (tests/firmware/test_firmware_scan.py).
constexpr uint16_t SELECT_CYCLES_MAX = 120;
constexpr uint16_t SELECT_CYCLES_MAX_FREE_RUNNING = 180;
constexpr uint16_t SLOT_CYCLES_MAX = 60000;
}  // namespace timing

// The plan for a request, or why there is none. With settle_us 0 the slots fill the period;
// otherwise they are as short as the settle time allows and the rest of the period is idle.
OHMSKIN_RARE frames::Result plan_scan(const ScanRequest &request, uint32_t clock_hz,
                                      ScanPlan *plan);

inline uint16_t readings_in(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(rows * columns * frames::READINGS_PER_CELL);
}

// Settle time that a plan keeps, at least.
inline uint16_t settle_us(const ScanPlan &plan, uint32_t clock_hz) {
    const uint16_t select =
        plan.free_running ? timing::SELECT_CYCLES_MAX_FREE_RUNNING : timing::SELECT_CYCLES_MAX;
    return static_cast<uint16_t>((plan.slot_cycles - select) /
                                 static_cast<uint16_t>(clock_hz / 1000000));
}

}  // namespace ohmskin
