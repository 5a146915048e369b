# SPDX-License-Identifier: Apache-2.0
"""Builds Debian's Arduino core with the compiler flags of PlatformIO's own AVR platform."""

from pathlib import Path

from SCons.Script import DefaultEnvironment

env = DefaultEnvironment()
board = env.BoardConfig()
package = Path(env.PioPlatform().get_package_dir("framework-arduino-avr"))
core = package / "cores" / board.get("build.core")

optimise = ["-Os", "-flto", "-mmcu=$BOARD_MCU"]
env.Append(
    CFLAGS=["-std=gnu11", "-fno-fat-lto-objects"],
    CCFLAGS=[*optimise, "-Wall", "-ffunction-sections", "-fdata-sections"],
    CXXFLAGS=["-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-fpermissive"],
    ASFLAGS=["-x", "assembler-with-cpp", *optimise],
    LINKFLAGS=[*optimise, "-fuse-linker-plugin", "-Wl,--gc-sections"],
    LIBS=["m"],
    CPPPATH=[str(core), str(package / "variants" / board.get("build.variant"))],
    LIBSOURCE_DIRS=[str(package / "libraries")],
    CPPDEFINES=[
        ("F_CPU", "$BOARD_F_CPU"),
        ("ARDUINO", 10808),
        "ARDUINO_ARCH_AVR",
        # float.h of avr-gcc 5.4 hides DECIMAL_DIG from C++; the core's WString.cpp needs it.
        ("DECIMAL_DIG", "__DECIMAL_DIG__"),
    ],
)
env.Prepend(LIBS=[env.BuildLibrary("$BUILD_DIR/FrameworkArduino", str(core))])
