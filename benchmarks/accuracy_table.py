# SPDX-License-Identifier: Apache-2.0
"""Print the tables of docs/accuracy.md, as Markdown, and one JSON object as the last line.

    python benchmarks/accuracy_table.py

Everything is simulated. The paper's sweeps are readings made with ngspice (tests/data), one frame
per condition, cold; `joint` and `touch` are told rest readings and nominal wires, the others
nothing. Without one of these: 20 random 8x8 skins of 20 frames, up to 8 touches, 10 bit, in order.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ohmskin.arrays import Float
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.record.readings import Readings, estimate_file, load_readings
from studies.published import CONDITIONS_MEGOHM, RMSE_MEGOHM
from studies.trials import Trial, random_trial

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
PAPER_NAMES = {"ohm": "naive", "lsq": "least squares", "regularized": "regularized"}
SWEPT = {"cell_sweep": "pressed cells", "wire_sweep": "wires"}
SKINS, FRAMES, TOUCHES, SEED = 20, 20, 8, 2000


def ten_bits(exact: Readings) -> Readings:
    assert exact.rest_ratio is not None
    ratio, rest = (ratio_from_codes(quantise(each)) for each in (exact.ratio, exact.rest_ratio))
    return replace(exact, ratio=ratio, rest_ratio=rest, adc_bits=10)


def table(headings: list[str], rows: list[list[str]]) -> None:
    print("| " + " | ".join(headings) + " |")
    print("|" + "---|" * len(headings))
    for row in rows:
        print("| " + " | ".join(row) + " |")
    print()


def sweep_rmse(sweep: str, method: str, *, exact: bool = True) -> Float:
    """RMSE over the cells of each condition [megohm]."""
    readings = load_readings(DATA / f"{sweep}_3x3.npz")
    if method not in ("joint", "touch"):
        readings = replace(
            readings, rest_ratio=None, nominal_top_wire_ohm=None, nominal_bottom_wire_ohm=None
        )
    elif not exact:
        readings = ten_bits(readings)
    out = estimate_file(readings, method, cold=True)
    with np.load(DATA / f"{sweep}_3x3.npz", allow_pickle=False) as file:
        square = (out["cell_ohm"] - file["cell_ohm"]) ** 2
    return np.asarray(1e-6 * np.sqrt(np.mean(square, axis=(1, 2))))


def print_sweeps() -> dict[str, dict[str, list[float]]]:
    found: dict[str, dict[str, list[float]]] = {}
    for sweep, paper in RMSE_MEGOHM.items():
        print(f"RMSE [Mohm] over the nine cells, exact readings; swept: {SWEPT[sweep]} [Mohm]\n")
        rows = [[f"paper: {PAPER_NAMES[name]}", *map(cell, each)] for name, each in paper.items()]
        ours = {
            method: sweep_rmse(sweep, method)
            for method in ("ohm", "matrix", "lsq", "regularized", "joint", "touch")
        }
        ours["joint, 10 bit"] = sweep_rmse(sweep, "joint", exact=False)
        rows += [[f"`{name}`", *map(cell, each)] for name, each in ours.items()]
        table(["", *map(str, CONDITIONS_MEGOHM[sweep])], rows)
        found[sweep] = {name: [round(float(x), 6) for x in each] for name, each in ours.items()}
    return found


def cell(value: float) -> str:
    return f"{value:.4f}"


def told(trial: Trial, *, rest: bool, wires: bool) -> Readings:
    """Readings of 10 bit with what is told of the skin."""
    readings = trial.rounded(10)
    if not rest:
        readings = replace(readings, rest_ratio=None)
    if not wires:
        readings = replace(readings, nominal_top_wire_ohm=None, nominal_bottom_wire_ohm=None)
    return readings


def print_knowledge() -> dict[str, dict[str, float]]:
    print("8x8, up to 8 touches, 10 bit: what becomes of a method that is told less\n")
    trials = [random_trial(8, 8, TOUCHES, FRAMES, SEED + number) for number in range(SKINS)]
    found = {}
    rows = []
    cases = [
        ("ohm", True, True),
        ("matrix", True, True),
        *((method, *case) for method in ("joint", "touch") for case in CASES),
    ]
    for method, rest, wires in cases:
        errors, ghosts, away, converged = [], [], [], []
        for trial in trials:
            out = estimate_file(told(trial, rest=rest, wires=wires), method)
            error = out["cell_siemens"] - trial.cell_siemens
            errors.append(np.abs(error / trial.cell_siemens)[trial.pressed])
            above = np.where(trial.pressed, 0.0, out["cell_siemens"] - trial.rest.cell_siemens)
            ghosts.append(above.max(axis=(1, 2)))
            away.append(np.abs(error / out["cell_siemens_std"]).ravel())
            converged.append(out["converged"])
        relative = 100 * np.concatenate(errors)
        figures = {
            "median_percent": round(float(np.median(relative)), 2),
            "p90_percent": round(float(np.percentile(relative, 90)), 1),
            "ghost_p95_us": round(1e6 * float(np.percentile(np.concatenate(ghosts), 95)), 2),
            "within_4_std_percent": round(100 * float(np.mean(np.concatenate(away) < 4)), 1),
            "converged_percent": round(100 * float(np.mean(np.concatenate(converged))), 1),
        }
        name = KNOWN[rest, wires] if method in ("joint", "touch") else "uses none of it"
        found[f"{method}, {name}"] = figures
        rows.append([f"`{method}`", name, *map(str, figures.values())])
    table(
        ["method", "told", "median error [%]", "90th percentile [%]", "ghost, 95 % of frames [uS]",
         "errors within 4 std [%]", "converged [%]"],
        rows,
    )  # fmt: skip
    return found


CASES = ((True, True), (True, False), (False, True), (False, False))
KNOWN = {
    (True, True): "rest readings, nominal wires",
    (True, False): "rest readings",
    (False, True): "nominal wires",
    (False, False): "nothing",
}


def main() -> int:
    print(json.dumps({"sweeps": print_sweeps(), "told": print_knowledge()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
