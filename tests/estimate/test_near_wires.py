# SPDX-License-Identifier: Apache-2.0
"""What near ends teach of the wires: lessons, and the two filters that take them."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from network import SkinCircuit  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, port_resistance_ohm, readings
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
from ohmskin.estimate.sparse_fit import SparseFit
from ohmskin.estimate.wire_belief import Lesson
from skins import ten_bits, told
from studies.trials import bent_trial


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
    np.testing.assert_allclose(unknown.stds, unknown.reach / [4.5, 4.5, 2])
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
        both_means = wary_mean + moves
        wary_mean, wary = mixture(of_both, both_means, covariances)

        scores = MEMORY * scores + np.log([of_steady, of_both.sum()])
        weights = np.array([1, WARY_ODDS]) * np.exp(scores)
        mean, covariance = mixture(
            weights, np.array([steady_mean, wary_mean]), np.array([steady, wary])
        )
    # The means of a layer that the mixture exceeds as seldom as a normal exceeds two deviations.
    shares = np.array([weights[0], *weights[1] * of_both / of_both.sum()]) / weights.sum()
    of_parts = np.array([steady, *covariances])
    logs, limit_stds = np.linspace(-3.0, 3.0, 60001), []
    for layer in range(2):
        centres = np.array([steady_mean[layer], *both_means[:, layer]]) - mean[layer]
        below = scipy.stats.norm.cdf(logs[:, None], centres, of_parts[:, layer, layer] ** 0.5)
        limit = np.interp(scipy.stats.norm.cdf(2), below @ shares, logs)
        limit_stds.append(limit / 2)
    layer_std = np.sqrt(np.diag(covariance))[:2]
    reach = [*np.expm1(2 * np.maximum(limit_stds, layer_std)), 2 * covariance[2, 2] ** 0.5]
    for usual in (True, False):
        belief.expect_usual(usual)
        np.testing.assert_allclose(belief.upper_limits().reach, reach, rtol=1e-6)
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


def test_what_few_touches_model_is_what_their_circuit_gives() -> None:
    """The last step is forecast, and the circuit not solved again. With wires of an ohm."""
    random, shape, off_stds = np.random.default_rng(4), (8, 8), []
    belief, wires_ohm = LearnedWires(shape, WireOhm(1.0, 1.0, 0.0)), np.ones((2, *shape))
    rest_log, by_means = np.full(64, -np.log(5e-6)), np.zeros((64, belief.means.size))
    prior = CellPrior(rest_log, np.full(64, REST_STD), by_means, belief.means)
    finder = SparseFit(prior, belief, 6e4)
    for _ in range(100):
        cells = np.exp(-rest_log)
        cells[random.choice(64, 6, replace=False)] = np.geomspace(1e-4, 3e-3, 6)
        ratio = ten_bits(readings(Skin(cells.reshape(shape), *wires_ohm)))
        ports = PortReader(told(ratio)).read(ratio)
        few = finder.find(ports)
        if few is not None and (touched := few.explain()):
            answer = Skin(np.exp(-touched.log_cells).reshape(shape), *wires_ohm)
            off = touched.modelled - 1 / (port_resistance_ohm(answer).ravel() + 6e4)
            off[touched.cells] = 0  # what they read is noise as well
            off_stds.append(np.abs(off / ports.current_std.ravel()).max())
    assert len(off_stds) > 50
    assert 1e-3 < np.max(off_stds) < 0.1


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
