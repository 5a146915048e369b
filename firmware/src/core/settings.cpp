// SPDX-License-Identifier: Apache-2.0
#include "core/settings.h"

#include <string.h>

#include "board.h"
#include "core/crc16.h"

namespace ohmskin {

namespace {

using Record = SettingsRecord;

// Two records are written in turn: while one is being written, the other stays whole.
constexpr uint8_t FIRST_AT = 32, SECOND_AT = 64;
// Older firmware had one record here, with the protocol's layout CRC in place of version and
// sequence. It is read where there is no other, and never written.
constexpr uint8_t OLD_AT = 0;
constexpr uint8_t NOWHERE = 0xFF;
constexpr uint8_t BLANK = 0xFF;

uint8_t *bytes_of(Record *record) { return reinterpret_cast<uint8_t *>(record); }

Crc16 crc_of(Record *record, uint8_t size) {
    Crc16 crc;
    for (uint8_t i = 0; i < size - 2; i++)
        crc.add(bytes_of(record)[i]);
    return crc;
}

bool known(uint8_t version) {
    return version == Record::VERSION || version == Record::VERSION_WITHOUT_MODE;
}

// Reads a record; false where its CRC is wrong.
bool read(uint8_t at, Record *record) {
    uint8_t *bytes = bytes_of(record);
    for (uint8_t i = 0; i < sizeof *record; i++)
        bytes[i] = board::eeprom_read(at + i);
    const bool has_mode = at != OLD_AT && record->version != Record::VERSION_WITHOUT_MODE;
    const uint8_t size = has_mode ? sizeof *record : sizeof *record - 1;
    const Crc16 crc = crc_of(record, size);
    const bool sound = bytes[size - 2] == crc.low() && bytes[size - 1] == crc.high();
    if (!has_mode)
        record->mode = static_cast<uint8_t>(frames::Mode::Near);
    return sound;
}

// Reads the newest sound record of a version that is known; where it is, or NOWHERE.
uint8_t read_newest(Record *newest) {
    uint8_t found = NOWHERE;
    for (uint8_t at = FIRST_AT; at <= SECOND_AT; at += SECOND_AT - FIRST_AT) {
        Record record;
        if (!read(at, &record) || !known(record.version))
            continue;
        if (found != NOWHERE && static_cast<int8_t>(record.sequence - newest->sequence) <= 0)
            continue;
        *newest = record;
        found = at;
    }
    return found;
}

bool all_blank() {
    for (uint8_t at = OLD_AT; at < SECOND_AT + sizeof(Record); at++)
        if (board::eeprom_read(at) != BLANK)
            return false;
    return true;
}

// Of another version, as newer firmware may have left it.
bool foreign(uint8_t at) {
    const uint8_t version = board::eeprom_read(at);
    return !known(version) && version != BLANK;
}

}  // namespace

frames::Settings load_settings(Settings *settings) {
    *settings = DEFAULT_SETTINGS;
    Record record;
    if (read_newest(&record) == NOWHERE && !read(OLD_AT, &record))
        return all_blank() ? frames::Settings::DefaultsBlank : frames::Settings::DefaultsDamaged;
    settings->unit_id = record.unit_id;
    const ScanRequest request = {record.rows,      record.columns,       record.rate_mhz,
                                 record.settle_us, record.adc_prescaler, record.mode};
    ScanPlan plan;
    if (plan_scan(request, board::CLOCK_HZ, &plan) != frames::Result::Ok)
        return frames::Settings::DefaultsDamaged;
    settings->request = request;
    return frames::Settings::Stored;
}

void SettingsWriter::begin(const Settings &settings) {
    Record last = {};
    const uint8_t newest = read_newest(&last);
    const ScanRequest &scan = settings.request;
    record_ = {Record::VERSION, last.sequence, settings.unit_id, scan.rows,
               scan.columns,    scan.rate_mhz, scan.settle_us,   scan.adc_prescaler,
               scan.mode,       last.crc_low,  last.crc_high};
    state_ = State::Writing;
    at_ = newest;
    left_ = 0;
    // An EEPROM lasts 100,000 writes: what it holds already is not written again.
    if (newest != NOWHERE && memcmp(&record_, &last, sizeof last) == 0)
        return;
    const bool second =
        newest == FIRST_AT || (newest == NOWHERE && foreign(FIRST_AT) && !foreign(SECOND_AT));
    at_ = second ? SECOND_AT : FIRST_AT;
    left_ = sizeof record_;
    record_.sequence++;
    const Crc16 crc = crc_of(&record_, sizeof record_);
    record_.crc_low = crc.low();
    record_.crc_high = crc.high();
}

// The bytes are written from the last to the first. So until all others are there, a record keeps
// its old sequence, by which the other one is newer, or is still of no version.
SettingsWriter::State SettingsWriter::poll() {
    if (state_ != State::Writing || board::eeprom_busy())
        return State::Idle;
    if (left_ != 0) {
        // Cells that already hold their value are spared too.
        left_--;
        const uint8_t octet = bytes_of(&record_)[left_];
        if (board::eeprom_read(at_ + left_) != octet)
            board::eeprom_write(at_ + left_, octet);
        return State::Writing;
    }
    state_ = State::Idle;
    for (uint8_t i = 0; i < sizeof record_; i++)
        if (board::eeprom_read(at_ + i) != bytes_of(&record_)[i])
            return State::Failed;
    return State::Done;
}

}  // namespace ohmskin
