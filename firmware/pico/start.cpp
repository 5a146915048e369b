// SPDX-License-Identifier: Apache-2.0
// What boot2 starts: the vector table, memory, and the main loop.
#include <stdint.h>

#include "board.h"
#include "core/device.h"

static ohmskin::Device device;

void ohmskin::keep_pace() { device.keep_pace(); }

extern "C" {

extern uint32_t bss_start[], bss_end[], stack_top[];
extern void (*first_constructor[])();
extern void (*last_constructor[])();
void slot_interrupt();
void wake_interrupt();

void start() {
    for (uint32_t *word = bss_start; word != bss_end; word++)
        *word = 0;
    for (void (**constructor)() = first_constructor; constructor != last_constructor; constructor++)
        (*constructor)();
    ohmskin::board::begin();
    device.begin();
    for (;;)
        ohmskin::board::mark_pass(device.poll());
}

// A fault, or an interrupt that nobody has asked for: the watchdog restarts the board.
void hang() {
    for (;;) {
    }
}

using Vector = void (*)();
__attribute__((section(".vectors"), used)) const Vector VECTORS[16 + 6] = {
    reinterpret_cast<Vector>(stack_top),
    start,
    hang,  // NMI
    hang,  // hard fault
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    hang,
    wake_interrupt,  // interrupt 0: alarm 0 of the timer
    hang,
    hang,
    hang,
    slot_interrupt,  // 4: a slice of the PWM has wrapped
    wake_interrupt,  // 5: USB
};

}  // extern "C"
