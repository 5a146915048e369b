// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "frames.h"

namespace ohmskin {

enum class Drive : uint8_t { Top, Bottom };  // which pin is high; the other one is low
enum class Sense : uint8_t { Top, Bottom };  // which node the converter reads

struct Configuration {
    Drive drive;
    Sense sense;
};

// What a cell's readings are, in scan order: the one table that says it.
constexpr Configuration CONFIGURATIONS[] = {
    {Drive::Top, Sense::Top},        // A
    {Drive::Top, Sense::Bottom},     // B
    {Drive::Bottom, Sense::Bottom},  // C
    {Drive::Bottom, Sense::Top},     // D
};
static_assert(sizeof CONFIGURATIONS / sizeof *CONFIGURATIONS == frames::READINGS_PER_CELL,
              "one configuration a reading");

// Where the multiplexers and pins stand for one reading.
struct Selection {
    uint8_t row;
    uint8_t column;
    uint8_t reading;  // index into CONFIGURATIONS
};

// The order of a scan: two readings of a cell, with one drive, then rows, then columns; then the
// same with the other drive. A drive that changes from cell to cell would charge the lines that are
// not selected anew each time, through the cells. Inlined into the slot interrupt.
class ScanSequence {
  public:
    void begin(uint8_t rows, uint8_t columns) {
        rows_ = rows;
        columns_ = columns;
        at_ = Selection{0, 0, 0};
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
        return at_.reading == 0;
    }

  private:
    static_assert(frames::READINGS_PER_CELL == 4 && frames::READINGS_PER_PASS == 2, "two bits");
    Selection at_ = {0, 0, 0};
    uint8_t rows_ = 1;
    uint8_t columns_ = 1;
};

}  // namespace ohmskin
