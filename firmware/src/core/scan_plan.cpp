// SPDX-License-Identifier: Apache-2.0
#include "core/scan_plan.h"

#include "core/scan_sequence.h"

namespace ohmskin {

using frames::Result;

namespace {

// A period is kept if it is off by at most one part of so many, 200 ppm. Chosen: the resonator of
// an Uno is off by up to 0.5 % anyway.
constexpr uint16_t PERIOD_PARTS = 5000;
// Numbers of slots that are tried for that. Chosen: where none of them keeps the period, as with
// small skins at fast rates, the best one is off by at most 0.12 % (tests:
// every_rate_that_fits_is_kept).
constexpr uint8_t SLOT_COUNTS_TRIED = 12;

bool known_prescaler(uint8_t prescaler) {
    return prescaler == static_cast<uint8_t>(frames::AdcPrescaler::Clock500khz) ||
           prescaler == static_cast<uint8_t>(frames::AdcPrescaler::Clock250khz) ||
           prescaler == static_cast<uint8_t>(frames::AdcPrescaler::Clock125khz);
}

Result check_limits(const ScanRequest &request) {
    if (request.rows < 1 || request.rows > frames::ROWS_MAX)
        return Result::BadRows;
    if (request.columns < 1 || request.columns > frames::COLUMNS_MAX)
        return Result::BadColumns;
    if (request.rate_mhz != 0 &&
        (request.rate_mhz < frames::RATE_MHZ_MIN || request.rate_mhz > frames::RATE_MHZ_MAX))
        return Result::BadRate;
    if (request.settle_us > frames::SETTLE_US_MAX)
        return Result::BadSettle;
    if (!known_prescaler(request.adc_prescaler))
        return Result::BadPrescaler;
    if (request.mode >= MODES)
        return Result::BadMode;
    return Result::Ok;
}

// Clock cycles of a scan's period: clock_hz * 1000 / rate_mhz, rounded. It is divided first,
// because a division of 64 bits is large and slow on an AVR: the remainder is below rate_mhz_max,
// so a thousand times it still fits into 32.
uint32_t period_cycles(uint32_t clock_hz, uint32_t rate_mhz) {
    static_assert(frames::RATE_MHZ_MAX <= 0xFFFFFFFF / 1000 - 1000, "remainder * 1000 overflows");
    const uint32_t whole = clock_hz / rate_mhz * 1000;
    const uint32_t rest = clock_hz % rate_mhz * 1000;
    return whole + (rest + rate_mhz / 2) / rate_mhz;
}

uint32_t difference(uint32_t a, uint32_t b) { return a > b ? a - b : b - a; }

// Divides a period into slots of equal whole cycles. A whole number of cycles a slot rarely gives
// the period exactly: the rounding error of a slot counts once a slot. One idle slot more or less
// changes that error. So numbers of slots are tried from `first` on, by `step`, down to `least`:
// the first one that keeps the period is taken, else the best one.
void divide(uint32_t period, uint16_t first, int8_t step, uint16_t least, uint16_t slot_min,
            ScanPlan *plan) {
    uint32_t best = 0xFFFFFFFF;
    uint16_t slots = first;
    for (uint8_t i = 0; i < SLOT_COUNTS_TRIED && slots >= least;
         i++, slots = static_cast<uint16_t>(slots + step)) {
        const uint32_t slot = (period + slots / 2) / slots;
        if (slot < slot_min)
            continue;
        const uint32_t error = difference(slot * slots, period);
        if (error < best) {
            best = error;
            plan->slot_cycles = static_cast<uint16_t>(slot);
            plan->slots_per_scan = slots;
        }
        if (error <= period / PERIOD_PARTS)
            break;
    }
}

}  // namespace

Result plan_scan(const ScanRequest &request, uint32_t clock_hz, ScanPlan *plan) {
    const Result limits = check_limits(request);
    if (limits != Result::Ok)
        return limits;

    const uint16_t readings = readings_in(request.rows, request.columns);
    const uint16_t cycles_per_us = static_cast<uint16_t>(clock_hz / 1000000);
    const uint8_t prescaler = request.adc_prescaler;
    uint16_t slot_min = timing::slot_min(prescaler);
    uint16_t least_us = request.settle_us;
    if (request.rate_mhz == 0 && least_us == 0)
        least_us = request.mode == static_cast<uint8_t>(frames::Mode::Far) ? timing::SETTLE_FAR_US
                                                                           : timing::SETTLE_US;
    const uint16_t settled =
        static_cast<uint16_t>(least_us * cycles_per_us + timing::held_cycles(prescaler));
    if (least_us != 0 && settled > slot_min)
        slot_min = settled;

    ScanPlan result = {slot_min, readings, 0};
    if (request.rate_mhz == 0) {
        // Small skins would be scanned faster than any rate that can be asked for. Idle slots keep
        // them to rate_mhz_max, with which the main loop keeps up.
        const uint32_t shortest = period_cycles(clock_hz, frames::RATE_MHZ_MAX);
        const uint16_t slots =
            static_cast<uint16_t>((shortest + result.slot_cycles - 1) / result.slot_cycles);
        if (slots > readings)
            result.slots_per_scan = slots;
        result.idle_slots = static_cast<uint16_t>(result.slots_per_scan - readings);
        *plan = result;
        return Result::Ok;
    }

    const uint32_t period = period_cycles(clock_hz, request.rate_mhz);
    if (period < static_cast<uint32_t>(slot_min) * readings)
        return Result::TooFast;
    if (request.settle_us != 0) {
        // Slots as short as they may be: the scan is over early, and its readings are close
        // together.
        const uint16_t most = static_cast<uint16_t>(period / slot_min);
        divide(period, most, -1, readings, slot_min, &result);
    } else {
        // Slots as long as they may be.
        uint16_t fewest = static_cast<uint16_t>((period - 1) / timing::SLOT_CYCLES_MAX + 1);
        if (fewest < readings)
            fewest = readings;
        divide(period, fewest, 1, fewest, slot_min, &result);
    }
    result.idle_slots = static_cast<uint16_t>(result.slots_per_scan - readings);
    *plan = result;
    return Result::Ok;
}

}  // namespace ohmskin
