// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// Bytes that last, in the flash, one by one as in an EEPROM. They are a log: each write adds an
// entry of four bytes to a sector. When it is full, the bytes that count go to the other sector. A
// reset at any moment leaves each byte with its old value or the new one.
namespace flash_store {

// Addresses that there are. The settings' records need fewer (core/settings.cpp).
constexpr uint16_t SIZE = 128;

// Ends reading the flash as memory, for good: nothing runs from it.
void begin();
uint8_t read(uint16_t address);
// False when the next byte can be written. To be called until it is: it goes on with the work.
bool busy();
void write(uint16_t address, uint8_t octet);  // not while busy
// The flash chip's own number: eight bytes, for USB.
void read_unique_id(uint8_t *octets);

}  // namespace flash_store
