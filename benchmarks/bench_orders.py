# SPDX-License-Identifier: Apache-2.0
"""Measure which readings a mode should take, and in which order, in the AVR simulator.

    make bench-orders

For each order of readings it builds the Uno's firmware in a temporary copy, whose frames.toml has
this order, and scans at 90 Hz. Errors are those of the mean of some hundred scans against exact
readings: medians and 90th percentiles over the pressed cells of four skins.

far    A cell's resistance, by Ohm's law on the readings alone, is r = R_ref V / I with V = e - f
       (or g - h) and I the mean of 1 - a and b. How far the capacitances of the setting `desk` (100
       pF a node, 30 pF a line, 14 pF in the converter), or an offset of 2 LSB, move it.
near   By how many passes over the cells, `/` between them. How far the current of a cell is moved,
       its mean over a to d: by 100 pF a node and 14 pF in the converter, without lines, where the
       sample capacitor joins the next node when a conversion ends (early), or only when the next
       one begins (late: `track_late`); and by the lines of `make bench-firmware`, rms over all
       cells with three corners pressed [LSB].
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from bars import QUICK, options  # beside this file
from desk import near_admittance  # tests/helpers
from lockstep import Rig
from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READING_OFFSET, READING_SIGN
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, readings
from ohmskin.link import protocol
from places import ROOT

# Mode, readings, and how many of them follow each other at a cell.
ORDERS = (
    *(("far", order, 2) for order in ("a e b f", "e a f b", "a b e f", "a b h g", "a b g h")),
    ("near", "a b c d", 2),
    ("near", "a b d c", 2),
    ("near", "b a c d", 2),
    ("near", "b a d c", 2),
    ("near", "a b c d", 1),
    ("near", "a b d c", 1),
)
CAPACITORS = {"sample_pf": 14, "input_ohm": 10e3, "node_pf": 100}
DESK = CAPACITORS | {"line_pf": 30, "cell_pf": 2}
FAR_SETTINGS: dict[str, dict[str, float]] = {"desk": DESK, "offset": {"offset_lsb": 2}}
# Each as a board without the last of them.
NEAR_SETTINGS: dict[str, dict[str, float]] = {
    "early": CAPACITORS,
    "late": CAPACITORS | {"track_late": 1},
}
LINES: tuple[dict[str, float], ...] = (
    {"node_pf": 50, "cell_pf": 2, "line_pf": 30},
    {"node_pf": 50, "cell_pf": 2, "line_pf": 100},
)
OF_MODE = r'(?<=name = "{}", value = {}, )readings = \[.*?\], per_pass = \d'  # in frames.toml
SELF_TEST_ORDER = re.compile(r"static_assert\([^;]*;")
PRESSED_SIEMENS = 5e-6


def skins() -> list[tuple[Float, Float, Float]]:
    """Cells [S], wires of rows and of columns [ohm]: corners, touches, a finger, harsh wires."""
    random = np.random.default_rng(1)
    rest = 1e-6 * np.exp(0.1 * random.standard_normal((8, 8)))
    corners, touches, harsh = rest.copy(), rest.copy(), rest.copy()
    corners[[2, 2, 5], [2, 5, 2]] += 1 / 5e3
    for skin in (touches, harsh):
        skin.flat[random.choice(64, 8, replace=False)] += 10 ** random.uniform(-5, -3, 8)
    i, j = np.indices((8, 8))
    finger = rest + 2e-4 * np.exp(-((i - 3.3) ** 2 + (j - 4.2) ** 2) / 5)
    spread = random.uniform(0.9, 1.1, (2, 8, 8))
    soft = (100 * spread[0], 200 * spread[1])
    return [
        *((cells, *soft) for cells in (corners, touches, finger)),
        (harsh, 1e3 * spread[0], 2e3 * spread[1]),
    ]


def resistance(ratio: Float, names: tuple[str, ...]) -> Float:
    """V / I of every cell, from readings of these names."""
    of = dict(zip(names, np.moveaxis(ratio, -1, 0), strict=True))
    voltage = of["e"] - of["f"] if "e" in of else of["g"] - of["h"]
    return np.asarray(voltage / (1 - of["a"] + of["b"]))


def read(skin: Skin, mode: str, **settings: float) -> Float:
    """What the board reads of a skin (R, C, n), mean of a second's scans: with noise, no steps."""
    names = protocol.MODES[mode]
    admittance = end_admittance(skin)
    exact = all_readings(skin, admittance.copy())
    with Rig("uno") as rig:
        rig.sim.set_table(exact)
        rig.sim.set(**settings, half_code=1, noise_lsb=0.5)
        if "line_pf" in settings:
            far = mode == "far"
            siemens = admittance if far else near_admittance(skin)
            rig.sim.request("C", bytes([0x80 * far | 8]) + siemens.tobytes())
        rig.run(0.05)
        rig.start_scan(mode=mode)
        rig.run(1.2)
        codes = np.mean([scan.codes for scan in rig.scans[10:]], axis=0)
    return np.asarray(codes / 1024 - exact[..., ["abcdefgh".index(name) for name in names]])


def said(errors: list[Float]) -> str:
    median, high = np.percentile(np.abs(np.concatenate(errors)), [50, 90])
    return f"{100 * median:5.2f} % {100 * high:6.2f} %"


def measure_far() -> str:
    """The errors of mode far's order, in words."""
    names, texts = protocol.MODES["far"], []
    for what, settings in FAR_SETTINGS.items():
        errors = []
        for layers in skins():
            skin = Skin(*layers)
            exact = all_readings(skin, end_admittance(skin))
            exact = exact[..., ["abcdefgh".index(name) for name in names]]
            off = resistance(exact + read(skin, "far", **settings), names)
            off = off / resistance(exact, names) - 1
            errors.append(off[skin.cell_siemens > PRESSED_SIEMENS])
        texts.append(f"{what} {said(errors)}")
    return ",  ".join(texts)


def measure_near() -> str:
    """The errors of mode near's order, in words."""
    names, texts = protocol.MODES["near"], []
    sign = READING_SIGN[["abcd".index(name) for name in names]] / 4
    for what, settings in NEAR_SETTINGS.items():
        errors = []
        for layers in skins():
            skin = Skin(*layers)
            current = (readings(skin)[..., :4] - READING_OFFSET) @ READING_SIGN / 4
            off = read(skin, "near", **settings) @ sign / current
            errors.append(off[skin.cell_siemens > PRESSED_SIEMENS])
        texts.append(f"{what} {said(errors)}")
    corners = Skin(skins()[0][0], *np.zeros((2, 8, 8)))
    lines = [read(corners, "near", **settings) @ sign for settings in LINES]
    rms = [1024 * float(np.sqrt(np.mean(off**2))) for off in lines]
    return ",  ".join([*texts, f"lines {rms[0]:.2f} {rms[1]:.2f} LSB"])


def main() -> None:
    part = options(__doc__).parse_args().part
    for mode, order, per_pass in ORDERS[:1] if part is QUICK else ORDERS:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "ohmskin"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "node_modules"))
            frames = copy / "protocol" / "frames.toml"
            wanted = re.compile(OF_MODE.format(mode, protocol.ENUMS["mode"].values[mode]))
            text = f"readings = {json.dumps(order.split())}, per_pass = {per_pass}"
            frames.write_text(wanted.sub(text, frames.read_text()))
            # The self-test's judgement knows today's order; here nobody asks for it.
            self_test = copy / "firmware" / "src" / "core" / "self_test.cpp"
            self_test.write_text(SELF_TEST_ORDER.sub("", self_test.read_text()))
            path = ":".join(map(str, (copy / "host", copy, copy / "tests" / "helpers")))
            pio = str(Path(sys.executable).parent / "pio")
            environment = os.environ | {"PYTHONPATH": path}
            command = [sys.executable, "benchmarks/bench_orders.py", "measure", mode]
            for build in (
                [sys.executable, "protocol/generate.py"],
                [pio, "run", "-s", "-e", "uno"],
            ):
                subprocess.run(
                    build, check=True, stdout=subprocess.DEVNULL, cwd=copy, env=environment
                )
            done = subprocess.run(
                command, check=True, stdout=subprocess.PIPE, text=True, cwd=copy, env=environment
            )
        names = order.split()
        passes = [names[n : n + per_pass] for n in range(0, len(names), per_pass)]
        print(f"{mode}  {' / '.join(map(' '.join, passes)):13}:  {done.stdout.strip()}", flush=True)


if __name__ == "__main__":
    of_copy = {"far": measure_far, "near": measure_near}
    if sys.argv[1:2] == ["measure"]:
        print(of_copy[sys.argv[2]]())
    else:
        main()
