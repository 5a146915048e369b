// SPDX-License-Identifier: Apache-2.0
#include <Arduino.h>

#include "board.h"
#include "core/device.h"

static ohmskin::Device device;

void setup() {
    ohmskin::board::begin();
    device.begin();
}

void loop() { ohmskin::board::mark_pass(device.poll()); }
