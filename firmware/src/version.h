// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

namespace ohmskin {

constexpr uint8_t VERSION_MAJOR = 0;
constexpr uint8_t VERSION_MINOR = 1;
constexpr uint8_t VERSION_PATCH = 0;

}  // namespace ohmskin
