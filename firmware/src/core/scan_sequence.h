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

// The order of a scan: readings of a cell, then rows, then columns. Inlined into the slot
// interrupt.
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
        const uint8_t reading = static_cast<uint8_t>(at_.reading + 1);
        at_.reading = reading < frames::READINGS_PER_CELL ? reading : 0;
        if (at_.reading != 0)
            return false;
        return next_cell();
    }

  private:
    bool next_cell() {
        if (++at_.row < rows_)
            return false;
        at_.row = 0;
        if (++at_.column < columns_)
            return false;
        at_.column = 0;
        return true;
    }

    Selection at_ = {0, 0, 0};
    uint8_t rows_ = 1;
    uint8_t columns_ = 1;
};

}  // namespace ohmskin
