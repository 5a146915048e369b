# SPDX-License-Identifier: Apache-2.0
"""Learns the force curve of every cell from presses of single cells.

Symbols of the n rows that a curve is learned from; `curve` has a table of the other symbols.

====== ======= ============================================================ ======
symbol shape   meaning                                                      unit
====== ======= ============================================================ ======
x      (n,)    rise above rest; dx its standard deviation                   S, or 1
F      (n,)    force                                                        N
f(x)   (n,)    the curve                                                    N
v      (n,)    variance of F about the curve, but for a factor s^2          1, N^2
p      ()      free coefficients: 2, or 1 for a line through rest           1
====== ======= ============================================================ ======

Presses scatter about their curve in one of two ways. Force sensors are noisy at any force, contacts
in proportion to what they conduct:

    constant  v = 1                                   s0 = s       s1 = 0
    growing   v = F^2 + F0^2,  F0 = 0.1 max F         s0 = s F0    s1 = s

With weights 1/v a curve minimises the sum of (F - f(x))^2 / v; then s^2 = sum / (n - p), and with J
the derivatives of f by its coefficients, K = s^2 (J^T V^-1 J)^-1.

Each cell has four candidates: a line or a power law, whose scatter is constant or grows. They are
compared by the log likelihood of rows held out, with s the root mean square of their own weighted
errors:

    l = -1/2 log(s^2 v) - (F - f(x))^2 / (2 s^2 v)

A power law is taken where l is higher by more than the standard error of that difference over
presses (the rule of one standard error, Breiman et al. 1984). How presses scatter is a property of
the textile: growing scatter is taken for all cells if their l together is higher by two standard
errors.

The s that a curve is kept with differs from that of the fit in three ways:

1. It comes from few presses, so a force is distributed as Student's t with n - p degrees of
   freedom, whose variance is s^2 (n - p) / (n - p - 2).
2. The mean of d^2 / v over the presses is taken off, because predicting adds it again.
3. It is at least the s of held-out presses where presses have several rows, which are alike and so
   scatter too little.

A cell with fewer presses than a curve needs has the curve of all presses times its gain (`gains`).
"""

from dataclasses import replace
from itertools import product
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.calibrate.gains import find_gains
from ohmskin.calibrate.rules import MIN_PRESSES, check_enough, require_forces, require_rows
from ohmskin.force.curve import (
    LINEAR,
    MAX_EXPONENT,
    MIN_EXPONENT,
    POWER,
    Curve,
    ForceModel,
    force_by,
    spread,
)

# The presses of a cell are split into so many parts, each held out once: none of them is empty.
PRESS_FOLDS: Final = MIN_PRESSES
# Cells are held out in at most so many parts. Chosen: the usual ten, so that a large skin takes no
# longer than a small one.
MAX_CELL_FOLDS: Final = 10
# Scatter that grows must predict better by so many standard errors. Chosen: more than the one of
# Breiman's rule, because all cells are changed by it.
SCATTER_ERRORS: Final = 2.0
# F0: below this share of the largest force, scatter no longer shrinks with force. Chosen: without
# it, a press of almost no force would have almost all the weight.
FLOOR_SHARE: Final = 0.1
# Exponents of power laws are first tried on this grid, because the sum of squares may have several
# minima. Each is a tenth above the one before.
EXPONENTS: Final = np.geomspace(MIN_EXPONENT, MAX_EXPONENT, 33)
# Presses that fit exactly count as scattered by this share of their force, so that the logarithm of
# their scatter is finite. Chosen: far below what any force sensor resolves.
_LEAST_SHARE: Final = 1e-6
# What a curve says of its errors.
_ERRORS: Final = ("residual_std", "residual_share", "held_out_rmse")


class ForceRegression:
    """Learns every cell's curve from single touches.

    After `fit`: `model_`, the curves; `message_`: how many cells have no curve of their own, empty
    if none.
    """

    def fit(
        self,
        cells: ArrayLike,
        rise: ArrayLike,
        force_n: ArrayLike,
        *,
        shape: tuple[int, int],
        rise_std: ArrayLike | None = None,
        press: ArrayLike | None = None,
    ) -> Self:
        """Learn from n rows, in each of which one cell alone is touched.

        cells (n,): flat indices, row * columns + column. rise and rise_std (n,): of that cell [S,
        or 1 for `voltage`]. force_n (n,) [N]. shape: (R, C). press (n,): an integer for each press;
        its rows are alike, so they are held out together. Absent, each row is a press.

        A cell keeps a curve of its own from 5 presses on, if its force varies and rises with x. The
        others take the curve of all presses, times the gain that their own presses tell.
        Standard errors of coefficients suppose independent rows. Raises ValueError, naming the row,
        for bad values; for fewer than 5 presses, for forces all the same or that fall with x.
        """
        size = np.size(force_n)
        rows = _Rows(
            x=_array("rise", rise, size),
            force=_array("force_n", force_n, size),
            dx=_array("rise_std", np.zeros(size) if rise_std is None else rise_std, size),
            cell=_array("cells", cells, size, np.intp),
            press=_array("press", np.arange(size) if press is None else press, size, np.intp),
        )
        _check(rows, shape)
        columns, own = _curves_by_gain(rows, shape[0] * shape[1]), _curves_of_cells(rows)
        for cell, curve in own.items():
            for name, value in vars(curve).items():
                columns[name][cell] = value
        arrays = {name: np.array(column).reshape(shape) for name, column in columns.items()}
        is_unknown = np.isnan(arrays["residual_std"])
        pooled = np.ones(shape, dtype=bool)
        pooled.flat[rows.cell] = False
        pooled |= is_unknown
        self.model_ = ForceModel(**arrays, pooled=pooled)
        lines, take = [], f"of {pooled.size} cells take the curve of all presses"
        if by_gain := np.count_nonzero(~pooled) - len(own):
            lines = [f"{by_gain} {take}, with their own gain"]
        if pooled.any():
            unknown = ": how far they are off is unknown" if is_unknown.any() else ""
            lines += [f"{pooled.sum()} {take}{unknown}"]
        self.message_ = "\n".join(lines)
        return self


class _Rows(NamedTuple):
    """What a curve is learned from, arrays (n,).

    x, force, dx: as in the module's table.
    cell: flat index of the cell that was pressed.
    press: number of the press that the row is of.
    """

    x: Float
    force: Float
    dx: Float
    cell: NDArray[np.intp]
    press: NDArray[np.intp]


def _curves_by_gain(rows: _Rows, cells: int) -> dict[str, list[Any]]:
    """The curve of all presses, times the gain of each of so many cells: columns of `Curve`."""
    is_one_cell = np.unique(rows.cell).size == 1
    # Whole cells are held out: what counts is the error on cells that nobody pressed.
    alike, parts = (rows.press, PRESS_FOLDS) if is_one_cell else (rows.cell, MAX_CELL_FOLDS)
    trial = _Trial(rows, alike, parts)
    curve = trial.fitted(grows=False)
    if curve is None:
        raise ValueError("force does not rise with the cells' rise: is the rest of this skin?")
    error_n = trial.errors.get((curve.kind, False))
    of_cells = vars(curve) | dict.fromkeys(_ERRORS, np.nan)
    if not (is_one_cell or error_n is None):  # else nothing tells the error on other cells
        curve_n = np.maximum(force_by(curve, rows.x), 0.0)
        held_out_n = rows.force - error_n
        gains = find_gains(rows.press, rows.cell, rows.force, curve_n, held_out_n, cells)
        share = curve.slope_std / curve.slope
        shares = np.maximum(np.hypot(share, gains.std / gains.gain), 1e-30)
        slopes = curve.slope * gains.gain
        of_cells |= {"slope": slopes, "slope_std": slopes * shares}
        of_cells |= {"correlation": curve.correlation * share / shares}
        of_cells |= dict(zip(_ERRORS, (gains.scatter_n, 0.0, gains.held_out_rmse), strict=True))
    return {name: np.broadcast_to(value, cells).tolist() for name, value in of_cells.items()}


def _curves_of_cells(rows: _Rows) -> dict[int, Curve]:
    """The curves that cells have of their own, by flat index.

    A cell has none if it was pressed less than `MIN_PRESSES` times, if its forces or its rises are
    all the same, or if its force falls with its rise. Nor has it one that its presses do not
    foresee: where some of them are held out, the others may show no rise.
    """
    trials = {}
    for cell in np.unique(rows.cell).tolist():
        of_cell = _Rows(*(column[rows.cell == cell] for column in rows))
        varied = np.ptp(of_cell.force) > 0 and np.ptp(of_cell.x) > 0
        if varied and np.unique(of_cell.press).size >= MIN_PRESSES:
            trials[cell] = _Trial(of_cell, of_cell.press, PRESS_FOLDS)
    # How presses scatter is decided once, by the groups of all cells. (The first, empty list is for
    # the case that there is no trial.)
    gains = np.concatenate([[], *(trial.gain_of_growing() for trial in trials.values())])
    grows = _is_clear(gains, SCATTER_ERRORS)
    curves = {cell: trial.best(grows) for cell, trial in trials.items()}
    return {
        cell: curve
        for cell, curve in curves.items()
        if curve is not None and not np.isnan(curve.residual_std)
    }


def fit_line(x: Float, force: Float, v: Float | float = 1.0) -> Curve | None:
    """Weighted least squares of F = a x. None if a is not above 0.

    x, force, v: as in the module's table; v may be one number for all rows.
    """
    weight = np.ones_like(x) / v
    information = float(weight @ x**2)  # J^T V^-1 J
    a = float(weight @ (x * force)) / information if information else 0.0
    if not a > 0:
        return None
    return Curve(LINEAR, a, float(np.sqrt(_square(force - a * x, weight, 1) / information)))


def fit_power(
    x: Float, force: Float, v: Float | float = 1.0, exponents: Float = EXPONENTS
) -> Curve | None:
    """Weighted least squares of F = a x^b: for each b the best a is known, so b alone is searched.

    x, force, v: as for `fit_line`. exponents: where b is searched, rising. None if the best b is
    the first or the last of them, or if the presses do not tell it.
    """
    from scipy.optimize import minimize_scalar

    unit = float(x.max())
    if unit <= 0 or np.unique(x[x > 0]).size < 2:  # through one point goes a law of any exponent
        return None
    z = np.maximum(x, 0.0) / unit
    weight = np.ones_like(x) / v

    def scale(exponent: float) -> float:
        powered = z**exponent
        return float((weight * powered) @ force / ((weight * powered) @ powered))

    def sum_of_squares(exponent: float) -> float:
        return float(weight @ (force - scale(exponent) * z**exponent) ** 2)

    # The deepest minimum on the grid is refined between its neighbours.
    best = int(np.argmin([sum_of_squares(exponent) for exponent in exponents]))
    if best in (0, exponents.size - 1):
        return None
    bounds, options = (exponents[best - 1], exponents[best + 1]), {"xatol": 1e-10}
    b = float(minimize_scalar(sum_of_squares, bounds=bounds, method="bounded", options=options).x)
    a = scale(b)
    if not a > 0:
        return None
    logs = np.log(np.where(z > 0, z, 1.0))
    jacobian = np.column_stack([z**b, a * z**b * logs]) * np.sqrt(weight)[:, None]
    # a is in N / unit^b here, and a' = a unit^-b in N / S^b. These are the derivatives of (a', b)
    # by (a, b). The inverse is `pinv`, because rises near 0 add nothing to J^T J: if all but one
    # are near 0, it is singular.
    to_si = np.array([[unit**-b, -a * unit**-b * np.log(unit)], [0.0, 1.0]])
    covariance = to_si @ np.linalg.pinv(jacobian.T @ jacobian) @ to_si.T
    covariance *= _square(force - a * z**b, weight, 2)
    a_std, b_std = np.sqrt(np.diag(covariance)).tolist()
    both_std = a_std * b_std
    rho = float(np.clip(covariance[0, 1] / both_std, -1, 1)) if both_std else 0.0
    return Curve(POWER, a * unit**-b, a_std, exponent=b, exponent_std=b_std, correlation=rho)


def _square(residual: Float, weight: Float, coefficients: int) -> float:
    """s^2 of residuals (n,); 0 where the rows are too few to tell it, as in parts of a trial."""
    freedom = residual.size - coefficients
    return float(weight @ residual**2) / freedom if freedom > 0 else 0.0


_FITS: Final = {LINEAR: fit_line, POWER: fit_power}


class _Trial:
    """Compares the four candidates by their errors on rows that were held out.

    A candidate is a pair: the kind of curve, and whether scatter grows. The rows are split into
    parts. Each part is held out once: candidates are fitted to the other rows, and have errors on
    these. One that could not be fitted every time has no errors, and is left out.

    rows: what the curve is learned from.
    alike: a number for each row, (n,), of its press or cell. Rows of one number are a group, which
        is held out as a whole: a curve that is fitted to some of them would know the others, too.
    parts: the groups are split into at most so many parts.

    errors: of each row [N], by candidate, (n,).
    """

    def __init__(self, rows: _Rows, alike: NDArray[np.intp], parts: int) -> None:
        self._rows = rows
        self._group = np.unique(alike, return_inverse=True)[1]
        self._groups = int(self._group.max()) + 1
        self._floor_n = FLOOR_SHARE * float(rows.force.max())  # F0
        self._v = {False: np.ones_like(rows.force), True: rows.force**2 + self._floor_n**2}
        self.errors: dict[tuple[str, bool], Float] = {}
        parts = min(parts, self._groups)
        # Shuffled, because forces often rise from press to press: a part that is held out must not
        # be all of the large ones.
        fold = np.random.default_rng(0).permutation(self._groups)[self._group] % parts
        for (kind, fit), grows in product(_FITS.items(), (False, True)):
            error = np.full_like(rows.force, np.inf)
            for held in range(parts):
                out = fold == held
                curve = fit(rows.x[~out], rows.force[~out], self._v[grows][~out])
                if curve is not None:
                    error[out] = rows.force[out] - np.maximum(force_by(curve, rows.x[out]), 0.0)
            if np.isfinite(error).all():
                self.errors[kind, grows] = error

    def fitted(self, grows: bool) -> Curve | None:
        """The curve of the kind that predicts held-out groups better; None where no curve rises."""
        rows, v = self._rows, self._v[grows]
        fits = (_FITS[kind](rows.x, rows.force, v) for kind in self._kinds(grows))
        return next((fit for fit in fits if fit is not None), None)

    def best(self, grows: bool) -> Curve | None:
        """The same, with how presses scatter about it."""
        curve = self.fitted(grows)
        if curve is None:
            return None
        rows, v = self._rows, self._v[grows]
        coefficients = 2 if curve.is_power else 1
        # Numbers are those of the module's list. 1: in s^2 times Student's factor, n - p cancels.
        freedom = rows.x.size - coefficients
        predicted, off = spread(curve, rows.x, rows.dx)
        square = float(np.sum((rows.force - predicted) ** 2 / v)) / (freedom - 2)
        by_rise = float(np.mean(off**2 / v))  # 2
        s = float(np.sqrt(max(square - by_rise, 0.0)))
        error = self.errors.get((curve.kind, grows), np.full_like(v, np.nan))
        held_out_s = _rms(error / np.sqrt(v))
        if self._groups < rows.x.size:  # 3; Student's factor by presses
            freedom = self._groups - coefficients
            s = float(np.maximum(s, held_out_s * np.sqrt(freedom / (freedom - 2))))
        s0, s1 = (s * self._floor_n, s) if grows else (s, 0.0)
        return replace(curve, residual_std=s0, residual_share=s1, held_out_rmse=_rms(error))

    def gain_of_growing(self) -> Float:
        """How much growing scatter raises the log likelihood of each group; empty if unknown.

        Each way of scattering is tried with the kind of curve that is the better one under it.
        """
        constant, growing = ((self._kinds(grows)[0], grows) for grows in (False, True))
        if constant not in self.errors or growing not in self.errors:
            return np.empty(0)
        return self._log_likelihood(*growing) - self._log_likelihood(*constant)

    def _kinds(self, grows: bool) -> list[str]:
        """The kinds to try, the better one first; a line if no kind has errors to compare."""
        tried = [kind for kind in _FITS if (kind, grows) in self.errors]
        if len(tried) == 2:
            gain = self._log_likelihood(POWER, grows) - self._log_likelihood(LINEAR, grows)
            return [POWER, LINEAR] if _is_clear(gain, 1) else tried
        return tried or [LINEAR]

    def _log_likelihood(self, kind: str, grows: bool) -> Float:
        """l of the module's equation for a candidate, the mean over the rows of each group."""
        error, v = self.errors[kind, grows], self._v[grows]
        least = _LEAST_SHARE**2 * float(np.mean(self._rows.force**2 / v))
        v = v * max(float(np.mean(error**2 / v)), least)
        of_rows = -0.5 * np.log(v) - 0.5 * error**2 / v
        return np.asarray(np.bincount(self._group, of_rows) / np.bincount(self._group))


def _is_clear(gain: Float, standard_errors: float) -> bool:
    """Whether the mean of gains (groups,) is above 0 by so many of its standard errors."""
    if gain.size < 2:  # one gain has no standard error
        return False
    return bool(gain.mean() > standard_errors * gain.std(ddof=1) / np.sqrt(gain.size))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _check(rows: _Rows, shape: tuple[int, int]) -> None:
    """Raise ValueError as `ForceRegression.fit`."""
    require_forces(rows.force)
    require_rows("rise_std", rows.dx, rows.dx >= 0, "0 or more")
    on_skin = (rows.cell >= 0) & (rows.cell < shape[0] * shape[1])
    require_rows("cells", rows.cell, on_skin, f"one of a {shape[0]}x{shape[1]} skin")
    check_enough(np.unique(rows.press).size, rows.force)


def _array(name: str, values: ArrayLike, size: int, dtype: Any = np.float64) -> Any:
    array = np.asarray(values)
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}, it must be {(size,)}")
    if array.size and not np.can_cast(array.dtype, dtype, "same_kind"):
        raise ValueError(f"{name} holds {array.dtype}, it must hold {np.dtype(dtype)}")
    require_rows(name, array, np.isfinite(array), "finite")
    return array.astype(dtype)
