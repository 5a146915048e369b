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

constexpr Settings DEFAULT_SETTINGS = {0, {8, 8, 90000, 0, 32}};

// Loads settings from EEPROM; a record that is blank, torn, of another layout or cannot be scanned
// yields the defaults, and the result says which.
OHMSKIN_RARE frames::Settings load_settings(Settings *settings);

// Writes settings to EEPROM one byte at a time without waiting, so that the scan goes on.
class SettingsWriter {
  public:
    enum class State : uint8_t { Idle, Writing, Done, Failed };

    OHMSKIN_RARE void begin(const Settings &settings);
    // Writes the next byte when the EEPROM is free. Done and Failed are returned once.
    OHMSKIN_RARE State poll();
    bool idle() const { return state_ == State::Idle; }

    // Layout of the record: the protocol's layout CRC, the settings, a CRC over both.
    static constexpr uint8_t RECORD_SIZE = 2 + sizeof(Settings) + 2;

  private:
    uint8_t record_[RECORD_SIZE] = {};
    uint8_t at_ = 0;
    State state_ = State::Idle;
};

}  // namespace ohmskin
