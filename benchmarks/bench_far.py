# SPDX-License-Identifier: Apache-2.0
"""Measure what sensing both ends of the lines gains: mode far beside mode near, on the same scenes.

    make bench-far

Everything is simulated. Nobody is told the wires; that there are no leads is told, and rest
readings are, rounded as all readings are. `far`: readings a e b f. `near`: a b c d. Rounding takes
the part of a code away, as a converter does, and estimators read the middle of its interval. What
is measured how:

MODE_KIND_METHOD_*      scenes of tests/data/far, solved by ngspice: `random` (8x8 and 5x9, wires of
                        100 to 300 ohm a segment, up to 8 touches), `harsh` (the same at 1 to
                        2.4 kohm), `finger` (a fingertip over 16 to 29 cells). 10 bits, each frame
                        cold. A pressed cell conducts half as much again as at rest.
    percent, p90_percent    error of a pressed cell: median and 90th percentile
    within_4                share of pressed cells within 4 stated deviations [%]
    ghost_us                cells that are not pressed: largest conductance above the true one [uS],
                            95th percentile over the frames
    stated                  median stated deviation of a pressed cell over its median error
    bits12_*                the same with 12 bits
time_KIND_METHOD*       time of a frame in mode far over that in mode near, frames in order, each
                        frame estimated in both modes one after the other: ratio of the medians, and
                        of the 99th percentiles (`_p99`). Of three passes the least time of each
                        frame counts: other work on the machine only adds. The same frames, of four
                        skins from the circuit that ngspice was compared with: `random`, touched
                        anew; `finger`, one or two small fingertips that move.
MODE_wires_METHOD       after 50 frames of up to 8 touches, on 12 skins of 8x8: median error of a
                        segment [%]. Six have 100 and 200 ohm a segment, six 150 and 300, as the
                        `random` scenes; `_100_200`: the first six. Segments are spread by 10 %, so
                        whoever knows the middle of each layer is off by 6.7 %.
MODE_bent_METHOD        wires 35 % above those at the calibration, rest readings and a force curve
                        of each cell unchanged: median error of a pressed cell's force over that of
                        the unbent skin. 3 skins of 8x8, 60 frames of up to 8 touches, in order. A
                        curve joins 9 presses of the cell alone, by straight lines in logarithms.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from bars import Bar, Part, at_least, at_most, run  # beside this file
from ohmskin.arrays import Float
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import ADC_BITS, MODES
from ohmskin.record.readings import Readings, estimate_file
from studies.judge import judge_trial, pooled
from studies.trials import (
    BEND,
    NOMINAL_WIRE_OHM,
    Trial,
    finger_trial,
    random_trial,
    reference_trial,
    stretched,
    trial_of,
)

KINDS = {
    "random": ("random_8x8_0", "random_8x8_1", "random_5x9_0", "random_5x9_1"),
    "harsh": ("harsh_8x8_0", "harsh_8x8_1"),
    "finger": ("finger_8x8_0", "finger_8x8_1"),
}
METHODS = ("joint", "touch")
BITS = (ADC_BITS, 12)  # of the board's converter, and of a better one
SEED = 7000  # of the first skin
# Skins of each kind that are timed; skins whose wires are learned, of each of two; skins that bend.
TIMED, LEARNED, BENT = 4, 6, 3
FRAMES = 50  # of each skin whose wires are learned
FILE_FRAMES = 40  # of each file of tests/data/far
# Frames of each skin that is timed: touched at random, and by fingertips. The first of them do not
# count.
TIMED_FRAMES, WARM_UP = (100, 150), 3
# How often the same frames are timed: other work on the machine only adds, so the least counts.
PASSES = 3
# A wire segment of a row and of a column [ohm]: those of the random skins of tests/data/far.
SEGMENT_OHM = (NOMINAL_WIRE_OHM, (150.0, 300.0))
# Rises that each cell is calibrated with [S]. Chosen: from the lightest touch to the hardest.
CALIBRATED_SIEMENS = np.geomspace(1e-5, 1e-3, 9)
LEAST_SIEMENS = 1e-8  # a smaller rise counts as this one, because 0 has no logarithm


# ------------------------------------------------------------------------------ scenes of ngspice


def errors(kind: str, mode: str, method: str, bits: int, frames: int) -> dict[str, float]:
    parts = []
    for name in KINDS[kind]:
        trial = reference_trial(f"far/{name}", slice(-frames, None))
        answers = estimate_file(trial.rounded(bits, mode=mode), method, cold=True)
        parts.append(judge_trial(answers, trial))
    judged = pooled(parts)
    stated = np.median(judged.stated) / np.median(judged.relative)
    return {
        "percent": round(judged.error_percent(), 3),
        "p90_percent": round(judged.error_percent(0.9), 2),
        "within_4": round(judged.pressed_within_percent(), 2),
        "stated": round(float(stated), 2),
        "ghost_us": round(judged.ghost_us(), 3),
    }


# ------------------------------------------------------------------------------------------ time


def times(part: Part) -> dict[str, float]:
    random, finger = (WARM_UP + part.of(frames - WARM_UP) for frames in TIMED_FRAMES)
    skins = range(part.of(TIMED))
    figures: dict[str, float] = {}
    by_kind = {
        "random": [random_trial(8, 8, 8, random, SEED + number) for number in skins],
        "finger": [finger_trial(8, 8, finger, SEED + number) for number in skins],
    }
    for kind, trials in by_kind.items():
        read = [{mode: untold(trial, mode) for mode in MODES} for trial in trials]
        for method in METHODS:
            passes = [
                [seconds(of_skin, method) for of_skin in read] for _ in range(part.of(PASSES))
            ]
            taken_s = np.min([np.concatenate(of_pass) for of_pass in passes], axis=0)
            near, far = np.quantile(taken_s, [0.5, 0.99], axis=0).T
            figures[f"time_{kind}_{method}"] = round(float(far[0] / near[0]), 2)
            figures[f"time_{kind}_{method}_p99"] = round(float(far[1] / near[1]), 2)
    return figures


def untold(trial: Trial, mode: str) -> Readings:
    """Readings of 10 bits, where nobody knows the wires."""
    return trial.rounded(ADC_BITS, mode=mode, wires_told=False)


def seconds(read: dict[str, Readings], name: str) -> Float:
    """Of each frame but the first ones, near and far, (F, 2): one beside the other."""
    methods = [make_estimator(name, read[mode].knowledge(0)) for mode in ("near", "far")]
    frames = zip(read["near"].ratio, read["far"].ratio, strict=True)
    taken_s = [
        [method.estimate(ratio).seconds for method, ratio in zip(methods, pair, strict=True)]
        for pair in frames
    ]
    return np.array(taken_s[WARM_UP:])


# ------------------------------------------------------------------------------- wires and forces


def wires(mode: str, method: str, kinds: Sequence[tuple[float, float]], skins: int) -> float:
    off = []
    for wire_ohm, number in itertools.product(kinds, range(skins)):
        trial = random_trial(8, 8, 8, FRAMES, SEED + 100 + number, wire_ohm=wire_ohm)
        out = estimate_file(untold(trial, mode), method)
        truth = trial.rest.top_wire_ohm, trial.rest.bottom_wire_ohm
        for name, ohm in zip(("top_wire_ohm", "bottom_wire_ohm"), truth, strict=True):
            off.append(np.abs(out[name][-1] / ohm - 1).ravel())
    return round(100 * float(np.median(np.concatenate(off))), 2)


def force_n(rise_siemens: Float) -> Float:
    """The truth: 10 N at 1 mS, and less than linear, as contacts are."""
    return np.asarray(10.0 * (np.maximum(rise_siemens, 0.0) / 1e-3) ** 0.7)


def seen(trial: Trial, mode: str, method: str) -> Float:
    """Cells (F, R, C) [S] as the method sees them, frames in order."""
    return np.asarray(estimate_file(untold(trial, mode), method)["cell_siemens"])


def curves(trial: Trial, mode: str, method: str) -> Float:
    """Log of the rise that the method sees of each press of a cell alone, (P, R, C)."""
    rest, cells = trial.rest, trial.rest.cell_siemens.size
    presses = [
        replace(rest, cell_siemens=rest.cell_siemens + siemens * one_cell)
        for siemens in CALIBRATED_SIEMENS
        for one_cell in np.eye(cells).reshape(cells, *rest.shape)
    ]
    of_presses = seen(trial_of(rest, presses), mode, method).reshape(-1, cells, cells)
    pressed = of_presses.diagonal(axis1=1, axis2=2).reshape(-1, *rest.shape)
    return np.log(np.maximum(pressed - rest.cell_siemens, LEAST_SIEMENS))


def by_curve(rise_siemens: Float, log_rises: Float) -> Float:
    """Forces (F, R, C) [N] by the curve of each cell, straight on beyond its ends."""
    force, log_forces = np.empty_like(rise_siemens), np.log(force_n(CALIBRATED_SIEMENS))
    for cell in np.ndindex(*rise_siemens.shape[1:]):
        curve = make_interp_spline(log_rises[:, *cell], log_forces, k=1)
        log_rise = np.log(np.maximum(rise_siemens[:, *cell], LEAST_SIEMENS))
        force[:, *cell] = np.exp(curve(log_rise))
    return force


def bent(mode: str, method: str, skins: int) -> dict[str, float]:
    off: dict[float, list[Float]] = {1.0: [], BEND: []}
    for number in range(skins):
        trial = random_trial(8, 8, 8, 60, SEED + 200 + number)
        log_rises, rest = curves(trial, mode, method), trial.rest.cell_siemens
        true_n = force_n(trial.cell_siemens - rest)
        for factor, shares in off.items():
            frames = [stretched(skin, factor) for skin in trial.frames]
            siemens = seen(trial_of(trial.rest, frames), mode, method)
            force = by_curve(siemens - rest, log_rises)
            share = force / np.where(trial.pressed, true_n, 1) - 1
            shares.append(np.abs(share)[trial.pressed])
    flat, moved = (float(np.median(np.concatenate(parts))) for parts in off.values())
    return {
        f"{mode}_bent_{method}": round(moved / flat, 2),
        f"{mode}_bent_{method}_percent": round(100 * moved, 2),
    }


def bars_of(method: str) -> list[Bar]:
    bars = []
    for kind, median, tail in (("random", 0.4, 2), ("harsh", 0.5, 3), ("finger", 1.2, 5)):
        key = f"far_{kind}_{method}"
        bars += [
            at_most(f"{key}_percent", median),
            at_most(f"{key}_p90_percent", tail),
            at_least(f"{key}_within_4", 97),
            at_most(f"{key}_ghost_us", 0.5),
        ]
    bars += [
        at_most(f"time_{kind}_{method}{tail}", 2)
        for kind in ("random", "finger")
        for tail in ("", "_p99")
    ]
    bars += [at_most(f"far_bent_{method}", 1.05), at_most(f"far_wires_{method}_percent", 5)]
    return bars


def measure(part: Part) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    figures: dict[str, Any] = {}
    for mode, kind, method, bits in itertools.product(("far", "near"), KINDS, METHODS, BITS):
        key = f"{mode}_{kind}_{method}" + ("" if bits == ADC_BITS else f"_bits{bits}")
        of_kind = errors(kind, mode, method, bits, part.of(FILE_FRAMES))
        figures |= {f"{key}_{name}": value for name, value in of_kind.items()}
    figures |= times(part)
    for mode, method in itertools.product(("far", "near"), METHODS):
        for name, kinds in (("", SEGMENT_OHM), ("_100_200", SEGMENT_OHM[:1])):
            percent = wires(mode, method, kinds, part.of(LEARNED))
            figures[f"{mode}_wires_{method}{name}_percent"] = percent
        figures |= bent(mode, method, part.of(BENT))
    return figures


if __name__ == "__main__":
    sys.exit(run(__doc__, measure, [bar for method in METHODS for bar in bars_of(method)]))
