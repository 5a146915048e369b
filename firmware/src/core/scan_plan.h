// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "frames.h"

namespace ohmskin {

// How to scan, as asked for: the fields of the command `configure`.
using ScanRequest = frames::Configure;

// How the board keeps a request: slots of equal length, one conversion each, a whole number of them
// a scan.
struct ScanPlan {
    uint16_t slot_cycles;     // clock cycles of a slot
    uint16_t slots_per_scan;  // idle ones included
    uint16_t idle_slots;      // those after the last reading: they fill up the scan's period
    uint32_t scan_cycles() const { return static_cast<uint32_t>(slot_cycles) * slots_per_scan; }
};

// What the converter and the timer make of a slot. An ADC clock is `prescaler` clock cycles. (Data
// sheets of ATmega328P and 2560, "Prescaling and Conversion Timing": a conversion that is triggered
// ends 13.5 ADC clocks and 3 clock cycles after its trigger, and holds its sample 2 ADC clocks and
// 3 clock cycles after it.)
namespace timing {
// ADC clocks of the shortest slot. A trigger that comes before the conversion's end is ignored, and
// its reading is lost. So a slot leaves the converter 1.5 ADC clocks to spare, at least 45
// clock cycles. Chosen: tests and `make bench-firmware` let conversions be up to 32 cycles late.
constexpr uint16_t SLOT_ADC_CLOCKS_MIN = 15;
constexpr uint16_t slot_min(uint8_t prescaler) { return SLOT_ADC_CLOCKS_MIN * prescaler; }
// Clock cycles from the hold to the end of the conversion: 11.5 ADC clocks. Only then does the
// sample capacitor join the next channel, so the time to settle counts from there. The pins have
// changed long before.
constexpr uint16_t held_cycles(uint8_t prescaler) {
    return static_cast<uint16_t>(11u * prescaler + prescaler / 2);
}
// What a slot leaves for settling [us] where a request names neither rate nor settle time: 14 pF of
// sample capacitor and 100 pF at a node of 30 kOhm then come to half a code. docs/timing.md,
// "Settle time", has the formula.
constexpr uint16_t SETTLE_US = 20;
// The same in mode far [us], where the far node's 100 pF and the line's 30 pF come on top.
constexpr uint16_t SETTLE_FAR_US = 35;
// Clock cycles of the longest slot: timer 1 has 16 bits. Chosen below 65536, because divide()
// rounds a slot's length up.
constexpr uint16_t SLOT_CYCLES_MAX = 60000;
}  // namespace timing

// The plan for a request, or why there is none. With settle_us 0 the slots fill the period;
// otherwise they are as short as the settle time allows and the rest of the period is idle. Rate 0:
// as fast as the settle time allows.
OHMSKIN_RARE frames::Result plan_scan(const ScanRequest &request, uint32_t clock_hz,
                                      ScanPlan *plan);

// Readings of a scan.
inline uint16_t readings_in(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(rows * columns * frames::READINGS_PER_CELL);
}

// Time that a plan leaves to pins and sample capacitor for settling, at least [us].
inline uint16_t settle_us(const ScanPlan &plan, uint8_t prescaler, uint32_t clock_hz) {
    return static_cast<uint16_t>((plan.slot_cycles - timing::held_cycles(prescaler)) /
                                 static_cast<uint16_t>(clock_hz / 1000000));
}

}  // namespace ohmskin
