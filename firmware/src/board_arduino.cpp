// SPDX-License-Identifier: Apache-2.0
// The board contract by Arduino's own calls, for whatever board has them. It is slow: analogRead()
// takes 112 us on an Uno, where the registers' way takes none of the processor's time. Slots are
// made in passes of the main loop; one that comes late is left out with its scan, and counted, so
// that what comes is stamped right. docs/other-boards.md says what each board can do.
#include <Arduino.h>

#include "board.h"
#include "wiring.h"
#if defined(E2END)
#include <EEPROM.h>
#else  // boards without one: `save` answers eeprom_failed
struct {
    uint8_t read(int) { return 0xFF; }
    void write(int, uint8_t) {}
} EEPROM;
#endif

namespace ohmskin {
namespace board {

const uint16_t WIRING = wiring::CRC, SHORT_CODE = wiring::SHORT_CODE;
const uint32_t REF_TOP_OHM = wiring::REF_TOP_OHM, REF_BOTTOM_OHM = wiring::REF_BOTTOM_OHM;
Scanner scanner;
const uint8_t SLOTS_OF_NEW_LENGTH = 2;
// An Uno takes 230 us for a reading by these calls. Scans that it cannot keep up with would lose
// readings, and the self-test could judge none of them.
const uint16_t SELF_TEST_SETTLE_US = 230;

namespace {
// A slot may come so late [us], and its scan still counts. Chosen: what stamps may be off.
constexpr uint16_t LATE_US = 1000;
// From the pins' change to the conversion [us], at the least. Chosen as SETTLE_US of scan_plan.h.
constexpr uint16_t SETTLE_US = 20;
// Bytes for the line in a pass of the main loop. Chosen: a scan brings 1.3 a slot.
constexpr uint8_t BYTES_A_PASS = 2;
// Pins of the analog inputs, from input 0 on. No more than are in use by default: not each board
// has more, and an ESP32 has no A1 and no A2.
#ifndef OHMSKIN_ANALOG_PINS
#define OHMSKIN_ANALOG_PINS A0, A1, A2, A3
#endif
constexpr uint8_t ANALOG_PINS[] = {OHMSKIN_ANALOG_PINS};
constexpr bool inputs_exist(uint8_t count) {
    return count == 0 ||
           (wiring::SENSE_INPUTS[count - 1] < sizeof ANALOG_PINS && inputs_exist(count - 1));
}
static_assert(inputs_exist(4), "OHMSKIN_SENSE_INPUTS: OHMSKIN_ANALOG_PINS has no such input");
constexpr bool none_drives(uint8_t count) {
    return count == 0 || (wiring::count(wiring::PINS, wiring::PIN_COUNT,
                                        ANALOG_PINS[wiring::SENSE_INPUTS[count - 1]]) == 0 &&
                          none_drives(count - 1));
}
static_assert(none_drives(4), "a pin drives and senses");

bool slots_run, converted_before, pins_are_set;  // the last: for the slot at hand
uint16_t slot_cycles, code_before;
uint32_t due_us, selected_us;  // when the slot at hand is due, and when its pins were set
UsRest due_rest;               // parts of a microsecond beyond due_us
Selection selected;
uint8_t bytes_left;

void write_number(const uint8_t *pins, uint8_t number, uint8_t changed) {
    for (uint8_t i = 0; i < 4; i++)
        if (changed >> i & 1)
            digitalWrite(pins[i], number >> i & 1);
}

ReadingDefinition reading_at(uint8_t entry) {
    return READING_DEFINITIONS[static_cast<uint8_t>(
        reading_of(entry / frames::READINGS_MAX, entry % frames::READINGS_MAX))];
}

// Sets what has changed, or all: digitalWrite() takes microseconds.
void select(const Selection &next, bool all) {
    write_number(wiring::ROW_PINS, next.row, all ? 15 : next.row ^ selected.row);
    write_number(wiring::COLUMN_PINS, next.column, all ? 15 : next.column ^ selected.column);
    const Drive drive = reading_at(next.pattern_entry).drive;
    if (all || drive != reading_at(selected.pattern_entry).drive) {
        digitalWrite(wiring::DRIVE_TOP_PIN, drive == Drive::Top);
        digitalWrite(wiring::DRIVE_BOTTOM_PIN, drive == Drive::Bottom);
    }
    selected = next;
    selected_us = micros();
}

// The end of a slot: of one that was made, with its code, or of one that is left out.
void end_slot(uint16_t code, bool made) {
    if (scanner.step(code_before, converted_before))
        slot_cycles = scanner.slot_cycles();
    code_before = code;
    converted_before = made && pins_are_set;
    pins_are_set = made;
    due_us += us_of(slot_cycles, &due_rest);
}

void make_slot() {
    const uint8_t input = wiring::SENSE_INPUTS[uint8_t(reading_at(selected.pattern_entry).sense)];
    const uint16_t code = static_cast<uint16_t>(analogRead(ANALOG_PINS[input]));
    select(scanner.selection(), false);
    end_slot(code, true);
}
}  // namespace

void begin() {
    for (uint8_t pin : wiring::PINS)
        pinMode(pin, OUTPUT);
#if !defined(__AVR__)
    analogReadResolution(ADC_BITS);
#endif
    serial_speed(frames::BAUD_DEFAULT);
}
uint8_t reset_cause() { return 0; }  // Arduino has no call that says so
void keep_alive() {
    bytes_left = BYTES_A_PASS;
    const int32_t late_us = slots_run ? static_cast<int32_t>(micros() - due_us) : -1;
    if (late_us > LATE_US)  // leaves slots out, which takes little time
        while (static_cast<int32_t>(micros() - due_us) > 0)
            end_slot(0, false);
    else if (late_us >= 0 && micros() - selected_us >= SETTLE_US)
        make_slot();
}
uint32_t now_us() { return micros(); }
void mark_pass(bool) {}

void start_slots(uint16_t cycles, uint8_t) {
    slot_cycles = cycles;
    select(scanner.selection(), true);
    pins_are_set = true;
    converted_before = false;
    due_us = micros();
    slots_run = true;
}
void stop_slots() {
    slots_run = false;
    digitalWrite(wiring::DRIVE_TOP_PIN, LOW);
    digitalWrite(wiring::DRIVE_BOTTOM_PIN, LOW);
}

bool serial_speed_known(uint32_t baud) {
    return baud == frames::BAUD_DEFAULT || baud == frames::BAUD_FAST;
}
void serial_speed(uint32_t baud) { Serial.begin(baud); }
// A few bytes a pass: more would make a slot late.
bool serial_can_write() { return bytes_left != 0 && Serial.availableForWrite() > 0; }
void serial_write(uint8_t octet) {
    bytes_left--;
    Serial.write(octet);
}
bool serial_idle() {
    Serial.flush();
    return true;
}
bool serial_has_byte() { return Serial.available() > 0; }
bool serial_read(uint8_t *octet) {
    *octet = static_cast<uint8_t>(Serial.read());
    return true;
}

uint8_t eeprom_read(uint16_t address) { return EEPROM.read(address); }
void eeprom_write(uint16_t address, uint8_t octet) { EEPROM.write(address, octet); }
// A write takes milliseconds, for which the next one would wait, and slots with it. Other boards
// have no such register.
bool eeprom_busy() {
#if defined(EECR) && defined(EEPE)
    return EECR & _BV(EEPE);
#else
    return false;
#endif
}

}  // namespace board
}  // namespace ohmskin
