# SPDX-License-Identifier: Apache-2.0
"""Measure forces under many touches where nobody has told the wires.

    make bench-newtons

Everything is simulated: `pressed` says how. A skin is calibrated by a recording of presses, and
then 100 frames of 2 to 6 touches of 0.4 to 7 N are read. The figure is the root mean square of the
error of touched cells, RMSE [N]. Seven pairs of wires, twice each: presses by two laws. `told` has
the true middle of both layers, else nobody has told anything. --only takes some of these:

force     METHOD_over_told: RMSE over that of `joint` told, of the first five pairs, of 2000/4000
          and of 10000/10000. METHOD_over_ohm: over that of `ohm`. told_over_before: `joint` and
          `touch` told, over the same before calibrations learned wires. METHOD_bent: wires 0.75
          and 1.35 of those at the calibration, over `joint` told on the same frames. within_4,
          wrong: touched cells within 4 stated deviations; cells that are off by half, by 0.5 N and
          by 4 deviations in a frame that converged, for 100 touched ones.
wrong     METHOD_wrong: told wires wrongly, twice or half of them, over `joint` told rightly;
          wrong_said: how often ``calibrate`` says that they disagree [%]. The first five pairs.
wires     20 skins, wires of 20 ohm to 2 kohm: how often the wires of a layer that ``calibrate``
          has found are within 30 ohm or 12 %, and within 2 of their deviations [%].
small     2x2 and 3x3, the first five pairs: METHOD_over_told.
few       presses of 12 cells alone, of 8x8, the first five pairs.
newtons   leads of 600 ohm at every line, 100/200 ohm a segment: over `ohm`.
leads     conductances, no forces: 100/200 ohm a segment, leads of so many ohm at every line. Random
          touches, and fingertips. within_4 of pressed cells; wrong: frames with a cell that is off
          by half, by 10 uS and by 4 deviations, though they converged. told, far: median or 90th
          percentile of the error, the larger share, over that without leads.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from bars import ALL, Bar, Part, at_least, at_most, finish, options  # beside this file
from network import SkinCircuit  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import load_calibration
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES
from pressed import LAWS, PressedSkin, calibrate, noisy_codes, with_leads  # beside this file
from studies.judge import Judged, Verdict, answers_of, judge_trial, pooled, verdict
from studies.rows import in_processes
from studies.trials import NOMINAL_WIRE_OHM, finger_trial, random_trial

PAIRS: tuple[tuple[float, float], ...] = (
    *((20, 40), (50, 100), (200, 400), (500, 1000), (50, 600)),
    *((2000, 4000), (10000, 10000)),
)
FIRST = 5  # of these pairs; the other two have bars of their own
METHODS = ("joint", "touch")
SEED = 9000  # of the first skin
BENDS = (0.75, 1.35)  # wires over those at the calibration
REST_FRAMES = 90  # of the untouched skin, where conductances are measured
LEADS_OHM = (300, 1000, 3000)
# RMSE of `joint` and `touch` told [N] before calibrations learned wires, by pair and law: commit
# 0710d63, with this file, on the same recordings.
BEFORE_N: dict[tuple[float, float, str], tuple[float, float]] = {}


class Told(NamedTuple):
    """A method, and what is told: the wires over the true ones, or nothing."""

    method: str
    factor: float | None = None


OHM, TOLD = Told("ohm"), Told("joint", 1.0)
UNTOLD = {method: Told(method) for method in METHODS}
COMPARED = (OHM, TOLD, *UNTOLD.values())


@dataclass(frozen=True)
class Skin:
    """A skin that is calibrated, of which group of figures it is, and in which ways it is read."""

    group: str
    wire_ohm: tuple[float, float]
    law: str
    seed: int
    ways: tuple[Told, ...] = COMPARED
    shape: tuple[int, int] = (8, 8)
    lead_ohm: float = 0.0
    presses_of: int | None = None
    touches: int = 100
    bends: tuple[float, ...] = ()


class Read(NamedTuple):
    """What one way shows of a skin.

    rmse_n: as calibrated, then bent. within, wrong: [%]. said: by ``calibrate``. found: wires that
    it keeps. true_ohm: the mean segments of both layers.
    """

    rmse_n: tuple[float, ...]
    within: float
    wrong: float
    said: str
    found: WireOhm
    true_ohm: tuple[float, float]


def read(skin: Skin) -> tuple[Skin, dict[Told, Read]]:
    """Press, calibrate and touch a skin. A way whose calibration is refused shows nothing."""
    pressed = PressedSkin(
        *(skin.wire_ohm, skin.law, skin.seed),
        shape=skin.shape,
        lead_ohm=skin.lead_ohm,
        presses_of=skin.presses_of,
        touches=skin.touches,
    )
    true_ohm = float(pressed.rest.top_wire_ohm.mean()), float(pressed.rest.bottom_wire_ohm.mean())
    shown: dict[Told, Read] = {}
    with tempfile.TemporaryDirectory() as place, threadpool_limits(limits=1):
        recording, file = Path(place, "presses.mcap"), Path(place, "skin.json")
        pressed.record(recording)
        for way in skin.ways:
            told = WireOhm()
            if way.factor is not None:
                top, bottom = skin.wire_ohm
                told = WireOhm(way.factor * top, way.factor * bottom, skin.lead_ohm)
            try:
                said = calibrate(recording, file, way.method, told)
            except ValueError as refusal:
                nan = float("nan")
                refused = (nan,) * (1 + len(skin.bends)), nan, nan, str(refusal)
                shown[way] = Read(*refused, WireOhm(), true_ohm)
                continue
            flat, *bent = (pressed.read(file, factor) for factor in (1.0, *skin.bends))
            shown[way] = Read(
                tuple(forces.rmse_n() for forces in (flat, *bent)),
                flat.within_percent(),
                flat.wrong_percent(),
                said,
                load_calibration(file).nominal_wire_ohm,
                true_ohm,
            )
    return skin, shown


def skins(group: str, part: Part, seed: int) -> list[Skin]:
    """All skins of a group of figures."""
    of_laws = [
        Skin(group, pair, law, seed, touches=part.of(100))
        for pair, law in product(PAIRS[: part.of(len(PAIRS))], LAWS)
    ][: part.of(2 * len(PAIRS))]
    first = [skin for skin in of_laws if skin.wire_ohm in PAIRS[:FIRST]]
    if part is not ALL:
        of_laws = first = [replace(skin, shape=(2, 2)) for skin in first]
    match group:
        case "force":
            return [
                replace(skin, ways=(*COMPARED, Told("touch", 1.0)), bends=BENDS) for skin in of_laws
            ]
        case "wrong":
            factors = dict(zip(LAWS, (2.0, 0.5), strict=True))
            ways = {law: tuple(Told(m, factors[law]) for m in METHODS) for law in LAWS}
            return [replace(skin, ways=(TOLD, *ways[skin.law])) for skin in first]
        case "wires":
            random = np.random.default_rng(seed)
            ohm = np.exp(random.uniform(np.log(20), np.log(2000), (part.of(20), 2)))
            laws = list(LAWS) * len(ohm)
            return [
                replace(
                    first[0],
                    wire_ohm=(float(top), float(bottom)),
                    law=law,
                    seed=seed + number,
                    ways=(UNTOLD["joint"],),
                    touches=1,
                )
                for number, ((top, bottom), law) in enumerate(zip(ohm, laws, strict=False))
            ]
        case "small":
            return [replace(skin, shape=(n, n)) for n in (2, 3) for skin in first]
        case "few":
            return [replace(skin, presses_of=12) for skin in first]
        case "newtons":
            return [
                replace(skin, wire_ohm=NOMINAL_WIRE_OHM, lead_ohm=600.0, seed=seed + number)
                for number in range(part.of(2))
                for skin in first[:2]
            ]
    raise KeyError(group)


# ----------------------------------------------------------------------------------------- figures

Shown = list[tuple[Skin, dict[Told, Read]]]
Figures = dict[str, float | None]


def over(shown: Shown, way: Told, base: Told, bend: int = 0) -> Float:
    """RMSE of a way over that of another one, of each skin; infinite where one was refused."""
    shares = np.array([by[way].rmse_n[bend] / by[base].rmse_n[bend] for _, by in shown])
    return np.where(np.isnan(shares), np.inf, shares)


def put(
    figures: Figures, name: str, values: Float | Iterable[float], how: Callable[..., Any]
) -> None:
    value = float(how(np.array(values)))
    figures[name] = round(value, 3) if np.isfinite(value) else None


def of_force(shown: Shown) -> Figures:
    figures: Figures = {}
    by_pair = {pair: [one for one in shown if one[0].wire_ohm == pair] for pair in PAIRS}
    first = [one for pair in PAIRS[:FIRST] for one in by_pair[pair]]
    for method, way in UNTOLD.items():
        put(figures, f"{method}_over_told_worst", over(first, way, TOLD), np.max)
        put(figures, f"{method}_over_told_median", over(first, way, TOLD), np.median)
        for pair in filter(by_pair.get, PAIRS[FIRST:]):
            put(figures, f"{method}_over_told_{pair[0]}", over(by_pair[pair], way, TOLD), np.max)
        others = [one for one in shown if one[0].wire_ohm != (2000, 4000)]
        put(figures, f"{method}_over_ohm_worst", over(others, way, OHM), np.max)
        if by_pair[2000, 4000]:
            put(figures, f"{method}_over_ohm_2000", over(by_pair[2000, 4000], way, OHM), np.max)
        bent = [over(first, way, TOLD, 1 + bend) for bend in range(len(BENDS))]
        put(figures, f"{method}_bent_worst", np.concatenate(bent), np.max)
        put(figures, f"{method}_bent_median", np.concatenate(bent), np.median)
        put(figures, f"{method}_within_4", [by[way].within for _, by in shown], np.mean)
        put(figures, f"{method}_wrong", [by[way].wrong for _, by in shown], np.mean)
        told = Told(method, 1.0)
        before = [
            by[told].rmse_n[0] / BEFORE_N[*skin.wire_ohm, skin.law][METHODS.index(method)]
            for skin, by in shown
            if (*skin.wire_ohm, skin.law) in BEFORE_N and skin.seed == SEED
        ]
        if before:
            put(figures, f"{method}_told_over_before", before, np.median)
            put(figures, f"{method}_told_over_before_worst", before, np.max)
    return figures


def of_wrong(shown: Shown) -> Figures:
    figures: Figures = {}
    said = []
    for method in METHODS:
        shares = []
        for skin, by in shown:
            way = next(way for way in by if way.method == method and way.factor != 1.0)
            shares.append(over([(skin, by)], way, TOLD)[0])
            said.append("disagree" in by[way].said)
        put(figures, f"{method}_wrong_worst", shares, np.max)
        put(figures, f"{method}_wrong_median", shares, np.median)
    put(figures, "wrong_said", 100 * np.array(said), np.mean)
    return figures


def of_wires(shown: Shown) -> Figures:
    figures: Figures = {}
    near, stated = [], []
    for _, by in shown:
        found = by[UNTOLD["joint"]].found
        std = found.top_log_std, found.bottom_log_std
        both = found.both or (0.0, 0.0)
        for ohm, log_std, true in zip(both, std, by[UNTOLD["joint"]].true_ohm, strict=True):
            near.append(abs(ohm - true) <= max(30.0, 0.12 * true))
            stated.append(abs(np.log(max(ohm, 1e-3) / true)) <= 2 * (log_std or 0.0))
    put(figures, "wires_near", 100 * np.array(near), np.mean)
    put(figures, "wires_within_2", 100 * np.array(stated), np.mean)
    return figures


def of_small(shown: Shown) -> Figures:
    figures: Figures = {}
    for method, size in product(METHODS, (2, 3)):
        shares = over([one for one in shown if one[0].shape[0] == size], UNTOLD[method], TOLD)
        put(figures, f"{method}_{size}x{size}_worst", shares, np.max)
        put(figures, f"{method}_{size}x{size}_median", shares, np.median)
    return figures


def of_few(shown: Shown) -> Figures:
    figures: Figures = {}
    for method, way in UNTOLD.items():
        put(figures, f"{method}_few_worst", over(shown, way, TOLD), np.max)
        put(figures, f"{method}_few_median", over(shown, way, TOLD), np.median)
        put(figures, f"{method}_few_over_ohm", over(shown, way, OHM), np.max)
    return figures


def of_newtons(shown: Shown) -> Figures:
    figures: Figures = {}
    for method, way in UNTOLD.items():
        put(figures, f"{method}_leads_over_ohm", over(shown, way, OHM), np.max)
    return figures


OF_SKINS = {
    "force": of_force,
    "wrong": of_wrong,
    "wires": of_wires,
    "small": of_small,
    "few": of_few,
    "newtons": of_newtons,
}


# ------------------------------------------------------------------------------------------- leads


class Scene(NamedTuple):
    """Conductances behind leads: a kind of touches, read in a mode by a method."""

    kind: str
    seed: int
    frames: int
    lead_ohm: float
    method: str
    mode: str = "near"
    told: bool = False


def judged(scene: Scene) -> tuple[Scene, Judged, list[bool]]:
    """The answers against the truth, and which frames mislead."""
    random = np.random.default_rng(scene.seed)
    if scene.kind == "random":
        trial = random_trial(8, 8, 6, scene.frames, scene.seed)
    else:
        usual = {"sigma_cells": (0.6, 1.0), "peak_siemens": (3e-5, 3e-4)}
        trial = finger_trial(8, 8, scene.frames, scene.seed, **usual)
    circuit = SkinCircuit(with_leads(trial.rest, scene.lead_ohm, random))
    names = [ENUMS["reading"].values[name] for name in MODES[scene.mode]]
    cells = [*[trial.rest.cell_siemens] * REST_FRAMES, *trial.cell_siemens]
    exact = np.array([circuit.readings(cell)[..., names] for cell in cells])
    ratio = ratio_from_codes(noisy_codes(exact, random))
    told = WireOhm(lead=scene.lead_ohm) if scene.told else WireOhm()
    rest_ratio = ratio[:REST_FRAMES].mean(axis=0)
    known = SkinKnowledge(
        8,
        8,
        adc_bits=ADC_BITS,
        rest_ratio=rest_ratio,
        nominal_wire_ohm=told,
        reading_names=MODES[scene.mode],
    )
    with threadpool_limits(limits=1):
        estimator = make_estimator(scene.method, known)
        found = [estimator.estimate(frame) for frame in ratio[REST_FRAMES:]]
    misleads = [
        verdict(one, true, close_share=0.5, close_siemens=1e-5) is Verdict.WRONG_UNFLAGGED
        for one, true in zip(found, trial.cell_siemens, strict=True)
    ]
    return scene, judge_trial(answers_of(found), trial), misleads


def of_leads(scenes: list[tuple[Scene, Judged, list[bool]]]) -> Figures:
    figures: Figures = {}

    def all_of(*like: object) -> tuple[Judged, float]:
        """Of all scenes of this kind, method, mode, told and lead."""
        chosen = [
            (one, misleads)
            for scene, one, misleads in scenes
            if (scene.kind, scene.method, scene.mode, scene.told, scene.lead_ohm) == like
        ]
        wrong = 100 * float(np.mean(np.concatenate([misleads for _, misleads in chosen])))
        return pooled(one for one, _ in chosen), wrong

    for kind, method in product(("random", "fingers"), METHODS):
        for mode, told in (("near", False), ("near", True), ("far", False)):
            name = f"{kind}_{method}_{'told' if told else mode}"
            without, _ = all_of(kind, method, mode, told, 0)
            shares = []
            for lead_ohm in LEADS_OHM:
                one, wrong = all_of(kind, method, mode, told, lead_ohm)
                shares += [one.error_percent(q) / without.error_percent(q) for q in (0.5, 0.9)]
                if name.endswith("near"):
                    figures[f"{name}_{lead_ohm}_median"] = round(one.error_percent(), 2)
                    figures[f"{name}_{lead_ohm}_p90"] = round(one.error_percent(0.9), 2)
                    figures[f"{name}_{lead_ohm}_within_4"] = round(one.pressed_within_percent(), 1)
                    figures[f"{name}_{lead_ohm}_wrong"] = round(wrong, 2)
            if name.endswith("near"):
                figures[f"{name}_0_median"] = round(without.error_percent(), 2)
                figures[f"{name}_0_p90"] = round(without.error_percent(0.9), 2)
            else:
                figures[name] = round(max(shares), 2)
    return figures


# -------------------------------------------------------------------------------------------- bars


def bars() -> list[Bar]:
    found = [at_least("wires_near", 90), at_least("wires_within_2", 90)]
    found.append(at_least("wrong_said", 100))
    for m in METHODS:
        found += [
            at_most(f"{m}_over_told_worst", 1.1),
            at_most(f"{m}_over_told_median", 1.04),
            at_most(f"{m}_over_told_2000", 1.3),
            at_most(f"{m}_over_told_10000", 1.6),
            at_most(f"{m}_over_ohm_worst", 0.92),
            at_most(f"{m}_over_ohm_2000", 1.05),
            at_most(f"{m}_bent_worst", 1.1),
            at_least(f"{m}_within_4", 97),
            at_most(f"{m}_wrong", 0.5),
            at_most(f"{m}_told_over_before", 1.03),
            at_most(f"{m}_wrong_worst", 1.1),
            at_most(f"{m}_2x2_median", 1.15),
            at_most(f"{m}_3x3_median", 1.15),
            at_most(f"{m}_3x3_worst", 1.3),
            at_most(f"{m}_few_median", 1.05),
            at_most(f"{m}_few_worst", 1.3),
            at_most(f"{m}_few_over_ohm", 1.05),
            at_most(f"{m}_leads_over_ohm", 0.92),
        ]
        for kind, lead_ohm in product(("random", "fingers"), LEADS_OHM):
            within, wrong = (90, 10) if lead_ohm == LEADS_OHM[-1] else (95, 1)
            found.append(at_least(f"{kind}_{m}_near_{lead_ohm}_within_4", within))
            found.append(at_most(f"{kind}_{m}_near_{lead_ohm}_wrong", wrong))
        for kind, how in product(("random", "fingers"), ("told", "far")):
            found.append(at_most(f"{kind}_{m}_{how}", 1.5))
    return found


def print_table(shown: Shown) -> None:
    """RMSE of all ways on all skins, and what the presses have found."""
    for skin, by in shown:
        place = f"{skin.group} {skin.wire_ohm[0]:.0f}/{skin.wire_ohm[1]:.0f} {skin.law}"
        size, errors = "x".join(map(str, skin.shape)), []
        for way, one in by.items():
            told = "" if way.factor is None else f" told {way.factor:g}"
            errors.append(f"{way.method}{told} " + " ".join(f"{n:.3f}" for n in one.rmse_n))
        untold = by.get(UNTOLD["joint"])
        found = ""
        if untold is not None and untold.found.both is not None:
            found = "found " + "/".join(f"{ohm:.0f}" for ohm in untold.found.both)
        print(f"{place:28} {size} | {' | '.join(errors)} | {found}")


def measure(part: Part, only: list[str], seed: int, jobs: int) -> Figures:
    figures: Figures = {}

    def progress(done: int, of: int) -> None:
        print(f"\r{done} of {of} ", end="" if done < of else "\n", file=sys.stderr)

    tasks = [skin for group in only if group in OF_SKINS for skin in skins(group, part, seed)]
    shown = in_processes(read, tasks, jobs, progress)
    shown.sort(key=lambda one: tasks.index(one[0]))
    print_table(shown)
    for group, figures_of in OF_SKINS.items():
        if group in only:
            figures |= figures_of([one for one in shown if one[0].group == group])
    if "leads" in only:
        ways = (("near", False), ("near", True), ("far", False))
        scenes = [
            Scene(kind, seed + number, part.of(80), lead_ohm, method, mode, told)
            for kind, number, lead_ohm, method, (mode, told) in product(
                ("random", "fingers"), range(part.of(4)), (0, *LEADS_OHM), METHODS, ways
            )
        ]
        figures |= of_leads(in_processes(judged, scenes, jobs, progress))
    return figures


def main() -> int:
    groups = (*OF_SKINS, "leads")
    parser = options(__doc__)
    parser.add_argument("--only", default=",".join(groups), help=f"of {', '.join(groups)}")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first skin")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one a core")
    asked = parser.parse_args()
    figures = measure(asked.part, asked.only.split(","), asked.seed, asked.jobs)
    return finish(asked.part, figures, [bar for bar in bars() if bar.figure in figures])


if __name__ == "__main__":
    sys.exit(main())
