// SPDX-License-Identifier: Apache-2.0
// The plan of a scan, its order, and the scanner's pipeline.
#include "../check.h"

#include "core/scan_plan.h"
#include "core/scanner.h"

using namespace ohmskin;
using frames::Result;

namespace {

constexpr uint32_t CLOCK_HZ = 16000000;

ScanRequest request(uint8_t rows, uint8_t columns, uint32_t rate_mhz, uint16_t settle_us = 0,
                    uint8_t prescaler = 32) {
    return ScanRequest{rows, columns, rate_mhz, settle_us, prescaler, 0};
}

// The code a fake skin gives for a selection, unique up to 16x16 within 10 bits of each cell's
// part.
uint16_t code_of(const Selection &s) {
    return static_cast<uint16_t>((s.row * 16 + s.column) << 2 | s.pattern_entry);
}

// Runs slots the way the hardware does: hold, set the pins, step.
struct Pipeline {
    Selection pins = {0, 0, 0};
    uint16_t result = 0x3FF;

    void slot(Scanner &scanner) {
        const uint16_t code = result;
        result = code_of(pins);
        pins = scanner.selection();
        scanner.step(code, true);
    }
};

// Takes what there is, and checks that each scan's codes come in order, from its first one.
struct Taker {
    ScanSequence expected;
    uint8_t rows, columns;
    uint16_t codes = 0, scans = 0, whole = 0;  // of the scan at hand; begun; come to their end
    uint8_t number = 0xFF;

    Taker(uint8_t r, uint8_t c) : rows(r), columns(c) {}
    void take(Scanner &scanner) {
        for (; scanner.has_group(); scanner.release_group()) {
            if (scanner.starts_scan()) {
                number = scanner.scan_number();
                expected.begin(rows, columns, 0);
                codes = 0;
                scans++;
            }
            for (uint8_t i = 0; i < Scanner::GROUP; i++, expected.next())
                CHECK_EQ(code_of(expected.at()), scanner.group()[i] & Scanner::CODE);
            codes = static_cast<uint16_t>(codes + Scanner::GROUP);
            if (codes == readings_in(rows, columns))
                whole++;
        }
    }
};

}  // namespace

TEST(ninety_hertz_is_kept_to_50_mhz_and_leaves_20_us_to_settle) {
    ScanPlan plan;
    CHECK_EQ(Result::Ok, plan_scan(request(8, 8, 90000), CLOCK_HZ, &plan));
    CHECK_EQ(plan.slots_per_scan - 256, plan.idle_slots);
    const uint32_t mhz = static_cast<uint32_t>(1000.0 * CLOCK_HZ / plan.scan_cycles());
    CHECK(mhz >= 89950 && mhz <= 90050);
    CHECK(settle_us(plan, 32, CLOCK_HZ) >= 20);
}

TEST(every_rate_that_fits_is_kept) {
    const uint8_t sizes[][2] = {{1, 1}, {2, 2}, {3, 5}, {8, 8}, {16, 16}};
    for (const auto &size : sizes)
        for (uint32_t rate = 1000; rate <= 2000000; rate = rate * 5 / 4 + 7) {
            ScanPlan plan;
            const ScanRequest r = request(size[0], size[1], rate);
            const uint16_t readings = readings_in(size[0], size[1]);
            const double period = 1000.0 * CLOCK_HZ / rate;
            const bool fits = period >= 480.0 * readings + 1;
            const Result result = plan_scan(r, CLOCK_HZ, &plan);
            if (!fits) {
                CHECK(result == Result::TooFast || period >= 480.0 * readings - 1);
                continue;
            }
            CHECK_EQ(Result::Ok, result);
            CHECK(plan.slot_cycles >= 480 && plan.slots_per_scan >= readings);
            const double off = plan.scan_cycles() / period - 1;
            CHECK(off < 0.0012 && off > -0.0012);
        }
}

TEST(rate_zero_is_as_fast_as_nodes_settle) {
    const uint8_t prescalers[] = {32, 64, 128};
    for (uint8_t prescaler : prescalers) {
        ScanPlan plan;
        CHECK_EQ(Result::Ok, plan_scan(request(8, 8, 0, 0, prescaler), CLOCK_HZ, &plan));
        // From the hold, 11.5 ADC clocks to the conversion's end, and 20 us; 15 ADC clocks at
        // least.
        const uint16_t settled = static_cast<uint16_t>(prescaler * 23 / 2 + 320);
        CHECK_EQ(prescaler == 128 ? 15 * 128 : settled, plan.slot_cycles);
        CHECK_EQ(256, plan.slots_per_scan);
        CHECK(settle_us(plan, prescaler, CLOCK_HZ) >= 20);
        // A shorter settle time is kept, too, down to 15 ADC clocks a slot.
        CHECK_EQ(Result::Ok, plan_scan(request(8, 8, 0, 1, prescaler), CLOCK_HZ, &plan));
        CHECK_EQ(prescaler * 15, plan.slot_cycles);
    }
}

TEST(a_settle_time_is_kept_and_the_rest_of_the_period_is_idle) {
    ScanPlan plan;
    CHECK_EQ(Result::Ok, plan_scan(request(4, 4, 90000, 30), CLOCK_HZ, &plan));
    CHECK(settle_us(plan, 32, CLOCK_HZ) >= 30 && settle_us(plan, 32, CLOCK_HZ) <= 33);
    CHECK(plan.idle_slots > 64);
    CHECK_EQ(Result::TooFast, plan_scan(request(8, 8, 90000, 21), CLOCK_HZ, &plan));
}

TEST(what_is_out_of_range_is_refused_by_name) {
    ScanPlan plan;
    CHECK_EQ(Result::BadRows, plan_scan(request(0, 8, 90000), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadRows, plan_scan(request(17, 8, 90000), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadColumns, plan_scan(request(8, 0, 90000), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadColumns, plan_scan(request(8, 17, 90000), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadRate, plan_scan(request(8, 8, 999), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadRate, plan_scan(request(8, 8, 2000001), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadSettle, plan_scan(request(8, 8, 90000, 3001), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadPrescaler, plan_scan(request(8, 8, 90000, 0, 16), CLOCK_HZ, &plan));
    CHECK_EQ(Result::BadPrescaler, plan_scan(request(8, 8, 90000, 0, 33), CLOCK_HZ, &plan));
    CHECK_EQ(Result::TooFast, plan_scan(request(8, 8, 150000), CLOCK_HZ, &plan));
}

TEST(a_scan_passes_over_all_cells_twice_and_rows_run_fastest) {
    for (uint8_t pattern = 0; pattern < PATTERNS; pattern++) {
        ScanSequence sequence;
        sequence.begin(2, 3, pattern);
        for (uint8_t first = 0; first < 4; first = static_cast<uint8_t>(first + 2))
            for (uint8_t column = 0; column < 3; column++)
                for (uint8_t row = 0; row < 2; row++)
                    for (uint8_t n = first; n < first + 2; n++) {
                        CHECK_EQ(row << 8 | column, sequence.at().row << 8 | sequence.at().column);
                        CHECK_EQ(pattern * 4 + n, sequence.at().pattern_entry);
                        const bool last = column == 2 && row == 1 && n == 3;
                        CHECK_EQ(last, sequence.next());
                    }
        CHECK_EQ(0, sequence.at().column);
        CHECK_EQ(pattern * 4, sequence.at().pattern_entry);
    }
}

TEST(every_code_is_of_the_reading_it_is_counted_for) {
    const uint8_t sizes[][2] = {{1, 1}, {3, 1}, {3, 2}, {16, 16}};
    const uint16_t idle_counts[] = {0, 1, 2, 7};
    for (const auto &size : sizes)
        for (uint16_t idle : idle_counts) {
            Scanner scanner;
            Pipeline pipeline;
            Taker taker(size[0], size[1]);
            scanner.begin(size[0], size[1], 0, idle);
            const uint16_t readings = readings_in(size[0], size[1]);
            const uint16_t scans = 3;
            uint16_t slots = 0;
            for (; taker.whole < scans && slots < 4 * scans * readings + 100; slots++) {
                pipeline.slot(scanner);
                taker.take(scanner);
            }
            CHECK_EQ(scans, taker.scans);
            // Two slots of lead-in, one until the last conversion is done.
            CHECK_EQ(2 + scans * readings + (scans - 1) * idle + 1, slots);
        }
}

TEST(a_stop_ends_with_a_whole_scan) {
    const uint16_t idle_counts[] = {0, 1, 5};
    for (uint16_t idle : idle_counts)
        for (uint16_t stop_at = 0; stop_at < 40; stop_at++) {
            Scanner scanner;
            Pipeline pipeline;
            scanner.begin(2, 1, 0, idle);
            uint16_t taken = 0;
            for (uint16_t slot = 0; !scanner.parked(); slot++) {
                if (slot == stop_at)
                    scanner.stop_after_scan();
                if (!CHECK(slot < 100))
                    break;
                pipeline.slot(scanner);
                for (; scanner.has_group(); taken++)
                    scanner.release_group();
            }
            CHECK_EQ(0, taken % 2);
            pipeline.slot(scanner);
            CHECK(!scanner.has_group());
        }
}

TEST(a_late_main_loop_cuts_scans_short_and_never_leaves_holes) {
    // Pauses of every length in the reading of 5x1 scans: what is taken of a scan is its beginning,
    // and its number is right.
    for (uint16_t pause = 0; pause < 200; pause++) {
        Scanner scanner;
        Pipeline pipeline;
        Taker taker(5, 1);
        scanner.begin(5, 1, 0, 3);
        for (uint16_t slot = 0; slot < 2 + 20 * 23 + 1; slot++) {
            pipeline.slot(scanner);
            if (slot % 230 >= pause)
                taker.take(scanner);
        }
        CHECK_EQ(19, taker.number);  // the last of 20 scans is taken whole
        CHECK_EQ(20, taker.codes);
        CHECK(pause > 100 ? taker.scans < 20 : taker.scans == 20 || pause > 60);
    }
}

TEST(a_late_conversion_costs_its_scan_and_no_other_is_wrong) {
    // It ends after the next slot's interrupt: the trigger of that slot is ignored, and the code
    // arrives where that slot's is expected. A scan has 12 readings and 2 idle slots.
    for (uint16_t late = 0; late < 3 * 14; late++) {
        Scanner scanner;
        Pipeline pipeline;
        Taker taker(3, 1);
        scanner.begin(3, 1, 0, 2);
        Selection held = pipeline.pins;
        for (uint16_t slot = 0; slot < 2 + 6 * 14 + 1; slot++) {
            const uint16_t code = pipeline.result;
            if (slot != late + 1)
                held = pipeline.pins;
            if (slot != late)
                pipeline.result = code_of(held);
            pipeline.pins = scanner.selection();
            scanner.step(code, slot != 0 && slot != late + 1);
            taker.take(scanner);
        }
        CHECK_EQ(5, taker.number);  // a scan that is left out is counted
        const bool only_idle = (late + 12) % 14 == 12;
        CHECK_EQ(only_idle ? 6 : 5, taker.whole);
    }
}
