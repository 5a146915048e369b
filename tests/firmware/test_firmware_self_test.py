# SPDX-License-Identifier: Apache-2.0
"""The self-test of the built firmware, on sound and broken boards."""

import numpy as np
import pytest

from lockstep import Rig

pytestmark = pytest.mark.simavr


REF_OHM = 30e3


def sound_skin(rng: np.random.Generator) -> np.ndarray:
    """Sense ratios (16, 16, 4): cells at rest, pressed, hard pressed and not connected at all."""
    rho = 10 ** rng.uniform(3, 6, (16, 16))
    rho[3, 4], rho[5, 5] = 0, np.inf
    x = REF_OHM / (2 * REF_OHM + rho)
    return np.stack([1 - x, x, 1 - x, x], axis=-1)


def skin_shorted_at_top(rng: np.random.Generator, rail: float, *, pressed: bool) -> np.ndarray:
    """The top node held at `rail`, whatever its pin does."""
    rho = 10 ** rng.uniform(3 if pressed else 5.5, 6, (16, 16))
    x = REF_OHM / (REF_OHM + rho)
    top = np.full_like(x, rail)
    return np.stack([top, rail * x, 1 - x + rail * x, top], axis=-1)


def skin_without_reference_at_top(rng: np.random.Generator, *, pressed: bool) -> np.ndarray:
    """No current flows: the top node follows the bottom layer where a cell holds it."""
    follows = rng.random((16, 16)) < (1.0 if pressed else 0.02)
    follows[7, 9] = True
    floats = rng.uniform(0.3, 0.7, (16, 16))
    low, high = np.zeros((16, 16)), np.ones((16, 16))
    return np.stack(
        [np.where(follows, low, floats), low, high, np.where(follows, high, floats)], axis=-1
    )


def swapped(ratio: np.ndarray) -> np.ndarray:
    """The same skin with top and bottom exchanged: A and C change places, B and D too."""
    return ratio[..., [2, 3, 0, 1]]


def findings_on(rig: Rig, ratio: np.ndarray) -> tuple[str, ...]:
    rig.sim.set_table(ratio)
    before = len(rig.log)
    rig.must("self_test", limit_s=1.0)
    assert [name for name, _ in rig.log[before:]] == ["self_test_report", "ack"]
    report = rig.frames("self_test_report")[-1]
    codes = np.clip(np.floor(ratio * 1024), 0, 1023)
    assert report["code_min"] == tuple(codes.min(axis=(0, 1)))
    assert report["code_max"] == tuple(codes.max(axis=(0, 1)))
    return tuple(report["findings"])


def test_self_test_of_a_sound_board(rig: Rig, rng: np.random.Generator) -> None:
    assert findings_on(rig, sound_skin(rng)) == ()
    assert findings_on(rig, np.full((16, 16, 4), 0.5)) == ()
    assert findings_on(rig, np.tile([1.0, 0.0, 1.0, 0.0], (16, 16, 1))) == ()
    rig.start_scan()  # and it leaves the scan as it was
    rig.must("stop")
    assert rig.damaged == 0


def test_self_test_finds_a_missing_reference(rig: Rig, rng: np.random.Generator) -> None:
    for pressed in (False, True):
        ratio = skin_without_reference_at_top(rng, pressed=pressed)
        assert findings_on(rig, ratio) == ("top_reference_missing",)
        assert findings_on(rig, swapped(ratio)) == ("bottom_reference_missing",)


@pytest.mark.parametrize("pressed", [False, True])
def test_self_test_finds_a_node_at_a_rail(
    rig: Rig, rng: np.random.Generator, pressed: bool
) -> None:
    for rail, name in ((0.0, "low"), (1.0, "high")):
        ratio = skin_shorted_at_top(rng, rail, pressed=pressed)
        assert findings_on(rig, ratio) == (f"top_stuck_{name}",)
        assert findings_on(rig, swapped(ratio)) == (f"bottom_stuck_{name}",)
