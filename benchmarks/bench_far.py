# SPDX-License-Identifier: Apache-2.0
"""Measure what sensing both ends of the lines gains: mode far beside mode near, on the same scenes.

    make bench-far

Prints a table of bars and, as the last line, one JSON object. The exit code is 1 when a bar is
missed. Everything is simulated. Nobody is told the wires; rest readings are told, rounded as all
readings are. `far`: readings a e b f. `near`: a b c d. Rounding takes the part of a code away, as a
converter does, and estimators read the middle of its interval. What is measured how:

MODE_KIND_METHOD_*      scenes of tests/data/far, solved by ngspice: `random` (8x8 and 5x9, wires of
                        100 to 300 ohm a segment, up to 8 touches), `harsh` (the same at 1 to
                        2.4 kohm), `finger` (a fingertip over 16 to 29 cells). 10 bits, each frame
                        cold. A pressed cell conducts half as much again as at rest.
    percent, p90_percent    error of a pressed cell: median and 90th percentile
    within_4                share of pressed cells within 4 stated deviations [%]
    ghost_us                cells that are not pressed: largest conductance above the true one [uS],
                            95th percentile over the frames
    stated                  median stated deviation of a pressed cell over its median error
    trusted                 share of frames that the method says converged, and without a fault [%]
    bits12_*                the same with 12 bits
time_KIND_METHOD*       time of a frame in mode far over that in mode near, frames in order, each
                        frame estimated in both modes one after the other: ratio of the medians, and
                        of the 99th percentiles (`_p99`). Of three passes the least time of each
                        frame counts: other work on the machine only adds. The same frames, of four
                        skins from the circuit that ngspice was compared with: `random`, touched
                        anew; `finger`, one or two small fingertips that move.
MODE_wires_METHOD       after 50 frames of up to 8 touches, on 12 skins of 8x8: median error of a
                        segment [%]. Six have 100 and 200 ohm a segment, six 150 and 300, as the
                        `random` scenes; `_100_200`: the first six. Segments are spread by 10 %, so
                        whoever knows the middle of each layer is off by 6.7 %.
far_wires_limit_percent what these frames allow: the same of normal errors with the deviations of
                        the posterior at the truth, for whoever knows which cells are pressed, with
                        the priors of `joint`. Two of the skins, one of each.
MODE_bent_METHOD        wires 35 % above those at the calibration, rest readings and a force curve
                        of each cell unchanged: median error of a pressed cell's force over that of
                        the unbent skin. 3 skins of 8x8, 60 frames of up to 8 touches, in order. A
                        curve joins 9 presses of the cell alone, by straight lines in logarithms.
MODE_bent_METHOD_p90    the same of the 90th percentiles.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bars import Bar, at_least, at_most, report  # beside this file
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, all_readings, end_admittance
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.prior import REST_STD, SEGMENT_STD, UNKNOWN_LAYER_STD
from ohmskin.link.codes import quantise, ratio_from_codes, ratio_std
from ohmskin.link.protocol import ENUMS, MODES
from ohmskin.record.readings import Readings, estimate_file
from studies.information import PRESSED_STD
from studies.trials import (
    PRESSED,
    Trial,
    finger_trial,
    random_trial,
    skin_at_rest,
    stretched,
    touch,
    trial_of,
)

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "data" / "far"
KINDS = {
    "random": ("random_8x8_0", "random_8x8_1", "random_5x9_0", "random_5x9_1"),
    "harsh": ("harsh_8x8_0", "harsh_8x8_1"),
    "finger": ("finger_8x8_0", "finger_8x8_1"),
}
METHODS = ("joint", "touch")
BITS = (10, 12)
SEED = 7000
WARM_UP = 3  # frames
PASSES = 3
BEND = 1.35
SEGMENT_OHM = ((100.0, 200.0), (150.0, 300.0))  # of the random skins of tests/data/far
CALIBRATED_SIEMENS = np.geomspace(1e-5, 1e-3, 9)


# ------------------------------------------------------------------------------ scenes of ngspice


@dataclass(frozen=True, eq=False)
class Scenes:
    """Frames of one file: exact readings a to h, and the truth (F, R, C) and (R, C) [S]."""

    ratio: Float
    rest_ratio: Float
    names: tuple[str, ...]
    cell_siemens: Float
    rest_siemens: Float

    @classmethod
    def load(cls, name: str) -> Scenes:
        with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
            return cls(
                file["ratio"],
                file["rest_ratio"],
                tuple(file["reading_names"].tolist()),
                1 / file["cell_ohm"],
                1 / file["rest_ohm"],
            )

    def read(self, mode: str, bits: int) -> Readings:
        chosen = [self.names.index(name) for name in MODES[mode]]
        ratio, rest = (
            ratio_from_codes(quantise(exact[..., chosen], bits), bits)
            for exact in (self.ratio, self.rest_ratio)
        )
        return Readings(ratio, rest, adc_bits=bits, reading_names=MODES[mode])

    @property
    def pressed(self) -> NDArray[np.bool_]:
        return np.asarray(self.cell_siemens > PRESSED * self.rest_siemens)


def errors(kind: str, mode: str, method: str, bits: int) -> dict[str, float]:
    relative, stated, ghost_us, trusted = [], [], [], []
    for name in KINDS[kind]:
        scenes = Scenes.load(name)
        out = estimate_file(scenes.read(mode, bits), method, cold=True)
        error, pressed = out["cell_siemens"] - scenes.cell_siemens, scenes.pressed
        relative.append(np.abs(error / scenes.cell_siemens)[pressed])
        stated.append((out["cell_siemens_std"] / scenes.cell_siemens)[pressed])
        trusted.append(out["converged"])
        ghost_us.append(1e6 * np.where(pressed, 0.0, error).max(axis=(1, 2)))
    of_cell, std = np.concatenate(relative), np.concatenate(stated)
    return {
        "percent": round(100 * float(np.median(of_cell)), 3),
        "p90_percent": round(100 * float(np.quantile(of_cell, 0.9)), 2),
        "within_4": round(100 * float(np.mean(of_cell < 4 * std)), 2),
        "stated": round(float(np.median(std) / np.median(of_cell)), 2),
        "trusted": round(100 * float(np.mean(np.concatenate(trusted))), 1),
        "ghost_us": round(float(np.quantile(np.concatenate(ghost_us), 0.95)), 3),
    }


# ------------------------------------------------------------------------------------------ time


def times() -> dict[str, float]:
    figures: dict[str, float] = {}
    of_kind = {
        "random": [random_trial(8, 8, 8, 100, SEED + n) for n in range(4)],
        "finger": [finger_trial(8, 8, 150, SEED + n) for n in range(4)],
    }
    for kind, trials in of_kind.items():
        read = [
            {mode: trial.rounded(10, mode=mode, wires_told=False) for mode in MODES}
            for trial in trials
        ]
        for method in METHODS:
            passes = [[seconds(each, method) for each in read] for _ in range(PASSES)]
            taken = np.min([np.concatenate(each) for each in passes], axis=0)
            near, far = np.quantile(taken, [0.5, 0.99], axis=0).T
            figures[f"time_{kind}_{method}"] = round(float(far[0] / near[0]), 2)
            figures[f"time_{kind}_{method}_p99"] = round(float(far[1] / near[1]), 2)
            figures[f"ms_near_{kind}_{method}"] = round(1e3 * float(near[0]), 2)
            figures[f"ms_far_{kind}_{method}"] = round(1e3 * float(far[0]), 2)
    return figures


def seconds(read: dict[str, Readings], method: str) -> Float:
    """Of each frame but the first ones, near and far, (F, 2): one beside the other."""
    estimators = [make_estimator(method, read[mode].knowledge(0)) for mode in ("near", "far")]
    frames = zip(read["near"].ratio, read["far"].ratio, strict=True)
    taken = [
        [each.estimate(ratio).seconds for each, ratio in zip(estimators, pair, strict=True)]
        for pair in frames
    ]
    return np.array(taken[WARM_UP:])


# ------------------------------------------------------------------------------- wires and forces


def wire_trial(wire_ohm: tuple[float, float], number: int) -> Trial:
    random = np.random.default_rng(SEED + 100 + number)
    rest = skin_at_rest(8, 8, random, wire_ohm=wire_ohm)
    counts = random.integers(0, 9, 50)
    return trial_of(rest, [touch(rest, int(count), random) for count in counts])


def wires(mode: str, method: str, kinds: Sequence[tuple[float, float]]) -> float:
    off = []
    for wire_ohm, number in itertools.product(kinds, range(6)):
        trial = wire_trial(wire_ohm, number)
        out = estimate_file(trial.rounded(10, mode=mode, wires_told=False), method)
        truth = trial.rest.top_wire_ohm, trial.rest.bottom_wire_ohm
        for name, ohm in zip(("top_wire_ohm", "bottom_wire_ohm"), truth, strict=True):
            off.append(np.abs(out[name][-1] / ohm - 1).ravel())
    return round(100 * float(np.median(np.concatenate(off))), 2)


def wires_limit() -> float:
    """By central differences of exact readings: cells of each frame are integrated out."""
    names = list(ENUMS["reading"].values)
    chosen = [names.index(name) for name in MODES["far"]]
    std = ratio_std(10)
    away = []
    for number in range(2):
        trial = wire_trial(SEGMENT_OHM[number], number)
        cells = trial.rest.cell_siemens.size
        shared = np.kron(np.eye(2), np.full((cells, cells), UNKNOWN_LAYER_STD**2))
        information = np.linalg.inv(shared + SEGMENT_STD**2 * np.eye(2 * cells))
        for skin, pressed in zip(trial.frames, trial.pressed, strict=True):
            logs = np.log([1 / skin.cell_siemens, skin.top_wire_ohm, skin.bottom_wire_ohm])

            def read(log_ohm: Float, shape: tuple[int, ...] = logs.shape) -> Float:
                cell, top, bottom = np.exp(log_ohm).reshape(shape)
                of = Skin(1 / cell, top, bottom)
                return np.asarray(all_readings(of, end_admittance(of))[..., chosen].ravel() / std)

            steps = 1e-4 * np.eye(logs.size)
            x = logs.ravel()
            slopes = np.array([(read(x + step) - read(x - step)) / 2e-4 for step in steps]).T
            by_cell, by_wire = slopes[:, :cells], slopes[:, cells:]
            variance = np.where(pressed.ravel(), PRESSED_STD, REST_STD) ** 2
            noise = by_cell * variance @ by_cell.T + np.eye(len(slopes))
            information += by_wire.T @ np.linalg.solve(noise, by_wire)
        away.append(np.sqrt(np.linalg.inv(information).diagonal()))
    normal = np.abs(np.random.default_rng(SEED).standard_normal((400, 1)))
    return round(100 * float(np.median(normal * np.concatenate(away))), 2)


def force_n(rise_siemens: Float) -> Float:
    """The truth: 10 N at 1 mS, and less than linear, as contacts are."""
    return np.asarray(10.0 * (np.maximum(rise_siemens, 0.0) / 1e-3) ** 0.7)


def estimated(estimator: Estimator, frames: Iterable[Float]) -> Float:
    return np.array([estimator.estimate(ratio).cell_siemens for ratio in frames])


def curves(trial: Trial, mode: str, method: str) -> tuple[Float, Float]:
    """Log of the rise that the estimator sees of each press (P, R, C), of its force (P, R, C)."""
    rest, rows, columns = trial.rest, *trial.rest.shape
    frames, force = [], []
    for siemens in CALIBRATED_SIEMENS:
        for cell in range(rows * columns):
            pressed = rest.cell_siemens.copy()
            pressed.flat[cell] += siemens
            frames.append(replace(rest, cell_siemens=pressed))
        force.append(np.full((rows, columns), np.log(force_n(siemens))))
    read = trial_of(rest, frames).rounded(10, mode=mode, wires_told=False)
    found = estimated(make_estimator(method, read.knowledge(0)), read.ratio)
    own = found.reshape(-1, rows * columns, rows * columns).diagonal(axis1=1, axis2=2)
    rise = own.reshape(-1, rows, columns) - rest.cell_siemens
    return np.log(np.maximum(rise, 1e-8)), np.array(force)


def by_curve(rise_siemens: Float, curve: tuple[Float, Float]) -> Float:
    """Forces (F, R, C) [N] by the curve of each cell, straight on beyond its ends."""
    log_rise, force = np.log(np.maximum(rise_siemens, 1e-8)), np.empty_like(rise_siemens)
    for cell in np.ndindex(*rise_siemens.shape[1:]):
        at, x, y = log_rise[:, *cell], curve[0][:, *cell], curve[1][:, *cell]
        part = np.clip(np.searchsorted(x, at), 1, x.size - 1)
        slope = (y[part] - y[part - 1]) / (x[part] - x[part - 1])
        force[:, *cell] = np.exp(y[part - 1] + slope * (at - x[part - 1]))
    return force


def bent(mode: str, method: str) -> dict[str, float]:
    off: dict[float, list[Float]] = {1.0: [], BEND: []}
    for number in range(3):
        trial = random_trial(8, 8, 8, 60, SEED + 200 + number)
        curve, rest = curves(trial, mode, method), trial.rest.cell_siemens
        true_n = force_n(trial.cell_siemens - rest)
        for factor, found in off.items():
            frames = [stretched(skin, factor) for skin in trial.frames]
            read = trial_of(trial.rest, frames).rounded(10, mode=mode, wires_told=False)
            siemens = estimated(make_estimator(method, read.knowledge(0)), read.ratio)
            force = by_curve(siemens - rest, curve)
            found.append(np.abs(force / np.where(trial.pressed, true_n, 1) - 1)[trial.pressed])
    flat, moved = (np.quantile(np.concatenate(each), [0.5, 0.9]) for each in off.values())
    return {
        f"{mode}_bent_{method}": round(float(moved[0] / flat[0]), 2),
        f"{mode}_bent_{method}_p90": round(float(moved[1] / flat[1]), 2),
        f"{mode}_bent_{method}_percent": round(100 * float(moved[0]), 2),
    }


# ------------------------------------------------------------------------------------------ bars


def bars_of(method: str) -> list[Bar]:
    bars = []
    for kind, median, tail in (("random", 0.4, 2), ("harsh", 0.5, 3), ("finger", 1.2, 5)):
        key = f"far_{kind}_{method}"
        bars += [
            at_most(f"{key}_percent", median),
            at_most(f"{key}_p90_percent", tail),
            at_least(f"{key}_within_4", 97),
            at_most(f"{key}_ghost_us", 0.5),
        ]
    bars += [
        at_most(f"time_{kind}_{method}{tail}", 2)
        for kind in ("random", "finger")
        for tail in ("", "_p99")
    ]
    bars += [at_most(f"far_bent_{method}", 1.05), at_most(f"far_wires_{method}_percent", 5)]
    return bars


def main() -> int:
    figures: dict[str, float] = {}
    for mode in ("far", "near"):
        for kind in KINDS:
            for method in METHODS:
                for bits in BITS:
                    key = f"{mode}_{kind}_{method}" + ("" if bits == 10 else f"_bits{bits}")
                    found = errors(kind, mode, method, bits)
                    figures |= {f"{key}_{name}": value for name, value in found.items()}
    figures |= times()
    for mode in ("far", "near"):
        for method in METHODS:
            figures[f"{mode}_wires_{method}_percent"] = wires(mode, method, SEGMENT_OHM)
            thin = wires(mode, method, SEGMENT_OHM[:1])
            figures[f"{mode}_wires_{method}_100_200_percent"] = thin
            figures |= bent(mode, method)
    figures["far_wires_limit_percent"] = wires_limit()
    all_met = report(figures, [bar for method in METHODS for bar in bars_of(method)])
    print(json.dumps(figures))
    return 0 if all_met else 1


if __name__ == "__main__":
    sys.exit(main())
