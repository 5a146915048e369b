# SPDX-License-Identifier: Apache-2.0
# PlatformIO runs this before it builds for a board. Register r2 is the boot loader's (see
# src/core/reset_cause.h), so the compiler must not use it. The linker generates code too, and
# build_flags do not reach it.
Import("env")  # noqa: F821
env.Append(CCFLAGS=["-ffixed-r2"], LINKFLAGS=["-ffixed-r2"])  # noqa: F821
