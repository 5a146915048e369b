// SPDX-License-Identifier: Apache-2.0
#pragma once

// What runs at most once a scan: out of line, so that the frequent passes save no registers for it,
// and compiled for size.
#define OHMSKIN_RARE __attribute__((noinline, cold))

// What runs often but not every pass: out of line for the same reason.
#define OHMSKIN_APART __attribute__((noinline))
