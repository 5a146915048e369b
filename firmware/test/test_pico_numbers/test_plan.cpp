// SPDX-License-Identifier: Apache-2.0
// The plan of a scan where slots are as short as a Pico's.
#include "../check.h"

#include "core/scan_plan.h"

using namespace ohmskin;
using frames::Result;

namespace ohmskin {
void keep_pace() {}
}  // namespace ohmskin

namespace {

ScanRequest request(uint8_t lines, uint32_t rate_mhz, uint16_t settle_us) {
    const uint32_t mask = (uint32_t{1} << lines) - 1;
    return ScanRequest{lines, lines, 0, mask, mask, rate_mhz, settle_us, 0, 0, 0};
}

// By how much the rate of a request's plan is off, as a part of it; -1: there is no plan.
double off(const ScanRequest &request) {
    Routes routes;
    uint32_t kept;
    const uint16_t per_byte = board::cycles_per_byte(frames::BAUD_DEFAULT);
    if (plan_scan(request, per_byte, &routes, &kept) != Result::Ok)
        return -1;
    const ScanPlan &plan = routes.region.plan;
    CHECK(plan.slot_cycles >= board::slot_min(0));
    CHECK(settle_us(plan, 0) >= request.settle_us);
    CHECK(plan.slots() >= plan.readings);
    const double rate = 1000.0 * CLOCK_HZ / plan.scan_cycles() / request.rate_mhz;
    return rate < 1 ? 1 - rate : rate - 1;
}

}  // namespace

TEST(every_rate_that_fits_is_kept) {
    const uint8_t sizes[] = {1, 2, 5, 8, 16};
    const uint16_t settle_times_us[] = {0, 1, 7, 12, 20, 100};
    for (uint8_t lines : sizes)
        for (uint16_t settle : settle_times_us)
            for (uint32_t rate = 1000; rate <= 50000000; rate = rate * 26 / 25 + 1)
                CHECK(off(request(lines, rate, settle)) < 0.004);
}

// With slots of 10 us, that many come in 0.655 s.
TEST(a_slow_scan_has_no_more_slots_than_16_bits_count) {
    const uint8_t sizes[] = {1, 8, 16};
    for (uint8_t lines : sizes)
        for (uint32_t rate = 1000; rate < 2000; rate++)
            for (uint16_t settle = 1; settle < 15; settle++) {
                const double part = off(request(lines, rate, settle));
                CHECK(part >= 0 && part < 0.0012);
            }
}
