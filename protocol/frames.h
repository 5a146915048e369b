// SPDX-License-Identifier: Apache-2.0
// Written by protocol/generate.py from protocol/frames.toml; do not edit.
#pragma once
#include <stdint.h>

namespace ohmskin {
namespace frames {

constexpr uint16_t LAYOUT_CRC = 0x2FED;
constexpr uint8_t DELIMITER = 0x00;
constexpr uint16_t CRC_POLYNOMIAL = 0x1021;
constexpr uint16_t CRC_INITIAL = 0xFFFF;

// rows a board can scan: inputs of one CD74HC4067
constexpr uint8_t ROWS_MAX = 16;
// columns a board can scan
constexpr uint8_t COLUMNS_MAX = 16;
// names in the enum `reading`
constexpr uint8_t READINGS = 8;
// readings of a cell in a scan: those of its mode, in its order
constexpr uint8_t READINGS_PER_CELL = 4;
// readings of a cell that follow each other; a scan passes over all cells for each such group
constexpr uint8_t READINGS_PER_PASS = 2;
// bits of one code; codes are packed without gaps, least significant bit first
constexpr uint8_t ADC_BITS = 10;
// slowest scan rate
constexpr uint16_t RATE_MHZ_MIN = 1000;
// fastest scan rate that can be asked for; what fits depends on the number of cells
constexpr uint32_t RATE_MHZ_MAX = 2000000;
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

// which readings a scan takes of each cell, in scan order
enum class Mode : uint8_t {
    Near = 0,  // both near ends, under both drives
    Far = 1,  // both ends of row and column, under one drive; needs a second pair of multiplexers at the far ends
};

// what the firmware was built for
enum class Board : uint8_t {
    Uno = 1,  // Arduino Uno, ATmega328P
    Megaatmega2560 = 2,  // Arduino Mega 2560
    Emulated = 3,  // no hardware: the host's emulator
};

// where the settings in force at boot came from
enum class Settings : uint8_t {
    Stored = 0,  // read from EEPROM, CRC right
    DefaultsBlank = 1,  // EEPROM never written: defaults
    DefaultsDamaged = 2,  // EEPROM holds no sound record, or a scan that does not fit: defaults, but for a unit id that is sound
};

// ADC clock divisor: a conversion takes 13 ADC clocks at 16 MHz / divisor
enum class AdcPrescaler : uint8_t {
    Clock500khz = 32,  // 26 us a conversion, the default
    Clock250khz = 64,  // 52 us, less converter noise
    Clock125khz = 128,  // 104 us, the data sheet's full 10-bit accuracy
};

// answer to a command; anything but ok has changed nothing
enum class Result : uint8_t {
    Ok = 0,  // done
    UnknownCommand = 1,  // this firmware has no such command
    BadLength = 2,  // the payload has the wrong length
    BadRows = 3,  // rows outside 1..16
    BadColumns = 4,  // columns outside 1..16
    BadRate = 5,  // rate neither 0 nor within 1000..2000000 mHz
    BadSettle = 6,  // settle time above 3000 us
    BadPrescaler = 7,  // no such ADC prescaler
    BadBaud = 8,  // no such line speed
    TooFast = 9,  // the readings of a scan do not fit into its period: lower the rate, the settle time, the prescaler or the size
    LineTooSlow = 10,  // not one whole scan could be buffered at this line speed: lower the rate or raise the speed
    Scanning = 11,  // not while scanning: stop first
    Busy = 12,  // the same command is still being carried out
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

// Readings of each mode, in scan order.
constexpr Reading MODE_READINGS[][READINGS_PER_CELL] = {
    {Reading::A, Reading::B, Reading::C, Reading::D},
    {Reading::A, Reading::E, Reading::B, Reading::F},
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
};

// board to host: who the board is and how it scans: sent at boot and on request
struct __attribute__((packed)) Hello {
    uint16_t layout_crc;  // CRC-16 of this definition; always the first field
    uint8_t version_major;  // firmware version
    uint8_t version_minor;  // firmware version
    uint8_t version_patch;  // firmware version
    uint8_t board;  // hardware the firmware was built for
    uint32_t unit_id;  // name of this skin, set by the user; 0: none yet
    uint8_t rows;  // rows scanned
    uint8_t columns;  // columns scanned
    uint8_t readings_per_cell;  // readings of each cell
    uint8_t adc_bits;  // bits of one code
    uint32_t ref_top_ohm;  // [ohm] reference resistor of the row side
    uint32_t ref_bottom_ohm;  // [ohm] reference resistor of the column side
    uint32_t rate_asked_mhz;  // [mHz] rate asked for; 0: as fast as the converter runs
    uint32_t scan_cycles;  // [clock] clock cycles from one scan's start to the next: the rate that is kept
    uint16_t slot_cycles;  // [clock] clock cycles from one reading of a scan to the next; what is left of the scan after its last reading is idle
    uint32_t clock_hz;  // [Hz] clock of the board
    uint16_t settle_asked_us;  // [us] settle time asked for; 0: as long as the rate allows
    uint16_t settle_us;  // [us] time from a multiplexer change to the hold, at least
    uint8_t adc_prescaler;  // ADC clock divisor
    uint8_t mode;  // which readings a scan takes
    uint32_t baud;  // [baud] line speed in force
    uint8_t settings;  // where the settings at boot came from
    uint8_t reset_cause;  // why the board last started
    uint8_t scanning;  // 1 while scanning
};
static_assert(sizeof(Hello) == 49, "wire size");

// board to host: all readings of one scan. The codes follow the header: the mode's first two readings of each cell, cells in column-major order (rows run fastest), then its other two of each cell; adc_bits each, packed least significant bit first; 4 codes of 10 bits fill 5 bytes. The last byte is padded with zero bits.
struct __attribute__((packed)) Scan {
    uint32_t scan;  // number of the scan since start, dropped ones counted; wraps
    uint32_t time_us;  // [us] board time at which the scan started; wraps
    uint16_t dropped;  // scans made but not sent since start, because the line was full; wraps
    uint16_t rx_errors;  // damaged or overlong frames the board has received since boot; wraps
    uint8_t rows;  // rows of this scan
    uint8_t columns;  // columns of this scan
    uint8_t mode;  // which readings these are
    // followed by codes: rows * columns * readings_per_cell codes
};
static_assert(sizeof(Scan) == 15, "wire size");

// board to host: answer to one command; the only one, sent when the command has been carried out
struct __attribute__((packed)) Ack {
    uint8_t command;  // type of the command answered
    uint8_t command_sequence;  // sequence number of the command answered
    uint8_t result;  // ok, or why not
};
static_assert(sizeof(Ack) == 3, "wire size");

// board to host: what the sense nodes read over all multiplexer inputs; comes before the ack of self_test
struct __attribute__((packed)) SelfTestReport {
    uint16_t findings;  // what cannot be on a sound board
    uint16_t code_min[8];  // smallest code of each reading over all inputs; above code_max: not taken, as e to h in mode near
    uint16_t code_max[8];  // largest code of each reading over all inputs
};
static_assert(sizeof(SelfTestReport) == 34, "wire size");

// host to board: how to scan; all of it or nothing. Refused while scanning
struct __attribute__((packed)) Configure {
    uint8_t rows;  // rows to scan, 1..rows_max
    uint8_t columns;  // columns to scan, 1..columns_max
    uint32_t rate_mhz;  // [mHz] scans per 1000 s; 0: as fast as the converter runs
    uint16_t settle_us;  // [us] least settle time, which then also is kept; 0: as long as the rate allows
    uint8_t adc_prescaler;  // ADC clock divisor
    uint8_t mode;  // which readings a scan takes
};
static_assert(sizeof(Configure) == 10, "wire size");

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

}  // namespace frames
}  // namespace ohmskin
