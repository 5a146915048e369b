// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "core/clock.h"
#include "core/packing.h"
#include "core/scan_sequence.h"
#include "frames.h"

namespace ohmskin {

// How to scan, as asked for: the fields of the command `configure`. The last of them are those of
// `set_region`, which changes them alone.
using ScanRequest = frames::Configure;
using RegionRequest = frames::SetRegion;

// Idle slots between scans of two kinds, at least. In the last of them the interrupt takes the
// other kind's steps: with three, no code comes in that slot, which would cost time, too.
constexpr uint8_t IDLE_TO_CHANGE = 3;
// A scan of up to FEW readings ends no later than its first code comes. So many idle slots after
// it, at least, leave less to do in that interrupt. The line takes longer than these slots anyway.
constexpr uint8_t FEW = 3, IDLE_OF_FEW = 5;

// How the board keeps the times of a scan: slots of equal length, one conversion each, a whole
// number of them a scan.
struct ScanPlan {
    uint16_t slot_cycles;  // clock cycles of a slot
    uint16_t readings;     // slots with a reading
    uint16_t idle_slots;   // those after the last reading: they fill up the scan's period
    uint16_t slots() const { return static_cast<uint16_t>(readings + idle_slots); }
    uint32_t scan_cycles() const { return static_cast<uint32_t>(slot_cycles) * slots(); }
};

// One kind of scan: the cells that it visits, the readings that it takes there, and its times.
struct Route {
    LineMask rows, columns;
    uint8_t pattern;  // which readings (scan_sequence.h)
    ScanPlan plan;
    uint16_t ring_limit;  // ring use up to which a scan may begin and is sure to fit; 0: none is
};

// The two kinds of scans that take turns: those of the region, and whole ones in between.
struct Routes {
    Route region, whole;
    uint16_t whole_every;  // each so many-th scan is a whole one; 0: none
};

// Whose turn it is. The interrupt and the main loop each have one of these, and step it once a
// scan, so that they need not tell each other.
class Turns {
  public:
    void begin() { left_ = 0, waited_ = false; }
    // Another region comes. A whole scan that is due lets one scan of the new region go first,
    // because a region is asked for where something moves. It does so once, so that whole scans
    // come however often the region changes.
    void change() {
        if (left_ == 0 && !waited_) {
            left_ = 1;
            waited_ = true;
        }
    }
    // Whether the next scan is a whole one. Each `every`-th is, 0: none.
    bool next_is_whole(uint16_t every) {
        if (every == 0)
            return false;
        // The count goes on when another region comes, but no longer than that one asks for.
        if (left_ >= every)
            left_ = static_cast<uint16_t>(every - 1);
        if (left_ != 0) {
            left_--;
            return false;
        }
        left_ = static_cast<uint16_t>(every - 1);
        waited_ = false;
        return true;
    }

  private:
    uint16_t left_ = 0;    // scans of the region until the next whole one
    bool waited_ = false;  // whether this whole one has let a region go first
};

namespace timing {
// What a slot leaves for settling [us] where a request names neither rate nor settle time, by mode.
// Near: 14 pF of sample capacitor and 100 pF at a node of 30 kOhm then come to half a code.
// docs/timing.md, "Settle time", has the formula. Far: the far node's 100 pF and the line's 30 pF
// come on top. Half and quick: lines that charge through the cells are not seen, and do not cancel,
// without the other drive; docs/timing.md, "Fewer readings", has the errors by settle time.
constexpr uint16_t SETTLE_US[] = {20, 35, 40, 101};
static_assert(sizeof SETTLE_US / sizeof *SETTLE_US == MODES, "one a mode");
// Clock cycles of the longest slot, which have 16 bits. Chosen below 65536, because divide() rounds
// a slot's length up.
constexpr uint16_t SLOT_CYCLES_MAX = 60000;
// The main loop feeds the line somewhat slower than the line could go, at most by this part, an
// eighth: with the shortest slots, interrupts leave it that little time. Chosen: with it, no load
// of tests/firmware (test_no_load_damages_a_frame) tears a frame.
constexpr uint8_t LINE_IDLE_PART = 8;
}  // namespace timing

// What cannot wait until a plan is made, which takes milliseconds: codes, the line and the clock.
// The program has it, beside its device (main.cpp).
void keep_pace();

// The plan for a request, or why there is none; `routes` changes only where there is one. With
// settle_us 0 the slots fill the period; otherwise they are as short as the settle time allows and
// the rest of the period is idle. Rate 0: as fast as the settle time allows, and as line and
// processor keep up. cycles_per_byte: clock cycles in which the line carries a byte. rate_mhz: the
// rate that is kept; where it is too fast, the fastest that could be; else 0.
OHMSKIN_RARE frames::Result plan_scan(const ScanRequest &request, uint16_t cycles_per_byte,
                                      Routes *routes, uint32_t *rate_mhz);

// The whole skin, in one pattern, as fast as the settle time allows: a scan of the self-test.
OHMSKIN_RARE Route plan_whole(uint8_t rows, uint8_t columns, uint8_t pattern, uint16_t settle,
                              uint16_t cycles_per_byte);

// Bytes of a scan frame's payload with so many readings.
constexpr uint16_t scan_payload(uint16_t readings) {
    return static_cast<uint16_t>(sizeof(frames::Scan) +
                                 Packing<board::ADC_BITS>::bytes_of(readings));
}

// Time that a plan leaves to pins and sample capacitor for settling, at least [us].
inline uint16_t settle_us(const ScanPlan &plan, uint8_t accuracy) {
    UsRest rest = 0;
    return static_cast<uint16_t>(us_of(plan.slot_cycles - board::held_cycles(accuracy), &rest));
}

}  // namespace ohmskin
