# SPDX-License-Identifier: Apache-2.0
"""Measure forces under many touches where nobody has told the wires.

    make bench-newtons

Everything is simulated: tests/helpers/pressed_skin.py says how. A skin is calibrated by a recording
of presses, and 100 frames of 2 to 6 touches of 0.4 to 7 N are read after that. RMSE [N]: root mean
square of the error of touched cells. Seven pairs of wires, each with presses by two laws. `told`:
the true middle of both layers; else nobody has told anything. --only takes some of these groups:

force     METHOD_over_told: RMSE over that of `joint` told, of the first five pairs, of 2000/4000
          and of 10000/10000. METHOD_over_ohm: over that of `ohm`. METHOD_told_over_before: told,
          over the same before calibrations learned wires; no_leads: `joint`, told wires, but not
          that there are no leads. METHOD_bent: wires 0.75 and 1.35 of those at the calibration,
          over `joint` told on the same frames. within_4, wrong: touched cells within 4 stated
          deviations; cells off by half, by 0.5 N and by 4 deviations in frames that converged, for
          100 touched ones.
wrong     METHOD_wrong: told twice the wires, or half of them, over `joint` told rightly. Five
          pairs. wrong_said: how often ``calibrate`` says that presses and told wires disagree [%].
wires     20 skins, wires of 20 ohm to 2 kohm: how often those of a layer that ``calibrate`` has
          found are within 30 ohm or 12 %, and within 2 of their deviations [%].
small     2x2 and 3x3, five pairs: over `joint` told.
few       presses of 12 cells alone, of 8x8, five pairs: over `joint` told, over `ohm`.
sparse    one, two, three presses of every cell, and five, 8x8, 50/100 and 500/1000: RMSE [N].
newtons   leads of 600 ohm at every line, 100/200 ohm a segment: over `ohm`.
odd       one line with a lead of 2 kohm, at others none, 50/100 and 50/600: over `joint` told of
          the segments, and that there are no leads; over `ohm`.
leads     conductances, no forces: 100/200 ohm a segment, leads of so many ohm at every line; random
          touches, and fingertips. within_4: of pressed cells. wrong: frames with a cell off by
          half, by 10 uS and by 4 deviations, though they converged. told, far: the median of the
          error or its 90th percentile, whichever is worse, over that without leads.
          leads_by_far_ends: how far the mean lead is off, at worst, after random touches.
"""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from bars import ALL, Bar, Part, at_least, at_most, finish, options  # beside this file
from network import SkinCircuit  # tests/helpers
from ohmskin.estimate.knowledge import NO_WIRES, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import load_calibration
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, MODES
from pressed_skin import LAWS, Plan, PressedSkin, calibrate, codes_of  # tests/helpers
from studies.judge import Judged, Verdict, answers_of, judge, pooled, verdict
from studies.rows import Progress, in_processes
from studies.trials import NOMINAL_WIRE_OHM, finger_trial, random_trial

FIVE = ((20.0, 40.0), (50.0, 100.0), (200.0, 400.0), (500.0, 1000.0), (50.0, 600.0))
LONG, LONGEST = (2000.0, 4000.0), (10000.0, 10000.0)  # these have bars of their own
PAIRS = (*FIVE, LONG, LONGEST)
METHODS = ("joint", "touch")
SEED = 9000  # of the first skin
BENDS = (0.75, 1.35)  # wires over those at the calibration
LEADS = "leads"  # the group of conductances
SPARSE = (5, 3, 2, 1)  # presses of every cell
KINDS, READOUTS = ("random", "fingers"), ("near", "told", "far")
LEADS_OHM = (100, 300, 1000, 3000)
Numbers = dict[str, float | None]  # figures by name; None: infinite, since calibrations are refused
PRESSED_SIEMENS = 5e-6  # rise of a cell that counts as pressed, where conductances are measured
REST_FRAMES = 90  # of the untouched skin, where conductances are measured
# RMSE of `joint` and of `touch` told [N], by pair and law, before calibrations learned wires: by
# the estimators of commit 0710d63, on the recordings of this file. That `calibrate` refused some of
# them, so it was allowed to align them at a correlation of 0.2 in place of 0.6.
BEFORE_N: dict[tuple[tuple[float, float], str], tuple[float, float]] = {
    ((20.0, 40.0), "studies"): (0.185, 0.207),
    ((20.0, 40.0), "series"): (0.160, 0.160),
    ((50.0, 100.0), "studies"): (0.187, 0.230),
    ((50.0, 100.0), "series"): (0.210, 0.180),
    ((200.0, 400.0), "studies"): (0.431, 0.252),
    ((200.0, 400.0), "series"): (0.306, 0.211),
    ((500.0, 1000.0), "studies"): (0.544, 0.603),
    ((500.0, 1000.0), "series"): (0.618, 0.547),
    ((50.0, 600.0), "studies"): (0.271, 0.349),
    ((50.0, 600.0), "series"): (0.362, 0.264),
}


# ----------------------------------------------------------------------------- pressed skins


class Way(NamedTuple):
    """A method, and what ``calibrate`` is told.

    factor: the wires told over the true ones; None: nothing is told. leads: are told with them.
    """

    method: str
    factor: float | None = None
    leads: bool = True

    def __str__(self) -> str:
        told = "" if self.factor is None else f" told {self.factor:g}"
        return self.method + told + ("" if self.leads else ", no leads")


OHM, TOLD, NO_LEADS = Way("ohm"), Way("joint", 1.0), Way("joint", 1.0, leads=False)
COMPARED = (OHM, TOLD, *map(Way, METHODS))
# Told wrongly: twice the wires, or half of them.
WRONG = dict(zip(LAWS, (2.0, 0.5), strict=True))


class Read(NamedTuple):
    """What one way shows of a skin.

    rmse_n: as calibrated, then bent. within, wrong: [%]. said: by ``calibrate``. found: the wires
    that it keeps.
    """

    rmse_n: tuple[float, ...]
    within: float
    wrong: float
    said: str
    found: WireOhm


class Task(NamedTuple):
    """A skin, the group of figures it is of, the ways in which it is read, how it bends."""

    group: str
    plan: Plan
    ways: tuple[Way, ...] = COMPARED
    bends: tuple[float, ...] = ()


class Shown(NamedTuple):
    """What all ways show of a skin. true_ohm: its mean segments, top and bottom."""

    task: Task
    by: dict[Way, Read]
    true_ohm: tuple[float, float]


def show(task: Task) -> Shown:
    """Press, calibrate and touch a skin. A way whose calibration is refused is infinitely off."""
    plan, pressed, by = task.plan, PressedSkin(task.plan), {}
    with tempfile.TemporaryDirectory() as place, threadpool_limits(limits=1):
        recording, file = Path(place, "presses.mcap"), Path(place, "skin.json")
        pressed.record(recording)
        for way in task.ways:
            told = NO_WIRES
            if way.factor is not None:
                top, bottom = plan.wire_ohm
                lead_ohm = plan.lead_ohm if way.leads else None
                told = WireOhm(way.factor * top, way.factor * bottom, lead_ohm)
            try:
                said = calibrate(recording, file, way.method, told)
            except ValueError as refusal:
                never = (np.inf,) * (1 + len(task.bends))
                by[way] = Read(never, 0.0, 100.0, str(refusal), NO_WIRES)
                continue
            flat, *bent = (pressed.read(file, factor) for factor in (1.0, *task.bends))
            rmse_n = tuple(forces.rmse_n() for forces in (flat, *bent))
            found = load_calibration(file).nominal_wire_ohm
            by[way] = Read(rmse_n, flat.within_percent(), flat.wrong_percent(), said, found)
    rest = pressed.rest
    shown = Shown(task, by, (float(rest.top_wire_ohm.mean()), float(rest.bottom_wire_ohm.mean())))
    print_skin(shown)
    return shown


def tasks_of(group: str, part: Part, seed: int) -> list[Task]:
    """All skins of a group of figures."""
    size = (8, 8) if part is ALL else (2, 2)
    pairs = PAIRS if group == "force" else FIVE
    plans = [
        Plan(pair, law, seed, shape=size, touches=part.of(100))
        for pair, law in product(pairs[: part.of(len(pairs))], LAWS)
    ]
    match group:
        case "force":
            ways = (*COMPARED, Way("touch", 1.0), NO_LEADS)
            return [Task(group, plan, ways, BENDS) for plan in plans]
        case "wrong":
            wrong = {law: tuple(Way(method, WRONG[law]) for method in METHODS) for law in LAWS}
            return [Task(group, plan, (TOLD, *wrong[plan.law])) for plan in plans]
        case "wires":
            random = np.random.default_rng(seed)
            ohm = np.exp(random.uniform(np.log(20), np.log(2000), (part.of(20), 2))).tolist()
            return [
                Task(
                    group,
                    Plan((top, bottom), list(LAWS)[number % 2], seed + number, size, touches=1),
                    (Way("joint"),),
                )
                for number, (top, bottom) in enumerate(ohm)
            ]
        case "small":
            return [Task(group, replace(plan, shape=(n, n))) for n in (2, 3) for plan in plans]
        case "few":
            return [Task(group, replace(plan, presses_of=12)) for plan in plans]
        case "sparse":
            ways, usual = (OHM, Way("joint")), (FIVE[1], FIVE[3])
            return [
                Task(group, replace(plan, presses=presses), ways)
                for presses in SPARSE[: part.of(len(SPARSE))]
                for plan in plans
                if plan.wire_ohm in usual or part is not ALL
            ]
        case "newtons":
            behind = [replace(plan, wire_ohm=NOMINAL_WIRE_OHM, lead_ohm=600.0) for plan in plans]
            return [
                Task(group, replace(plan, seed=seed + number))
                for number in range(part.of(2))
                for plan in behind[: len(LAWS)]
            ]
        case "odd":
            usual = FIVE[1], FIVE[4]
            return [
                Task(group, replace(plan, seed=seed + number, odd_lead_ohm=2000.0))
                for number, plan in enumerate(plans)
                if plan.wire_ohm in usual or part is not ALL
            ]
    raise KeyError(group)


# Of one skin: what it gives to a figure.
Of = Callable[[Shown], Iterable[float]]


class Figure(NamedTuple):
    """One figure of a group: what `how` makes of all that the skins of the group give to it."""

    group: str
    name: str
    of: Of
    how: Callable[[list[float]], Any]
    bar: Callable[[str, float], Bar] | None = None
    limit: float = 0.0


def over(
    method: str,
    base: Way = TOLD,
    pairs: Collection[tuple[float, float]] = (),
    *,
    rows: int = 0,
    bent: bool = False,
) -> Of:
    """RMSE of a method, told nothing or wrongly, over that of another way.

    pairs, rows: of skins of these wires, and of so many rows; else of all.
    """

    def of(shown: Shown) -> Iterator[float]:
        plan = shown.task.plan
        if (not pairs or plan.wire_ohm in pairs) and rows in (0, plan.shape[0]):
            way = next(way for way in shown.by if way.method == method and way.factor != 1.0)
            both = zip(shown.by[way].rmse_n, shown.by[base].rmse_n, strict=True)
            shares = [np.inf if np.isinf(other) else one / other for one, other in both]
            yield from shares[1:] if bent else shares[:1]

    return of


def over_before(way: Way) -> Of:
    def of(shown: Shown) -> Iterator[float]:
        plan = shown.task.plan
        before_n = BEFORE_N.get((plan.wire_ohm, plan.law))
        if before_n is not None and plan.seed == SEED:
            yield shown.by[way].rmse_n[0] / before_n[METHODS.index(way.method)]

    return of


def near(shown: Shown) -> Iterator[float]:
    """Whether the wires that were found are those of the skin, of each layer [%]."""
    for ohm, true in zip(shown.by[Way("joint")].found.both or (0, 0), shown.true_ohm, strict=True):
        yield 100.0 * (abs(ohm - true) <= max(30.0, 0.12 * true))


def stated(shown: Shown) -> Iterator[float]:
    """Whether they are within two of their deviations [%]."""
    found = shown.by[Way("joint")].found
    stds = found.top_log_std or 0.0, found.bottom_log_std or 0.0
    for ohm, std, true in zip(found.both or (1, 1), stds, shown.true_ohm, strict=True):
        yield 100.0 * (abs(np.log(ohm / true)) <= 2 * std)


def figures_of(method: str) -> list[Figure]:
    """All figures of a method on pressed skins, with their bars."""
    untold, before, ratio = Way(method), over_before(Way(method, 1.0)), partial(over, method)
    rows: list[tuple[Any, ...]] = [
        ("force", "over_told_worst", ratio(TOLD, FIVE), np.max, at_most, 1.1),
        ("force", "over_told_median", ratio(TOLD, FIVE), np.median, at_most, 1.04),
        ("force", "over_told_2000", ratio(TOLD, [LONG]), np.max, at_most, 1.3),
        ("force", "over_told_10000", ratio(TOLD, [LONGEST]), np.max, at_most, 1.6),
        ("force", "over_ohm_worst", ratio(OHM, [*FIVE, LONGEST]), np.max, at_most, 0.92),
        ("force", "over_ohm_2000", ratio(OHM, [LONG]), np.max, at_most, 1.05),
        ("force", "told_over_before", before, np.median, at_most, 1.03),
        ("force", "told_over_before_worst", before, np.max),
        ("force", "bent_worst", ratio(TOLD, FIVE, bent=True), np.max, at_most, 1.1),
        ("force", "bent_median", ratio(TOLD, FIVE, bent=True), np.median),
        ("force", "within_4", lambda one: [one.by[untold].within], np.mean, at_least, 97),
        ("force", "wrong", lambda one: [one.by[untold].wrong], np.mean, at_most, 0.5),
        ("wrong", "wrong_worst", ratio(), np.max, at_most, 1.1),
        ("wrong", "wrong_median", ratio(), np.median),
        ("small", "2x2_worst", ratio(rows=2), np.max),
        ("small", "2x2_median", ratio(rows=2), np.median, at_most, 1.15),
        ("small", "3x3_worst", ratio(rows=3), np.max, at_most, 1.3),
        ("small", "3x3_median", ratio(rows=3), np.median, at_most, 1.15),
        ("few", "few_worst", ratio(), np.max, at_most, 1.3),
        ("few", "few_median", ratio(), np.median, at_most, 1.05),
        ("few", "few_over_ohm", ratio(OHM), np.max, at_most, 1.05),
        ("newtons", "leads_over_ohm", ratio(OHM), np.max, at_most, 0.92),
        ("odd", "odd_over_told", ratio(), np.max, at_most, 1.1),
        ("odd", "odd_over_ohm", ratio(OHM), np.max, at_most, 0.92),
    ]
    return [Figure(group, f"{method}_{name}", *more) for group, name, *more in rows]


def disagrees(shown: Shown) -> Iterator[float]:
    """Whether calibrations that were told wrongly said so [%]."""
    yield from (100.0 * ("disagree" in one.said) for way, one in shown.by.items() if way != TOLD)


def rmse_n(presses: int) -> Of:
    """RMSE of `joint` untold, of skins each of whose cells was pressed so often [N]."""

    def of(shown: Shown) -> Iterator[float]:
        if shown.task.plan.presses == presses:
            yield shown.by[Way("joint")].rmse_n[0]

    return of


FIGURES = [
    *(figure for method in METHODS for figure in figures_of(method)),
    Figure(
        *("force", "no_leads_told_over_before", over_before(NO_LEADS), np.median, at_most, 1.03)
    ),
    Figure("force", "no_leads_told_over_before_worst", over_before(NO_LEADS), np.max),
    Figure("wrong", "wrong_said", disagrees, np.mean, at_least, 100),
    *(Figure("sparse", f"joint_{n}_presses_n", rmse_n(n), np.mean) for n in SPARSE),
    Figure("wires", "wires_near", near, np.mean, at_least, 90),
    Figure("wires", "wires_within_2", stated, np.mean, at_least, 90),
]


def print_skin(shown: Shown) -> None:
    """RMSE of all ways, as calibrated and bent, and the wires that `joint` untold keeps."""
    task, plan = shown.task, shown.task.plan
    ways = [
        f"{way} " + " ".join(f"{rmse_n:.3f}" for rmse_n in one.rmse_n)
        for way, one in shown.by.items()
    ]
    found = shown.by.get(Way("joint"), next(iter(shown.by.values()))).found
    kept = " ".join(f"{number:.3g}" for number in found if number is not None)
    size, wires = "x".join(map(str, plan.shape)), "/".join(f"{ohm:.0f}" for ohm in plan.wire_ohm)
    print(f"{task.group} {size} {wires} {plan.law}: {', '.join(ways)}; keeps {kept}", flush=True)


# ------------------------------------------------------------------------------------------- leads


class Scene(NamedTuple):
    """Conductances behind leads: a kind of touches, read by a method in one of `READOUTS`."""

    seed: int
    frames: int
    kind: str
    method: str
    readout: str
    lead_ohm: float


class Behind(NamedTuple):
    """What a scene shows: answers against the truth, which frames mislead, the mean lead found."""

    judged: Judged
    misleads: list[bool]
    lead_share: float


def read_behind(scene: Scene) -> tuple[Scene, Behind]:
    """Estimate a scene's frames. lead_share: of the true mean lead."""
    random, size = np.random.default_rng(scene.seed), (8, 8)
    if scene.kind == "random":
        trial = random_trial(*size, 8, scene.frames, scene.seed)
    else:
        trial = finger_trial(
            *(*size, scene.frames, scene.seed),
            sigma_cells=(0.6, 1.0),
            peak_siemens=(3e-5, 3e-4),
        )
    rest = replace(trial.rest, lead_ohm=np.array(scene.lead_ohm))
    cells = np.concatenate([[rest.cell_siemens] * REST_FRAMES, trial.cell_siemens])
    mode = "far" if scene.readout == "far" else "near"
    ratio = ratio_from_codes(codes_of(SkinCircuit(rest), cells, mode, random))
    known = SkinKnowledge(
        *size,
        adc_bits=ADC_BITS,
        rest_ratio=ratio[:REST_FRAMES].mean(axis=0),
        nominal_wire_ohm=WireOhm(lead=scene.lead_ohm if scene.readout == "told" else None),
        reading_names=MODES[mode],
    )
    with threadpool_limits(limits=1):
        estimator = make_estimator(scene.method, known)
        found = [estimator.estimate(frame) for frame in ratio[REST_FRAMES:]]
    misleads = [
        verdict(one, true, close_share=0.5, close_siemens=1e-5) is Verdict.WRONG_UNFLAGGED
        for one, true in zip(found, trial.cell_siemens, strict=True)
    ]
    lead_share = (estimator.wires().lead or 0.0) / max(scene.lead_ohm, 1.0)
    pressed = trial.cell_siemens > rest.cell_siemens + PRESSED_SIEMENS
    judged = judge(answers_of(found), trial.cell_siemens, rest.cell_siemens, pressed)
    return scene, Behind(judged, misleads, lead_share)


def of_leads(part: Part, seed: int, jobs: int, progress: Progress) -> tuple[Numbers, list[Bar]]:
    """All figures of conductances behind leads, and their bars."""
    conditions = list(product(KINDS, METHODS, READOUTS))
    leads_ohm = LEADS_OHM[: part.of(len(LEADS_OHM))]
    scenes = [
        Scene(seed + number, part.of(80), *condition, lead_ohm)
        for number, condition, lead_ohm in product(range(part.of(4)), conditions, (0, *leads_ohm))
    ]
    found: defaultdict[tuple[object, ...], list[Behind]] = defaultdict(list)
    for scene, one in in_processes(read_behind, scenes, jobs, progress):
        found[scene[2:]].append(one)
    judged = {key: pooled(one.judged for one in parts) for key, parts in found.items()}
    error = {key: 100 * np.quantile(one.relative, (0.5, 0.9)) for key, one in judged.items()}
    figures: Numbers = {}
    bars, far_off = [], []
    for condition in conditions:
        kind, method, readout = condition
        for lead_ohm in leads_ohm if readout == "near" else ():
            key, name = (*condition, lead_ohm), f"{kind}_{method}_{lead_ohm}"
            wrong = 100 * float(np.mean([one.misleads for one in found[key]]))
            within = judged[key].pressed_within_percent()
            figures |= {f"{name}_median": error[key][0], f"{name}_p90": error[key][1]}
            figures |= {f"{name}_within_4": within, f"{name}_wrong": wrong}
            least, most = (90, 10) if lead_ohm == LEADS_OHM[-1] else (95, 1)
            bars += [at_least(f"{name}_within_4", least), at_most(f"{name}_wrong", most)]
        if readout != "near":
            shares = [error[*condition, lead_ohm] / error[*condition, 0] for lead_ohm in leads_ohm]
            figures[f"{kind}_{method}_{readout}_over_none"] = np.max(shares)
            bars.append(at_most(f"{kind}_{method}_{readout}_over_none", 1.5))
        if (kind, readout) == ("random", "far"):
            parts = chain.from_iterable(found[*condition, lead_ohm] for lead_ohm in leads_ohm)
            far_off += [100 * abs(one.lead_share - 1) for one in parts]
    figures["leads_by_far_ends_percent"] = max(far_off)
    bars.append(at_most("leads_by_far_ends_percent", 10))
    return {name: round(float(number or 0.0), 2) for name, number in figures.items()}, bars


# -------------------------------------------------------------------------------------------- main


def measure(part: Part, groups: list[str], seed: int, jobs: int) -> tuple[Numbers, list[Bar]]:
    """All figures of these groups, and their bars."""

    def progress(done: int, of: int) -> None:
        print(f"\r{done} of {of} ", end="" if done < of else "\n", file=sys.stderr, flush=True)

    tasks = [task for group in groups if group != LEADS for task in tasks_of(group, part, seed)]
    shown = in_processes(show, tasks, jobs, progress)
    figures: Numbers = {}
    bars = []
    for figure in (figure for figure in FIGURES if figure.group in groups):
        of_skins = (figure.of(one) for one in shown if one.task.group == figure.group)
        values = list(chain.from_iterable(of_skins))
        if values:
            value = float(figure.how(values))
            figures[figure.name] = round(value, 3) if np.isfinite(value) else None
            if figure.bar is not None:
                bars.append(figure.bar(figure.name, figure.limit))
    if LEADS in groups:
        of_conductances, more = of_leads(part, seed, jobs, progress)
        figures, bars = figures | of_conductances, bars + more
    return figures, bars


def main() -> int:
    groups = [*dict.fromkeys(figure.group for figure in FIGURES), LEADS]
    parser = options(__doc__)
    parser.add_argument("--only", default=",".join(groups), help=f"of {', '.join(groups)}")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first skin")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one a core")
    asked = parser.parse_args()
    figures, bars = measure(asked.part, asked.only.split(","), asked.seed, asked.jobs)
    return finish(asked.part, figures, bars)


if __name__ == "__main__":
    sys.exit(main())
