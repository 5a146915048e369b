# SPDX-License-Identifier: Apache-2.0
"""Curves of force against a cell's rise, fitted to presses: two kinds, two ways to scatter.

Symbols, of one cell's n presses (see `force` for those of the curves)

====== ======= ============================================================ ======
symbol shape   meaning                                                      unit
====== ======= ============================================================ ======
x      (n,)    rise above rest                                              S, or 1
F      (n,)    force                                                        N
f(x)   (n,)    the curve                                                    N
v      (n,)    variance of F about the curve, but for a factor s^2          1, N^2
p      ()      free coefficients: 2, or 1 for a line through rest           1
====== ======= ============================================================ ======

    constant  v = 1                                   s0 = s       s1 = 0
    growing   v = F^2 + F0^2,  F0 = 0.1 max F         s0 = s F0    s1 = s

Contacts are noisy in proportion to what they conduct, force sensors at any force: both occur. With
weights 1/v a curve minimises the sum of (F - f(x))^2 / v; then s^2 = sum / (n - p), and with J the
derivatives of f by its coefficients, K = s^2 (J^T V^-1 J)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ohmskin.arrays import Float
from ohmskin.force.curve import LINEAR, MAX_EXPONENT, MIN_EXPONENT, POWER

FLOOR: Final = 0.1  # of the largest force: below it, scatter no longer shrinks with force
EXPONENTS: Final = np.geomspace(MIN_EXPONENT, MAX_EXPONENT, 33)


@dataclass(frozen=True)
class Scatter:
    """v of the module's table. floor_n: F0; 0: the scatter is constant."""

    floor_n: float = 0.0

    @classmethod
    def growing(cls, force: Float) -> Self:
        """For a cell that was pressed with these forces."""
        return cls(FLOOR * float(force.max()))

    def variance(self, force: Float) -> Float:
        """v at forces (n,)."""
        return np.asarray(force**2 + self.floor_n**2) if self.floor_n else np.ones_like(force)


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

    def force(self, x: Float, *, cut: bool = True) -> Float:
        """F [N] as reported, or before forces below 0 are cut, shape of x."""
        if self.kind == POWER:
            return np.asarray(self.slope * np.maximum(x, 0.0) ** self.exponent)
        force_n = self.slope * x + self.intercept
        return np.maximum(force_n, 0.0) if cut else np.asarray(force_n)

    def scattering(self, scatter: Scatter, factor: float) -> Curve:
        """The same with s = factor."""
        if not scatter.floor_n:
            return replace(self, residual_std=factor, residual_share=0.0)
        return replace(self, residual_std=factor * scatter.floor_n, residual_share=factor)


def fit_line(x: Float, force: Float, scatter: Scatter, *, intercept: bool) -> Curve | None:
    """Weighted least squares of F = a x, or a x + c. None if a is not above 0."""
    unit = float(np.abs(x).max())  # siemens are small: keeps the columns alike
    if unit == 0 or (intercept and np.ptp(x) == 0):
        return None
    design = np.column_stack([x / unit, np.ones_like(x)] if intercept else [x / unit])
    root = scatter.variance(force) ** -0.5
    weighted = design * root[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted)
    found = inverse @ weighted.T @ (force * root)
    if not found[0] > 0:
        return None
    covariance = _variance((force - design @ found) * root, found.size) * inverse
    errors = np.sqrt(np.diag(covariance))
    curve = Curve(LINEAR, float(found[0] / unit), float(errors[0] / unit))
    if not intercept:
        return curve
    return replace(
        curve,
        intercept=float(found[1]),
        intercept_std=float(errors[1]),
        correlation=_correlation(covariance),
    )


def fit_power(
    x: Float, force: Float, scatter: Scatter, exponents: Float = EXPONENTS
) -> Curve | None:
    """Weighted least squares of F = a x^b: for each b the best a is known, so b alone is searched.

    exponents: where b is searched, rising. None if it runs into their ends, or the presses do not
    tell it.
    """
    unit = float(x.max())
    if unit <= 0 or np.unique(x[x > 0]).size < 2:
        return None
    z = np.maximum(x, 0.0) / unit
    weight = 1 / scatter.variance(force)

    def scale(exponent: float) -> float:
        powered = z**exponent
        return float((weight * powered) @ force / ((weight * powered) @ powered))

    def rss(exponent: float) -> float:
        return float(weight @ (force - scale(exponent) * z**exponent) ** 2)

    # The sum of squares may have several minima: the deepest on a grid, then refined.
    best = int(np.argmin([rss(exponent) for exponent in exponents]))
    if best in (0, exponents.size - 1):
        return None
    bounds = (exponents[best - 1], exponents[best + 1])
    b = float(minimize_scalar(rss, bounds=bounds, method="bounded", options={"xatol": 1e-10}).x)
    a = scale(b)
    if not a > 0:
        return None
    logs = np.log(np.where(z > 0, z, 1.0))
    jacobian = np.column_stack([z**b, a * z**b * logs]) * np.sqrt(weight)[:, None]
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    # From a per unit^b to a per S^b: a_S = a unit^-b.
    to_si = np.array([[unit**-b, -a * unit**-b * np.log(unit)], [0.0, 1.0]])
    variance = _variance((force - a * z**b) * np.sqrt(weight), 2)
    covariance = variance * to_si @ inverse @ to_si.T
    errors = np.sqrt(np.diag(covariance))
    return Curve(
        POWER,
        slope=float(a * unit**-b),
        slope_std=float(errors[0]),
        correlation=_correlation(covariance),
        exponent=b,
        exponent_std=float(errors[1]),
    )


def _variance(residual: Float, coefficients: int) -> float:
    """s^2; 0 where nothing is left (a training fold)."""
    freedom = residual.size - coefficients
    return float(residual @ residual) / freedom if freedom > 0 else 0.0


def _correlation(covariance: NDArray[np.floating[Any]]) -> float:
    scale = float(np.sqrt(covariance[0, 0] * covariance[1, 1]))
    return float(np.clip(covariance[0, 1] / scale, -1.0, 1.0)) if scale > 0 else 0.0
