# SPDX-License-Identifier: Apache-2.0
"""Frames that constants are tried on, of ngspice and simulated, and what a method does with them.

All readings have 10 bits. Simulated readings have noise of 0.3 LSB before the converter; those of
conditions of `stability` have what these say.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import Readings
from studies.conditions import SWEEPS, Case, Frame, converted
from studies.judge import STATED_STDS, Verdict, answers_of, judge, verdict
from studies.trials import (
    NOISE_LSB,
    Trial,
    finger_trial,
    jump_trial,
    palm_trial,
    random_trial,
    reference_trial,
    rounded,
    without_wires,
)

# A file has one skin. Its frames are cut into so many pieces, which stand for skins when figures
# are resampled. Chosen: a file has as few as eight frames.
PIECES: Final = 10
# The relative error that counts for no answer, or for one without a limit. Chosen: far above all
# others, and finite, because medians of it are compared.
MOST_ERROR: Final = 1e3
BOTH: Final = ("joint", "touch")


@dataclass(frozen=True)
class Plan:
    """How much is read of 8x8 skins; there is less of larger ones, and under each condition.

    skins: simulated skins of each kind.
    frames: of each skin.
    """

    skins: int = 12
    frames: int = 8


def _of_readings(
    readings: Readings, true_siemens: Float, rest_siemens: Float, pieces: int = 1
) -> Case:
    frames = (Frame(*pair) for pair in zip(readings.ratio, true_siemens, strict=True))
    return Case(readings.knowledge(0), tuple(frames), rest_siemens, pieces)


def _file(name: str, plan: Plan) -> list[Case]:
    """All of a file's frames, or as many as all skins of a small plan have, evenly spaced."""
    frames = len(reference_trial(name).frames)
    most = min(plan.skins * plan.frames, frames)
    trial = reference_trial(name, np.linspace(0, frames - 1, most).round().astype(np.intp))
    readings, rest = rounded(trial.readings), trial.rest.cell_siemens
    return [_of_readings(readings, trial.cell_siemens, rest, min(PIECES, most))]


def _simulated(
    make: Callable[[int, int], Trial],
    plan: Plan,
    wires_told: bool = True,
    rest_told: bool = True,
    fewer: int = 1,
) -> list[Case]:
    """make: a trial from a number of frames and a seed. fewer: a part of the skins and frames."""
    cases = []
    for seed in range(max(2, plan.skins // fewer)):
        trial = make(max(2, plan.frames // fewer), seed)
        random = np.random.default_rng([seed, 1])
        exact = trial.readings if wires_told else without_wires(trial.readings)
        assert exact.rest_ratio is not None
        rest_ratio = converted(exact.rest_ratio, random, NOISE_LSB)
        readings = replace(
            exact,
            ratio=converted(exact.ratio, random, NOISE_LSB),
            rest_ratio=rest_ratio if rest_told else None,
            adc_bits=ADC_BITS,
        )
        cases.append(_of_readings(readings, trial.cell_siemens, trial.rest.cell_siemens))
    return cases


def _conditions(conditions: Sequence[tuple[str, float | str]], plan: Plan) -> list[Case]:
    cases = []
    for sweep, x in conditions:
        for skin in range(max(2, plan.skins // 4)):
            random = np.random.default_rng([zlib.crc32(f"{sweep} {x}".encode()), skin])
            cases.append(SWEEPS[sweep].build(x, (8, 8), max(2, plan.frames // 2), random))
    return cases


# Conditions under which frames were wrong and not flagged, and neighbours of these.
EXTREMES: Final = (
    *(("wires", 10.0), ("wires", 40.0), ("touches", 24 / 64), ("touches", 0.75)),
    *(("noise", 2.0), ("noise", 6.0), ("nominal", 0.5), ("nominal", 2.0)),
)
FAULTS: Final = (
    *(("before", "untouched"), ("stuck", "one at 1"), ("stuck", "cell at 1")),
    *(("lines", "row open"), ("lines", "row cut midway")),
)


@dataclass(frozen=True)
class Scene:
    """A set of frames, and the methods that read it."""

    build: Callable[[Plan], list[Case]]
    methods: tuple[str, ...] = BOTH


# The longest first: else the last process would work alone.
SCENES: Final = {
    "32x32": Scene(partial(_simulated, partial(random_trial, 32, 32, 10), fewer=4), ("touch",)),
    "16x16": Scene(partial(_simulated, partial(random_trial, 16, 16, 10), fewer=2)),
    "extremes": Scene(partial(_conditions, EXTREMES)),
    "faults": Scene(partial(_conditions, FAULTS)),
    "no_rest": Scene(partial(_simulated, partial(random_trial, 8, 8, 10), rest_told=False)),
    "fingers": Scene(partial(_simulated, partial(finger_trial, 8, 8))),
    "fingers_untold": Scene(partial(_simulated, partial(finger_trial, 8, 8), wires_told=False)),
    "palms": Scene(partial(_simulated, partial(palm_trial, 8, 8), wires_told=False)),
    "random": Scene(partial(_simulated, partial(random_trial, 8, 8, 10))),
    "jump": Scene(partial(_simulated, partial(jump_trial, 8, 8, 10))),
    **{
        f"ngspice_{name.partition('_')[0]}": Scene(partial(_file, name))
        for name in ("presses_8x8", "finger_8x8", "random_8x8", "bent_8x8")
    },
}


# --------------------------------------------------------------------------------------- reading


@dataclass(frozen=True, eq=False)
class Sample:
    """What one method did.

    values: (n,) of each kind.
    skins: the number of the skin that each value is of, (n,).
    """

    values: dict[str, Float]
    skins: dict[str, NDArray[np.intp]]


def observe(cases: Iterable[Case], method: str) -> Sample:
    """Let a method read these frames, each started from the one before."""
    values: defaultdict[str, list[Float]] = defaultdict(list)
    skins: defaultdict[str, list[int]] = defaultdict(list)
    first_skin = 0
    for case in cases:
        estimator = make_estimator(method, case.knowledge)
        for number, frame in enumerate(case.frames):
            if frame.afresh:
                estimator.reset()
            estimate, started_s = None, perf_counter()
            # A variant may raise whatever it likes: `_judged` counts it.
            with suppress(Exception), np.errstate(all="ignore"):
                estimate = estimator.estimate(frame.ratio)
            taken_ms = 1e3 * (perf_counter() - started_s)
            if frame.cell_siemens is None:
                continue
            skin = first_skin + number * case.pieces // len(case.frames)
            judged = _judged(estimate, frame.cell_siemens, case.rest_siemens)
            for kind, of_frame in {**judged, "ms": np.array([taken_ms])}.items():
                values[kind].append(of_frame)
                skins[kind] += [skin] * of_frame.size
        first_skin += case.pieces
    return Sample(
        {kind: np.concatenate(parts) for kind, parts in values.items()},
        {kind: np.array(numbers, dtype=np.intp) for kind, numbers in skins.items()},
    )


def _judged(
    estimate: Estimate | None, true_siemens: Float, rest_siemens: Float | None
) -> dict[str, Float]:
    """Values of one frame, by kind. None: the variant has raised, or only the verdict matters."""
    if rest_siemens is None:
        said = verdict(estimate, true_siemens)
        of_frame = {"wrong": said is Verdict.WRONG_UNFLAGGED, "not_right": said != Verdict.RIGHT}
        return {kind: np.array([1.0 * value]) for kind, value in of_frame.items()}
    answers = {
        "cell_siemens": rest_siemens[None],
        "cell_siemens_std": np.zeros((1, *rest_siemens.shape)),
    }
    if estimate is not None:
        answers = dict(answers_of([estimate]))
    judged = judge(answers, true_siemens[None], rest_siemens)
    is_pressed = judged.relative.size > 0
    return {
        "error": _bounded(judged.relative),
        "sum": _bounded(np.abs(judged.rise_share - 1)[: int(is_pressed)]),
        # Written so that NaN is outside.
        "outside": (~(judged.deviations <= STATED_STDS)).astype(np.float64),
        "alarm": (~judged.converged).astype(np.float64),
        "stated": _bounded(judged.stated),
    }


def _bounded(error: Float) -> Float:
    return np.minimum(np.nan_to_num(error, nan=MOST_ERROR), MOST_ERROR)
