# SPDX-License-Identifier: Apache-2.0
"""Learns the force curve of every cell from presses of single cells.

Symbols, of the n rows that a curve is learned from (`curve` has those of the curves)

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

so that a newton at 8 N weighs as much as the scatter there lets it. A power law is taken where l is
higher by more than the standard error of that difference over presses (the rule of one standard
error, Breiman et al. 1984). How presses scatter is a property of the textile: growing scatter is
taken for all cells if their l together is higher by two standard errors.

s comes from few presses, so that of a force is the standard deviation of Student's t with n - p
degrees of freedom: s^2 (n - p) / (n - p - 2). Where the dx of presses are known, the mean of
d^2 / v over them is taken off, because predicting adds it again. Where presses have several rows,
s is at least that of held-out presses. For cells that nobody pressed, it is at least that of
held-out cells.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.force.curve import (
    LINEAR,
    MAX_EXPONENT,
    MIN_EXPONENT,
    POWER,
    ForceModel,
    force_by,
    spread,
)

# A curve has 2 coefficients: fewer presses leave 2 degrees of freedom, for which Student's t has no
# finite variance.
MIN_PRESSES: Final = 5
# Cells are held out in at most so many parts, so that a large skin takes no longer.
MAX_CELL_FOLDS: Final = 10
# Scatter that grows must be better by so many standard errors.
SCATTER_ERRORS: Final = 2.0
# F0: below this share of the largest force, scatter no longer shrinks with force.
FLOOR_SHARE: Final = 0.1
# Exponents of power laws are first tried on this grid, because errors may have several minima.
EXPONENTS: Final = np.geomspace(MIN_EXPONENT, MAX_EXPONENT, 33)
# Presses that fit exactly still scatter by this share of their force.
_LEAST_SHARE: Final = 1e-6


# ------------------------------------------------------------------------------- one curve's fit


@dataclass(frozen=True)
class Curve:
    """One cell's curve: the fields of `ForceModel`, as numbers."""

    kind: str
    slope: float
    slope_std: float
    residual_std: float = 0.0
    residual_share: float = 0.0
    correlation: float = 0.0
    exponent: float = 1.0
    exponent_std: float = 0.0
    intercept: float = 0.0
    intercept_std: float = 0.0
    held_out_rmse: float = np.nan

    def force(self, x: Float) -> Float:
        """F at rises x (n,) [N], before forces below 0 are cut."""
        return force_by(self.kind, self.slope, self.exponent, self.intercept, x)


def variance(force: Float, floor_n: float) -> Float:
    """v of the module at forces (n,). floor_n: F0 of scatter that grows; 0: it is constant."""
    return np.asarray(force**2 + floor_n**2) if floor_n else np.ones_like(force)


def fit_line(x: Float, force: Float, floor_n: float = 0.0, *, intercept: bool) -> Curve | None:
    """Weighted least squares of F = a x, or a x + c. None if a is not above 0.

    x, force (n,); floor_n: see `variance`.
    """
    unit = float(np.abs(x).max())  # siemens are small: keeps the columns alike
    if unit == 0 or (intercept and np.ptp(x) == 0):
        return None
    design = np.column_stack([x / unit, np.ones_like(x)] if intercept else [x / unit])
    root = variance(force, floor_n) ** -0.5
    weighted = design * root[:, None]
    found = np.linalg.pinv(weighted.T @ weighted) @ weighted.T @ (force * root)
    if not found[0] > 0:
        return None
    covariance = _covariance(weighted, (force - design @ found) * root)
    errors = np.sqrt(np.diag(covariance))
    curve = Curve(LINEAR, float(found[0] / unit), float(errors[0] / unit))
    if intercept:
        c, c_std = float(found[1]), float(errors[1])
        correlation = _correlation(covariance)
        curve = replace(curve, intercept=c, intercept_std=c_std, correlation=correlation)
    return curve


def fit_power(
    x: Float, force: Float, floor_n: float = 0.0, exponents: Float = EXPONENTS
) -> Curve | None:
    """Weighted least squares of F = a x^b: for each b the best a is known, so b alone is searched.

    x, force (n,); floor_n: see `variance`; exponents: where b is searched, rising. None if b runs
    into their ends, or if the presses do not tell it.
    """
    from scipy.optimize import minimize_scalar

    unit = float(x.max())
    if unit <= 0 or np.unique(x[x > 0]).size < 2:
        return None
    z = np.maximum(x, 0.0) / unit
    weight = 1 / variance(force, floor_n)

    def scale(exponent: float) -> float:
        powered = z**exponent
        return float((weight * powered) @ force / ((weight * powered) @ powered))

    def sum_of_squares(exponent: float) -> float:
        return float(weight @ (force - scale(exponent) * z**exponent) ** 2)

    # It may have several minima: the deepest on the grid is refined.
    best = int(np.argmin([sum_of_squares(exponent) for exponent in exponents]))
    if best in (0, exponents.size - 1):
        return None
    bounds, options = (exponents[best - 1], exponents[best + 1]), {"xatol": 1e-10}
    b = float(minimize_scalar(sum_of_squares, bounds=bounds, method="bounded", options=options).x)
    a = scale(b)
    if not a > 0:
        return None
    logs = np.log(np.where(z > 0, z, 1.0))
    root = np.sqrt(weight)
    jacobian = np.column_stack([z**b, a * z**b * logs]) * root[:, None]
    # From a per unit^b to a per S^b: a_S = a unit^-b.
    to_si = np.array([[unit**-b, -a * unit**-b * np.log(unit)], [0.0, 1.0]])
    covariance = to_si @ _covariance(jacobian, (force - a * z**b) * root) @ to_si.T
    a_std, b_std = np.sqrt(np.diag(covariance)).tolist()
    return Curve(
        *(POWER, a * unit**-b, a_std),
        exponent=b,
        exponent_std=b_std,
        correlation=_correlation(covariance),
    )


def _covariance(jacobian: Float, residual: Float) -> Float:
    """K, of J (n, p) and F - f(x) (n,), both times v^-1/2; 0 where a training fold tells no s."""
    count, coefficients = jacobian.shape
    freedom = count - coefficients
    square = float(residual @ residual) / freedom if freedom > 0 else 0.0
    return np.asarray(square * np.linalg.pinv(jacobian.T @ jacobian))


def _correlation(covariance: Float) -> float:
    scale = float(np.sqrt(covariance[0, 0] * covariance[1, 1]))
    return float(np.clip(covariance[0, 1] / scale, -1.0, 1.0)) if scale > 0 else 0.0


# ---------------------------------------------------------------------------- curves of all cells


class ForceRegression:
    """Learns every cell's curve from single touches.

    fit_intercept: give lines an intercept c, as the paper's regression has. Then untouched cells
    report c, too. folds: parts that the presses of a cell are split into, each held out once.

    After `fit`: `model_`, the curves; `message_`: which cells have no curve of their own, empty if
    none.
    """

    def __init__(self, *, fit_intercept: bool = False, folds: int = 5) -> None:
        if folds < 2:
            raise ValueError(f"folds must be at least 2, not {folds}")
        self.fit_intercept = fit_intercept
        self.folds = folds

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

        cells: flat indices (n,), row * columns + column, or (row, column) pairs (n, 2). rise and
        rise_std (n,): of that cell [S, or 1 for `voltage`]. force_n (n,) [N]. shape: (R, C).
        press (n,): an integer for each press, shared by the rows recorded during it. They
        resemble one another, so they are held out together; absent, each row is a press.

        A cell keeps a curve of its own from 5 presses on, if its force varies and rises with x; the
        others take the curve of all presses, with the error it shows on cells not fitted.
        Standard errors of coefficients suppose independent rows. Raises ValueError, naming the row,
        for bad values; for fewer than 5 presses, for forces all the same or that fall with x.
        """
        rows = _checked(cells, rise, force_n, shape, rise_std, press)
        of_skin = self._curve_of_skin(rows)
        own = self._curves_of_cells(rows)
        every_cell = range(shape[0] * shape[1])
        curves = [own.get(cell, of_skin) for cell in every_cell]
        arrays = {
            field.name: np.array([getattr(curve, field.name) for curve in curves]).reshape(shape)
            for field in fields(Curve)
        }
        pooled = np.array([cell not in own for cell in every_cell]).reshape(shape)
        self.model_ = ForceModel(**arrays, pooled=pooled)
        self.message_ = _pooled_message(pooled, np.unique(rows.cell), of_skin)
        return self

    def _curve_of_skin(self, rows: _Rows) -> Curve:
        """The curve of all presses, for cells without a curve of their own."""
        is_one_cell = np.unique(rows.cell).size == 1
        if is_one_cell:
            trial = self._trial(rows, rows.press, self.folds)
        else:  # what counts is the error on cells that were not fitted
            trial = self._trial(rows, rows.cell, MAX_CELL_FOLDS)
        choice = self._choose(trial, grows=_is_clear(trial.gain_of_growing(), SCATTER_ERRORS))
        if choice is None:
            raise ValueError("force does not rise with the cells' rise: is the rest of this skin?")
        if is_one_cell:
            return replace(choice.curve(np.nan), held_out_rmse=np.nan)
        return choice.curve(float(np.maximum(choice.s, choice.held_out_s)))  # NaN stays

    def _curves_of_cells(self, rows: _Rows) -> dict[int, Curve]:
        """The curves that cells have of their own, by flat index."""
        trials = {}
        for cell in np.unique(rows.cell).tolist():
            of_cell = rows.some(rows.cell == cell)
            if of_cell.are_enough:
                trials[cell] = self._trial(of_cell, of_cell.press, self.folds)
        gains = np.concatenate([[], *(trial.gain_of_growing() for trial in trials.values())])
        grows = _is_clear(gains, SCATTER_ERRORS)
        chosen = {cell: self._choose(trial, grows=grows) for cell, trial in trials.items()}
        return {
            cell: choice.curve(self._own_s(choice, trials[cell]))
            for cell, choice in chosen.items()
            if choice is not None
        }

    def _own_s(self, choice: _Choice, trial: _Trial) -> float:
        """s of a cell's own curve: where presses have several rows, that of held-out presses."""
        if trial.groups == trial.rows.x.size:
            return choice.s
        freedom = trial.groups - self._coefficients(choice.fitted.kind)
        return float(np.maximum(choice.s, choice.held_out_s * np.sqrt(freedom / (freedom - 2))))

    def _trial(self, rows: _Rows, of: NDArray[np.intp], parts: int) -> _Trial:
        """The errors of all candidates on rows held out. of (n,): rows of a group go together."""
        group = np.unique(of, return_inverse=True)[1]
        groups = int(group.max()) + 1
        # Shuffled, for the forces of successive presses often follow a pattern of their own.
        fold = np.random.default_rng(0).permutation(groups)[group]
        fold %= min(parts, groups)
        errors = {}
        for kind, grows in product((LINEAR, POWER), (False, True)):
            error = np.empty_like(rows.force)
            for held in range(int(fold.max()) + 1):
                out = fold == held
                curve = self._fit(kind, rows.some(~out), rows.floor_n(grows=grows))
                error[out] = np.inf
                if curve is not None:
                    error[out] = rows.force[out] - np.maximum(curve.force(rows.x[out]), 0.0)
            if np.isfinite(error).all():
                errors[kind, grows] = error
        return _Trial(rows, group, errors)

    def _choose(self, trial: _Trial, *, grows: bool) -> _Choice | None:
        """The kind that predicts held-out groups better; None where no curve rises."""
        rows, floor_n = trial.rows, trial.rows.floor_n(grows=grows)
        for kind in trial.kinds(grows=grows):
            curve = self._fit(kind, rows, floor_n)
            if curve is not None:
                v = variance(rows.force, floor_n)
                error = trial.errors.get((kind, grows), np.full_like(rows.force, np.nan))
                curve = replace(curve, held_out_rmse=_rms(error))
                return _Choice(curve, floor_n, self._s(curve, rows, v), _rms(error / np.sqrt(v)))
        return None

    def _fit(self, kind: str, rows: _Rows, floor_n: float) -> Curve | None:
        if kind == POWER:
            return fit_power(rows.x, rows.force, floor_n)
        return fit_line(rows.x, rows.force, floor_n, intercept=self.fit_intercept)

    def _s(self, curve: Curve, rows: _Rows, v: Float) -> float:
        """s as the fitted presses tell it."""
        # Of Student's t: rss / (n - p) times (n - p) / (n - p - 2).
        freedom = rows.x.size - self._coefficients(curve.kind)
        square = float(np.sum((rows.force - curve.force(rows.x)) ** 2 / v)) / (freedom - 2)
        of_rise = float(np.mean(spread(curve.force, rows.x, rows.dx) ** 2 / v))
        return float(np.sqrt(max(square - of_rise, 0.0)))

    def _coefficients(self, kind: str) -> int:
        return 2 if kind == POWER or self.fit_intercept else 1


@dataclass(frozen=True, eq=False)
class _Rows:
    """What a curve is learned from, arrays (n,): x, F, dx, flat index of the cell, press."""

    x: Float
    force: Float
    dx: Float
    cell: NDArray[np.intp]
    press: NDArray[np.intp]

    def some(self, which: NDArray[np.bool_]) -> _Rows:
        """These rows alone."""
        return _Rows(*(getattr(self, field.name)[which] for field in fields(self)))

    @property
    def are_enough(self) -> bool:
        """Whether a cell can have a curve of its own."""
        varied = bool(np.ptp(self.force) > 0 and np.ptp(self.x) > 0)
        return varied and np.unique(self.press).size >= MIN_PRESSES

    def floor_n(self, *, grows: bool) -> float:
        """F0 [N]; 0 for constant scatter."""
        return FLOOR_SHARE * float(self.force.max()) if grows else 0.0


@dataclass(frozen=True, eq=False)
class _Trial:
    """Errors on held-out rows. group (n,): of each row, from 0 without gaps.

    errors: (n,) [N] by candidate (kind, whether scatter grows). A candidate has none if it cannot
    be fitted without some group.
    """

    rows: _Rows
    group: NDArray[np.intp]
    errors: dict[tuple[str, bool], Float]

    @property
    def groups(self) -> int:
        """How many groups there are."""
        return int(self.group.max()) + 1

    def kinds(self, *, grows: bool) -> list[str]:
        """The better kind first; a line of unknown error, if none is known."""
        known = [kind for kind in (LINEAR, POWER) if (kind, grows) in self.errors]
        if len(known) == 2 and _is_clear(self._gain((POWER, grows), (LINEAR, grows)), 1):
            known.reverse()
        return known or [LINEAR]

    def gain_of_growing(self) -> Float:
        """Log likelihood gained by scatter that grows, of each group; empty if unknown."""
        constant, growing = ((self.kinds(grows=grows)[0], grows) for grows in (False, True))
        if constant not in self.errors or growing not in self.errors:
            return np.empty(0)
        return self._gain(growing, constant)

    def _gain(self, one: tuple[str, bool], other: tuple[str, bool]) -> Float:
        gain = self._log_likelihood(one) - self._log_likelihood(other)
        return np.asarray(np.bincount(self.group, gain) / np.bincount(self.group))

    def _log_likelihood(self, candidate: tuple[str, bool]) -> Float:
        """l of the module's equation, (n,)."""
        error, force = self.errors[candidate], self.rows.force
        v = variance(force, self.rows.floor_n(grows=candidate[1]))
        least = _LEAST_SHARE**2 * float(np.mean(force**2 / v))
        v = v * max(float(np.mean(error**2 / v)), least)
        return np.asarray(-0.5 * np.log(v) - 0.5 * error**2 / v)


class _Choice(NamedTuple):
    """A fitted curve, F0 of its scatter, and s of the presses fitted and of those held out."""

    fitted: Curve
    floor_n: float
    s: float
    held_out_s: float

    def curve(self, s: float) -> Curve:
        """The curve with this s."""
        s0, s1 = (s * self.floor_n, s) if self.floor_n else (s, 0.0)
        return replace(self.fitted, residual_std=s0, residual_share=s1)


def _is_clear(gain: Float, errors: float) -> bool:
    """Whether the mean is above 0 by so many standard errors."""
    return gain.size > 1 and bool(gain.mean() > errors * gain.std(ddof=1) / np.sqrt(gain.size))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


# ---------------------------------------------------------------------------- what `fit` is given


def _checked(
    cells: ArrayLike,
    rise: ArrayLike,
    force_n: ArrayLike,
    shape: tuple[int, int],
    rise_std: ArrayLike | None,
    press: ArrayLike | None,
) -> _Rows:
    """The arguments of `ForceRegression.fit` as arrays. Raises ValueError as it does."""
    if min(shape) < 1:
        raise ValueError(f"a skin has at least 1x1 cells, not {shape[0]}x{shape[1]}")
    force = _array("force_n", force_n, (np.size(force_n),))
    if not force.size:
        raise ValueError("force_n is empty: there are no presses")
    known = force.shape
    rows = _Rows(
        x=_array("rise", rise, known),
        force=force,
        dx=np.zeros(known) if rise_std is None else _array("rise_std", rise_std, known),
        cell=_flat_cells(cells, force.size, shape),
        press=np.arange(force.size) if press is None else _array("press", press, known, np.intp),
    )
    for name, values in (("force_n", force), ("rise_std", rows.dx)):
        if values.min() < 0:
            row = int(np.argmax(values < 0))
            hint = ": zero the force sensor, or leave the row out" if name == "force_n" else ""
            raise ValueError(f"row {row}: {name} is {values[row]:g}, it must be 0 or more{hint}")
    number = np.unique(rows.press).size
    if number < MIN_PRESSES:
        raise ValueError(f"too few presses: {number}, {MIN_PRESSES} are needed")
    if np.ptp(force) == 0:
        raise ValueError(f"all {force.size} forces are {force[0]:g} N: press with different forces")
    return rows


def _array(name: str, values: ArrayLike, shape: tuple[int, ...], dtype: Any = np.float64) -> Any:
    array = np.asarray(values)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, it must be {shape}")
    kinds, what = ("iu", "integers") if dtype is np.intp else ("iuf", "numbers")
    if array.dtype.kind not in kinds:
        raise ValueError(f"{name} holds {array.dtype}, it must hold {what}")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array)))
        raise ValueError(f"row {row}: {name} is {array[row]:g}, it must be finite")
    return array.astype(dtype)


def _flat_cells(cells: ArrayLike, count: int, shape: tuple[int, int]) -> NDArray[np.intp]:
    pairs = np.ndim(cells) == 2
    array = _array("cells", cells, (count, 2) if pairs else (count,), np.intp)
    indices, limits = (array, shape) if pairs else (array[:, None], (shape[0] * shape[1],))
    outside = ((indices < 0) | (indices >= limits)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise ValueError(
            f"row {row}: no cell {array[row].tolist()} on a {shape[0]}x{shape[1]} skin"
        )
    return np.asarray(array @ [shape[1], 1] if pairs else array)


def _pooled_message(pooled: NDArray[np.bool_], pressed: NDArray[np.intp], skin: Curve) -> str:
    """Which cells have no curve of their own. pressed: flat indices of those with presses."""
    if not pooled.any():
        return ""
    message = f"{pooled.sum()} of {pooled.size} cells take the curve of all presses"
    if pressed.size == 1:
        message += f", all on cell {divmod(int(pressed[0]), pooled.shape[1])}"
    unknown = np.isnan(skin.residual_std)
    return f"{message}: how far they are off is unknown" if unknown else message
