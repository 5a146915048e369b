// SPDX-License-Identifier: Apache-2.0
// The device's scan frames: from the scanner's groups of codes to bytes for the line.
#include "board.h"
#include "core/device.h"

namespace ohmskin {

using frames::Type;

namespace {

constexpr uint8_t BITS_PER_BYTE_8N1 = 10;
// What Hello, a report and the acks may take between two scans.
constexpr uint16_t ANSWERS_SPACE =
    FrameWriter::line_bytes(sizeof(frames::Hello)) + FrameWriter::line_bytes(sizeof(frames::Ack));

// What the last group of a frame may take: its bytes, a block's length, CRC, delimiter.
constexpr uint16_t GROUP_SPACE = 5 + 2 + 2 + 1;

uint16_t scan_payload(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(sizeof(frames::Scan) +
                                 (readings_in(rows, columns) * uint32_t{frames::ADC_BITS} + 7) / 8);
}

uint16_t cycles_per_byte(uint32_t baud) {
    return static_cast<uint16_t>(board::CLOCK_HZ / baud * BITS_PER_BYTE_8N1);
}

}  // namespace

void Device::take_group() {
    Scanner &scanner = board::scanner;
    if (mode_ == Mode::SelfTesting) {
        self_test_.take(scanner.group());
        scanner.stop_after_scan();  // one scan is enough
    } else {
        if (scanner.starts_scan())
            begin_scan();
        if (groups_left_ != 0 && writer_.space() < GROUP_SPACE)
            drop_open_scan();
        if (groups_left_ != 0) {
            put_group(scanner.group());
            if (--groups_left_ == 0) {
                writer_.end();
                attention_ = true;
            }
        }
    }
    scanner.release_group();
}

void Device::begin_scan() {
    if (groups_left_ != 0)
        drop_open_scan();
    account_for_lost_scans();
    if (hello_pending_ || report_pending_ || ack_count_ != 0)
        send_pending();
    const ScanRequest &scan = settings_.request;
    if (writer_.used() <= ring_limit_) {
        const frames::Scan header = {scan_number_, scan_time_us_, dropped_, reader_.errors(),
                                     scan.rows,    scan.columns,  scan.mode};
        writer_.begin(Type::Scan);
        writer_.put(&header, sizeof header);
        groups_left_ = static_cast<uint16_t>(scan.rows * scan.columns);
    } else {
        dropped_++;
    }
    count_scan();
}

// The main loop was too late for the slots or for the line. That does not happen within the limits
// of plan_scan() and ring_limit(), but if it does, the scan is lost as a whole.
void Device::drop_open_scan() {
    writer_.abandon();
    groups_left_ = 0;
    dropped_++;
}

// Scan numbers and times go on for scans that never reached the queue.
void Device::account_for_lost_scans() {
    const uint8_t number = board::scanner.scan_number();
    while (static_cast<uint8_t>((number - scan_number_) & (Scanner::SCAN_NUMBERS - 1)) != 0) {
        dropped_++;
        count_scan();
    }
}

void Device::count_scan() {
    const uint8_t cycles_per_us = static_cast<uint8_t>(board::CLOCK_HZ / 1000000);
    const uint32_t cycles = plan_.scan_cycles() + scan_time_rest_;
    scan_number_++;
    scan_time_us_ += cycles / cycles_per_us;
    scan_time_rest_ = static_cast<uint8_t>(cycles % cycles_per_us);
}

// Codes of 10 bits, least significant bit first: a group's four make five bytes.
void Device::put_group(const uint16_t *code) {
    static_assert(frames::ADC_BITS == 10 && frames::READINGS_PER_CELL == 4, "the shifts below");
    const uint8_t octets[] = {
        static_cast<uint8_t>(code[0]),
        static_cast<uint8_t>((code[0] & Scanner::CODE) >> 8 | static_cast<uint8_t>(code[1]) << 2),
        static_cast<uint8_t>(code[1] >> 6 | static_cast<uint8_t>(code[2]) << 4),
        static_cast<uint8_t>(code[2] >> 4 | static_cast<uint8_t>(code[3]) << 6),
        static_cast<uint8_t>(code[3] >> 2),
    };
    // At 500 kbaud the chip's two bytes leave within 640 cycles, and a group's work takes longer.
    writer_.put(octets, 3);
    transmit();
    writer_.put(octets + 3, 2);
}

// A scan's bytes come in at a known pace and leave at a known pace, so the most the ring can hold
// during a scan is known when it begins: max(used, one open block) + what comes in faster than it
// leaves. A scan begins only where that fits, hence none is ever torn. 0: it never fits.
uint16_t Device::ring_limit(const ScanRequest &request, const ScanPlan &plan, uint32_t baud) const {
    const uint16_t frame = FrameWriter::line_bytes(scan_payload(request.rows, request.columns));
    const uint32_t duration =
        static_cast<uint32_t>(plan.slot_cycles) * readings_in(request.rows, request.columns);
    uint32_t leaves = duration / cycles_per_byte(baud);
    leaves -= leaves / 8;  // what the main loop keeps up with where slots are shortest
    const uint32_t excess = frame > leaves ? frame - leaves : 0;
    const uint16_t most = FrameWriter::SIZE - 1 - ANSWERS_SPACE;
    if (excess + FrameWriter::LONGEST_BLOCK > most)
        return 0;
    return static_cast<uint16_t>(most - excess);
}

}  // namespace ohmskin
