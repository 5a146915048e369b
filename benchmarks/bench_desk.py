# SPDX-License-Identifier: Apache-2.0
"""Measure what is estimated from a board that is as unkind as one on a desk.

    make bench-desk

Everything is simulated: the built firmware scans 8x8 skins at 90 Hz in simavr, with the
preset `desk` of firmware/sim: sample, node and line capacitances; offset and gain of the converter
up to 2 LSB, its bow up to 1.5, drawn anew for each of 10 skins; noise of 0.5 LSB. Each skin is at
rest, then touched anew 24 times, up to 8 cells of 1 to 100 kohm; a touch stays for three scans, of
which the last is judged. Wires are 100 and 200 ohm, of which segments deviate by 10 %.

measured_*  the board on a desk, wires told as `ohmskin doctor --press` measures them there before,
            with their deviation
desk_*      the same, wires told as 100 and 200 ohm, without a deviation
exact_*     the same skins as readings of 10 bits, which are exact otherwise, wires told without
far_*       the same skins on a board in mode far; there the wires are not told

*_percent            median error of a pressed cell, and its 90th percentile
*_within_4           pressed cells within 4 stated deviations [%]
*_wrong              frames that are wrong and not flagged [%]: a cell is off by more than 4 stated
                     deviations and by more than half of its value
*_stated             pressed cells: median of stated deviation over error. Normal errors: 1.5. The
                     methods expect that the skin may have been stretched by up to 30 % since its
                     wires were told: here it has not
doctor_share, _std   median of what the doctor measures of the wires over truth, and its deviation
"""

from __future__ import annotations

import sys

import numpy as np

from bars import Part, at_least, at_most, run  # beside this file
from desk import DeskSkin, desk_skin, examined  # tests/helpers
from ohmskin.circuit.skin import readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, MODES
from studies.judge import Verdict, answers_of, judge, pooled, verdict
from studies.trials import NOMINAL_WIRE_OHM

SKINS, FRAMES = 10, 24  # skins, and touches of each
METHODS = ("joint", "touch")
WRONG_SHARE = 0.5  # a cell that is off by more than this share of its value is wrong. Chosen.


def exact(skin: DeskSkin) -> DeskSkin:
    """The same without a board."""
    rest, *frames = (
        ratio_from_codes(quantise(readings(state))) for state in (skin.rest, *skin.frames)
    )
    return DeskSkin(skin.rest, rest, skin.frames, [np.array([ratio] * 3) for ratio in frames])


def measured(seed: int) -> WireOhm:
    """What `ohmskin doctor --press --into` keeps of the wires."""
    whole = (examined(seed, NOMINAL_WIRE_OHM).pressed or [])[0]
    top_ohm, bottom_ohm = NOMINAL_WIRE_OHM
    log_std = whole.std / whole.share
    segments = whole.share * top_ohm, whole.share * bottom_ohm
    return WireOhm(*segments, lead=0.0, top_log_std=log_std, bottom_log_std=log_std)


def judged(
    skins: list[DeskSkin], method: str, wires_of: list[WireOhm], mode: str = "near"
) -> dict[str, float]:
    parts, wrong = [], []
    for skin, wires in zip(skins, wires_of, strict=True):
        knowledge = SkinKnowledge(
            *skin.rest.shape,
            adc_bits=ADC_BITS,
            rest_ratio=skin.rest_ratio,
            nominal_wire_ohm=wires,
            reading_names=MODES[mode],
        )
        estimator = make_estimator(method, knowledge)
        # Of the three scans of a touch, the last is judged.
        estimates = [[estimator.estimate(ratio) for ratio in three][-1] for three in skin.ratios]
        truth = np.array([frame.cell_siemens for frame in skin.frames])
        parts.append(judge(answers_of(estimates), truth, skin.rest.cell_siemens))
        for estimate, true_siemens in zip(estimates, truth, strict=True):
            said = verdict(estimate, true_siemens, close_share=WRONG_SHARE, close_siemens=0.0)
            wrong.append(said is Verdict.WRONG_UNFLAGGED)
    together = pooled(parts)
    return {
        "percent": round(together.error_percent(), 2),
        "p90_percent": round(together.error_percent(0.9), 2),
        "within_4": round(together.pressed_within_percent(), 2),
        "wrong": round(100 * float(np.mean(wrong)), 2),
        "stated": round(float(np.median(together.stated / together.relative)), 2),
    }


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    count, frames = part.of(SKINS), part.of(FRAMES)
    desk = [desk_skin(seed, frames) for seed in range(count)]
    far = [desk_skin(seed, frames, mode="far") for seed in range(count)]
    by_doctor = [measured(seed) for seed in range(count)]
    # The simulator's multiplexers have 1 ohm: there are no leads, and that is told.
    nominal, unknown = (
        [WireOhm(top, bottom, lead=0.0)] * count for top, bottom in (NOMINAL_WIRE_OHM, (None, None))
    )
    shares = [wires.top / NOMINAL_WIRE_OHM[0] for wires in by_doctor if wires.top]
    stds = [wires.top_log_std for wires in by_doctor if wires.top_log_std is not None]
    figures = {
        "doctor_share": round(float(np.median(shares)), 3),
        "doctor_std": round(float(np.median(stds)), 3),
    }
    for name, skins, wires, mode in (
        ("measured", desk, by_doctor, "near"),
        ("desk", desk, nominal, "near"),
        ("exact", [exact(skin) for skin in desk], nominal, "near"),
        ("far", far, unknown, "far"),
    ):
        for method in METHODS:
            of_method = judged(skins, method, wires, mode)
            figures |= {f"{name}_{method}_{key}": value for key, value in of_method.items()}
    return figures


BARS = [
    bar
    for method in METHODS
    for name in ("measured", "desk", "far")
    for bar in (
        at_most(f"{name}_{method}_percent", 1.5),
        at_least(f"{name}_{method}_within_4", 98),
        at_most(f"{name}_{method}_wrong", 1),
        *([] if name == "far" else [at_most(f"{name}_{method}_stated", 2.6)]),
    )
]

if __name__ == "__main__":
    sys.exit(run(__doc__, measure, BARS))
