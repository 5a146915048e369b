// SPDX-License-Identifier: Apache-2.0
#include "core/settings.h"

#include <string.h>

#include "board.h"
#include "core/crc16.h"

namespace ohmskin {

namespace {

constexpr uint8_t RECORD_SIZE = SettingsWriter::RECORD_SIZE;

Crc16 record_crc(const uint8_t *record) {
    Crc16 crc;
    for (uint8_t i = 0; i < RECORD_SIZE - 2; i++)
        crc.add(record[i]);
    return crc;
}

}  // namespace

frames::Settings load_settings(Settings *settings) {
    uint8_t record[RECORD_SIZE];
    bool blank = true;
    for (uint8_t i = 0; i < RECORD_SIZE; i++) {
        record[i] = board::eeprom_read(i);
        blank = blank && record[i] == 0xFF;
    }
    *settings = DEFAULT_SETTINGS;
    if (blank)
        return frames::Settings::DefaultsBlank;
    const Crc16 crc = record_crc(record);
    uint16_t layout;
    memcpy(&layout, record, sizeof layout);
    if (record[RECORD_SIZE - 2] != crc.low() || record[RECORD_SIZE - 1] != crc.high() ||
        layout != frames::LAYOUT_CRC)
        return frames::Settings::DefaultsDamaged;
    Settings stored;
    memcpy(&stored, record + 2, sizeof stored);
    ScanPlan plan;
    if (plan_scan(stored.request, board::CLOCK_HZ, &plan) != frames::Result::Ok)
        return frames::Settings::DefaultsDamaged;
    *settings = stored;
    return frames::Settings::Stored;
}

void SettingsWriter::begin(const Settings &settings) {
    const uint16_t layout = frames::LAYOUT_CRC;
    memcpy(record_, &layout, sizeof layout);
    memcpy(record_ + 2, &settings, sizeof settings);
    const Crc16 crc = record_crc(record_);
    record_[RECORD_SIZE - 2] = crc.low();
    record_[RECORD_SIZE - 1] = crc.high();
    at_ = 0;
    state_ = State::Writing;
}

SettingsWriter::State SettingsWriter::poll() {
    if (state_ != State::Writing || board::eeprom_busy())
        return State::Idle;
    if (at_ < RECORD_SIZE) {
        // Cells that already hold their value are spared: an EEPROM lasts 100,000 writes.
        if (board::eeprom_read(at_) != record_[at_])
            board::eeprom_write(at_, record_[at_]);
        at_++;
        return State::Writing;
    }
    state_ = State::Idle;
    for (uint8_t i = 0; i < RECORD_SIZE; i++)
        if (board::eeprom_read(i) != record_[i])
            return State::Failed;
    return State::Done;
}

}  // namespace ohmskin
