# SPDX-License-Identifier: Apache-2.0
"""From what a cell shows to the force on it [N], by its curve.

Symbols

====== ======= ======================================================================= ==========
symbol shape   meaning                                                                 unit
====== ======= ======================================================================= ==========
x      (R, C)  rise above rest: conductance g - g_rest, or the reading's (`voltage`)   S, or 1
F      (R, C)  force normal to the skin                                                N
a      (R, C)  `slope`                                                                 N / x^b
b      (R, C)  `exponent`, 1 where the cell is linear                                  1
K              covariance of a cell's free coefficients: a, or (a, b)
s0     (R, C)  `residual_std`: scatter of presses about the curve at no force          N
s1     (R, C)  `residual_share`: how that grows with force                             1
dx     (R, C)  standard deviation of x                                                 as x
====== ======= ======================================================================= ==========

    linear  F = a x       (section IV.G of the paper, but an untouched cell reports no force)
    power   F = a x^b     (x < 0 counts as 0)

Standard deviation of a force, with J the derivatives of F by the cell's free coefficients:

    F_std^2 = d^2 + s0^2 + (s1 F)^2 + J K J^T ,     d = F(x + dx) - F(x) .

For x^b with b < 1 the differential is infinite at rest, the difference is not. Where errors of a
conductance are not alike in both directions, dx is that upwards: so is d.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Bool, Float

LINEAR: Final = "linear"
POWER: Final = "power"
# The smallest exponent that a fit may give. Chosen: presses of known skins lie well above, and a
# fit that runs into it has found no curve.
MIN_EXPONENT: Final = 0.2
# The largest exponent that a fit may give: the reciprocal of the smallest, because a curve and its
# inverse are limited alike.
MAX_EXPONENT: Final = 1 / MIN_EXPONENT


@dataclass(frozen=True, eq=False)
class ForceModel:
    """The curve of every cell, each array (R, C); symbols and units in the module's table.

    Raises ValueError, naming the array, for what no fit gives.

    kind: "linear" or "power".
    slope: a.
    slope_std: its standard error.
    exponent: b.
    exponent_std: its standard error; 0 where the exponent is not fitted.
    correlation: of these two errors, -1 to 1.
    residual_std: s0; NaN where nothing tells it.
    residual_share: s1; NaN where nothing tells it.
    pooled: presses tell next to nothing of the cell: its curve is that of all presses.
    held_out_rmse: error on presses that were not fitted [N]; of pooled cells, on cells that were
        not fitted; NaN where nothing tells it.
    """

    kind: NDArray[np.str_]
    slope: Float
    slope_std: Float
    exponent: Float
    exponent_std: Float
    correlation: Float
    residual_std: Float
    residual_share: Float
    pooled: Bool
    held_out_rmse: Float

    def __post_init__(self) -> None:
        shape = self.kind.shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"kind has shape {shape}, it must be (rows, columns)")
        for field in fields(self):
            array = getattr(self, field.name)
            if array.shape != shape:
                raise ValueError(f"{field.name} has shape {array.shape}, kind {shape}")
        power = self.is_power
        require("kind", power | (self.kind == LINEAR), f"neither {LINEAR} nor {POWER}")
        require("slope", (self.slope > 0) & np.isfinite(self.slope), "not above 0")
        require("correlation", np.abs(self.correlation) <= 1, "not in -1..1")
        inside = (self.exponent >= MIN_EXPONENT) & (self.exponent <= MAX_EXPONENT)
        require("exponent", inside, f"not in {MIN_EXPONENT:g}..{MAX_EXPONENT:g}")
        for name in ("slope_std", "exponent_std"):
            std = getattr(self, name)
            require(name, np.isfinite(std) & (std >= 0), "not finite and >= 0")
        for name in ("residual_std", "residual_share", "held_out_rmse"):
            error = getattr(self, name)
            require(name, np.isnan(error) | (np.isfinite(error) & (error >= 0)), "negative or inf")
        require("exponent", power | (self.exponent == 1), "not 1, as of a linear cell")
        require("exponent_std", power | (self.exponent_std == 0), "not 0, as of a linear cell")

    @cached_property
    def is_power(self) -> Bool:
        """Which cells have a power law, (R, C). Kept, because texts take long to compare."""
        return np.asarray(self.kind == POWER)

    def predict(self, rise: ArrayLike, rise_std: ArrayLike) -> tuple[Float, Float]:
        """Force and its standard deviation [N], each (..., R, C), of rises above rest (..., R, C).

        No force is below 0; the standard deviation is that before the cut. It is NaN where
        `rise_std` is (the method gives none), and where the scatter is unknown. Raises ValueError,
        naming the cell, for a shape or a value that cannot be.
        """
        x, dx = np.asarray(rise, dtype=np.float64), np.asarray(rise_std, dtype=np.float64)
        shape = self.kind.shape
        for name, array in (("rise", x), ("rise_std", dx)):
            if array.shape[-2:] != shape:
                raise ValueError(f"{name} has shape {array.shape}, this calibration {shape}")
        require("rise", np.isfinite(x), "not finite")
        require("rise_std", ~(dx < 0) & ~np.isinf(dx), "negative or inf")
        uncut_n, by_rise = spread(self, x, dx)  # where dx is NaN, so is the second, and the answer
        by_slope = uncut_n * (self.slope_std / self.slope)
        by_exponent = uncut_n * np.log(np.where(x > 0, x, 1.0)) * self.exponent_std
        # J K J^T; the exponent of a linear cell has no error. The slope of a power law is the force
        # at 1 S, far from any press. So where its error is large, the error of the exponent is
        # large as well, and both nearly cancel. Then rounding may leave less than 0.
        by_fit = by_slope**2 + by_exponent**2 + 2 * self.correlation * by_slope * by_exponent
        force_n = np.maximum(uncut_n, 0.0)
        scatter = self.residual_std**2 + (self.residual_share * force_n) ** 2
        return force_n, np.sqrt(by_rise**2 + scatter + np.maximum(by_fit, 0.0))

    def rise(self, force_n: ArrayLike) -> Float:
        """The rise x above rest, (R, C), at which a force [N] is predicted: x = (F / a)^(1 / b).

        Raises ValueError, naming the cell, for a shape or a force that cannot be.
        """
        force = np.asarray(force_n, dtype=np.float64)
        if force.shape != self.kind.shape:
            raise ValueError(f"force_n has shape {force.shape}, this calibration {self.kind.shape}")
        require("force_n", np.isfinite(force) & (force >= 0), "negative or not finite")
        with np.errstate(over="ignore"):
            rise = np.asarray((force / self.slope) ** (1 / self.exponent))
        require("force_n", np.isfinite(rise), "more than its curve reaches")
        return rise


@dataclass(frozen=True)
class Curve:
    """One cell's curve. `ForceModel` says what the fields are, here as numbers."""

    kind: str
    slope: float
    slope_std: float
    residual_std: float = 0.0
    residual_share: float = 0.0
    correlation: float = 0.0
    exponent: float = 1.0
    exponent_std: float = 0.0
    held_out_rmse: float = np.nan

    @property
    def is_power(self) -> bool:
        """Whether it is a power law."""
        return self.kind == POWER


def force_by(curve: ForceModel | Curve, x: Float) -> Float:
    """F of the module's equations [N], before forces below 0 are cut, shape of x."""
    power = curve.slope * np.maximum(x, 0.0) ** curve.exponent
    return np.where(curve.is_power, power, curve.slope * x)


def spread(curve: ForceModel | Curve, x: Float, dx: Float) -> tuple[Float, Float]:
    """`force_by`, and d of the module's equations [N]: how far F is off if x is off by dx."""
    here, more = force_by(curve, np.array([x, x + dx]))
    return here, more - here


def require(name: str, good: Bool, what: str) -> None:
    """Raise ValueError, naming the first cell, unless all are good, (..., R, C).

    what: the error says that the cell is this.
    """
    if not good.all():
        row, column = (int(index) for index in np.argwhere(~good)[0, -2:])
        raise ValueError(f"{name} of cell ({row}, {column}) is {what}")
