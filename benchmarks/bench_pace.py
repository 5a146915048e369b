# SPDX-License-Identifier: Apache-2.0
"""Measure what it costs to read less of a skin than all: accuracy, and what it saves: time.

    make bench-pace

Simulated: 8x8 cells, 10 bits, noise of 0.3 LSB, lines that settle at once; `touch`, wires told,
rest of 90 whole scans. Random touches (6 at most, each frame anew), fingertips; five skins of each.

half_*, quick_*     two readings of each cell, a and b, and one, b: their median error over that of
                    all four (whichever scene is worse), and the share of pressed cells within four
                    stated deviations.
desk_*              the same scenes on the desk of `make bench-desk`: the built firmware in simavr,
                    lines that charge, converters that err, noise of 0.5 LSB. Modes half and quick
                    at their default settle times, a near scan in thirty, against near at 90 Hz. A
                    skin stays for three scans, of which the last is judged. *_over_near: the worse
                    scene; desk_within_4: the least of both modes and scenes; desk_ghost_us: the
                    largest ghost of a frame, 95th percentile, the worst of them; *_hz: scans a
                    second between the near scans.
partial_*           a region of 3x3 cells around one fingertip, b alone, after one whole frame in
                    thirty: time of its estimate by `joint` over that of whole frames, and in units
                    of `make bench-estimators`.
focus_*, new_touch_*, refocus_*, slip_*, clock_*
                    the host and the built firmware together: focused.py says what they are.
joint_16x16_*       time of `joint` under a fingertip on 16x16 cells, wires not told, in units of
                    8x8 cells: median and 99th percentile.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

import focused
from bars import Part, at_least, at_most, run  # beside this file
from bench_estimators import times_of, unit_s
from desk import paced_skin  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS
from studies.judge import answers_of, judge, judge_trial, pooled
from studies.trials import (
    NOISE_LSB,
    NOMINAL_WIRE_OHM,
    Trial,
    finger_trial,
    knowledge_of,
    random_trial,
)

SEED, SKINS, FRAMES, REST_SCANS = 7000, 5, 40, 90
READ = {"near": [0, 1, 2, 3], "half": [0, 1], "quick": [1]}
WHOLE_EVERY = 30  # frames, of which one is whole
STAYS = 10  # frames of a region for which a fingertip stays where it is
WARM_UP = 3  # frames whose time does not count
SMALL_FINGER = (0.45, 0.5)  # standard deviations of a fingertip that 3x3 cells show [cells]


def read(exact: Float, random: np.random.Generator) -> Float:
    """What a board reads: noise, then codes."""
    noise = NOISE_LSB / 2**ADC_BITS * random.standard_normal(exact.shape)
    return ratio_from_codes(quantise(exact + noise))


def frames_of(trial: Trial, seed: int, times: int = 1) -> tuple[SkinKnowledge, Float]:
    """What is known of a skin, and readings of its frames, each so many times, (F, R, C, 4)."""
    random = np.random.default_rng(seed)
    rest = trial.readings.rest_ratio
    assert rest is not None
    rest_ratio = read(np.repeat(rest[None], REST_SCANS, axis=0), random).mean(axis=0)
    rows, columns, _ = rest.shape
    knowledge = SkinKnowledge(
        rows,
        columns,
        adc_bits=ADC_BITS,
        rest_ratio=rest_ratio,
        nominal_wire_ohm=WireOhm(*NOMINAL_WIRE_OHM, lead=0.0),
    )
    return knowledge, read(np.repeat(trial.readings.ratio, times, axis=0), random)


def part_of(ratio: Float, kinds: list[int], rows: slice, columns: slice) -> Float:
    """These readings (R, C, 4) of these lines alone: others are not a number."""
    some = np.full_like(ratio, np.nan)
    some[rows, columns, kinds] = ratio[rows, columns, kinds]
    return some


def estimates(trial: Trial, mode: str, seed: int) -> list[Estimate]:
    knowledge, frames = frames_of(trial, seed)
    estimator, every = make_estimator("touch", knowledge), slice(None)
    return [estimator.estimate(part_of(ratio, READ[mode], every, every)) for ratio in frames]


def of_modes(part: Part) -> dict[str, float]:
    """half_*, quick_*."""
    scenes: list[Callable[[int], Trial]] = [
        lambda seed: random_trial(8, 8, 6, part.of(FRAMES), seed),
        lambda seed: finger_trial(8, 8, part.of(FRAMES), seed),
    ]
    over: dict[str, list[float]] = {mode: [] for mode in READ}
    within: dict[str, list[float]] = {mode: [] for mode in READ}
    for scene in scenes:
        trials = [scene(SEED + number) for number in range(part.of(SKINS))]
        for mode in READ:
            judged = [
                judge(
                    answers_of(estimates(each, mode, number)),
                    each.cell_siemens,
                    each.rest.cell_siemens,
                )
                for number, each in enumerate(trials)
            ]
            over[mode].append(float(np.mean([one.error_percent() for one in judged])))
            within[mode].append(pooled(judged).pressed_within_percent() / 100)
    figures = {}
    for mode in ("half", "quick"):
        ratios = np.array(over[mode]) / over["near"]
        figures[f"{mode}_over_near"] = round(float(ratios.max()), 2)
        figures[f"{mode}_within_4"] = round(min(within[mode]), 4)
    return figures


def of_desk(part: Part) -> dict[str, float]:
    """desk_*."""
    count, frames = part.of(SKINS), part.of(FRAMES)
    default: dict[str, Any] = {"rate_mhz": 0, "whole_every": WHOLE_EVERY}
    over: dict[str, list[float]] = {}
    within, ghosts, hz = [], [], {}
    for scene in (partial(random_trial, 8, 8, 6), partial(finger_trial, 8, 8)):
        errors = {}
        for mode, pace in {"near": {}, "half": default, "quick": default}.items():
            parts = []
            for seed in range(count):
                skin = paced_skin(seed, scene(frames, SEED + seed), mode=mode, **pace)
                estimator = make_estimator("touch", knowledge_of(skin.rest_ratio))
                found = [[estimator.estimate(each) for each in scans][-1] for scans in skin.ratios]
                parts.append(judge_trial(answers_of(found), skin.trial))
            errors[mode] = float(np.mean([one.error_percent() for one in parts]))
            hz[mode] = skin.scans_hz
            if mode != "near":
                together = pooled(parts)
                within.append(together.pressed_within_percent() / 100)
                ghosts.append(together.ghost_us())
                over.setdefault(mode, []).append(errors[mode] / errors["near"])
    figures = {f"desk_{mode}_over_near": round(max(ratios), 2) for mode, ratios in over.items()}
    figures |= {"desk_within_4": round(min(within), 4), "desk_ghost_us": round(max(ghosts), 2)}
    return figures | {f"desk_{mode}_hz": round(hz[mode], 1) for mode in over}


def of_region(part: Part) -> dict[str, float]:
    """partial_*."""
    trial = finger_trial(8, 8, part.of(40), SEED, sigma_cells=SMALL_FINGER)
    knowledge, frames = frames_of(trial, SEED, STAYS)
    peaks = [np.unravel_index(cells.argmax(), cells.shape) for cells in trial.cell_siemens]
    peaks = [peak for peak in peaks for _ in range(STAYS)]
    lines = [tuple(slice(n - 1, n + 2) for n in np.clip(peak, 1, 6)) for peak in peaks]
    unit = unit_s(64)

    def seconds(of_frames: Iterable[Float]) -> Float:
        estimator, taken = make_estimator("joint", knowledge), []
        for ratio in of_frames:
            whole = not np.isnan(ratio).any()
            taken.append((estimator.estimate(ratio).seconds, unit(), whole))
        return np.array(taken[WARM_UP:] or taken)

    whole = seconds(frames)
    some = seconds(
        ratio if number % WHOLE_EVERY == 0 else part_of(ratio, READ["quick"], *where)
        for number, (ratio, where) in enumerate(zip(frames, lines, strict=True))
    )
    partial = some[some[:, 2] == 0] if (some[:, 2] == 0).any() else some
    return {
        "partial_time_over_whole": round(
            float(np.median(partial[:, 0]) / np.median(whole[:, 0])), 2
        ),
        "partial_3x3_units": round(float(np.median(partial[:, 0] / partial[:, 1])), 1),
    }


def of_large(part: Part) -> dict[str, float]:
    """joint_16x16_*."""
    frames, seeds = WARM_UP + part.of(60), range(SEED, SEED + part.of(4))
    trials = (finger_trial(16, 16, frames, seed) for seed in seeds)
    readings = [trial.rounded(ADC_BITS, wires_told=False) for trial in trials]
    seconds, _ = times_of("joint", readings)
    unit = unit_s(64)
    units = seconds / float(np.median([unit() for _ in range(part.of(200))]))
    median, p99 = np.percentile(units, [50, 99])
    return {
        "joint_16x16_finger_units": round(float(median)),
        "joint_16x16_finger_units_p99": round(float(p99)),
    }


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    parts = (of_modes, of_desk, of_region, focused.measure, of_large)
    return {name: value for figures in parts for name, value in figures(part).items()}


BARS = [
    at_most("half_over_near", 1.3),
    at_most("quick_over_near", 1.9),
    at_least("half_within_4", 0.98),
    at_least("quick_within_4", 0.98),
    at_most("desk_half_over_near", 1.5),
    at_most("desk_quick_over_near", 1.7),
    at_least("desk_within_4", 0.95),
    at_most("desk_ghost_us", 2),
    at_least("desk_half_hz", 120),
    at_least("desk_quick_hz", 120),
    at_most("partial_time_over_whole", 0.6),
    at_most("partial_3x3_units", 5),
    at_most("focus_error_over_whole", 1.2),
    at_most("new_touch_s", 0.1),
    at_most("refocus_scans", 2),
    at_most("slip_hz_error", 0.01),
    at_most("slip_amplitude_error", 0.1),
    at_most("clock_delay_error_ms", 0.3),
    at_most("joint_16x16_finger_units", 115),
    at_most("joint_16x16_finger_units_p99", 145),
]

if __name__ == "__main__":
    sys.exit(run(__doc__, measure, BARS))
