// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "frames.h"

namespace ohmskin {

// Words of the scan, each with one meaning:
//
//     reading    A to H (frames::Reading): which pin is driven high, and which node is sensed
//     mode       near or far (frames::Mode): the four readings that a host asks for, of each cell
//     pattern    the four readings that a scan takes: those of a mode, or of the self-test
//     pass       a scan's way over all cells, which takes two of the four readings

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
constexpr frames::Reading FAR_TEST_READINGS[][frames::READINGS_PER_CELL] = {
    {frames::Reading::B, frames::Reading::E, frames::Reading::C, frames::Reading::H},
    {frames::Reading::A, frames::Reading::F, frames::Reading::D, frames::Reading::G},
};
constexpr uint8_t PATTERNS = MODES + sizeof FAR_TEST_READINGS / sizeof *FAR_TEST_READINGS;

// The n-th reading of a pattern, in scan order.
constexpr frames::Reading reading_of(uint8_t pattern, uint8_t n) {
    return pattern < MODES ? frames::MODE_READINGS[pattern][n]
                           : FAR_TEST_READINGS[pattern - MODES][n];
}

// Where the multiplexers and pins stand for one reading of one cell.
struct Selection {
    uint8_t row;
    uint8_t column;
    // Which entry of a table of all patterns: 4 * pattern + number of the reading in its pattern.
    // The interrupt looks register values up by it, without arithmetic.
    uint8_t pattern_entry;
};

// The order in which a scan visits cells: a first pass takes the pattern's first two readings of
// each cell, a second pass the other two. Rows run fastest. In mode near the passes differ in the
// drive. If the drive changed from cell to cell, it would charge the lines that are not selected
// anew each time, through the cells. Inlined into the slot interrupt.
class ScanSequence {
  public:
    void begin(uint8_t rows, uint8_t columns, uint8_t pattern) {
        rows_ = rows;
        columns_ = columns;
        at_ = Selection{0, 0, static_cast<uint8_t>(pattern * frames::READINGS_PER_CELL)};
    }
    const Selection &at() const { return at_; }

    // Steps to the next reading; true when that is the first of a scan again.
    bool next() {
        at_.pattern_entry ^= SECOND_OF_PASS;
        if (at_.pattern_entry & SECOND_OF_PASS || ++at_.row < rows_)
            return false;
        at_.row = 0;
        if (++at_.column < columns_)
            return false;
        at_.column = 0;
        at_.pattern_entry ^= SECOND_PASS;
        return (at_.pattern_entry & SECOND_PASS) == 0;
    }

  private:
    // The two lowest bits of pattern_entry count a pattern's readings: 0 and 1 are those of the
    // first pass, 2 and 3 those of the second.
    static constexpr uint8_t SECOND_OF_PASS = 1, SECOND_PASS = 2;
    static_assert(frames::READINGS_PER_CELL == 4 && frames::READINGS_PER_PASS == 2, "two bits");
    Selection at_ = {0, 0, 0};
    uint8_t rows_ = 1;
    uint8_t columns_ = 1;
};

}  // namespace ohmskin
