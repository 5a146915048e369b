# SPDX-License-Identifier: Apache-2.0
"""The wires of a skin, from presses of single cells by known forces.

Under the same force, all cells conduct alike wherever they lie, apart from some scatter. But the
more wire lies in series with a cell, the less current its port shows: j+1 segments of its row, i+1
of its column. With wires that are taken for too small, cells far from the electrodes would seem to
conduct too little, and most of all under large forces. So the wires are found together with one law
from force to conductance, which holds for all cells.

Symbols. A press has up to `LEVELS` rows, each of them the mean of its scans at about one force.

======== ====== ========================================================================= =======
symbol   shape  meaning                                                                   unit
======== ====== ========================================================================= =======
F, x     (n,)   force; its log, less the mean of all rows                                 N, 1
I, I0    (n,)   current of the pressed cell's port per Vdd; that of the untouched skin    S
y        (n,)   log(I - I0)                                                               log S
p        (7,)   logs of a top and a bottom segment; a lead over `UNKNOWN_LEAD_OHM`; k, b,
                q; log r
G        (n,)   conductance of the contact                                                S
r               what no force lowers, in series with the contact                          ohm
d        (n,)   conductance that the press adds to the cell                               S
rho0, M  (n,)   as in `sparse_fit`: of the untouched skin, at the port of the pressed     ohm
H        (n,)   cell, and that cell alone
S        (n,)   dy / d log G                                                              1
U        (n,)   dy / d ohm, of what is in series with the whole port                      1/ohm
K        (c, c) covariance of what is in series with the c pressed cells: segments and    ohm^2
                leads differ from their means by `SEGMENT_STD`, r by its v
v               variances of log G: of a cell's factor, of its exponent, of a press, of   1
                a row; and that of a force [N^2], and of a cell's r as a share of it
C        (n, n) covariance of y                                                           1
======== ====== ========================================================================= =======

    log G = k + b x + q (x^2 - mean x^2) ,    1 / d = r + 1 / G ,
    rho = rho0 - H^2 / (1 / d + M) ,          I = 1 / (rho + 2 lead + references) .

For each trial of the wires, the untouched cells are those that explain the rest readings, and the
network is solved once (`RestNetwork`). A pressed cell is a change of rank 1.

    C = N + S S^T * [same cell] (v_cell + v_exponent x x^T + v_press [same press]
                                 + (v_row + v_force / F^2) [same row]) + U U^T * K ,

N is the noise of the readings, * multiplies by elements, and [...] is 1 where it holds, else 0.
The fit minimises (y - y(p))^T C^-1 (y - y(p)) and the priors of p. Between such fits, the variances
v are replaced by the most likely ones. Two leads and r lie in series, so presses tell their sum
alone, and the prior of r divides it: what is above the usual r is taken for the leads. The
covariance of p is that of least squares. Layers that were told, and leads, are tried as told and as
never told, and the most probable of these is the answer (`WRONGLY_TOLD`).

After a fit, the line is sought that is the most unlike the others (`_PressFit.oddest_line`). All is
fitted again with the lead that this line would have, and the next such line is sought. Leads are
kept if all is much more probable with them.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import wire_coupling_ohm
from ohmskin.circuit.small import one_blas_thread, solve_positive
from ohmskin.estimate.knowledge import MIN_CELL_SIEMENS, SkinKnowledge, WireOhm
from ohmskin.estimate.port_readings import PortReader, PortReadings
from ohmskin.estimate.prior import (
    HIGHEST_TOUCH_SIEMENS,
    LAYER_STD,
    MAX_STEP_LOG,
    REACH_STDS,
    SEGMENT_STD,
    UNKNOWN_LEAD_OHM,
    UNKNOWN_WIRE_OHM,
    UNTOUCHED_STD,
    rest_level,
)
from ohmskin.estimate.sparse_fit import RestNetwork

# Rows.
# The forces of a press are divided, by their log, into so many parts. Chosen: its scans are not
# independent, and a curve bends between the least and the largest force.
LEVELS: Final = 4
# Forces below this share of the largest one are left out. Chosen: there a sensor's zero and the
# memory of a contact are as large as the force.
LEAST_FORCE_SHARE: Final = 0.05
# Scans whose current rises by fewer deviations are left out. Chosen: logs of less are skewed.
LEAST_RISE_STDS: Final = 6.0

# Priors: centres, and deviations of logs.
# Deviation of the log of segments that nobody has told. Chosen: two deviations are a factor of
# twenty either way.
UNTOLD_STD: Final = 1.5
# Deviation of a lead that nobody has told [ohm]. Chosen: margins of yarn have kilohms.
UNTOLD_LEAD_STD_OHM: Final = 1500.0
# r [ohm], that of the cell in docs/force.md, and the deviation of its log. Chosen: a factor of e.
SERIES_OHM, SERIES_STD = 250.0, 1.0
# Exponent b: linear contacts have 1, rough ones up to 2. Chosen.
EXPONENT, EXPONENT_STD = 1.5, 1.0
# Bend q. Chosen: from 0.4 to 8 N, it changes the exponent by 0.3.
BEND_STD: Final = 0.1
# The roots of v before any press: of a cell's factor, of its exponent, of a press and of a row, all
# of log G; of a force [N]; and of a cell's r. Then the deviations of the logs of these roots.
# Chosen: cells of one skin scatter by some ten percent, presses by less.
SCATTER: Final[Float] = np.array([0.2, 0.03, 0.05, 0.08, 0.03, 0.2])
SCATTER_LOG_STD: Final[Float] = np.array([0.5, 0.7, 1.0, 1.0, 1.0, 1.0])

# Wires are unclear if the deviation of their log is larger, and if that matters (`FoundWires`).
# Chosen: a factor of 1.6.
UNCLEAR_LOG: Final = 0.5

# Told wires are wrong with this probability, as where kilohms are taken for ohms: then presses tell
# alone. Chosen: so that it takes wires which are off by more than skins stretch.
WRONGLY_TOLD: Final = 0.01

# Lines unlike the others.
# A line is suspect if its lead or its segments differ from others' by so many deviations. Chosen:
# as on sound skins, at most. A lead that is odd passes for scatter, so it is not far off either.
SUSPECT_STDS: Final = 3.0
# Leads are odd if the fit with them is as much more probable as by so many deviations each, and a
# stripe if it is so many deviations off. Chosen: a row whose cells conduct half as much is not odd,
# and a lead of 600 ohm at lines of 100 ohm a segment is.
ODD_STDS: Final = 5.0
# So many cells of it must have been pressed. Chosen: an odd contact or two are no odd line.
LEAST_CELLS: Final = 3
# At most this share of the lines is told to have a lead of its own. Chosen: what a quarter has is
# not odd.
ODD_LINES: Final = 0.25

# The search.
# Both layers start from this [ohm]. Chosen: from wires that are too small, it finds larger ones, up
# to 10 kOhm in `benchmarks/bench_newtons.py`.
START_OHM: Final = 50.0
# Fits, each with the scatter by the one before. Chosen: a fifth moves wires by less than 1 %.
ROUNDS: Final = 4
# Newton steps for the untouched cells of a trial, which starts from those of the one before, and
# the step that is the last.
_REST_STEPS, _CLOSE_STEP = 20, 1e-6
# A port that conducts less than this share of the median one at rest is of an open line. Chosen: an
# open line leaves hundredths, and lines of 10 kOhm a segment halve a current.
OPEN_SHARE: Final = 0.05
# Step of p for slopes by differences.
_DIFFERENCE: Final = 1e-3
# p stays within this of its centre. Chosen: as a log, it is a factor of e^14, and only a fit that
# goes astray gets there.
_LIMIT: Final = 14.0


class PressReadings(NamedTuple):
    """What n scans of pressed cells show, arrays (n,).

    cells: flat index of the pressed cell.
    press: number of its press.
    force_n: force on the cell [N].
    current: of the cell's port per Vdd [S].
    current_std: standard deviation of current [S].
    """

    cells: NDArray[np.intp]
    press: NDArray[np.intp]
    force_n: Float
    current: Float
    current_std: Float


class LineExcess(NamedTuple):
    """What one line has, and the others of its layer have not.

    line: its number; columns follow the rows.
    ohm: of its lead, or of each of its segments [ohm].
    stds: this over its standard deviation [1].
    is_lead: whether a lead explains the presses of its cells better than segments do.
    """

    line: int
    ohm: float
    stds: float
    is_lead: bool


@dataclass(frozen=True)
class FoundWires:
    """What presses tell of the wires, together with what was told.

    wires: the most likely ones, or the mean of a kneaded skin's, with their deviations.
    told: what was told before.
    presses: how many presses there were.
    unclear: layers whose wires are not clear: the deviation of their log is above `UNCLEAR_LOG`,
        and the longest line is uncertain by more ohms than the hardest touch has.
    own_lead_ohm: what single leads have above the others (`SkinKnowledge`); None: nothing.
    odd_stripe: a line whose segments are unlike those of the other lines; None: no press shows one.
    """

    wires: WireOhm
    told: WireOhm
    presses: int
    unclear: tuple[str, ...]
    own_lead_ohm: Float | None = None
    odd_stripe: LineExcess | None = None

    @property
    def disagrees(self) -> bool:
        """Whether a layer was told and other wires are found, by more than skins stretch."""
        layers = zip(self.told[:2], self.wires[:2], self.wires[3:5], strict=True)
        return any(
            abs(np.log(ohm / max(told, 1e-3))) > max(LAYER_STD, REACH_STDS * (std or 0.0))
            for told, ohm, std in layers
            if told is not None and ohm is not None
        )

    @property
    def lead_disagrees(self) -> bool:
        """Whether a lead was told and another is found, by more than both deviations explain."""
        told_ohm, told_std_ohm = self.told.lead_or_usual(0.0)
        std_ohm = np.hypot(told_std_ohm, self.wires.lead_std_ohm or 0.0)
        apart_ohm = abs((self.wires.lead or 0.0) - told_ohm)
        return self.told.lead is not None and bool(apart_ohm > REACH_STDS * std_ohm)


class _Rows(NamedTuple):
    """Arrays (n,) of the module's table. variance: of y, by the readings' noise."""

    cells: NDArray[np.intp]
    press: NDArray[np.intp]
    log_force: Float
    y: Float
    variance: Float


class _Trial(NamedTuple):
    """The skin with some wires: rho0, H^2 and M of the pressed cells (n,), and K (c, c)."""

    rest_ohm: Float
    square_volt: Float
    cell_volt: Float
    path_variance: Float


class _Expected(NamedTuple):
    """y of the model, S and U, (n,); K without r, (c, c); r [ohm]."""

    y: Float
    by_contact: Float
    by_path: Float
    path_variance: Float
    series_ohm: float


@one_blas_thread
def find_wires(knowledge: SkinKnowledge, readings: PressReadings) -> FoundWires:
    """The wires by presses. knowledge: of the skin, with its rest readings and what was told.

    Raises ValueError where no scan shows a press.
    """
    assert knowledge.rest_ratio is not None
    shape = knowledge.rows, knowledge.columns
    rest = PortReader(knowledge).read(knowledge.rest_ratio)
    rows = _rows(readings, rest.current.ravel())
    own_ohm = trial_ohm = np.zeros(sum(shape))
    even = fit = trial = _best_fit(knowledge, rows, rest, own_ohm)
    # One odd lead hides another. So the next one is sought even before the first one is clear.
    for count in range(1, 1 + int(ODD_LINES * own_ohm.size)):
        odd = trial.oddest_line()
        if odd is None or not odd.is_lead:
            break
        trial_ohm = trial_ohm.copy()
        trial_ohm[odd.line] += odd.ohm
        trial = _best_fit(knowledge, rows, rest, trial_ohm)
        if even.score - trial.score > count * ODD_STDS**2:
            own_ohm, fit = trial_ohm, trial
    odd = fit.oddest_line()
    is_stripe = odd is not None and not odd.is_lead and abs(odd.stds) > ODD_STDS
    p, std = fit.p, np.sqrt(fit.covariance.diagonal())
    top_ohm, bottom_ohm = np.exp(p[:2]).tolist()
    lead_ohm, lead_std_ohm = (UNKNOWN_LEAD_OHM * float(lead) for lead in (p[2], std[2]))
    top_std, bottom_std = std[:2].tolist()
    wires = WireOhm(top_ohm, bottom_ohm, lead_ohm, top_std, bottom_std, lead_std_ohm)
    return FoundWires(
        wires,
        knowledge.nominal_wire_ohm,
        np.unique(readings.press).size,
        unclear_layers(p[:2], std[:2], shape),
        own_ohm if own_ohm.any() else None,
        odd if is_stripe else None,
    )


def _best_fit(
    knowledge: SkinKnowledge, rows: _Rows, rest: PortReadings, own_ohm: Float
) -> "_PressFit":
    """The most probable fit, where single leads have so much above the others (R+C,) [ohm].

    rest: readings of the untouched skin.
    """
    told = knowledge.nominal_wire_ohm
    lead_alone = WireOhm(lead=told.lead, lead_std_ohm=told.lead_std_ohm)
    layers_alone = told._replace(lead=None, lead_std_ohm=None)
    cost_of_wrong = -2 * float(np.log(WRONGLY_TOLD))
    # Where nothing else was told, one of these is what was told, and costs nothing.
    costs = {lead_alone: cost_of_wrong, layers_alone: cost_of_wrong, told: 0.0}
    tried = []
    for wires, cost in costs.items():
        known = replace(knowledge, nominal_wire_ohm=wires)
        tried.append(_PressFit(known, rows, rest, own_ohm))
        tried[-1].score += cost
    return min(tried, key=lambda fit: fit.score)


def unclear_layers(logs: Float, stds: Float, shape: tuple[int, int]) -> tuple[str, ...]:
    """Layers whose wires are not clear (`FoundWires`), by logs of their segments and deviations."""
    rows, columns = shape
    lines_ohm = np.exp(logs) * stds * (columns, rows)
    unclear = (stds > UNCLEAR_LOG) & (lines_ohm > 1 / HIGHEST_TOUCH_SIEMENS)
    return tuple(np.array(["top", "bottom"])[unclear].tolist())


def _rows(readings: PressReadings, rest_current: Float) -> _Rows:
    """The means of each press at its levels of force."""
    cells, press, force_n, current, current_std = readings
    rise = current - rest_current[cells]
    good = rise > LEAST_RISE_STDS * current_std
    good &= force_n > LEAST_FORCE_SHARE * force_n.max()
    if not good.any():
        raise ValueError("no scan shows a press clearly")
    cells, press, rise = cells[good], press[good], rise[good]
    x, y = np.log(force_n[good]), np.log(rise)
    variance = (current_std[good] / rise) ** 2
    presses, number = np.unique(press, return_inverse=True)
    least, most = np.full(presses.size, np.inf), np.full(presses.size, -np.inf)
    np.minimum.at(least, number, x)
    np.maximum.at(most, number, x)
    level = LEVELS * (x - least[number]) / np.maximum(most - least, 1e-9)[number]
    row = number * LEVELS + np.minimum(level.astype(np.intp), LEVELS - 1)
    _, first, row = np.unique(row, return_index=True, return_inverse=True)
    count = np.bincount(row)
    # Noise of scans averages out, but for the rounding, which is alike in them.
    means = (np.bincount(row, values) / count for values in (x, y, variance))
    return _Rows(cells[first], press[first], *means)


def wire_prior(told: WireOhm) -> tuple[Float, Float]:
    """Centre and deviation of p[:3], by what was told of the wires."""
    centre, std = [], []
    for ohm, log_std in zip(told[:2], told[3:5], strict=True):
        centre.append(np.log(UNKNOWN_WIRE_OHM if ohm is None else max(ohm, 1e-3)))
        std.append(UNTOLD_STD if ohm is None else np.hypot(LAYER_STD, log_std or 0.0))
    lead_ohm, lead_std_ohm = told.lead_or_usual(UNTOLD_LEAD_STD_OHM)
    centre.append(lead_ohm / UNKNOWN_LEAD_OHM)
    std.append(max(lead_std_ohm, 1e-3) / UNKNOWN_LEAD_OHM)
    return np.array(centre), np.array(std)


class _PressFit:
    """The fit of wires and law to the rows of presses: the most probable p and v.

    score: -2 log of the evidence.
    p, covariance: as in the module's table, and that of p, (7, 7).
    scatter: roots of v, (6,).
    """

    def __init__(
        self, knowledge: SkinKnowledge, rows: _Rows, rest: PortReadings, own_ohm: Float
    ) -> None:
        """rest: readings of the untouched skin. own_ohm: of the leads, above the mean (R+C,)."""
        self._shape, self._rows = (knowledge.rows, knowledge.columns), rows
        rest_current = self._rest_current = rest.current.ravel()
        self._rest_std = rest.current_std.ravel()
        # Of each port, without mean leads.
        own_of_ports = np.add.outer(own_ohm[: knowledge.rows], own_ohm[knowledge.rows :])
        self._ref_ohm = knowledge.ref_ohm + own_of_ports.ravel()
        self._x = rows.log_force - rows.log_force.mean()
        self._bend = self._x**2 - np.mean(self._x**2)
        level = rest_level(rest_current.reshape(self._shape), knowledge.ref_ohm)
        # Cells of an open line have no slopes to speak of: to fit them would not end.
        self._is_open = rest_current < OPEN_SHARE * np.median(rest_current)
        self._log_siemens = np.full(rest_current.size, np.log(level))
        self._log_siemens[self._is_open] = np.log(MIN_CELL_SIEMENS)
        # It keeps more trials than one step and its slopes need.
        self._trial = lru_cache(maxsize=8)(self._solved)
        self._set_priors(knowledge.nominal_wire_ohm)
        self._set_blocks()
        self._minimise()

    def _set_priors(self, told: WireOhm) -> None:
        """Centre and deviation of p, by what was told."""
        centre, std = wire_prior(told)
        # The level k of the law is free: -10 is 45 microsiemens.
        self._centre = np.array([*centre, -10.0, EXPONENT, 0.0, np.log(SERIES_OHM)])
        self._std = np.array([*std, 10.0, EXPONENT_STD, BEND_STD, SERIES_STD])
        self._lowest, self._highest = self._centre - _LIMIT, self._centre + _LIMIT
        self._lowest[2], self._highest[2] = 0.0, np.inf

    def _set_blocks(self) -> None:
        """Rows of one cell stand side by side, (c, m): where a cell has fewer than m, padded."""
        cells, number = np.unique(self._rows.cells, return_inverse=True)
        order = np.argsort(number, kind="stable")
        count = np.bincount(number)
        place = np.arange(number.size) - np.repeat(np.cumsum(count) - count, count)
        self._cells = cells
        self._block: NDArray[np.intp] = np.zeros((cells.size, count.max()), dtype=np.intp)
        self._is_row: Bool = np.zeros(self._block.shape, dtype=bool)
        self._block[number[order], place] = order
        self._is_row[number[order], place] = True

    # ------------------------------------------------------------------------------ the model

    def _solved(self, log_top: float, log_bottom: float, leads: float) -> _Trial:
        """The skin with these wires, p[:3]."""
        top_ohm, bottom_ohm = np.exp([log_top, log_bottom]).tolist()
        series_ohm = self._ref_ohm + 2 * leads * UNKNOWN_LEAD_OHM
        log_siemens = self._log_siemens
        for _ in range(_REST_STEPS):
            siemens = np.exp(log_siemens).reshape(self._shape)
            circuit = PortCircuit(siemens, top_ohm, bottom_ohm)
            current = 1.0 / (circuit.port_ohm + series_ohm)
            slopes = (current**2 / self._rest_std)[:, None] * circuit.by_cell()
            slopes[:, self._is_open] = 0.0
            off = (self._rest_current - current) / self._rest_std
            from_level = (log_siemens - np.median(log_siemens)) / UNTOUCHED_STD**2
            from_level[self._is_open] = 0.0
            system = slopes.T @ slopes + np.eye(off.size) / UNTOUCHED_STD**2
            step = solve_positive(system, slopes.T @ off - from_level)
            log_siemens = log_siemens + np.clip(step, -MAX_STEP_LOG, MAX_STEP_LOG)
            limits = np.log([MIN_CELL_SIEMENS, HIGHEST_TOUCH_SIEMENS])
            log_siemens = np.clip(log_siemens, *limits)
            if np.abs(step).max() < _CLOSE_STEP:
                break
        self._log_siemens = log_siemens
        net = RestNetwork(np.exp(log_siemens).reshape(self._shape), top_ohm, bottom_ohm)
        top, bottom = (np.full(self._shape, (SEGMENT_STD * w) ** 2) for w in (top_ohm, bottom_ohm))
        of_lead = (SEGMENT_STD * leads * UNKNOWN_LEAD_OHM) ** 2
        top[:, 0] += of_lead
        bottom[0] += of_lead
        of_path = wire_coupling_ohm(top, bottom, self._shape)[np.ix_(self._cells, self._cells)]
        cells = self._rows.cells
        rest_ohm = net.port_ohm[cells] + series_ohm[cells]
        return _Trial(rest_ohm, net.own_slope[cells], net.cell_volt[cells, cells], of_path)

    def _expected(self, p: Float) -> _Expected:
        trial = self._trial(*p[:3].tolist())
        log_contact = p[3] + p[4] * self._x + p[5] * self._bend
        rest_current = 1.0 / trial.rest_ohm

        series_ohm = float(np.exp(p[6]))

        def y(log_siemens: Float) -> tuple[Float, Float]:
            added_ohm = series_ohm + np.exp(-log_siemens)
            missing = trial.square_volt / (added_ohm + trial.cell_volt)
            current = 1.0 / np.maximum(trial.rest_ohm - missing, 1.0)
            return np.log(np.maximum(current - rest_current, 1e-15)), current

        middle, current = y(log_contact)
        half = 0.5 * SEGMENT_STD
        by_contact = (y(log_contact + half)[0] - y(log_contact - half)[0]) / (2 * half)
        # U: d(I - I0) / d ohm = I0^2 - I^2, so that d log(I - I0) / d ohm = -(I + I0).
        by_path = -(current + rest_current)
        return _Expected(middle, by_contact, by_path, trial.path_variance, series_ohm)

    def _whitener(self, model: _Expected, scatter: Float) -> "_Whitener":
        """Whitens residuals of y at this model. scatter: roots of v, (6,)."""
        block, is_row, rows = self._block, self._is_row, self._rows
        x, press = self._x[block], rows.press[block]
        cell, exponent, of_press, of_row, of_force, of_series = scatter**2
        covariance = cell + exponent * x[:, :, None] * x[:, None]
        covariance += of_press * (press[:, :, None] == press[:, None])
        own = of_row + of_force * np.exp(-2 * rows.log_force[block])
        diagonal = np.einsum("kii->ki", covariance)
        diagonal += own
        slope = np.where(is_row, model.by_contact[block], 0.0)
        covariance *= slope[:, :, None] * slope[:, None]
        diagonal += np.where(is_row, rows.variance[block] + 1e-12, 1.0)
        by_path = np.where(is_row, model.by_path[block], 0.0)
        of_path = model.path_variance + of_series * model.series_ohm**2 * np.eye(self._cells.size)
        return _Whitener(np.linalg.cholesky(covariance), by_path, of_path)

    # ----------------------------------------------------------------------------- the search

    def _minimise(self) -> None:
        """Find the most probable p and v."""
        from scipy.optimize import least_squares

        p, scatter = self._start(), SCATTER
        for _ in range(ROUNDS):
            whitener = self._whitener(self._expected(p), scatter)
            found = least_squares(
                self._residual,
                p,
                self._slopes,
                (self._lowest, self._highest),
                x_scale="jac",
                max_nfev=50,
                ftol=1e-6,
                xtol=1e-5,
                args=(whitener,),
            )
            p = found.x
            scatter, score = self._scatter(p, scatter)
        from_centre = (p - self._centre) / self._std
        precision = found.jac.T @ found.jac
        # Of the likelihood times the prior, by Laplace's integral over p.
        score += float(from_centre @ from_centre) + 2 * float(np.log(self._std).sum())
        self.score = score + float(np.linalg.slogdet(precision)[1])
        self.p, self.covariance, self.scatter = p, np.linalg.inv(precision), scatter

    def oddest_line(self) -> LineExcess | None:
        """The line whose lead, or segments, are the most unlike the others'; None if none is.

        With y' = y - d x, of which d is by a lead of the line, or by each of its segments, and J
        the slopes of the residual by p, the best x is, together with the change of p that it makes,

            x = d^T Q y / (d^T Q d) ,  Q = 1 - J (J^T J)^-1 J^T ,

        all of them whitened by C. Its deviation is (d^T Q d)^-1/2.
        """
        model = self._expected(self.p)
        whitener = self._whitener(model, self.scatter)
        residual, slopes = self._residual(self.p, whitener), self._slopes(self.p, whitener)
        basis, _ = np.linalg.qr(slopes)
        residual -= basis @ (basis.T @ residual)
        by_path = np.where(self._is_row, model.by_path[self._block], 0.0)
        odd, (row, column) = [], np.divmod(self._cells, self._shape[1])
        for line, is_lead in product(range(sum(self._shape)), (True, False)):
            is_column = line >= self._shape[0]
            on_line = column == line - self._shape[0] if is_column else row == line
            if on_line.sum() < LEAST_CELLS:
                continue
            segments = 1.0 if is_lead else 1.0 + (row if is_column else column)
            by_ohm = whitener(by_path * (on_line * segments)[:, None]).ravel()
            slope = np.append(by_ohm, np.zeros(self.p.size))
            slope -= basis @ (basis.T @ slope)
            square = max(float(slope @ slope), 1e-9 * float(by_ohm @ by_ohm))
            ohm = float(slope @ residual) / square
            odd.append(LineExcess(line, ohm, ohm * square**0.5, is_lead))
        oddest = max(odd, key=lambda one: abs(one.stds), default=None)
        return oddest if oddest is not None and abs(oddest.stds) > SUSPECT_STDS else None

    def _start(self) -> Float:
        """p with the wires of the start, and the level of the law by the median row."""
        p = self._centre.copy()
        p[:2] = np.log(START_OHM)
        for _ in range(_REST_STEPS):
            model = self._expected(p)
            off = (self._rows.y - model.y) / np.maximum(model.by_contact, 0.1)
            p[3] += np.clip(np.median(off), -MAX_STEP_LOG, MAX_STEP_LOG)
        return np.asarray(np.clip(p, self._lowest, self._highest))

    def _residual(self, p: Float, whitener: "_Whitener") -> Float:
        off = (self._rows.y - self._expected(p).y)[self._block]
        whitened = whitener(np.where(self._is_row, off, 0.0)).ravel()
        return np.asarray(np.concatenate([whitened, (p - self._centre) / self._std]))

    def _slopes(self, p: Float, whitener: "_Whitener") -> Float:
        """Of the residual, by differences: a step as small as p may be would show rounding."""
        from scipy.optimize import approx_fprime

        return np.asarray(approx_fprime(p, self._residual, _DIFFERENCE, whitener))

    def _scatter(self, p: Float, scatter: Float) -> tuple[Float, float]:
        """The scatter (6,) of most likelihood at p, and -2 log of that likelihood."""
        from scipy.optimize import minimize

        model = self._expected(p)
        off = np.where(self._is_row, (self._rows.y - model.y)[self._block], 0.0)

        def score(logs: Float) -> float:
            whitener = self._whitener(model, SCATTER * np.exp(SCATTER_LOG_STD * logs))
            return float(np.sum(whitener(off) ** 2) + whitener.log_determinant + logs @ logs)

        start = np.log(scatter / SCATTER) / SCATTER_LOG_STD
        found = minimize(score, start, method="L-BFGS-B", bounds=[(-5.0, 5.0)] * start.size)
        return SCATTER * np.exp(SCATTER_LOG_STD * found.x), float(found.fun)


class _Whitener:
    """Makes residuals (c, m) of unit variance: L^-1 of them, with L L^T = C.

    C = blocks + U K U^T. With each cell's U whitened by its own block, of length u and direction d:
    C' = 1 + d (u K u) d^T, and the factor of 1 + u K u whitens what residuals have along d.

    log_determinant: of C.
    """

    def __init__(self, factors: Float, by_path: Float, path_variance: Float) -> None:
        """factors: of the blocks, (c, m, m). by_path: U (c, m). path_variance: K (c, c)."""
        self._factors = factors
        along = self._by_block(by_path)
        length = np.maximum(np.linalg.norm(along, axis=1), 1e-12)
        self._along = along / length[:, None]
        common = np.eye(length.size) + length[:, None] * path_variance * length
        self._common = np.linalg.cholesky(common)
        diagonals = np.einsum("kii->ki", factors), self._common.diagonal()
        self.log_determinant = 2 * float(sum(np.log(diagonal).sum() for diagonal in diagonals))

    def _by_block(self, values: Float) -> Float:
        return np.asarray(np.linalg.solve(self._factors, values[..., None])[..., 0])

    def __call__(self, residual: Float) -> Float:
        whitened = self._by_block(residual)
        along = np.einsum("km,km->k", self._along, whitened)
        change = np.linalg.solve(self._common, along) - along
        return np.asarray(whitened + self._along * change[:, None])
