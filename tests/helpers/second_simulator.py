# SPDX-License-Identifier: Apache-2.0
"""The built firmware in avr8js, or a Pico's in rp2040js, in lock-step: firmware/second_sim."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any
from unittest.mock import patch

from lockstep import LockstepSim, elf_of
from pin_maps import pins_option, told_by
from places import ROOT

FOLDER = ROOT / "firmware" / "second_sim"
PICO_ELF = ROOT / "firmware" / "pico" / "build" / "ohmskin.elf"


def is_installed(chip: str) -> bool:
    """Whether there are node and a chip's simulator, avr8js or rp2040js: 'make setup' gets them."""
    return shutil.which("node") is not None and (FOLDER / "node_modules" / chip).exists()


class SecondSim(LockstepSim):
    """A board with its HEX file; has the operations that firmware/second_sim/README.md lists."""

    def __init__(self, board: str, elf: Path | None = None, pins: str = "") -> None:
        """pins: a wiring; else it is that which the firmware tells."""
        elf = elf or elf_of(board)
        pins = pins or pins_option(board, told_by(elf)[0])
        with patch("ohmskin.emulate.simavr.PROGRAM", FOLDER / "second_sim.js"):
            super().__init__(board, elf.with_suffix(".hex"), pins=pins)


class PicoSim(LockstepSim):
    """A Pico with its UF2 file, and a host at its USB that has opened its port."""

    boot_s = 0.06
    """Until the host has it: 10 ms of bus reset are the most of it."""
    jitter_cycles = 2
    """Its processor starts each conversion, up to some instructions late."""
    adc_bits = 12

    def __init__(self, elf: Path = PICO_ELF, pins: str = "") -> None:
        with patch("ohmskin.emulate.simavr.PROGRAM", FOLDER / "second_sim.js"):
            super().__init__("pico", elf.with_suffix(".uf2"), pins=pins)

    def cut_power(self) -> None:
        """Switch it off and on again: what the flash was writing is left half done."""
        self.request("P")

    def restart_by_rom(self) -> None:
        """Restart it as its ROM does when a UF2 file has been copied to it: by the watchdog."""
        self.request("F")

    def open_port(self, is_open: bool) -> None:
        """Let a program of the host open the port, or close it."""
        self.request("U", struct.pack("<?", is_open))

    def clear_halt(self, endpoint: int) -> None:
        """Clear an endpoint's halt, as a driver does: its packets begin with DATA0 again."""
        self.request("H", bytes([endpoint]))

    def described(self) -> dict[str, bytes]:
        """The descriptors that the board has given: device, configuration, serial_number."""
        said: dict[str, Any] = json.loads(self.request("V"))
        return {name: bytes.fromhex(digits) for name, digits in said.items()}
