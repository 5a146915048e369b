// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_plan.h"

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
// Two kinds of scans take turns: those of a region, and whole ones. Between two of different kinds,
// or where the region changes, there is at least one idle slot, in which step() takes the other
// kind's steps and slot length. (A slot that gets longer or shorter then is idle, or its reading
// has been held already; and the slot before the next reading has the new length, so it settles.)
//
// Codes reach the main loop four at a time, through a queue. A scan begins a group of its own; its
// last group may be filled up with old codes. The interrupt alone moves write_, the main loop alone
// moves read_, and an AVR reads and writes such 8-bit indices in one instruction. So the queue
// needs no lock, and no interrupt is ever held off. The steps of a new region get to the interrupt
// in the same way: they are in a bank that it does not use, until it sees change_waits_ and takes
// them.
class Scanner {
  public:
    // Codes of a group. Four codes of 10 bits fill whole bytes.
    static constexpr uint8_t GROUP = 4;
    // Scans are numbered modulo this, where a group says so: its mark has seven bits for it.
    static constexpr uint8_t SCAN_NUMBERS = 128;
    // Slots from begin() to that of the first reading: the first step() decides for the slot after
    // next (see the diagram).
    static constexpr uint8_t FIRST_SLOT = 2;

    // To be called while no slots run.
    void begin(const Routes &routes) {
        bank_ = banks_;
        bank_->set(routes);
        whole_lines_.set(routes.whole.rows, routes.whole.columns);
        turns_.begin();
        alternates_ = routes.whole_every != 0;
        begin_scan(alternates_);
        idle_left_ = LEAD_IN;
        kinds_ = 0;
        write_ = read_ = 0;
        begun_ = 0;
        scans_ = 0;
        late_codes_ = 0;
        takes_ = 0;
        change_waits_ = stopping_ = pauses_ = parked_ = false;
        on_time_ = 0;
    }
    void begin(const Route &only) { begin(Routes{only, only, 0}); }

    // Other routes, from the scan after the one in progress on. Not while a change waits.
    void change(const Routes &routes) {
        other_bank()->set(routes);
        pauses_ = true;  // before change_waits_, whose end sets it back
        __atomic_signal_fence(
            __ATOMIC_SEQ_CST);  // the steps are there before change_waits_ says so
        change_waits_ = true;
    }
    bool change_waits() const { return change_waits_; }
    // The number of the scan, modulo 256, from which on the last change is in force.
    uint8_t changed_at() const { return changed_at_; }

    // Once a slot, from the interrupt: first the pins are set to selection(), then step() takes a
    // code and moves selection() on. converted: 0 if no conversion has ended since the interrupt
    // before; then `code` is an old one. True where the slot at hand, and those after it, last
    // slot_cycles() from now on.
    const Selection &selection() const { return sequence_.at(); }
    bool step(uint16_t code, uint8_t converted) {
        uint8_t kinds = kinds_;
        const uint8_t held = kinds & HELD;
        if (held != 0)
            push(code, held, converted);
        else
            write_ = whole_groups(write_);
        on_time_ = converted;
        bool other_slots = false;
        const uint8_t next = next_kind(kinds, &other_slots);
        kinds = static_cast<uint8_t>(kinds << KIND_BITS);
        kinds_ = kinds | next;
        return other_slots;
    }
    uint16_t slot_cycles() const { return sequence_.steps().slot_cycles; }

    // ---- main loop's side
    bool has_group() const { return static_cast<uint8_t>((write_ - read_) & QUEUE_MASK) >= GROUP; }

    // The oldest group's codes, until release_group().
    const uint16_t *group() const { return queue_ + read_; }
    bool starts_scan() const { return marks_[read_ / GROUP] != 0; }
    // The number of the scan that this group starts, modulo SCAN_NUMBERS. Where the main loop was
    // so late that the start of a scan was lost, it sees the gap in these numbers.
    uint8_t scan_number() const { return marks_[read_ / GROUP] & (SCAN_NUMBERS - 1); }
    void release_group() {
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the codes have been read by now
        read_ = static_cast<uint8_t>((read_ + GROUP) & QUEUE_MASK);
    }

    void stop_after_scan() {
        stopping_ = true;
        pauses_ = true;  // after stopping_, which the end of a change looks at
    }
    // The last scan is over, and every code of it is in the queue.
    bool parked() const { return parked_; }

    // Scans since begin() whose first reading was due, modulo 256.
    uint8_t scans() const { return scans_; }
    // Readings since begin() whose conversion ended too late; wraps. The interrupt may change it
    // between its two bytes, so it is read until it stays.
    uint16_t late_codes() const {
        uint16_t seen = late_codes_, again;
        while ((again = late_codes_) != seen)
            seen = again;
        return seen;
    }

  private:
    // The mark of a group that a scan begins with, beside the scan's number.
    static constexpr uint8_t FIRST = SCAN_NUMBERS;
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
    static constexpr uint8_t LAST = 3;  // the slot that selection() is for

    // Both kinds of scans, and when each has its turn. Whole scans have the same lines until
    // begin().
    struct Bank {
        Lines lines;
        Steps region, whole;
        uint16_t whole_every;
        void set(const Routes &routes) {
            lines.set(routes.region.rows, routes.region.columns);
            region.set(routes.region);
            whole.set(routes.whole);
            whole_every = routes.whole_every;
        }
    };

    // Moves on to the slot after next, and says what it is for. kinds: before it.
    uint8_t next_kind(uint8_t kinds, bool *other_slots) {
        if ((kinds & LAST) == IDLE)
            return idle(kinds, other_slots);
        if (!sequence_.next())
            return READING;
        uint16_t idle_slots = sequence_.steps().idle_slots;
        if (idle_slots < IDLE_TO_CHANGE) {
            if (pauses_) {
                idle_slots = IDLE_TO_CHANGE;
            } else if (idle_slots == 0) {
                begun_++;
                return STARTS_SCAN;
            }
        }
        idle_left_ = idle_slots;
        return IDLE;
    }

    uint8_t idle(uint8_t kinds, bool *other_slots) {
        if (stopping_) {
            // Not yet, if a slot whose code is still to come is in kinds_, or one whose code has
            // just been taken: then its group may have to be ended.
            parked_ = kinds == 0;
            return IDLE;
        }
        const uint16_t left = static_cast<uint16_t>(idle_left_ - 1);
        idle_left_ = left;
        if (left != 0) {
            // The first of the three slots that pauses_ makes. A change that comes later waits for
            // the next scan's end: this one may be followed by fewer idle slots.
            if (left == IDLE_TO_CHANGE - 1 && change_waits_)
                take_change();
            return IDLE;
        }
        if (alternates_) {
            const uint16_t every = bank_->whole_every;
            alternates_ = every != 0;
            begin_scan(turns_.next_is_whole(every));
            *other_slots = true;
        }
        begun_++;
        return STARTS_SCAN;
    }

    // The scan that begins next is the first of the other bank. Earlier than its begin, so that no
    // interrupt has to do both.
    void take_change() {
        Bank *const bank = other_bank();
        bank_ = bank;
        turns_.change();
        alternates_ = true;
        changed_at_ = begun_;
        pauses_ = stopping_;
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // it is told before the other bank is free
        change_waits_ = false;
    }
    Bank *other_bank() { return bank_ == banks_ ? banks_ + 1 : banks_; }

    // Takes the steps of the scan that begins.
    void begin_scan(bool whole) {
        const Bank &bank = *bank_;
        sequence_.begin(whole ? whole_lines_ : bank.lines, whole ? bank.whole : bank.region);
    }

    // The end of the last group, which counts as full: its scan is over.
    static uint8_t whole_groups(uint8_t at) {
        return static_cast<uint8_t>((at + GROUP - 1) & ~(GROUP - 1) & QUEUE_MASK);
    }

    // Puts a code into the queue, or leaves the rest of its scan out: where the queue has no room
    // for a whole group, or where a code is missing. So the main loop may see a scan cut short, but
    // never one with a hole. Room is looked for once a group, at its first code.
    //
    // A conversion that ends late gives its code in the next slot's interrupt. If that slot starts
    // a scan, on_time_ keeps the code from being taken for the scan's first: that scan is left out,
    // too.
    void push(uint16_t code, uint8_t held, uint8_t converted) {
        uint8_t at = write_;
        uint8_t mark = 0, takes = takes_;
        if (held == STARTS_SCAN << HELD_SHIFT) {
            at = whole_groups(at);
            mark = scans_;
            scans_ = static_cast<uint8_t>(mark + 1);
            mark |= FIRST;
            takes_ = takes = on_time_;
        }
        const uint8_t of_group = at & (GROUP - 1);
        if (!converted) {
            late_codes_ = static_cast<uint16_t>(late_codes_ + 1);
            takes_ = 0;
            write_ = at ^ of_group;
            return;
        }
        if (of_group == 0) {
            const uint8_t end = static_cast<uint8_t>((at + GROUP) & QUEUE_MASK);
            if (end == read_)
                takes_ = takes = 0;
            marks_[at / GROUP] = mark;
        }
        if (!takes) {
            write_ = at;
            return;
        }
        queue_[at] = code;
        __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the code is there before write_ says so
        write_ = static_cast<uint8_t>((at + 1) & QUEUE_MASK);
    }

    uint16_t queue_[QUEUE_SIZE] = {};  // not volatile: write_ and read_ say who may touch what
    uint8_t marks_[QUEUE_SIZE / GROUP] = {};  // of each group: FIRST and the scan's number, or 0
    Lines whole_lines_ = {};
    Bank banks_[2] = {};  // not volatile: bank_ and change_waits_ say who may
    volatile uint8_t write_ = 0;
    volatile uint8_t read_ = 0;
    volatile bool stopping_ = false;
    volatile bool pauses_ = false;  // scans are followed by idle slots enough to stop or to change
    volatile bool parked_ = false;
    volatile bool change_waits_ = false;
    volatile uint8_t changed_at_ = 0;
    Bank *bank_ = nullptr;        // whose steps are in force; moved by the interrupt
    uint8_t takes_ = 0;           // 0: codes are left out until the next scan starts
    uint8_t on_time_ = 0;         // 0: no conversion had ended by the interrupt before
    bool alternates_ = false;     // the next scan may have other steps than the one before
    uint8_t kinds_ = 0;           // of the last slots, see above
    uint8_t begun_ = 0;           // number of the next scan to be decided on, modulo 256
    volatile uint8_t scans_ = 0;  // number of the next scan whose codes come
    volatile uint16_t late_codes_ = 0;
    uint16_t idle_left_ = 0;  // idle slots still to come before the next scan
    Turns turns_;
    ScanSequence sequence_;
};

}  // namespace ohmskin
