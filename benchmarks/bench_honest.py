# SPDX-License-Identifier: Apache-2.0
"""Measure whether an answer says so where a skin is not as its model supposes.

    make bench-honest

Everything is simulated: skins of 8x8 by a node Laplacian (tests/helpers/network.py), 10 bits, noise
of 0.3 LSB, rest readings and nothing else told; every other skin has leads of 100 ohm, the others
none. `random`: up to 8 touches, anew in each frame. `fingers`: one or two fingertips that move.
wrong: frames with a cell off by half, by 10 uS and by 4 deviations, though they converged.
within_4: pressed cells within 4 stated deviations, or in a frame that is flagged. --only takes some
of these groups:

far     readings at far ends. Faults: all far rows, or all far columns, at a constant (rows,
        columns); reading their near ends (rows_near, columns_near); one far line at a constant, or
        reading its near end (line, line_near); from the start, rest readings included, or in the
        middle of a run. named: scenes in which a message names it within a second.
        references: 5 % apart, either way; flagged: of these frames.
        channel: 1 LSB of offset, up or down, of the far rows' channel.
        10000, 20000, 41000: ohm a segment; right_but_flagged: frames without a wrong cell.
        healthy: 100 and 200 ohm a segment.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from bars import Bar, Figures, Part, at_least, at_most, finish, options  # beside this file
from network import SkinCircuit  # tests/helpers
from ohmskin.arrays import Bool, Float
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES
from studies.judge import STATED_STDS, Verdict, verdict
from studies.rows import Progress, in_processes
from studies.trials import NOMINAL_WIRE_OHM, finger_trial, random_trial

SEED = 24000  # of the first skin
SKINS, FRAMES = 4, 60  # of each condition
REST_FRAMES = 90  # whose mean is the rest readings
SHAPE = (8, 8)
NOISE_LSB = 0.3
LEAD_OHM = 100.0
METHODS, KINDS = ("joint", "touch"), ("random", "fingers")
PRESSED_SIEMENS = 5e-6  # rise of a cell that counts as pressed
CLOSE_SHARE, CLOSE_SIEMENS = 0.5, 1e-5  # what is off by more of both is wrong
LSB = 2.0**-ADC_BITS
# Far ends at fault: where a cell's readings in mode far have them, and which lines.
FAULTS = ("rows", "columns", "rows_near", "columns_near", "line", "line_near")
WHEN = ("start", "middle")
LONG_OHM = (10_000, 20_000, 41_000)
CONSTANTS = (0.0, 0.3, 0.5, 0.8, 1.0)  # over Vdd: one of these for each skin
LINE = 3  # the one far line that is off


class Scene(NamedTuple):
    """A skin, touched in one way, read by a method; name: of the figures it belongs to."""

    name: str
    seed: int
    kind: str
    method: str
    frames: int
    fault: str = ""
    when: str = ""
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM
    channel_lsb: float = 0.0
    references_apart: float = 0.0


class Shown(NamedTuple):
    """What the frames of a scene that count show, (F,), and pressed cells within 4, or flagged."""

    wrong: Bool
    off: Bool
    flagged: Bool
    named: bool
    within: Bool


def broken(ratio: Float, fault: str, number: int) -> Float:
    """These readings of mode far, (..., R, C, 4), with a fault of their far ends."""
    ratio, names = ratio.copy(), list(MODES["far"])
    near, far = ("b", "f") if fault.startswith("columns") else ("a", "e")
    lines = slice(LINE, LINE + 1) if fault.startswith("line") else slice(None)
    instead: Float | float = CONSTANTS[number % len(CONSTANTS)]
    if fault.endswith("near"):
        instead = ratio[..., lines, :, names.index(near)]
    ratio[..., lines, :, names.index(far)] = instead
    return ratio


def read_scene(scene: Scene) -> tuple[Scene, Shown]:
    """Estimate all frames of a scene, and judge those with its fault."""
    number, random = scene.seed - SEED, np.random.default_rng(scene.seed)
    before = scene.frames // 2 if scene.when == "middle" else 0
    frames, seed = scene.frames + before, scene.seed
    if scene.kind == "random":
        trial = random_trial(*SHAPE, 8, frames, seed, wire_ohm=scene.wire_ohm)
    else:
        trial = finger_trial(
            *(*SHAPE, frames, seed),
            sigma_cells=(0.6, 1.0),
            peak_siemens=(3e-5, 3e-4),
            wire_ohm=scene.wire_ohm,
        )
    sign = 1 - number // 2 % 2 * 2
    apart = 0.5 * sign * scene.references_apart
    rest = replace(
        trial.rest,
        lead_ohm=np.array(LEAD_OHM * (number % 2)),
        ref_top_ohm=(1 + apart) * trial.rest.ref_top_ohm,
        ref_bottom_ohm=(1 - apart) * trial.rest.ref_bottom_ohm,
    )
    circuit, cells = SkinCircuit(rest), trial.cell_siemens
    names = [ENUMS["reading"].values[name] for name in MODES["far"]]
    # Rest readings, frames before the fault, and frames with it.
    exact = np.array([circuit.readings(one)[..., names] for one in (rest.cell_siemens, *cells)])
    exact = np.concatenate([np.repeat(exact[:1], REST_FRAMES, axis=0), exact[1:]])
    exact[..., MODES["far"].index("e")] += sign * scene.channel_lsb * LSB
    if scene.fault:
        faulty = REST_FRAMES + before if before else 0
        exact[faulty:] = broken(exact[faulty:], scene.fault, number)
    exact += NOISE_LSB * LSB * random.standard_normal(exact.shape)
    ratio = ratio_from_codes(quantise(exact))
    known = SkinKnowledge(
        *SHAPE,
        adc_bits=ADC_BITS,
        rest_ratio=ratio[:REST_FRAMES].mean(axis=0),
        reading_names=MODES["far"],
    )
    with threadpool_limits(limits=1):
        estimator = make_estimator(scene.method, known)
        found = [estimator.estimate(frame) for frame in ratio[REST_FRAMES:]][before:]
    return scene, shown(scene, found, cells[before:], rest.cell_siemens)


def shown(scene: Scene, found: list[Estimate], cells: Float, rest_siemens: Float) -> Shown:
    """Judge these frames of a scene by its cells (F, R, C) [S]."""
    flagged = np.array([not one.converged for one in found])
    siemens, stds = (
        np.array([getattr(one, name) for one in found])
        for name in ("cell_siemens", "cell_siemens_std")
    )
    off_siemens = np.abs(siemens - cells)
    off = (off_siemens > np.maximum(CLOSE_SHARE * cells, CLOSE_SIEMENS)).any(axis=(1, 2))
    wrong = [
        verdict(one, true, close_share=CLOSE_SHARE, close_siemens=CLOSE_SIEMENS)
        is Verdict.WRONG_UNFLAGGED
        for one, true in zip(found, cells, strict=True)
    ]
    pressed = cells > rest_siemens + PRESSED_SIEMENS
    within = (off_siemens <= STATED_STDS * stds) | flagged[:, None, None]
    name = f"far row {LINE}" if "line" in scene.fault else f"far {scene.fault.split('_')[0]}"
    named = any(name in one.message for one in found)
    return Shown(np.array(wrong), np.asarray(off), flagged, named, within[pressed])


def of_far(part: Part, seed: int, jobs: int, progress: Progress) -> tuple[Figures, list[Bar]]:
    """All figures of far ends, and their bars."""
    skins = [
        Scene("", seed + number, kind, method, part.of(FRAMES))
        for kind, method in product(KINDS, METHODS)
        for number in range(part.of(SKINS))
    ]
    scenes = [
        one._replace(name=f"{fault}_{when}", fault=fault, when=when)
        for fault, when, one in product(FAULTS, WHEN, skins)
    ]
    for skin in skins:
        scenes += [skin._replace(name=str(ohm), wire_ohm=(ohm, ohm)) for ohm in LONG_OHM]
        scenes.append(skin._replace(name="references", references_apart=0.05))
        scenes += [skin._replace(name="channel", channel_lsb=1.0), skin._replace(name="healthy")]
    found: defaultdict[tuple[str, str, str], list[Shown]] = defaultdict(list)
    for scene, one in in_processes(read_scene, scenes, jobs, progress):
        found[scene.name, scene.kind, scene.method].append(one)
    figures: dict[str, float | None] = {}
    bars = []
    worst = dict(zip(map(str, LONG_OHM), (1, 2, 5), strict=True))
    for (name, kind, method), parts in found.items():
        wrong, off, flagged, within = (
            np.concatenate([getattr(one, of) for one in parts])
            for of in ("wrong", "off", "flagged", "within")
        )
        key = f"{name}_{kind}_{method}"
        figures[f"{key}_wrong"] = 100 * float(wrong.mean())
        bars.append(at_most(f"{key}_wrong", worst.get(name, 1)))
        figures[f"{key}_within_4"] = 100 * float(within.mean())
        if name.startswith(FAULTS):
            figures[f"{key}_named"] = 100 * float(np.mean([one.named for one in parts]))
            bars += [at_least(f"{key}_named", 100), at_least(f"{key}_within_4", 95)]
        elif name == "channel":
            bars.append(at_least(f"{key}_within_4", 95))
        if name in worst:
            figures[f"{key}_right_but_flagged"] = 100 * float((flagged & ~off).mean())
            if kind == "fingers" and name != str(LONG_OHM[-1]):
                bars.append(at_most(f"{key}_right_but_flagged", 10))
        elif not name.startswith(FAULTS):
            figures[f"{key}_flagged"] = 100 * float(flagged.mean())
            if name != "channel":
                bars.append(at_most(f"{key}_flagged", 1))
    return {name: round(float(number or 0.0), 2) for name, number in figures.items()}, bars


# Figures of each group, and their bars.
GROUPS = {"far": of_far}


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--only", default=",".join(GROUPS), help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first skin")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one a core")
    asked = parser.parse_args()

    def progress(done: int, of: int) -> None:
        print(f"\r{done} of {of} ", end="" if done < of else "\n", file=sys.stderr, flush=True)

    figures: dict[str, float | None] = {}
    bars: list[Bar] = []
    for group in asked.only.split(","):
        of_group, more = GROUPS[group](asked.part, asked.seed, asked.jobs, progress)
        figures, bars = figures | dict(of_group), bars + more
    return finish(asked.part, figures, bars)


if __name__ == "__main__":
    sys.exit(main())
