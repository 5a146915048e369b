// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_sequence.h"

namespace ohmskin {

// The interrupt's half of the scan. Time goes in slots of equal length, one conversion each:
//
//     slot        k-1          k           k+1
//     converter   ..done(k-1)  hold(k)     hold(k+1)
//     step()                   ^ code of k-1 goes in, selection of k+1 comes out
//
// step() is called once a slot, just after the sample of slot k is held. The code it is given is that
// of slot k-1; what it returns is where pins and multiplexers have to stand for slot k+1, so they
// settle while slot k is converted. Slots beyond the last reading of a scan are idle: they fill up
// the scan's period.
//
// Codes reach the main loop through a queue with one writer and one reader and 8-bit indices, which
// an AVR reads and writes in one instruction: no interrupt is ever held off.
class Scanner {
  public:
    static constexpr uint16_t FIRST = 0x8000;  // marks the code that starts a scan

    // Before the slots start: geometry, and how many idle slots follow a scan.
    void begin(uint8_t rows, uint8_t columns, uint16_t idle_slots) {
        sequence_.begin(rows, columns);
        idle_slots_ = idle_slots;
        idle_left_ = LEAD_IN;
        held_ = selected_ = 0;
        write_ = read_ = 0;
        lost_scans_ = 0;
        stopping_ = parked_ = false;
    }

    // Once a slot, from the interrupt.
    Selection step(uint16_t code) {
        if (held_ & READING)
            push((held_ & STARTS_SCAN) ? static_cast<uint16_t>(code | FIRST) : code);
        held_ = selected_;
        advance();
        return sequence_.at();
    }

    // ---- main loop's side
    bool take(uint16_t *code) {
        const uint8_t at = read_;
        if (at == write_)
            return false;
        *code = queue_[at];
        read_ = static_cast<uint8_t>((at + 1) & QUEUE_MASK);
        return true;
    }

    // Scans whose very start was lost since begin() because the main loop was late.
    uint8_t lost_scans() const { return lost_scans_; }

    void stop_after_scan() { stopping_ = true; }
    // The last scan is over, and every code of it is in the queue.
    bool parked() const { return parked_; }

  private:
    static constexpr uint8_t QUEUE_SIZE = 32;
    static constexpr uint8_t QUEUE_MASK = QUEUE_SIZE - 1;
    static constexpr uint16_t LEAD_IN = 1;  // slots until the first selection has settled

    // Kinds of slot.
    static constexpr uint8_t READING = 1;
    static constexpr uint8_t STARTS_SCAN = 2;

    void advance() {
        if (idle_left_ != 0) {
            selected_ = 0;
            if (stopping_) {
                parked_ = held_ == 0;  // else the last reading's code is still to come
                return;
            }
            if (--idle_left_ == 0)
                selected_ = READING | STARTS_SCAN;
            return;
        }
        if (!sequence_.next()) {
            selected_ = READING;
        } else if (idle_slots_ == 0 && !stopping_) {
            selected_ = READING | STARTS_SCAN;
        } else {
            idle_left_ = idle_slots_ ? idle_slots_ : 1;
            selected_ = 0;
        }
    }

    void push(uint16_t code) {
        const uint8_t at = write_;
        const uint8_t next = static_cast<uint8_t>((at + 1) & QUEUE_MASK);
        if (next == read_) {
            if (code & FIRST)
                lost_scans_ = static_cast<uint8_t>(lost_scans_ + 1);
            return;
        }
        queue_[at] = code;
        write_ = next;
    }

    volatile uint16_t queue_[QUEUE_SIZE];
    volatile uint8_t write_ = 0;
    volatile uint8_t read_ = 0;
    volatile uint8_t lost_scans_ = 0;
    volatile bool stopping_ = false;
    volatile bool parked_ = false;
    uint8_t held_ = 0;      // kind of the slot held last: its code arrives with the next step()
    uint8_t selected_ = 0;  // kind of the slot that the pins are set for
    uint16_t idle_slots_ = 0;
    uint16_t idle_left_ = 0;
    ScanSequence sequence_;
};

}  // namespace ohmskin
