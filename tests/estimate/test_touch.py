# SPDX-License-Identifier: Apache-2.0
"""`touch`, the networks behind it, and what the wires learn: against whole-circuit solutions."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from network import Network, SkinCircuit, skin_network  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import Skin, port_resistance_ohm
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.near_wires import LearnedWires
from ohmskin.estimate.port_readings import PortReader, PortReadings
from ohmskin.estimate.prior import (
    CHANGED_ODDS,
    LAYER_STD,
    MEMORY,
    REST_STD,
    SEGMENT_STD,
    STEADY_FADE,
    UNKNOWN_LAYER_STD,
    USUAL_LAYER_STD,
    WARY_ODDS,
    CellPrior,
)
from ohmskin.estimate.sparse_fit import RestNetwork, SparseFit, TouchedNetwork
from ohmskin.estimate.wire_belief import Lesson
from ohmskin.record.readings import estimate_file
from skins import reference, ten_bits, told
from studies.trials import bent_trial, finger_trial, random_trial, skin_at_rest, touch, trial_of


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 1), (4, 5), (8, 8)])
def test_touched_network_is_the_network_with_touches(size: tuple[int, int]) -> None:
    random = np.random.default_rng(1)
    rest = skin_at_rest(*size, random)
    touched = touch(rest, 4, random)
    added = (touched.cell_siemens - rest.cell_siemens).ravel()
    cells = np.flatnonzero(added)
    net = RestNetwork(rest.cell_siemens, rest.top_wire_ohm, rest.bottom_wire_ohm)
    np.testing.assert_allclose(net.port_ohm, port_resistance_ohm(rest).ravel(), rtol=1e-10)
    network = TouchedNetwork(net, cells, added[cells])
    np.testing.assert_allclose(network.port_ohm, port_resistance_ohm(touched).ravel(), rtol=1e-9)
    # d rho / d g = -v^2, by central differences of the whole circuit.
    for number, cell in enumerate(cells):
        ends = []
        for sign in (-1, 1):
            conductance = touched.cell_siemens.copy()
            conductance.flat[cell] *= 1 + sign * 1e-5
            ends.append(port_resistance_ohm(replace(touched, cell_siemens=conductance)).ravel())
        slope = (ends[1] - ends[0]) / (2e-5 * touched.cell_siemens.flat[cell])
        np.testing.assert_allclose(
            -(network.volt[number] ** 2), slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max()
        )


def test_currents_of_the_touched_network_obey_kirchhoff() -> None:
    """What enters a row leaves it through its cells: one ampere for the port's, none for others."""
    random = np.random.default_rng(2)
    rest = skin_at_rest(4, 5, random)
    net = RestNetwork(rest.cell_siemens, rest.top_wire_ohm, rest.bottom_wire_ohm)
    network = TouchedNetwork(net, np.array([3, 11]), np.array([1e-4, 1e-3]))
    current = network.cell_current(np.arange(20))[0].reshape(20, 4, 5)
    for port, (row, column) in enumerate(np.ndindex(4, 5)):
        np.testing.assert_allclose(current[port].sum(axis=1), np.eye(4)[row], atol=1e-9)
        np.testing.assert_allclose(current[port].sum(axis=0), np.eye(5)[column], atol=1e-9)


def per_ampere(network: Network, source: int, sink: int) -> Float:
    """Potentials of the nodes per ampere from one node through the network to another."""
    volt = network.node_v({source: 1.0, sink: 0.0})
    ampere = (volt[network.tail] - volt[network.head]) / network.branch_ohm
    return volt / (ampere[network.tail == source].sum() - ampere[network.head == source].sum())


@pytest.mark.parametrize("far", [(False, False), (True, True), (False, True)])
def test_voltages_over_cells_of_a_touched_skin_are_a_laplacians(far: tuple[bool, bool]) -> None:
    random = np.random.default_rng(4)
    shape, cells, added = (4, 5), np.array([3, 11]), np.array([1e-4, 1e-3])
    siemens = random.uniform(1e-6, 2e-6, shape)
    rest = RestNetwork(siemens, 100.0, 200.0, far=far)
    network = TouchedNetwork(rest, cells, added)
    touched = siemens.copy()
    touched.flat[cells] += added
    skin = Skin(touched, np.full(shape, 100.0), np.full(shape, 200.0))
    laplacian = skin_network(skin)
    top, bottom = np.arange(sum(shape), laplacian.nodes).reshape(2, *shape)
    some = np.array([0, 3, 7, 19])
    slopes, forced = network.own_slope(some)
    currents = network.cell_current(some)
    for port, (i, j) in enumerate(np.ndindex(shape)):
        far_row, far_column = (top[i, -1] if far[0] else i), (bottom[-1, j] if far[1] else 4 + j)
        driven, sensed = per_ampere(laplacian, i, 4 + j), per_ampere(laplacian, far_row, far_column)
        over_cells = [(volt[top] - volt[bottom]).ravel() for volt in (driven, sensed)]
        assert network.port_ohm[port] == pytest.approx(driven[far_row] - driven[far_column])
        np.testing.assert_allclose(network.volt[:, port], over_cells[0][cells], rtol=1e-6)
        np.testing.assert_allclose(network.sense_volt[:, port], over_cells[1][cells], rtol=1e-6)
        if port in some:
            number = some.tolist().index(port)
            assert slopes[number] == pytest.approx(over_cells[0][port] * over_cells[1][port])
            alone = per_ampere(laplacian, top[i, j], bottom[i, j])
            assert forced[number] == pytest.approx(alone[top[i, j]] - alone[bottom[i, j]])
            for current, volt in zip(currents, over_cells, strict=True):
                np.testing.assert_allclose(current[number], volt * touched.ravel(), rtol=1e-5)
    # `PortCircuit` has its slopes by wires from finite differences of a Laplacian (test_far_ends).
    whole = PortCircuit(touched, skin.top_wire_ohm, skin.bottom_wire_ohm, far=far).by_wires()[some]
    by_wires = rest.by_wires_of(some, *currents)
    np.testing.assert_allclose(by_wires, whole, atol=1e-7 * np.abs(whole).max())


@pytest.mark.parametrize("name", ["random_4x6", "random_8x8", "presses_8x8", "bent_8x8"])
def test_touch_agrees_with_joint_within_its_standard_deviation(name: str) -> None:
    rounded, arrays = reference(name)
    few, all_ = (estimate_file(rounded, method) for method in ("touch", "joint"))
    pressed = 1 / arrays["cell_ohm"] > 1.5 / arrays["rest_ohm"]
    apart = np.abs(few["cell_siemens"] - all_["cell_siemens"]) / few["cell_siemens_std"]
    simple = pressed.sum(axis=(1, 2)) <= 12  # frames with more touches are `joint`'s anyway
    # Rounding moves cells at rest in one method and not in the other, and wires learned differ.
    for some in (apart[simple], apart[simple][pressed[simple]]):
        assert np.mean(some <= 1) > 0.9
        assert np.mean(some <= 2) > 0.96


def test_touch_models_no_more_cells_than_are_touched() -> None:
    """On simulated frames of up to five touches: the pressed cells, and hardly ever another.

    The wires are known: else frames that want them better known would be for `joint`.
    """
    trial = random_trial(8, 8, 5, 40, seed=3)
    knowledge = trial.rounded(10).knowledge(0)
    wires = knowledge.nominal_wire_ohm._replace(top_log_std=0.03, bottom_log_std=0.03)
    knowledge = replace(knowledge, nominal_wire_ohm=wires, may_be_bent=False)
    estimator = make_estimator("touch", knowledge)
    found = np.array([estimator.estimate(r).cell_siemens for r in trial.rounded(10).ratio])
    off_rest = ~np.isclose(found, np.median(found, axis=0), rtol=1e-6)
    assert np.all(off_rest[trial.pressed])
    exact = np.all(off_rest == trial.pressed, axis=(1, 2))
    assert np.mean(exact) >= 0.85  # the others are for `joint`


def test_touch_finds_touches_in_a_large_skin_or_says_what_it_may_have_missed() -> None:
    trial = random_trial(32, 32, 10, 3, seed=4)
    out = estimate_file(trial.rounded(10), "touch")
    assert not np.any(out["touched"] & ~trial.pressed)
    assert np.mean(out["touched"][trial.pressed]) > 0.7
    away = np.abs(out["cell_siemens"] - trial.cell_siemens) / out["cell_siemens_std"]
    assert np.mean(away < 4) > 0.999


def test_without_rest_readings_touch_is_joint() -> None:
    trial = random_trial(4, 4, 3, 2, seed=5)
    frames = replace(trial.rounded(10), rest_ratio=None)
    few, all_ = (estimate_file(frames, method)["cell_siemens"] for method in ("touch", "joint"))
    np.testing.assert_array_equal(few, all_)


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_wires_of_a_bent_skin_are_learned(method: str) -> None:
    """Wires 35 % above nominal: after 50 frames the mean of each layer is known to a tenth."""
    trial = bent_trial(8, 8, 8, 50, seed=6)
    out = estimate_file(trial.rounded(10), method)
    for layer in ("top_wire_ohm", "bottom_wire_ohm"):
        truth = getattr(trial.frames[-1], layer)
        nominal = float(np.asarray(getattr(trial.readings, f"nominal_{layer}")))
        assert np.mean(out[layer][-1]) == pytest.approx(np.mean(truth), rel=0.1)
        assert np.mean(truth) > 1.25 * nominal


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_skin_that_bends_is_followed(method: str) -> None:
    """Wires learned on a flat skin, then half as much again: errors return to what is stated."""
    random = np.random.default_rng(7)
    rest = skin_at_rest(8, 8, random)
    bent = replace(
        rest, top_wire_ohm=1.5 * rest.top_wire_ohm, bottom_wire_ohm=1.5 * rest.bottom_wire_ohm
    )
    frames = [touch(skin, 6, random) for skin in [rest] * 40 + [bent] * 60]
    out = estimate_file(trial_of(rest, frames).rounded(10), method)
    truth = np.array([skin.cell_siemens for skin in frames])
    away = np.abs(out["cell_siemens"] - truth) / out["cell_siemens_std"]
    pressed = truth > 1.5 * rest.cell_siemens
    assert np.mean(away[60:][pressed[60:]] < 4) > 0.97
    assert np.mean(away[80:][pressed[80:]] < 2) > 0.9
    assert np.mean(out["top_wire_ohm"][-1]) == pytest.approx(bent.top_wire_ohm.mean(), rel=0.15)


@pytest.mark.parametrize(("seed", "known"), [(0, True), (1, True), (0, False), (2, False)])
@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_finger_over_several_cells_is_followed(method: str, seed: int, known: bool) -> None:
    """Two seconds of a fingertip with soft edges, once around half the skin. known: the wires."""
    scene = Scene("moving", 8, 8, seed=seed)
    times_s = BEGIN_S + np.arange(180) / 90
    rest = scene.skin(0.0).top_wire_ohm, scene.skin(0.0).bottom_wire_ohm
    estimator = make_estimator(method, told(scene.rest_ratio, wires=known))
    errors, away, converged, shares = [], [], [], []
    for time_s in times_s:
        found = estimator.estimate(ten_bits(scene.ratio(time_s)))
        error = np.abs(found.cell_siemens - scene.skin(time_s).cell_siemens)
        errors.append((error / scene.skin(time_s).cell_siemens)[scene.touched(time_s)])
        away.append(error / found.cell_siemens_std)
        converged.append(found.converged)
        shares.append(found.cell_siemens.sum() / scene.skin(time_s).cell_siemens.sum())
    assert np.median(np.concatenate(errors)) < (0.03 if known else 0.06)
    assert np.mean(np.array(away) < 4) > 0.99
    assert np.mean(converged) > 0.97
    assert np.abs(np.array(shares) - 1).max() < (0.1 if known else 0.25)
    for believed, true in zip((found.top_wire_ohm, found.bottom_wire_ohm), rest, strict=True):
        assert not known or np.mean(believed) == pytest.approx(np.mean(true), rel=0.3)


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_jump_of_the_wires_is_followed(method: str) -> None:
    """Eight simulated skins, 40 touches each before and after all wires double.

    Five touches are too few to show that, at most: after them, deviations say what is not known.
    """
    away, errors = [], []
    for seed in range(8):
        random = np.random.default_rng(100 + seed)
        rest = skin_at_rest(8, 8, random)
        longer = replace(
            rest, top_wire_ohm=2 * rest.top_wire_ohm, bottom_wire_ohm=2 * rest.bottom_wire_ohm
        )
        frames = [touch(skin, int(random.integers(1, 9)), random) for skin in [rest] * 40]
        frames += [touch(skin, int(random.integers(1, 9)), random) for skin in [longer] * 40]
        trial = trial_of(rest, frames)
        out = estimate_file(trial.rounded(10), method)
        error = np.abs(out["cell_siemens"] - trial.cell_siemens)
        stds, pressed = error / out["cell_siemens_std"], trial.pressed
        away += stds[45:50][pressed[45:50]].tolist()
        errors += (error / trial.cell_siemens)[60:][pressed[60:]].tolist()
    assert np.mean(np.array(away) < 4) > 0.95
    assert np.median(errors) < 0.04


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_fingertip_on_a_skin_whose_wires_nobody_knows(method: str) -> None:
    """ngspice's readings of a soft finger that moves: no frame shows a multiple of its force."""
    rounded, skin = reference("finger_8x8")
    out = estimate_file(rounded, method)
    rest, truth = 1 / skin["rest_ohm"], 1 / skin["cell_ohm"]
    assert out["converged"].all()
    touched = (truth - rest).sum(axis=(1, 2)) > 5e-6
    rise = np.maximum(out["cell_siemens"] - rest, 0).sum(axis=(1, 2))[touched]
    share = rise / (truth - rest).sum(axis=(1, 2))[touched]
    assert np.quantile(share, 0.1) > 0.9
    assert np.quantile(share, 0.9) < 1.08
    assert share.max() < 1.3
    pressed = truth > 1.5 * rest
    error = np.abs(out["cell_siemens"] - truth)[pressed]
    assert np.median(error / truth[pressed]) < 0.025
    assert np.quantile(error / truth[pressed], 0.9) < 0.07
    assert np.mean(error < 4 * out["cell_siemens_std"][pressed]) > 0.99


@pytest.mark.parametrize("seed", [1, 3, 7])
@pytest.mark.parametrize("method", ["joint", "touch"])
def test_two_fingertips_over_much_of_a_skin_whose_wires_nobody_knows(
    method: str, seed: int
) -> None:
    """With rest more likely than a touch, long wires and few hard touches gave up to 1.5."""
    trial = finger_trial(8, 8, 20, 2000 + seed)
    assert trial.pressed.mean() > 0.3
    knowledge = replace(trial.rounded(10).knowledge(0), nominal_wire_ohm=WireOhm(lead=0.0))
    estimator, rest = make_estimator(method, knowledge), trial.rest.cell_siemens
    for ratio, truth in zip(trial.rounded(10).ratio, trial.cell_siemens, strict=True):
        found = estimator.estimate(ratio).cell_siemens
        assert (found - rest).sum() / (truth - rest).sum() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("seed", [5005, 5007])
def test_told_wires_do_not_mislead_under_two_large_fingertips(seed: int) -> None:
    """With rest more likely than a touch, the sum of all cells was up to 12 % too large."""
    sizes = {"sigma_cells": (1.0, 1.1), "peak_siemens": (3e-5, 2e-4)}
    trial = finger_trial(8, 8, 40, seed, **sizes)
    found = estimate_file(trial.rounded(10), "joint")["cell_siemens"]
    rise, truth = (
        (cells - trial.rest.cell_siemens).sum(axis=(1, 2)) for cells in (found, trial.cell_siemens)
    )
    np.testing.assert_allclose(rise / truth, 1, atol=0.08)


def test_wires_that_touch_reports_are_those_that_it_has_learned() -> None:
    """After a lesson, frames reported the wires of before the lesson, until the next one."""
    readings = bent_trial(8, 8, 8, 6, seed=6).rounded(10)
    estimator = make_estimator("touch", readings.knowledge(0))
    few = 0
    for ratio in np.repeat(readings.ratio, 2, axis=0):
        top_ohm = estimator.estimate(ratio).top_wire_ohm
        if np.ptp(top_ohm) == 0:  # a few touches explain it; the fit of `joint` has segments
            assert top_ohm[0, 0] == pytest.approx(estimator.wires().top)
            few += 1
    assert few > 3


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_wires_far_from_what_is_expected_are_learned(method: str) -> None:
    """Cells at rest that were fitted with 150 ohm pulled wires of 1 kOhm to 300."""
    for seed in range(3):
        trial = random_trial(8, 8, 6, 20, seed=seed, wire_ohm=(1000.0, 1000.0))
        knowledge = trial.rounded(10).knowledge(0)
        untold = replace(knowledge, nominal_wire_ohm=WireOhm(lead=0.0))
        estimator = make_estimator(method, untold)
        for ratio in trial.rounded(10).ratio:
            estimator.estimate(ratio)
        assert estimator.wires().both == pytest.approx((1000.0, 1000.0), rel=0.2)


class SilentFit:
    """A fit of a new touch, whose lesson says nothing."""

    log_cells = np.zeros(16)
    lesson = Lesson(np.full((4, 11), 1e-9), np.zeros(4), np.eye(4))


def test_a_lesson_that_says_nothing_asks_for_no_other_fit() -> None:
    """Whether fits before and after it expect the usual lead, or the one that is known."""
    belief = LearnedWires((4, 4), WireOhm())
    slopes = np.zeros((4, belief.means.size))
    slopes[0, 2] = 1 / 600
    strong = Lesson(belief.per_mean_std(slopes), np.array([1.6, 0.0, 0.0, 0.0]), np.eye(4))
    belief.take(strong)
    belief.expect_usual(False)
    known = belief.means[2]
    belief.expect_usual(True)
    assert abs(known - belief.means[2]) > 150  # what asks for another fit
    ports = PortReadings(np.zeros((4, 4)), np.zeros((4, 4)), np.ones((4, 4)))
    belief.expect_usual(False)
    assert not belief.after_fit(SilentFit(), ports)


@dataclass
class TellingFit:
    """A fit of a new touch, whose lesson is that the top layer resists much more than usual."""

    lesson: Lesson
    log_cells: Float = field(default_factory=lambda: np.zeros(16))


def test_a_frame_of_fingertips_is_not_fitted_again() -> None:
    """On 16x16, the second fit made the slowest frames, and gained nothing."""
    again = []
    for tip_log in (None, np.eye(4).ravel()):
        belief = LearnedWires((4, 4), WireOhm())
        slopes = np.zeros((4, belief.means.size))
        slopes[:2, 0] = 10.0
        lesson = Lesson(belief.per_mean_std(slopes), np.array([10.0, 10.0, 0.0, 0.0]), np.eye(4))
        ports = PortReadings(np.zeros((4, 4)), np.zeros((4, 4)), np.ones((4, 4)))
        again.append(belief.after_fit(TellingFit(lesson), ports, tip_log))
        assert belief.learned().top > 300.0
    assert again == [True, False]


def test_limits_of_untold_wires_count_as_more_deviations_until_frames_teach_them() -> None:
    belief, taught = LearnedWires((2, 2), WireOhm()), []
    unknown = belief.upper_limits()
    np.testing.assert_allclose(unknown.reach[:2], np.expm1(2 * UNKNOWN_LAYER_STD))
    np.testing.assert_allclose(unknown.stds, unknown.reach / [4, 4, 2])
    means = np.add(belief.means, [2.5, 0, 0, 0, 0, 0, 0])  # a layer of 1.8 kOhm
    for log_std in (0.45, 0.31, 0.29):
        belief._believe(means, np.diag([log_std, log_std, 200.0, 0.1, 0.1, 0.1, 0.1]) ** 2)
        taught.append(belief.upper_limits().reach[0] / belief.upper_limits().stds[0])
        assert belief.is_assumed == (log_std > 0.3)
        # The prior of usual layers has a heavy tail, so that it hardly pulls at what is known.
        assert abs(belief.means[0] - means[0]) < 0.1
    np.testing.assert_allclose(taught, [3, 0.62 / 0.3, 2])
    told = LearnedWires((2, 2), WireOhm(100.0, 200.0, 0.0, 1.0, 1.0))
    np.testing.assert_allclose(told.upper_limits().reach / told.upper_limits().stds, 2)
    assert told.means_std()[0] == pytest.approx(np.hypot(1.0, LAYER_STD))  # no usual ones


def learned(by_mean: Float, noise: Float, at: Float, faded: Float) -> tuple[float, Float, Float]:
    """Likelihood of a residual, what the mean gains, and its covariance after it (Kalman)."""
    expected = by_mean @ faded @ by_mean.T + noise
    likelihood = scipy.stats.multivariate_normal(np.zeros(len(at)), expected).pdf(at)
    gain = faded @ by_mean.T @ np.linalg.inv(expected)
    return float(likelihood), gain @ at, faded - gain @ by_mean @ faded


def mixture(weights: Float, means: Float, covariances: Float) -> tuple[Float, Float]:
    """Mean and covariance of two, (2, n) and (2, n, n)."""
    shares = weights / weights.sum()
    mean = shares @ means
    apart = means - mean
    spread = np.einsum("i,ij,ik->jk", shares, apart, apart)
    return mean, np.tensordot(shares, covariances, 1) + spread


def wires_of(means: Float) -> Float:
    """Logs of the 12 segments and the 5 leads of a 2x3 skin."""
    segments = np.repeat(means[:2], 6) + (means[8:] if means.size > 8 else 0.0)
    return np.concatenate([segments, means[2] * (1 + means[3:8])])


@pytest.mark.parametrize("segments", [0, 12])
def test_the_belief_of_wires_is_of_a_steady_filter_and_a_wary_one(segments: int) -> None:
    """Against the textbook's covariance form and likelihood: three lessons.

    After the first, single segments are to be learned, or not.
    """
    random = np.random.default_rng(8)
    belief = LearnedWires((2, 3), WireOhm(100.0, 200.0, lead=50.0, lead_std_ohm=20.0))
    prior = np.diag([LAYER_STD, LAYER_STD, 20.0, *[SEGMENT_STD] * 5]) ** 2
    before = mean = steady_mean = wary_mean = np.array(
        [np.log(100.0), np.log(200.0), 50.0, *[0] * 5]
    )
    covariance = steady = wary = prior
    scores, own = np.zeros(2), SEGMENT_STD**2 * np.eye(segments)
    for lesson in range(3):
        if segments and lesson == 1:
            belief.learn_segments()
            before, mean, steady_mean, wary_mean = (
                np.concatenate([each, np.zeros(segments)])
                for each in (before, mean, steady_mean, wary_mean)
            )
            covariance, steady, wary = (
                scipy.linalg.block_diag(each, own) for each in (covariance, steady, wary)
            )
        by_mean, at_mean = random.normal(size=(4, mean.size)), random.normal(size=4)
        by_mean[:, 2] *= 0.01
        noise = np.diag(random.uniform(1, 2, 4))
        factor = np.linalg.cholesky(noise)
        belief.take(Lesson(belief.per_mean_std(by_mean), at_mean, factor))

        layers = np.diag(np.maximum(np.diag(steady)[:2], LAYER_STD**2))
        drifted = scipy.linalg.block_diag(layers, steady[2:8, 2:8])
        if mean.size > 8:
            drifted = scipy.linalg.block_diag(drifted, own)
        faded = steady + STEADY_FADE * (drifted - steady)
        residual = at_mean - by_mean @ (steady_mean - mean)
        of_steady, moved, steady = learned(by_mean, noise, residual, faded)
        steady_mean = steady_mean + moved

        changed = scipy.linalg.block_diag(np.eye(2) * USUAL_LAYER_STD**2, wary[2:, 2:])
        residual = at_mean - by_mean @ (wary_mean - mean)
        both = [learned(by_mean, noise, residual, faded) for faded in (wary, changed)]
        likelihoods, moves, covariances = (np.array(each) for each in zip(*both, strict=True))
        of_both = np.array([1, CHANGED_ODDS]) / (1 + CHANGED_ODDS) * likelihoods
        wary_mean, wary = mixture(of_both, wary_mean + moves, covariances)

        scores = MEMORY * scores + np.log([of_steady, of_both.sum()])
        weights = np.array([1, WARY_ODDS]) * np.exp(scores)
        mean, covariance = mixture(
            weights, np.array([steady_mean, wary_mean]), np.array([steady, wary])
        )
    wary_std = np.hypot(np.sqrt(np.diag(wary)), wary_mean - mean)[:2]
    layer_std = np.sqrt(np.diag(covariance))[:2]
    reach = [*np.expm1(2 * np.maximum(wary_std, layer_std)), 2 * covariance[2, 2] ** 0.5]
    for usual in (True, False):
        belief.expect_usual(usual)
        np.testing.assert_allclose(belief.upper_limits().reach, reach)
    np.testing.assert_allclose(belief.means_std(), np.sqrt(covariance.diagonal()))
    np.testing.assert_allclose(belief.expected_wires, wires_of(mean), rtol=1e-9)
    # How wires follow the means: by differences.
    n = mean.size
    steps = 1e-6 * np.eye(n)
    by_means = np.array([(wires_of(mean + s) - wires_of(mean - s)) / 2e-6 for s in steps]).T
    ports = np.array([1, 4])  # of row 0 and column 1, of row 1 and column 1
    by_segment = random.normal(size=(2, 12))
    slopes = np.hstack([by_segment, [[1, 0, 0, 1, 0], [0, 1, 0, 1, 0]]])  # by all wires
    unlearned = np.diag(np.repeat([0.0 if segments else SEGMENT_STD, 0.0], (12, 5))) ** 2
    of_wires = by_means @ covariance @ by_means.T + unlearned
    root = belief.per_std(by_segment, belief.by_means(by_segment, belief.means, ports))
    np.testing.assert_allclose(root @ root.T, slopes @ of_wires @ slopes.T, rtol=1e-6)
    np.testing.assert_allclose(root[:, -n:], belief.per_mean_std(slopes @ by_means), rtol=1e-6)
    stds = np.sqrt(of_wires.diagonal())[:12].reshape(2, 2, 3)
    np.testing.assert_allclose(np.broadcast_to(belief.segment_std(), stds.shape), stds, rtol=1e-6)
    away, of_own = 0.1 * random.normal(size=n), SEGMENT_STD * random.normal(size=12)
    expected = wires_of(mean + np.linalg.cholesky(covariance) @ away)
    expected[:12] += of_own
    np.testing.assert_allclose(belief.wires_off(away, of_own), expected, rtol=1e-9)
    some = random.normal(size=(3, n))
    moved = belief.moved_since(before, belief.per_mean_std(some))
    np.testing.assert_allclose(moved, some @ (mean - before), rtol=1e-9)


def test_still_wires_are_known_better_than_wires_that_were_bent() -> None:
    """Twenty lessons of the same wires, then five of wires that are twice as large."""
    random = np.random.default_rng(3)
    belief = LearnedWires((2, 3), WireOhm(100.0, 200.0, lead=0.0))
    stds, errors = [], []
    for lesson in range(25):
        true = np.array([np.log(130.0), np.log(170.0), 0.0])
        true[:2] += np.log(2.0) * (lesson >= 20)
        slopes = np.zeros((4, belief.means.size))
        slopes[:, :3] = random.normal(size=(4, 3)) * (5.0, 5.0, 0.01)
        residual = slopes[:, :3] @ (true - belief.means[:3]) + random.normal(size=4)
        belief.take(Lesson(belief.per_mean_std(slopes), residual, np.eye(4)))
        stds.append(belief.means_std()[:2].max())
        errors.append(np.abs(belief.means[:3] - true)[:2].max())
    assert stds[19] < 0.07
    assert max(stds[20:]) > 1.7 * stds[19]
    assert errors[24] < 0.15


def test_a_calmer_frame_teaches_in_place_of_the_first() -> None:
    """The belief is that of a skin that the first frame of the touch never taught."""
    random = np.random.default_rng(9)
    # Of three frames, by the means.
    slopes = random.normal(size=(3, 5, 8)) * (1.0, 1.0, 0.01, 1.0, 1.0, 1.0, 1.0, 1.0)
    residual, noise = random.normal(size=(3, 5)), np.diag(random.uniform(1, 2, 5))
    nominal = np.array([np.log(100.0), np.log(200.0), 50.0, *np.zeros(5)])

    def teach(belief: LearnedWires, frame: int, *, replace_last: bool = False) -> None:
        at_mean = residual[frame] - slopes[frame] @ (belief.means - nominal)
        lesson = Lesson(belief.per_mean_std(slopes[frame]), at_mean, np.linalg.cholesky(noise))
        belief.take(lesson, replace_last=replace_last)

    taught, never = (LearnedWires((2, 3), WireOhm(100.0, 200.0, lead=50.0)) for _ in range(2))
    teach(taught, 0)
    teach(taught, 1)
    teach(taught, 2, replace_last=True)
    teach(never, 0)
    teach(never, 2)
    np.testing.assert_allclose(taught.means, never.means, rtol=1e-9)
    np.testing.assert_allclose(
        taught.per_mean_std(np.eye(8)), never.per_mean_std(np.eye(8)), atol=1e-9
    )


def test_a_touch_alone_does_not_take_the_lesson_before_it_away() -> None:
    belief = LearnedWires((2, 3), WireOhm(100.0, 200.0, lead=50.0))
    slopes = np.array([[1.0, 1.0, 0.01, *[1.0] * 5]] * 2)
    lesson = Lesson(belief.per_mean_std(slopes), np.ones(2), 3.0 * np.eye(2))
    belief.take(lesson)
    taught = belief.means
    nothing = Lesson(np.zeros((0, 8)), np.zeros(0), np.zeros((0, 0)))
    belief.take(nothing)
    belief.take(nothing, replace_last=True)
    np.testing.assert_array_equal(belief.means, taught)
    belief.take(lesson, replace_last=True)
    assert np.all(np.abs(belief.means) > np.abs(taught))


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_noise_as_a_touch_begins_does_not_spoil_what_it_teaches(method: str) -> None:
    """Each touch: one frame with 12 LSB of noise, one without; wires 35 % above nominal."""
    trial, random = bent_trial(8, 8, 8, 30, seed=6), np.random.default_rng(1)
    readings = trial.rounded(10)
    estimators = [make_estimator(method, readings.knowledge(0)) for _ in range(2)]
    for ratio in readings.ratio:
        noise = 12 / 1024 * random.standard_normal(ratio.shape)
        estimators[0].estimate(ten_bits(np.clip(ratio + noise, 0, 1)))
        for estimator in estimators:
            estimator.estimate(ratio)
    noisy, calm = (estimator.wires() for estimator in estimators)
    assert noisy[:2] == pytest.approx(calm[:2], rel=0.1)
    assert noisy[3:5] == pytest.approx(calm[3:5], rel=0.3)


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_frames_of_one_touch_do_not_teach_twice(method: str) -> None:
    """A calmer frame takes the place of the one before, one that is no calmer teaches nothing.

    Were each of these five a lesson, 3 to 11 % less would be left of what is not known.
    """
    readings, random = bent_trial(8, 8, 8, 1, seed=6).rounded(10), np.random.default_rng(1)
    ratio, known = readings.ratio[0], []
    calm, estimator = (make_estimator(method, readings.knowledge(0)) for _ in range(2))
    for noise_lsb in (3.0, 1.5, 1.0, 0.7, 0.0, 0.0):
        noise = noise_lsb / 1024 * random.standard_normal(ratio.shape)
        estimator.estimate(ten_bits(np.clip(ratio + noise, 0, 1)))
        known.append(estimator.wires())
    assert len(set(known)) == 5
    assert known[4] == known[5]
    calm.estimate(ratio)
    assert known[4][3:5] == pytest.approx(calm.wires()[3:5], rel=0.02)


def test_a_lesson_of_few_touches_errs_by_as_much_as_it_states() -> None:
    """Cells at rest drift, and move several ports alike. As noise of each, it erred 2.5 times so.

    By the node Laplacian, with wires as they are believed, of which single segments differ.
    """
    random, shape, wires = np.random.default_rng(3), (8, 8), (50.0, 600.0)
    belief = LearnedWires(shape, WireOhm(*wires, 0.0))
    rest_log, by_means = np.full(64, -np.log(5e-6)), np.zeros((64, belief.means.size))
    prior = CellPrior(rest_log, np.full(64, REST_STD), by_means, belief.means)
    finder, layers = SparseFit(prior, belief, 6e4), np.reshape(wires, (2, 1, 1))
    off_stds = []
    for _ in range(150):
        cells = np.exp(REST_STD * random.standard_normal(64) - rest_log)
        cells[random.choice(64, 4, replace=False)] = random.uniform(1e-4, 4e-4, 4)
        wires_ohm = layers * np.exp(SEGMENT_STD * random.standard_normal((2, *shape)))
        skin = Skin(cells.reshape(shape), *wires_ohm)
        ratio = ten_bits(SkinCircuit(skin).readings(skin.cell_siemens)[..., :4])
        few = finder.find(PortReader(told(ratio)).read(ratio))
        if few is not None and (touched := few.explain()):
            slopes, residual, factor = touched.lesson
            both = np.column_stack([slopes[:, :2], residual])
            whitened = scipy.linalg.solve_triangular(factor, both, lower=True)
            layer = whitened[:, :2]
            off_stds.append(whitened[:, 2] @ layer / np.linalg.norm(layer, axis=0))
    assert len(off_stds) > 100
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(off_stds), axis=0)), 1.0, atol=0.2)
