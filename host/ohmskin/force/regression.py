# SPDX-License-Identifier: Apache-2.0
"""Learns the force curve of every cell from single touches.

Each cell has four candidates: a line or a power law, whose scatter is constant or grows with force
(`force_curves`). What counts is the log likelihood of presses held out, with s the root mean square
of their own weighted errors:

    l = -1/2 log(s^2 v) - (F - f(x))^2 / (2 s^2 v)

so that a newton at 8 N weighs as much as its scatter there lets it. A power law is taken where l is
higher by more than the standard error of that difference over presses (the rule of one standard
error, Breiman et al. 1984). How presses scatter is a property of the textile: growing scatter is
taken for all cells if their l together is higher by two standard errors.

s comes from few presses, so a force's is the standard deviation of Student's t with n - p degrees
of freedom: s^2 (n - p) / (n - p - 2), less the mean of d^2 / v over the presses where their dx is
told, since predicting adds that again. Where presses have several rows, or cells no press, s is at
least that of held-out presses, or cells: their scatter is what counts then.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.force.curve import LINEAR, POWER, ForceModel
from ohmskin.force.curve_fit import Curve, Scatter, fit_line, fit_power

# With 2 coefficients fewer leave 2 degrees of freedom: no finite variance of Student's t.
MIN_PRESSES: Final = 5
# Cells are held out in so many groups at most, so that a large skin takes no longer.
MAX_CELL_FOLDS: Final = 10
SCATTER_ERRORS: Final = 2.0
_LEAST_SHARE: Final = 1e-6  # of the forces: presses that fit exactly still scatter by so much


class ForceRegression:
    """Learns every cell's curve from single touches: `fit`, then `predict`.

    fit_intercept: give lines an intercept c, as the paper's regression has. Then untouched cells
    report c, too. folds: parts that the presses of a cell are split into, each held out once.

    After `fit`: `model_` (a `ForceModel`) and its arrays (R, C) as `kind_`, `slope_`,
    `slope_std_`, `exponent_`, `exponent_std_`, `intercept_`, `intercept_std_`, `correlation_`,
    `residual_std_`, `residual_share_`, `pooled_`, `held_out_rmse_`; `message_`: which cells have no
    curve of their own, empty if none.
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
        trial = self._try(_Rows(x, force, dx, groups), parts)
        skin = self._choose(trial, grows=_is_clear(trial.gain_of_growing(), SCATTER_ERRORS))
        if skin is None:
            raise ValueError("force does not rise with the cells' rise: is the rest of this skin?")
        if pressed.size == 1:
            skin = replace(skin, held_out_factor=np.nan, held_out_rmse=np.nan)
        of_skin = skin.curve(float(np.maximum(skin.factor, skin.held_out_factor)))  # NaN stays
        curves = [of_skin] * (rows * columns)
        pooled = np.ones(rows * columns, dtype=np.bool_)
        trials = {}
        for cell in pressed:
            own = _Rows(x, force, dx, presses).some(flat == cell)
            if own.are_enough:
                trials[cell] = self._try(own, self.folds)
        gains = np.concatenate([[], *(each.gain_of_growing() for each in trials.values())])
        grows = _is_clear(gains, SCATTER_ERRORS)
        for cell, trial in trials.items():
            curve = self._own(trial, grows=grows)
            if curve is not None:
                curves[cell], pooled[cell] = curve, False

        names = [field.name for field in fields(Curve)]
        arrays = {
            name: np.array([getattr(curve, name) for curve in curves]).reshape(shape)
            for name in names
        }
        self.model_ = ForceModel(**arrays, pooled=pooled.reshape(shape))
        for field in fields(ForceModel):
            setattr(self, f"{field.name}_", getattr(self.model_, field.name))
        self.message_ = _pooled_message(pooled, pressed, columns, of_skin)
        return self

    def predict(self, rise: ArrayLike, rise_std: ArrayLike) -> tuple[Float, Float]:
        """`ForceModel.predict` of what was learned. Raises ValueError before `fit`."""
        if not hasattr(self, "model_"):
            raise ValueError("nothing is learned yet: call fit first")
        return self.model_.predict(rise, rise_std)

    def _own(self, trial: _Trial, *, grows: bool) -> Curve | None:
        choice = self._choose(trial, grows=grows)
        if choice is None:
            return None
        factor, number = choice.factor, trial.rows.groups
        if number < trial.rows.x.size:
            freedom = number - self._coefficients(choice.fitted.kind)
            held_out = choice.held_out_factor * np.sqrt(freedom / (freedom - 2))
            factor = float(np.maximum(factor, held_out))
        return choice.curve(factor)

    def _try(self, rows: _Rows, parts: int) -> _Trial:
        """The errors of all candidates on groups held out."""
        # Shuffled, for the forces of successive presses often follow a pattern of their own.
        fold = np.random.default_rng(0).permutation(rows.groups)[rows.group]
        fold %= min(parts, rows.groups)
        errors = {}
        for kind, grows in product((LINEAR, POWER), (False, True)):
            error = np.empty_like(rows.force)
            for held in range(int(fold.max()) + 1):
                out = fold == held
                fitted = self._fit(kind, rows.some(~out), rows.scatter(grows=grows))
                error[out] = (
                    np.inf if fitted is None else rows.force[out] - fitted.force(rows.x[out])
                )
            if np.isfinite(error).all():
                errors[kind, grows] = error
        return _Trial(rows, errors)

    def _choose(self, trial: _Trial, *, grows: bool) -> _Choice | None:
        """The kind that predicts held-out groups better; None where no curve rises."""
        rows = trial.rows
        scatter = rows.scatter(grows=grows)
        for kind in trial.kinds(grows=grows):
            fitted = self._fit(kind, rows, scatter)
            if fitted is not None:
                variance = scatter.variance(rows.force)
                error = trial.errors.get((kind, grows), np.full_like(rows.force, np.nan))
                return _Choice(
                    fitted,
                    scatter,
                    self._factor(fitted, rows, variance),
                    _rms(error / np.sqrt(variance)),
                    _rms(error),
                )
        return None

    def _fit(self, kind: str, rows: _Rows, scatter: Scatter) -> Curve | None:
        if kind == POWER:
            return fit_power(rows.x, rows.force, scatter)
        return fit_line(rows.x, rows.force, scatter, intercept=self.fit_intercept)

    def _factor(self, curve: Curve, rows: _Rows, variance: Float) -> float:
        """s as presses tell it that were fitted."""
        x, dx = rows.x, rows.dx
        here = curve.force(x, cut=False)
        spread = np.maximum(
            curve.force(x + dx, cut=False) - here, here - curve.force(x - dx, cut=False)
        )
        # Of Student's t: rss / (n - p) times (n - p) / (n - p - 2).
        freedom = x.size - self._coefficients(curve.kind)
        square = float(np.sum((rows.force - here) ** 2 / variance)) / (freedom - 2)
        return float(np.sqrt(max(square - float(np.mean(spread**2 / variance)), 0.0)))

    def _coefficients(self, kind: str) -> int:
        return 2 if kind == POWER or self.fit_intercept else 1


@dataclass(frozen=True, eq=False)
class _Rows:
    """What a curve is learned from: rows (n,), and the group of each, held out together."""

    x: Float
    force: Float
    dx: Float
    of: NDArray[np.intp]

    def some(self, which: NDArray[np.bool_]) -> _Rows:
        """These rows alone."""
        return _Rows(self.x[which], self.force[which], self.dx[which], self.of[which])

    @property
    def group(self) -> NDArray[np.intp]:
        """From 0 without gaps, (n,)."""
        return np.unique(self.of, return_inverse=True)[1]

    @property
    def groups(self) -> int:
        """How many there are."""
        return int(np.unique(self.of).size)

    @property
    def are_enough(self) -> bool:
        """Whether a cell can have a curve of its own."""
        varied = bool(np.ptp(self.force) > 0 and np.ptp(self.x) > 0)
        return varied and self.groups >= MIN_PRESSES

    def scatter(self, *, grows: bool) -> Scatter:
        """One of the two ways."""
        return Scatter.growing(self.force) if grows else Scatter()


@dataclass(frozen=True, eq=False)
class _Trial:
    """Errors (n,) on held-out rows of the candidates (kind, whether scatter grows) that have any:
    where some group alone rises, there is none.
    """

    rows: _Rows
    errors: dict[tuple[str, bool], Float]

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
        group = self.rows.group
        gain = self._log_likelihood(one) - self._log_likelihood(other)
        return np.asarray(np.bincount(group, gain) / np.bincount(group))

    def _log_likelihood(self, candidate: tuple[str, bool]) -> Float:
        """l of the module's equation, (n,)."""
        error, force = self.errors[candidate], self.rows.force
        variance = self.rows.scatter(grows=candidate[1]).variance(force)
        least = _LEAST_SHARE**2 * float(np.mean(force**2 / variance))
        variance = variance * max(float(np.mean(error**2 / variance)), least)
        return np.asarray(-0.5 * np.log(variance) - 0.5 * error**2 / variance)


@dataclass(frozen=True)
class _Choice:
    """A curve of some kind, how it scatters, and s of the presses fitted and of those held out."""

    fitted: Curve
    scatter: Scatter
    factor: float
    held_out_factor: float
    held_out_rmse: float

    def curve(self, factor: float) -> Curve:
        """The curve with this s."""
        told = replace(self.fitted, held_out_rmse=self.held_out_rmse)
        return told.scattering(self.scatter, factor)


def _is_clear(gain: Float, errors: float) -> bool:
    """Whether the mean is above 0 by so many standard errors."""
    return gain.size > 1 and bool(gain.mean() > errors * gain.std(ddof=1) / np.sqrt(gain.size))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


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
    pooled: NDArray[np.bool_], pressed: NDArray[np.intp], columns: int, skin: Curve
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
