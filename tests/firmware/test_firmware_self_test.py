# SPDX-License-Identifier: Apache-2.0
"""The self-test of the built firmware, on sound and broken boards."""

import numpy as np
import pytest

from lockstep import DEFAULT_SCAN, Rig
from ohmskin.circuit.skin import Skin, all_readings, end_admittance

pytestmark = pytest.mark.simavr


REF_OHM = 30e3


def sound_skin(rng: np.random.Generator, least_ohm: float = 0.0) -> np.ndarray:
    """Sense ratios (16, 16, 4): cells at rest, pressed, hard pressed and not connected at all."""
    rho = 10 ** rng.uniform(3, 6, (16, 16))
    rho[3, 4], rho[5, 5] = 0, np.inf
    rho = np.maximum(rho, least_ohm)
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
    """Of near ends (16, 16, 4) in mode near, of both ends (16, 16, 8) in mode far."""
    readings = ratio.shape[2]
    rig.must("configure", **(DEFAULT_SCAN | {"mode": "near" if readings == 4 else "far"}))
    rig.sim.set_table(ratio)
    before = len(rig.log)
    rig.must("self_test", limit_s=1.0)
    assert [name for name, _ in rig.log[before:]] == ["self_test_report", "ack"]
    report = rig.frames("self_test_report")[-1]
    largest = (1 << rig.sim.adc_bits) - 1
    codes = np.clip(np.floor(ratio * (largest + 1)), 0, largest)
    # Far nodes are judged from the second column on.
    far = codes[:, 1:, 4:]
    least = (*codes[..., :4].min(axis=(0, 1)), *far.min(axis=(0, 1)), *([largest] * 4))
    most = (*codes[..., :4].max(axis=(0, 1)), *far.max(axis=(0, 1)), *([0] * 4))
    assert (report["code_min"], report["code_max"]) == (least[:8], most[:8])
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


def test_a_self_test_ends_though_no_conversion_ends_in_time(rig: Rig) -> None:
    rig.sim.set(late_cycles=900)
    rig.must("self_test", limit_s=2.0)
    report = rig.frames("self_test_report")[-1]
    assert report["findings"] == ()
    assert all(a > b for a, b in zip(report["code_min"], report["code_max"], strict=True))
    rig.sim.set(late_cycles=0)
    rig.must("self_test", limit_s=1.0)
    assert rig.frames("self_test_report")[-1]["code_min"][0] < 1023


A, B, C, D, E, F, G, H = range(8)


def far_board(rng: np.random.Generator, change: dict[int, int | float]) -> np.ndarray:
    """A sound 16x16 board of 5 rows and 7 columns with far ends, whose readings then change.

    A far node at an input beyond the skin has the potential of the other layer. change: to another
    reading, or to a number. Presses below 20 kOhm would hide that a far node floats.
    """
    ratio = np.concatenate([sound_skin(rng, 20e3)] * 2, axis=-1)
    ratio[..., [E, F, G, H]] = ratio[..., [A, B, C, D]]
    ratio[5:, :, [E, H]] = ratio[5:, :, [B, C]]
    ratio[:, 7:, [F, G]] = ratio[:, 7:, [A, D]]
    for reading, to in change.items():
        ratio[..., reading] = ratio[..., to] if isinstance(to, int) else to
    return ratio


@pytest.mark.parametrize(
    ("change", "findings"),
    [
        ({}, ()),
        ({E: B, H: C}, ("far_top_open",)),
        ({F: A, G: D}, ("far_bottom_open",)),
        ({E: B, H: C, F: A, G: D}, ("far_top_open", "far_bottom_open")),
        ({E: 0.0, H: 0.0}, ("far_top_stuck_low",)),
        ({E: 1.0, H: 1.0}, ("far_top_stuck_high",)),
        ({F: 0.0, G: 0.0}, ("far_bottom_stuck_low",)),
        ({F: 1.0, G: 1.0}, ("far_bottom_stuck_high",)),
    ],
)
def test_self_test_judges_far_nodes(
    rig: Rig, rng: np.random.Generator, change: dict[int, int | float], findings: tuple[str, ...]
) -> None:
    ratio = far_board(rng, change)
    assert findings_on(rig, ratio) == findings
    assert findings_on(rig, ratio[..., :4]) == ()  # in mode near nobody asks for them


@pytest.mark.parametrize("node_pf", [20, 100])
def test_far_nodes_that_float_are_found_and_those_of_a_skin_are_not(
    rig: Rig, node_pf: float
) -> None:
    """By the simulator's capacitances: a node that floats follows the sample capacitor."""
    cells = np.full((5, 2), 1e-6)
    cells[1, 1] = 1e-3
    skin = Skin(cells, np.full((5, 2), 100.0), np.full((5, 2), 200.0))
    ends = end_admittance(skin)
    rig.sim.set_table(all_readings(skin, ends.copy()))
    rig.sim.set(sample_pf=14, input_ohm=10e3, node_pf=node_pf, line_pf=30, cell_pf=2)
    rig.must("configure", **(DEFAULT_SCAN | {"rows": 5, "columns": 2, "mode": "far"}))
    rig.sim.request("C", bytes([0x80 | 5]) + ends.tobytes())
    for far_open, findings in (0, ()), (1, ("far_top_open", "far_bottom_open")):
        rig.sim.set(far_open=far_open)
        rig.must("self_test", limit_s=1.0)
        assert rig.frames("self_test_report")[-1]["findings"] == findings
