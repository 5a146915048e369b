# SPDX-License-Identifier: Apache-2.0
"""The wires, learned: what touches that share wires say of them at near ends.

Symbols, beside those of `wire_belief`

====== ========== =============================================================== ==========
symbol shape      meaning                                                         unit
====== ========== =============================================================== ==========
H      (k, n)     slope of these readings by the means, J L^T, whitened by N
S      (k, k)     covariance of the whitened readings, 1 + H V H^T                1
z      (k,)       whitened residual of these readings at the mean                 1
====== ========== =============================================================== ==========

A lesson is one step of a Kalman filter,

    m += V H^T S^-1 z ,     V -= V H^T S^-1 H V .

No lead is below 0. So a mean lead that comes out below 0 is moved to 0, and what V says of it is
taken for the other means.

The first frame of a touch is noisy, as it changes. A calmer one of the same touch takes its place:
its step starts from m and V as they were before the touch. Cells at the edge of a fingertip hide
in all its frames alike: so it is the same touch until it has moved by about its width.

A single touch reveals nothing of the wires, because its own resistance is in the same reading. So N
holds the touched cells as noise without limit. A lead is in all readings of its line, so each
line's own is learned. What single segments differ from their means by matters where wires resist
much (`joint.LEARNED_LINE_OHM`), and only there is it learned: it costs time.

A skin bends. So there are two filters. The steady one is for a skin that lies still, as most do:
before a lesson, a small share of what it knows of the layers and of single segments fades, so that
it follows a slow drift. The wary one takes each lesson twice: for wires that are what they were,
and, with the odds `CHANGED_ODDS`, for wires that have changed since the last lesson, so that no
more is known of the layers than a factor of two (of a skin that may not be bent: than was told).
It goes on with the mixture of both, by its mean and its covariance. (Such a filter is called
generalized pseudo-Bayesian, of first order: Bar-Shalom, Li, Kirubarajan, *Estimation with
Applications to Tracking and Navigation*, chapter 11.)

The odds of a mixture are those before the lesson, times the exponential of a difference of scores.
A score says how well the lesson was expected: it is the log likelihood, without terms that all have
in common,

    score = - (z . S^-1 z + log det S) / 2 .

What is believed is the mixture of both filters, with the odds `WARY_ODDS` of the wary one before
any lesson. A filter adds up its scores, and at each lesson the sum keeps the share `MEMORY` of what
it was.

Most lessons say too little to show a change. A fit takes what is believed, which has the least
error on a skin that lies still. But if wires have just grown longer, cells conduct more than they
seem to. The deviation of a mixture hardly shows a part that is unlikely and far away. So the upper
limit of a layer is that of the mixture itself: the log that it exceeds as seldom as a normal
exceeds `REACH_STDS` deviations,

    sum_i p_i Phi((m_i - limit) / s_i) = Phi(-REACH_STDS) ,

where each part i (steady; wary, stayed; wary, changed) has the probability p_i and a normal.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.small import cholesky, solve_lower
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    CHANGED_ODDS,
    LAYER_STD,
    MEMORY,
    REACH_STDS,
    STEADY_FADE,
    USUAL_LAYER_STD,
    USUAL_LEAD_STD_OHM,
    WARY_ODDS,
    likeness,
)
from ohmskin.estimate.wire_belief import LARGE_MOVE_LOG, Fit, Lesson, WireBelief

# A fingertip is the same as that of the last lesson if both are more alike. Chosen: on 16x16, it
# has to move by about its width.
SAME_TIP: Final = 0.6
# The limit is between those of the parts. This interval is halved so often. Chosen: it is found to
# a billionth.
_HALVINGS: Final = 30


class _Filter(NamedTuple):
    """A filter: m and V; score: the sum of how well it has expected the lessons."""

    means: Float
    covariance: Float
    score: float = 0.0


def _stepped(before: _Filter, covariance: Float, slopes: Float, residual: Float) -> _Filter:
    """This filter after a lesson, before which its V is `covariance` (n, n).

    slopes: H, (k, n). residual: z at the filter's own m, (k,).
    """
    by_means = slopes @ covariance
    expected = by_means @ slopes.T
    np.einsum("ii->i", expected)[:] += 1.0
    factor = cholesky(expected)
    whitened = solve_lower(factor, np.hstack([by_means, residual[:, None]]))
    gain, misses = whitened[:, :-1], whitened[:, -1]
    score = -0.5 * float(misses @ misses) - float(np.log(factor.diagonal()).sum())
    means, covariance = before.means + misses @ gain, covariance - gain.T @ gain
    # The most probable means without a lead below 0: else such a lead, of minus some kilohms, would
    # explain touches behind long wires.
    means -= min(means[2] / covariance[2, 2], 0.0) * covariance[2]
    return _Filter(means, covariance, MEMORY * before.score + score)


def _mixture(one: _Filter, other: _Filter, odds: float) -> tuple[_Filter, float]:
    """Mean and covariance of both, and the share of the other.

    odds: of the other to the one, before their scores.
    """
    log_odds = math.log(odds) + other.score - one.score
    share = 1.0 / (1.0 + math.exp(min(-log_odds, 500.0)))
    apart = other.means - one.means
    covariance = (1 - share) * one.covariance + share * other.covariance
    covariance += share * (1 - share) * np.outer(apart, apart)
    score = one.score + np.logaddexp(0.0, log_odds) - math.log1p(odds)
    return _Filter(one.means + share * apart, covariance, float(score)), share


def _exceeded(parts: Sequence[tuple[float, float, float]], stds: float) -> float:
    """What a mixture of normals exceeds as seldom as one normal exceeds so many deviations.

    parts: of each, its share, mean and standard deviation.
    """
    chance = NormalDist().cdf(-stds)
    alone = [mean + stds * std for _, mean, std in parts]
    low, high = min(alone), max(alone)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        tails = (share * math.erfc((middle - mean) / std / 2**0.5) for share, mean, std in parts)
        low, high = (middle, high) if 0.5 * sum(tails) > chance else (low, middle)
    return high


class LearnedWires(WireBelief):
    """Wires at near ends: touches that share wires reveal the layers, a Kalman step a touch."""

    def reset(self) -> None:
        """Back to the nominal wires; single segments in m, too, are nominal ones again."""
        super().reset()
        self._lesson_noise = np.inf  # deviations of the last lesson's currents, in sum [S]
        # How cells rose under the fingertips of the last lesson, or 0, (RC,).
        self._tip_log = np.zeros(self.leads_of_ports.shape[0])
        known = _Filter(self._known.means, self._known.covariance)
        self._filters = self._before_lesson = [known] * 2
        # Of what the last lesson has left: the share of each part, and its filter.
        self._parts = [(1.0, known)]

    def learn_segments(self) -> None:
        """As of any belief. Each filter learns them."""
        super().learn_segments()

        def with_segments(one: _Filter) -> _Filter:
            means = np.concatenate([one.means, self._nominal[self._of_segments]])
            return _Filter(means, self._with_segments(one.covariance), one.score)

        self._filters, self._before_lesson = (
            [with_segments(one) for one in filters]
            for filters in (self._filters, self._before_lesson)
        )

    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Nothing: before its touches are known, a frame of near ends shows no wires."""

    def fix_rest_wires(self) -> None:
        """Nothing: an untouched skin shows no wires, as its cells resist far more than they do."""

    def after_fit(
        self, fit: Fit, ports: PortReadings, tip_log: Float | None = None, *, again: bool = False
    ) -> bool:
        """Learn from a touch that is new, or again from a calmer frame of the last one.

        The calmer frame must not count as one more, since both have the touch's errors. So it takes
        the place of the other. So does a harder frame of a fingertip that has hardly moved.
        """
        noise, is_news = float(ports.current_std.sum()), self._has_moved(fit.log_cells)
        tip = np.zeros_like(fit.log_cells) if tip_log is None else tip_log
        if is_news and likeness(tip, self._tip_log) > SAME_TIP:
            is_news, tells_more = False, bool(tip @ tip > self._tip_log @ self._tip_log)
        else:
            tells_more = is_news or noise < self._lesson_noise
        if not (again or tells_more):
            return False
        self._lesson_cells, self._lesson_noise, self._tip_log = fit.log_cells, noise, tip
        before = self._known.means
        self.take(fit.lesson, replace_last=again or not is_news)
        moved = np.abs(self._known.means - before)[:3]
        moves = moved > [LARGE_MOVE_LOG, LARGE_MOVE_LOG, USUAL_LEAD_STD_OHM]
        # Under fingertips, more fits take long on large skins, and gain nothing.
        return bool(moves.any()) and tip_log is None

    def take(self, lesson: Lesson, *, replace_last: bool = False) -> None:
        """One Kalman step.

        replace_last: undo the last lesson first, by a step from where that lesson started. A lesson
            that says nothing undoes nothing.
        """
        if not replace_last:
            self._before_lesson = self._filters
        per_mean_std, residual, factor = lesson
        # The unknown resistance of its touch explains a single reading: it says nothing of wires.
        if len(residual) < 2:
            return
        # The lesson is counted in deviations of the belief that the fit had, but the step may start
        # from an older belief. So its slopes are first brought to logs.
        slopes = solve_lower(self._root, per_mean_std.T, transposed=True).T
        both = solve_lower(factor, np.hstack([slopes, residual[:, None]]))
        if len(both) > both.shape[1]:  # the same sums of squares and of products, in fewer rows
            both = np.asarray(np.linalg.qr(both, mode="r"), np.float64)
        slopes, residual = both[:, :-1], both[:, -1]

        def stepped(before: _Filter, covariance: Float) -> _Filter:
            here = residual - slopes @ (before.means - self.means)
            return _stepped(before, covariance, slopes, here)

        steady, wary = map(self._dried, self._before_lesson)
        steady = stepped(steady, self._faded(steady))
        stayed, changed = stepped(wary, wary.covariance), stepped(wary, self._changed(wary))
        wary, share = _mixture(stayed, changed, CHANGED_ODDS)
        self._filters = [steady, wary]
        believed, of_wary = _mixture(steady, wary, WARY_ODDS)
        shares = 1.0 - of_wary, of_wary * (1.0 - share), of_wary * share
        self._parts = list(zip(shares, (steady, stayed, changed), strict=True))
        self._believe(believed.means, believed.covariance)

    def _faded(self, before: _Filter) -> Float:
        """V of a filter before a lesson, (n, n), if wires may have drifted since the last one."""
        told = np.minimum(np.diagonal(self._prior_covariance)[:2], LAYER_STD**2)
        widened, own = self._widened(before, told), self._of_segments
        widened[own] = widened[:, own] = 0.0
        widened[own, own] = self._prior_covariance[own, own]
        return before.covariance + STEADY_FADE * (widened - before.covariance)

    def _changed(self, before: _Filter) -> Float:
        """The same, if they have changed altogether."""
        layers = np.full(2, USUAL_LAYER_STD**2)
        if not self._may_be_bent:
            layers = np.minimum(layers, np.diagonal(self._prior_covariance)[:2])
        return self._widened(before, layers)

    def _widened(self, before: _Filter, layers: Float) -> Float:
        """V (n, n), if of the layers no more is known than these variances (2,)."""
        covariance = before.covariance.copy()
        covariance[:2] = covariance[:, :2] = 0.0
        variances = np.diagonal(before.covariance)[:2]
        covariance[:2, :2] = np.diag(np.maximum(variances, layers))
        return covariance

    def _dried(self, before: _Filter) -> _Filter:
        """This filter, with leaks that are no better known than at first: a damp skin dries."""
        if not self.has_leaks:
            return before
        covariance, leaks = before.covariance.copy(), self._of_leaks
        covariance[leaks] = covariance[:, leaks] = 0.0
        first, now = np.diagonal(self._prior_covariance), np.diagonal(before.covariance)
        covariance[leaks, leaks] = np.diag(np.maximum(first, now)[leaks])
        return before._replace(covariance=covariance)

    def _layer_limit_stds(self) -> Float:
        limits = []
        for layer in range(2):
            of_layer = [
                (share, part.means[layer], math.sqrt(part.covariance[layer, layer]))
                for share, part in self._parts
            ]
            limits.append(_exceeded(of_layer, REACH_STDS) - self._known.means[layer])
        return np.array(limits) / REACH_STDS
