# SPDX-License-Identifier: Apache-2.0
"""Measure what a user gets who knows no wires: fingertips, and the paper's method under noise.

    make bench-fingers

Prints a table of bars and, as the last line, one JSON object. The exit code is 1 when a bar is
missed. Everything is simulated, with the circuit that ngspice was compared with; readings have 10
bits. Fingertips move in circles over 8x8 skins: the pressure of each is a Gaussian of 0.6 to 1.0
cells with a peak of 30 to 150 uS, around those of tests/data/finger_8x8. `one`, `two`: so many
fingertips at once, on 12 skins, 150 frames of each; `all`: both. Pressed cells conduct half as much
again as at rest. What is measured how, for both methods:

total_*         sum of the rise of all cells over the true one: 10th and 90th percentile, and the
                frame that is furthest off, as a ratio above 1. Frames that touch with 5 uS or more.
error_*         error of a pressed cell, median and 90th percentile: of the first 50 frames, and of
                those after a hundred.
told_*_worst    the worst total where the wires are told: the nominal 100 and 200 ohm.
mixed_*         the same fingertips on skins with wires of 20 ohm to 1 kohm a segment, not told:
                90th percentile of the total's error, pressed cells within 4 stated deviations.
within_*        all cells of all these scenes: share within 1, 2 and 4 stated deviations.
stated_*        pressed cells: the median of what is stated over the median error.
limit_*         90th percentile of the errors that one frame of them allows whoever knows which
                cells are pressed: wires not told, and wires known exactly (studies/information.py).
force_*         `touch`, scene "moving" of six skins, calibrated as examples/forces.py says: share
                of the scans whose sum of forces is within 20 % of that of the true conductances.
paper_*         2x2, noise of 0.3 LSB before rounding, 0 to 4 touches of 2 to 100 kohm, 150 frames:
                share that converges; share of `regularized` within 1 % of `matrix`; median time of
                a frame of `regularized` over that without noise.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from bars import Bar, at_least, at_most, report  # beside this file

import ohmskin
from ohmskin.arrays import Float
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.tables import load_press_table
from ohmskin.circuit.skin import readings
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.reader import SkinReader
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.messages import Scan
from studies.conditions import converted
from studies.information import information_limit
from studies.trials import (
    BOTTOM_WIRE_OHM,
    PRESSED,
    TOP_WIRE_OHM,
    Trial,
    finger_trial,
    skin_at_rest,
)

SEED = 5000
SKINS, FRAMES = 12, 150
SIGMA_CELLS, PEAK_SIEMENS, WIRE_OHM = (0.6, 1.0), (3e-5, 1.5e-4), (20.0, 1000.0)
FEW_FRAMES, MANY_FRAMES = 50, 100
TOUCHED_SIEMENS = 5e-6  # the sum of all cells' rise
METHODS, PAPER = ("joint", "touch"), ("lsq", "regularized", "matrix")
PAPER_TOUCH_OHM = (2e3, 1e5)
WITHIN = {1: 60, 2: 90, 4: 99}  # deviations: per cent of all cells


def fingertips(count: int, number: int, wire_ohm: tuple[float, float]) -> Trial:
    """One fingertip or two, 150 frames."""
    return finger_trial(
        *(8, 8, FRAMES, SEED + 2 * number + count - 1),
        sigma_cells=SIGMA_CELLS,
        peak_siemens=PEAK_SIEMENS,
        wire_ohm=wire_ohm,
    )


class Figures(dict[str, float]):
    """Figures by name, rounded."""

    def put(self, name: str, value: float, digits: int = 2) -> None:
        self[name] = round(float(value), digits)


class Judged:
    """What a method says of frames in order, against the truth."""

    def __init__(self, trial: Trial, method: str, told: bool) -> None:
        rounded = trial.rounded(10)
        knowledge = replace(
            rounded.knowledge(0), **({} if told else {"nominal_wire_ohm": NO_WIRES})
        )
        estimator = make_estimator(method, knowledge)
        found = [estimator.estimate(ratio) for ratio in rounded.ratio]
        siemens = np.array([each.cell_siemens for each in found])
        std = np.array([each.cell_siemens_std for each in found])
        truth, rest = trial.cell_siemens, trial.rest.cell_siemens
        rise = (truth - rest).sum(axis=(1, 2))
        touched = rise > TOUCHED_SIEMENS
        self.total: Float = (siemens - rest).sum(axis=(1, 2))[touched] / rise[touched]
        self.pressed = truth > PRESSED * rest
        self.relative: Float = np.abs(siemens - truth) / truth
        self.stated: Float = std / truth


def of_fingers(figures: Figures, method: str) -> None:
    """All figures of fingertips, but their limits."""
    random = np.random.default_rng(SEED)
    by_case: dict[str, dict[str, list[Judged]]] = {}
    for number, name in enumerate(("one", "two"), start=1):
        cases = by_case[name] = defaultdict(list)
        for seed in range(SKINS):
            usual = fingertips(number, seed, (TOP_WIRE_OHM, BOTTOM_WIRE_OHM))
            cases["untold"].append(Judged(usual, method, told=False))
            cases["told"].append(Judged(usual, method, told=True))
            top, bottom = np.exp(random.uniform(*np.log(WIRE_OHM), 2))
            mixed = fingertips(number, seed, (float(top), float(bottom)))
            cases["mixed"].append(Judged(mixed, method, told=False))
    one, two = by_case.values()
    by_case["all"] = {case: one[case] + two[case] for case in one}
    for name, judged in by_case.items():
        of_case(figures, f"{method}_{name}", judged)
    both = [each for case in ("untold", "told") for each in by_case["all"][case]]
    away = np.concatenate([(each.relative / each.stated).ravel() for each in both])
    for limit in WITHIN:
        figures.put(f"within_{limit}_std_{method}_percent", 100 * np.mean(away < limit))
    stated, error = (
        np.median(np.concatenate([getattr(each, name)[each.pressed] for each in both]))
        for name in ("stated", "relative")
    )
    figures.put(f"stated_over_error_{method}", stated / error)


def of_case(figures: Figures, key: str, cases: dict[str, list[Judged]]) -> None:
    total = {case: np.concatenate([each.total for each in cases[case]]) for case in cases}
    figures.put(f"total_{key}_p10", np.quantile(total["untold"], 0.1), 3)
    figures.put(f"total_{key}_p90", np.quantile(total["untold"], 0.9), 3)
    for case, word in (("untold", "total"), ("told", "told")):
        worst = np.exp(np.abs(np.log(np.maximum(total[case], 1e-3))).max())
        figures.put(f"{word}_{key}_worst", worst, 3)
    for part, when in (("first", slice(FEW_FRAMES)), ("late", slice(MANY_FRAMES, None))):
        error = [each.relative[when][each.pressed[when]] for each in cases["untold"]]
        median, p90 = np.quantile(100 * np.concatenate(error), [0.5, 0.9])
        figures.put(f"error_{key}_{part}_percent", median)
        figures.put(f"error_{key}_{part}_p90_percent", p90)
    figures.put(f"mixed_{key}_p90_percent", 100 * np.quantile(np.abs(total["mixed"] - 1), 0.9))
    over = [(each.relative / each.stated)[each.pressed] for each in cases["mixed"]]
    figures.put(f"mixed_{key}_within_4_std_percent", 100 * np.mean(np.concatenate(over) < 4))


def of_limits(figures: Figures) -> None:
    """What errors would be if normal, with the deviations of the posterior at the truth."""
    random = np.random.default_rng(SEED)
    for number, name in enumerate(("one", "two"), start=1):
        for word, layer_std in (("untold", None), ("known", 0.0)):
            errors = []
            for seed in range(SKINS):
                trial = fingertips(number, seed, (TOP_WIRE_OHM, BOTTOM_WIRE_OHM))
                known = replace(trial.rounded(10).knowledge(0), nominal_wire_ohm=NO_WIRES)
                for frame in range(0, FRAMES, 15):
                    pressed = trial.pressed[frame]
                    std = information_limit(
                        trial.frames[frame], known, pressed, layer_std=layer_std
                    )[pressed]
                    errors.append(np.abs(std * random.standard_normal(std.size)))
            p90 = 100 * np.quantile(np.concatenate(errors), 0.9)
            figures.put(f"limit_{name}_{word}_p90_percent", p90)


def of_forces(figures: Figures) -> None:
    table = load_press_table(Path(__file__).resolve().parents[1] / "examples" / "presses.csv")
    close = []
    for seed in range(6):
        scene = Scene("moving", 8, 8, seed=seed)
        with ohmskin.open(f"emulator://8x8?seed={seed}", start=False) as skin:
            board = skin.info
        rest = ratio_from_codes(quantise(scene.rest_ratio))
        calibrator = Calibrator(board, rest, "touch", 80e-6)
        calibration, _ = calibrator.calibration(calibrator.presses_in_table(table))
        reader = SkinReader(board, calibration)
        at_rest = Scene("rest", 8, 8, seed=seed).skin(0.0).cell_siemens
        for number in range(270):
            time_s = number / 90 + BEGIN_S
            codes = quantise(scene.ratio(time_s))
            found = reader.read(Scan(codes, number, 11_111 * number, number / 90, 0))
            rise = scene.skin(time_s).cell_siemens - at_rest
            true_n, _ = calibration.model.predict(rise, np.zeros_like(rise))
            close.append(abs(found.force_n.sum() / true_n.sum() - 1) < 0.2)
    figures.put("force_touch_within_20_percent", 100 * np.mean(close), 1)


def of_paper(figures: Figures) -> None:
    """The paper's method, on noisy and on perfect readings of the same frames."""
    random = np.random.default_rng(SEED)
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    converged: defaultdict[str, list[bool]] = defaultdict(list)
    close = []
    for _ in range(150):
        skin = skin_at_rest(2, 2, random)
        cells = skin.cell_siemens.copy()
        places = random.permutation(4)[: random.integers(0, 5)]
        cells.flat[places] = 1 / np.exp(random.uniform(*np.log(PAPER_TOUCH_OHM), places.size))
        skin = replace(skin, cell_siemens=cells)
        noisy = converted(readings(skin), random, 0.3)
        known = SkinKnowledge(2, 2, adc_bits=10)
        by = {method: make_estimator(method, known).estimate(noisy) for method in PAPER}
        for method in ("lsq", "regularized"):
            converged[method].append(by[method].converged)
        off = np.abs(by["regularized"].cell_siemens / by["matrix"].cell_siemens - 1)
        close.append(bool(off.max() < 0.01))
        seconds["noisy"].append(by["regularized"].seconds)
        perfect = make_estimator("regularized", known).estimate(converted(readings(skin)))
        seconds["perfect"].append(perfect.seconds)
    for method, each in converged.items():
        figures.put(f"paper_{method}_converged_percent", 100 * np.mean(each), 1)
    figures.put("paper_as_matrix_percent", 100 * np.mean(close), 1)
    figures.put(
        "paper_time_over_exact", np.median(seconds["noisy"]) / np.median(seconds["perfect"])
    )


def bars_of(method: str) -> list[Bar]:
    bars = [at_least(f"within_{n}_std_{method}_percent", share) for n, share in WITHIN.items()]
    bars.append(at_most(f"stated_over_error_{method}", 3))
    key = f"{method}_all"
    bars += [
        at_least(f"total_{key}_p10", 0.9),
        at_most(f"total_{key}_p90", 1.08),
        at_most(f"total_{key}_worst", 1.3),
        at_most(f"told_{key}_worst", 1.1),
        at_most(f"error_{key}_first_percent", 3.5),
        at_most(f"error_{key}_first_p90_percent", 10),
        at_most(f"error_{key}_late_percent", 2.5),
        at_most(f"error_{key}_late_p90_percent", 7),
        at_most(f"mixed_{key}_p90_percent", 30),
        at_least(f"mixed_{key}_within_4_std_percent", 95),
    ]
    return bars


def main() -> int:
    figures = Figures()
    for method in METHODS:
        of_fingers(figures, method)
    of_limits(figures)
    of_forces(figures)
    of_paper(figures)
    bars = [bar for method in METHODS for bar in bars_of(method)]
    bars.append(at_least("force_touch_within_20_percent", 95))
    bars += [at_least(f"paper_{method}_converged_percent", 97) for method in PAPER[:2]]
    bars += [at_least("paper_as_matrix_percent", 95), at_most("paper_time_over_exact", 1)]
    all_met = report(figures, bars)
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
