// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_plan.h"

namespace ohmskin {

// What `save` keeps.
struct Settings {
    uint32_t unit_id;
    ScanRequest request;
};

// Sets them to those of a board that nobody has configured. These numbers are the firmware's own.
// The protocol says what may be asked for, not what a board begins with, and hosts read that from
// `hello`. They are not returned, which would take a copy.
OHMSKIN_RARE void take_defaults(Settings *settings);

// Settings as the EEPROM holds them. The fields are the record's own, not the protocol's, so that a
// change of the protocol forgets nothing. A change of the fields needs a new VERSION; `version` and
// `sequence` stay the first two bytes.
struct __attribute__((packed)) SettingsRecord {
    static constexpr uint8_t VERSION = 3;  // of the record's fields

    uint8_t version;
    uint8_t sequence;  // one more than that of the record written before; wraps
    uint32_t unit_id;
    uint8_t rows;
    uint8_t columns;
    uint32_t rate_mhz;
    uint16_t settle_us;
    uint8_t accuracy;
    uint8_t mode;
    uint32_t row_mask;
    uint32_t column_mask;
    uint8_t whole_mode;
    uint16_t whole_every;
    uint8_t crc_low, crc_high;  // over all before
};
static_assert(sizeof(SettingsRecord) == 29, "no padding; a change needs a new VERSION");

// Loads settings from EEPROM. Without a sound record of this version it yields the defaults. Where
// this firmware cannot make the record's scan with this line, the unit id stays and the scan is the
// default. The result says which. `routes` changes only where the scan is the record's: its plan.
OHMSKIN_RARE frames::Settings load_settings(Settings *settings, uint16_t cycles_per_byte,
                                            Routes *routes);

// Writes settings to EEPROM one byte at a time without waiting, so that the scan goes on. A reset
// at any moment leaves the old settings or the new ones.
class SettingsWriter {
  public:
    enum class State : uint8_t { Idle, Writing, Done, Failed };

    OHMSKIN_RARE void begin(const Settings &settings);
    // Writes the next byte when the EEPROM is free. Done and Failed are returned once.
    OHMSKIN_RARE State poll();
    bool idle() const { return state_ == State::Idle; }

  private:
    SettingsRecord record_ = {};
    uint8_t at_ = 0;    // address of the record in EEPROM
    uint8_t left_ = 0;  // bytes still to be written: from the last to the first
    State state_ = State::Idle;
};

}  // namespace ohmskin
