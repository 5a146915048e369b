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
// Codes reach the main loop four at a time, through a queue. The interrupt alone moves write_, the
// main loop alone moves read_, and an AVR reads and writes such 8-bit indices in one instruction.
// So the queue needs no lock, and no interrupt is ever held off.
class Scanner {
  public:
    // Codes of a group. Four codes of 10 bits fill whole bytes, and a scan has as many groups as
    // there are cells.
    static constexpr uint8_t GROUP = frames::READINGS_PER_CELL;

    // A queued code is 16 bits: the code, and in the first code of a scan also the scan's number
    // and a mark. These are the code's bits.
    static constexpr uint16_t CODE = 0x03FF;
    // Scans are numbered modulo this: the five bits that are left between the code and the mark.
    static constexpr uint8_t SCAN_NUMBERS = 32;
    static_assert(CODE == (1u << frames::ADC_BITS) - 1, "above it: the scan's number, and FIRST");
    // Slots from begin() to that of the first reading: the first step() decides for the slot after
    // next (see the diagram).
    static constexpr uint8_t FIRST_SLOT = 2;

    // To be called while no slots run. pattern: which readings (scan_sequence.h). idle_slots: how
    // many follow each scan.
    void begin(uint8_t rows, uint8_t columns, uint8_t pattern, uint16_t idle_slots) {
        sequence_.begin(rows, columns, pattern);
        idle_slots_ = idle_slots;
        idle_left_ = LEAD_IN;
        idling_ = true;
        kinds_ = 0;
        write_ = read_ = 0;
        scan_ = 0;
        skipping_ = true;
        stopping_ = parked_ = late_ = false;
    }

    // Both once a slot, from the interrupt: first the pins are set to selection(), then step()
    // takes a code and moves selection() on. converted: whether a conversion has ended since the
    // interrupt before; if not, `code` is an old one.
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
    // The number of the scan that this group starts, modulo SCAN_NUMBERS. Where the main loop was
    // so late that the start of a scan was lost, it sees the gap in these numbers.
    uint8_t scan_number() const { return (queue_[read_] >> frames::ADC_BITS) & (SCAN_NUMBERS - 1); }
    void release_group() {
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the codes have been read by now
        read_ = static_cast<uint8_t>((read_ + GROUP) & QUEUE_MASK);
    }

    void stop_after_scan() { stopping_ = true; }
    // The last scan is over, and every code of it is in the queue.
    bool parked() const { return parked_; }

  private:
    // The mark of a scan's first code.
    static constexpr uint16_t FIRST = 0x8000;
    // Codes that the queue holds: whole groups, so that no group wraps. 16 of them are chosen: the
    // main loop may be 15 groups late, 1.8 ms with the shortest slots.
    static constexpr uint8_t QUEUE_SIZE = 16 * GROUP;
    static constexpr uint8_t QUEUE_MASK = QUEUE_SIZE - 1;
    static_assert((QUEUE_SIZE & QUEUE_MASK) == 0, "indices are masked");
    // Calls of step() until one begins the first scan: the very first call does. Its slot,
    // FIRST_SLOT, comes two slots after the pins were set to the first selection, so the skin has
    // settled.
    static constexpr uint16_t LEAD_IN = 1;

    // What a slot is for. It is decided two slots ahead, when selection() moves on to the slot, and
    // it is needed when the slot's code comes, three interrupts later. So kinds_ is a shift
    // register with two bits a slot: each step() reads the kind of the slot whose code has come
    // (HELD), and shifts in the kind of the slot that selection() is for from now on. Bits 7 and 6
    // are over.
    //
    // A scan of one cell with two idle slots: S is STARTS_SCAN, r READING, - IDLE.
    //
    //     interrupt in slot            0    1    2    3    4    5    6    7    8    9
    //     step() reads the kind of     -1   0    1    2    3    4    5    6    7    8
    //         from bits 5 and 4        -    -    -    S    r    r    r    -    -    S
    //         so it takes the code of                 A    B    C    D              A
    //     step() decides for slot      2    3    4    5    6    7    8    9    10   11
    //         in bits 1 and 0          S    r    r    r    -    -    S    r    r    r
    //     kinds_ after it, 5 4|3 2|1 0 --S  -Sr  Srr  rrr  rr-  r--  --S  -Sr  Srr  rrr
    static constexpr uint8_t KIND_BITS = 2;
    static constexpr uint8_t IDLE = 0, READING = 1, STARTS_SCAN = 2;
    static constexpr uint8_t HELD_SHIFT = 2 * KIND_BITS;
    static constexpr uint8_t HELD = 3 << HELD_SHIFT;

    // Moves on to the slot after next, and says what it is for.
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
            // Not yet, if a slot whose code is still to come is in kinds_. The code of HELD has
            // just been taken. (Bits 7 and 6 only make it a slot later.)
            parked_ = (kinds_ & ~HELD) == 0;
            return IDLE;
        }
        if (--idle_left_ != 0)
            return IDLE;
        idling_ = false;
        return STARTS_SCAN;
    }

    // Puts a code into the queue, or leaves the rest of its scan out: where the queue has no room
    // for a whole group, or where a code is missing. So the main loop may see a scan cut short, but
    // never one with a hole. Room is looked for once a group, at its first code.
    //
    // A conversion that ends late gives its code in the next slot's interrupt. If that slot starts
    // a scan, late_ keeps the code from being taken for the scan's first: that scan is left out,
    // too.
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
    bool skipping_ = true;     // codes are left out until the next scan starts
    bool late_ = false;        // no conversion had ended by the interrupt before
    bool idling_ = true;       // the slot that selection() is for is idle
    uint8_t kinds_ = 0;        // of the last slots, see above
    uint8_t scan_ = 0;         // number of the next scan
    uint16_t idle_slots_ = 0;  // after each scan
    uint16_t idle_left_ = 0;   // still to come before the next scan
    ScanSequence sequence_;
};

}  // namespace ohmskin
