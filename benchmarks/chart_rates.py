# SPDX-License-Identifier: Apache-2.0
"""How fast a skin can be read, and what that costs: a picture of rates against errors.

    make chart

Simulated: the built firmware of an Uno in simavr; fingertips, one or two; `touch`, wires told; the
third scan after each frame begins. Two wirings: one whose lines settle at once, with noise of 0.3
LSB, and the desk of `make bench-desk`, with lines that charge. A region is 3x3 or 5x5 cells around
a small fingertip that stays, in one reading of each cell, after a near scan of the whole skin.
Modes half and quick have a near scan in thirty. Writes docs/rate-accuracy.png and .csv.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bars import Part, options  # beside this file
from desk import paced_skin  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import MODES, all_lines
from places import ROOT
from studies.drawing import INK, new_figure, png_of, prepare, write_notes, write_plain_numbers
from studies.trials import Trial, finger_trial, knowledge_of

SEED, SKINS, FRAMES = 7200, 4, 12
WHOLE_EVERY, WHOLE_EVERY_OF_REGION = 30, 4
SMALL_FINGER: Final = (0.45, 0.5)  # standard deviations [cells]
WIRINGS: Final[dict[str, dict[str, float]]] = {
    "lines that settle at once": {"desk": 0, "noise_lsb": 0.3},
    "the desk: lines that charge": {},
}
# Settle times that are asked for [us], by what is read; 0: the default of the mode.
WHOLE: Final = {
    "near": (0, 40, 80),
    "half": (20, 30, 0, 80),
    "quick": (20, 40, 60, 0),
    "far": (0, 80),
}
REGIONS: Final = {3: (20, 40, 0), 5: (20, 40, 0)}
PERCENTS: Final = (1, 2, 3, 5, 10, 20)
COLOURS: Final = {"near": "#000000", "half": "#0072b2", "quick": "#d55e00", "far": "#009e73"}
COLOURS_OF_REGIONS: Final = {3: "#aa3fb4", 5: "#e69f00"}


@dataclass(frozen=True)
class Row:
    """One way to scan. settle_us: as asked for; 0: the default. Errors are of pressed cells."""

    wiring: str
    size: int
    region: int
    mode: str
    settle_us: int
    hz: float
    error_percent: float
    error_p90_percent: float


def errors_of(
    trial: Trial, seed: int, wiring: str, lines: tuple[int, int], **scan: Any
) -> tuple[float, Float]:
    """Scans a second, and the errors of pressed cells that were read (n,), as shares.

    lines: how many of each layer are read around the peak of the first frame; the size: all.
    """
    region, size = lines
    if region < size:
        peak = np.unravel_index(trial.cell_siemens[0].argmax(), (size, size))
        starts = np.clip(np.array(peak) - region // 2, 0, size - region).tolist()
        masks = [all_lines(region) << start for start in starts]
        scan |= dict(zip(("row_mask", "column_mask"), masks, strict=True))
        trial = replace(trial, frames=trial.frames[:1] * len(trial.frames))
    skin = paced_skin(seed, trial, settings=WIRINGS[wiring], **scan)
    names = MODES["far" if scan["mode"] == "far" else "near"]
    estimator = make_estimator("touch", replace(knowledge_of(skin.rest_ratio), reading_names=names))
    errors, whole_seen = [], False
    for scans, true, pressed in zip(skin.ratios, trial.cell_siemens, trial.pressed, strict=True):
        found = [estimator.estimate(ratio, names).cell_siemens for ratio in scans][-1]
        whole_seen |= any(not np.isnan(ratio[..., 1]).any() for ratio in scans)
        if whole_seen:  # what is outside of a region is known from a whole scan alone
            judged = pressed & ~np.isnan(scans[-1]).all(axis=-1)
            errors.append((np.abs(found - true) / true)[judged])
    return skin.scans_hz, np.concatenate(errors)


def row(part: Part, wiring: str, lines: tuple[int, int], mode: str, settle_us: int) -> Row:
    region, size = lines
    whole_every = WHOLE_EVERY if region == size else WHOLE_EVERY_OF_REGION
    if mode in ("near", "far"):
        whole_every = 0
    scan = {"mode": mode, "rate_mhz": 0, "settle_us": settle_us, "whole_every": whole_every}
    found = []
    for number in range(part.of(SKINS)):
        fingers: dict[str, Any] = {"sigma_cells": SMALL_FINGER} if region < size else {}
        trial = finger_trial(size, size, FRAMES, SEED + number, **fingers)
        found.append(errors_of(trial, number, wiring, lines, **scan))
    errors = 100 * np.concatenate([each for _, each in found])
    median, p90 = np.percentile(errors, [50, 90]).round(2).tolist()
    return Row(wiring, size, region, mode, settle_us, round(found[0][0], 1), median, p90)


def rows(part: Part) -> Iterator[Row]:
    for wiring in WIRINGS:
        for size in (8, 16):
            for mode, times in WHOLE.items():
                for settle_us in times:
                    yield row(part, wiring, (size, size), mode, settle_us)
        for region, times in REGIONS.items():
            for settle_us in times:
                yield row(part, wiring, (region, 8), "quick", settle_us)


def picture(found: list[Row]) -> bytes:
    figure = new_figure(11, 5.2)
    panels = figure.subplots(1, len(WIRINGS), sharex=True, sharey=True)
    for axes, wiring in zip(panels, WIRINGS, strict=True):
        curves: dict[tuple[int, int, str], list[Row]] = {}
        for each in found:
            if each.wiring == wiring:
                curves.setdefault((each.size, each.region, each.mode), []).append(each)
        for (size, region, mode), points in curves.items():
            part = region < size
            points = sorted(points, key=lambda point: point.hz)
            axes.plot(
                [point.hz for point in points],
                [point.error_percent for point in points],
                color=COLOURS_OF_REGIONS[region] if part else COLOURS[mode],
                linestyle="--" if size == 16 else "-",
                marker="s" if size == 16 else "D" if part else "o",
                markersize=5,
                label=f"{region}x{region} of {size}x{size}" if part else f"{size}x{size}, {mode}",
            )
            for point in points:
                if not point.settle_us:  # the default
                    axes.plot(point.hz, point.error_percent, "o", ms=12, mfc="none", mec=INK)
        axes.set(xscale="log", yscale="log", title=wiring, xlabel="scans a second")
        prepare(axes, which="both")
        write_plain_numbers(axes.xaxis, axes.yaxis)
        axes.set_yticks(PERCENTS, map(str, PERCENTS))
        axes.set_yticks([], minor=True)
    panels[0].set_ylabel("median error of a pressed cell [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    notes = [
        "Built firmware of an Uno, simulated; fingertips; 'touch', wires told. Along a line, the "
        "settle time of a reading changes: 20 us and more. Circles: the default of a mode. Rates "
        "are those between the near scans that half, quick and regions have, on a line of 500,000 "
        "baud. Fingers of regions are smaller, and stay."
    ]
    write_notes(figure, notes, 150)
    return png_of(figure)


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder to write to")
    asked = parser.parse_args()
    found = []
    for each in rows(asked.part):
        print(each, flush=True)
        found.append(each)
    with (asked.out / "rate-accuracy.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, found))
    (asked.out / "rate-accuracy.png").write_bytes(picture(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
