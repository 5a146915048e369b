# SPDX-License-Identifier: Apache-2.0
"""Measure whether an answer says so where a skin is not as its model supposes.

    make bench-honest

Everything is simulated: skins of 8x8 by a node Laplacian (tests/helpers/network.py), 10 bits, noise
of 0.3 LSB, rest readings and nothing else told; every other skin has leads of 100 ohm, the others
none. Mode near, unless said otherwise. `random`: up to 8 touches, anew in each frame. `fingers`:
one or two fingertips that move.
wrong: frames with a cell off by half, by 10 uS and by 4 deviations, though they converged.
within_4: pressed cells within 4 stated deviations, or in a frame that is flagged. --only takes some
of these groups:

far     mode far. Faults: all far rows, or all far columns, at a constant (rows,
        columns); reading their near ends (rows_near, columns_near); one far line at a constant, or
        reading its near end (line, line_near); from the start, rest readings included, or in the
        middle of a run. named: scenes in which a message names it within a second.
        references: 5 % apart, either way; flagged: of these frames.
        channel: 1 LSB of offset, up or down, of the far rows' channel.
        10000, 20000, 41000: ohm a segment; right_but_flagged: frames without a wrong cell.
        healthy: 100 and 200 ohm a segment.
references  of each mode: both off by 5 %, of which estimators are told 1 % or 5 % as a deviation
        (told_1%, told_5%); 5 % apart, told 1 % (apart).
damp    of each mode: neighbouring stripes leak into each other by so many ohm at every crossing.
palms   a palm over 60 % of the skin, with peaks of about 250 uS (firm); cells of 200 and 30 kOhm at
        rest (rest_200000, rest_30000). error, p90: of pressed cells, median and 90th percentile.
large   sound skins of 16x16 cells, of modes near and far; palms, too.
objects an edge, a ring, something flat on half of the skin or on all of it, of sizes 8x8 and 16x16,
        of modes near and far.
damages a segment of ten times its resistance (segment), 20 ohm between two rows (short). named:
        scenes in which a message names these rows. misnamed: scenes in which one names others.
untold  wires of 150, 500, 1000 and 2000 ohm a segment.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from bars import Bar, Part, at_least, at_most, finish, options  # beside this file
from network import SkinCircuit, leaks  # tests/helpers
from ohmskin.arrays import Bool, Float
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.scenes import REST_OHM
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES
from studies.judge import STATED_STDS, Verdict, verdict
from studies.rows import Progress, in_processes
from studies.trials import (
    NOMINAL_WIRE_OHM,
    OBJECTS,
    finger_trial,
    object_trial,
    palm_trial,
    random_trial,
)
from studies.unmodelled import lost

SEED = 24000  # of the first skin
SKINS, FRAMES = 4, 60  # of each condition
REST_FRAMES = 90  # whose mean is the rest readings
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
SEGMENT_TIMES, SHORT_OHM = 10.0, 20.0  # a damaged yarn; two neighbouring rows that touch
UNTOLD_OHM = (500, 1000)
LEAKS_OHM = (3_000_000, 1_000_000, 300_000)


class Scene(NamedTuple):
    """A skin, touched in one way, read by a method; name: of the figures it belongs to.

    fault: of `FAULTS`, "segment" or "short". references: shares by which both are off.
    """

    name: str
    seed: int
    kind: str
    method: str
    frames: int
    mode: str = "far"
    fault: str = ""
    when: str = ""
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM
    channel_lsb: float = 0.0
    references: tuple[float, float] = (0.0, 0.0)
    ref_log_std: float = 0.0
    leak_ohm: float = 0.0
    rest_ohm: float = REST_OHM
    shape: tuple[int, int] = (8, 8)


class Shown(NamedTuple):
    """What the frames of a scene that count show, (F,), and of their pressed cells, (n,), whether
    they are within 4, or flagged, and the error over the truth.
    """

    wrong: Bool
    off: Bool
    flagged: Bool
    named: bool
    misnamed: bool
    within: Bool
    error: Float


def broken(ratio: Float, fault: str, number: int) -> Float:
    """These readings of mode far, (..., R, C, 4), with a fault of their far ends."""
    how = "near" if fault.endswith("near") else "off"
    lines = fault.removesuffix("_near").replace("line", "one row")
    return lost(ratio, f"{lines} {how}", CONSTANTS[number % len(CONSTANTS)], LINE)


def trial_of_scene(scene: Scene, frames: int) -> tuple[Skin, Float]:
    """The untouched skin, and the cells of all frames, (F, R, C) [S]."""
    if scene.kind == "random":
        trial = random_trial(*scene.shape, 8, frames, scene.seed, wire_ohm=scene.wire_ohm)
    elif scene.kind in OBJECTS:
        trial = object_trial(*scene.shape, frames, scene.seed, scene.kind)
    elif scene.kind == "palms":
        trial = palm_trial(*scene.shape, frames, scene.seed)
    else:
        trial = finger_trial(
            *(*scene.shape, frames, scene.seed),
            sigma_cells=(0.6, 1.0),
            peak_siemens=(3e-5, 3e-4),
            wire_ohm=scene.wire_ohm,
        )
    cells = trial.rest.cell_siemens
    at_rest = cells * REST_OHM / scene.rest_ohm
    top, bottom = (1 + off for off in scene.references)
    rest = replace(
        trial.rest,
        cell_siemens=at_rest,
        lead_ohm=np.array(LEAD_OHM * (scene.seed % 2)),
        ref_top_ohm=top * trial.rest.ref_top_ohm,
        ref_bottom_ohm=bottom * trial.rest.ref_bottom_ohm,
    )
    return rest, at_rest + trial.cell_siemens - cells


def circuits(scene: Scene, rest: Skin) -> tuple[SkinCircuit, SkinCircuit]:
    """The circuit of the rest readings, and that of frames."""
    more = leaks(scene.shape, scene.leak_ohm) if scene.leak_ohm else None
    row, column = np.divmod(scene.seed * 7 % rest.cell_siemens.size, scene.shape[1])
    if scene.fault == "segment":
        top_ohm = rest.top_wire_ohm.copy()
        top_ohm[row, column] *= SEGMENT_TIMES
        rest = replace(rest, top_wire_ohm=top_ohm)
    sound = SkinCircuit(rest, more)
    if scene.fault != "short":
        return sound, sound
    first = row % (scene.shape[0] - 1)  # electrodes are the first nodes
    return sound, SkinCircuit(rest, (np.array([[first], [first + 1]]), np.array([SHORT_OHM])))


def read_scene(scene: Scene) -> tuple[Scene, Shown]:
    """Estimate all frames of a scene, and judge those with its fault."""
    number, random = scene.seed - SEED, np.random.default_rng(scene.seed)
    before = scene.frames // 2 if scene.when == "middle" else 0
    rest, cells = trial_of_scene(scene, scene.frames + before)
    at_rest, in_frames = circuits(scene, rest)
    names = [ENUMS["reading"].values[name] for name in MODES[scene.mode]]
    # Rest readings, frames before the fault, and frames with it.
    of_rest = np.repeat([at_rest.readings(rest.cell_siemens)], REST_FRAMES, axis=0)
    of_frames = np.array([in_frames.readings(one) for one in cells])
    exact = np.concatenate([of_rest, of_frames])[..., names]
    if scene.mode == "far":
        sign = 1 - number // 2 % 2 * 2
        exact[..., MODES["far"].index("e")] += sign * scene.channel_lsb * LSB
    if scene.fault in FAULTS:
        faulty = REST_FRAMES + before if before else 0
        exact[faulty:] = broken(exact[faulty:], scene.fault, number)
    exact += NOISE_LSB * LSB * random.standard_normal(exact.shape)
    ratio = ratio_from_codes(quantise(exact))
    known = SkinKnowledge(
        *scene.shape,
        adc_bits=ADC_BITS,
        rest_ratio=ratio[:REST_FRAMES].mean(axis=0),
        reading_names=MODES[scene.mode],
        ref_log_std=scene.ref_log_std,
    )
    with threadpool_limits(limits=1):
        estimator = make_estimator(scene.method, known)
        found = [estimator.estimate(frame) for frame in ratio[REST_FRAMES:]][before:]
    return scene, shown(scene, found, cells[before:], rest.cell_siemens)


def damaged_lines(scene: Scene) -> str:
    """How a message names what is wrong in this scene."""
    row = scene.seed * 7 % (scene.shape[0] * scene.shape[1]) // scene.shape[1]
    if scene.fault == "segment":
        return f"row {row}:"
    if scene.fault == "short":
        return f"rows {row % (scene.shape[0] - 1)} and {row % (scene.shape[0] - 1) + 1}"
    return f"far row {LINE}" if "line" in scene.fault else f"far {scene.fault.split('_')[0]}"


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
    named = any(damaged_lines(scene) in one.message for one in found)
    misnamed = any(
        damage in one.message and damaged_lines(scene) not in one.message
        for one in found
        for damage in ("shorted?", "yarn broken?")
    )
    error = (off_siemens / cells)[pressed]
    return Shown(np.array(wrong), np.asarray(off), flagged, named, misnamed, within[pressed], error)


class Pooled(dict[str, float | None]):
    """Figures of all scenes of a name, kind and method, and their bars."""

    def __init__(self, scenes: list[Scene], jobs: int, progress: Progress) -> None:
        super().__init__()
        self.bars: list[Bar] = []
        parts: defaultdict[tuple[str, str, str], list[Shown]] = defaultdict(list)
        for scene, one in in_processes(read_scene, scenes, jobs, progress):
            parts[scene.name, scene.kind, scene.method].append(one)
        for (name, kind, method), shown_of in parts.items():
            wrong, off, flagged, within, error = (
                np.concatenate([getattr(one, of) for one in shown_of])
                for of in ("wrong", "off", "flagged", "within", "error")
            )
            key = f"{name}_{kind}_{method}"
            named = np.mean([one.named for one in shown_of])
            for figure, share in (
                ("wrong", wrong.mean()),
                ("within_4", within.mean()),
                ("flagged", flagged.mean()),
                ("right_but_flagged", (flagged & ~off).mean()),
                ("named", named),
                ("misnamed", np.mean([one.misnamed for one in shown_of])),
                ("error", np.median(error)),
                ("error_p90", np.quantile(error, 0.9)),
            ):
                self[f"{key}_{figure}"] = round(100 * float(share), 2)

    def only(self, *figures: str) -> Pooled:
        """Without figures that are of no interest here."""
        for key in [key for key in self if not key.endswith(figures)]:
            del self[key]
        return self

    def bar(
        self, make: Callable[[str, float], Bar], prefix: str, figure: str, limit: float
    ) -> None:
        """The same bar for this figure of all whose name begins so; KeyError: of none."""
        begins, ends = f"{prefix}_", f"_{figure}"
        keys = [key for key in self if key.startswith(begins) and key.endswith(ends)]
        if not keys:
            raise KeyError(f"no figure {begins}...{ends}")
        self.bars += [make(key, limit) for key in keys]


def skins_of(part: Part, seed: int, kinds: Sequence[str] = KINDS, **more: Any) -> list[Scene]:
    """The skins of each condition, read by both methods."""
    return [
        Scene("", seed + number, kind, method, part.of(FRAMES), **more)
        for kind, method in product(kinds, METHODS)
        for number in range(part.of(SKINS))
    ]


def of_far(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """All figures of far ends, and their bars."""
    skins = skins_of(part, seed)
    scenes = [
        one._replace(name=f"{fault}_{when}", fault=fault, when=when)
        for fault, when, one in product(FAULTS, WHEN, skins)
    ]
    for skin in skins:
        apart = 0.025 * (1 - (skin.seed - SEED) // 2 % 2 * 2)
        scenes += [skin._replace(name=str(ohm), wire_ohm=(ohm, ohm)) for ohm in LONG_OHM]
        scenes.append(skin._replace(name="references", references=(apart, -apart)))
        scenes += [skin._replace(name="channel", channel_lsb=1.0), skin._replace(name="healthy")]
    found = Pooled(scenes, jobs, progress)
    for name in (*FAULTS, "references", "channel", "healthy"):
        found.bar(at_most, name, "wrong", 1)
    for ohm, most in zip(LONG_OHM, (1, 2, 5), strict=True):
        found.bar(at_most, str(ohm), "wrong", most)
    for ohm in LONG_OHM[:-1]:
        found.bar(at_most, f"{ohm}_fingers", "right_but_flagged", 10)
    for fault, when in product(FAULTS, WHEN):
        found.bar(at_least, f"{fault}_{when}", "named", 100)
        found.bar(at_least, f"{fault}_{when}", "within_4", 95)
    found.bar(at_least, "channel", "within_4", 95)
    for name in ("references", "healthy"):
        found.bar(at_most, name, "flagged", 1)
    return found


def of_references(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """References that are not as told: both 5 % off, and 5 % apart."""
    scenes = []
    for mode, skin in product(MODES, skins_of(part, seed)):
        sign = 1 - (skin.seed - SEED) // 2 % 2 * 2
        both = skin._replace(mode=mode, references=(0.05 * sign, 0.05 * sign))
        scenes += [
            both._replace(name=f"{mode}_told_{std:.0%}", ref_log_std=std) for std in (0.01, 0.05)
        ]
        apart = 0.025 * sign, -0.025 * sign
        scenes.append(both._replace(name=f"{mode}_apart", references=apart, ref_log_std=0.01))
    found = Pooled(scenes, jobs, progress).only("wrong", "within_4", "flagged")
    for mode in MODES:
        found.bar(at_least, f"{mode}_told_5%", "within_4", 95)
        found.bar(at_least, f"{mode}_apart", "within_4", 95)
    return found


def of_damp(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """Neighbouring stripes of each layer that leak into each other."""
    scenes = [
        skin._replace(name=f"{mode}_leaks_{ohm}", mode=mode, leak_ohm=ohm)
        for mode, ohm, skin in product(MODES, LEAKS_OHM, skins_of(part, seed))
    ]
    found = Pooled(scenes, jobs, progress).only("wrong", "within_4", "flagged", "error")
    for mode, (ohm, within, wrong) in product(
        MODES, zip(LEAKS_OHM, (95, 90, 80), (1, 1, 10), strict=True)
    ):
        found.bar(at_least, f"{mode}_leaks_{ohm}", "within_4", within)
        found.bar(at_most, f"{mode}_leaks_{ohm}", "wrong", wrong)
    return found


def of_palms(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """Firm palms, and skins that conduct much at rest."""
    scenes = [one._replace(name="firm") for one in skins_of(part, seed, ["palms"], mode="near")]
    scenes += [
        skin._replace(name=f"rest_{ohm}", rest_ohm=ohm)
        for ohm, skin in product((200_000, 30_000), skins_of(part, seed, mode="near"))
    ]
    found = Pooled(scenes, jobs, progress).only("wrong", "within_4", "flagged", "error", "p90")
    found.bar(at_most, "rest_30000", "flagged", 5)
    found.bar(at_most, "firm", "wrong", 1)
    return found


def of_large(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """Sound skins of 16x16, nothing told; palms on 60 % of their cells."""
    scenes = [
        skin._replace(name=f"large_{mode}", mode=mode, shape=(16, 16))
        for mode in ("near", "far")
        for skin in skins_of(part, seed, (*KINDS, "palms"), mode=mode)
    ]
    found = Pooled(scenes, jobs, progress)
    for mode, kind in product(("near", "far"), KINDS):
        found.bar(at_most, f"large_{mode}_{kind}", "wrong", 1)
        found.bar(at_least, f"large_{mode}_{kind}", "within_4", 95)
        found.bar(at_most, f"large_{mode}_{kind}", "right_but_flagged", 5)
    for mode in ("near", "far"):
        found.bar(at_most, f"large_{mode}_palms", "wrong", 1)
        found.bar(at_most, f"large_{mode}_palms", "misnamed", 0)
    return found


def of_objects(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """Sound skins that other things than fingers press, nothing told."""
    scenes = [
        skin._replace(name=f"{mode}_{size}x{size}", mode=mode, shape=(size, size))
        for mode, size in product(("near", "far"), (8, 16))
        for skin in skins_of(part, seed, OBJECTS, mode=mode)
        if skin.method == "joint"
    ]
    found = Pooled(scenes, jobs, progress)
    for mode in ("near", "far"):
        found.bar(at_most, f"{mode}_8x8", "wrong", 1)
        found.bar(at_most, mode, "misnamed", 0)
    return found


def of_damages(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """A segment of ten times its resistance, and a short of 20 ohm between two rows."""
    scenes = [
        skin._replace(name=fault, fault=fault)
        for fault, skin in product(("segment", "short"), skins_of(part, seed, mode="near"))
    ]
    found = Pooled(scenes, jobs, progress).only("wrong", "within_4", "flagged", "named", "misnamed")
    for fault in ("segment", "short"):
        found.bar(at_most, fault, "wrong", 2)
        found.bar(at_most, fault, "misnamed", 0)
    found.bar(at_least, "short", "named", 100)
    return found


def of_untold(part: Part, seed: int, jobs: int, progress: Progress) -> Pooled:
    """Long wires at near ends that nobody told."""
    scenes = [
        skin._replace(name=str(ohm), wire_ohm=(ohm, ohm))
        for ohm, skin in product((150, *UNTOLD_OHM, 2000), skins_of(part, seed, mode="near"))
    ]
    found = Pooled(scenes, jobs, progress).only("wrong", "within_4", "flagged", "error")
    for ohm, wrong in zip(UNTOLD_OHM, (1, 1), strict=True):
        found.bar(at_most, f"{ohm}_fingers", "wrong", wrong)
        found.bar(at_most, f"{ohm}_fingers", "right_but_flagged", 10)
    for ohm, wrong in zip(UNTOLD_OHM, (3, 5), strict=True):
        found.bar(at_most, f"{ohm}_random", "wrong", wrong)
    return found


# Figures of each group, and their bars.
GROUPS: dict[str, Callable[[Part, int, int, Progress], Pooled]] = {
    "far": of_far,
    "references": of_references,
    "damp": of_damp,
    "palms": of_palms,
    "large": of_large,
    "objects": of_objects,
    "damages": of_damages,
    "untold": of_untold,
}


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
        found = GROUPS[group](asked.part, asked.seed, asked.jobs, progress)
        figures, bars = figures | found, bars + found.bars
    return finish(asked.part, figures, bars)


if __name__ == "__main__":
    sys.exit(main())
