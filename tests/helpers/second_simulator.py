# SPDX-License-Identifier: Apache-2.0
"""The built firmware in avr8js, in lock-step: firmware/second_sim, independent of simavr."""

import shutil
from unittest.mock import patch

from lockstep import LockstepSim, Rig, elf_of
from places import ROOT

FOLDER = ROOT / "firmware" / "second_sim"
PROGRAM = FOLDER / "second_sim.js"


def is_installed() -> bool:
    """Whether 'make setup' found npm and its registry."""
    return shutil.which("node") is not None and (FOLDER / "node_modules" / "avr8js").exists()


class SecondSim(LockstepSim):
    """The operations that firmware/second_sim/README.md lists; the others raise SimulationError.

    Runs the HEX file that a board is flashed with.
    """

    def __init__(self, board: str) -> None:
        with patch("ohmskin.emulate.simavr.PROGRAM", PROGRAM):
            super().__init__(board, elf_of(board).with_suffix(".hex"))


def second_rig(board: str) -> Rig:
    """A board in the second simulator, in lock-step with a host that knows every reading."""
    return Rig(board, SecondSim(board))
