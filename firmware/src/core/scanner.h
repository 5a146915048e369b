// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_sequence.h"

namespace ohmskin {

// The interrupt's half of the scan. Time goes in slots of equal length, one conversion each:
//
//     slot        k-1          k            k+1          k+2
//     converter   done(k-1)    hold(k)      hold(k+1)    hold(k+2)
//     interrupt                | pins to k+1: selection()
//                              | step(code of k-1): selection() is that of k+2
//
// The interrupt comes once a slot, just after the sample of slot k is held. It sets pins and
// multiplexers to selection(), so they settle while slot k is converted, and calls step(). Slots
// beyond the last reading of a scan are idle: they fill up the scan's period. A slot whose
// conversion is missing, because the converter was late, ends the scan.
//
// Codes reach the main loop four at a time, through a queue with one writer and one reader and
// 8-bit indices, which an AVR reads and writes in one instruction: no interrupt is ever held off.
class Scanner {
  public:
    // As many codes as fill whole bytes, and as many groups a scan as there are cells.
    static constexpr uint8_t GROUP = frames::READINGS_PER_CELL;

    static constexpr uint16_t CODE = 0x03FF;
    static constexpr uint8_t SCAN_NUMBERS = 32;
    static_assert(CODE == (1u << frames::ADC_BITS) - 1, "above it: the scan's number, and FIRST");
    // From begin() to the slot of the first reading.
    static constexpr uint8_t FIRST_SLOT = 2;

    // Before the slots start: geometry, order of readings, and how many idle slots follow a scan.
    void begin(uint8_t rows, uint8_t columns, uint8_t order, uint16_t idle_slots) {
        sequence_.begin(rows, columns, order);
        idle_slots_ = idle_slots;
        idle_left_ = LEAD_IN;
        idling_ = true;
        kinds_ = 0;
        write_ = read_ = 0;
        scan_ = 0;
        skipping_ = true;
        stopping_ = parked_ = late_ = false;
    }

    // Once a slot, from the interrupt. converted: whether a conversion has ended since the last
    // one.
    const Selection &selection() const { return sequence_.at(); }
    void step(uint16_t code, bool converted) {
        const uint8_t kinds = kinds_;
        const uint8_t held = kinds & HELD;
        if (held != 0)
            push(code, held, converted);
        late_ = !converted;
        kinds_ = static_cast<uint8_t>(kinds << KIND_BITS | next_kind());
    }

    // ---- main loop's side
    bool has_group() const { return static_cast<uint8_t>((write_ - read_) & QUEUE_MASK) >= GROUP; }

    // The oldest group's codes, until release_group(); to be masked with CODE.
    const uint16_t *group() const { return queue_ + read_; }
    bool starts_scan() const { return queue_[read_] & FIRST; }
    // Of the scan that this group starts, modulo SCAN_NUMBERS: gaps tell of scans whose very start
    // was lost because the main loop was late.
    uint8_t scan_number() const { return (queue_[read_] >> frames::ADC_BITS) & (SCAN_NUMBERS - 1); }
    void release_group() {
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the codes have been read by now
        read_ = static_cast<uint8_t>((read_ + GROUP) & QUEUE_MASK);
    }

    void stop_after_scan() { stopping_ = true; }
    // The last scan is over, and every code of it is in the queue.
    bool parked() const { return parked_; }

  private:
    static constexpr uint16_t FIRST = 0x8000;          // in a code: the scan's first
    static constexpr uint8_t QUEUE_SIZE = 16 * GROUP;  // whole groups, so that none wraps
    static constexpr uint8_t QUEUE_MASK = QUEUE_SIZE - 1;
    static_assert((QUEUE_SIZE & QUEUE_MASK) == 0, "indices are masked");
    static constexpr uint16_t LEAD_IN = 1;  // slots until the first selection has settled

    // Kinds of slot. kinds_ holds those of the last three, the newest in the lowest bits: of the
    // slot selection() is for, the slot the pins are set for, and the slot held last, whose code
    // arrives with the next step().
    static constexpr uint8_t KIND_BITS = 2;
    static constexpr uint8_t IDLE = 0, READING = 1, STARTS_SCAN = 2;
    static constexpr uint8_t HELD_SHIFT = 2 * KIND_BITS;
    static constexpr uint8_t HELD = 3 << HELD_SHIFT;

    uint8_t next_kind() {
        if (idling_)
            return idle();
        if (!sequence_.next())
            return READING;
        if (idle_slots_ == 0 && !stopping_)
            return STARTS_SCAN;
        idle_left_ = idle_slots_ ? idle_slots_ : 1;
        idling_ = true;
        return IDLE;
    }

    uint8_t idle() {
        if (stopping_) {
            parked_ = (kinds_ & ~HELD) == 0;  // else codes are still to come
            return IDLE;
        }
        if (--idle_left_ != 0)
            return IDLE;
        idling_ = false;
        return STARTS_SCAN;
    }

    // Room is made sure of for a whole group at its first code. Where there is none, or a code is
    // missing, the rest of the scan is left out, so that the main loop sees a scan cut short and
    // never one with a hole. A code that comes late is not taken for the first of the next scan.
    void push(uint16_t code, uint8_t held, bool converted) {
        const uint8_t at = write_;
        if (held == STARTS_SCAN << HELD_SHIFT) {
            code |= FIRST | (scan_++ & (SCAN_NUMBERS - 1)) << frames::ADC_BITS;
            skipping_ = late_;
        }
        if (!converted) {
            skipping_ = true;
            write_ = static_cast<uint8_t>(at & ~(GROUP - 1));
        } else if (!(at & (GROUP - 1)) &&
                   static_cast<uint8_t>((at + GROUP) & QUEUE_MASK) == read_) {
            skipping_ = true;
        }
        if (skipping_)
            return;
        queue_[at] = code;
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the code is there before write_ says so
        write_ = static_cast<uint8_t>((at + 1) & QUEUE_MASK);
    }

    uint16_t queue_[QUEUE_SIZE] = {};  // not volatile: write_ and read_ say who may touch what
    volatile uint8_t write_ = 0;
    volatile uint8_t read_ = 0;
    volatile bool stopping_ = false;
    volatile bool parked_ = false;
    bool skipping_ = true;  // until the next scan starts
    bool late_ = false;     // the conversion of the slot before was
    bool idling_ = true;
    uint8_t kinds_ = 0;
    uint8_t scan_ = 0;
    uint16_t idle_slots_ = 0;
    uint16_t idle_left_ = 0;
    ScanSequence sequence_;
};

}  // namespace ohmskin
