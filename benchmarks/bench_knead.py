# SPDX-License-Identifier: Apache-2.0
"""Measure forces of skins that were kneaded over a scale, and touched after that.

    make bench-knead

Everything is simulated: tests/helpers/kneaded_skin.py says how. A skin of 8x8 is kneaded for 6,000
scans, 240 fingertips of 1 to 12 N, and ``calibrate recording --total`` learns from that. Nothing is
told, unless a group says so. RMSE [N]: root mean square of the error of touched cells, in frames of
2 to 6 touches of 0.4 to 7 N. --only takes some of these groups:

force     WIRES_over_single: RMSE over that after 320 single presses, for segments of 100/200,
          500/1000 and 20/40 ohm; the median of all skins. WIRES_tips: rms error of the total of
          held-out fingertips [%], of frames that converged; refused: how many did not [%].
          within_4, wrong: touched cells within 4 stated deviations; cells off by half, by 0.5 N and
          by 4 deviations, for 100 touched ones. stated_over_true: rms of stated deviations over
          that of errors, the worst. nan: touched cells without a number, for 100.
spared    nobody presses eight cells: within_4 of these; stated: median of deviation over force.
scale     a scale of 10 Hz that lags by 200 ms, has noise of 5 g and drifts by 20 g: RMSE over that
          of an ideal scale read at 10 Hz, same touches; the median of five skins.
beside    one fingertip in ten presses beside the skin, too: RMSE over that without; how many of
          these presses are named, and how many others are left out [%].
weights   WEIGHTS_tips: as above, after so many weights, each laid somewhere at rest.
large     16x16, 20,000 scans: seconds of the whole command, and its memory.
live      ``calibrate knead`` of an emulated skin over an emulated scale, in real time: seconds of
          the whole command, until every cell is known to 15 % and all is learned, the longest;
          live_over_single: RMSE over that after a robot's presses of the same skin (scene
          "presses"), in readings that are exact but for the converter; the median.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

import ohmskin
from bars import ALL, Bar, Part, at_least, at_most, finish, options  # beside this file
from command_line import PRINTS_PEAK  # tests/helpers
from kneaded_skin import KneadedSkin, Scale
from ohmskin.emulate.scenes import Scene
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import SkinReader
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Scan
from pressed_skin import TOUCH_N, Forces, Plan, calibrate
from studies.rows import in_processes

WIRES = {"100_200": (100.0, 200.0), "500_1000": (500.0, 1000.0), "20_40": (20.0, 40.0)}
LAW = "series"  # of `LAWS`: no creep, as kneading is quicker than single presses
IDEAL, LAB = Scale(rate_hz=10.0, noise_n=0.0), Scale(10.0, 0.1, 0.1, noise_n=0.05, drift_n=0.2)
SPARED, BESIDE = 8, 0.1
SEED = 100  # of the first skin


class Read(NamedTuple):
    """What a calibration shows of a skin: touches, fingertips; what the command said."""

    touches: Forces
    tips: Forces
    said: dict[str, Any]

    def tips_percent(self) -> float:
        """RMS error of the total of fingertips, of frames that converged [%]."""
        good = self.tips.converged
        sums_n = (forces_n[good].sum(axis=(1, 2)) for forces_n in self.tips[:2])
        true_n, force_n = sums_n
        return 100 * float(np.sqrt(np.mean((force_n / true_n - 1) ** 2)))


class Task(NamedTuple):
    """A skin, and the group of figures it is of."""

    group: str
    name: str
    seed: int
    part: Part


class Shown(NamedTuple):
    """What is shown of a task, by the way of calibrating."""

    task: Task
    by: dict[str, Read]
    skin: KneadedSkin | None  # None: an emulated one


def knead(recording: Path, out: Path) -> dict[str, Any]:
    """Run the command in a process of its own: what it says, its seconds and its memory."""
    arguments = ["calibrate", "recording", str(recording), str(out), "--total", "--json"]
    begin_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", PRINTS_PEAK, *arguments], check=True, capture_output=True
    )
    answer, peak_kb = done.stdout.splitlines()
    said: dict[str, Any] = json.loads(answer)
    return said | {"seconds": time.monotonic() - begin_s, "gigabytes": int(peak_kb) / 1e6}


class EmulatedSkin:
    """The emulated skin of a seed, under touches of single cells as those of `KneadedSkin`."""

    def __init__(self, seed: int, part: Part) -> None:
        size = "2x2" if part is not ALL else "8x8"
        self.url = f"emulator://{size}?seed={seed}&scene="
        with ohmskin.open(f"{self.url}weights", start=False) as board:
            self._board = board.info
        rows, columns = shape = self._board.rows, self._board.columns
        scene, random = Scene("weights", rows, columns, seed=seed), np.random.default_rng(seed)
        self._true_n = np.zeros((part.of(100), *shape))
        self._codes = []
        for true_n in self._true_n:
            siemens = scene.rest.cell_siemens.copy()
            touches = random.integers(2, min(6, true_n.size) + 1)
            for number in random.permutation(true_n.size)[:touches].tolist():
                cell = divmod(number, columns)
                true_n[cell] = random.uniform(*TOUCH_N)
                scene.put((cell, true_n[cell]))
                siemens[cell] = scene.skin(0.0).cell_siemens[cell]
            skin = replace(scene.rest, cell_siemens=siemens)
            self._codes.append(quantise(scene.faults.readings(skin)))

    def read(self, calibration: Path) -> Forces:
        """What a later use of the skin shows of its touches."""
        reader = SkinReader(self._board, load_calibration(calibration))
        scans = [
            reader.read(Scan(codes, number, 11_111 * number, number / 90, 0))
            for number, codes in enumerate(self._codes)
        ]
        return Forces(
            self._true_n,
            np.array([scan.force_n for scan in scans]),
            np.array([scan.force_n_std for scan in scans]),
            np.array([scan.estimate.converged for scan in scans]),
        )


def ohmskin_says(*arguments: str | Path) -> str:
    """Run the command, and return what it prints."""
    command = [sys.executable, "-m", "ohmskin", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def show_live(task: Task) -> Shown:
    """Knead an emulated skin in real time, and press it by a robot."""
    skin, by = EmulatedSkin(task.seed, task.part), {}
    with tempfile.TemporaryDirectory() as place:
        file, recording = Path(place, "skin.json"), Path(place, "robot.mcap")
        command = [sys.executable, "-m", "ohmskin", "emulate", f"{skin.url}knead"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulated:
            assert emulated.stdout is not None
            board, scale = (emulated.stdout.readline().strip() for _ in range(2))
            begin_s = time.monotonic()
            try:
                ohmskin_says("calibrate", "knead", board, file, "--force-port", scale)
            finally:
                emulated.terminate()
            seconds = time.monotonic() - begin_s
        read = skin.read(file)
        by["total"] = Read(read, read, {"seconds": seconds})
        span_s = "25" if task.part is not ALL else "300"
        presses = f"{skin.url}presses&rate=30&speed=0", recording
        ohmskin_says("record", *presses, "--force-port", "truth", "--seconds", span_s)
        calibrate(recording, file, "joint")
        read = skin.read(file)
        by["single"] = Read(read, read, {})
    rmse_n = ", ".join(f"{name} {one.touches.rmse_n():.3f}" for name, one in by.items())
    print(f"live {task.seed}: {rmse_n}; {seconds:.0f} s", flush=True)
    return Shown(task, by, None)


def show(task: Task) -> Shown:
    """Knead, calibrate and touch a skin."""
    if task.group == "live":
        return show_live(task)
    size, scans = 8, 6000
    if task.group == "large":
        size, scans = 16, 20_000
    if task.part is not ALL:
        size, scans = 2, 500
    wire_ohm = WIRES.get(task.name, WIRES["100_200"])
    plan = Plan(wire_ohm, LAW, task.seed, shape=(size, size), touches=task.part.of(100))
    beside = BESIDE if task.group == "beside" else 0.0
    spared = task.part.of(SPARED) if task.group == "spared" else 0
    weights = max(15, task.part.of(int(task.name))) if task.group == "weights" else 0
    skin, by = KneadedSkin(plan, scans, beside, spared, weights), {}
    ways = {"total": Scale()}
    if task.group == "scale":
        ways = {"total": LAB, "without": IDEAL}
    if task.group == "beside":
        ways["without"] = Scale()
    with tempfile.TemporaryDirectory() as place, threadpool_limits(limits=1):
        file = Path(place, "skin.json")
        for name, scale in ways.items():
            recording = Path(place, f"{name}.mcap")
            skin.record_kneading(recording, scale, beside=name == "total")
            said = knead(recording, file)
            by[name] = Read(skin.read(file), skin.read_tips(file), said)
        if task.group == "force":
            recording = Path(place, "single.mcap")
            skin.record(recording)
            calibrate(recording, file, "joint")
            by["single"] = Read(skin.read(file), skin.read_tips(file), {})
    shown = Shown(task, by, skin)
    rmse_n = ", ".join(f"{name} {read.touches.rmse_n():.3f}" for name, read in by.items())
    total = by["total"]
    print(
        f"{task.group} {task.name} {task.seed}: {rmse_n}; tips {total.tips_percent():.1f} %; "
        f"{total.said['seconds']:.0f} s; lag {total.said['lag_s']:.3f}; "
        f"wires {total.said['top']:.0f} {total.said['bottom']:.0f} {total.said['lead']:.0f}",
        flush=True,
    )
    return shown


# ----------------------------------------------------------------------------------- the figures


def over(name: str) -> Callable[[Shown], Iterator[float]]:
    def of(shown: Shown) -> Iterator[float]:
        if name in shown.by:
            yield shown.by["total"].touches.rmse_n() / shown.by[name].touches.rmse_n()

    return of


def tips(shown: Shown) -> Iterator[float]:
    yield shown.by["total"].tips_percent()


def refused(shown: Shown) -> Iterator[float]:
    yield 100.0 * float(np.mean(~shown.by["total"].tips.converged))


def within(shown: Shown) -> Iterator[float]:
    yield shown.by["total"].touches.within_percent()


def wrong(shown: Shown) -> Iterator[float]:
    yield shown.by["total"].touches.wrong_percent()


def no_number(shown: Shown) -> Iterator[float]:
    forces = shown.by["total"].touches
    yield 100.0 * float(np.mean(~np.isfinite(forces.force_n + forces.std_n)[forces.true_n > 0]))


def stated(shown: Shown) -> Iterator[float]:
    forces = shown.by["total"].touches
    on = (forces.true_n > 0) & forces.converged[:, None, None]
    off_n = forces.force_n - forces.true_n
    yield float(np.sqrt(np.mean(forces.std_n[on] ** 2) / np.mean(off_n[on] ** 2)))


def of_spared(shown: Shown) -> Forces:
    """Of the cells that nobody pressed."""
    assert shown.skin is not None
    forces, mask = shown.by["total"].touches, shown.skin.spared.reshape(shown.skin.rest.shape)
    return forces._replace(true_n=np.where(mask, forces.true_n, 0.0))


def spared_within(shown: Shown) -> Iterator[float]:
    yield of_spared(shown).within_percent()


def spared_stated(shown: Shown) -> Iterator[float]:
    forces = of_spared(shown)
    on = forces.true_n > 0
    yield float(np.median(forces.std_n[on] / forces.force_n[on]))


def left_out(shown: Shown, *, beside: bool) -> Iterator[float]:
    """For each press, beside the skin or not, whether its middle is named [%]."""
    assert shown.skin is not None
    spans = shown.by["total"].said["left_out"]
    for press in shown.skin.presses:
        if (press.beside_n > 0) is beside:
            middle_s = 0.5 * (press.from_s + press.to_s)
            yield 100.0 * any(begin_s <= middle_s <= end_s for begin_s, end_s in spans)


def said(name: str) -> Callable[[Shown], Iterator[float]]:
    def of(shown: Shown) -> Iterator[float]:
        yield shown.by["total"].said[name]

    return of


class Figure(NamedTuple):
    """One figure: what `how` makes of all that the skins of its group and name give to it."""

    name: str
    group: str
    skins: str  # "": all of the group
    of: Callable[[Shown], Iterator[float]]
    how: Callable[[list[float]], Any]
    bar: Callable[[str, float], Bar] | None = None
    limit: float = 0.0


FIGURES = [
    Figure("100_200_over_single", "force", "100_200", over("single"), np.median, at_most, 1.3),
    Figure("500_1000_over_single", "force", "500_1000", over("single"), np.median, at_most, 1.8),
    Figure("20_40_over_single", "force", "20_40", over("single"), np.median, at_most, 1.3),
    Figure("100_200_tips", "force", "100_200", tips, np.median, at_most, 7),
    Figure("500_1000_tips", "force", "500_1000", tips, np.median, at_most, 10),
    Figure("refused", "force", "", refused, np.mean),
    Figure("within_4", "force", "", within, np.mean, at_least, 97),
    Figure("wrong", "force", "", wrong, np.mean, at_most, 0.5),
    Figure("stated_over_true", "force", "", stated, np.max, at_most, 3),
    Figure("nan", "force", "", no_number, np.max, at_most, 0),
    Figure("spared_within_4", "spared", "", spared_within, np.mean, at_least, 95),
    Figure("spared_stated", "spared", "", spared_stated, np.max, at_most, 0.4),
    Figure("scale_over_ideal", "scale", "", over("without"), np.median, at_most, 1.2),
    Figure("beside_over_without", "beside", "", over("without"), np.median, at_most, 1.2),
    Figure("beside_named", "beside", "", partial(left_out, beside=True), np.mean, at_least, 95),
    Figure("others_left_out", "beside", "", partial(left_out, beside=False), np.mean, at_most, 1),
    Figure("60_weights_tips", "weights", "60", tips, np.median, at_most, 10),
    Figure("120_weights_tips", "weights", "120", tips, np.median, at_most, 9),
    Figure("large_seconds", "large", "", said("seconds"), np.max, at_most, 300),
    Figure("live_over_single", "live", "", over("single"), np.median, at_most, 1.3),
    Figure("live_seconds", "live", "", said("seconds"), np.max, at_most, 150),
    Figure("large_gigabytes", "large", "", said("gigabytes"), np.max, at_most, 1),
]
NAMES = {"force": list(WIRES), "weights": ["60", "120"]}
SKINS = {"force": 3, "spared": 2, "scale": 5, "beside": 2, "weights": 3, "large": 1, "live": 3}


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--only", default=",".join(SKINS), help=f"of {', '.join(SKINS)}")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first skin")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one a core")
    asked = parser.parse_args()
    groups, part = asked.only.split(","), asked.part
    if part is not ALL:  # so small a skin, kneaded so shortly, may have too few presses
        groups = [group for group in groups if group != "live"]
    tasks = [
        Task(group, name, asked.seed + number, part)
        for group in groups
        for name in NAMES.get(group, [""])[: part.of(3)]
        for number in range(part.of(SKINS[group]))
    ]
    shown = in_processes(show, tasks, asked.jobs, None)
    figures: dict[str, float | None] = {}
    bars = []
    for figure in (figure for figure in FIGURES if figure.group in groups):
        values = [
            value
            for one in shown
            if one.task.group == figure.group and figure.skins in ("", one.task.name)
            for value in figure.of(one)
        ]
        figures[figure.name] = round(float(figure.how(values)), 3) if values else None
        if figure.bar is not None:
            bars.append(figure.bar(figure.name, figure.limit))
    return finish(part, figures, bars)


if __name__ == "__main__":
    sys.exit(main())
