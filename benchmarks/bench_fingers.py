# SPDX-License-Identifier: Apache-2.0
"""Measure what a user gets who knows no wires: fingertips.

    make bench-fingers

Everything is simulated, with the circuit that ngspice was compared with; readings have 10
bits. Fingertips move in circles over 8x8 skins: the pressure of each is a Gaussian of 0.6 to 1.0
cells with a peak of 30 to 150 uS, around those of tests/data/finger_8x8. `one`, `two`: so many
fingertips at once, on 12 skins, 150 frames of each; `all`: both. Pressed cells conduct half as much
again as at rest. What is measured how, for both methods:

total_*         sum of the rise of all cells over the true one: 10th and 90th percentile, and the
                frame that is furthest off, as a ratio above 1. Frames that touch with 5 uS or more.
error_*         error of a pressed cell, median and 90th percentile: of the first 50 frames, and of
                those after a hundred.
told_*_worst    the worst total where the wires are told: the nominal 100 and 200 ohm.
nothing_*       total and error of all frames, and pressed cells within 4 stated deviations, where
                nobody has told either that there are no leads. All other figures are told that.
stated_*        median stated deviation of a pressed cell over its median error.
mixed_*         the same fingertips on skins with wires of 20 ohm to 1 kohm a segment, not told:
                90th percentile of the total's error, pressed cells within 4 stated deviations.
limit_*         90th percentile of the errors that one frame of them allows whoever knows which
                cells are pressed: wires not told, and the mean wire of each layer known exactly,
                but not how segments deviate from it (studies/information.py).
"""

from __future__ import annotations

import sys
from collections import defaultdict
from typing import Any

import numpy as np

from bars import Bar, Part, at_least, at_most, run  # beside this file
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import estimate_file
from studies.information import pressed_limits
from studies.judge import Judged, judge_trial, pooled
from studies.trials import NOMINAL_WIRE_OHM, Trial, finger_trial, without_leads

METHODS = ("joint", "touch")
SEED = 5000  # of the first skin
SKINS, FRAMES = 12, 150  # skins of one fingertip, and of two; frames of each
# Of each fingertip: standard deviation of its pressure [cells], and its peak [S]. Chosen: around
# those of tests/data/finger_8x8.
SIGMA_CELLS, PEAK_SIEMENS = (0.6, 1.0), (3e-5, 1.5e-4)
WIRE_OHM = (20.0, 1000.0)  # a segment of skins whose wires are mixed: a decade to either side
# The first frames, in which wires are not learned yet, and the late ones, in which they are.
PARTS = {"every": slice(None), "first": slice(0, 50), "late": slice(100, None)}
TOUCHED_SIEMENS = 5e-6  # a frame touches if all its cells together rise by so much. Chosen.


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

    def put(self, name: str, value: float | np.floating[Any], digits: int = 2) -> None:
        self[name] = round(float(value), digits)


def read(
    trial: Trial, method: str, *, wires_told: bool, leads_told: bool = True
) -> dict[str, Judged]:
    """What a method says of one skin's frames in order, by parts of them."""
    told = trial.rounded(ADC_BITS, wires_told=wires_told)
    answers = estimate_file(told if leads_told else without_leads(told), method)
    return {name: judge_trial(answers, trial, part) for name, part in PARTS.items()}


def of_fingers(figures: Figures, method: str, skins: int) -> None:
    """All figures of fingertips, but their limits."""
    random, (low, high) = np.random.default_rng(SEED), np.log(WIRE_OHM)
    by_name: dict[str, dict[str, list[dict[str, Judged]]]] = {}
    for count, name in enumerate(("one", "two"), start=1):
        cases: defaultdict[str, list[dict[str, Judged]]] = defaultdict(list)
        by_name[name] = cases
        for number in range(skins):
            usual = fingertips(count, number, NOMINAL_WIRE_OHM)
            cases["untold"].append(read(usual, method, wires_told=False))
            cases["told"].append(read(usual, method, wires_told=True))
            cases["nothing"].append(read(usual, method, wires_told=False, leads_told=False))
            top, bottom = np.exp(random.uniform(low, high, 2))
            mixed = fingertips(count, number, (float(top), float(bottom)))
            cases["mixed"].append(read(mixed, method, wires_told=False))
    one, two = by_name.values()
    by_name["all"] = {case: one[case] + two[case] for case in one}
    for name, by_case in by_name.items():
        of_case(figures, f"{method}_{name}", by_case)


def of_case(figures: Figures, key: str, cases: dict[str, list[dict[str, Judged]]]) -> None:
    judged = {case: pooled(skin["every"] for skin in skins) for case, skins in cases.items()}
    total = {
        case: every.rise_share[every.rise_siemens > TOUCHED_SIEMENS]
        for case, every in judged.items()
    }
    figures.put(f"total_{key}_p10", np.quantile(total["untold"], 0.1), 3)
    figures.put(f"total_{key}_p90", np.quantile(total["untold"], 0.9), 3)
    figures.put(f"nothing_{key}_p10", np.quantile(total["nothing"], 0.1), 3)
    figures.put(f"nothing_{key}_p90", np.quantile(total["nothing"], 0.9), 3)
    figures.put(f"nothing_{key}_percent", judged["nothing"].error_percent())
    figures.put(f"nothing_{key}_p90_percent", judged["nothing"].error_percent(0.9))
    within_percent = judged["nothing"].pressed_within_percent()
    figures.put(f"nothing_{key}_within_4_std_percent", within_percent)
    for case, word in (("untold", "total"), ("told", "told"), ("nothing", "nothing")):
        worst = np.exp(np.abs(np.log(np.maximum(total[case], 1e-3))).max())
        figures.put(f"{word}_{key}_worst", worst, 3)
    for case, word in (("untold", "stated"), ("told", "stated_told")):
        every = judged[case]
        figures.put(f"{word}_{key}", np.median(every.stated) / np.median(every.relative))
    for part in ("first", "late"):
        of_part = pooled(skin[part] for skin in cases["untold"])
        figures.put(f"error_{key}_{part}_percent", of_part.error_percent())
        figures.put(f"error_{key}_{part}_p90_percent", of_part.error_percent(0.9))
    figures.put(f"mixed_{key}_p90_percent", 100 * np.quantile(np.abs(total["mixed"] - 1), 0.9))
    within_percent = judged["mixed"].pressed_within_percent()
    figures.put(f"mixed_{key}_within_4_std_percent", within_percent)


def of_limits(figures: Figures, skins: int) -> None:
    """What errors would be if normal, with the deviations of the posterior at the truth."""
    random = np.random.default_rng(SEED)
    for count, name in enumerate(("one", "two"), start=1):
        for word, layer_std in (("untold", None), ("known", 0.0)):
            errors = []
            for number in range(skins):
                trial = fingertips(count, number, NOMINAL_WIRE_OHM)
                some = slice(0, FRAMES, 15)
                std = pressed_limits(trial, some, wires_told=False, layer_std=layer_std)
                errors.append(np.abs(std * random.standard_normal(std.size)))
            p90 = 100 * np.quantile(np.concatenate(errors), 0.9)
            figures.put(f"limit_{name}_{word}_p90_percent", p90)


def bars_of(method: str) -> list[Bar]:
    key = f"{method}_all"
    return [
        at_least(f"total_{key}_p10", 0.9),
        at_most(f"total_{key}_p90", 1.08),
        at_most(f"total_{key}_worst", 1.3),
        at_most(f"told_{key}_worst", 1.1),
        at_most(f"stated_{key}", 6),
        at_most(f"stated_told_{key}", 3),
        at_most(f"error_{key}_first_percent", 3.5),
        at_most(f"error_{key}_first_p90_percent", 10),
        at_most(f"error_{key}_late_percent", 2.5),
        at_most(f"error_{key}_late_p90_percent", 7),
        at_most(f"mixed_{key}_p90_percent", 30),
        at_least(f"mixed_{key}_within_4_std_percent", 95),
    ]


def measure(part: Part) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    figures = Figures()
    for method in METHODS:
        of_fingers(figures, method, part.of(SKINS))
    of_limits(figures, part.of(SKINS))
    return figures


if __name__ == "__main__":
    sys.exit(run(__doc__, measure, [bar for method in METHODS for bar in bars_of(method)]))
