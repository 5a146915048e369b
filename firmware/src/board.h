// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/scan_plan.h"
#include "core/scanner.h"

// The whole hardware contract: what a board has to offer, beside the numbers in board_numbers.h.
// board_avr.cpp implements it for the Uno and the Mega 2560, firmware/pico for an RP2040,
// board_arduino.cpp for what has Arduino's calls, firmware/test/fake_board.h for the unit tests.
// Nothing here blocks.
namespace ohmskin {
namespace board {

// ---- what it is
extern const uint16_t WIRING;  // hello.wiring
extern const uint32_t REF_TOP_OHM;
extern const uint32_t REF_BOTTOM_OHM;
// What A and B read where a cell is a short: REF_BOTTOM_OHM's share of both, in codes.
extern const uint16_t SHORT_CODE;

// Pins, converter, serial line at the default speed, clock and watchdog.
void begin();
// Bits of frames::ResetCause.
uint8_t reset_cause();
// Once a pass of the main loop: keeps now_us() counting, which needs it every millisecond, and the
// watchdog quiet, which restarts the board after 250 ms without (500 ms with interrupts off).
void keep_alive();
uint32_t now_us();  // since begin(); wraps
// Tells an observer whether a pass of the main loop found something to do; costs one instruction.
void mark_pass(bool worked);

// ---- scan
// The board's slot interrupt calls scanner.step() once a slot (see core/scanner.h) from
// start_slots() to stop_slots(), puts pins and multiplexers where it says, and gives slots
// the length that it says.
extern Scanner scanner;
// How many slots have the new length before the first reading of a scan whose slots are of another
// one: 2 where the slot at hand takes it, 1 where the next one does.
extern const uint8_t SLOTS_OF_NEW_LENGTH;
// Settle time [us] of the self-test's scans; a test need not be fast. 50 or more: the largest node
// that the firmware reckons with, 244 pF at 30 kOhm (docs/timing.md, "Mode far"), has a time
// constant of 7.3 us, and is off by a code after 50 us.
extern const uint16_t SELF_TEST_SETTLE_US;
void start_slots(uint16_t slot_cycles, uint8_t accuracy);
void stop_slots();

// ---- serial line
bool serial_speed_known(uint32_t baud);
void serial_speed(uint32_t baud);
bool serial_can_write();
void serial_write(uint8_t octet);
bool serial_idle();  // everything written has left
bool serial_has_byte();
bool serial_read(uint8_t *octet);  // false: the line failed (framing error, overrun)

// ---- EEPROM
uint8_t eeprom_read(uint16_t address);
bool eeprom_busy();
void eeprom_write(uint16_t address, uint8_t octet);  // not while busy; takes milliseconds

}  // namespace board
}  // namespace ohmskin
