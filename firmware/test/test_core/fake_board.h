// SPDX-License-Identifier: Apache-2.0
// A board for unit tests: time, line and EEPROM under the test's control, and a skin whose code
// says where it was read.
#pragma once
#include <stdint.h>
#include <string.h>

#include "board.h"

namespace fake {

struct State {
    uint32_t now_us;
    bool slots_running;
    uint16_t slot_cycles;
    uint8_t eeprom[96];
    uint16_t eeprom_wear[96];  // writes of each byte
    int eeprom_busy_polls;     // polls until a write is finished
    bool eeprom_worn_out;      // writes change nothing
    int eeprom_cut_at;         // this write is cut short, and all after it fail; 0: none
    uint8_t (*eeprom_torn)(uint8_t before, uint8_t wanted);  // what a write cut short leaves
    uint8_t received[64];                                    // bytes on their way to the board
    uint8_t received_size, received_at;
    bool damage_next;  // the line reports an error with the next byte
    uint32_t baud;
    // What the board has written, oldest first.
    uint8_t sent[2000];
    uint16_t sent_size;
    bool line_stuck;  // the line takes nothing
};
extern State state;

inline void reset() {
    memset(&state, 0, sizeof state);
    memset(state.eeprom, 0xFF, sizeof state.eeprom);
}

inline void receive(const uint8_t *octets, uint8_t size) {
    state.received_at = 0;
    state.received_size = size;
    memcpy(state.received, octets, size);
}

}  // namespace fake
