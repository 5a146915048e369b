# SPDX-License-Identifier: Apache-2.0
"""Measure the estimators: time a frame, error, and whether the stated uncertainty holds.

    make bench-estimators

Prints a table of bars and, as the last line, one JSON object. The exit code is 1 when a bar is
missed. Everything is simulated: presses_8x8, the sweeps and the scenes they are taken from are
readings made with ngspice (tests/data), the others come from the circuit that ngspice was compared
with. All readings are 10 bit, and all frames warm: in order, each started from the one before,
unless another thing is said. What is measured how:

unit_ms                 what one look at an 8x8 circuit must cost, one core, median: a Cholesky
                        factorisation, a solution for 16 columns and a product of symmetric
                        matrices of order 64. It is measured before every frame.
units_*                 median time of a frame's estimate over that of the unit just before it; of
                        the 16x16 and 32x32 skins the unit has their order and columns. `presses`:
                        one second of four overlapping presses. `random`: every frame touched anew,
                        so that a warm start is worth little. `finger`: soft fingertips that move,
                        wires not told; `_p99`: the 99th percentile over the median. `paper_2x2`:
                        `regularized`, both of its steps, in milliseconds.
ms_joint_16x16_finger_p99  99th percentile in milliseconds; a scan takes 26.6 ms.
error_*, ghost_*        random 8x8, up to 8 touches, cold: error of a pressed cell's conductance,
                        median and 90th percentile; largest conductance reported at a cell that
                        nothing presses, above rest, 95th percentile of the frames.
sweeps_worst_share      the paper's sweeps, exact readings, `joint`: RMSE over the best figure that
                        the paper has for the same point, the worst of the ten points.
bent_*                  8x8 with wires 35 % above nominal, frames 50 to 69: median error of a
                        pressed cell over the information limit, that is the median standard
                        deviation of the posterior at the truth: of one frame alone, and (`_known`,
                        harder) with the mean wire of each layer known exactly. Normal errors would
                        have 0.67.
stretched_*             8x8, 40 random frames, then all wires half as much again, 40 frames: median
                        error of a pressed cell in the first 5 after that and in the last 20, and
                        the share of pressed cells within 4 stated standard deviations after it.
finger_*                8x8, a fingertip with soft edges that covers some 15 cells, around the skin
                        in 4 s at 90 Hz, wires told: median error of a cell above 1 uS over rest,
                        share of all cells within 4 stated standard deviations.
within_*                `joint`, all scenes above, and the sweeps: share of all errors within 1, 2
                        and 4 stated standard deviations.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bars import at_least, at_most, report  # beside this file
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.emulate.scenes import BEGIN_S, BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Scene
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.record.readings import Readings, estimate_file, load_readings
from studies.information import information_limit
from studies.published import RMSE_MEGOHM
from studies.trials import (
    PRESSED,
    bent_trial,
    finger_trial,
    random_trial,
    skin_at_rest,
    touch,
    trial_of,
)

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
SEED = 1000
WARM_UP = 3  # frames
LEARNED = 50  # frames after which a bent skin is judged


def ten_bits(exact: Readings) -> Readings:
    assert exact.rest_ratio is not None
    ratio, rest = (ratio_from_codes(quantise(each)) for each in (exact.ratio, exact.rest_ratio))
    return replace(exact, ratio=ratio, rest_ratio=rest, adc_bits=10)


@dataclass
class Errors:
    """Errors of many frames: relative ones of pressed cells, and all over what was stated."""

    relative: list[Float]
    over_stated: list[Float]
    ghost_siemens: list[float]

    def add(
        self, out: dict[str, NDArray[Any]], truth: Float, rest: Float, pressed: NDArray[np.bool_]
    ) -> None:
        error = out["cell_siemens"] - truth
        self.relative.append(np.abs(error / truth)[pressed])
        self.over_stated.append(np.abs(error / out["cell_siemens_std"]).ravel())
        above = np.where(pressed, 0.0, out["cell_siemens"] - rest)
        self.ghost_siemens += list(above.max(axis=(1, 2)))

    @classmethod
    def none(cls) -> Errors:
        return cls([], [], [])


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
    """Seconds of each frame, and of the unit just before it."""
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


def random_scenes(lines: int, touches: int, frames: int, trials: int) -> list[Readings]:
    return [
        random_trial(lines, lines, touches, frames, SEED + trial).rounded(10)
        for trial in range(trials)
    ]


def fingers(lines: int, frames: int, trials: int) -> list[Readings]:
    """Wires not told, as nobody knows them."""
    return [
        replace(
            finger_trial(lines, lines, frames, SEED + trial).rounded(10),
            nominal_top_wire_ohm=None,
            nominal_bottom_wire_ohm=None,
        )
        for trial in range(trials)
    ]


def times() -> dict[str, float]:
    presses = [ten_bits(load_readings(DATA / "presses_8x8.npz"))] * 3
    five, eight = random_scenes(8, 5, 30, 4), random_scenes(16, 8, 20, 4)
    paper_s, _ = times_of("regularized", random_scenes(2, 3, 20, 3))
    figures = {
        "units_joint_8x8_random": median_units("joint", random_scenes(8, 8, 30, 4)),
        "units_joint_16x16_random": median_units("joint", eight),
        "units_touch_8x8_random": median_units("touch", five),
        "units_touch_16x16_random": median_units("touch", eight),
        "units_touch_32x32_random": median_units("touch", random_scenes(32, 10, 20, 2)),
        "ms_paper_2x2_random": round(1e3 * float(np.median(paper_s)), 1),
    }
    for method in ("matrix", "joint", "touch"):
        figures[f"units_{method}_8x8_presses"] = median_units(method, presses)
        seconds, units = times_of(method, fingers(8, 90, 4))
        ratio = seconds / units
        figures[f"units_{method}_8x8_finger"] = round(float(np.median(ratio)), 1)
        figures[f"units_{method}_8x8_finger_p99"] = round(
            float(np.percentile(ratio, 99) / np.median(ratio)), 2
        )
        figures["unit_ms"] = round(1e3 * float(np.median(units)), 4)
    seconds, _ = times_of("joint", fingers(16, 60, 4))
    figures["ms_joint_16x16_finger"] = round(1e3 * float(np.median(seconds)), 1)
    figures["ms_joint_16x16_finger_p99"] = round(1e3 * float(np.percentile(seconds, 99)), 1)
    return figures


# ------------------------------------------------------------------------------------ accuracy


def random_errors(method: str, trials: int) -> Errors:
    errors = Errors.none()
    for trial in range(trials):
        scene = random_trial(8, 8, 8, 20, SEED + 100 + trial)
        out = estimate_file(scene.rounded(10), method, cold=True)
        errors.add(out, scene.cell_siemens, scene.rest.cell_siemens, scene.pressed)
    return errors


def random_figures(method: str, errors: Errors) -> dict[str, float]:
    relative = 100 * np.concatenate(errors.relative)
    return {
        f"error_{method}_median_percent": round(float(np.median(relative)), 3),
        f"error_{method}_p90_percent": round(float(np.percentile(relative, 90)), 3),
        f"ghost_{method}_p95_us": round(1e6 * float(np.percentile(errors.ghost_siemens, 95)), 3),
    }


def bent_errors(method: str, trials: int) -> tuple[Errors, dict[str, float]]:
    errors, alone, known = Errors.none(), [], []
    for trial in range(trials):
        scene = bent_trial(8, 8, 8, LEARNED + 20, SEED + 200 + trial)
        told = scene.rounded(10)
        out = estimate_file(told, method)
        late = {name: array[LEARNED:] for name, array in out.items()}
        pressed = scene.pressed[LEARNED:]
        errors.add(late, scene.cell_siemens[LEARNED:], scene.rest.cell_siemens, pressed)
        for skin, where in zip(scene.frames[LEARNED:], pressed, strict=True):
            knowledge = told.knowledge(0)
            alone.append(information_limit(skin, knowledge, where)[where])
            known.append(information_limit(skin, knowledge, where, layer_std=0.0)[where])
    median = float(np.median(np.concatenate(errors.relative)))
    return errors, {
        f"bent_{method}_median_percent": round(100 * median, 3),
        f"bent_{method}_over_limit": round(median / float(np.median(np.concatenate(alone))), 3),
        f"bent_{method}_over_limit_known": round(
            median / float(np.median(np.concatenate(known))), 3
        ),
    }


def stretched_figures(method: str, trials: int) -> dict[str, float]:
    """A skin whose wires rise by half at once, after 40 frames on which they were learned."""
    first, last, away = [], [], []
    for trial in range(trials):
        random = np.random.default_rng(SEED + 300 + trial)
        rest = skin_at_rest(8, 8, random)
        top_ohm, bottom_ohm = 1.5 * rest.top_wire_ohm, 1.5 * rest.bottom_wire_ohm
        longer = replace(rest, top_wire_ohm=top_ohm, bottom_wire_ohm=bottom_ohm)
        skins = [touch(skin, int(random.integers(1, 9)), random) for skin in [rest, longer] * 40]
        scene = trial_of(rest, skins[::2] + skins[1::2])
        out = estimate_file(scene.rounded(10), method)
        error = np.abs(out["cell_siemens"] - scene.cell_siemens)
        relative, pressed = error / scene.cell_siemens, scene.pressed
        first.append(relative[40:45][pressed[40:45]])
        last.append(relative[60:][pressed[60:]])
        away.append((error / out["cell_siemens_std"])[40:][pressed[40:]])
    figures = {
        "first_percent": np.median(np.concatenate(first)),
        "last_percent": np.median(np.concatenate(last)),
        "within_4_std_percent": np.mean(np.concatenate(away) < 4),
    }
    return {
        f"stretched_{method}_{name}": round(100 * float(value), 2)
        for name, value in figures.items()
    }


def finger_figures(method: str) -> dict[str, float]:
    scene = Scene("moving", 8, 8, seed=1)
    knowledge = SkinKnowledge(
        8,
        8,
        adc_bits=10,
        rest_ratio=ratio_from_codes(quantise(scene.rest_ratio)),
        nominal_wire_ohm=WireOhm(TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
    )
    estimator = make_estimator(method, knowledge)
    relative, away = [], []
    for time_s in BEGIN_S + np.arange(360) / 90:
        found = estimator.estimate(ratio_from_codes(quantise(scene.ratio(time_s))))
        truth = scene.skin(time_s).cell_siemens
        error = np.abs(found.cell_siemens - truth)
        relative.append((error / truth)[scene.touched(time_s)])
        away.append(error / found.cell_siemens_std)
    return {
        f"finger_{method}_percent": round(100 * float(np.median(np.concatenate(relative))), 2),
        f"finger_{method}_within_4_std_percent": round(
            100 * float(np.mean(np.concatenate(away) < 4)), 2
        ),
    }


def file_errors(names: tuple[str, ...], method: str) -> Errors:
    """Of the reference files, 10 bit."""
    errors = Errors.none()
    for name in names:
        out = estimate_file(ten_bits(load_readings(DATA / f"{name}.npz")), method)
        with np.load(DATA / f"{name}.npz", allow_pickle=False) as file:
            truth, rest = 1 / file["cell_ohm"], 1 / file["rest_ohm"]
        errors.add(out, truth, rest, truth > PRESSED * rest)
    return errors


def sweeps_worst_share() -> float:
    shares = []
    for sweep, figures in RMSE_MEGOHM.items():
        out = estimate_file(load_readings(DATA / f"{sweep}_3x3.npz"), "joint")
        with np.load(DATA / f"{sweep}_3x3.npz", allow_pickle=False) as file:
            square = (out["cell_ohm"] - file["cell_ohm"]) ** 2
        rmse_megohm = 1e-6 * np.sqrt(np.mean(square, axis=(1, 2)))
        shares.append(rmse_megohm / np.min(list(figures.values()), axis=0))
    return float(np.max(shares))


def accuracy() -> dict[str, float]:
    figures: dict[str, float] = {}
    stated = []
    for method in ("joint", "touch"):
        random = random_errors(method, 20)
        figures |= random_figures(method, random)
        bent, bent_figures = bent_errors(method, 12)
        figures |= bent_figures
        figures |= stretched_figures(method, 12)
        figures |= finger_figures(method)
        if method == "joint":
            stated += random.over_stated + bent.over_stated
    figures["sweeps_worst_share"] = round(sweeps_worst_share(), 4)
    names = ("random_2x2", "random_4x6", "random_8x8", "bent_8x8", "presses_8x8")
    stated += file_errors((*names, "wire_sweep_3x3", "cell_sweep_3x3"), "joint").over_stated
    away = np.concatenate(stated)
    for limit in (1, 2, 4):
        figures[f"within_{limit}_std_percent"] = round(100 * float(np.mean(away < limit)), 2)
    return figures


# ---------------------------------------------------------------------------------------- bars

BARS = (
    at_most("units_joint_8x8_presses", 15),
    at_most("units_touch_8x8_presses", 8),
    at_most("units_joint_8x8_finger", 30),
    at_most("units_touch_8x8_finger", 30),
    at_most("units_joint_8x8_finger_p99", 4),
    at_most("units_touch_8x8_finger_p99", 4),
    at_most("ms_joint_16x16_finger_p99", 26.6),
    at_most("ms_paper_2x2_random", 90),
    at_most("error_joint_median_percent", 0.65),
    at_most("error_joint_p90_percent", 5),
    at_most("ghost_joint_p95_us", 0.5),
    at_most("error_touch_median_percent", 0.88),
    at_most("error_touch_p90_percent", 5.5),
    at_most("ghost_touch_p95_us", 0.55),
    at_most("bent_joint_over_limit", 1.3),
    at_most("sweeps_worst_share", 0.25),
    at_least("within_1_std_percent", 60),
    at_least("within_2_std_percent", 90),
    at_least("within_4_std_percent", 99),
)


def main() -> int:
    figures = times() | accuracy()
    all_met = report(figures, BARS)
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
