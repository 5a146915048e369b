// SPDX-License-Identifier: Apache-2.0
// The device's scan frames: from the scanner's groups of codes to bytes for the line.
#include "board.h"
#include "core/device.h"

namespace ohmskin {

using frames::Type;

namespace {

using Codes = Packing<board::ADC_BITS>;
static_assert(Scanner::GROUP == Codes::CODES, "a group is packed at once");

// Bytes that the last group of a frame may take: its own, the lengths of two blocks, CRC,
// delimiter.
constexpr uint16_t GROUP_SPACE = Codes::BYTES + 2 + 2 + 1;

}  // namespace

// Takes the oldest group of codes from the queue, into the scan's frame or the self-test.
void Device::take_group() {
    Scanner &scanner = board::scanner;
    if (activity_ == Activity::SelfTesting) {
        self_test_.take(scanner.group());
        scanner.stop_after_scan();  // one scan is enough
    } else {
        if (scanner.starts_scan())
            begin_scan();
        if (codes_left_ != 0 && writer_.space() < GROUP_SPACE)
            drop_open_scan();
        if (codes_left_ != 0) {
            const uint8_t count =
                codes_left_ < Scanner::GROUP ? static_cast<uint8_t>(codes_left_) : Scanner::GROUP;
            put_group(scanner.group(), count);
            codes_left_ = static_cast<uint16_t>(codes_left_ - count);
            if (codes_left_ == 0) {
                writer_.end();
                if (answers_wait())
                    attention_ = true;
            }
        }
    }
    scanner.release_group();
}

// The oldest group starts a scan: moves on to this scan's number, time and route.
void Device::begin_scan() {
    if (codes_left_ != 0)
        drop_open_scan();  // its last codes were lost
    account_for_lost_scans(board::scanner.scan_number());
    // Answers first, if they find room: before the line's time is spent on a new scan.
    if (answers_wait())
        send_pending();
    const Route &now = route();
    if (writer_.used() <= now.ring_limit) {
        // Field by field: an initializer clears all of it first, 1 % of the time of a scan of 3x3.
        frames::Scan header;
        header.scan = scan_number_;
        header.time_us = scan_time_us_;
        header.dropped = dropped_;
        header.rx_errors = reader_.errors();
        header.rows = settings_.request.rows;
        header.columns = settings_.request.columns;
        header.mode = now.pattern;
        header.adc_bits = board::ADC_BITS;
        header.row_mask = now.rows;
        header.column_mask = now.columns;
        header.slot_cycles = now.plan.slot_cycles;
        writer_.begin(Type::Scan);
        writer_.put(&header, sizeof header);
        codes_left_ = now.plan.readings;
    } else {
        dropped_++;
    }
    seen_ = true;
}

// The main loop was too late for the slots or for the line. plan_scan() refuses
// scans with which that could happen; if it does happen, the scan is lost as a whole.
void Device::drop_open_scan() {
    writer_.abandon();
    codes_left_ = 0;
    dropped_++;
}

// Goes on to the scan of this number (modulo Scanner::SCAN_NUMBERS), and counts those before it
// that never reached the queue, so that scan numbers and times stay right.
void Device::account_for_lost_scans(uint8_t number) {
    while (static_cast<uint8_t>((number - scan_number_) & (Scanner::SCAN_NUMBERS - 1)) != 0) {
        if (!seen_)
            dropped_++;
        seen_ = false;
        count_scan();
    }
}

// Counts scans that have begun and of which no code has come, but for the last one: it may come
// yet.
void Device::count_silent_scans() {
    const uint8_t begun = board::scanner.scans();
    if (begun != static_cast<uint8_t>(scan_number_) && !board::scanner.has_group())
        account_for_lost_scans(static_cast<uint8_t>(begun - 1));
}

// Moves number, time and route on to the next scan. The rest of the time is carried along, so that
// times do not drift.
void Device::count_scan() {
    const ScanPlan before = route().plan;
    uint16_t slots = before.slots();
    scan_number_++;
    if (changing_ && !board::scanner.change_waits() &&
        board::scanner.changed_at() == static_cast<uint8_t>(scan_number_)) {
        if (before.idle_slots < IDLE_TO_CHANGE)
            slots = static_cast<uint16_t>(slots + IDLE_TO_CHANGE - before.idle_slots);
        take_change();
        turns_.change();
    }
    whole_ = turns_.next_is_whole(routes_.whole_every);
    // The last slots before a scan have the length of its own (scanner.h).
    const int32_t longer = int32_t{route().plan.slot_cycles} - before.slot_cycles;
    const uint32_t cycles = uint32_t{before.slot_cycles} * slots +
                            static_cast<uint32_t>(board::SLOTS_OF_NEW_LENGTH * longer);
    scan_time_us_ += us_of(cycles, &scan_time_rest_);
}

// Packs a group's codes. The last group of a scan may have fewer: the bits behind them are 0.
void Device::put_group(const uint16_t *code, uint8_t count) {
    uint16_t last[Scanner::GROUP];
    if (count != Scanner::GROUP) {
        for (uint8_t n = 0; n < Scanner::GROUP; n++)
            last[n] = n < count ? code[n] : 0;
        code = last;
    }
    uint8_t octets[Codes::BYTES];
    Codes::pack(code, octets);
    writer_.put(octets, static_cast<uint8_t>((count * board::ADC_BITS + 7) / 8));
}

}  // namespace ohmskin
