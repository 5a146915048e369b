# SPDX-License-Identifier: Apache-2.0
"""Measure what is estimated from a board that is as unkind as one on a desk.

    make bench-desk

Prints a table of bars and, as the last line, one JSON object. The exit code is 1 when a bar is
missed. Everything is simulated: the built firmware scans 8x8 skins at 90 Hz in simavr, with the
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
                     methods expect a layer told without a deviation to be up to 30 % off: here it
                     is not
doctor_share, _std   median of what the doctor measures of the wires over truth, and its deviation
"""

from __future__ import annotations

import json
import sys

import numpy as np
from bars import at_least, at_most, report  # beside this file

from desk import DeskSkin, desk_skin, examined  # tests/helpers
from ohmskin.circuit.skin import readings
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import MODES
from studies.trials import BOTTOM_WIRE_OHM, PRESSED, TOP_WIRE_OHM

SKINS, FRAMES = 10, 24
METHODS = ("joint", "touch")
NOMINAL = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)


def exact(skin: DeskSkin) -> DeskSkin:
    """The same without a board."""
    rest, *frames = (
        ratio_from_codes(quantise(readings(each))) for each in (skin.rest, *skin.frames)
    )
    return DeskSkin(skin.rest, rest, skin.frames, [np.array([each] * 3) for each in frames])


def measured(seed: int) -> WireOhm:
    """What `ohmskin doctor --press --into` keeps of the wires."""
    whole = (examined(seed, NOMINAL).pressed or [])[0]
    return WireOhm(*(whole.share * ohm for ohm in NOMINAL), whole.std / whole.share)


def judged(
    skins: list[DeskSkin], method: str, wires_of: list[WireOhm], mode: str = "near"
) -> dict[str, float]:
    error, stated, wrong = [], [], []
    for skin, wires in zip(skins, wires_of, strict=True):
        knowledge = SkinKnowledge(
            *(8, 8),
            adc_bits=10,
            rest_ratio=skin.rest_ratio,
            nominal_wire_ohm=wires,
            reading_names=MODES[mode],
        )
        estimator = make_estimator(method, knowledge)
        for truth, ratios in zip(skin.frames, skin.ratios, strict=True):
            *_, found = (estimator.estimate(ratio) for ratio in ratios)
            pressed = truth.cell_siemens > PRESSED * skin.rest.cell_siemens
            off = np.abs(found.cell_siemens - truth.cell_siemens)
            far = off > np.maximum(4 * found.cell_siemens_std, 0.5 * truth.cell_siemens)
            wrong.append(found.converged and bool(far.any()))
            error.append((off / truth.cell_siemens)[pressed])
            stated.append((found.cell_siemens_std / truth.cell_siemens)[pressed])
    errors, stds = np.concatenate(error), np.concatenate(stated)
    return {
        "percent": round(100 * float(np.median(errors)), 2),
        "p90_percent": round(100 * float(np.quantile(errors, 0.9)), 2),
        "within_4": round(100 * float(np.mean(errors < 4 * stds)), 2),
        "wrong": round(100 * float(np.mean(wrong)), 2),
        "stated": round(float(np.median(stds / errors)), 2),
    }


def main() -> int:
    desk = [desk_skin(seed, FRAMES) for seed in range(SKINS)]
    by_doctor = [measured(seed) for seed in range(SKINS)]
    shares = [wires.top / TOP_WIRE_OHM for wires in by_doctor if wires.top]
    figures = {
        "doctor_share": round(float(np.median(shares)), 3),
        "doctor_std": round(float(np.median([wires.log_std for wires in by_doctor])), 3),
    }
    nominal = [WireOhm(*NOMINAL)] * SKINS
    far = [desk_skin(seed, FRAMES, mode="far") for seed in range(SKINS)]
    bars = []
    for name, skins, wires, mode in (
        ("measured", desk, by_doctor, "near"),
        ("desk", desk, nominal, "near"),
        ("exact", [exact(skin) for skin in desk], nominal, "near"),
        ("far", far, [NO_WIRES] * SKINS, "far"),
    ):
        for method in METHODS:
            found = judged(skins, method, wires, mode)
            figures |= {f"{name}_{method}_{key}": value for key, value in found.items()}
            if name != "exact":
                bars += [
                    at_most(f"{name}_{method}_percent", 1.5),
                    at_least(f"{name}_{method}_within_4", 98),
                    at_most(f"{name}_{method}_wrong", 1),
                ]
            if name in ("measured", "desk"):
                bars.append(at_most(f"{name}_{method}_stated", 2))
    all_met = report(figures, bars)
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
