// SPDX-License-Identifier: Apache-2.0
#pragma once

// The numbers that a board says of itself. They are known when it compiles: divisions by CLOCK_HZ
// are shifts then, and codes are packed without loops.
//
//     CLOCK_HZ             the clock in which slots are counted
//     board::NAME          as PlatformIO calls it
//     board::ADC_BITS      bits of the converter's codes, an even number: 10, 12, 14
//     board::slot_min()    clock cycles of the shortest slot of an accuracy
//     board::held_cycles() clock cycles of a slot in which the node and the sample capacitor do not
//                          settle for the next reading: from a hold until both have joined it
//     board::BUSY_...      clock cycles of the processor, at most: for the interrupt of an idle
//                          slot; for a reading besides (taking and packing its code); and for a
//                          scan's header and end
//     board::RING_SIZE     bytes that wait for the line: a power of two
//     board::cycles_per_byte()   clock cycles in which the line carries a byte
#if defined(OHMSKIN_PICO)
#include "../pico/pico_numbers.h"
#else
#include "avr_numbers.h"
#endif
