// SPDX-License-Identifier: Apache-2.0
#include "flash_store.h"

#include "core/crc16.h"
#include "rp2040.h"

namespace flash_store {

using namespace rp2040;

namespace {

// ------------------------------------------------------------- commands of the flash chip
// Those of Winbond's W25Q16JV, which is on a Pico; other makers' chips have the same ones.
enum Command : uint8_t {
    PROGRAM = 0x02,
    READ = 0x03,
    READ_STATUS = 0x05,
    ENABLE_WRITE = 0x06,
    ERASE_SECTOR = 0x20,
    READ_UNIQUE_ID = 0x4B,
};
constexpr uint8_t STATUS_WRITING = 1;

// SPI frames of 8 bits, both ways at once (4.10.13).
constexpr uint32_t FRAMES_OF_8 = 7u << 16;
// clk_sys / 4: 32 MHz, of the 50 that READ may have.
constexpr uint32_t CLOCK_DIVIDER = 4;
// The SSI lets the chip's select go when its queue is empty, so the pin is set by hand.
constexpr uint32_t SELECT_LOW = 2u << 8, SELECT_HIGH = 3u << 8;
// Bytes of the SSI's queues: no command here is longer.
constexpr uint8_t QUEUE = 16;

// Sends bytes and puts those that come back into their place.
void exchange(uint8_t *octets, uint8_t count) {
    at(QSPI_SS_CTRL) = SELECT_LOW;
    for (uint8_t i = 0; i < count; i++)
        at(SSI_DR0) = octets[i];
    for (uint8_t i = 0; i < count; i++) {
        while (at(SSI_RXFLR) == 0) {
        }
        octets[i] = static_cast<uint8_t>(at(SSI_DR0));
    }
    at(QSPI_SS_CTRL) = SELECT_HIGH;
}

void put_address(uint8_t *octets, uint32_t address) {
    octets[0] = static_cast<uint8_t>(address >> 16);
    octets[1] = static_cast<uint8_t>(address >> 8);
    octets[2] = static_cast<uint8_t>(address);
}

bool flash_writes() {
    uint8_t octets[] = {READ_STATUS, 0};
    exchange(octets, sizeof octets);
    return octets[1] & STATUS_WRITING;
}

void enable_write() {
    uint8_t octets[] = {ENABLE_WRITE};
    exchange(octets, sizeof octets);
}

uint32_t read_word(uint32_t address) {
    uint8_t octets[8] = {READ};
    put_address(octets + 1, address);
    exchange(octets, sizeof octets);
    return static_cast<uint32_t>(octets[4]) | static_cast<uint32_t>(octets[5]) << 8 |
           static_cast<uint32_t>(octets[6]) << 16 | static_cast<uint32_t>(octets[7]) << 24;
}

void program_word(uint32_t address, uint32_t word) {
    enable_write();
    uint8_t octets[8] = {PROGRAM};
    put_address(octets + 1, address);
    for (uint8_t i = 0; i < 4; i++)
        octets[4 + i] = static_cast<uint8_t>(word >> 8 * i);
    exchange(octets, sizeof octets);
}

void erase_sector(uint32_t address) {
    enable_write();
    uint8_t octets[4] = {ERASE_SECTOR};
    put_address(octets + 1, address);
    exchange(octets, sizeof octets);
}

// -------------------------------------------------------------------------------------- log
// Two sectors of the flash's 2 MiB, the last ones. link.ld keeps the firmware out of them.
constexpr uint32_t SECTOR_BYTES = 4096, WORD = 4;
constexpr uint32_t SECTORS_AT = 2 * 1024 * 1024 - 2 * SECTOR_BYTES;
constexpr uint32_t BLANK = 0xFFFFFFFF;
constexpr uint8_t BLANK_OCTET = 0xFF;

// A word of a sector: 16 bits, and their CRC. In the first word, which is written last, they count
// the sectors that were begun; in all others, they are an address and its byte.
uint32_t word_of(uint16_t content) {
    ohmskin::Crc16 crc;
    crc.add(static_cast<uint8_t>(content));
    crc.add(static_cast<uint8_t>(content >> 8));
    return content | static_cast<uint32_t>(crc.low()) << 16 |
           static_cast<uint32_t>(crc.high()) << 24;
}
bool sound(uint32_t word) { return word == word_of(static_cast<uint16_t>(word)); }

enum class Work : uint8_t {
    None,
    Entry,    // an entry is being written
    Erasing,  // the other sector is
    Moving,   // what counts is being written to the other sector
    Heading,  // its first word is: from then on it is the one
};

uint8_t bytes[SIZE];
uint8_t sector;               // 0 or 1: where entries go
bool has_sector;              // false: nothing was ever written
uint16_t begun;               // number of this sector
uint32_t end = SECTOR_BYTES;  // of the entries: offset of the first word that is blank
Work work = Work::None;
uint16_t moved;  // addresses that Work::Moving has looked at
uint32_t entry;  // that is being written
bool broken;     // the flash did not take a sector's head: nothing is written any more

uint32_t address_of(uint8_t which, uint32_t offset) {
    return SECTORS_AT + which * SECTOR_BYTES + offset;
}
uint8_t other() { return has_sector ? sector ^ 1 : 0; }

// Takes all entries of the sector, the oldest first. One that a reset cut short counts for nothing.
void load() {
    end = WORD;
    for (uint32_t offset = WORD; offset < SECTOR_BYTES; offset += WORD) {
        const uint32_t word = read_word(address_of(sector, offset));
        if (word == BLANK)
            continue;
        end = offset + WORD;
        const uint8_t address = static_cast<uint8_t>(word >> 8);
        if (sound(word) && address < SIZE)
            bytes[address] = static_cast<uint8_t>(word);
    }
}

// The next step of moving to the other sector.
void move_on() {
    while (moved < SIZE && bytes[moved] == BLANK_OCTET)
        moved++;
    if (moved == SIZE) {
        program_word(address_of(other(), 0), word_of(static_cast<uint16_t>(begun + 1)));
        work = Work::Heading;
        return;
    }
    program_word(address_of(other(), end),
                 word_of(static_cast<uint16_t>(moved << 8 | bytes[moved])));
    end += WORD;
    moved++;
}

}  // namespace

void begin() {
    at(SSI_SSIENR) = 0;
    at(SSI_CTRLR0) = FRAMES_OF_8;
    at(SSI_BAUDR) = CLOCK_DIVIDER;
    at(SSI_SER) = 1;
    at(SSI_SSIENR) = 1;
    for (uint8_t &octet : bytes)
        octet = BLANK_OCTET;
    while (flash_writes()) {  // what a reset has interrupted goes on in the flash
    }
    for (uint8_t which = 0; which < 2; which++) {
        const uint32_t head = read_word(address_of(which, 0));
        const uint16_t number = static_cast<uint16_t>(head);
        if (!sound(head) || (has_sector && static_cast<int16_t>(number - begun) <= 0))
            continue;
        has_sector = true;
        sector = which;
        begun = number;
    }
    if (has_sector)
        load();
}

uint8_t read(uint16_t address) { return bytes[address]; }

bool busy() {
    if (work != Work::None && flash_writes())
        return true;
    switch (work) {
    case Work::None:
        if (end < SECTOR_BYTES || broken)
            return false;
        erase_sector(address_of(other(), 0));
        work = Work::Erasing;
        return true;
    case Work::Entry:
        // The byte counts if the flash holds it: whoever reads it then sees whether it does.
        if (read_word(address_of(sector, end - WORD)) == entry)
            bytes[static_cast<uint8_t>(entry >> 8)] = static_cast<uint8_t>(entry);
        work = Work::None;
        return busy();
    case Work::Erasing:
        work = Work::Moving;
        moved = 0;
        end = WORD;
        move_on();
        return true;
    case Work::Moving:
        move_on();
        return true;
    case Work::Heading:
        work = Work::None;
        broken = read_word(address_of(other(), 0)) != word_of(static_cast<uint16_t>(begun + 1));
        if (broken)
            return false;
        sector = other();
        has_sector = true;
        begun++;
        return false;
    }
    return false;
}

void write(uint16_t address, uint8_t octet) {
    if (broken)
        return;  // whoever reads it sees that it is not there
    entry = word_of(static_cast<uint16_t>(address << 8 | octet));
    program_word(address_of(sector, end), entry);
    end += WORD;
    work = Work::Entry;
}

void read_unique_id(uint8_t *octets) {
    constexpr uint8_t ANSWER_AT = 5, ANSWER = 8;
    static_assert(ANSWER_AT + ANSWER <= QUEUE, "one exchange");
    uint8_t exchanged[ANSWER_AT + ANSWER] = {READ_UNIQUE_ID};
    exchange(exchanged, sizeof exchanged);
    for (uint8_t i = 0; i < ANSWER; i++)
        octets[i] = exchanged[ANSWER_AT + i];
}

}  // namespace flash_store
