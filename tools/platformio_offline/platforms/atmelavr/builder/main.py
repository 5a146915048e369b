# SPDX-License-Identifier: Apache-2.0
"""Builds, measures and uploads a program for an AVR with Debian's avr-gcc and avrdude."""

from SCons.Script import COMMAND_LINE_TARGETS, AlwaysBuild, Builder, Default, DefaultEnvironment

env = DefaultEnvironment()
env.Replace(
    AR="avr-gcc-ar",
    AS="avr-as",
    CC="avr-gcc",
    CXX="avr-g++",
    OBJCOPY="avr-objcopy",
    RANLIB="avr-gcc-ranlib",
    SIZETOOL="avr-size",
    PROGNAME="firmware",
    PROGSUFFIX=".elf",
    SIZECHECKCMD="$SIZETOOL -A -d $SOURCES",
    SIZEPROGREGEXP=r"^(?:\.text|\.data|\.bootloader)\s+(\d+).*",
    SIZEDATAREGEXP=r"^(?:\.data|\.bss|\.noinit)\s+(\d+).*",
    UPLOADER="avrdude",
    UPLOADERFLAGS=["-p", "$BOARD_MCU", "-c", "$UPLOAD_PROTOCOL", "-b", "$UPLOAD_SPEED", "-D"],
)
env.Append(
    BUILDERS={
        "ElfToHex": Builder(
            action=env.VerboseAction(
                "$OBJCOPY -O ihex -R .eeprom $SOURCES $TARGET", "Building $TARGET"
            ),
            suffix=".hex",
        )
    }
)

if "nobuild" in COMMAND_LINE_TARGETS:
    firmware = env.File("$BUILD_DIR/${PROGNAME}.hex")
else:
    firmware = env.ElfToHex("$BUILD_DIR/${PROGNAME}", env.BuildProgram())
    env.Depends(firmware, "checkprogsize")
AlwaysBuild(env.Alias("nobuild", firmware))

actions = [env.VerboseAction("$UPLOADCMD", "Uploading $SOURCE")]
if env.subst("$UPLOAD_PROTOCOL") != "custom":
    env.Replace(UPLOADCMD='$UPLOADER $UPLOADERFLAGS -P "$UPLOAD_PORT" -U flash:w:$SOURCES:i')
    actions.insert(0, env.VerboseAction(env.AutodetectUploadPort, "Looking for upload port..."))
AlwaysBuild(env.Alias("upload", firmware, actions))

Default(firmware)
