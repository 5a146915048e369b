// SPDX-License-Identifier: Apache-2.0
#include <Arduino.h>

#include "board.h"
#include "core/device.h"

static ohmskin::Device device;

void ohmskin::keep_pace() { device.keep_pace(); }

void setup() {
    ohmskin::board::begin();
    device.begin();
}

// Never returns: what the Arduino core does between two calls would only cost time.
void loop() {
    for (;;)
        ohmskin::board::mark_pass(device.poll());
}
