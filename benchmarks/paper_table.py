# SPDX-License-Identifier: Apache-2.0
"""Print how `lsq` and `regularized` compare with the figures of the paper.

    python benchmarks/paper_table.py [--start-wire-ohm 100] [--size 2 --size 3]

RMSE [Mohm] per frame of the two simulations of section V.A, the wire sweep also with cells pressed
to 0.1 megohm (docs/paper.md says why); then how many frames converge, how long they
take, and how many converge to a wrong answer.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.matrix import MatrixEstimator
from ohmskin.estimate.ohm import OhmEstimator
from ohmskin.estimate.paper import LsqEstimator, PaperEstimator, RegularizedEstimator
from ohmskin.link.codes import quantise, ratio_from_codes
from studies.published import RMSE_MEGOHM

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
METHODS: tuple[type[Estimator], ...] = (
    OhmEstimator,
    MatrixEstimator,
    LsqEstimator,
    RegularizedEstimator,
)
WIRES_OHM = (100.0, 500.0, 1e3, 21e3, 41e3)
COLUMNS = "condition [Mohm]  | naive: paper    ohm | least squares: paper    lsq | "
COLUMNS += "regularized: paper  regularized |  matrix"


def frames_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    with np.load(DATA / f"{name}.npz") as reference:
        ratio: np.ndarray = reference["ratio"]
        cell_ohm: np.ndarray = reference["cell_ohm"]
    return ratio, cell_ohm


def wire_sweep(pressed_ohm: float) -> tuple[np.ndarray, np.ndarray]:
    """The frames of `wire_sweep_3x3` with another resistance of the pressed cells."""
    cell_ohm = np.full((3, 3), 1e6)
    cell_ohm[[0, 0, 1], [0, 1, 0]] = pressed_ohm
    wires = (np.full((3, 3), ohm) for ohm in WIRES_OHM)
    ratio = np.array([readings(Skin(1 / cell_ohm, wire, wire)) for wire in wires])
    return ratio, np.broadcast_to(cell_ohm, (len(ratio), 3, 3))


def rmse_megohm(method: type[Estimator], ratio: np.ndarray, cell_ohm: np.ndarray) -> np.ndarray:
    """RMSE of each frame, each from a cold start."""
    found = [method(SkinKnowledge(*each.shape[:2])).estimate(each).cell_ohm for each in ratio]
    rmse: np.ndarray = np.sqrt(np.mean((np.array(found) - cell_ohm) ** 2, axis=(1, 2))) / 1e6
    return rmse


def print_errors() -> None:
    cells_ohm = (0.01, 0.07, 0.09, 0.5, 0.7)
    wires = [ohm / 1e6 for ohm in WIRES_OHM]
    for title, scenes, paper, conditions in (
        ("wires, cells pressed to 0.001", frames_of("wire_sweep_3x3"), "wire_sweep", wires),
        ("wires, cells pressed to 0.1", wire_sweep(1e5), "wire_sweep", wires),
        ("pressed cells, wires 0.001", frames_of("cell_sweep_3x3"), "cell_sweep", cells_ohm),
    ):
        ours = {method.name: rmse_megohm(method, *scenes) for method in METHODS}
        print(f"\nRMSE [Mohm], swept: {title}\n{COLUMNS}")
        for frame, condition in enumerate(conditions):
            naive, least, regular = (figures[frame] for figures in RMSE_MEGOHM[paper].values())
            print(
                f"{condition:17.4f} | {naive:12.4f} {ours['ohm'][frame]:6.4f} | "
                f"{least:20.4f} {ours['lsq'][frame]:6.4f} | "
                f"{regular:18.4f} {ours['regularized'][frame]:12.4f} | "
                f"{ours['matrix'][frame]:7.4f}"
            )


def moving_presses(size: int, frames: int = 90) -> Iterator[np.ndarray]:
    """10-bit readings of presses that come and go within a second at 90 frames a second."""
    random = np.random.default_rng(size)
    shape = (size, size)
    top, bottom = (ohm * np.exp(0.1 * random.standard_normal(shape)) for ohm in (100.0, 200.0))
    rest = 1e-6 * np.exp(0.1 * random.standard_normal(shape))
    pressed = np.exp(-random.uniform(np.log(2e3), np.log(1e5), shape)) * (
        random.random(shape) < 0.6
    )
    phase, turns = random.random(shape), random.uniform(0.5, 1.5, shape)
    for frame in range(frames):
        force = np.maximum(0, np.sin(2 * np.pi * (turns * frame / frames + phase))) ** 2
        ratio = readings(Skin(rest + force * pressed, top, bottom))
        yield ratio_from_codes(quantise(ratio, 10), 10)


def print_convergence(sizes: list[int]) -> None:
    print("\nconverged, iterations and time a frame (median; largest), all steps together")
    for method in (LsqEstimator, RegularizedEstimator):
        for name in ("random_2x2", "wire_sweep_3x3", "cell_sweep_3x3"):
            for adc_bits in (None, 10):
                ratio, _ = frames_of(name)
                if adc_bits:
                    ratio = ratio_from_codes(quantise(ratio, adc_bits), adc_bits)
                estimator = method(SkinKnowledge(ratio.shape[1], ratio.shape[2], adc_bits=adc_bits))
                what = f"{name}, {'10 bit' if adc_bits else 'exact'}, cold"
                print_times(estimator, what, ratio, cold=True)
        for size in sizes:
            estimator = method(SkinKnowledge(size, size, adc_bits=10))
            print_times(estimator, f"presses, {size}x{size}, warm", moving_presses(size))


def random_scenes(size: int, scenes: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """10-bit readings and cells [ohm]: none to all touched, 1 to 300 kilohm, wires that vary."""
    random = np.random.default_rng(size)
    shape = (size, size)
    for _ in range(scenes):
        cell_ohm = 1e6 * np.exp(0.1 * random.standard_normal(shape))
        pressed_ohm = np.exp(random.uniform(np.log(1e3), np.log(3e5), shape))
        touched = random.random(shape) < random.random()
        cell_ohm = np.where(touched, pressed_ohm, cell_ohm)
        top, bottom = (ohm * np.exp(0.3 * random.standard_normal(shape)) for ohm in (100.0, 200.0))
        ratio = readings(Skin(1 / cell_ohm, top, bottom))
        yield ratio_from_codes(quantise(ratio, 10), 10), cell_ohm


def print_reliability(sizes: list[int]) -> None:
    print("\nrandom scenes, 10 bit, cold: scenes, converged, of these with a cell wrong by 1 Mohm")
    for method in (LsqEstimator, RegularizedEstimator):
        for size in sizes:
            estimator = method(SkinKnowledge(size, size, adc_bits=10))
            scenes = converged = wrong = 0
            for ratio, cell_ohm in random_scenes(size, 100 if size == 2 else 40):
                estimator.reset()
                found = estimator.estimate(ratio)
                scenes += 1
                converged += found.converged
                wrong += found.converged and bool(np.abs(found.cell_ohm - cell_ohm).max() > 1e6)
            print(f"{method.name:11} {size}x{size} {scenes:4} {converged:4} {wrong:3}")


def print_times(
    estimator: Estimator, what: str, frames: np.ndarray | Iterator[np.ndarray], cold: bool = False
) -> None:
    found = []
    for ratio in frames:
        if cold:
            estimator.reset()
        found.append(estimator.estimate(ratio))
    iterations = [each.iterations for each in found]
    milliseconds = [1e3 * each.seconds for each in found]
    print(
        f"{estimator.name:11} {what:28} {sum(each.converged for each in found):3} of {len(found):2}"
        f"  {np.median(iterations):4.0f}; {max(iterations):3}"
        f"  {np.median(milliseconds):6.1f}; {max(milliseconds):6.1f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--start-wire-ohm", type=float, default=100.0, help="step 2's 'zero'")
    parser.add_argument("--size", type=int, action="append", help="of the moving presses (2, 3)")
    arguments = parser.parse_args()
    PaperEstimator.start_wire_megohm = arguments.start_wire_ohm / 1e6
    print_errors()
    print_convergence(arguments.size or [2, 3])
    print_reliability(arguments.size or [2, 3])


if __name__ == "__main__":
    main()
