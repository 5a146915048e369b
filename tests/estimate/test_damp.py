# SPDX-License-Identifier: Apache-2.0
"""Damp skins: neighbouring stripes of a layer leak into each other, by a node Laplacian."""

import numpy as np
import pytest

from network import SkinCircuit, leaks  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import Skin
from ohmskin.estimate.joint import JointEstimator, TouchEstimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.sparse_fit import RestNetwork, TouchedNetwork
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ENUMS, MODES
from studies.judge import answers_of, judge_trial, pooled
from studies.trials import Trial, finger_trial, random_trial

METHODS = JointEstimator, TouchEstimator
FARS = ((False, False), (True, True), (True, False))


def readings(trial: Trial, leak_ohm: float, mode: str) -> Float:
    """Of 10 bits and 0.3 LSB: at rest, the mean of 90 scans, then of all frames."""
    more = leaks(trial.rest.shape, leak_ohm) if leak_ohm else None
    circuit = SkinCircuit(trial.rest, more)
    names = [ENUMS["reading"].values[name] for name in MODES[mode]]
    cells = [trial.rest.cell_siemens, *trial.cell_siemens]
    exact = np.array([circuit.readings(siemens) for siemens in cells])[..., names]
    exact = np.concatenate([np.repeat(exact[:1], 90, axis=0), exact[1:]])
    noise = 0.3 / 1024 * np.random.default_rng(0).standard_normal(exact.shape)
    ratio = ratio_from_codes(quantise(exact + noise))
    return np.concatenate([ratio[:90].mean(axis=0, keepdims=True), ratio[90:]])


def estimator(method: type[JointEstimator], rest: Float, mode: str) -> JointEstimator:
    size = rest.shape[0], rest.shape[1]
    return method(SkinKnowledge(*size, adc_bits=10, rest_ratio=rest, reading_names=MODES[mode]))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "trials",
    [
        [random_trial(8, 8, 6, 12, 3), random_trial(8, 8, 6, 12, 4), random_trial(8, 8, 6, 12, 5)],
        [finger_trial(8, 8, 12, 4)],
    ],
    ids=["random", "finger"],
)
def test_leaks_are_found_at_rest_and_do_not_spoil_answers(
    trials: list[Trial], method: type[JointEstimator], mode: str
) -> None:
    """Neglected leaks of 1 MOhm make fingertips err by 14 %, and flag most random touches."""
    judged = []
    for trial in trials:
        rest, *frames = readings(trial, 1e6, mode)
        reader = estimator(method, rest, mode)
        leak_ohm = reader.leak_ohm()
        assert leak_ohm is not None
        assert all(3e5 < ohm < 3e6 for ohm in leak_ohm)
        found = [reader.estimate(frame) for frame in frames]
        assert np.mean([one.converged for one in found]) > 0.9
        judged.append(judge_trial(answers_of(found), trial))
    assert pooled(judged).error_percent() < 6
    assert pooled(judged).pressed_within_percent() > 97


def test_small_leaks_are_expected_and_not_said() -> None:
    """Leaks of 10 MOhm that were neglected would mislead in most frames; they may be chance."""
    misled = 0
    for seed in range(3):
        trial = random_trial(8, 8, 8, 12, seed)
        rest, *frames = readings(trial, 1e7, "near")
        reader = estimator(JointEstimator, rest, "near")
        assert reader.leak_ohm() is None
        for ratio, true in zip(frames, trial.cell_siemens, strict=True):
            found = reader.estimate(ratio)
            off = np.abs(found.cell_siemens - true)
            misled += bool((off > np.maximum(4 * found.cell_siemens_std, 5e-7)).any())
    assert misled <= 1


@pytest.mark.parametrize("shape", [(8, 8), (16, 16), (3, 3), (2, 2), (1, 8), (8, 1), (1, 1)])
def test_a_dry_skin_has_no_leaks(shape: tuple[int, int]) -> None:
    for seed in range(4):
        rest = readings(random_trial(*shape, 1, 1, seed), 0.0, "near")[0]
        assert estimator(JointEstimator, rest, "near").leak_ohm() is None


def test_a_reset_does_not_dry_a_skin() -> None:
    rest = readings(random_trial(8, 8, 1, 1, 3), 1e6, "near")[0]
    reader = estimator(JointEstimator, rest, "near")
    before = reader.leak_ohm()
    reader.reset()
    assert reader.leak_ohm() == before
    assert before is not None


@pytest.mark.parametrize("far", FARS)
def test_slopes_by_leaks_are_those_of_differences(far: tuple[bool, bool]) -> None:
    random, added = np.random.default_rng(0), 1e-4
    cells = 1e-6 * np.exp(random.standard_normal((4, 5)))
    leak, step = np.array([2e-6, 5e-7]), 1e-9
    touched = cells.copy()
    touched[1, 2] += added

    def port_ohm(siemens: Float) -> Float:
        by_row, by_column = siemens.tolist()
        return PortCircuit(
            touched, 100.0, 200.0, far=far, leak_siemens=(by_row, by_column)
        ).port_ohm

    expected = np.transpose(
        [(port_ohm(leak + one) - port_ohm(leak - one)) / (2 * step) for one in step * np.eye(2)]
    )
    leaking = (float(leak[0]), float(leak[1]))
    whole = PortCircuit(touched, 100.0, 200.0, far=far, leak_siemens=leaking)
    np.testing.assert_allclose(whole.by_leaks(), expected, rtol=1e-5)
    rest = RestNetwork(cells, 100.0, 200.0, far=far, leak_siemens=leaking)
    network = TouchedNetwork(rest, np.array([7]), np.array([added]))
    np.testing.assert_allclose(network.port_ohm, whole.port_ohm, rtol=1e-9)
    np.testing.assert_allclose(network.by_leaks(np.arange(20)), whole.by_leaks(), rtol=1e-9)


def test_leaks_at_the_ends_of_lines_are_nearly_those_at_each_crossing() -> None:
    random = np.random.default_rng(1)
    cells = 1e-6 * np.exp(0.1 * random.standard_normal((8, 8)))
    cells[2, 3] = 1e-4
    top, bottom = np.full((8, 8), 100.0), np.full((8, 8), 200.0)
    skin = Skin(cells, top, bottom)
    exact = SkinCircuit(skin, leaks((8, 8), 1e6)).readings(cells)[..., 1] / skin.ref_bottom_ohm
    circuit = PortCircuit(cells, 100.0, 200.0, leak_siemens=(1e-6, 1e-6))
    current = 1 / (circuit.port_ohm.reshape(8, 8) + skin.ref_top_ohm + skin.ref_bottom_ohm)
    np.testing.assert_allclose(current, exact, rtol=6e-3)


@pytest.mark.parametrize("shape", [(1, 16), (16, 1)])
@pytest.mark.parametrize("method", METHODS)
def test_a_single_line_has_no_neighbour_to_leak_into(
    shape: tuple[int, int], method: type[JointEstimator]
) -> None:
    """Its slope by these leaks is 0, and they are known to be none."""
    cells = np.full(shape, 5e-6)
    skin = Skin(cells, np.full(shape, 100.0), np.full(shape, 200.0))
    circuit = SkinCircuit(skin, leaks(shape, 3e5))
    reader = estimator(method, circuit.readings(cells)[..., :4], "near")
    reader.estimate(circuit.readings(cells)[..., :4])
    pressed = cells.copy()
    pressed.flat[3] = 1e-4
    found = reader.estimate(circuit.readings(pressed)[..., :4])
    assert found.touched.sum() == found.touched.flat[3] == 1
