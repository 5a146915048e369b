// SPDX-License-Identifier: Apache-2.0
// Written by protocol/generate.py from protocol/frames.toml; do not edit.
#pragma once
#include <stdint.h>

namespace ohmskin {
namespace frames {

constexpr uint16_t LAYOUT_CRC = 0xEA8F;
constexpr uint8_t DELIMITER = 0x00;
constexpr uint16_t CRC_POLYNOMIAL = 0x1021;
constexpr uint16_t CRC_INITIAL = 0xFFFF;

// rows that a mask has bits for; a board says in `hello` how many it can scan
constexpr uint8_t ROWS_MAX = 32;
// columns that a mask has bits for
constexpr uint8_t COLUMNS_MAX = 32;
// bytes of a name: ASCII, zeros behind it
constexpr uint8_t NAME_SIZE = 16;
// names in the enum `reading`
constexpr uint8_t READINGS = 8;
// readings of a cell in a scan, at most: those of its mode, in its order
constexpr uint8_t READINGS_MAX = 4;
// bits of one code, at most; a board says its own in `hello` and in each scan
constexpr uint8_t ADC_BITS_MAX = 16;
// slowest scan rate
constexpr uint16_t RATE_MHZ_MIN = 1000;
// fastest scan rate that can be asked for; what fits depends on the readings of a scan, on line and processor
constexpr uint32_t RATE_MHZ_MAX = 50000000;
// longest settling time that can be asked for
constexpr uint16_t SETTLE_US_MAX = 3000;
// line speed after every reset, 8N1: some USB bridges lose bytes above about 47 kB/s
constexpr uint32_t BAUD_DEFAULT = 500000;
// the other line speed a board can be switched to until its next reset
constexpr uint32_t BAUD_FAST = 1000000;
// a board that hears no valid command this long after set_baud returns to baud_default
constexpr uint16_t BAUD_CONFIRM_MS = 1000;

// V/Vdd of the sense node named; a cell's row is in the top layer, its column in the bottom layer
enum class Reading : uint8_t {
    A = 0,  // top pin high, bottom pin low: top sense node
    B = 1,  // top pin high, bottom pin low: bottom sense node
    C = 2,  // top pin low, bottom pin high: bottom sense node
    D = 3,  // top pin low, bottom pin high: top sense node
    E = 4,  // top pin high, bottom pin low: far end of the row
    F = 5,  // top pin high, bottom pin low: far end of the column
    G = 6,  // top pin low, bottom pin high: far end of the column
    H = 7,  // top pin low, bottom pin high: far end of the row
};

// which readings a scan takes of each cell, in scan order. A scan passes over all its cells, once or more often: `per_pass` readings of a cell follow each other, and the next ones come in the next pass
enum class Mode : uint8_t {
    Near = 0,  // both near ends, under both drives
    Far = 1,  // both ends of row and column, under one drive; needs a second pair of multiplexers at the far ends
    Half = 2,  // both near ends, under one drive: half the time of near, and offsets of the converter do not show
    Quick = 3,  // the column's near end alone: a quarter of the time of near
};

// where the settings in force at boot came from
enum class Settings : uint8_t {
    Stored = 0,  // read from EEPROM, CRC right
    DefaultsBlank = 1,  // EEPROM never written: defaults
    DefaultsDamaged = 2,  // EEPROM holds no sound record, or a scan that does not fit: defaults, but for a unit id that is sound
};

// how exact a conversion is, and so how long it takes
enum class Accuracy : uint8_t {
    Usual = 0,  // the default; 26 us a conversion on an Uno (ADC clock of 500 kHz)
    Fine = 1,  // less noise of the converter; 52 us on an Uno (250 kHz)
    Finest = 2,  // all that the converter's data sheet promises; 104 us on an Uno (125 kHz)
};

// answer to a command; anything but ok has changed nothing
enum class Result : uint8_t {
    Ok = 0,  // done
    UnknownCommand = 1,  // this firmware has no such command
    BadLength = 2,  // the payload has the wrong length
    BadRows = 3,  // rows outside 1 to the board's rows_max, or a mask that is empty or has bits beyond the rows
    BadColumns = 4,  // columns outside 1 to the board's columns_max, or a mask that is empty or has bits beyond the columns
    BadRate = 5,  // rate neither 0 nor within 1000..50000000 mHz
    BadSettle = 6,  // settle time above 3000 us
    BadAccuracy = 7,  // no such accuracy
    BadBaud = 8,  // no such line speed
    TooFast = 9,  // converter or processor cannot keep up with this rate: lower the rate, the settle time, the accuracy or the number of cells
    LineTooSlow = 10,  // the line cannot keep up with this rate: lower the rate or the number of cells, or raise the speed of the line
    Scanning = 11,  // not while scanning: stop first
    Busy = 12,  // a command is still being carried out that this one would disturb: wait for its answer
    EepromFailed = 13,  // the EEPROM does not hold what was written
    BadMode = 14,  // no such mode
};

// bits of hello.reset_cause, only those that are known: most boot loaders clear the chip's own record
enum class ResetCause : uint8_t {
    PowerOn = 1,  // supply came up
    External = 2,  // reset pin, as when a host opens the port
    BrownOut = 4,  // supply dipped
    Watchdog = 8,  // the firmware hung and was restarted
};

// bits of self_test_report.findings: what no skin can cause
enum class Finding : uint16_t {
    TopStuckLow = 1,  // top sense node at ground under both drives: short to ground
    TopStuckHigh = 2,  // top sense node at Vdd under both drives: short to Vdd
    TopReferenceMissing = 4,  // top sense node does not follow its drive pin: reference resistor or drive wire open
    BottomStuckLow = 8,  // bottom sense node at ground under both drives: short to ground
    BottomStuckHigh = 16,  // bottom sense node at Vdd under both drives: short to Vdd
    BottomReferenceMissing = 32,  // bottom sense node does not follow its drive pin: reference resistor or drive wire open
    FarTopStuckLow = 64,  // far sense node of the rows at ground under both drives: short to ground
    FarTopStuckHigh = 128,  // far sense node of the rows at Vdd under both drives: short to Vdd
    FarTopOpen = 256,  // far sense node of the rows follows no row: multiplexer, its wire or its connector open
    FarBottomStuckLow = 512,  // far sense node of the columns at ground under both drives: short to ground
    FarBottomStuckHigh = 1024,  // far sense node of the columns at Vdd under both drives: short to Vdd
    FarBottomOpen = 2048,  // far sense node of the columns follows no column: multiplexer, its wire or its connector open
};

// Readings of each mode, in scan order: how many, how many a pass, and which.
struct ModeReadings {
    uint8_t count, per_pass;
    Reading readings[READINGS_MAX];
};
constexpr ModeReadings MODE_READINGS[] = {
    {4, 2, {Reading::A, Reading::B, Reading::C, Reading::D}},  // near
    {4, 2, {Reading::A, Reading::E, Reading::B, Reading::F}},  // far
    {2, 2, {Reading::A, Reading::B}},  // half
    {1, 1, {Reading::B}},  // quick
};

enum class Type : uint8_t {
    Hello = 0x01,
    Scan = 0x02,
    Ack = 0x03,
    SelfTestReport = 0x04,
    GetHello = 0x81,
    Configure = 0x82,
    Start = 0x83,
    Stop = 0x84,
    SetUnitId = 0x85,
    Save = 0x86,
    LoadDefaults = 0x87,
    SelfTest = 0x88,
    SetBaud = 0x89,
    SetRegion = 0x8A,
};

// board to host: who the board is and how it scans: sent at boot and on request
struct __attribute__((packed)) Hello {
    uint16_t layout_crc;  // CRC-16 of this definition; always the first field
    uint8_t version_major;  // firmware version
    uint8_t version_minor;  // firmware version
    uint8_t version_patch;  // firmware version
    char board[16];  // hardware the firmware was built for, as PlatformIO calls it; emulated: none
    uint16_t wiring;  // CRC-16 of the board's table of pins, where it is not that of docs/build.md; 0: it is
    uint32_t unit_id;  // name of this skin, set by the user; 0: none yet
    uint8_t rows_max;  // rows that this board can scan
    uint8_t columns_max;  // columns that this board can scan
    uint8_t rows;  // rows of the skin
    uint8_t columns;  // columns of the skin
    uint8_t adc_bits;  // bits of one code
    uint32_t ref_top_ohm;  // [ohm] reference resistor of the row side
    uint32_t ref_bottom_ohm;  // [ohm] reference resistor of the column side
    uint32_t rate_asked_mhz;  // [mHz] rate asked for; 0: as fast as readings settle, and line and processor keep up
    uint32_t scan_cycles;  // [clock] clock cycles from one scan's start to the next: the rate that is kept
    uint32_t slot_cycles;  // [clock] clock cycles from one reading of a scan to the next; what is left of the scan after its last reading is idle
    uint32_t whole_scan_cycles;  // [clock] clock cycles of a whole scan in between; 0: there is none
    uint32_t clock_hz;  // [Hz] clock of the board
    uint16_t settle_asked_us;  // [us] settle time asked for; 0: as long as the rate allows
    uint16_t settle_us;  // [us] time to settle before a hold, at least, of the node and of the sample capacitor
    uint8_t accuracy;  // of a conversion
    uint8_t mode;  // which readings a scan takes
    uint32_t row_mask;  // rows that a scan reads, bit 0 for row 0
    uint32_t column_mask;  // columns that a scan reads
    uint8_t whole_mode;  // which readings a whole scan in between takes
    uint16_t whole_every;  // each so many-th scan is a whole one, of all rows and columns; 0: none
    uint32_t baud;  // [baud] line speed in force
    uint8_t settings;  // where the settings at boot came from
    uint8_t reset_cause;  // why the board last started
    uint8_t scanning;  // 1 while scanning
    uint16_t dropped;  // scans made but not sent since start, also where no scan comes; wraps
    uint16_t late;  // readings lost since start because their conversion ended too late; wraps
};
static_assert(sizeof(Hello) == 88, "wire size");

// board to host: all readings of one scan. The codes follow the header: the readings of the mode's first pass of each cell, cells in column-major order (rows run fastest), then those of its next pass of each cell; of the cells alone whose row and column are in the masks; adc_bits each, packed without gaps, least significant bit first. The last byte is padded with zero bits.
struct __attribute__((packed)) Scan {
    uint32_t scan;  // number of the scan since start, dropped ones counted; wraps
    uint32_t time_us;  // [us] board time at which the scan started; wraps
    uint16_t dropped;  // scans made but not sent since start; wraps
    uint16_t rx_errors;  // damaged or overlong frames the board has received since boot, and commands that came while four others waited for their answers; wraps
    uint8_t rows;  // rows of the skin
    uint8_t columns;  // columns of the skin
    uint8_t mode;  // which readings these are
    uint8_t adc_bits;  // bits of one code
    uint32_t row_mask;  // rows that were read, bit 0 for row 0
    uint32_t column_mask;  // columns that were read
    uint16_t slot_cycles;  // [clock] clock cycles from one reading of this scan to the next; 0: as in hello
    // followed by codes: of the cells that were read
};
static_assert(sizeof(Scan) == 26, "wire size");

// board to host: answer to one command; the only one, sent when the command has been carried out. A command that comes while four others wait for their answers is neither carried out nor answered, but counted in `rx_errors`
struct __attribute__((packed)) Ack {
    uint8_t command;  // type of the command answered
    uint8_t command_sequence;  // sequence number of the command answered
    uint8_t result;  // ok, or why not
    uint32_t time_us;  // [us] board time at which the command's last byte was read; wraps
    uint32_t rate_mhz;  // [mHz] of configure and set_region: the rate that is kept or, where it was too fast, the fastest that could be; else 0
};
static_assert(sizeof(Ack) == 11, "wire size");

// board to host: what the sense nodes read over all multiplexer inputs; comes before the ack of self_test
struct __attribute__((packed)) SelfTestReport {
    uint16_t findings;  // what cannot be on a sound board
    uint16_t code_min[8];  // smallest code of each reading over all inputs; above code_max: not taken, as e to h in mode near
    uint16_t code_max[8];  // largest code of each reading over all inputs
};
static_assert(sizeof(SelfTestReport) == 34, "wire size");

// host to board: how to scan; all of it or nothing. Refused while scanning. What follows accuracy are the fields of set_region
struct __attribute__((packed)) Configure {
    uint8_t rows;  // rows of the skin, 1 to the board's rows_max
    uint8_t columns;  // columns of the skin, 1 to the board's columns_max
    uint8_t accuracy;  // of a conversion
    uint32_t row_mask;  // rows that a scan reads, bit 0 for row 0
    uint32_t column_mask;  // columns that a scan reads
    uint32_t rate_mhz;  // [mHz] scans per 1000 s; 0: as fast as readings settle, and line and processor keep up
    uint16_t settle_us;  // [us] least settle time, which then also is kept; 0: as long as the rate allows
    uint8_t mode;  // which readings a scan takes
    uint8_t whole_mode;  // which readings a whole scan in between takes
    uint16_t whole_every;  // each so many-th scan is a whole one, of all rows and columns, as fast as its readings settle; 0: none
};
static_assert(sizeof(Configure) == 21, "wire size");

// host to board: name this skin; `save` makes it last
struct __attribute__((packed)) SetUnitId {
    uint32_t unit_id;  // the new name
};
static_assert(sizeof(SetUnitId) == 4, "wire size");

// host to board: change the line speed after the ack; to be confirmed by any command at the new speed. Refused while scanning
struct __attribute__((packed)) SetBaud {
    uint32_t baud;  // [baud] baud_default or baud_fast
};
static_assert(sizeof(SetBaud) == 4, "wire size");

// host to board: which part of the skin to scan, and how; also while scanning. Answered when it is in force, from the next scan on
struct __attribute__((packed)) SetRegion {
    uint32_t row_mask;  // rows that a scan reads, bit 0 for row 0
    uint32_t column_mask;  // columns that a scan reads
    uint32_t rate_mhz;  // [mHz] as in configure
    uint16_t settle_us;  // [us] as in configure
    uint8_t mode;  // which readings a scan takes
    uint8_t whole_mode;  // which readings a whole scan in between takes
    uint16_t whole_every;  // as in configure; the count goes on over a change of region, but a whole scan that is due lets one scan of the new region go first
};
static_assert(sizeof(SetRegion) == 18, "wire size");

}  // namespace frames
}  // namespace ohmskin
