# SPDX-License-Identifier: Apache-2.0
"""How far the answers of a method are from the truth: the one judge of studies and benchmarks.

`judge` compares the frames of one skin with the true cells, `pooled` takes several skins together,
and `verdict` says of one frame whether it misleads.

====== ========= ===================================================== ====
symbol shape     meaning                                               unit
====== ========= ===================================================== ====
g      (F, R, C) conductance of a cell, as the method says             S
s      (F, R, C) standard deviation of it, as the method says          S
true   (F, R, C) the true conductance                                  S
rest   (R, C)    the true conductance of the untouched skin            S
====== ========= ===================================================== ====
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from studies.trials import PRESSED, Trial

# Arrays by name, of all frames: what `estimate_file` returns, or a part of it.
Answers = Mapping[str, NDArray[Any]]

# An error counts as stated if it is within so many standard deviations. Chosen: of normal errors,
# 1 in 16,000 is outside.
STATED_STDS: Final = 4.0
# A frame is right if no error exceeds both of these. Chosen: what a user would not notice.
CLOSE_SHARE: Final = 0.05  # of the true conductance
CLOSE_SIEMENS: Final = 0.5e-6  # the least rise that is called a touch


@dataclass(frozen=True, eq=False)
class Judged:
    """Answers against the truth, of one skin or, after `pooled`, of several.

    relative: |g - true| / true of each pressed cell, (n,).
    stated: s / true of each pressed cell, (n,).
    deviations: |g - true| / s of every cell, (m,); 0 where there is no error.
    ghost_siemens: the largest g - true of cells that are not pressed, in each frame, (F,) [S].
    rise_siemens: sum of true - rest over the cells of each frame, (F,) [S].
    rise_share: sum of g - rest over that sum, (F,); not a number where nothing rises.
    rmse_megohm: root mean square of 1/g - 1/true over the cells of each frame, (F,) [megohm].
    converged: whether each frame did, (F,).
    seconds: time of each frame, (F,).

    What the method does not state is NaN.
    """

    relative: Float
    stated: Float
    deviations: Float
    ghost_siemens: Float
    rise_siemens: Float
    rise_share: Float
    rmse_megohm: Float
    converged: NDArray[np.bool_]
    seconds: Float

    def error_percent(self, quantile: float = 0.5) -> float:
        """A quantile of the errors of pressed cells; the median, unless another is asked for."""
        return 100 * float(np.quantile(self.relative, quantile))

    def pressed_within_percent(self, stds: float = STATED_STDS) -> float:
        """How many pressed cells are within so many stated deviations."""
        return 100 * float(np.mean(self.relative < stds * self.stated))

    def within_percent(self, stds: float = STATED_STDS) -> float:
        """How many cells of all are within so many stated deviations."""
        return 100 * float(np.mean(self.deviations < stds))

    def ghost_us(self) -> float:
        """The largest ghost of a frame [uS], 95th percentile over the frames."""
        return 1e6 * float(np.quantile(self.ghost_siemens, 0.95))

    def converged_percent(self) -> float:
        """How many frames converged."""
        return 100 * float(np.mean(self.converged))


def judge(
    answers: Answers,
    true_siemens: Float,
    rest_siemens: Float,
    pressed: NDArray[np.bool_] | None = None,
) -> Judged:
    """Compare the answers about one skin with the truth. Shapes and symbols as in the module.

    answers: "cell_siemens"; "cell_siemens_std", "converged", "seconds", as far as there are any.
    pressed: (F, R, C); if absent, cells that conduct half as much again as at rest.
    """
    if pressed is None:
        pressed = true_siemens > PRESSED * rest_siemens
    siemens, frames = answers["cell_siemens"], len(true_siemens)
    std = answers.get("cell_siemens_std", np.full(siemens.shape, np.nan))
    error = siemens - true_siemens
    rise_siemens = (true_siemens - rest_siemens).sum(axis=(1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        deviations = np.where(error == 0, 0.0, np.abs(error) / std)
        rise_share = (siemens - rest_siemens).sum(axis=(1, 2)) / rise_siemens
        error_ohm = 1 / siemens - 1 / true_siemens
    return Judged(
        relative=(np.abs(error) / true_siemens)[pressed],
        stated=(std / true_siemens)[pressed],
        deviations=deviations.ravel(),
        ghost_siemens=np.where(pressed, 0.0, error).max(axis=(1, 2)),
        rise_siemens=rise_siemens,
        rise_share=rise_share,
        rmse_megohm=1e-6 * np.sqrt(np.mean(error_ohm**2, axis=(1, 2))),
        converged=answers.get("converged", np.zeros(frames, np.bool_)),
        seconds=answers.get("seconds", np.full(frames, np.nan)),
    )


def judge_trial(answers: Answers, trial: Trial, frames: slice = slice(None)) -> Judged:
    """Compare the answers about a trial, of all its frames or of some, with its truth."""
    chosen = {name: array[frames] for name, array in answers.items()}
    return judge(chosen, trial.cell_siemens[frames], trial.rest.cell_siemens)


def pooled(parts: Iterable[Judged]) -> Judged:
    """All frames and cells of several skins as those of one."""
    parts = list(parts)
    names = [field.name for field in fields(Judged)]
    return Judged(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )


def answers_of(estimates: Iterable[Estimate]) -> Answers:
    """The answers of frames that were estimated one by one."""
    estimates = list(estimates)
    names = ("cell_siemens", "cell_siemens_std", "converged", "seconds")
    return {name: np.array([getattr(found, name) for found in estimates]) for name in names}


class Verdict(StrEnum):
    """What `verdict` says of one frame."""

    RIGHT = "right"
    FLAGGED = "flagged"
    WRONG_UNFLAGGED = "wrong_unflagged"


def verdict(
    found: Estimate | None,
    true_siemens: Float,
    *,
    close_share: float = CLOSE_SHARE,
    close_siemens: float = CLOSE_SIEMENS,
) -> Verdict:
    """Judge a frame's answer against the true cells (R, C) [S]. None: the method has raised.

    A cell is off when |g - true| > max(5 % of true, 0.5e-6 S), or when g is NaN; it is stated
    when |g - true| <= 4 of its standard deviations (NaN counts as 0).

    - right: converged, and no cell is off.
    - wrong_unflagged: converged, and a cell is off and not stated. The reader is misled.
    - flagged: all others. Not converged, or all that is off is stated.

    A fault excuses nothing: the truth is the cell's conductance, whether or not readings tell it.
    """
    if found is None or not found.converged:
        return Verdict.FLAGGED
    error = np.abs(found.cell_siemens - true_siemens)
    # Written so that NaN is off and not stated.
    off = ~(error <= np.maximum(close_share * true_siemens, close_siemens))
    std = found.cell_siemens_std
    stated = error <= STATED_STDS * np.where(np.isnan(std), 0.0, std)
    if not off.any():
        return Verdict.RIGHT
    return Verdict.WRONG_UNFLAGGED if (off & ~stated).any() else Verdict.FLAGGED
