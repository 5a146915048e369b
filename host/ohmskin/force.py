# SPDX-License-Identifier: Apache-2.0
"""From what a cell shows to the force on it [N]: regressions learned from single touches.

Symbols

====== ======= ======================================================================= ==========
symbol shape   meaning                                                                 unit
====== ======= ======================================================================= ==========
x      (R, C)  rise above rest: conductance g - g_rest, or the reading's (`voltage`)   S, or 1
F      (R, C)  force normal to the skin                                                N
a      (R, C)  `slope`                                                                 N / x^b
b      (R, C)  `exponent`, 1 where the cell is linear                                  1
c      (R, C)  `intercept`, 0 unless asked for                                         N
K      (2, 2)  covariance of a cell's two free coefficients: (a, c), or (a, b)
s      (R, C)  `residual_std`: scatter of presses about the curve                      N
dx     (R, C)  standard deviation of x                                                 as x
====== ======= ======================================================================= ==========

Two kinds of curve, both by ordinary least squares in newtons:

    linear  F = a x + c   (section IV.G of the paper; c = 0 makes an untouched cell report no force)
    power   F = a x^b     (x < 0 counts as 0)

A power law is taken where its held-out squared error is lower by more than the standard error of
that difference over presses (the rule of one standard error, Breiman et al. 1984), else the line.

Standard deviation of a force, with J the derivatives of F by the cell's free coefficients:

    F_std^2 = d^2 + s^2 + J K J^T ,     d = max(F(x + dx) - F(x), F(x) - F(x - dx)) .

For a line d = a dx; for x^b with b < 1 the differential is infinite at rest, the difference is not.
s comes from few presses, so it is the standard deviation of Student's t with n - p degrees of
freedom: s^2 = rss / (n - p) (n - p) / (n - p - 2), less the mean of d^2 over the presses where
their dx is told, since predicting adds that again. Where presses have several rows, or cells no
press, s is at least the error on held-out presses, or cells: their scatter is what counts then.

One table of symbols serves the model, the choice and the fits: hence one file, if a long one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from ohmskin.circuit import READING_OFFSET, READING_SIGN, Float

LINEAR: Final = "linear"
POWER: Final = "power"
MIN_EXPONENT: Final = 0.2
MAX_EXPONENT: Final = 5.0
# With 2 coefficients fewer leave 2 degrees of freedom: no finite variance of Student's t.
MIN_PRESSES: Final = 5
# Cells are held out in so many groups at most, so that a large skin takes no longer.
MAX_CELL_FOLDS: Final = 10


def voltage_level(ratio: ArrayLike) -> Float:
    """What `voltage`, the paper's "naive" baseline, regresses on: (..., 4) [V/Vdd] to (...) [1].

    Mean over the configurations of sign (y - offset): voltage over the reference resistors, which
    grows with the cell's conductance. All four round alike, so its standard deviation is that of
    one reading (`SkinKnowledge.ratio_std`). Raises ValueError for another shape.
    """
    readings = np.asarray(ratio, dtype=np.float64)
    if readings.ndim < 1 or readings.shape[-1] != READING_SIGN.size:
        raise ValueError(f"ratio has shape {readings.shape}, it must end in {READING_SIGN.size}")
    return np.asarray((readings - READING_OFFSET) @ READING_SIGN / READING_SIGN.size)


@dataclass(frozen=True, eq=False)
class ForceModel:
    """The curve of every cell, each array (R, C); symbols and units in the module's table.

    kind: "linear" or "power". slope, exponent, intercept and their standard errors (0: fixed).
    correlation: of the errors of slope and of the other free coefficient.
    residual_std: s; NaN where nothing tells it. pooled: the cell has no curve of its own but the
    skin's. held_out_rmse: error on presses not fitted [N], of pooled cells on cells not fitted;
    NaN where nothing tells it. Raises ValueError, naming the array, for what no fit gives.
    """

    kind: NDArray[np.str_]
    slope: Float
    slope_std: Float
    exponent: Float
    exponent_std: Float
    intercept: Float
    intercept_std: Float
    correlation: Float
    residual_std: Float
    pooled: NDArray[np.bool_]
    held_out_rmse: Float

    def __post_init__(self) -> None:
        shape = self.kind.shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"kind has shape {shape}, it must be (rows, columns)")
        for field in fields(self):
            array = getattr(self, field.name)
            if array.shape != shape:
                raise ValueError(f"{field.name} has shape {array.shape}, kind {shape}")
        power = self.kind == POWER
        _require("kind", power | (self.kind == LINEAR), f"neither {LINEAR} nor {POWER}")
        for name in ("slope", "exponent", "intercept", "correlation"):
            _require(name, np.isfinite(getattr(self, name)), "not finite")
        for name in ("slope_std", "exponent_std", "intercept_std"):
            std = getattr(self, name)
            _require(name, np.isfinite(std) & (std >= 0), "not finite and >= 0")
        for name in ("residual_std", "held_out_rmse"):
            known = getattr(self, name)
            _require(name, np.isnan(known) | (np.isfinite(known) & (known >= 0)), "negative or inf")
        _require("slope", self.slope > 0, "not above 0")
        _require("correlation", np.abs(self.correlation) <= 1, "not in -1..1")
        inside = (self.exponent >= MIN_EXPONENT) & (self.exponent <= MAX_EXPONENT)
        _require("exponent", inside, f"not in {MIN_EXPONENT:g}..{MAX_EXPONENT:g}")
        _require("exponent", power | (self.exponent == 1), "not 1, as of a linear cell")
        _require("exponent_std", power | (self.exponent_std == 0), "not 0, as of a linear cell")
        _require("intercept", ~power | (self.intercept == 0), "not 0, as of a power law")
        _require("intercept_std", ~power | (self.intercept_std == 0), "not 0, as of a power law")

    def predict(self, rise: ArrayLike, rise_std: ArrayLike) -> tuple[Float, Float]:
        """Force and its standard deviation [N], each (R, C), of rises above rest (R, C).

        No force is below 0; the standard deviation is that before the cut. It is NaN where
        `rise_std` is (the method gives none), and where the scatter is unknown: in cells without
        data when one cell alone was pressed, say. Raises ValueError, naming the cell, for a shape
        or a value that cannot be.
        """
        x, dx = self._checked("rise", rise), self._checked("rise_std", rise_std)
        _require("rise", np.isfinite(x), "not finite")
        _require("rise_std", ~(dx < 0) & ~np.isinf(dx), "negative or inf")
        force_n = self._curve(x)
        known_dx = np.nan_to_num(dx)
        spread = np.maximum(
            self._curve(x + known_dx) - force_n, force_n - self._curve(x - known_dx)
        )
        power = self.kind == POWER
        above = np.maximum(x, 0.0)
        safe = np.where(above > 0, above, 1.0)
        powered = above**self.exponent
        by_slope = np.where(power, powered, x) * self.slope_std
        by_other = np.where(
            power, self.slope * powered * np.log(safe) * self.exponent_std, self.intercept_std
        )
        # The two nearly cancel in a power law, whose slope is that at 1 S: far from any press.
        of_fit = by_slope**2 + by_other**2 + 2 * self.correlation * by_slope * by_other
        variance = spread**2 + self.residual_std**2 + np.maximum(of_fit, 0.0)
        variance = np.where(np.isnan(dx), np.nan, variance)
        return np.maximum(force_n, 0.0), np.sqrt(variance)

    def _curve(self, x: Float) -> Float:
        powered = self.slope * np.maximum(x, 0.0) ** self.exponent
        return np.where(self.kind == POWER, powered, self.slope * x + self.intercept)

    def _checked(self, name: str, values: ArrayLike) -> Float:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != self.kind.shape:
            raise ValueError(f"{name} has shape {array.shape}, this calibration {self.kind.shape}")
        return array


class ForceRegression:
    """Learns every cell's curve from single touches: `fit`, then `predict`.

    fit_intercept: give lines an intercept c, as the paper's regression has. Then untouched cells
    report c, too. folds: parts that the presses of a cell are split into, each held out once.

    After `fit`: `model_` (a `ForceModel`) and its arrays (R, C) as `kind_`, `slope_`,
    `slope_std_`, `exponent_`, `exponent_std_`, `intercept_`, `intercept_std_`, `residual_std_`,
    `pooled_`, `held_out_rmse_`; `message_`: which cells have no curve of their own, empty if none.
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
        rows, columns = shape
        if rows < 1 or columns < 1:
            raise ValueError(f"a skin has at least 1x1 cells, not {rows}x{columns}")
        force = _column("force_n", force_n)
        count = force.size
        x = _column("rise", rise, count)
        dx = np.zeros(count) if rise_std is None else _column("rise_std", rise_std, count)
        flat = _flat_cells(cells, count, (rows, columns))
        presses = np.arange(count) if press is None else _integers("press", press, (count,))
        for name, bad in (("force_n", force < 0), ("rise_std", dx < 0)):
            if bad.any():
                row = int(np.argmax(bad))
                value = float((force if name == "force_n" else dx)[row])
                hint = ": zero the force sensor, or leave the row out" if name == "force_n" else ""
                raise ValueError(f"row {row}: {name} is {value:g}, it must be 0 or more{hint}")
        number = np.unique(presses).size
        if number < MIN_PRESSES:
            are = "press is" if number == 1 else "presses are"
            raise ValueError(f"{number} {are} too few: {MIN_PRESSES} are needed")
        if np.ptp(force) == 0:
            raise ValueError(f"all {count} forces are {force[0]:g} N: press with different forces")

        pressed = np.unique(flat)
        if pressed.size > 1:
            groups = np.searchsorted(pressed, flat)
            parts = min(pressed.size, MAX_CELL_FOLDS)
        else:
            groups, parts = presses, self.folds
        skin = self._choose(x, force, dx, groups, parts)
        if skin is None:
            raise ValueError("force does not rise with the cells' rise: is the rest of this skin?")
        if pressed.size == 1:
            skin.held_out_rmse = np.nan
        skin.residual_std = float(np.maximum(skin.residual_std, skin.held_out_rmse))  # NaN stays
        curves = [skin] * (rows * columns)
        pooled = np.ones(rows * columns, dtype=np.bool_)
        for cell in pressed:
            of_cell = flat == cell
            own = self._own(x[of_cell], force[of_cell], dx[of_cell], presses[of_cell])
            if own is not None:
                curves[cell], pooled[cell] = own, False

        names = [field.name for field in fields(_Curve)]
        arrays = {
            name: np.array([getattr(curve, name) for curve in curves]).reshape(shape)
            for name in names
        }
        self.model_ = ForceModel(**arrays, pooled=pooled.reshape(shape))
        for field in fields(ForceModel):
            setattr(self, f"{field.name}_", getattr(self.model_, field.name))
        self.message_ = _pooled_message(pooled, pressed, columns, skin)
        return self

    def predict(self, rise: ArrayLike, rise_std: ArrayLike) -> tuple[Float, Float]:
        """`ForceModel.predict` of what was learned. Raises ValueError before `fit`."""
        if not hasattr(self, "model_"):
            raise ValueError("nothing is learned yet: call fit first")
        return self.model_.predict(rise, rise_std)

    def _own(self, x: Float, force: Float, dx: Float, presses: NDArray[np.intp]) -> _Curve | None:
        number = np.unique(presses).size
        if number < MIN_PRESSES or np.ptp(force) == 0 or np.ptp(x) == 0:
            return None
        curve = self._choose(x, force, dx, presses, self.folds)
        if curve is not None and number < x.size:
            freedom = number - (2 if curve.kind == POWER or self.fit_intercept else 1)
            held_out = curve.held_out_rmse * np.sqrt(freedom / (freedom - 2))
            curve.residual_std = float(np.maximum(curve.residual_std, held_out))
        return curve

    def _choose(
        self, x: Float, force: Float, dx: Float, groups: NDArray[np.intp], parts: int
    ) -> _Curve | None:
        """The kind that predicts held-out groups better; None where no curve rises."""
        _, group = np.unique(groups, return_inverse=True)
        number = int(group.max()) + 1
        # Shuffled, for the forces of successive presses often follow a pattern of their own.
        fold = np.random.default_rng(0).permutation(number)[group] % min(parts, number)
        squared = {}
        for kind in (LINEAR, POWER):
            error = np.empty_like(force)
            for held in range(int(fold.max()) + 1):
                out = fold == held
                fitted = self._fit(kind, x[~out], force[~out])
                error[out] = np.inf if fitted is None else force[out] - fitted.force(x[out])
            squared[kind] = error**2
        # Where some group alone rises, no error can be held out: a line, of unknown error.
        kinds = [kind for kind in squared if np.isfinite(squared[kind]).all()] or [LINEAR]
        if len(kinds) == 2:
            members = np.bincount(group)
            gain = np.bincount(group, squared[LINEAR] - squared[POWER]) / members
            if gain.mean() > gain.std(ddof=1) / np.sqrt(number):
                kinds.reverse()
        for kind in kinds:
            curve = self._fit(kind, x, force, dx)
            if curve is not None:
                rmse = float(np.sqrt(squared[kind].mean()))
                curve.held_out_rmse = rmse if np.isfinite(rmse) else np.nan
                return curve
        return None

    def _fit(self, kind: str, x: Float, force: Float, dx: Float | None = None) -> _Curve | None:
        curve = _fit_power(x, force) if kind == POWER else _fit_line(x, force, self.fit_intercept)
        if curve is not None and dx is not None:
            here = curve.force(x, cut=False)
            spread = np.maximum(
                curve.force(x + dx, cut=False) - here, here - curve.force(x - dx, cut=False)
            )
            freedom = x.size - 2 if kind == POWER or self.fit_intercept else x.size - 1
            variance = curve.residual_std**2 * freedom / (freedom - 2)
            curve.residual_std = float(np.sqrt(max(variance - np.mean(spread**2), 0.0)))
        return curve


@dataclass(eq=False)
class _Curve:
    """One cell's curve: the fields of `ForceModel`, as numbers."""

    kind: str
    slope: float
    slope_std: float
    residual_std: float
    correlation: float = 0.0
    exponent: float = 1.0
    exponent_std: float = 0.0
    intercept: float = 0.0
    intercept_std: float = 0.0
    held_out_rmse: float = np.nan

    def force(self, x: Float, *, cut: bool = True) -> Float:
        """F [N] as reported, or before forces below 0 are cut, shape of x."""
        if self.kind == POWER:
            return np.asarray(self.slope * np.maximum(x, 0.0) ** self.exponent)
        force_n = self.slope * x + self.intercept
        return np.maximum(force_n, 0.0) if cut else np.asarray(force_n)


def _fit_line(x: Float, force: Float, intercept: bool) -> _Curve | None:
    """Least squares of F = a x, or a x + c. None if a is not above 0."""
    unit = float(np.abs(x).max())  # siemens are small: keeps the columns alike
    if unit == 0 or (intercept and np.ptp(x) == 0):
        return None
    design = np.column_stack([x / unit, np.ones_like(x)] if intercept else [x / unit])
    inverse = np.linalg.pinv(design.T @ design)
    found = inverse @ design.T @ force
    if not found[0] > 0:
        return None
    std, variance = _scatter(force - design @ found, found.size)
    covariance = variance * inverse
    errors = np.sqrt(np.diag(covariance))
    curve = _Curve(LINEAR, float(found[0] / unit), float(errors[0] / unit), std)
    if intercept:
        curve.intercept, curve.intercept_std = float(found[1]), float(errors[1])
        curve.correlation = _correlation(covariance)
    return curve


def _fit_power(x: Float, force: Float) -> _Curve | None:
    """Least squares of F = a x^b: for each b the best a is known, so b alone is searched.

    None if b runs into its bounds, or the presses do not tell it.
    """
    unit = float(x.max())
    if unit <= 0 or np.unique(x[x > 0]).size < 2:
        return None
    z = np.maximum(x, 0.0) / unit

    def scale(exponent: float) -> float:
        powered = z**exponent
        return float(powered @ force / (powered @ powered))

    def rss(exponent: float) -> float:
        return float(np.sum((force - scale(exponent) * z**exponent) ** 2))

    # The sum of squares may have several minima: the deepest on a grid, then refined.
    grid = np.geomspace(MIN_EXPONENT, MAX_EXPONENT, 33)
    best = int(np.argmin([rss(exponent) for exponent in grid]))
    if best in (0, grid.size - 1):
        return None
    bounds = (grid[best - 1], grid[best + 1])
    b = float(minimize_scalar(rss, bounds=bounds, method="bounded", options={"xatol": 1e-10}).x)
    a = scale(b)
    if not a > 0:
        return None
    logs = np.log(np.where(z > 0, z, 1.0))
    jacobian = np.column_stack([z**b, a * z**b * logs])
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    std, variance = _scatter(force - a * z**b, 2)
    # From a per unit^b to a per S^b: a_S = a unit^-b.
    to_si = np.array([[unit**-b, -a * unit**-b * np.log(unit)], [0.0, 1.0]])
    covariance = variance * to_si @ inverse @ to_si.T
    errors = np.sqrt(np.diag(covariance))
    return _Curve(
        POWER,
        slope=float(a * unit**-b),
        slope_std=float(errors[0]),
        residual_std=std,
        correlation=_correlation(covariance),
        exponent=b,
        exponent_std=float(errors[1]),
    )


def _scatter(residual_n: Float, coefficients: int) -> tuple[float, float]:
    """Standard deviation and variance rss / (n - p); 0 where nothing is left (a training fold)."""
    freedom = residual_n.size - coefficients
    variance = float(residual_n @ residual_n) / freedom if freedom > 0 else 0.0
    return float(np.sqrt(variance)), variance


def _correlation(covariance: NDArray[np.floating[Any]]) -> float:
    scale = float(np.sqrt(covariance[0, 0] * covariance[1, 1]))
    return float(np.clip(covariance[0, 1] / scale, -1.0, 1.0)) if scale > 0 else 0.0


def _require(name: str, good: NDArray[np.bool_], what: str) -> None:
    if not good.all():
        row, column = (int(index) for index in np.argwhere(~good)[0])
        raise ValueError(f"{name} of cell ({row}, {column}) is {what}")


def _column(name: str, values: ArrayLike, count: int | None = None) -> Float:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array of numbers") from error
    if array.ndim != 1 or array.size != (array.size if count is None else count):
        expected = "(n,)" if count is None else f"({count},) as force_n"
        raise ValueError(f"{name} has shape {array.shape}, it must be {expected}")
    if not array.size:
        raise ValueError(f"{name} is empty: there are no presses")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array)))
        raise ValueError(f"row {row}: {name} is {array[row]:g}, it must be finite")
    return array


def _integers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.intp]:
    array = np.asarray(values)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, it must be {shape}")
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name} holds {array.dtype}, it must hold integers")
    return array.astype(np.intp)


def _flat_cells(cells: ArrayLike, count: int, shape: tuple[int, int]) -> NDArray[np.intp]:
    rows, columns = shape
    pairs = np.ndim(cells) == 2
    array = _integers("cells", cells, (count, 2) if pairs else (count,))
    indices = array if pairs else array[:, None]
    limits = np.array(shape if pairs else [rows * columns])
    outside = ((indices < 0) | (indices >= limits)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise ValueError(f"row {row}: no cell {array[row].tolist()} on a {rows}x{columns} skin")
    return np.asarray(array[:, 0] * columns + array[:, 1] if pairs else array, dtype=np.intp)


def _pooled_message(
    pooled: NDArray[np.bool_], pressed: NDArray[np.intp], columns: int, skin: _Curve
) -> str:
    number = int(pooled.sum())
    if not number:
        return ""
    message = f"{number} of {pooled.size} cells take the curve of all presses"
    if pressed.size == 1:
        row, column = divmod(int(pressed[0]), columns)
        message += f", all on cell ({row}, {column})"
    unknown = np.isnan(skin.residual_std)
    return f"{message}: how far they are off is unknown" if unknown else message
