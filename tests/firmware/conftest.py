# SPDX-License-Identifier: Apache-2.0
"""A board with the built firmware, in lock-step, for each kind of board."""

from collections.abc import Iterator

import numpy as np
import pytest

from lockstep import BOARDS, Rig


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2024)


@pytest.fixture(params=BOARDS)
def rig(request: pytest.FixtureRequest, rng: np.random.Generator) -> Iterator[Rig]:
    """A board that has booted with a blank EEPROM, on a random skin."""
    with Rig(request.param) as rig:
        rig.run(rig.sim.boot_s)
        rig.randomize(rng)
        yield rig
