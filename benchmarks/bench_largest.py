# SPDX-License-Identifier: Apache-2.0
"""Measure what the largest files that are taken cost: SECURITY.md states it.

    make bench-largest
    .venv/bin/python benchmarks/bench_largest.py

A frame of random readings, which no skin gives, over random rest readings: each method gives up.
Each runs in a process of its own.

METHOD_SIZE_MODE_s, _mb     of one frame, with what reading the rest takes.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from bars import Part, run  # beside this file
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import MODES

SIZES = ((32, 32), (16, 64))
CASES = [
    (method, rows, columns, mode)
    for rows, columns in SIZES
    for mode in MODES
    for method in ("matrix", "joint", "touch")
    if method != "matrix" or mode == "near"
]


def peak_mb() -> float:
    """The most memory that this process has had."""
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


def frame(method: str, rows: int, columns: int, mode: str) -> None:
    """Estimate one, and print what it has cost."""
    random, names = np.random.default_rng(1), MODES[mode]
    small = SkinKnowledge(2, 2, adc_bits=10, reading_names=names)
    make_estimator(method, small).estimate(random.random((2, 2, 4)))  # all is imported
    before_mb, begin_s = peak_mb(), time.perf_counter()
    rest_ratio = random.random((rows, columns, 4))
    known = SkinKnowledge(rows, columns, adc_bits=10, reading_names=names, rest_ratio=rest_ratio)
    make_estimator(method, known).estimate(random.random((rows, columns, 4)))
    print(time.perf_counter() - begin_s, peak_mb() - before_mb)


def measured(*arguments: str) -> tuple[float, float]:
    """What another process of this file prints: seconds, and megabytes."""
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    took_s, memory_mb = map(float, done.stdout.split()[-2:])
    return took_s, memory_mb


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    figures = {}
    for method, rows, columns, mode in CASES[: part.of(len(CASES))]:
        size = f"{rows}x{columns}" if part.share == 1 else "2x2"
        took_s, memory_mb = measured("frame", method, *size.split("x"), mode)
        figures[f"{method}_{size}_{mode}_s"] = round(took_s, 1)
        figures[f"{method}_{size}_{mode}_mb"] = round(memory_mb)
    return figures


if __name__ == "__main__":
    if sys.argv[1:2] == ["frame"]:
        frame(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
        sys.exit()
    sys.exit(run(__doc__, measure, ()))
