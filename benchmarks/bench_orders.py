# SPDX-License-Identifier: Apache-2.0
"""Measure which readings mode far should take, and in which order, in the AVR simulator.

    make bench-orders

For each order of readings it builds the Uno's firmware in a temporary copy, whose frames.toml has
this order. It scans four skins at 90 Hz with the capacitances of the setting `desk` (100 pF a node,
30 pF a line, 14 pF in the converter), and with its offset of 2 LSB alone. A cell's resistance, by
Ohm's law on the readings alone, is r = R_ref V / I with V = e - f (or g - h) and I the mean of
1 - a and b. What it prints is how far capacitances, or the offset, move it from that of exact
readings: median and 90th percentile over pressed cells.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from bars import QUICK, options  # beside this file
from ohmskin.arrays import Float
from places import ROOT

ORDERS = ("a e b f", "e a f b", "a b e f", "a b h g", "a b g h")
DESK = {"sample_pf": 14, "input_ohm": 10e3, "node_pf": 100, "line_pf": 30, "cell_pf": 2}
FAR_READINGS = re.compile(r'(?<=name = "far", value = 1, readings = )\[.*?\]')  # in frames.toml


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


def measure() -> None:
    """In a copy: print the errors of its order."""
    from lockstep import Rig
    from ohmskin.circuit.skin import Skin, all_readings, end_admittance
    from ohmskin.link import protocol

    names = protocol.MODES["far"]
    errors: dict[str, list[Float]] = {"desk": [], "offset": []}
    for layers in skins():
        skin = Skin(*layers)
        admittance = end_admittance(skin)
        exact = all_readings(skin, admittance.copy())
        true = resistance(exact[..., ["abcdefgh".index(name) for name in names]], names)
        for what, settings in (("desk", DESK), ("offset", {"offset_lsb": 2})):
            with Rig("uno") as rig:
                rig.sim.set_table(exact)
                rig.sim.set(**settings, half_code=1, noise_lsb=0.5)
                rig.sim.request("C", bytes([0x80 | 8]) + admittance.tobytes())
                rig.run(0.05)
                rig.start_scan(mode="far")
                rig.run(1.2)
                codes = np.mean([scan.codes for scan in rig.scans[10:]], axis=0)
            off = resistance(codes / 1024, names) / true - 1
            errors[what].append(100 * np.abs(off[skin.cell_siemens > 5e-6]))
    texts = []
    for what, parts in errors.items():
        median, high = np.percentile(np.concatenate(parts), [50, 90])
        texts.append(f"{what} {median:5.2f} % {high:6.2f} %")
    print(f"{' '.join(names)}:  {',  '.join(texts)}", flush=True)


def main() -> None:
    part = options(__doc__).parse_args().part
    for order in ORDERS[:1] if part is QUICK else ORDERS:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "ohmskin"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "node_modules"))
            frames = copy / "protocol" / "frames.toml"
            frames.write_text(FAR_READINGS.sub(str(order.split()), frames.read_text()))
            path = ":".join(map(str, (copy / "host", copy, copy / "tests" / "helpers")))
            pio = str(Path(sys.executable).parent / "pio")
            for command in (
                [sys.executable, "protocol/generate.py"],
                [pio, "run", "-s", "-e", "uno"],
                [sys.executable, "benchmarks/bench_orders.py", "measure"],
            ):
                quiet = subprocess.DEVNULL if command[-1] != "measure" else None
                environment = os.environ | {"PYTHONPATH": path}
                subprocess.run(command, check=True, stdout=quiet, cwd=copy, env=environment)


if __name__ == "__main__":
    measure() if sys.argv[1:] == ["measure"] else main()
