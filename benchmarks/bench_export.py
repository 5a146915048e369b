# SPDX-License-Identifier: Apache-2.0
"""Measure what it costs to bring the forces of recordings into files.

    make bench-export

Takes some ten minutes, or less with `--minutes N`, so long a recording. All skins are simulated,
8x8 at 90 scans/s. What is measured how:

export_times          processor time of an export to .npz, over that of the estimator alone on the
                      same scans: a fingertip, for 20 s, by `touch`. The least of five of each, in
                      turn: what else runs on the machine makes single ones a fifth longer.
beyond_ms             the difference of the two, a scan [ms]
export_mb             memory of the process at its most [MB], when a recording of two hours has been
                      exported to .npz. By `ohm`, because what a method needs is not meant here.
export_minutes        how long that recording was
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from bars import at_most, run_minutes  # beside this file
from bench_force import board_8x8, calibration  # beside this file
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.reader import SkinReader
from ohmskin.force.tables import export
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Scan
from ohmskin.record.recorder import Recorder

RATE_HZ = 90
COMPARED = 20 * RATE_HZ  # scans
TURNS = 5


def finger(scans: int) -> Iterable[Scan]:
    """So many scans of a fingertip, which repeats its way of four seconds."""
    scene = Scene("moving", 8, 8, seed=1)
    way = [quantise(scene.ratio(BEGIN_S + k / RATE_HZ)) for k in range(4 * RATE_HZ)]
    for k, codes in enumerate(islice(cycle(way), scans)):
        yield Scan(codes, k, round(1e6 * k / RATE_HZ), k / RATE_HZ, 0)


def recorded(path: Path, scans: int) -> Path:
    with Recorder(path, replace(board_8x8(), board="uno")) as recorder:
        for scan in finger(scans):
            recorder.add(scan)
    return path


def processor_s(way: Callable[[], object]) -> float:
    begin_s = time.process_time()
    way()
    return time.process_time() - begin_s


def measure(minutes: float) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    rest_ratio, board = Scene("moving", 8, 8, seed=1).rest_ratio, board_8x8()
    with tempfile.TemporaryDirectory() as place:
        long, out = Path(place) / "long.mcap", Path(place) / "out.npz"
        recorded(long, round(60 * minutes * RATE_HZ))
        export(long, out, calibration(board, rest_ratio, "ohm"))
        most_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        of_skin = calibration(board, rest_ratio, "touch")
        short = recorded(Path(place) / "short.mcap", COMPARED)
        reader = SkinReader(board, of_skin)
        ratios = [scan.ratio for scan in finger(COMPARED)]

        def alone() -> None:
            estimator = make_estimator("touch", reader._knowledge(reader.rest))
            for ratio in ratios:
                estimator.estimate(ratio)

        alone()  # loads what it needs
        ways = alone, partial(export, short, out, of_skin)
        turns = [[processor_s(way) for way in ways] for _ in range(TURNS)]
        alone_s, export_s = map(min, zip(*turns, strict=True))
    return {
        "export_times": round(export_s / alone_s, 3),
        "beyond_ms": round(1e3 * (export_s - alone_s) / COMPARED, 3),
        "export_mb": round(most_mb, 1),
        "export_minutes": minutes,
        "estimate_ms": round(1e3 * alone_s / COMPARED, 3),
    }


BARS = (at_most("export_times", 1.1), at_most("export_mb", 300))

if __name__ == "__main__":
    sys.exit(run_minutes(__doc__, measure, BARS, minutes=120.0, least_minutes=0.05))
