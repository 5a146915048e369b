# SPDX-License-Identifier: Apache-2.0
"""The built firmware in avr8js, in lock-step: firmware/second_sim, independent of simavr."""

import shutil
from unittest.mock import patch

from lockstep import LockstepSim, elf_of
from places import ROOT

FOLDER = ROOT / "firmware" / "second_sim"


def is_installed() -> bool:
    """Whether there are node and avr8js: 'make setup' gets them."""
    return shutil.which("node") is not None and (FOLDER / "node_modules" / "avr8js").exists()


class SecondSim(LockstepSim):
    """A board with its HEX file; has the operations that firmware/second_sim/README.md lists."""

    def __init__(self, board: str) -> None:
        with patch("ohmskin.emulate.simavr.PROGRAM", FOLDER / "second_sim.js"):
            super().__init__(board, elf_of(board).with_suffix(".hex"))
