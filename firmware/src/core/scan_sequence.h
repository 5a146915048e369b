// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "board_numbers.h"
#include "frames.h"

// Rows and columns that the board's multiplexers have: the address bits of its pins limit them.
#ifndef OHMSKIN_ROWS_MAX
#define OHMSKIN_ROWS_MAX 16
#endif
#ifndef OHMSKIN_COLUMNS_MAX
#define OHMSKIN_COLUMNS_MAX 16
#endif

namespace ohmskin {

constexpr uint8_t ROWS_MAX = OHMSKIN_ROWS_MAX;
constexpr uint8_t COLUMNS_MAX = OHMSKIN_COLUMNS_MAX;
static_assert(ROWS_MAX <= frames::ROWS_MAX && COLUMNS_MAX <= frames::COLUMNS_MAX, "bits of masks");

// A bit a row or column. The link's masks have 32 bits, of which this board needs no more.
#if OHMSKIN_ROWS_MAX > 16 || OHMSKIN_COLUMNS_MAX > 16
#define OHMSKIN_LINES_MAX 32
using LineMask = uint32_t;
#else
#define OHMSKIN_LINES_MAX 16
using LineMask = uint16_t;
#endif

// Words of the scan, each with one meaning:
//
//     reading    A to H (frames::Reading): which pin is driven high, and which node is sensed
//     mode       near, far, half or quick (frames::Mode): the readings that a host asks for, of
//                each cell
//     pattern    the readings that a scan takes: those of a mode, or of the self-test
//     pass       a scan's way over all its cells, which takes one group of the readings
//     group      readings of a cell that follow each other

enum class Drive : uint8_t { Top, Bottom };  // which pin is high; the other one is low
enum class Sense : uint8_t { Top, Bottom, FarTop, FarBottom };  // which node the converter reads

struct ReadingDefinition {
    Drive drive;
    Sense sense;
};

// What each frames::Reading is. Every other place derives it from this table.
constexpr ReadingDefinition READING_DEFINITIONS[] = {
    {Drive::Top, Sense::Top},           // A
    {Drive::Top, Sense::Bottom},        // B
    {Drive::Bottom, Sense::Bottom},     // C
    {Drive::Bottom, Sense::Top},        // D
    {Drive::Top, Sense::FarTop},        // E
    {Drive::Top, Sense::FarBottom},     // F
    {Drive::Bottom, Sense::FarBottom},  // G
    {Drive::Bottom, Sense::FarTop},     // H
};

// Pattern n is that of mode n; the last two are those of the self-test's scans of far nodes. The
// self-test's patterns read a near node of the other layer before each far node, because a far node
// that is connected to nothing then keeps that node's potential, which shows (see self_test.h).
constexpr uint8_t MODES = sizeof frames::MODE_READINGS / sizeof *frames::MODE_READINGS;
constexpr frames::ModeReadings PATTERN_DEFINITIONS[] = {
    frames::MODE_READINGS[0],
    frames::MODE_READINGS[1],
    frames::MODE_READINGS[2],
    frames::MODE_READINGS[3],
    {4, 2, {frames::Reading::B, frames::Reading::E, frames::Reading::C, frames::Reading::H}},
    {4, 2, {frames::Reading::A, frames::Reading::F, frames::Reading::D, frames::Reading::G}},
};
constexpr uint8_t PATTERNS = sizeof PATTERN_DEFINITIONS / sizeof *PATTERN_DEFINITIONS;
static_assert(MODES == 4 && PATTERNS == MODES + 2, "a mode has no pattern above");

// The n-th reading of a pattern, in scan order.
constexpr frames::Reading reading_of(uint8_t pattern, uint8_t n) {
    return PATTERN_DEFINITIONS[pattern].readings[n];
}

// Where the multiplexers and pins stand for one reading of one cell.
struct Selection {
    uint8_t row;
    uint8_t column;
    // Which entry of a table of all patterns: 4 * pattern + number of the reading in its pattern.
    // The interrupt looks register values up by it, without arithmetic.
    uint8_t pattern_entry;
};

// Where to go from each row and column, so that the interrupt neither shifts masks nor searches: to
// the next line of the mask, and from the last one to the first.
class Lines {
  public:
    void set(LineMask rows, LineMask columns) {
        uint8_t row = first(rows), column = first(columns);
        for (uint8_t line = OHMSKIN_LINES_MAX; line-- != 0;) {
            next_[line] = static_cast<Pair>(column << HALF | row);
            if (rows & TOP)
                row = line;
            if (columns & TOP)
                column = line;
            rows = static_cast<LineMask>(rows << 1);
            columns = static_cast<LineMask>(columns << 1);
        }
    }
    uint8_t row_after(uint8_t row) const { return static_cast<uint8_t>(next_[row] & LOW_HALF); }
    uint8_t column_after(uint8_t column) const {
        // A rotation by half is one instruction of an AVR; a shift of it would be eight.
        const Pair pair = next_[column];
        return static_cast<Pair>(pair << HALF | pair >> HALF) & LOW_HALF;
    }
    // The first line of a mask, which must have one.
    static uint8_t first(LineMask mask) {
        uint8_t line = 0;
        for (; !(mask & 1); mask = static_cast<LineMask>(mask >> 1))
            line++;
        return line;
    }

  private:
    // A row and a column; of 16 lines, both fit into a byte.
#if OHMSKIN_LINES_MAX > 16
    using Pair = uint16_t;
    static constexpr uint8_t HALF = 8;
#else
    using Pair = uint8_t;
    static constexpr uint8_t HALF = 4;
#endif

    static constexpr Pair LOW_HALF = (1 << HALF) - 1;

    // The bit of the last line.
    static constexpr LineMask TOP = LineMask{1} << (OHMSKIN_LINES_MAX - 1);

    Pair next_[OHMSKIN_LINES_MAX] = {};
};

// What the interrupt needs to know of a kind of scan besides.
struct Steps {
    Selection first;
    uint8_t group_mask;  // readings of a group, less 1: the bits that count them in pattern_entry
    uint8_t last_group;  // the first pattern_entry of the pattern's last group
    uint16_t idle_slots;
    uint16_t slot_cycles;

    template <class Route> void set(const Route &route) {
        const frames::ModeReadings &readings = PATTERN_DEFINITIONS[route.pattern];
        first = Selection{Lines::first(route.rows), Lines::first(route.columns),
                          static_cast<uint8_t>(route.pattern * frames::READINGS_MAX)};
        group_mask = static_cast<uint8_t>(readings.per_pass - 1);
        last_group = static_cast<uint8_t>(first.pattern_entry + readings.count - readings.per_pass);
        idle_slots = route.plan.idle_slots;
        slot_cycles = route.plan.slot_cycles;
    }
};

// The order in which a scan visits its cells: a first pass takes the pattern's first group of
// readings of each cell, the next pass the next group. Rows run fastest. In mode near the passes
// differ in the drive. If the drive changed from cell to cell, it would charge the lines that are
// not selected anew each time, through the cells. Inlined into the slot interrupt.
class ScanSequence {
  public:
    void begin(const Lines &lines, const Steps &steps) {
        lines_ = &lines;
        steps_ = &steps;
        at_ = steps.first;
    }
    const Selection &at() const { return at_; }
    const Steps &steps() const { return *steps_; }

    // Steps to the next reading; true when that is the first of a scan again.
    bool next() {
        const Steps &now = *steps_;
        uint8_t entry = at_.pattern_entry;
        const uint8_t mask = now.group_mask;
        if ((entry & mask) != mask) {
            at_.pattern_entry = static_cast<uint8_t>(entry + 1);
            return false;
        }
        entry = static_cast<uint8_t>(entry & ~mask);
        const uint8_t row = lines_->row_after(at_.row);
        const bool same_column = row > at_.row;
        at_.row = row;
        if (same_column) {
            at_.pattern_entry = entry;
            return false;
        }
        const uint8_t column = lines_->column_after(at_.column);
        const bool same_pass = column > at_.column;
        at_.column = column;
        const bool ends = !same_pass && entry == now.last_group;
        if (ends)
            entry = now.first.pattern_entry;
        else if (!same_pass)
            entry = static_cast<uint8_t>(entry + mask + 1);
        at_.pattern_entry = entry;
        return ends;
    }

  private:
    static_assert(frames::READINGS_MAX == 4,
                  "two bits of pattern_entry count a pattern's readings");
    Selection at_ = {0, 0, 0};
    const Lines *lines_ = nullptr;
    const Steps *steps_ = nullptr;
};

}  // namespace ohmskin
