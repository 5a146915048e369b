// SPDX-License-Identifier: Apache-2.0
#include "core/settings.h"

#include <stddef.h>
#include <string.h>

#include "board.h"
#include "core/crc16.h"

namespace ohmskin {

namespace {

using Record = SettingsRecord;

// Addresses of the two records in EEPROM. They are written in turn: while one is being written, the
// other stays whole.
constexpr uint8_t FIRST_AT = 32, SECOND_AT = 64;
// Address at which older firmware had its one record, with the protocol's layout CRC in place of
// version and sequence. It is read where there is no other, and never written.
constexpr uint8_t OLD_AT = 0;
// In place of an address: there is no record.
constexpr uint8_t NOWHERE = 0xFF;
// A byte of EEPROM that was never written (data sheet: erased bytes read 0xFF).
constexpr uint8_t BLANK = 0xFF;

uint8_t *bytes_of(Record *record) { return reinterpret_cast<uint8_t *>(record); }

// Older records are read as well, and never written. Each is the beginning of the record of now,
// with its CRC behind it; but in place of an accuracy, they have the AVR's prescaler, 32, 64 or
// 128.
constexpr uint8_t VERSION_WITHOUT_REGION = 2, VERSION_WITHOUT_MODE = 1;

bool known(uint8_t version) {
    return version >= VERSION_WITHOUT_MODE && version <= Record::VERSION;
}

// All of so many rows or columns.
OHMSKIN_RARE uint32_t mask_of(uint8_t lines) { return (uint32_t{1} << lines % 32) - 1; }

// Reads a record; false where its CRC is wrong.
bool read(uint8_t at, Record *record) {
    uint8_t *bytes = bytes_of(record);
    for (uint8_t i = 0; i < sizeof *record; i++)
        bytes[i] = board::eeprom_read(at + i);
    const bool has_mode = at != OLD_AT && record->version != VERSION_WITHOUT_MODE;
    const bool has_region = has_mode && record->version != VERSION_WITHOUT_REGION;
    const uint8_t size = has_region ? sizeof *record
                                    : static_cast<uint8_t>(offsetof(Record, row_mask) + CRC_BYTES -
                                                           (has_mode ? 0 : sizeof record->mode));
    const bool sound = ends_in_crc(bytes, size);
    if (has_region)
        return sound;
    const uint8_t near = static_cast<uint8_t>(frames::Mode::Near);
    if (!has_mode)
        record->mode = near;
    uint8_t accuracy = 0;
    while (accuracy < static_cast<uint8_t>(frames::Accuracy::Finest) &&
           record->accuracy != 32 << accuracy)
        accuracy++;
    record->accuracy = accuracy;
    record->row_mask = mask_of(record->rows);
    record->column_mask = mask_of(record->columns);
    record->whole_mode = near;
    record->whole_every = 0;
    return sound;
}

// Reads the newest sound record of a version that is known; where it is, or NOWHERE.
uint8_t read_newest(Record *newest) {
    uint8_t newest_at = NOWHERE;
    for (uint8_t at = FIRST_AT; at <= SECOND_AT; at += SECOND_AT - FIRST_AT) {
        Record record;
        if (!read(at, &record) || !known(record.version))
            continue;
        // Sequences wrap: the newer one is at most half a turn ahead.
        if (newest_at != NOWHERE && static_cast<int8_t>(record.sequence - newest->sequence) <= 0)
            continue;
        *newest = record;
        newest_at = at;
    }
    return newest_at;
}

bool all_blank() {
    for (uint8_t at = OLD_AT; at < SECOND_AT + sizeof(Record); at++)
        if (board::eeprom_read(at) != BLANK)
            return false;
    return true;
}

// Whether a record of another version is there, as newer firmware may have left it. It is not
// overwritten as long as there is another place.
bool foreign(uint8_t at) {
    const uint8_t version = board::eeprom_read(at);
    return !known(version) && version != BLANK;
}

}  // namespace

// By assignments: of a constant object, an AVR would have a copy in RAM.
void take_defaults(Settings *settings) {
    ScanRequest &scan = settings->request;
    settings->unit_id = 0;  // none yet
    // Chosen: the size of skin that docs/ reckons with.
    scan.rows = scan.columns = 8;
    scan.row_mask = scan.column_mask = 0xFF;
    scan.accuracy = static_cast<uint8_t>(frames::Accuracy::Usual);
    // Chosen: the fastest round one that leaves 8x8 cells 20 us to settle on an Uno.
    scan.rate_mhz = 90000;
    scan.settle_us = 0;  // as long as the rate allows
    scan.mode = scan.whole_mode = static_cast<uint8_t>(frames::Mode::Near);
    scan.whole_every = 0;  // no whole scans in between: all are whole
}

frames::Settings load_settings(Settings *settings, uint16_t cycles_per_byte, Routes *routes) {
    take_defaults(settings);
    Record record;
    if (read_newest(&record) == NOWHERE && !read(OLD_AT, &record))
        return all_blank() ? frames::Settings::DefaultsBlank : frames::Settings::DefaultsDamaged;
    settings->unit_id = record.unit_id;
    const ScanRequest request = {
        record.rows,     record.columns,   record.accuracy, record.row_mask,   record.column_mask,
        record.rate_mhz, record.settle_us, record.mode,     record.whole_mode, record.whole_every};
    uint32_t rate_mhz;
    if (plan_scan(request, cycles_per_byte, routes, &rate_mhz) != frames::Result::Ok)
        return frames::Settings::DefaultsDamaged;
    settings->request = request;
    return frames::Settings::Stored;
}

void SettingsWriter::begin(const Settings &settings) {
    Record last = {};
    const uint8_t newest = read_newest(&last);
    const ScanRequest &scan = settings.request;
    // With the sequence and the CRC of the last record, for the comparison below. Field by field:
    // an initializer would be made on the stack first.
    record_ = last;
    record_.version = Record::VERSION;
    record_.unit_id = settings.unit_id;
    record_.rows = scan.rows;
    record_.columns = scan.columns;
    record_.rate_mhz = scan.rate_mhz;
    record_.settle_us = scan.settle_us;
    record_.accuracy = scan.accuracy;
    record_.mode = scan.mode;
    record_.row_mask = scan.row_mask;
    record_.column_mask = scan.column_mask;
    record_.whole_mode = scan.whole_mode;
    record_.whole_every = scan.whole_every;
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
    const Crc16 crc = crc_of(bytes_of(&record_), sizeof record_ - CRC_BYTES);
    record_.crc_low = crc.low();
    record_.crc_high = crc.high();
}

// The bytes are written from the last to the first, so version and sequence come last. Until all
// other bytes are there, the record still has its old sequence, and the other record is the newer
// one; or it has no version yet, and counts for nothing.
SettingsWriter::State SettingsWriter::poll() {
    if (state_ != State::Writing || board::eeprom_busy())
        return State::Idle;
    if (left_ != 0) {
        // Bytes that already hold their value are not worn by another write.
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
