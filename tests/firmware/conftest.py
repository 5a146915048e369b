# SPDX-License-Identifier: Apache-2.0
"""A board with the built firmware, in lock-step, for each kind of board."""

from collections.abc import Iterator

import numpy as np
import pytest

from firmware_helpers import BOOT_S
from lockstep import BOARDS, Rig, elf_of
from ohmskin.emulate.simavr import PROGRAM


@pytest.fixture(params=BOARDS)
def board(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if not PROGRAM.exists():
        pytest.skip("skinsim is not built: make sim")
    if not elf_of(name).exists():
        pytest.skip(f"the firmware for {name} is not built: make firmware")
    return name


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2024)


@pytest.fixture
def rig(board: str, rng: np.random.Generator) -> Iterator[Rig]:
    """A board that has booted with a blank EEPROM, on a random skin."""
    with Rig(board) as rig:
        rig.run(BOOT_S)
        rig.randomize(rng)
        yield rig
