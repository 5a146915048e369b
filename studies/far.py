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

Rest readings are told, and that there are no leads; nominal wires only where a readout's line says
so. Segments are spread by 10 % about the nominal value. Estimators start each frame anew. Sweeps:
`wires`, a segment of a row (one of a column has twice as much); `bend`, all wires are so many times
those of the rest readings and of the nominal wires.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from threadpoolctl import threadpool_limits

from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, TOP_WIRE_OHM
from ohmskin.record.readings import estimate_file
from studies import zero_potential
from studies.drawing import INK, new_figure, png_of, prepare, write_notes, write_plain_numbers
from studies.judge import Answers, judge_trial, pooled
from studies.rows import Progress, Steps, as_csv, field_names
from studies.trials import BEND, Trial, finger_trial, skin_at_rest, stretched, touch, trial_of

NEAR, NEAR_TOLD, FAR = "near", "near, told", "far"
ZERO, ZERO_BEST = "zero", "zero, best scale"
ZERO_PATH, ZERO_SOLVED = "zero, less path", "zero, solved"
ESTIMATED: Final = (NEAR, NEAR_TOLD, FAR)  # readouts that state deviations
READOUTS: Final = (*ESTIMATED, ZERO, ZERO_BEST, ZERO_PATH, ZERO_SOLVED)
METHOD: Final = "joint"
SCENES: Final = ("one touch", "eight touches", "fingertip")
BY_WIRES, BY_BEND = "wires", "bend"  # the sweeps
SIZE: Final = 8  # rows, and columns
BITS: Final = (10, 12)  # of the converter: the board's, and a better one
# A wire segment of a row [ohm], in the sweep by wires. Chosen: from a good conductive yarn to what
# near ends do not see through.
WIRE_OHM: Final = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
# Wires over those of the flat skin, in the sweep by bends. Chosen: up to more than the usual bend.
BENDS: Final = (1.0, 1.1, 1.2, BEND, 1.5)
# A wire segment of a row [ohm] in that sweep.
BENT_OHM: Final = TOP_WIRE_OHM
# A wire segment of a column over one of a row, in both sweeps.
COLUMN_OVER_ROW: Final = BOTTOM_WIRE_OHM / TOP_WIRE_OHM
# A fingertip's pressure: least and largest standard deviation, and peak. Those of tests/data/far.
FINGER_CELLS: Final = (0.75, 0.9)
FINGER_SIEMENS: Final = (3e-5, 1.5e-4)  # as bench_fingers has it, too


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    skins: of each condition.
    frames: of each skin.
    """

    skins: int
    frames: int


FULL: Final = Plan(skins=4, frames=20)
QUICK: Final = Plan(skins=1, frames=8)


@dataclass(frozen=True)
class Row:
    """One readout under one condition; a line of the CSV.

    sweep: "wires" or "bend".
    scene, bits, readout: what is read, in so many bits, and how.
    wire_ohm: a segment of a row before the bend [ohm].
    bend: factor of all wires since the rest readings.
    pressed_cells: how many there were in all frames.
    error_percent, error_p90_percent: of their conductance, median and 90th percentile.
    ghost_us: largest conductance above the true one of cells that are not pressed [uS], 95th
    percentile of the frames.
    within_4_percent: pressed cells within 4 stated deviations; None where nothing is stated.
    trusted_percent: frames that the method calls converged; None where nothing is stated.
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
    steps = Steps(len(conditions), progress)
    with threadpool_limits(limits=1):
        for sweep, scene, wire_ohm, bend in conditions:
            trials = [
                _trial(scene, wire_ohm, bend, plan.frames, seed) for seed in range(plan.skins)
            ]
            for bits in BITS:
                for readout in READOUTS:
                    judged = pooled(
                        judge_trial(_read(readout, trial, bits), trial) for trial in trials
                    )
                    states = readout in ESTIMATED
                    row = Row(
                        *(sweep, scene, wire_ohm, bend, bits, readout, judged.relative.size),
                        error_percent=judged.error_percent(),
                        error_p90_percent=judged.error_percent(0.9),
                        ghost_us=judged.ghost_us(),
                        within_4_percent=judged.pressed_within_percent() if states else None,
                        trusted_percent=judged.converged_percent() if states else None,
                    )
                    rows.append(row)
            steps.done()
    return rows


def _conditions() -> Iterator[tuple[str, str, float, float]]:
    for scene in SCENES:
        for wire_ohm in WIRE_OHM:
            yield BY_WIRES, scene, wire_ohm, 1.0
    for bend in BENDS:
        yield BY_BEND, SCENES[1], BENT_OHM, bend


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


def _read(readout: str, trial: Trial, bits: int) -> Answers:
    if readout in ESTIMATED:
        mode = "far" if readout == FAR else "near"
        readings = trial.rounded(bits, mode=mode, wires_told=readout == NEAR_TOLD)
        return estimate_file(readings, METHOD, cold=True)
    exact = np.array([zero_potential.currents(skin) for skin in trial.frames])
    scale = zero_potential.USUAL_SIEMENS if readout == ZERO else float(exact.max()) * (1 + 1e-9)
    siemens = zero_potential.converted(exact, scale, bits)
    wires = trial.readings.knowledge(0).nominal_wire_ohm.both
    assert wires is not None
    if readout == ZERO_PATH:
        siemens = zero_potential.less_path(siemens, wires)
    if readout == ZERO_SOLVED:
        siemens = np.array([zero_potential.solved(frame, wires) for frame in siemens])
    return {"cell_siemens": siemens}


# ---------------------------------------------------------------------------------------- words


def csv_text(rows: Iterable[Row]) -> str:
    """The rows as CSV, columns named after the fields of `Row`."""
    return as_csv(field_names(Row), map(astuple, rows))


def tables(rows: Iterable[Row]) -> str:
    """Median and 90th percentile of the error [%], as tables in Markdown: those of the page."""
    by_place = {
        (row.sweep, row.scene, row.wire_ohm, row.bend, row.bits, row.readout): row for row in rows
    }
    blocks = []
    for bits in BITS:
        places = [
            (f"{scene}, {wire:g}/{COLUMN_OVER_ROW * wire:g} ohm", BY_WIRES, scene, wire, 1.0)
            for scene in SCENES
            for wire in (100.0, 1000.0)
        ]
        bent = f"eight touches, 100/200 ohm, bent by {BEND}"
        places.append((bent, BY_BEND, SCENES[1], BENT_OHM, BEND))
        lines = [
            f"| {bits} bit: error of a pressed cell [%] | " + " | ".join(READOUTS) + " |",
            "|---" * (len(READOUTS) + 1) + "|",
        ]
        for name, sweep, scene, wire_ohm, bend in places:
            cells = []
            for readout in READOUTS:
                row = by_place[sweep, scene, wire_ohm, bend, bits, readout]
                cells.append(f"{row.error_percent:.2g}, {row.error_p90_percent:.2g}")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


# -------------------------------------------------------------------------------------- picture

_STYLES: Final[dict[str, dict[str, Any]]] = {
    FAR: {"color": "#009e73", "marker": "o", "linewidth": 2.2, "label": "far ends, nothing told"},
    NEAR: {"color": "#d55e00", "marker": "v", "label": "near ends, nothing told"},
    NEAR_TOLD: {"color": "#e69f00", "marker": "^", "label": "near ends, wires told"},
    ZERO_BEST: {"color": "#666666", "marker": "s", "label": "zero potential, as read"},
    ZERO_PATH: {"color": "#56b4e9", "marker": "D", "label": "…, less the wires told"},
    ZERO_SOLVED: {"color": "#0072b2", "marker": "P", "label": "…, solved with the wires told"},
}
# Readouts are drawn beside each other, at places that differ by this factor: else bars hide bars.
_APART: Final = {BY_WIRES: 1.06, BY_BEND: 1.006}
_LIMITS_PERCENT: Final = (0.03, 200.0)  # of the axis of errors: all medians are inside
_NOTE: Final = (
    "Simulation: 8x8 cells, 1 MΩ at rest, touches of 1 to 100 kΩ at random places, or a fingertip "
    "over some 20 cells; wire segments spread by 10 %. Told: the middle of the segments of each "
    "layer, of the unbent skin. Estimator: 'joint', each frame anew. Zero potential: ideal "
    "amplifiers, and the least full scale that holds all frames of the skin. Markers: median; pale "
    "bars: up to the 90th percentile."
)


def picture(rows: Sequence[Row]) -> bytes:
    """The rows of `far.measure` as a PNG."""
    figure = new_figure(15.0, 7.6)
    grid = figure.subplots(len(BITS), len(SCENES) + 1, sharey=True, squeeze=False)
    for bits, line in zip(BITS, grid, strict=True):
        for axes, scene in zip(line, SCENES, strict=False):
            chosen = [
                row for row in rows if (row.sweep, row.scene, row.bits) == (BY_WIRES, scene, bits)
            ]
            _panel(axes, chosen, BY_WIRES)
        _panel(line[-1], [row for row in rows if (row.sweep, row.bits) == (BY_BEND, bits)], BY_BEND)
        line[0].set_ylabel(f"{bits} bit\nerror of a pressed cell [%]", color=INK)
    for axes, title in zip(grid[0], (*SCENES, f"{SCENES[1]}, the skin bent"), strict=True):
        axes.set_title(title, fontsize=11.5, color=INK)
    for axes in grid[-1, :-1]:
        axes.set_xlabel(f"row segment [Ω]; column: x {COLUMN_OVER_ROW:g}", color=INK)
    grid[-1, -1].set_xlabel(
        f"all wires over those at rest ({BENT_OHM:g} and {COLUMN_OVER_ROW * BENT_OHM:g} Ω)",
        color=INK,
    )
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    write_notes(figure, [_NOTE], 170)
    return png_of(figure)


def _panel(axes: Axes, rows: Sequence[Row], sweep: str) -> None:
    """Medians as lines, and bars up to the 90th percentiles."""
    axes.set_yscale("log")
    axes.set_ylim(*_LIMITS_PERCENT)
    if sweep == BY_WIRES:
        axes.set_xscale("log")
    prepare(axes)
    for number, (readout, style) in enumerate(_STYLES.items()):
        of_readout = [row for row in rows if row.readout == readout]
        shift = _APART[sweep] ** (number - (len(_STYLES) - 1) / 2)
        places = [shift * (row.wire_ohm if sweep == BY_WIRES else row.bend) for row in of_readout]
        medians = [row.error_percent for row in of_readout]
        tails = [row.error_p90_percent for row in of_readout]
        axes.plot(places, medians, **{"linewidth": 1.2, "markersize": 5.0, **style})
        axes.vlines(places, medians, tails, color=style["color"], alpha=0.3, linewidth=3.5)
    write_plain_numbers(axes.xaxis, axes.yaxis)
    if sweep == BY_BEND:
        axes.set_xticks(sorted({row.bend for row in rows}))
