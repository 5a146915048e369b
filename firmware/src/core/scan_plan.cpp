// SPDX-License-Identifier: Apache-2.0
#include "core/scan_plan.h"

#include "board.h"
#include "core/frame_writer.h"

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

// Bytes of the ring that scans leave free, for a hello and its ack. Answers may be sent only
// between two scans. If scans filled the ring to its end, an answer would find no room at that
// moment, and might wait for ever. (A report of the self-test is sent while no scans are.)
constexpr uint16_t ANSWERS_SPACE =
    FrameWriter::line_bytes(sizeof(frames::Hello)) + FrameWriter::line_bytes(sizeof(frames::Ack));

bool is_part(uint32_t mask, uint8_t lines) {
    return mask != 0 && (lines >= 32 || mask >> lines == 0);
}

Result check_limits(const ScanRequest &request) {
    if (request.rows < 1 || request.rows > ROWS_MAX || !is_part(request.row_mask, request.rows))
        return Result::BadRows;
    if (request.columns < 1 || request.columns > COLUMNS_MAX ||
        !is_part(request.column_mask, request.columns))
        return Result::BadColumns;
    if (request.rate_mhz != 0 &&
        (request.rate_mhz < frames::RATE_MHZ_MIN || request.rate_mhz > frames::RATE_MHZ_MAX))
        return Result::BadRate;
    if (request.settle_us > frames::SETTLE_US_MAX)
        return Result::BadSettle;
    if (request.accuracy > static_cast<uint8_t>(frames::Accuracy::Finest))
        return Result::BadAccuracy;
    if (request.mode >= MODES || request.whole_mode >= MODES)
        return Result::BadMode;
    return Result::Ok;
}

OHMSKIN_RARE uint8_t count_of(LineMask mask) {
    uint8_t count = 0;
    for (; mask != 0; mask = static_cast<LineMask>(mask >> 1))
        count = static_cast<uint8_t>(count + (mask & 1));
    return count;
}

// 1000 * dividend / divisor, rounded down or to the nearest. A digit at a time, because a division
// of 64 bits is large and slow on an AVR; the divisor must be below 2^32 / 10.
OHMSKIN_RARE uint32_t thousand_times(uint32_t dividend, uint32_t divisor, bool to_nearest) {
    uint32_t quotient = dividend / divisor, rest = dividend % divisor;
    for (uint8_t digit = 0; digit < 3; digit++) {
        rest *= 10;
        quotient = quotient * 10 + rest / divisor;
        rest %= divisor;
    }
    return quotient + (to_nearest && rest >= divisor - rest);
}
static_assert(frames::RATE_MHZ_MAX < 0xFFFFFFFF / 10, "thousand_times() divides by it");

uint32_t difference(uint32_t a, uint32_t b) { return a > b ? a - b : b - a; }

// Divides a period into slots of equal whole cycles. A whole number of cycles a slot rarely gives
// the period exactly: the rounding error of a slot counts once a slot. One idle slot more or less
// changes that error. So `tried` numbers of slots are, from `first` on, by `step`, down to `least`:
// the first one that keeps the period is taken, else the best one.
OHMSKIN_RARE void divide(uint32_t period, uint16_t first, int8_t step, uint8_t tried,
                         uint16_t least, uint16_t slot_min, ScanPlan *plan) {
    uint32_t best = 0xFFFFFFFF;
    uint16_t slots = first;
    for (uint8_t i = 0; i < tried && slots >= least;
         i++, slots = static_cast<uint16_t>(slots + step)) {
        keep_pace();
        const uint32_t slot = (period + slots / 2) / slots;
        if (slot < slot_min)
            continue;
        const uint32_t error = difference(slot * slots, period);
        if (error < best) {
            best = error;
            plan->slot_cycles = static_cast<uint16_t>(slot);
            plan->idle_slots = static_cast<uint16_t>(slots - plan->readings);
        }
        if (error <= period / PERIOD_PARTS)
            break;
    }
}

// Where slots are as long as may be, the processor has the time of so many more than a scan has
// readings: some are idle, and readings that fill no group of four take longer. Measured:
// tests/firmware, test_the_rate_that_is_answered_is_kept_for_long, fails where they are fewer.
constexpr uint8_t SPARE_SLOTS = 3;
static_assert(SPARE_SLOTS >= IDLE_TO_CHANGE, "those are among them");

// Plans one kind of scan. idle_min: idle slots that it needs, because scans of another kind follow.
class Planner {
  public:
    Planner(uint16_t cycles_per_byte, uint8_t accuracy, uint8_t idle_min)
        : cycles_per_byte_(cycles_per_byte), accuracy_(accuracy), idle_min_(idle_min) {}

    // `route` has all but its plan. Returns Ok or why not; fastest_cycles() is known then.
    OHMSKIN_RARE Result plan(Route *route, uint32_t rate_mhz, uint16_t settle) {
        keep_pace();
        ScanPlan &plan = route->plan;
        const uint8_t cells_rows = count_of(route->rows);
        plan.readings = static_cast<uint16_t>(cells_rows * count_of(route->columns) *
                                              PATTERN_DEFINITIONS[route->pattern].count);
        uint16_t least_us = settle;
        if (rate_mhz == 0 && settle == 0)
            least_us = timing::SETTLE_US[route->pattern < MODES ? route->pattern : 0];
        const uint32_t settled = cycles_of(least_us) + board::held_cycles(accuracy_);
        if (settled > timing::SLOT_CYCLES_MAX)
            return Result::BadSettle;
        uint16_t slot_min = board::slot_min(accuracy_);
        if (least_us != 0 && settled > slot_min)
            slot_min = static_cast<uint16_t>(settled);
        const bool few = plan.readings <= FEW;
        const uint8_t idle_min = few ? IDLE_OF_FEW : idle_min_;
        const uint16_t least = static_cast<uint16_t>(plan.readings + idle_min);

        const uint32_t by_line = line_cycles(plan.readings);
        // The processor has what the interrupts of all slots leave, which are few where slots are
        // as long as may be.
        uint32_t by_processor =
            board::BUSY_A_SCAN + uint32_t{board::BUSY_A_READING} * plan.readings;
        if (rate_mhz != 0 && settle == 0)
            by_processor += uint32_t{board::BUSY_A_SLOT} *
                            (plan.readings + (few ? IDLE_OF_FEW + SPARE_SLOTS : SPARE_SLOTS));
        else
            by_processor += by_processor * board::BUSY_A_SLOT / (slot_min - board::BUSY_A_SLOT);
        fastest_ = uint32_t{slot_min} * least;
        if (fastest_ < by_processor)
            fastest_ = by_processor;
        const bool line_limits = by_line > fastest_;
        if (line_limits)
            fastest_ = by_line;

        plan.slot_cycles = slot_min;
        if (rate_mhz == 0) {
            const uint16_t slots = static_cast<uint16_t>((fastest_ + slot_min - 1) / slot_min);
            plan.idle_slots = static_cast<uint16_t>(slots - plan.readings);
            fastest_ = plan.scan_cycles();
            return limited(route);
        }
        const uint32_t period = thousand_times(CLOCK_HZ, rate_mhz, true);
        if (period < fastest_)
            return line_limits ? Result::LineTooSlow : Result::TooFast;
        if (settle != 0) {
            // Slots as short as they may be: the scan is over early, and its readings are close
            // together. But no shorter than that 16 bits count them.
            const uint16_t counted = static_cast<uint16_t>((period >> 16) + 1);
            if (slot_min < counted)
                slot_min = counted;
            divide(period, static_cast<uint16_t>(period / slot_min), -1, SLOT_COUNTS_TRIED, least,
                   slot_min, &plan);
        } else {
            // Slots as long as they may be, and no more than the processor has the time for.
            uint16_t fewest = static_cast<uint16_t>((period - 1) / timing::SLOT_CYCLES_MAX + 1);
            if (fewest < least)
                fewest = least;
            uint8_t tried = 1;
            for (uint32_t left = period - by_processor;
                 tried < SLOT_COUNTS_TRIED && left >= board::BUSY_A_SLOT;
                 left -= board::BUSY_A_SLOT)
                tried++;
            divide(period, fewest, 1, tried, fewest, slot_min, &plan);
        }
        return limited(route);
    }

    uint32_t fastest_cycles() const { return fastest_; }

  private:
    // How full the ring may be where a scan begins.
    //
    // The bytes of a scan come in at a known pace and leave at a known pace. So the most that the
    // ring can hold during a scan is known when it begins: what it holds then, or one open block
    // that cannot leave yet, and what comes in faster than it leaves. A scan begins only where that
    // fits, hence no scan is torn.
    Result limited(Route *route) const {
        const ScanPlan &of_route = route->plan;
        const uint16_t frame = FrameWriter::line_bytes(scan_payload(of_route.readings));
        uint32_t leaves = uint32_t{of_route.slot_cycles} * of_route.readings / cycles_per_byte_;
        leaves -= leaves / timing::LINE_IDLE_PART;
        const uint32_t excess = frame > leaves ? frame - leaves : 0;
        const uint16_t most = FrameWriter::SIZE - 1 - ANSWERS_SPACE;
        const bool fits = excess + FrameWriter::LONGEST_BLOCK <= most;
        route->ring_limit = fits ? static_cast<uint16_t>(most - excess) : 0;
        return fits ? Result::Ok : Result::LineTooSlow;
    }

    // Clock cycles in which the line carries a scan.
    uint32_t line_cycles(uint16_t readings) const {
        const uint32_t bytes = FrameWriter::line_bytes(scan_payload(readings));
        const uint32_t cycles = bytes * cycles_per_byte_;
        return cycles + cycles / (timing::LINE_IDLE_PART - 1);
    }

    uint16_t cycles_per_byte_;
    uint8_t accuracy_, idle_min_;
    uint32_t fastest_ = 0;
};

LineMask all_lines(uint8_t count) {
    return static_cast<LineMask>(static_cast<LineMask>(~LineMask{0}) >>
                                 (8 * sizeof(LineMask) - count));
}

}  // namespace

Result plan_scan(const ScanRequest &request, uint16_t cycles_per_byte, Routes *routes,
                 uint32_t *rate_mhz) {
    *rate_mhz = 0;
    const Result limits = check_limits(request);
    if (limits != Result::Ok)
        return limits;
    const uint8_t idle_min = request.whole_every != 0 ? IDLE_TO_CHANGE : 0;
    Planner planner(cycles_per_byte, request.accuracy, idle_min);
    Routes found;
    found.whole_every = request.whole_every;
    // Field by field: an initializer would clear plans first.
    found.whole.rows = all_lines(request.rows);
    found.whole.columns = all_lines(request.columns);
    found.whole.pattern = request.whole_mode;
    found.region.rows = static_cast<LineMask>(request.row_mask);
    found.region.columns = static_cast<LineMask>(request.column_mask);
    found.region.pattern = request.mode;
    Result result = planner.plan(&found.whole, 0, 0);
    if (result == Result::Ok || request.whole_every == 0)
        result = planner.plan(&found.region, request.rate_mhz, request.settle_us);
    const bool fits = result == Result::Ok;
    if (fits || result == Result::TooFast || result == Result::LineTooSlow)
        *rate_mhz = thousand_times(
            CLOCK_HZ, fits ? found.region.plan.scan_cycles() : planner.fastest_cycles(), fits);
    if (fits)
        *routes = found;
    return result;
}

Route plan_whole(uint8_t rows, uint8_t columns, uint8_t pattern, uint16_t settle,
                 uint16_t cycles_per_byte) {
    Route route = {all_lines(rows), all_lines(columns), pattern, {}, 0};
    Planner(cycles_per_byte, static_cast<uint8_t>(frames::Accuracy::Usual), 0)
        .plan(&route, 0, settle);
    return route;
}

}  // namespace ohmskin
