# SPDX-License-Identifier: Apache-2.0
"""Boards that are wired otherwise: their firmware, and the same wiring for the simulators."""

import binascii
import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from places import ROOT

# Debian's arduino-core-avr: which port and bit a pin is. The firmware has a table of its own.
VARIANTS = Path("/usr/share/arduino/hardware/arduino/avr/variants")
VARIANT = {"uno": "standard", "megaatmega2560": "mega"}


@dataclass(frozen=True)
class PinMap:
    """A wiring by Arduino's numbers; sense: analog inputs, top, bottom, far of rows, of columns."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]
    drive: tuple[int, int]
    sense: tuple[int, ...]
    ref_ohm: tuple[int, int] = (30_000, 30_000)

    def __str__(self) -> str:
        rows, columns, drive, sense = (
            ",".join(map(str, pins)) for pins in (self.rows, self.columns, self.drive, self.sense)
        )
        sense = "A" + sense.replace(",", ",A")
        return f"rows {rows}; columns {columns}; drive {drive}; sense {sense}"

    @property
    def lines(self) -> int:
        """How many rows, and columns, its multiplexers can have."""
        return 1 << len(self.rows)

    @property
    def flags(self) -> str:
        """What platformio.ini's build_flags are told."""
        lists = {"ROW_PINS": self.rows, "COLUMN_PINS": self.columns, "SENSE_INPUTS": self.sense}
        numbers = {
            "DRIVE_TOP_PIN": self.drive[0],
            "DRIVE_BOTTOM_PIN": self.drive[1],
            "REF_TOP_OHM": self.ref_ohm[0],
            "REF_BOTTOM_OHM": self.ref_ohm[1],
        }
        if self.lines > 16:
            numbers |= {"ROWS_MAX": self.lines, "COLUMNS_MAX": self.lines}
        said = {name: ",".join(map(str, pins)) for name, pins in lists.items()} | numbers
        return " ".join(f"-DOHMSKIN_{name}={value}" for name, value in said.items())

    @property
    def crc(self) -> int:
        """What `hello` says of it: binascii's CRC of its pins, in the order of wiring.h."""
        return binascii.crc_hqx(bytes(self.numbers), 0xFFFF)

    @property
    def numbers(self) -> tuple[int, ...]:
        """All of it, in the order of wiring.h."""
        return *self.rows, *self.columns, *self.drive, *self.sense

    def pins(self, board: str) -> str:
        """The option --pins of both simulators."""
        return pins_option(board, self.numbers)


# docs/build.md.
DEFAULT = {
    "uno": PinMap((4, 5, 6, 7), (8, 9, 10, 11), (2, 3), (0, 1, 2, 3)),
    "megaatmega2560": PinMap((22, 23, 24, 25), (37, 36, 35, 34), (49, 48), (0, 1, 2, 3)),
}

# Three for each board: all ports that it has, among the sense pins too; blocks in other places; the
# lamp's pin, and analog inputs as outputs.
MAPS = {
    "uno": (
        PinMap((16, 7, 12, 2), (8, 3, 10, 11), (5, 19), (1, 0, 3, 4), (10_000, 47_000)),
        PinMap((8, 9, 10, 11), (4, 5, 6, 7), (12, 2), (5, 4, 1, 0)),
        PinMap((4, 5, 6, 13), (8, 9, 10, 18), (3, 14), (1, 2, 3, 5)),
    ),
    "megaatmega2560": (
        PinMap((5, 22, 40, 53), (69, 14, 2, 33), (10, 3), (7, 5, 0, 2), (10_000, 47_000)),
        PinMap((37, 36, 35, 34), (25, 24, 23, 22), (48, 49), (3, 2, 1, 0)),
        PinMap((62, 63, 64, 65), (6, 7, 8, 9), (13, 54), (1, 2, 3, 4)),
    ),
}


# Multiplexers of 32 channels, which want five pins each.
WIDE = PinMap((22, 23, 24, 25, 26), (37, 36, 35, 34, 33), (49, 48), (0, 1, 2, 3))


@cache
def _ports(board: str) -> tuple[str, ...]:
    """Port and bit of each pin, as PD4."""
    header = (VARIANTS / VARIANT[board] / "pins_arduino.h").read_text()
    listed = []
    for name in ("digital_pin_to_port_PGM", "digital_pin_to_bit_mask_PGM"):
        body = header.split(f"{name}[] = {{", 1)[1].split("};", 1)[0]
        listed.append(re.sub(r"//.*", "", body))
    ports = re.findall(r"\bP([A-L])\b", listed[0])
    bits = re.findall(r"_BV\(\s*(\d)\s*\)", listed[1])
    assert len(ports) == len(bits)
    return tuple(f"P{port}{bit}" for port, bit in zip(ports, bits, strict=True))


def pins_option(board: str, numbers: Sequence[int]) -> str:
    """The option --pins of both simulators, of a wiring in the order of wiring.h."""
    ports = _ports(board)
    return ",".join([*(ports[pin] for pin in numbers[:-4]), *map(str, numbers[-4:])])


_SIDES = ("TOP", "BOTTOM")
# Flags by which platformio.ini may have another wiring; settings of tests have no value.
_FLAG = re.compile(r"-D\s*OHMSKIN_(\w+)=(\S+)")


def build(board: str, flags: str, place: Path) -> Path:
    """Build the firmware with these flags below `place`, whatever wiring platformio.ini has.

    :raises RuntimeError: it does not compile, and why.
    """
    project, built = place / "platformio.ini", place / "build"  # PlatformIO empties the latter
    place.mkdir(exist_ok=True)
    project.write_text(_FLAG.sub("", (ROOT / "platformio.ini").read_text()))
    variables = {"PLATFORMIO_BUILD_DIR": str(built), "PLATFORMIO_BUILD_FLAGS": flags}
    done = _pio("run", "-s", "-c", str(project), "-e", board, **variables)
    if done.returncode:
        raise RuntimeError(f"the firmware does not compile with {flags}:\n{done.stdout}")
    return built / board / "firmware.elf"


def _pio(*command: str, **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run PlatformIO for this project; its output and its messages are `stdout`."""
    environment = {"PLATFORMIO_CORE_DIR": str(ROOT / ".pio" / "core")} | os.environ | variables
    pio = Path(sys.executable).parent / "pio"
    return subprocess.run(
        [str(pio), *command, "-d", str(ROOT)],
        env=environment,
        check=False,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def of_platformio_ini(board: str) -> tuple[PinMap, int]:
    """The wiring that platformio.ini has for a board, and the number of it in `hello`."""
    said = _pio("project", "config", "--json-output").stdout
    flags = dict(dict(json.loads(said))[f"env:{board}"])["build_flags"]
    told, usual = dict(_FLAG.findall(" ".join(flags))), DEFAULT[board]
    odd = [f"OHMSKIN_{name}" for name in told if f"-DOHMSKIN_{name}=" not in WIDE.flags]
    assert not odd, f"platformio.ini has flags that no board knows: {', '.join(odd)}"

    def numbers(name: str, otherwise: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(map(int, told[name].split(","))) if name in told else otherwise

    (top,), (bottom,) = (numbers(f"DRIVE_{s}_PIN", (usual.drive[n],)) for n, s in enumerate(_SIDES))
    (top_ohm,), (bottom_ohm,) = (numbers(f"REF_{side}_OHM", (30_000,)) for side in _SIDES)
    wiring = PinMap(
        numbers("ROW_PINS", usual.rows),
        numbers("COLUMN_PINS", usual.columns),
        (top, bottom),
        numbers("SENSE_INPUTS", usual.sense),
        (top_ohm, bottom_ohm),
    )
    has_own_pins = any(name.endswith(("_PIN", "_PINS", "_INPUTS")) for name in told)
    return wiring, wiring.crc if has_own_pins else 0


def told_by(elf: Path) -> tuple[tuple[int, ...], tuple[int, int]]:
    """What the firmware tells simulators: pins and sense inputs, and reference resistors [ohm]."""
    section = ".ohmskin.wiring=/dev/stdout"
    command = ["avr-objcopy", "--dump-section", section, str(elf), "/dev/null"]
    done = subprocess.run(command, check=False, capture_output=True)
    if not done.stdout:  # objcopy may say so and return 0
        raise RuntimeError(f"{elf} does not tell its wiring: run 'make firmware'")
    table = done.stdout
    return tuple(table[:-8]), struct.unpack("<II", table[-8:])
