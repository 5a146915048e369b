# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin that was pressed anywhere: those with which one curve fits the total forces.

With wrong wires, cells far from the electrodes and cells under much force seem too soft or too
hard, so that no single curve, with a gain for each cell, fits the total forces.

Symbols

====== ======= ========================================================================= =======
symbol shape   meaning                                                                   unit
====== ======= ========================================================================= =======
u      (2,)    logs of a top and of a bottom segment                                     1
w      (2,)    change of a top and of a bottom segment, as a share of itself             1
L              -log of how likely the total forces are (`TotalFit.misfit`), for a press  1
====== ======= ========================================================================= =======

In a trial, the wires are held at some u, an estimator shows the scans, and a `TotalFit` has L. It
also tells w (`TotalFit.wires`). Presses tell ohms, so the next trial is at u + log(1 + w). Where w
is below 0, it is at u + w, because 1 + w may be below 0. If L of all presses together is then
larger by more than `LIKELY`, that was too far, and half of the way is tried.

Few presses tell little of the wires, so what is taken at last is no maximum but the mean of all
wires that they do not exclude (`likely_wires`). Behind wires that are too large, the cells under
much force conduct without limit, which w says nothing of. So the mean, too, is tried, once.

Without any force, the scans teach wires, too, because each touch has several cells. Where they are
sure of them (`SURE_LEAD`), and nobody has told any, these wires count as told: the search begins
with them, and they are the prior. In the total force, a lead looks like a resistance in series with
each contact. So the lead is what the scans teach.

A loose crimp gives one line a lead that the others have not. After the first trials, each line is
asked for its own lead, which is one more w. The oddest one is taken off, and trials go on with it.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.scale import Scale
from ohmskin.calibrate.totals import TotalFit, Totals
from ohmskin.calibrate.wires import (
    ODD_LINES,
    UNTOLD_LEAD_STD_OHM,
    FoundWires,
    unclear_layers,
    wire_prior,
)
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.prior import LAYER_STD, USUAL_LEAD_STD_OHM

# A trial takes as many scans as have about so many cells together: the first number in the first
# trials, the second one after a short step. Chosen: 16x16 cells then take some minutes.
FIRST_CELLS, TRIAL_CELLS = 60_000, 240_000
# After the first trial with either number of scans there are at most so many others. The steps are
# logs: the longest one that is taken, the one below which trials take more cells, and the one below
# which they end.
TRIALS, LONGEST_STEP, SHORT_STEP, LAST_STEP = 6, 1.5, 0.5, 0.1
# Trials also end at a step below so many standard deviations of the wires, with the first number of
# scans and with the second. Chosen: the presses do not tell the wires better.
CLOSE_STDS: Final = (1.0, 0.7)
# Segments of which neither somebody nor the scans have told are at most this in the first trial
# [ohm]. Chosen: from there, steps lead to the wires that textiles have. With wires that are far too
# large, cells under much force conduct without limit.
START_OHM: Final = 50.0
# Scans teach wires if they make the lead surer than by this factor, or know both layers to
# `LAYER_STD`. Chosen: touches with sharp edges do the first, and large wires the second. Cells at a
# soft edge look untouched and are not, which passes for wires.
SURE_LEAD: Final = 0.5
# L of all presses together may grow by so much with a step, or to the mean. Chosen: a mean is about
# so far from the most likely wires.
LIKELY: Final = 3.0
# The mean of the wires is that of so many trial values of each layer, up to so many deviations from
# the most likely one, which is this share of what was held at least. Chosen: fine enough for 1 %,
# and as far as the prior reaches.
GRID_POINTS, GRID_STDS, LEAST_SHARE = 121, 6.0, 0.2
# A lead is odd if it is so many deviations off. Chosen: on simulated skins without an odd one, the
# oddest line is off by up to 1.6, and a line with a crimp of 1.5 kOhm by 4 and more.
ODD_LEAD_STDS: Final = 3.0
# Deviations of the logs of segments, and of the lead [ohm], that are held, in trials and in the
# last reading. Chosen: so small that no scan teaches others.
HELD_LOG_STD, HELD_LEAD_STD_OHM = 1e-3, 1e-3


class Shown(NamedTuple):
    """What an estimator shows of the scans that is told some wires.

    slopes: how its rises follow both layers and each lead, d log x / dw, (2+R+C, m, C).
    scans: the m scans of these slopes; all others have none, because nothing is pressed.
    wires: these wires, with what the scans have taught.
    """

    totals: Totals
    slopes: Float
    scans: NDArray[np.intp]
    wires: WireOhm

    def by_wires(self, wanted: list[int]) -> Float:
        """Slopes of all scans by these k wires, (k, n, C)."""
        slopes = np.zeros((len(wanted), *self.totals.rise.shape))
        slopes[:, self.scans] = self.slopes[wanted]
        return slopes


class _Trial(NamedTuple):
    """A trial: u, what an estimator shows, the fit, L, w and the covariance of w, (2, 2)."""

    held: Float
    shown: Shown
    fit: TotalFit
    misfit: float
    change: Float
    covariance: Float

    @property
    def step(self) -> Float:
        """The step of u to the next trial, (2,). To smaller wires, w is the step."""
        longer = np.log1p(np.maximum(self.change, 0.0))
        step = np.where(self.change > 0, longer, self.change)
        return np.asarray(step.clip(-LONGEST_STEP, LONGEST_STEP))

    def is_close(self, short: float, stds: float) -> bool:
        """Whether the step is short, or below so many of its deviations."""
        least = np.maximum(short, stds * np.sqrt(self.covariance.diagonal()))
        return bool((np.abs(self.step) < least).all())

    def is_likely(self, best: "_Trial") -> bool:
        """Whether it is about as likely as the best one so far, or more."""
        return self.misfit <= best.misfit + LIKELY / best.fit.presses


class WireSearch:
    """Looks for the wires.

    told: what was told of them. shape: (R, C).
    show: what an estimator shows that is told the given wires, and what single leads have above
        them (R+C,), in scans that have about so many cells together at most.
    """

    def __init__(
        self, told: WireOhm, shape: tuple[int, int], show: Callable[[WireOhm, Float, int], Shown]
    ) -> None:
        self._told, self._shape = told, shape
        self._show, self._most_cells = show, FIRST_CELLS
        self._own_ohm = np.zeros(sum(shape))
        self._scale: Scale | None = None

    def found(self) -> FoundWires:
        """The wires. Raises ValueError where the force does not follow the skin."""
        start = self._taught()
        best = self._nearest(self._trial(start), SHORT_STEP, CLOSE_STDS[0])
        best = self._with_odd_leads(best)
        # L of more scans is not to be compared with that before, nor L of another filter, which is
        # kept from the first trial near the wires on. So a step that is not short is not taken: it
        # may be one that was too far.
        self._most_cells = TRIAL_CELLS
        step = best.step * best.is_close(SHORT_STEP, CLOSE_STDS[0])
        best = self._nearest(self._trial(best.held + step), LAST_STEP, CLOSE_STDS[1])
        u, stds = likely_wires(best.held, best.change, best.covariance, self._centre, self._std)
        if np.abs(u - best.held).max() > LAST_STEP:
            trial = self._trial(u)
            best = trial if trial.is_likely(best) else best
            u = best.held
        (top_ohm, bottom_ohm), (top_std, bottom_std) = np.exp(u).tolist(), stds.tolist()
        lead_ohm, lead_std_ohm = self._lead
        wires = WireOhm(top_ohm, bottom_ohm, lead_ohm, top_std, bottom_std, lead_std_ohm)
        unclear = unclear_layers(u, stds, self._shape)
        own_ohm = self._own_ohm if self._own_ohm.any() else None
        return FoundWires(wires, self._told, best.fit.presses, unclear, own_ohm)

    def _taught(self) -> Float:
        """u of the first trial. Takes the lead, and the prior, that the scans alone teach."""
        lead_ohm, lead_std_ohm = self._told.lead_or_usual(USUAL_LEAD_STD_OHM)
        told = self._told._replace(lead=lead_ohm, lead_std_ohm=lead_std_ohm)
        taught = self._show(told, self._own_ohm, FIRST_CELLS).wires
        self._lead = taught.lead_or_usual(USUAL_LEAD_STD_OHM)
        stds = [LAYER_STD if std is None else std for std in taught[3:5]]
        is_sure = self._lead[1] < SURE_LEAD * lead_std_ohm or max(stds) < LAYER_STD
        believed = taught if is_sure and self._told[:2] == (None, None) else self._told
        self._centre, self._std = (of_wires[:2] for of_wires in wire_prior(believed))
        is_known = [ohm is not None for ohm in believed[:2]]
        return np.where(is_known, self._centre, np.minimum(self._centre, np.log(START_OHM)))

    def _trial(self, u: Float) -> _Trial:
        """A trial."""
        top_ohm, bottom_ohm = np.exp(u).tolist()
        wires = held(WireOhm(top_ohm, bottom_ohm, self._lead[0]))
        shown = self._show(wires, self._own_ohm, self._most_cells)
        fit = TotalFit(shown.totals, self._scale, for_wires=True).fit()
        by_wires = fit.wires(shown.by_wires([0, 1]), self._centre - u, self._std)
        trial = _Trial(u, shown, fit, fit.misfit(), *by_wires)
        if self._most_cells == TRIAL_CELLS and trial.is_close(SHORT_STEP, 0.0):
            self._scale = fit.scale_
        return trial

    def _with_odd_leads(self, best: _Trial) -> _Trial:
        """The trial that is kept when leads that are unlike the others' have been taken off.

        Slopes foresee a large lead badly, so a line that was found may be asked again.
        """
        for _ in range(max(2, int(ODD_LINES * self._own_ohm.size))):
            line, ohm, stds = self._oddest_lead(best)
            if abs(stds) < ODD_LEAD_STDS and not self._own_ohm[line]:
                break
            self._own_ohm = self._own_ohm.copy()
            self._own_ohm[line] += ohm
            best = self._nearest(self._trial(best.held), SHORT_STEP, CLOSE_STDS[0])
        return best

    def _oddest_lead(self, trial: _Trial) -> tuple[int, float, float]:
        """The line whose lead is the most unlike the others': its number, by how much [ohm], and
        this over its deviation.
        """
        found = []
        centre = np.append(self._centre - trial.held, 0.0)
        std = np.append(self._std, UNTOLD_LEAD_STD_OHM)
        for line in range(sum(self._shape)):
            slopes = trial.shown.by_wires([0, 1, 2 + line])
            change, covariance = trial.fit.wires(slopes, centre, std)
            found.append((line, float(change[2]), float(change[2] / covariance[2, 2] ** 0.5)))
        return max(found, key=lambda one: abs(one[2]))

    def _nearest(self, best: _Trial, short: float, stds: float) -> _Trial:
        """The last trial that is kept, of steps until they are short.

        A trial is kept if it is likely beside the one before. If not, half of the step is tried.
        """
        step = best.step
        for _ in range(TRIALS):
            if best.is_close(short, stds) or np.abs(step).max() <= LAST_STEP:
                break
            trial = self._trial(best.held + step)
            best, step = (trial, trial.step) if trial.is_likely(best) else (best, 0.5 * step)
        return best


def held(wires: WireOhm) -> WireOhm:
    """These wires, told so that no scan teaches others."""
    return wires._replace(
        top_log_std=HELD_LOG_STD, bottom_log_std=HELD_LOG_STD, lead_std_ohm=HELD_LEAD_STD_OHM
    )


def likely_wires(
    held: Float, step: Float, covariance: Float, centre: Float, std: Float
) -> tuple[Float, Float]:
    """Mean and standard deviation of the logs of the segments, each (2,).

    held: u for which the rises were estimated. step, covariance: w, by a fit with the prior.
    centre, std: of the prior of u.

    Presses tell ohms: what they say is normal about the segments themselves, and the prior about
    their logs. So where presses tell little, u of most likelihood is far above the mean: what they
    cannot exclude reaches up to the largest segments, but down to none.
    """
    prior = np.diag(std**-2.0)
    precision = np.linalg.inv(covariance)
    pull = precision @ step - prior @ (centre - held)  # that of the presses alone
    precision = precision - prior
    share = np.maximum(1 + step, LEAST_SHARE)  # of the segments that were held
    reach = np.linspace(-GRID_STDS, GRID_STDS, GRID_POINTS)[:, None]
    axes = held + np.log(share) + reach * np.sqrt(covariance.diagonal()) / np.minimum(share, 1.0)
    logs = np.stack(np.meshgrid(*axes.T, indexing="ij"), axis=-1).reshape(-1, 2)
    more = np.expm1(logs - held)  # the change of a segment, over what was held
    score = more @ pull - 0.5 * np.sum(more @ precision * more, axis=1)
    score -= 0.5 * np.sum(((logs - centre) / std) ** 2, axis=1)
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = weight @ logs
    return mean, np.sqrt(weight @ (logs - mean) ** 2)
