// SPDX-License-Identifier: Apache-2.0
#include "fake_board.h"

namespace fake {
State state;
}

namespace ohmskin {

void keep_pace() {}

namespace board {

using fake::state;

const uint16_t WIRING = 0x1234;
const uint32_t REF_TOP_OHM = 2200;
const uint32_t REF_BOTTOM_OHM = 4700;
const uint16_t SHORT_CODE = 696;
Scanner scanner;
const uint8_t SLOTS_OF_NEW_LENGTH = 2;
const uint16_t SELF_TEST_SETTLE_US = 50;

void begin() {}
uint8_t reset_cause() { return static_cast<uint8_t>(frames::ResetCause::External); }
void keep_alive() {}
uint32_t now_us() { return state.now_us; }
void mark_pass(bool) {}

void start_slots(uint16_t slot_cycles, uint8_t) {
    state.slot_cycles = slot_cycles;
    state.slots_running = true;
}
void stop_slots() { state.slots_running = false; }

bool serial_speed_known(uint32_t baud) {
    return baud == frames::BAUD_DEFAULT || baud == frames::BAUD_FAST;
}
void serial_speed(uint32_t baud) { state.baud = baud; }
bool serial_can_write() { return !state.line_stuck && state.sent_size < sizeof state.sent; }
void serial_write(uint8_t octet) { state.sent[state.sent_size++] = octet; }
bool serial_idle() { return true; }
bool serial_has_byte() { return state.received_at != state.received_size; }
bool serial_read(uint8_t *octet) {
    *octet = state.received[state.received_at++];
    const bool sound = !state.damage_next;
    state.damage_next = false;
    return sound;
}

uint8_t eeprom_read(uint16_t address) { return state.eeprom[address]; }
bool eeprom_busy() { return state.eeprom_busy_polls && state.eeprom_busy_polls--; }
void eeprom_write(uint16_t address, uint8_t octet) {
    state.eeprom_busy_polls = 3;
    state.eeprom_wear[address]++;
    if (state.eeprom_cut_at != 0 && --state.eeprom_cut_at == 0) {
        state.eeprom[address] = state.eeprom_torn(state.eeprom[address], octet);
        state.eeprom_worn_out = true;
    }
    if (!state.eeprom_worn_out)
        state.eeprom[address] = octet;
}

}  // namespace board
}  // namespace ohmskin
