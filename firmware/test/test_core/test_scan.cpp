// SPDX-License-Identifier: Apache-2.0
// The plan of a scan, its order, and the scanner's pipeline.
#include "../check.h"

#include "core/scanner.h"
#include "requests.h"

using namespace ohmskin;
using frames::Result;

namespace {

ScanRequest request(uint8_t rows, uint8_t columns, uint32_t rate_mhz, uint16_t settle_us = 0,
                    uint8_t accuracy = 0) {
    return scan_request(rows, columns, rate_mhz, settle_us, accuracy);
}

uint16_t readings_in(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(4 * rows * columns);
}

// Prescaler of each accuracy.
const uint8_t PRESCALERS[] = {32, 64, 128};

// The code a fake skin gives for a selection, unique up to 16x16 within 10 bits of each cell's
// part.
uint16_t code_of(const Selection &s) {
    return static_cast<uint16_t>((s.row * 16 + s.column) << 2 | s.pattern_entry);
}

// Out of line: an Uno has no flash for as many copies.
OHMSKIN_APART void begin(Scanner &scanner, const Route &route) { scanner.begin(route); }
OHMSKIN_APART void step(Scanner &scanner, uint16_t code, uint8_t converted) {
    scanner.step(code, converted);
}
OHMSKIN_APART void follow(ScanSequence *sequence, Lines *lines, Steps *steps, const Route &route) {
    lines->set(route.rows, route.columns);
    steps->set(route);
    sequence->begin(*lines, *steps);
}
OHMSKIN_APART bool next(ScanSequence &sequence) { return sequence.next(); }

// Runs slots the way the hardware does: hold, set the pins, step.
struct Pipeline {
    Selection pins = {0, 0, 0};
    uint16_t result = 0x3FF;

    OHMSKIN_APART void slot(Scanner &scanner) {
        const uint16_t code = result;
        result = code_of(pins);
        pins = scanner.selection();
        step(scanner, code, 1);
    }
};

// Takes what there is, and checks that each scan's codes come in order, from its first one.
struct Taker {
    ScanSequence expected;
    Route route;
    Lines lines;
    Steps steps;
    uint8_t rows, columns;
    uint16_t codes = 0, scans = 0, whole = 0;  // of the scan at hand; begun; come to their end
    uint8_t number = 0xFF;

    Taker(uint8_t r, uint8_t c) : route(whole_route(r, c, 0, 0)), rows(r), columns(c) {}
    OHMSKIN_APART void take(Scanner &scanner) {
        for (; scanner.has_group(); scanner.release_group()) {
            if (scanner.starts_scan()) {
                number = scanner.scan_number();
                follow(&expected, &lines, &steps, route);
                codes = 0;
                scans++;
            }
            for (uint8_t i = 0; i < Scanner::GROUP; i++, next(expected))
                CHECK_EQ(code_of(expected.at()), scanner.group()[i]);
            codes = static_cast<uint16_t>(codes + Scanner::GROUP);
            if (codes == readings_in(rows, columns))
                whole++;
        }
    }
};

}  // namespace

TEST(ninety_hertz_is_kept_to_50_mhz_and_leaves_20_us_to_settle) {
    ScanPlan plan;
    CHECK_EQ(Result::Ok, plan_of(request(8, 8, 90000), &plan));
    CHECK_EQ(plan.slots() - 256, plan.idle_slots);
    const uint32_t mhz = static_cast<uint32_t>(1000.0 * CLOCK_HZ / plan.scan_cycles());
    CHECK(mhz >= 89950 && mhz <= 90050);
    CHECK(settle_us(plan, 0) >= 20);
}

TEST(every_rate_that_fits_is_kept) {
    const uint8_t sizes[][2] = {{1, 1}, {2, 2}, {3, 5}, {8, 8}, {16, 16}};
    for (const auto &size : sizes)
        for (uint32_t rate = 1000; rate <= 2000000; rate = rate * 5 / 4 + 7) {
            ScanPlan plan;
            const ScanRequest r = request(size[0], size[1], rate);
            const uint16_t readings = readings_in(size[0], size[1]);
            const double period = 1000.0 * CLOCK_HZ / rate;
            const Result result = plan_of(r, &plan);
            if (period < 480.0 * readings - 1)
                CHECK(result != Result::Ok);
            if (result != Result::Ok) {
                // The line carries nine tenths of what it could, at the least.
                const double line = (28 + 1.25 * readings + 8) * CYCLES_PER_BYTE;
                const double busy = 6000 + 450.0 * readings;
                CHECK(period < 480.0 * readings + 1 || period < 1.25 * line || period < busy);
                continue;
            }
            CHECK(plan.slot_cycles >= 480 && plan.slots() >= readings);
            const double off = plan.scan_cycles() / period - 1;
            CHECK(off < 0.0012 && off > -0.0012);
        }
}

TEST(rate_zero_is_as_fast_as_nodes_settle) {
    for (uint8_t accuracy = 0; accuracy < 3; accuracy++) {
        const uint8_t prescaler = PRESCALERS[accuracy];
        ScanPlan plan;
        CHECK_EQ(Result::Ok, plan_of(request(8, 8, 0, 0, accuracy), &plan));
        // From the hold, 11.5 ADC clocks to the conversion's end, and 20 us; 15 ADC clocks at
        // least.
        const uint16_t settled = static_cast<uint16_t>(prescaler * 23 / 2 + 320);
        CHECK_EQ(prescaler == 128 ? 15 * 128 : settled, plan.slot_cycles);
        CHECK_EQ(256, plan.slots());
        CHECK(settle_us(plan, accuracy) >= 20);
        // A shorter settle time is kept, too, down to 15 ADC clocks a slot.
        CHECK_EQ(Result::Ok, plan_of(request(6, 6, 0, 1, accuracy), &plan));
        CHECK_EQ(prescaler * 15, plan.slot_cycles);
    }
}

TEST(a_settle_time_is_kept_and_the_rest_of_the_period_is_idle) {
    ScanPlan plan;
    CHECK_EQ(Result::Ok, plan_of(request(4, 4, 90000, 30), &plan));
    CHECK(settle_us(plan, 0) >= 30 && settle_us(plan, 0) <= 33);
    CHECK(plan.idle_slots > 64);
    CHECK_EQ(Result::TooFast, plan_of(request(8, 8, 90000, 21), &plan));
}

TEST(what_is_out_of_range_is_refused_by_name) {
    ScanPlan plan;
    CHECK_EQ(Result::BadRows, plan_of(request(0, 8, 90000), &plan));
    CHECK_EQ(Result::BadRows, plan_of(request(17, 8, 90000), &plan));
    CHECK_EQ(Result::BadColumns, plan_of(request(8, 0, 90000), &plan));
    CHECK_EQ(Result::BadColumns, plan_of(request(8, 17, 90000), &plan));
    CHECK_EQ(Result::BadRate, plan_of(request(8, 8, 999), &plan));
    CHECK_EQ(Result::BadRate, plan_of(request(8, 8, 50000001), &plan));
    CHECK_EQ(Result::BadSettle, plan_of(request(8, 8, 90000, 3001), &plan));
    CHECK_EQ(Result::BadAccuracy, plan_of(request(8, 8, 90000, 0, 3), &plan));
    CHECK_EQ(Result::TooFast, plan_of(request(16, 16, 40000), &plan));
    CHECK_EQ(Result::LineTooSlow, plan_of(request(8, 8, 150000), &plan));
}

TEST(a_scan_passes_over_all_cells_and_rows_run_fastest) {
    // Rows and columns of the masks, and passes of each pattern: first and second reading of each.
    const uint8_t rows[] = {1, 4, 15}, columns[] = {0, 2};
    for (uint8_t pattern = 0; pattern < PATTERNS; pattern++) {
        const uint8_t count = pattern == 2 ? 2 : pattern == 3 ? 1 : 4;
        const uint8_t together = pattern == 3 ? 1 : 2;
        const Route route = {0x8012, 0x0005, pattern, {688, 0, 0}, 0};
        Lines lines;
        Steps steps;
        ScanSequence sequence;
        follow(&sequence, &lines, &steps, route);
        for (uint8_t twice = 0; twice < 2; twice++)
            for (uint8_t first = 0; first < count; first = static_cast<uint8_t>(first + together))
                for (uint8_t column : columns)
                    for (uint8_t row : rows)
                        for (uint8_t n = first; n < first + together; n++) {
                            CHECK_EQ(row << 8 | column,
                                     sequence.at().row << 8 | sequence.at().column);
                            CHECK_EQ(pattern * 4 + n, sequence.at().pattern_entry);
                            const bool last = column == 2 && row == 15 && n == count - 1;
                            CHECK_EQ(last, next(sequence));
                        }
    }
}

#ifndef __AVR_ATmega328P__  // an Uno has no flash for all of them
TEST(masks_of_any_lines_are_followed) {
    for (uint32_t mask = 1; mask < 0x10000; mask = mask * 5 / 4 + 1) {
        const LineMask lines = static_cast<LineMask>(mask);
        Lines next;
        next.set(lines, static_cast<LineMask>(1));
        uint8_t row = Lines::first(lines);
        uint32_t seen = 0;
        do {
            CHECK(!(seen >> row & 1));
            seen |= uint32_t{1} << row;
            const uint8_t after = next.row_after(row);
            CHECK(after > row || after == Lines::first(lines));
            row = after;
        } while (row != Lines::first(lines));
        CHECK_EQ(mask, seen);
    }
}

TEST(whole_scans_come_as_often_as_asked_whatever_changes) {
    Turns turns;
    turns.begin();
    uint16_t whole = 0;
    for (uint16_t scan = 0; scan < 300; scan++) {
        if (scan % 7 == 3)
            turns.change();
        whole = static_cast<uint16_t>(whole + turns.next_is_whole(10));
    }
    CHECK(whole == 29 || whole == 30);
    CHECK(!turns.next_is_whole(0));
    turns.begin();
    CHECK(turns.next_is_whole(10));
    CHECK(!turns.next_is_whole(2));  // nine were left, of which the new number takes one
    CHECK(turns.next_is_whole(2));
    CHECK(turns.next_is_whole(1));
}

TEST(a_whole_scan_that_is_due_lets_a_new_region_go_first_once) {
    for (uint8_t every = 2; every < 5; every++) {
        Turns turns;
        turns.begin();
        uint8_t region = 0, whole = 0;
        for (uint8_t scan = 0; scan < 60; scan++) {
            turns.change();
            if (turns.next_is_whole(every)) {
                CHECK(region >= 1 && region <= every);
                region = 0;
                whole++;
            } else {
                region++;
            }
        }
        CHECK_EQ(60 / (every + 1), whole);
    }
    Turns turns;
    turns.begin();
    turns.change();
    CHECK(turns.next_is_whole(1));  // all of them are whole
}
#endif

TEST(every_code_is_of_the_reading_it_is_counted_for) {
    const uint8_t sizes[][2] = {{1, 1}, {3, 1}, {3, 2}, {16, 16}};
    const uint16_t idle_counts[] = {0, 1, 2, 7};
    for (const auto &size : sizes)
        for (uint16_t idle : idle_counts) {
            Scanner scanner;
            Pipeline pipeline;
            Taker taker(size[0], size[1]);
            begin(scanner, whole_route(size[0], size[1], 0, idle));
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
            begin(scanner, whole_route(2, 1, 0, idle));
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
        begin(scanner, whole_route(5, 1, 0, 3));
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

#ifndef __AVR_ATmega328P__
TEST(a_late_conversion_costs_its_scan_and_no_other_is_wrong) {
    // It ends after the next slot's interrupt: the trigger of that slot is ignored, and the code
    // arrives where that slot's is expected. A scan has 12 readings and 2 idle slots.
    for (uint16_t late = 0; late < 3 * 14; late++) {
        Scanner scanner;
        Pipeline pipeline;
        Taker taker(3, 1);
        begin(scanner, whole_route(3, 1, 0, 2));
        Selection held = pipeline.pins;
        for (uint16_t slot = 0; slot < 2 + 6 * 14 + 1; slot++) {
            const uint16_t code = pipeline.result;
            if (slot != late + 1)
                held = pipeline.pins;
            if (slot != late)
                pipeline.result = code_of(held);
            pipeline.pins = scanner.selection();
            step(scanner, code, slot != 0 && slot != late + 1);
            taker.take(scanner);
        }
        CHECK_EQ(5, taker.number);  // a scan that is left out is counted
        const bool only_idle = (late + 12) % 14 == 12;
        CHECK_EQ(only_idle ? 6 : 5, taker.whole);
    }
}
#endif
