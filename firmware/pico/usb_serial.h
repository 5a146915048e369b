// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// A serial port over USB (CDC-ACM, full speed), without interrupts: poll() does all, once a pass of
// the main loop. What nobody reads is thrown away, but for the first bytes after a start: they wait
// for the first program that opens the port.
namespace usb_serial {

void begin();
void poll(uint32_t now_us);
// Whether the next thing that poll() would find makes an interrupt.
void wake_at_news();
void wake_no_more();

bool can_write();
void write(uint8_t octet);
bool idle();  // everything written has left
bool has_byte();
uint8_t read();

}  // namespace usb_serial
