# SPDX-License-Identifier: Apache-2.0
"""Measure the estimators: time a frame, error, and whether the stated uncertainty holds.

    make bench-estimators

Everything is simulated: presses_8x8 and the sweeps are readings made with ngspice
(tests/data), the others come from the circuit that ngspice was compared with. All readings are 10
bit, and all frames warm: in order, each started from the one before, unless another thing is said.
What is measured how:

unit_ms                 what one look at an 8x8 circuit must cost, one core, median: a Cholesky
                        factorisation, a solution for 16 columns and a product of symmetric
                        matrices of order 64. It is measured after every frame.
units_*                 median time of a frame's estimate over that of the unit just after it; of
                        the 16x16 and 32x32 skins the unit has their order and columns. `presses`:
                        one second of four overlapping presses. `random`: every frame touched anew,
                        so that a warm start is worth little. `finger`: soft fingertips that move,
                        wires not told; `_p99`: the 99th percentile over the median.
ms_joint_16x16_finger_p99  99th percentile in milliseconds; a scan takes 44 ms.
error_*, ghost_*        random 8x8, up to 8 touches, cold: error of a pressed cell's conductance,
                        median and 90th percentile; largest conductance above the true one of a cell
                        that nothing presses, 95th percentile of the frames.
bent_*                  8x8 with wires 35 % above nominal, frames 50 to 69: median error of a
                        pressed cell over the information limit, that is the median standard
                        deviation of the posterior at the truth: of one frame alone, and (`_known`,
                        harder) with the mean wire of each layer known exactly. Normal errors would
                        have 0.67.
stretched_*, doubled_*  8x8, 40 random frames, then all wires half as much again, or double, 40
                        frames: median error of a pressed cell in the first 5 after that and in the
                        last 20, and the share of pressed cells within 4 stated standard deviations
                        after it, and in the frames 6 to 10 after it (soon).
finger_*                8x8, a fingertip with soft edges that covers some 15 cells, around the skin
                        in 4 s at 90 Hz, wires told: median error of a cell above 1 uS over rest,
                        share of all cells within 4 stated standard deviations.
within_*                `joint`, cells of the scenes `error` and `bent`, of ngspice's files and of
                        the paper's sweeps: share of all errors within 1, 2 and 4 stated standard
                        deviations. Not of wires that change at once: `stretched`, `doubled`.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bars import Part, at_least, at_most, run  # beside this file
from ohmskin.arrays import Float
from ohmskin.emulate.board import DEFAULT_RATE_HZ
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import Readings, estimate_file
from studies.information import pressed_limits
from studies.judge import Judged, answers_of, judge, judge_trial, pooled
from studies.published import RMSE_MEGOHM
from studies.trials import (
    JUMP,
    Trial,
    bent_trial,
    finger_trial,
    knowledge_of,
    random_trial,
    reference_trial,
    rounded,
    skin_at_rest,
    stretched,
    touch,
    trial_of,
)

METHODS = ("joint", "touch")
SEED = 1000  # of the first skin
# Skins that are timed, that are read at random, and whose wires are not as told.
TIMED, JUDGED, CHANGED = 4, 20, 12
WARM_UP = 3  # frames of each skin whose time does not count
LEARNED = 50  # frames after which a bent skin is judged
BEFORE = 40  # frames of a stretched skin before its wires rise at once, and as many after
FILES = ("random_2x2", "random_4x6", "random_8x8", "bent_8x8", "presses_8x8")
DEVIATIONS = (1, 2, 4)  # how many stated ones errors are counted within


# ---------------------------------------------------------------------------------------- time


def unit_s(cells: int) -> Callable[[], float]:
    """What measures the unit of a skin of so many cells [s]."""
    random = np.random.default_rng(0)
    b = random.standard_normal((cells, 2 * math.isqrt(cells)))
    a = b @ b.T + np.eye(cells)

    def measure() -> float:
        taken = []
        for _ in range(3):
            start_s = time.perf_counter()
            np.linalg.cholesky(a)
            np.linalg.solve(a, b)
            a @ a
            taken.append(time.perf_counter() - start_s)
        return float(np.median(taken))

    return measure


def times_of(method: str, sources: list[Readings]) -> tuple[Float, Float]:
    """Seconds of each frame, and of the unit just after it."""
    taken: list[tuple[float, float]] = []
    for readings in sources:
        measure = unit_s(readings.ratio[0, ..., 0].size)
        estimator = make_estimator(method, readings.knowledge(0))
        frames = [(estimator.estimate(ratio).seconds, measure()) for ratio in readings.ratio]
        taken += frames[WARM_UP:]
    seconds, units = np.transpose(taken)
    return seconds, units


def median_units(method: str, sources: list[Readings]) -> float:
    seconds, units = times_of(method, sources)
    return round(float(np.median(seconds / units)), 1)


def random_scenes(lines: int, touches: int, frames: int, skins: int) -> list[Readings]:
    return [
        random_trial(lines, lines, touches, frames, SEED + number).rounded(ADC_BITS)
        for number in range(skins)
    ]


def fingers(lines: int, frames: int, skins: int) -> list[Readings]:
    """Wires not told, as nobody knows them."""
    return [
        finger_trial(lines, lines, frames, SEED + number).rounded(ADC_BITS, wires_told=False)
        for number in range(skins)
    ]


def times(part: Part) -> dict[str, float]:
    skins = part.of(TIMED)

    def frames(count: int) -> int:
        return WARM_UP + part.of(count - WARM_UP)

    presses = [rounded(reference_trial("presses_8x8", slice(frames(90))).readings)] * 3
    five = random_scenes(8, 5, frames(30), skins)
    eight = random_scenes(16, 8, frames(20), skins)
    large = random_scenes(32, 10, frames(20), min(2, skins))
    figures = {
        "units_joint_16x16_random": median_units("joint", eight),
        "units_touch_8x8_random": median_units("touch", five),
        "units_touch_16x16_random": median_units("touch", eight),
        "units_touch_32x32_random": median_units("touch", large),
    }
    for method in ("matrix", *METHODS):
        figures[f"units_{method}_8x8_presses"] = median_units(method, presses)
        seconds, units = times_of(method, fingers(8, frames(90), skins))
        median, p99 = np.percentile(seconds / units, [50, 99])
        figures[f"units_{method}_8x8_finger"] = round(float(median), 1)
        figures[f"units_{method}_8x8_finger_p99"] = round(float(p99 / median), 2)
        figures["unit_ms"] = round(1e3 * float(np.median(units)), 4)
    seconds, _ = times_of("joint", fingers(16, frames(60), skins))
    figures["ms_joint_16x16_finger"] = round(1e3 * float(np.median(seconds)), 1)
    figures["ms_joint_16x16_finger_p99"] = round(1e3 * float(np.percentile(seconds, 99)), 1)
    return figures


# ------------------------------------------------------------------------------------ accuracy


def random_figures(method: str, skins: int) -> tuple[Judged, dict[str, float]]:
    trials = [random_trial(8, 8, 8, 20, SEED + 100 + number) for number in range(skins)]
    judged = pooled(
        judge_trial(estimate_file(trial.rounded(ADC_BITS), method, cold=True), trial)
        for trial in trials
    )
    return judged, {
        f"error_{method}_median_percent": round(judged.error_percent(), 3),
        f"error_{method}_p90_percent": round(judged.error_percent(0.9), 3),
        f"ghost_{method}_p95_us": round(judged.ghost_us(), 3),
    }


def limit_percent(trials: list[Trial], layer_std: float | None = None) -> float:
    """Median deviation of a pressed cell in the posterior at the truth, of frames judged."""
    late = slice(LEARNED, None)
    stds = [pressed_limits(trial, late, layer_std=layer_std) for trial in trials]
    return 100 * float(np.median(np.concatenate(stds)))


def bent_figures(method: str, skins: int) -> tuple[Judged, dict[str, float]]:
    trials = [bent_trial(8, 8, 8, LEARNED + 20, SEED + 200 + number) for number in range(skins)]
    late = slice(LEARNED, None)
    judged = pooled(
        judge_trial(estimate_file(trial.rounded(ADC_BITS), method), trial, late) for trial in trials
    )
    median = judged.error_percent()
    known = limit_percent(trials, layer_std=0.0)
    return judged, {
        f"bent_{method}_median_percent": round(median, 3),
        f"bent_{method}_over_limit": round(median / limit_percent(trials), 3),
        f"bent_{method}_over_limit_known": round(median / known, 3),
    }


def stretched_figures(name: str, factor: float, method: str, skins: int) -> dict[str, float]:
    """A skin whose wires rise by a factor at once, after 40 frames on which they were learned."""
    first, soon, last, after = [], [], [], []
    for number in range(skins):
        random = np.random.default_rng(SEED + 300 + number)
        rest = skin_at_rest(8, 8, random)
        both = [rest, stretched(rest, factor)] * BEFORE
        frames = [touch(skin, int(random.integers(1, 9)), random) for skin in both]
        trial = trial_of(rest, frames[::2] + frames[1::2])
        out = estimate_file(trial.rounded(ADC_BITS), method)
        first.append(judge_trial(out, trial, slice(BEFORE, BEFORE + 5)))
        soon.append(judge_trial(out, trial, slice(BEFORE + 5, BEFORE + 10)))
        last.append(judge_trial(out, trial, slice(BEFORE + 20, None)))
        after.append(judge_trial(out, trial, slice(BEFORE, None)))
    return {
        f"{name}_{method}_first_percent": round(pooled(first).error_percent(), 2),
        f"{name}_{method}_last_percent": round(pooled(last).error_percent(), 2),
        f"{name}_{method}_soon_within_4_std_percent": round(
            pooled(soon).pressed_within_percent(), 2
        ),
        f"{name}_{method}_within_4_std_percent": round(pooled(after).pressed_within_percent(), 2),
    }


def finger_figures(method: str) -> dict[str, float]:
    scene = Scene("moving", 8, 8, seed=1)
    scene.rest = replace(scene.rest, lead_ohm=np.array(0.0))  # as `knowledge_of` tells
    rest_siemens = scene.skin(0.0).cell_siemens
    estimator = make_estimator(method, knowledge_of(ratio_from_codes(quantise(scene.rest_ratio))))
    times_s = BEGIN_S + np.arange(360) / DEFAULT_RATE_HZ
    estimates = [
        estimator.estimate(ratio_from_codes(quantise(scene.ratio(time_s)))) for time_s in times_s
    ]
    truth = np.array([scene.skin(time_s).cell_siemens for time_s in times_s])
    touched = np.array([scene.touched(time_s) for time_s in times_s])
    judged = judge(answers_of(estimates), truth, rest_siemens, touched)
    return {
        f"finger_{method}_percent": round(judged.error_percent(), 2),
        f"finger_{method}_within_4_std_percent": round(judged.within_percent(), 2),
    }


def accuracy(part: Part) -> dict[str, float]:
    figures: dict[str, float] = {}
    by_joint = []
    for method in METHODS:
        random, of_random = random_figures(method, part.of(JUDGED))
        bent, of_bent = bent_figures(method, part.of(CHANGED))
        figures |= of_random | of_bent
        figures |= stretched_figures("stretched", JUMP, method, part.of(CHANGED))
        figures |= stretched_figures("doubled", 2.0, method, part.of(CHANGED))
        figures |= finger_figures(method)
        if method == "joint":
            by_joint += [random, bent]
    for name in (*FILES, *(f"{sweep}_3x3" for sweep in RMSE_MEGOHM)):
        trial = reference_trial(name)
        by_joint.append(judge_trial(estimate_file(rounded(trial.readings), "joint"), trial))
    for stds in DEVIATIONS:
        percent = pooled(by_joint).within_percent(stds)
        figures[f"within_{stds}_std_percent"] = round(percent, 2)
    return figures


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    return times(part) | accuracy(part)


BARS = (
    at_most("units_joint_8x8_presses", 15),
    at_most("units_touch_8x8_presses", 8),
    at_most("units_joint_8x8_finger", 30),
    at_most("units_touch_8x8_finger", 30),
    at_most("units_joint_8x8_finger_p99", 4),
    at_most("units_touch_8x8_finger_p99", 4),
    at_most("ms_joint_16x16_finger_p99", 26.6),
    at_most("error_joint_median_percent", 0.65),
    at_most("error_joint_p90_percent", 5),
    at_most("ghost_joint_p95_us", 0.5),
    at_most("error_touch_median_percent", 0.88),
    at_most("error_touch_p90_percent", 5.5),
    at_most("ghost_touch_p95_us", 0.55),
    at_most("bent_joint_over_limit", 1.3),
    at_least("doubled_joint_soon_within_4_std_percent", 95),
    at_least("doubled_touch_soon_within_4_std_percent", 95),
    at_least("within_1_std_percent", 60),
    at_least("within_2_std_percent", 90),
    at_least("within_4_std_percent", 99),
)

if __name__ == "__main__":
    sys.exit(run(__doc__, measure, BARS))
