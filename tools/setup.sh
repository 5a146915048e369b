#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Usage: tools/setup.sh host|all        (run by `make`, from the repository's root)
#
# host: .venv with the ohmskin package.
# all: also the tools of AVR and ARM, ngspice, Chromium and node (for tests) from apt, avr8js and
# rp2040js (simulators, for tests) and biome (for the page's JavaScript) from npm, and the development tools.
# Installs only what is missing, and says what. Python packages are those files that were tested, by their
# hashes, and no package is built but this one: tools/pins.
set -euo pipefail

APT_PACKAGES=(gcc-avr binutils-avr avr-libc arduino-core-avr avrdude cppcheck
              gcc-arm-none-eabi libnewlib-arm-none-eabi
              simavr libsimavr-dev libelf-dev gcc g++ make ngspice)

fail() {
    printf 'setup: %s\n' "$@" >&2
    exit 1
}

apt_install() { # package...
    local package as_root=() missing=()
    command -v apt-get >/dev/null ||
        fail "this is not Debian or Ubuntu: install the equivalents of these packages: $*" \
             "then, if they are there, run 'make OHMSKIN_SKIP_APT=1 ...'"
    for package in "$@"; do
        [[ $(dpkg-query -W -f '${db:Status-Abbrev}' "$package" 2>/dev/null) == ii* ]] ||
            missing+=("$package")
    done
    ((${#missing[@]})) || return 0

    if ((EUID != 0)); then
        command -v sudo >/dev/null ||
            fail "these packages are missing, and there is no sudo to install them. As root, run:" \
                 "apt-get install --no-install-recommends ${missing[*]}"
        as_root=(sudo)
    fi
    echo "setup: installing with apt: ${missing[*]}"
    "${as_root[@]}" apt-get update
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y --no-install-recommends "${missing[@]}"
}

is_new_enough() { # python
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

find_python() {
    local candidate
    if [[ -n ${PYTHON:-} ]]; then
        is_new_enough "$PYTHON" || fail "PYTHON=$PYTHON is not a Python 3.11 or newer"
        echo "$PYTHON"
        return
    fi
    for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
        if is_new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    fail "needs Python 3.11 or newer, found $(python3 --version 2>&1 || true)." \
         "Install one (Ubuntu 22.04: apt install python3.11 python3.11-venv)," \
         "or name one: make PYTHON=/path/to/python3 ..."
}

make_venv() {
    local python
    .venv/bin/python -m pip --version >/dev/null 2>&1 && return
    command -v python3 >/dev/null || [[ -n ${PYTHON:-} ]] || apt_install python3 python3-venv
    python=$(find_python)
    "$python" -c 'import ensurepip' 2>/dev/null ||
        apt_install "$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
    echo "setup: making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv
}

pip_install() { # pins
    echo "setup: installing $1 and this package into .venv"
    # To build a package would take the newest of what its build asks for, without hashes.
    PIP_ONLY_BINARY=${PIP_ONLY_BINARY-:all:} .venv/bin/python -m pip install --quiet \
        --disable-pip-version-check --require-hashes --requirement "$1"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check \
        --no-deps --no-build-isolation --editable .
}

npm_install() { # folder, what it is, what is skipped without it
    [[ $1/node_modules/.package-lock.json -nt $1/package-lock.json ]] && return
    if command -v npm >/dev/null; then
        echo "setup: installing $2 into $1/node_modules"
        npm ci --prefix "$1" --ignore-scripts --no-audit --no-fund --fetch-retries=1 \
            --loglevel=error && return
    fi
    echo "setup: without npm and its registry, $3"
}

case ${1:-} in
host)
    make_venv
    pip_install tools/pins/host.txt
    touch .venv/.stamp-host
    ;;
all)
    if [[ -z ${OHMSKIN_SKIP_APT:-} ]]; then
        apt_install "${APT_PACKAGES[@]}"
        apt_install chromium fonts-dejavu-core ||
            echo "setup: without Chromium (Ubuntu has a snap alone) tests of the page are skipped"
        command -v npm >/dev/null || apt_install nodejs npm || true
    fi
    npm_install firmware/second_sim "avr8js and rp2040js" "tests in the second simulator, and of the Pico, are skipped"
    npm_install tools/page_lint biome "the page's JavaScript is not linted"
    make_venv
    pip_install tools/pins/all.txt
    touch .venv/.stamp-host .venv/.stamp
    ;;
*)
    fail "usage: tools/setup.sh host|all"
    ;;
esac
