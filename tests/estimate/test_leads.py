# SPDX-License-Identifier: Apache-2.0
"""Leads between the multiplexers and the skin, told or not: readings by a circuit that has them.

That circuit is compared with ngspice in tests/circuit.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from network import SkinCircuit
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from studies.trials import Trial, finger_trial, random_trial, skin_at_rest, trial_of

METHODS = ("joint", "touch")


def with_leads(trial: Trial, ohm: float, own: float = 0.1) -> Trial:
    """The same skin behind leads of about so many ohm, each off by such a share by itself."""
    random = np.random.default_rng(1)
    lead_ohm = ohm * np.exp(own * random.standard_normal(sum(trial.rest.shape)))

    def led(skin: Skin) -> Skin:
        return replace(skin, lead_ohm=lead_ohm)

    return trial_of(led(trial.rest), [led(skin) for skin in trial.frames])


def estimates(
    trial: Trial, method: str, lead_ohm: float | None, mode: str = "near"
) -> tuple[list[Estimate], float]:
    """Answers to all frames, by who was told this lead; and the lead that came of them [ohm]."""
    given = trial.rounded(10, mode=mode, wires_told=False)
    nominal = given.knowledge(0).nominal_wire_ohm._replace(lead=lead_ohm)
    estimator = make_estimator(method, replace(given.knowledge(0), nominal_wire_ohm=nominal))
    answers = [estimator.estimate(ratio) for ratio in given.ratio]
    return answers, estimator.wires().lead or 0.0


def errors(trial: Trial, answers: list[Estimate]) -> tuple[Float, Float]:
    """Of the pressed cells: error over the truth, and over the deviation that is stated."""
    found, std = (
        np.array([getattr(answer, name) for answer in answers])[trial.pressed]
        for name in ("cell_siemens", "cell_siemens_std")
    )
    off = np.abs(found - trial.cell_siemens[trial.pressed])
    return off / trial.cell_siemens[trial.pressed], off / std


@pytest.mark.parametrize("method", METHODS)
def test_leads_that_are_told_cost_little(method: str) -> None:
    without = random_trial(8, 8, 6, 20, seed=4)
    behind = with_leads(without, 600.0)
    usual = np.median(errors(without, estimates(without, method, 0.0)[0])[0])
    assert np.median(errors(behind, estimates(behind, method, 600.0)[0])[0]) < 1.5 * usual
    silent = np.median(errors(behind, estimates(behind, method, 0.0)[0])[0])
    assert silent > 2 * usual  # they matter


@pytest.mark.parametrize("ohm", [0.0, 300.0, 1000.0])
@pytest.mark.parametrize("method", METHODS)
def test_leads_that_nobody_told_are_in_the_deviations(method: str, ohm: float) -> None:
    for trial in (random_trial(8, 8, 6, 20, seed=4), finger_trial(8, 8, 10, seed=4)):
        behind = with_leads(trial, ohm)
        _, stds_off = errors(behind, estimates(behind, method, None)[0])
        assert np.mean(stds_off < 4) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_several_touches_teach_the_lead(method: str) -> None:
    behind = with_leads(random_trial(8, 8, 6, 25, seed=5), 600.0)
    assert estimates(behind, method, None)[1] == pytest.approx(600, rel=0.2)


def test_touches_teach_what_the_lead_of_each_line_is() -> None:
    """Late frames behind leads that differ are answered as well as behind leads that are alike."""

    def late(behind: Trial) -> Float:
        answers, _ = estimates(behind, "joint", 3000.0)
        half = len(behind.frames) // 2
        found = np.array([answer.cell_siemens for answer in answers])[half:]
        true, pressed = behind.cell_siemens[half:], behind.pressed[half:]
        return (np.abs(found - true) / true)[pressed]

    trials = [random_trial(8, 8, 6, 60, seed) for seed in range(3)]
    differ, alike = (
        np.median(np.concatenate([late(with_leads(trial, 3000.0, own)) for trial in trials]))
        for own in (0.1, 0.0)
    )
    assert differ < 1.4 * alike  # 1.9 where nothing is learned of single leads


def test_no_lead_below_0_explains_what_long_wires_hide() -> None:
    """Skins without leads, of which nothing is told: some lessons show minus some kilohms."""
    off = []
    for seed in range(3, 11):
        trial = random_trial(8, 8, 4, 24, seed, wire_ohm=(500.0, 1000.0))
        answers, _ = estimates(trial, "joint", None)
        off.append(errors(trial, answers))
    share, stds_off = np.concatenate(off, axis=1)
    assert np.mean(stds_off < 4) > 0.995
    assert np.median(share) < 0.1  # 0.17 where leads may be below 0


@pytest.mark.parametrize("ohm", [100.0, 1000.0])
def test_far_ends_measure_leads_and_are_not_misled(ohm: float) -> None:
    without = random_trial(8, 8, 6, 20, seed=6)
    behind = with_leads(without, ohm)
    usual, _ = errors(without, estimates(without, "joint", 0.0, "far")[0])
    answers, lead_ohm = estimates(behind, "joint", None, "far")
    off, stds_off = errors(behind, answers)
    assert lead_ohm == pytest.approx(behind.rest.lead_ohm.mean(), rel=0.1)
    assert np.median(off) < 1.5 * np.median(usual)
    assert np.mean(stds_off < 4) > 0.97


def test_fingertips_alone_show_the_lead_at_far_ends() -> None:
    """Every frame measures it, even one that is too crowded to be a lesson."""
    behind = with_leads(finger_trial(8, 8, 6, seed=3), 600.0)
    _, lead_ohm = estimates(behind, "joint", None, "far")
    assert lead_ohm == pytest.approx(behind.rest.lead_ohm.mean(), rel=0.1)


def fingertip(shape: tuple[int, int], random: np.random.Generator) -> Float:
    """Each cell's share of the force of a fingertip somewhere, which fades to nothing."""
    rows, columns = np.indices(shape)
    row, column = random.uniform(0, np.array(shape) - 1)
    pressure = np.exp(
        -((rows - row) ** 2 + (columns - column) ** 2) / random.uniform(0.7, 1.2) ** 2
    )
    pressure[pressure < 0.01 * pressure.max()] = 0.0
    return np.asarray(pressure / pressure.sum())


def pressed(rest: Skin, force_n: Float, gain: Float | float = 1.0) -> Skin:
    """The skin under these forces. Conductance fades faster than force, as a power of it.

    So cells at the edge of a fingertip rise by less than they conduct at rest.
    """
    contact = 30e-6 * force_n**1.5 * gain
    return replace(rest, cell_siemens=rest.cell_siemens + contact / (1 + 250 * contact))


def hard_fingertips(seed: int) -> Trial:
    """60 of them on a skin without leads."""
    random = np.random.default_rng(seed)
    rest = skin_at_rest(8, 8, random, wire_ohm=(100.0, 200.0))
    frames = []
    for _ in range(60):
        shares, force_n = fingertip(rest.shape, random), random.uniform(8, 12)
        gain = np.exp(0.2 * random.standard_normal(rest.shape))
        frames.append(pressed(rest, force_n * shares, gain))
    return trial_of(rest, frames, (100.0, 200.0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_lead_that_is_told_takes_no_place_of_weak_cells_under_a_fingertip(seed: int) -> None:
    """Two hard fingertips of 60 came out up to 2.6 times as hard, behind a lead that is not there.

    The lead was told with a deviation, 150 ohm, as a calibration has it. Each frame is read alone.
    """
    trial = hard_fingertips(seed)
    given = trial.rounded(10)
    wires = given.knowledge(0).nominal_wire_ohm._replace(lead=0.0, lead_std_ohm=150.0)
    estimator = make_estimator("joint", replace(given.knowledge(0), nominal_wire_ohm=wires))
    for ratio, true in zip(given.ratio, trial.cell_siemens, strict=True):
        estimator.reset()
        answer = estimator.estimate(ratio)
        assert answer.cell_siemens.max() == pytest.approx(true.max(), rel=0.2)


def soft_fingertips(wire_ohm: tuple[float, float], seed: int, size: int = 8) -> Trial:
    """Twelve of them, each pressed ever harder."""
    random = np.random.default_rng(seed)
    rest = skin_at_rest(size, size, random, wire_ohm=wire_ohm)
    frames = []
    for _ in range(12):
        shares, most_n = fingertip(rest.shape, random), random.uniform(2, 12)
        frames += [pressed(rest, share * most_n * shares) for share in (0.3, 0.7, 1.0)]
    return trial_of(rest, frames)


@pytest.mark.parametrize("wire_ohm", [(20.0, 40.0), (100.0, 200.0)])
def test_the_soft_edge_of_a_fingertip_passes_for_no_lead(wire_ohm: tuple[float, float]) -> None:
    """One such fingertip taught a lead of 3.2 kohm where there was none."""
    for seed in range(4):
        trial = soft_fingertips(wire_ohm, seed)
        answers, lead_ohm = estimates(trial, "joint", None)
        assert lead_ohm < 500
        assert np.median(errors(trial, answers)[0]) < 0.05


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("lead_ohm", [0.0, None])
def test_the_soft_edge_of_a_fingertip_passes_for_no_long_wires(
    method: str, lead_ohm: float | None
) -> None:
    """Where wires are told, but not exactly. Peaks of 4 and 1000 times the truth were read."""
    for seed, size in product(range(4), (8, 16)):
        trial = soft_fingertips((100.0, 200.0), seed, size)
        given = trial.rounded(10)
        wires = given.knowledge(0).nominal_wire_ohm._replace(lead=lead_ohm)
        estimator = make_estimator(method, replace(given.knowledge(0), nominal_wire_ohm=wires))
        for ratio, true in zip(given.ratio, trial.cell_siemens, strict=True):
            assert estimator.estimate(ratio).cell_siemens.max() < 1.5 * true.max()


def test_a_cell_that_opened_beside_a_fingertip_is_named() -> None:
    """Its prior is wide there, by which nothing is a loss."""
    random = np.random.default_rng(5)
    rest = skin_at_rest(8, 8, random, wire_ohm=(100.0, 200.0))
    siemens = rest.cell_siemens.copy()
    siemens[2:4, 2:4] += random.uniform(1e-5, 1e-4, (2, 2))
    siemens[4, 2] *= 0.05
    trial = trial_of(rest, [replace(rest, cell_siemens=siemens)])
    answers, _ = estimates(trial, "joint", None)
    assert "cell (4, 2): conducts less than at rest" in answers[0].message


def test_what_a_lead_has_above_the_others_is_taken_off_all_readings() -> None:
    """Exact readings by the nodes' equations, behind leads of all kinds: the answers are those of
    the same skin without them. Methods without leads are told nothing.
    """
    random = np.random.default_rng(5)
    trial = random_trial(5, 4, 3, 2, 11)
    own_ohm = random.uniform(-50.0, 3000.0, 9)
    even = replace(trial.rest, lead_ohm=np.full(9, 100.0))
    answers: dict[str, list[list[Float]]] = {"joint": [], "ohm": []}
    for skin, own in ((even, None), (replace(even, lead_ohm=100.0 + own_ohm), own_ohm)):
        circuit = SkinCircuit(skin)
        rest, *frames = (
            circuit.readings(cells)[..., :4] for cells in (skin.cell_siemens, *trial.cell_siemens)
        )
        known = SkinKnowledge(5, 4, rest_ratio=rest, own_lead_ohm=own)
        for method, of_skins in answers.items():
            estimator = make_estimator(method, known)
            of_skins.append([estimator.estimate(frame).cell_siemens for frame in frames])
    np.testing.assert_allclose(*answers["joint"], rtol=1e-6)
    assert not np.allclose(*answers["ohm"], rtol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_chi_square_counts_what_a_lead_has_above_the_others(method: str) -> None:
    """The model has no such leads, and the readings have: a perfect answer had chi-square 50."""
    own_ohm = np.zeros(16)
    own_ohm[3] = 2000.0
    rest = skin_at_rest(8, 8, np.random.default_rng(5), wire_ohm=(100.0, 200.0))
    siemens = rest.cell_siemens.copy()
    siemens[[3, 3, 5], [4, 6, 4]] += 2e-4
    crimped = replace(rest, lead_ohm=own_ohm)
    given = trial_of(crimped, [replace(crimped, cell_siemens=siemens)]).rounded(10)
    known = replace(given.knowledge(0), own_lead_ohm=own_ohm)
    assert make_estimator(method, known).estimate(given.ratio[0]).chi2 < 2.0
    assert make_estimator("ohm", known).estimate(given.ratio[0]).chi2 < 2.0  # it takes off none


@pytest.mark.parametrize("own_ohm", [np.zeros(8), np.full(9, np.nan), np.full(9, 1e30)])
def test_leads_that_cannot_be_are_refused(own_ohm: Float) -> None:
    with pytest.raises(ValueError, match="own_lead_ohm must be 9 numbers"):
        SkinKnowledge(5, 4, own_lead_ohm=own_ohm)
