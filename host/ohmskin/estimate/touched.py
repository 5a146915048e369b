# SPDX-License-Identifier: Apache-2.0
"""Which cells a frame shows to be touched, and how hard: what `touch` answers, and where `joint`
starts.

Symbols

====== ======== ================================================================== ==========
symbol shape    meaning                                                            unit
====== ======== ================================================================== ==========
k               cells in the model; all others are as at rest
x      (k,)     their log conductances                                             log S
I      (RC,)    port currents per Vdd                                              S
s      (RC,)    their noise: of the readings, of cells at rest and wires           S
r      (RC,)    residual (I_read - I) / s                                          1
J      (k, RC)  dI / dx / s                                                        1
Jw     (m, 2RC) dI / dw / s, w the log wire resistances, at the m ports they matter
N      (m, m)   1 + Jw P Jw^T, P the covariance of w                               1
====== ======== ================================================================== ==========

The untouched skin is solved once (`rest_network`). A frame starts from no touched cells.
Gauss-Newton steps on x minimise |r|^2 and the prior of the cells. Where a reading then shows more
current than the model explains, the cells that would explain most in their row and column are
added, until no reading asks for one; a cell that falls back to rest is taken out. The last steps
know that wires are known to P only, and weigh the readings by N^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import lapack

from ohmskin.arrays import Float
from ohmskin.circuit.cholesky import cholesky, solve, solve_lower
from ohmskin.circuit.skin import by_wires
from ohmskin.estimate.base import MAX_CELL_SIEMENS
from ohmskin.estimate.prior import DOUBT, HIDDEN, HIGHEST_TOUCH_SIEMENS, UNLIMITED_STD, CellPrior
from ohmskin.estimate.rest_network import Cells, RestNetwork, TouchedNetwork
from ohmskin.estimate.wires import Lesson, WireBelief

MOST_PER_LINE: Final = 2  # touches; with more, the skin is not at rest any more
DEMAND: Final = 4.0  # residual, in its standard deviation, that a cell is added for
SHARE: Final = 0.5  # of the largest rise in its row and column, to be added with it
LEAST_RISE: Final = 2.0  # in deviations of the prior: a cell that rises less is at rest
MAX_ROUNDS: Final = 8
MAX_STEPS: Final = 8  # per round
MAX_STEP: Final = 1.5  # of a log conductance
CLOSE: Final = 0.1  # a step below this share of every standard deviation is the last
HEAVY: Final = 0.5  # wires matter to a reading that they may move by this share of its noise,
LIGHT: Final = 0.03  # and to the next, down to this share,
MAX_HEAVY: Final = 24  # up to so many in all: together they tell a bend that none tells alone
HIDING: Final = 0.1  # deviation of a path's wires, over a cell at rest, beyond which wires hide it
REBUILD: Final = 0.05  # relative change of a path's wires for which the network is solved anew
CONTRADICTION: Final = 3.0  # deviations of the chi-square of the readings that wires matter to
_HIGHEST_LOG: Final = float(np.log(MAX_CELL_SIEMENS))
_NO_CELLS: Final[Cells] = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Touched:
    """What was found: cells (k,), their log conductance and its standard deviation (k,).

    doubtful: a touch may hide at another cell. contradicted: no touches explain the readings.
    current: what the model predicts, wires corrected (RC,) [S]. lesson: what the wires can learn
    from: Jw, r and N of the m ports, the touched cells in N as noise without limit.
    """

    cells: Cells
    log_siemens: Float
    log_std: Float
    doubtful: bool
    current: Float
    contradicted: bool
    steps: int
    lesson: Lesson


class TouchedFit:
    """Fits the frames of a skin (R, C), each by itself."""

    def __init__(
        self, shape: tuple[int, int], prior: CellPrior, belief: WireBelief, ref_ohm: float
    ) -> None:
        self._shape = shape
        self._prior = prior
        self._belief = belief
        self._ref_ohm = ref_ohm
        self._base: _Base | None = None

    def find(self, current: Float, current_std: Float) -> Touched | None:
        """The touched cells of one frame, (RC,) [S] both; None if no touches explain it."""
        base = self._base
        if base is None or base.path_change(self._belief.mean) > REBUILD:
            self._base = base = _Base(self._shape, self._prior, self._belief, self._ref_ohm)
        fit = _Fit(base, current, current_std)
        # Never from the frame before: that keeps cells in the model that no reading asks for.
        fit.settle(_NO_CELLS, np.zeros(0))
        for _ in range(MAX_ROUNDS):
            asked, rise = fit.asked_for()
            if not asked.size:
                break
            if fit.cells.size + asked.size > MOST_PER_LINE * sum(self._shape):
                return None
            added = np.log(base.net.cell_siemens[asked] + rise)
            fit.settle(np.concatenate([fit.cells, asked]), np.concatenate([fit.log_siemens, added]))
        else:
            return None
        return fit.finish(self._belief)


class _Base:
    """What does not change from frame to frame: the untouched skin with wires as believed."""

    def __init__(
        self, shape: tuple[int, int], prior: CellPrior, belief: WireBelief, ref_ohm: float
    ) -> None:
        self.log_wires = belief.mean
        top, bottom = np.exp(belief.mean).reshape(2, *shape)
        self.rest_log = -prior.expected
        self.least_log = self.rest_log + LEAST_RISE * prior.std
        self.prior = prior
        self.ref_ohm = ref_ohm
        self.net = net = RestNetwork(np.exp(self.rest_log).reshape(shape), top, bottom)
        self.current = 1.0 / (net.port_ohm + ref_ohm)
        by_cell = self.current**2 * net.port_volt**2 * net.cell_siemens[:, None]
        by_wires = net.by_wires() * (self.current**2)[:, None]
        # Cells drift and skins bend after their rest readings [S^2].
        self.slack = prior.std**2 @ (by_cell * by_cell)
        self.slack += belief.variance(by_wires)
        self.path_ohm = self.net.path_ohm(self.log_wires)
        self.wire_std = float(belief.std().max())
        # Wires this uncertain are no small noise beside a cell at rest.
        self.hides = bool(np.any(self.path_ohm * self.wire_std * net.cell_siemens > HIDING))

    def path_change(self, log_wires: Float) -> float:
        """Largest relative change of the wire between a cell and its electrodes."""
        return float(np.abs(self.net.path_ohm(log_wires) / self.path_ohm - 1.0).max())


class _Fit:
    """One frame: the cells in the model, and all that follows from them."""

    def __init__(self, base: _Base, current: Float, current_std: Float) -> None:
        self._base = base
        self._measured = current
        self._reading_std = current_std
        self._loose_std = np.sqrt(current_std**2 + base.slack)
        self._target_ohm = 1.0 / np.maximum(current, 1e-12) - base.ref_ohm
        self.steps = 0

    def _place(self, cells: Cells, log_siemens: Float) -> None:
        """Take these cells for the touched ones: network, currents, residual."""
        base = self._base
        self.cells, self.log_siemens = cells, log_siemens
        self._siemens = np.exp(log_siemens)
        self._std = self._loose_std
        self._touched: TouchedNetwork | None = None
        self._current = base.current
        if cells.size:
            added = self._siemens - base.net.cell_siemens[cells]
            self._touched = TouchedNetwork(base.net, cells, added)
            self._current = 1.0 / (self._touched.port_ohm + base.ref_ohm)
            self._std = self._loose_std.copy()
            self._std[cells] = self._reading_std[cells]
        self._residual = (self._measured - self._current) / self._std

    def settle(self, cells: Cells, log_siemens: Float) -> None:
        """Steps from here until none matters; cells that fall back to rest leave."""
        least = self._base.least_log[cells]
        self._place(cells, np.maximum(log_siemens, least))
        for _ in range(MAX_STEPS):
            if not self.cells.size:
                return
            slopes = self._slopes()
            normal, step = self._step(slopes @ slopes.T, slopes @ self._residual)
            moved = np.minimum(self.log_siemens + np.clip(step, -MAX_STEP, MAX_STEP), _HIGHEST_LOG)
            stays = moved > self._base.least_log[self.cells]
            if stays.all():
                self._place(self.cells, moved)
                if (step * step * np.diagonal(normal)).max() < CLOSE**2:
                    return
            else:
                self._place(self.cells[stays], moved[stays])

    def _slopes(self) -> Float:
        """J, (k, RC)."""
        assert self._touched is not None
        volt = self._touched.volt
        weight = self._current**2 / self._std
        return np.asarray(volt * volt * self._siemens[:, None] * weight)

    def _step(self, normal: Float, pull: Float) -> tuple[Float, Float]:
        """Normal matrix, with the prior about rest, and the step it makes of `pull`."""
        prior, cells = self._base.prior, self.cells
        centre, variance = prior.normal(-self.log_siemens, cells)
        away, precision = self.log_siemens + centre, 1.0 / variance
        normal.ravel()[:: cells.size + 1] += precision
        _, step, _ = lapack.dposv(normal, pull - away * precision, lower=1)
        self.steps += 1
        return normal, step

    def asked_for(self) -> tuple[Cells, Float]:
        """Cells that readings ask for, and the conductance that each, alone, would need [S].

        A current above the model's by `DEMAND` asks for its cell. Of these only such count that
        need at least `SHARE` of the largest rise in their row and column: a ghost needs less, as
        its current passes three touches in series.
        """
        base = self._base
        asks = self._residual > DEMAND
        asks[self.cells] = False
        if not asks.any():
            return _NO_CELLS, np.zeros(0)
        net = base.net
        port_volt, cell_volt, port_ohm = net.own_port_volt, net.own_cell_volt, net.port_ohm
        if self._touched is not None:
            port_volt, cell_volt = self._touched.own_volt()
            port_ohm = self._touched.port_ohm
        # From rho = target for one cell more.
        target = np.maximum(self._target_ohm, 0.5 * base.path_ohm)
        need = port_volt**2 / np.maximum(port_ohm - target, 1e-9) - cell_volt
        rise = np.where(asks, 1.0 / np.maximum(need, 1.0 / HIGHEST_TOUCH_SIEMENS), 0.0)
        map_ = rise.reshape(net.shape)
        rival = np.maximum(map_.max(axis=1, keepdims=True), map_.max(axis=0, keepdims=True))
        asked = np.flatnonzero((map_ > 0) & (map_ >= SHARE * rival))
        return asked, rise[asked]

    def finish(self, belief: WireBelief) -> Touched:
        """The last steps, with wires known to their covariance only."""
        base, cells = self._base, self.cells
        if not cells.size:
            nothing = np.zeros((0, belief.mean.size)), np.zeros(0), np.zeros((0, 0))
            none, less = np.zeros(0), bool(self._residual.min() < -DEMAND)
            return Touched(cells, none, none, False, self._current, less, 0, nothing)
        assert self._touched is not None
        move = (self._current**2 - base.current**2) * base.path_ohm * base.wire_std
        weight = move / self._std
        least = np.partition(weight, -MAX_HEAVY)[-MAX_HEAVY] if weight.size > MAX_HEAVY else 0.0
        heavy = weight > np.clip(least, LIGHT, HEAVY)
        heavy[cells] = True
        ports = np.flatnonzero(heavy)
        light = ~heavy
        wires = self._sharpened(ports)
        covariance = belief.seen(wires)
        np.einsum("ii->i", covariance)[:] += 1.0
        unit = np.sqrt(np.diagonal(covariance))
        factor = cholesky(covariance)
        offset = wires @ (belief.mean - base.log_wires)
        for last in (False, True):
            slopes = self._slopes()
            residual = self._residual[ports] - offset
            both = np.concatenate([slopes[:, ports], residual[None, :]])
            whitened = solve_lower(factor, both.T)
            free = slopes[:, light]
            own, rest = whitened[:, :-1], whitened[:, -1]
            normal, step = self._step(
                free @ free.T + own.T @ own, free @ self._residual[light] + rest @ own
            )
            least = base.least_log[cells]
            moved = np.clip(
                self.log_siemens + np.clip(step, -MAX_STEP, MAX_STEP), least, _HIGHEST_LOG
            )
            small = (step * step * np.diagonal(normal)).max() < CLOSE**2
            self._place(cells, moved)
            if small or last:
                break
        residual = self._residual[ports] - offset
        left = solve(factor, residual)
        spare = ports.size - cells.size  # degrees of freedom
        current = self._current.copy()
        current[ports] += (residual - left + offset) * self._std[ports]
        heavy_slopes = slopes[:, ports]
        noise = UNLIMITED_STD**2 * (heavy_slopes.T @ heavy_slopes)
        noise.ravel()[:: ports.size + 1] += 1.0
        return Touched(
            cells=cells,
            log_siemens=self.log_siemens,
            log_std=np.sqrt(np.diagonal(np.linalg.inv(normal))),
            doubtful=base.hides or self._doubtful(ports, residual, unit),
            current=current,
            contradicted=bool(
                residual @ left > spare + CONTRADICTION * np.sqrt(2 * spare + 1)
                or self._residual[light].min(initial=0.0) < -DEMAND
            ),
            steps=self.steps,
            lesson=(wires, residual, noise),
        )

    def _sharpened(self, ports: Cells) -> Float:
        """Jw (m, 2RC); takes the drift of cells at rest from the touched network at these ports."""
        assert self._touched is not None
        base, net = self._base, self._base.net
        currents = self._touched.cell_current(ports)
        square = self._current[ports] ** 2
        by_cell = currents * currents / net.cell_siemens
        by_cell[:, self.cells] = 0.0
        by_cell *= base.prior.std
        slack = square * square * np.einsum("ij,ij->i", by_cell, by_cell)
        self._loose_std[ports] = np.sqrt(self._reading_std[ports] ** 2 + slack)
        self._place(self.cells, self.log_siemens)
        wires = by_wires(currents.reshape(-1, *net.shape), net.top_wire_ohm, net.bottom_wire_ohm)
        wires *= -(square / self._std[ports])[:, None]
        return wires

    def _doubtful(self, ports: Cells, residual: Float, deviation: Float) -> bool:
        """Whether a touch may hide at a cell that this model holds for untouched.

        What its own reading says of it: rise of its conductance over rest, and deviation.
        """
        assert self._touched is not None
        net = self._base.net
        volt, _ = self._touched.own_volt()
        slope = (self._current * volt) ** 2 * net.cell_siemens / self._std
        left, unit = self._residual.copy(), np.ones(volt.size)
        left[ports], unit[ports] = residual, deviation
        rise, rise_std = left / slope, unit / slope
        hidden = (rise > DOUBT * rise_std) & (rise + 2 * rise_std > HIDDEN)
        hidden[self.cells] = False
        return bool(hidden.any())
