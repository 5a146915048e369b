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
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import Readings, load_readings
from studies.conditions import SWEEPS, Frame, converted
from studies.stability import STATED_STDS, Verdict, verdict
from studies.trials import PRESSED, Trial, finger_trial, jump_trial, random_trial

DATA: Final = Path(__file__).parents[1] / "tests" / "data"
NOISE_LSB: Final = 0.3  # before the converter
PIECES: Final = 10  # of a file's frames
MOST_ERROR: Final = 1e3  # relative: no answer, or one without a limit, counts as so much
BOTH: Final = ("joint", "touch")


@dataclass(frozen=True)
class Plan:
    """Simulated skins of 8x8, frames of each; fewer of larger ones, and under each condition."""

    skins: int = 12
    frames: int = 8


@dataclass(frozen=True, eq=False)
class Run:
    """Frames in order, and what is told of their skin.

    rest_siemens: (R, C) [S]; None: only the verdict is of interest. pieces: how many parts the
    frames have that count as a skin each.
    """

    knowledge: SkinKnowledge
    frames: tuple[Frame, ...]
    rest_siemens: Float | None = None
    pieces: int = 1


def _of_readings(
    readings: Readings, true_siemens: Float, rest_siemens: Float, pieces: int = 1
) -> Run:
    frames = (Frame(*pair) for pair in zip(readings.ratio, true_siemens, strict=True))
    return Run(readings.knowledge(0), tuple(frames), rest_siemens, pieces)


def _file(name: str, plan: Plan) -> list[Run]:
    """All of a file's frames, or as many as all skins of a small plan have, evenly spaced."""
    readings = load_readings(DATA / f"{name}.npz")
    assert readings.rest_ratio is not None
    most = min(plan.skins * plan.frames, len(readings.ratio))
    picked = np.linspace(0, len(readings.ratio) - 1, most).round().astype(int)
    with np.load(DATA / f"{name}.npz") as truth:
        cells, rest = 1 / truth["cell_ohm"][picked], 1 / truth["rest_ohm"]
    ratio, rest_ratio = converted(readings.ratio[picked]), converted(readings.rest_ratio)
    readings = replace(readings, ratio=ratio, rest_ratio=rest_ratio, adc_bits=ADC_BITS)
    return [_of_readings(readings, cells, rest, min(PIECES, most))]


def _simulated(
    make: Callable[[int, int], Trial],
    plan: Plan,
    told: bool = True,
    rested: bool = True,
    fewer: int = 1,
) -> list[Run]:
    """make: a trial from a number of frames and a seed. told, rested: of wires, rest readings."""
    found = []
    for seed in range(max(2, plan.skins // fewer)):
        trial = make(max(2, plan.frames // fewer), seed)
        random = np.random.default_rng([seed, 1])
        exact = trial.readings
        assert exact.rest_ratio is not None
        rest_ratio = converted(exact.rest_ratio, random, NOISE_LSB)
        ratio = converted(exact.ratio, random, NOISE_LSB)
        readings = replace(
            exact, ratio=ratio, rest_ratio=rest_ratio if rested else None, adc_bits=ADC_BITS
        )
        if not told:
            readings = replace(readings, nominal_top_wire_ohm=None, nominal_bottom_wire_ohm=None)
        found.append(_of_readings(readings, trial.cell_siemens, trial.rest.cell_siemens))
    return found


def _conditions(conditions: Sequence[tuple[str, float | str]], plan: Plan) -> list[Run]:
    found = []
    for sweep, x in conditions:
        for skin in range(max(2, plan.skins // 4)):
            random = np.random.default_rng([zlib.crc32(f"{sweep} {x}".encode()), skin])
            case = SWEEPS[sweep].build(x, (8, 8), max(2, plan.frames // 2), random)
            found.append(Run(case.knowledge, case.frames))
    return found


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

    build: Callable[[Plan], list[Run]]
    methods: tuple[str, ...] = BOTH


# The longest first: else the last process would work alone.
SCENES: Final = {
    "32x32": Scene(partial(_simulated, partial(random_trial, 32, 32, 10), fewer=4), ("touch",)),
    "16x16": Scene(partial(_simulated, partial(random_trial, 16, 16, 10), fewer=2)),
    "extremes": Scene(partial(_conditions, EXTREMES)),
    "faults": Scene(partial(_conditions, FAULTS)),
    "no_rest": Scene(partial(_simulated, partial(random_trial, 8, 8, 10), rested=False)),
    "fingers": Scene(partial(_simulated, partial(finger_trial, 8, 8))),
    "fingers_untold": Scene(partial(_simulated, partial(finger_trial, 8, 8), told=False)),
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
    """What one method did: values (n,) of each kind, and the number of the skin of each, (n,)."""

    values: dict[str, Float]
    skins: dict[str, NDArray[np.intp]]


def observe(runs: Iterable[Run], method: str) -> Sample:
    """Let a method read these frames, each started from the one before."""
    values: defaultdict[str, list[Float]] = defaultdict(list)
    skins: defaultdict[str, list[int]] = defaultdict(list)
    first_skin = 0
    for run in runs:
        estimator = make_estimator(method, run.knowledge)
        for number, frame in enumerate(run.frames):
            if frame.afresh:
                estimator.reset()
            found, started_s = None, perf_counter()
            # A variant may raise whatever it likes: `_judged` counts it.
            with suppress(Exception), np.errstate(all="ignore"):
                found = estimator.estimate(frame.ratio)
            taken_ms = 1e3 * (perf_counter() - started_s)
            if frame.cell_siemens is None:
                continue
            skin = first_skin + number * run.pieces // len(run.frames)
            judged = _judged(found, frame.cell_siemens, run.rest_siemens)
            for kind, of_frame in {**judged, "ms": np.array([taken_ms])}.items():
                values[kind].append(of_frame)
                skins[kind] += [skin] * of_frame.size
        first_skin += run.pieces
    return Sample(
        {kind: np.concatenate(parts) for kind, parts in values.items()},
        {kind: np.array(numbers, dtype=np.intp) for kind, numbers in skins.items()},
    )


def _judged(found: Estimate | None, true: Float, rest: Float | None) -> dict[str, Float]:
    """Values of one frame, by kind. true, rest: (R, C) [S]."""
    if rest is None:
        said = Verdict.FLAGGED
        if found is not None:
            said = verdict(found.cell_siemens, found.cell_siemens_std, found.converged, true)
        is_wrong = said is Verdict.WRONG_UNFLAGGED
        return {"wrong": np.array([is_wrong * 1.0]), "not_right": np.array([said != "right"]) * 1.0}
    cells, std, alarm = rest, np.zeros_like(rest), True
    if found is not None:
        cells, std, alarm = found.cell_siemens, found.cell_siemens_std, not found.converged
    pressed = true > PRESSED * rest
    off = np.abs(cells - true)
    sums = [(cells - rest).sum() / (true - rest).sum() - 1] if pressed.any() else []
    return {
        "error": _bounded((off / true)[pressed]),
        "sum": _bounded(np.abs(sums)),
        # Written so that NaN is outside.
        "outside": ~(off <= STATED_STDS * std).ravel() * 1.0,
        "alarm": np.array([alarm * 1.0]),
        "stated": _bounded((std / true)[pressed]),
    }


def _bounded(error: Float) -> Float:
    return np.minimum(np.nan_to_num(error, nan=MOST_ERROR), MOST_ERROR)
