// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "frames.h"

namespace ohmskin {

enum class Drive : uint8_t { Top, Bottom };  // which pin is high; the other one is low
enum class Sense : uint8_t { Top, Bottom, FarTop, FarBottom };  // which node the converter reads

struct Configuration {
    Drive drive;
    Sense sense;
};

// What the readings are, by frames::Reading: the one table that says it.
constexpr Configuration CONFIGURATIONS[] = {
    {Drive::Top, Sense::Top},           // A
    {Drive::Top, Sense::Bottom},        // B
    {Drive::Bottom, Sense::Bottom},     // C
    {Drive::Bottom, Sense::Top},        // D
    {Drive::Top, Sense::FarTop},        // E
    {Drive::Top, Sense::FarBottom},     // F
    {Drive::Bottom, Sense::FarBottom},  // G
    {Drive::Bottom, Sense::FarTop},     // H
};

// What a scan takes of each cell, in scan order: the readings of its mode, by frames::Mode, or
// those of the self-test's scans of far nodes, with the number of such an order in place of the
// mode. They read the other layer's near node before each far node.
constexpr uint8_t MODES = sizeof frames::MODE_READINGS / sizeof *frames::MODE_READINGS;
constexpr uint8_t ORDERS = MODES + 2;
constexpr frames::Reading FAR_TEST_READINGS[][frames::READINGS_PER_CELL] = {
    {frames::Reading::B, frames::Reading::E, frames::Reading::C, frames::Reading::H},
    {frames::Reading::A, frames::Reading::F, frames::Reading::D, frames::Reading::G},
};
constexpr frames::Reading reading_of(uint8_t order, uint8_t n) {
    return order < MODES ? frames::MODE_READINGS[order][n] : FAR_TEST_READINGS[order - MODES][n];
}

// Where the multiplexers and pins stand for one reading.
struct Selection {
    uint8_t row;
    uint8_t column;
    uint8_t reading;  // 4 times the order, and the number of the reading in it
};

// The order of a scan: two readings of a cell, then rows, then columns; then the same with the
// other two. In mode near they have the other drive. A drive that changes from cell to cell would
// charge the lines that are not selected anew each time, through the cells. Inlined into the slot
// interrupt.
class ScanSequence {
  public:
    void begin(uint8_t rows, uint8_t columns, uint8_t order) {
        rows_ = rows;
        columns_ = columns;
        at_ = Selection{0, 0, static_cast<uint8_t>(order * frames::READINGS_PER_CELL)};
    }
    const Selection &at() const { return at_; }

    // Steps to the next reading; true when that is the first of a scan again.
    bool next() {
        at_.reading ^= 1;
        if (at_.reading & 1 || ++at_.row < rows_)
            return false;
        at_.row = 0;
        if (++at_.column < columns_)
            return false;
        at_.column = 0;
        at_.reading ^= 2;
        return (at_.reading & 2) == 0;
    }

  private:
    static_assert(frames::READINGS_PER_CELL == 4 && frames::READINGS_PER_PASS == 2, "two bits");
    Selection at_ = {0, 0, 0};
    uint8_t rows_ = 1;
    uint8_t columns_ = 1;
};

}  // namespace ohmskin
