# SPDX-License-Identifier: Apache-2.0
"""What sensing both ends of the lines gains, on simulated skins. Simulation, all of it.

Readouts of the same frames of the same 8x8 skins (`trials`; random touches, or a fingertip):

=================== =======================================================================
`near`              readings a to d, `joint`, nobody knows the wires
`near, told`        the same, the middle of the wires of each layer is told
`far`               readings a, e, b, f, `joint`, nobody knows the wires
`zero`              zero-potential readout over 1 mS, as read (`zero_potential`)
`zero, best scale`  the same over the least full scale that no reading of the skin exceeds
`zero, less path`   `best scale`, the nominal wires between electrodes and cell subtracted
`zero, solved`      `best scale`, the cells that explain all currents with the nominal wires
=================== =======================================================================

Rest readings are told, nominal wires only where a readout's line says so. Segments are spread by 10
% about the nominal value. Estimators start each frame anew. Sweeps: `wires`, a segment of a row
(one of a column has twice as much); `bend`, all wires are so many times those of the rest readings
and of the nominal wires.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ohmskin.arrays import Float
from ohmskin.circuit.skin import all_readings, end_admittance
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ENUMS, MODES
from ohmskin.record.readings import Readings, estimate_file
from studies import zero_potential
from studies.trials import Trial, finger_trial, skin_at_rest, stretched, touch, trial_of

NEAR, NEAR_TOLD, FAR = "near", "near, told", "far"
ZERO, ZERO_BEST = "zero", "zero, best scale"
ZERO_PATH, ZERO_SOLVED = "zero, less path", "zero, solved"
READOUTS: Final = (NEAR, NEAR_TOLD, FAR, ZERO, ZERO_BEST, ZERO_PATH, ZERO_SOLVED)
METHOD: Final = "joint"
SCENES: Final = ("one touch", "eight touches", "fingertip")
WIRES, BEND = "wires", "bend"
SIZE: Final = 8
BITS: Final = (10, 12)
WIRE_OHM: Final = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
BENDS: Final = (1.0, 1.1, 1.2, 1.35, 1.5)
BENT_OHM: Final = 100.0
COLUMN_OVER_ROW: Final = 2.0
FINGER_CELLS: Final = (0.75, 0.9)
FINGER_SIEMENS: Final = (3e-5, 1.5e-4)
_NAMES: Final = list(ENUMS["reading"].values)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Plan:
    """How many skins of each condition, and how many frames of each."""

    skins: int
    frames: int


FULL: Final = Plan(skins=4, frames=20)
QUICK: Final = Plan(skins=1, frames=8)


@dataclass(frozen=True)
class Row:
    """One readout under one condition; a line of the CSV.

    sweep: "wires" or "bend". wire_ohm: a segment of a row [ohm], before the bend. bend: factor of
    all wires since the rest readings. error_percent, error_p90_percent: of the conductance of
    pressed cells, median and 90th percentile. ghost_us: largest conductance above the true one of
    cells that are not pressed [uS], 95th percentile of the frames. within_4_percent: pressed cells
    within 4 stated deviations; trusted_percent: frames that the method calls converged; None where
    nothing is stated.
    """

    sweep: str
    scene: str
    wire_ohm: float
    bend: float
    bits: int
    readout: str
    pressed_cells: int
    error_percent: float
    error_p90_percent: float
    ghost_us: float
    within_4_percent: float | None = None
    trusted_percent: float | None = None


# ------------------------------------------------------------------------------------ measuring


def measure(plan: Plan, progress: Progress | None = None) -> list[Row]:
    """All readouts under all conditions. `progress(done, conditions)` is called after each."""
    conditions = list(_conditions())
    rows: list[Row] = []
    with threadpool_limits(limits=1):
        for done, (sweep, scene, wire_ohm, bend) in enumerate(conditions, start=1):
            trials = [
                _trial(scene, wire_ohm, bend, plan.frames, seed) for seed in range(plan.skins)
            ]
            for bits in BITS:
                for readout in READOUTS:
                    judged = _Judged()
                    for trial in trials:
                        judged.add(trial, *_read(readout, trial, bits))
                    rows.append(judged.row(sweep, scene, wire_ohm, bend, bits, readout))
            if progress is not None:
                progress(done, len(conditions))
    return rows


def _conditions() -> Iterator[tuple[str, str, float, float]]:
    for scene in SCENES:
        for wire_ohm in WIRE_OHM:
            yield WIRES, scene, wire_ohm, 1.0
    for bend in BENDS:
        yield BEND, SCENES[1], BENT_OHM, bend


def seen(trial: Trial, mode: str, bits: int | None, *, told: bool = False) -> Readings:
    """The trial's readings in a mode; its nominal wires only if they are told. bits None: exact."""
    chosen = [_NAMES.index(name) for name in MODES[mode]]
    exact = [
        all_readings(skin, end_admittance(skin))[..., chosen]
        for skin in (trial.rest, *trial.frames)
    ]
    if bits is not None:
        exact = [ratio_from_codes(quantise(each, bits), bits) for each in exact]
    rest, *frames = exact
    readings = replace(
        trial.readings,
        ratio=np.array(frames),
        rest_ratio=rest,
        adc_bits=bits,
        reading_names=MODES[mode],
    )
    if told:
        return readings
    return replace(readings, nominal_top_wire_ohm=None, nominal_bottom_wire_ohm=None)


def _trial(scene: str, wire_ohm: float, bend: float, frames: int, seed: int) -> Trial:
    """Frames of a skin: the same touches at all wires."""
    wires = (wire_ohm, COLUMN_OVER_ROW * wire_ohm)
    if scene == "fingertip":
        trial = finger_trial(
            *(SIZE, SIZE, frames, 2 * seed),  # even: one fingertip
            sigma_cells=FINGER_CELLS,
            peak_siemens=FINGER_SIEMENS,
            wire_ohm=wires,
        )
        rest, skins = trial.rest, list(trial.frames)
    else:
        random = np.random.default_rng(seed)
        rest = skin_at_rest(SIZE, SIZE, random, wire_ohm=wires)
        touches = 1 if scene == "one touch" else 8
        skins = [touch(rest, touches, random) for _ in range(frames)]
    return trial_of(rest, [stretched(skin, bend) for skin in skins], wires)


_Answer = tuple[Float, Float | None, NDArray[np.bool_] | None]


def _read(readout: str, trial: Trial, bits: int) -> _Answer:
    """Conductances (F, R, C) [S], their stated deviations, whether each frame converged (F,)."""
    if readout in (NEAR, NEAR_TOLD, FAR):
        mode = "far" if readout == FAR else "near"
        readings = seen(trial, mode, bits, told=readout == NEAR_TOLD)
        out = estimate_file(readings, METHOD, cold=True)
        return out["cell_siemens"], out["cell_siemens_std"], out["converged"]
    exact = np.array([zero_potential.currents(skin) for skin in trial.frames])
    scale = zero_potential.USUAL_SIEMENS if readout == ZERO else float(exact.max()) * (1 + 1e-9)
    siemens = zero_potential.converted(exact, scale, bits)
    top, bottom = trial.readings.nominal_top_wire_ohm, trial.readings.nominal_bottom_wire_ohm
    assert top is not None
    assert bottom is not None
    wires = float(top), float(bottom)
    if readout == ZERO_PATH:
        siemens = zero_potential.less_path(siemens, wires)
    if readout == ZERO_SOLVED:
        siemens = np.array([zero_potential.solved(frame, wires) for frame in siemens])
    return siemens, None, None


class _Judged:
    """Answers about several skins, against the truth."""

    def __init__(self) -> None:
        self._all: dict[str, list[Float]] = defaultdict(list)

    def add(
        self, trial: Trial, siemens: Float, std: Float | None, trusted: NDArray[np.bool_] | None
    ) -> None:
        truth, pressed, found = trial.cell_siemens, trial.pressed, self._all
        error = siemens - truth
        found["error"].append(np.abs(error / truth)[pressed])
        found["ghost"].append(np.where(pressed, 0.0, error).max(axis=(1, 2)))
        if std is not None and trusted is not None:
            found["within"].append((np.abs(error) < 4 * std)[pressed].astype(float))
            found["trusted"].append(trusted.astype(float))

    def row(
        self, sweep: str, scene: str, wire_ohm: float, bend: float, bits: int, readout: str
    ) -> Row:
        found = {name: np.concatenate(parts) for name, parts in self._all.items()}
        shares = [
            100 * float(found[name].mean()) if name in found else None
            for name in ("within", "trusted")
        ]
        median, p90 = np.quantile(found["error"], [0.5, 0.9])
        return Row(
            *(sweep, scene, wire_ohm, bend, bits, readout, found["error"].size),
            100 * float(median),
            100 * float(p90),
            1e6 * float(np.quantile(found["ghost"], 0.95)),
            *shares,
        )


# ---------------------------------------------------------------------------------------- words


def csv_text(rows: Iterable[Row]) -> str:
    """The rows as CSV, columns named after the fields of `Row`; None is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        cells = vars(row).values()
        writer.writerow(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in cells)
    return text.getvalue()


def tables(rows: Iterable[Row]) -> str:
    """Median and 90th percentile of the error [%], as tables in Markdown: those of the page."""
    rows = list(rows)
    blocks = []
    for bits in BITS:
        places = [
            (f"{scene}, {wire:g}/{COLUMN_OVER_ROW * wire:g} ohm", WIRES, scene, wire, 1.0)
            for scene in SCENES
            for wire in (100.0, 1000.0)
        ]
        places.append(("eight touches, 100/200 ohm, bent by 1.35", BEND, SCENES[1], BENT_OHM, 1.35))
        lines = [
            f"| {bits} bit: error of a pressed cell [%] | " + " | ".join(READOUTS) + " |",
            "|---" * (len(READOUTS) + 1) + "|",
        ]
        for name, *place in places:
            cells = []
            for readout in READOUTS:
                row = next(
                    row
                    for row in rows
                    if [row.sweep, row.scene, row.wire_ohm, row.bend, row.bits, row.readout]
                    == [*place, bits, readout]
                )
                cells.append(f"{row.error_percent:.2g}, {row.error_p90_percent:.2g}")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)
