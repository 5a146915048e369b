// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "board_numbers.h"
#include "core/scan_sequence.h"

// The one table of what is connected where: by Arduino's numbers of pins (D4 is 4; on an RP2040,
// GP4 is 4) and of analog inputs (A0 is 0). The defaults are those of docs/build.md. A board that
// is wired otherwise is told by build_flags in platformio.ini (docs/wiring.md), any of these:
//
//     -DOHMSKIN_ROW_PINS=4,5,6,7       S0 to S3 of the row multiplexers
//     -DOHMSKIN_COLUMN_PINS=8,9,10,11  S0 to S3 of the column multiplexers
//     -DOHMSKIN_DRIVE_TOP_PIN=2        the reference resistor of the rows' common pin
//     -DOHMSKIN_DRIVE_BOTTOM_PIN=3     the reference resistor of the columns' common pin
//     -DOHMSKIN_SENSE_INPUTS=0,1,2,3   top, bottom; far ends of rows, of columns
//     -DOHMSKIN_REF_TOP_OHM=30000      the reference resistors
//     -DOHMSKIN_REF_BOTTOM_OHM=30000
//
// Multiplexers of 32 channels, such as the ADG732, on a Mega: five pins each, A0 to A4, and
//
//     -DOHMSKIN_ROWS_MAX=32 -DOHMSKIN_COLUMNS_MAX=32
//
// What cannot be, such as a pin that is used twice, does not compile.

#if defined(OHMSKIN_ROW_PINS) || defined(OHMSKIN_COLUMN_PINS) || defined(OHMSKIN_DRIVE_TOP_PIN) || \
    defined(OHMSKIN_DRIVE_BOTTOM_PIN) || defined(OHMSKIN_SENSE_INPUTS)
#define OHMSKIN_OWN_PINS 1
#else
#define OHMSKIN_OWN_PINS 0
#endif

#if defined(__AVR_ATmega2560__)
#define OHMSKIN_DEFAULTS(what) OHMSKIN_MEGA_##what
#elif defined(__arm__) && defined(OHMSKIN_PICO)
#define OHMSKIN_DEFAULTS(what) OHMSKIN_PICO_##what
#else
#define OHMSKIN_DEFAULTS(what) OHMSKIN_UNO_##what
#endif
#define OHMSKIN_UNO_ROWS 4, 5, 6, 7
#define OHMSKIN_UNO_COLUMNS 8, 9, 10, 11
#define OHMSKIN_UNO_TOP 2
#define OHMSKIN_UNO_BOTTOM 3
#define OHMSKIN_MEGA_ROWS 22, 23, 24, 25
#define OHMSKIN_MEGA_COLUMNS 37, 36, 35, 34
#define OHMSKIN_MEGA_TOP 49
#define OHMSKIN_MEGA_BOTTOM 48
#define OHMSKIN_PICO_ROWS 2, 3, 4, 5
#define OHMSKIN_PICO_COLUMNS 6, 7, 8, 9
#define OHMSKIN_PICO_TOP 10
#define OHMSKIN_PICO_BOTTOM 11

#ifndef OHMSKIN_ROW_PINS
#define OHMSKIN_ROW_PINS OHMSKIN_DEFAULTS(ROWS)
#endif
#ifndef OHMSKIN_COLUMN_PINS
#define OHMSKIN_COLUMN_PINS OHMSKIN_DEFAULTS(COLUMNS)
#endif
#ifndef OHMSKIN_DRIVE_TOP_PIN
#define OHMSKIN_DRIVE_TOP_PIN OHMSKIN_DEFAULTS(TOP)
#endif
#ifndef OHMSKIN_DRIVE_BOTTOM_PIN
#define OHMSKIN_DRIVE_BOTTOM_PIN OHMSKIN_DEFAULTS(BOTTOM)
#endif
#ifndef OHMSKIN_SENSE_INPUTS
#define OHMSKIN_SENSE_INPUTS 0, 1, 2, 3
#endif
// 30 kOhm: docs/build.md says why. The host computes with what `hello` says.
#ifndef OHMSKIN_REF_TOP_OHM
#define OHMSKIN_REF_TOP_OHM 30000
#endif
#ifndef OHMSKIN_REF_BOTTOM_OHM
#define OHMSKIN_REF_BOTTOM_OHM 30000
#endif

namespace ohmskin {
namespace wiring {

constexpr uint8_t ROW_PINS[] = {OHMSKIN_ROW_PINS};
constexpr uint8_t COLUMN_PINS[] = {OHMSKIN_COLUMN_PINS};
constexpr uint8_t DRIVE_TOP_PIN = OHMSKIN_DRIVE_TOP_PIN;
constexpr uint8_t DRIVE_BOTTOM_PIN = OHMSKIN_DRIVE_BOTTOM_PIN;
constexpr uint8_t SENSE_INPUTS[] = {OHMSKIN_SENSE_INPUTS};  // by Sense
constexpr uint32_t REF_TOP_OHM = OHMSKIN_REF_TOP_OHM;
constexpr uint32_t REF_BOTTOM_OHM = OHMSKIN_REF_BOTTOM_OHM;

// Pins that select a row, and as many that select a column.
constexpr uint8_t ADDRESS_PINS = OHMSKIN_LINES_MAX > 16 ? 5 : 4;
#if OHMSKIN_LINES_MAX > 16
#if !defined(__AVR_ATmega2560__)
#error "OHMSKIN_ROWS_MAX, OHMSKIN_COLUMNS_MAX: more than 16 lines want a Mega"
#endif
static_assert(sizeof ROW_PINS == 5, "OHMSKIN_ROW_PINS: five pins for more than 16 lines, A0 to A4");
static_assert(sizeof COLUMN_PINS == 5,
              "OHMSKIN_COLUMN_PINS: five pins for more than 16 lines, A0 to A4");
#else
static_assert(sizeof ROW_PINS == 4, "OHMSKIN_ROW_PINS: four pins, S0 to S3");
static_assert(sizeof COLUMN_PINS == 4, "OHMSKIN_COLUMN_PINS: four pins, S0 to S3");
#endif
static_assert(sizeof SENSE_INPUTS == 4, "OHMSKIN_SENSE_INPUTS: four inputs, the last two far");
static_assert(REF_TOP_OHM >= 100 && REF_TOP_OHM <= 10000000 && REF_BOTTOM_OHM >= 100 &&
                  REF_BOTTOM_OHM <= 10000000,
              "OHMSKIN_REF_TOP_OHM, OHMSKIN_REF_BOTTOM_OHM: in ohms, 30000 for 30 kOhm");

constexpr uint16_t SHORT_CODE = static_cast<uint16_t>(
    ((uint64_t{1} << board::ADC_BITS) - 1) * REF_BOTTOM_OHM / (REF_TOP_OHM + REF_BOTTOM_OHM));

// All digital pins, in one row.
constexpr uint8_t PINS[] = {OHMSKIN_ROW_PINS, OHMSKIN_COLUMN_PINS, OHMSKIN_DRIVE_TOP_PIN,
                            OHMSKIN_DRIVE_BOTTOM_PIN};
constexpr uint8_t PIN_COUNT = sizeof PINS;

// CRC-16/IBM-3740 of a list, after `crc`: what `hello` says of the wiring.
constexpr uint16_t crc_of_bits(uint16_t crc, uint8_t bits) {
    return bits == 0 ? crc
                     : crc_of_bits(static_cast<uint16_t>(crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0)),
                                   bits - 1);
}
constexpr uint16_t crc_of(const uint8_t *list, uint8_t size, uint16_t crc) {
    return size == 0 ? crc
                     : crc_of(list + 1, size - 1,
                              crc_of_bits(static_cast<uint16_t>(crc ^ list[0] << 8), 8));
}
// Of the pins above, in that order; 0: those of docs/build.md.
constexpr uint16_t CRC =
    OHMSKIN_OWN_PINS ? crc_of(SENSE_INPUTS, 4, crc_of(PINS, PIN_COUNT, 0xFFFF)) : 0;

#if defined(__AVR__)
// The same for simulators, which read it in the ELF file; it takes no memory of the board. (The
// section's name brings flags of its own, and the semicolon makes those of the compiler a comment:
// it would put the table into the flash.)
struct Table {
    uint8_t pins[PIN_COUNT], sense_inputs[4];
    uint32_t ref_ohm[2];
};
__attribute__((used, section(".ohmskin.wiring,\"\",@progbits;"))) const Table TABLE = {
    {OHMSKIN_ROW_PINS, OHMSKIN_COLUMN_PINS, OHMSKIN_DRIVE_TOP_PIN, OHMSKIN_DRIVE_BOTTOM_PIN},
    {OHMSKIN_SENSE_INPUTS},
    {REF_TOP_OHM, REF_BOTTOM_OHM}};
#endif

// How often a number is in a list.
constexpr uint8_t count(const uint8_t *list, uint8_t size, uint8_t number) {
    return size == 0
               ? 0
               : static_cast<uint8_t>((list[0] == number) + count(list + 1, size - 1, number));
}
// Whether each number of a list is there once, from its n-th on.
constexpr bool distinct(const uint8_t *list, uint8_t size, uint8_t n = 0) {
    return n == size || (count(list, size, list[n]) == 1 && distinct(list, size, n + 1));
}
static_assert(distinct(PINS, PIN_COUNT), "a pin is used twice: rows, columns, drive");
static_assert(distinct(SENSE_INPUTS, 4), "OHMSKIN_SENSE_INPUTS: an input is used twice");

}  // namespace wiring
}  // namespace ohmskin
