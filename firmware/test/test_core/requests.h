// SPDX-License-Identifier: Apache-2.0
// Requests of whole scans, and their plans at 500 kbaud, for several test files.
#pragma once

#include "core/scan_plan.h"

constexpr uint16_t CYCLES_PER_BYTE = 320;  // at 16 MHz

OHMSKIN_APART inline ohmskin::ScanRequest scan_request(uint8_t rows, uint8_t columns,
                                                       uint32_t rate_mhz, uint16_t settle_us = 0,
                                                       uint8_t accuracy = 0, uint8_t mode = 0) {
    return ohmskin::ScanRequest{rows,
                                columns,
                                accuracy,
                                (uint32_t{1} << rows) - 1,
                                (uint32_t{1} << columns) - 1,
                                rate_mhz,
                                settle_us,
                                mode,
                                0,
                                0};
}

OHMSKIN_APART inline ohmskin::frames::Result plan_of(const ohmskin::ScanRequest &request,
                                                     ohmskin::ScanPlan *plan) {
    ohmskin::Routes routes;
    uint32_t rate_mhz;
    const auto result = ohmskin::plan_scan(request, CYCLES_PER_BYTE, &routes, &rate_mhz);
    if (result == ohmskin::frames::Result::Ok)
        *plan = routes.region.plan;
    return result;
}

inline ohmskin::ScanPlan plan_of(const ohmskin::ScanRequest &request) {
    ohmskin::ScanPlan plan = {0, 0, 0};
    plan_of(request, &plan);
    return plan;
}

// A route of all cells, for the scanner alone.
OHMSKIN_APART inline ohmskin::Route whole_route(uint8_t rows, uint8_t columns, uint8_t pattern,
                                                uint16_t idle_slots) {
    const uint8_t count = ohmskin::PATTERN_DEFINITIONS[pattern].count;
    const uint16_t readings = static_cast<uint16_t>(rows * columns * count);
    return ohmskin::Route{static_cast<ohmskin::LineMask>((uint32_t{1} << rows) - 1),
                          static_cast<ohmskin::LineMask>((uint32_t{1} << columns) - 1),
                          pattern,
                          {688, readings, idle_slots},
                          0};
}
