# SPDX-License-Identifier: Apache-2.0
"""Print the tables of docs/accuracy.md and docs/paper.md, and one JSON object as the last line.

    make bench-tables
    PYTHONPATH=. .venv/bin/python benchmarks/bench_tables.py --start-wire-ohm 10000

Everything is simulated. It prints:

- the RMSE [Mohm] of the paper's two sweeps, readings made with ngspice (tests/data), one frame per
  condition, cold. `joint` and `touch` are told rest readings and nominal wires, the others nothing.
  The wire sweep also with cells pressed to 0.1 megohm: docs/paper.md says why.
- what becomes of a method that is told less: 20 random 8x8 skins of 20 frames, up to 8 touches, 10
  bit, in order. That there are no leads is told, but in the row that says so.
- of the paper's methods: how many frames converge, how long they take, and how many converge to a
  wrong answer.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bars import Part, options  # beside this file
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.paper import PaperEstimator
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import estimate_file
from studies.conditions import converted
from studies.judge import judge_trial, pooled
from studies.published import CONDITIONS_MEGOHM, RMSE_MEGOHM
from studies.trials import (
    NOMINAL_WIRE_OHM,
    PAPER_METHODS,
    SPREAD,
    Trial,
    random_trial,
    reference_trial,
    trial_of,
    without_leads,
    without_wires,
)

OURS = ("joint", "touch")
PAPER_NAMES = {"ohm": "naive", "lsq": "least squares", "regularized": "regularized"}
SWEPT = {"cell_sweep": "pressed cells", "wire_sweep": "wires"}
PRESSED_OHM = 1e5  # of the other wire sweep: what the paper's figures look like (docs/paper.md)
# The random 8x8 skins that are told less: how many, frames of each, most touches in a frame, seed
# of the first.
SKINS, FRAMES, TOUCHES, SEED = 20, 20, 8, 2000
PRESSES = 90  # frames of the moving presses
SCENES = {2: 100, 3: 40}  # random scenes by rows and columns
# A cell is wrong if it is off by so much [ohm]. Chosen: by a cell at rest.
WRONG_OHM = 1e6
TOLD = {
    (True, True): "rest readings, nominal wires",
    (True, False): "rest readings",
    (False, True): "nominal wires",
    (False, False): "nothing",
}
LEADS_NEITHER = "nothing, leads neither"


def papers(part: Part) -> tuple[str, ...]:
    """The paper's methods that are run: they are slow."""
    return PAPER_METHODS[: part.of(len(PAPER_METHODS))]


def print_table(headings: Iterable[object], rows: Iterable[Iterable[object]]) -> None:
    """A table in Markdown."""
    for number, row in enumerate((list(headings), *map(list, rows))):
        print("| " + " | ".join(map(str, row)) + " |")
        if number == 0:
            print("|" + "---|" * len(row))
    print()


# ---------------------------------------------------------------------------- the paper's sweeps


def rmse_megohm(trial: Trial, method: str, bits: int | None = None) -> Float:
    """RMSE over the cells of each frame, each from a cold start."""
    told = trial.rounded(bits)
    if method not in OURS:
        told = replace(without_wires(told), rest_ratio=None)
    return judge_trial(estimate_file(told, method, cold=True), trial).rmse_megohm


def print_sweep(
    swept: str, conditions: Iterable[float], rmse: dict[str, Float], paper: dict[str, Any]
) -> None:
    print(f"RMSE [Mohm] over the nine cells, exact readings; swept: {swept} [Mohm]\n")
    rows = {f"paper: {PAPER_NAMES[name]}": row for name, row in paper.items()}
    rows |= {f"`{name}`": row for name, row in rmse.items()}
    print_table(["", *conditions], ([name, *(f"{x:.4f}" for x in rows[name])] for name in rows))


def print_sweeps(part: Part) -> dict[str, dict[str, list[float]]]:
    theirs = ("ohm", "matrix", *papers(part))
    figures = {}
    for name, paper in RMSE_MEGOHM.items():
        trial = reference_trial(f"{name}_3x3")
        rmse = {method: rmse_megohm(trial, method) for method in (*theirs, *OURS)}
        rmse["joint, 10 bit"] = rmse_megohm(trial, "joint", ADC_BITS)
        print_sweep(SWEPT[name], CONDITIONS_MEGOHM[name], rmse, paper)
        figures[name] = {
            method: [round(float(error), 6) for error in row] for method, row in rmse.items()
        }
    drawn = reference_trial("wire_sweep_3x3")
    cells = np.where(drawn.pressed, 1 / PRESSED_OHM, drawn.cell_siemens)
    frames = zip(drawn.frames, cells, strict=True)
    trial = trial_of(drawn.rest, [replace(skin, cell_siemens=cell) for skin, cell in frames])
    rmse = {method: rmse_megohm(trial, method) for method in theirs}
    swept = f"wires, cells pressed to {PRESSED_OHM / 1e6:g}"
    print_sweep(swept, CONDITIONS_MEGOHM["wire_sweep"], rmse, RMSE_MEGOHM["wire_sweep"])
    return figures


# -------------------------------------------------------------------------------------- told less


def print_told(part: Part) -> dict[str, dict[str, float]]:
    print(f"8x8, up to {TOUCHES} touches, 10 bit: what becomes of a method that is told less\n")
    trials = [
        random_trial(8, 8, TOUCHES, part.of(FRAMES), SEED + number)
        for number in range(part.of(SKINS))
    ]
    figures, rows = {}, []
    cases = [("ohm", True, True, True), ("matrix", True, True, True)]
    for method in OURS:
        cases += [*((method, *told, True) for told in TOLD), (method, False, False, False)]
    for method, rest_told, wires_told, leads_told in cases:
        parts = []
        for trial in trials:
            told = trial.rounded(ADC_BITS, wires_told=wires_told)
            told = told if rest_told else replace(told, rest_ratio=None)
            told = told if leads_told else without_leads(told)
            parts.append(judge_trial(estimate_file(told, method), trial))
        judged = pooled(parts)
        of_case = {
            "median_percent": round(judged.error_percent(), 2),
            "p90_percent": round(judged.error_percent(0.9), 1),
            "ghost_p95_us": round(judged.ghost_us(), 2),
            "within_4_std_percent": round(judged.within_percent(4), 1),
            "converged_percent": round(judged.converged_percent(), 1),
        }
        name = TOLD[rest_told, wires_told] if leads_told else LEADS_NEITHER
        name = name if method in OURS else "uses none of it"
        figures[f"{method}, {name}"] = of_case
        rows.append([f"`{method}`", name, *of_case.values()])
    headings = ["method", "told", "median error [%]", "90th percentile [%]"]
    headings += ["ghost, 95 % of frames [uS]", "errors within 4 std [%]", "converged [%]"]
    print_table(headings, rows)
    return figures


# --------------------------------------------------------------------------- the paper's methods


def moving_presses(size: int, frames: int) -> Iterator[Float]:
    """10-bit readings of presses that come and go within a second at 90 frames a second."""
    random = np.random.default_rng(size)
    shape = (size, size)
    top, bottom = (ohm * np.exp(SPREAD * random.standard_normal(shape)) for ohm in NOMINAL_WIRE_OHM)
    rest = 1e-6 * np.exp(SPREAD * random.standard_normal(shape))
    pressed = np.exp(-random.uniform(np.log(2e3), np.log(1e5), shape)) * (
        random.random(shape) < 0.6
    )
    phase, turns = random.random(shape), random.uniform(0.5, 1.5, shape)
    for frame in range(frames):
        force = np.maximum(0, np.sin(2 * np.pi * (turns * frame / frames + phase))) ** 2
        yield converted(readings(Skin(rest + force * pressed, top, bottom)))


def print_times(
    estimator: Estimator, what: str, frames: Iterable[Float], cold: bool = False
) -> None:
    estimates = []
    for ratio in frames:
        if cold:
            estimator.reset()
        estimates.append(estimator.estimate(ratio))
    iterations = [estimate.iterations for estimate in estimates]
    ms = [1e3 * estimate.seconds for estimate in estimates]
    converged = sum(estimate.converged for estimate in estimates)
    print(
        f"{estimator.name:11} {what:28} {converged:3} of {len(estimates):2}"
        f"  {np.median(iterations):4.0f}; {max(iterations):3}"
        f"  {np.median(ms):6.1f}; {max(ms):6.1f} ms"
    )


def print_convergence(part: Part) -> None:
    print("converged, iterations and time a frame (median; largest), all steps together")
    for method in papers(part):
        for name in ("random_2x2", "wire_sweep_3x3", "cell_sweep_3x3"):
            for bits, word in ((None, "exact"), (ADC_BITS, "10 bit")):
                ratio = reference_trial(name).rounded(bits).ratio
                ratio = ratio[: part.of(len(ratio))]
                estimator = make_estimator(
                    method, SkinKnowledge(ratio.shape[1], ratio.shape[2], adc_bits=bits)
                )
                print_times(estimator, f"{name}, {word}, cold", ratio, cold=True)
        for size in SCENES:
            estimator = make_estimator(method, SkinKnowledge(size, size, adc_bits=ADC_BITS))
            presses = moving_presses(size, part.of(PRESSES))
            print_times(estimator, f"presses, {size}x{size}, warm", presses)


def random_scenes(size: int, scenes: int) -> Iterator[tuple[Float, Float]]:
    """10-bit readings and cells [ohm]: none to all touched, 1 to 300 kilohm, wires that vary."""
    random = np.random.default_rng(size)
    shape = (size, size)
    for _ in range(scenes):
        cell_ohm = 1e6 * np.exp(SPREAD * random.standard_normal(shape))
        pressed_ohm = np.exp(random.uniform(np.log(1e3), np.log(3e5), shape))
        touched = random.random(shape) < random.random()
        cell_ohm = np.where(touched, pressed_ohm, cell_ohm)
        top, bottom = (
            ohm * np.exp(3 * SPREAD * random.standard_normal(shape)) for ohm in NOMINAL_WIRE_OHM
        )
        yield converted(readings(Skin(1 / cell_ohm, top, bottom))), cell_ohm


def print_reliability(part: Part) -> None:
    print("\nrandom scenes, 10 bit, cold: scenes, converged, of these with a cell wrong by 1 Mohm")
    for method in papers(part):
        for size, usual in SCENES.items():
            estimator = make_estimator(method, SkinKnowledge(size, size, adc_bits=ADC_BITS))
            scenes, converged, wrong = part.of(usual), 0, 0
            for ratio, cell_ohm in random_scenes(size, scenes):
                estimator.reset()
                estimate = estimator.estimate(ratio)
                is_wrong = bool(np.abs(estimate.cell_ohm - cell_ohm).max() > WRONG_OHM)
                converged += estimate.converged
                wrong += estimate.converged and is_wrong
            print(f"{method:11} {size}x{size} {scenes:4} {converged:4} {wrong:3}")


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--start-wire-ohm", type=float, default=100.0, help="step 2's 'zero'")
    asked = parser.parse_args()
    PaperEstimator.start_wire_megohm = asked.start_wire_ohm / 1e6
    figures = {"sweeps": print_sweeps(asked.part), "told": print_told(asked.part)}
    print_convergence(asked.part)
    print_reliability(asked.part)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
