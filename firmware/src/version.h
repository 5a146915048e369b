// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

namespace ohmskin {

// The package's version (host/ohmskin/version.py): firmware/version.py defines the macros.
constexpr uint8_t VERSION_MAJOR = OHMSKIN_VERSION_MAJOR;
constexpr uint8_t VERSION_MINOR = OHMSKIN_VERSION_MINOR;
constexpr uint8_t VERSION_PATCH = OHMSKIN_VERSION_PATCH;

}  // namespace ohmskin
