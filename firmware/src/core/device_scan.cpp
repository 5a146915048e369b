// SPDX-License-Identifier: Apache-2.0
// The device's scan frames: from the scanner's groups of codes to bytes for the line.
#include "board.h"
#include "core/device.h"

namespace ohmskin {

using frames::Type;

namespace {

// Start bit, eight data bits, stop bit.
constexpr uint8_t BITS_PER_BYTE_8N1 = 10;

// Bytes of a group: four codes of 10 bits.
constexpr uint8_t GROUP_BYTES = 5;

// Bytes of the ring that scans leave free, for a hello and its ack. Answers may be sent only
// between two scans. If scans filled the ring to its end, an answer would find no room at that
// moment, and might wait for ever. (A report of the self-test is sent while no scans are.)
constexpr uint16_t ANSWERS_SPACE =
    FrameWriter::line_bytes(sizeof(frames::Hello)) + FrameWriter::line_bytes(sizeof(frames::Ack));

// Bytes that the last group of a frame may take: its own, the lengths of two blocks, CRC,
// delimiter.
constexpr uint16_t GROUP_SPACE = GROUP_BYTES + 2 + 2 + 1;

// The main loop feeds the line somewhat slower than the line could go, at most by this part, an
// eighth: with the shortest slots, interrupts leave it that little time. Chosen: with it, no load
// of tests/firmware (test_no_load_damages_a_frame) tears a frame.
constexpr uint8_t LINE_IDLE_PART = 8;

// Bytes of a scan frame's payload.
uint16_t scan_payload(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(sizeof(frames::Scan) +
                                 (readings_in(rows, columns) * uint32_t{frames::ADC_BITS} + 7) / 8);
}

// Clock cycles in which the line carries a byte.
uint16_t cycles_per_byte(uint32_t baud) {
    return static_cast<uint16_t>(board::CLOCK_HZ / baud * BITS_PER_BYTE_8N1);
}

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
        drop_open_scan();  // its last codes were lost
    account_for_lost_scans();
    if (answers_wait())
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

// The main loop was too late for the slots or for the line. plan_scan() and ring_limit() refuse
// scans with which that could happen; if it does happen, the scan is lost as a whole.
void Device::drop_open_scan() {
    writer_.abandon();
    groups_left_ = 0;
    dropped_++;
}

// Counts scans that never reached the queue, so that scan numbers and times stay right.
void Device::account_for_lost_scans() {
    const uint8_t number = board::scanner.scan_number();
    while (static_cast<uint8_t>((number - scan_number_) & (Scanner::SCAN_NUMBERS - 1)) != 0) {
        dropped_++;
        count_scan();
    }
}

// Moves number and time on to the next scan. The rest is carried along, so that times do not drift.
void Device::count_scan() {
    const uint8_t cycles_per_us = static_cast<uint8_t>(board::CLOCK_HZ / 1000000);
    const uint32_t cycles = plan_.scan_cycles() + scan_time_rest_;
    scan_number_++;
    scan_time_us_ += cycles / cycles_per_us;
    scan_time_rest_ = static_cast<uint8_t>(cycles % cycles_per_us);
}

// Packs a group's four codes of 10 bits into five bytes, least significant bit first. Only a scan's
// first code has more than its 10 bits set (Scanner::starts_scan()), so code[0] alone is masked.
void Device::put_group(const uint16_t *code) {
    static_assert(frames::ADC_BITS == 10 && frames::READINGS_PER_CELL == 4, "the shifts below");
    const uint8_t octets[GROUP_BYTES] = {
        static_cast<uint8_t>(code[0]),
        static_cast<uint8_t>((code[0] & Scanner::CODE) >> 8 | static_cast<uint8_t>(code[1]) << 2),
        static_cast<uint8_t>(code[1] >> 6 | static_cast<uint8_t>(code[2]) << 4),
        static_cast<uint8_t>(code[2] >> 4 | static_cast<uint8_t>(code[3]) << 6),
        static_cast<uint8_t>(code[3] >> 2),
    };
    // The chip holds two bytes for the line, which at 500 kbaud leave within 640 cycles, and the
    // work on a group takes longer. So the line is fed in between, too: it would idle otherwise.
    writer_.put(octets, 3);
    transmit();
    writer_.put(octets + 3, GROUP_BYTES - 3);
}

// How full the ring may be where a scan begins; 0: the scan never fits.
//
// The bytes of a scan come in at a known pace and leave at a known pace. So the most that the ring
// can hold during a scan is known when it begins: what it holds then, or one open block that cannot
// leave yet, and what comes in faster than it leaves. A scan begins only where that fits, hence no
// scan is torn.
uint16_t Device::ring_limit(const ScanRequest &request, const ScanPlan &plan, uint32_t baud) const {
    const uint16_t frame = FrameWriter::line_bytes(scan_payload(request.rows, request.columns));
    const uint32_t duration =
        static_cast<uint32_t>(plan.slot_cycles) * readings_in(request.rows, request.columns);
    uint32_t leaves = duration / cycles_per_byte(baud);
    leaves -= leaves / LINE_IDLE_PART;
    const uint32_t excess = frame > leaves ? frame - leaves : 0;
    const uint16_t most = FrameWriter::SIZE - 1 - ANSWERS_SPACE;
    if (excess + FrameWriter::LONGEST_BLOCK > most)
        return 0;
    return static_cast<uint16_t>(most - excess);
}

}  // namespace ohmskin
