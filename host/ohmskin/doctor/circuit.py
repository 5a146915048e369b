# SPDX-License-Identifier: Apache-2.0
"""Lines, cells and reference resistors, from the mean readings of a skin at rest.

Symbols

====== ======== ============================================================================
symbol shape    meaning
====== ======== ============================================================================
n      (R, C)   mean current of a port in codes: of B, D, and of what A and C lack to Vdd
g      (R, C)   cell conductances by the method `matrix`, lines that are open left out [S]
====== ======== ============================================================================

The rules, in this order; each leaves out what those before it have found:

- A line is open if no port of it draws current. If it has one port only, its cell may be dead.
- Two lines are shorted if their ports draw the same currents and if `matrix`, which knows nothing
  of a short, finds twice the conductance of other lines in both. Where there are no other lines,
  it is enough that many ports agree.
- A cell is dead if its g is far below that of other cells. A cell whose row and whose column have a
  touched cell is not judged, because little current goes through it.
- A cell whose g is above that of other cells is touched, or saturated if 1/g is no more than the
  wires to it.

By reciprocity a port has the same resistance in both directions, so R_top / R_bottom is the sum of
what A and D show over that of B and C. The readings are ratios: a factor common to all resistances,
references included, changes none of them and cannot be known.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.skin import READING_SENSES_TOP, READING_SIGN
from ohmskin.doctor.findings import Diagnosis, Kind, Place, lines_of
from ohmskin.doctor.signal import Rest
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator

WIRE_OHM: Final = (100.0, 200.0)  # [ohm] Top and bottom segments are so unless told otherwise.

# Open lines.
DARK_LSB: Final = 0.7  # [LSB] No current is read as less than this, because of rounding.
DARK_NOISE: Final = 0.4  # [1] Noise adds this share of itself, because no code is below zero.
OFFSET_LSB: Final = 2.5  # [LSB] The converter's offset makes no current look like up to this.
DARK_SHARE: Final = 0.08  # [1] No more than this share of the usual current is taken for offset.

# Shorted lines.
ALIKE_LSB: Final = 0.05  # [LSB] Mean readings of shorted lines differ by less, besides noise.
ALIKE_STDS: Final = 6.0  # [deviations] The noise of hundreds of readings does not reach this.
DOUBLED: Final = 1.4  # [1] `matrix` finds shorted lines more conductive by this; 2 is expected.
ALIKE_PORTS: Final = 5  # [ports] So many do not agree by chance.
RISE_STDS: Final = 3.0  # [deviations] With fewer, the rise must stand out of all lines' scatter.

# Dead cells.
DEAD_SHARE: Final = 0.3  # [1] A dead cell has less than this share of the usual conductance.
CLEAR_STDS: Final = 5.0  # [deviations] Beside a touch, a dead cell is below that by this.

# Touched and saturated cells.
REST_QUANTILE: Final = 0.25  # [1] This share of the cells, at least, is taken to be at rest.
MOST_AT_REST_SIEMENS: Final = 5e-6  # [S] No cell at rest conducts more; 1e-6 is usual.
TOUCHED_SHARE: Final = 2.0  # [1] A touched cell conducts more than one at rest by this factor.
TOUCHED_STDS: Final = 5.0  # [deviations] It also stands out of the scatter at rest by this.
MANY_CELLS: Final = 8  # [cells] The scatter of fewer cells is not known.
MOST_SPREAD: Final = 0.4  # [log] Cells at rest scatter less: a wider scatter is of touches.
SHORTED_OHM: Final = 350.0  # [ohm] A saturated cell has less: the hardest touch has 300.
WIRE_SPREAD: Final = 1.15  # [1] The wires to a cell are over nominal by less: segments scatter.

# Reference resistors.
RATIO_TOLERANCE: Final = 0.03  # [1] The ratio of two resistors of 1 % is off by up to 2 %.
RATIO_STDS: Final = 3.0  # [deviations] Noise and rounding change the ratio by less than this.


def examine_circuit(rest: Rest, diagnosis: Diagnosis) -> tuple[Bool, Bool]:
    """Adds lines, cells and references to a diagnosis. Returns two masks of cells, (R, C): those
    that are touched, and those that are dead or saturated or have an open or shorted line.

    Shorted lines and dead cells are not judged while something moves on the skin.
    """
    noise_lsb, full = rest.noise_lsb, (1 << rest.board.adc_bits) - 1
    shown = np.where(READING_SIGN > 0, rest.codes, full - rest.codes)
    current = shown.mean(axis=2)
    rows, columns = current.shape
    usual = float(np.median(current))
    least = max(DARK_LSB + DARK_NOISE * noise_lsb, min(OFFSET_LSB, DARK_SHARE * usual))
    dark = current < least
    shorted = np.zeros(current.shape, dtype=np.bool_)
    if dark.all():
        diagnosis.add(Kind.NOTHING_CONDUCTS, one_cell=dark.size == 1)
        diagnosis.measured |= {"reference_ratio": None, "cell_ohm": None}
        return shorted, dark
    no_row, no_column = dark.all(axis=1), dark.all(axis=0)
    if no_row.any():
        place = Place(rows=lines_of(no_row))
        diagnosis.add(Kind.OPEN_ROW, place, line_count=rows, cells_per_line=columns)
    if no_column.any():
        place = Place(columns=lines_of(no_column))
        diagnosis.add(Kind.OPEN_COLUMN, place, line_count=columns, cells_per_line=rows)
    out = no_row[:, None] | no_column
    siemens, siemens_std = _cells(rest, no_row, no_column)
    if not rest.moves:
        std = noise_lsb / (4 * rest.scans) ** 0.5
        for group in _shorted(current, siemens, std, out):
            diagnosis.add(Kind.SHORT_ROWS, Place(rows=tuple(group)))
            shorted[group] = no_row[group[1:]] = True
        for group in _shorted(current.T, siemens.T, std, out.T):
            diagnosis.add(Kind.SHORT_COLUMNS, Place(columns=tuple(group)))
            shorted[:, group] = no_column[group[1:]] = True
        if shorted.any():
            # Shorted lines are one: the network without the others is right for all other cells.
            siemens, siemens_std = _cells(rest, no_row, no_column)
    wrong = out | shorted
    touched, bad = _judge_cells(siemens, siemens_std, ~wrong, rest, diagnosis)
    ratio = _reference_ratio(shown[~dark], rest, diagnosis)
    cell_ohm = 1 / np.nanmedian(siemens)
    diagnosis.measured |= {"reference_ratio": round(ratio, 4), "cell_ohm": float(f"{cell_ohm:.3g}")}
    return touched, wrong | bad


def _cells(rest: Rest, no_row: Bool, no_column: Bool) -> tuple[Float, Float]:
    """Conductances and their deviations, (R, C) [S], NaN in the lines that are left out."""
    kept = np.ix_(~no_row, ~no_column)
    ratio = rest.ratio[kept]
    rest_of_board = replace(rest.board, rows=ratio.shape[0], columns=ratio.shape[1])
    estimate = make_estimator("matrix", SkinKnowledge.of(rest_of_board)).estimate(ratio)
    siemens, std = np.full((2, *rest.codes.shape[:2]), np.nan)
    siemens[kept], std[kept] = estimate.cell_siemens, estimate.cell_siemens_std
    return siemens, std


def _shorted(current: Float, siemens: Float, std: float, out: Bool) -> list[list[int]]:
    """Groups of lines that are one electrode; the arrays are (lines, ports)."""
    lines, ports = np.flatnonzero(~out.all(axis=1)), np.flatnonzero(~out.all(axis=0))
    current, siemens = current[np.ix_(lines, ports)], siemens[np.ix_(lines, ports)]
    apart = np.abs(current[:, None] - current[None, :]).max(axis=2)
    alike = apart < ALIKE_LSB + ALIKE_STDS * std * 2**0.5
    level, few = np.median(siemens, axis=1), len(ports) < ALIKE_PORTS
    groups: list[list[int]] = []
    for line in range(len(lines)):
        members = [line, *np.flatnonzero(alike[line, line + 1 :]) + line + 1]
        if len(members) < 2 or any(int(lines[line]) in group for group in groups):
            continue
        is_short, others = not few, np.log(np.delete(level, members))
        if len(others):
            rise = float(np.log(level[members].min()) - np.median(others))
            is_short = rise > max(np.log(DOUBLED), RISE_STDS * few * float(np.std(others)))
        if is_short:
            groups.append([int(lines[member]) for member in members])
    return groups


def _judge_cells(
    siemens: Float, std: Float, judged: Bool, rest: Rest, diagnosis: Diagnosis
) -> tuple[Bool, Bool]:
    """Adds dead and saturated cells. Returns touched cells, and these."""
    dead: Bool = np.zeros(siemens.shape, dtype=np.bool_)
    if not judged.any():
        return dead, dead
    level = min(float(np.quantile(siemens[judged], REST_QUANTILE)), MOST_AT_REST_SIEMENS)
    share = TOUCHED_SHARE
    if judged.sum() >= MANY_CELLS:  # cells at rest differ
        lower, middle = np.quantile(siemens[judged], (0.16, 0.5))  # one deviation apart
        spread = min(float(np.log(middle / lower)), MOST_SPREAD)
        share = max(share, float(np.exp(TOUCHED_STDS * spread)))
    high: Bool = judged & (siemens > share * level)
    if not rest.moves and high.sum() < judged.sum() > 1:
        usual = float(np.median(siemens[judged & ~high]))
        hidden = np.logical_and.outer(high.any(axis=1), high.any(axis=0))
        # Untouched cells are well known; their deviation has what a wrong reference does to it.
        doubt = CLEAR_STDS * std if high.any() else 0.0
        dead = np.asarray(judged & ~hidden & (siemens + doubt < DEAD_SHARE * usual))
    if dead.any():
        percent = 100 * float(np.max(siemens[dead] / usual))
        diagnosis.add(Kind.DEAD_CELL, Place.of_cells(dead), percent_of_usual=percent)
    rows, columns = siemens.shape
    top, bottom = rest.wire_ohm
    path_ohm = bottom * np.arange(1, rows + 1)[:, None] + top * np.arange(1, columns + 1)
    saturated = high & (siemens * (WIRE_SPREAD * path_ohm + SHORTED_OHM) > 1)
    if saturated.any():
        place, ohm = Place.of_cells(saturated), float(np.max(1 / siemens[saturated]))
        diagnosis.add(Kind.SATURATED_CELL, place, cell_ohm=ohm, rest_megohm=1e-6 / level)
    return high & ~saturated, dead | saturated


def _reference_ratio(lit: Float, rest: Rest, diagnosis: Diagnosis) -> float:
    """R_top / R_bottom. Adds a finding if it is far from what the board says.

    lit: what the ports (P, 4) with a current show of it [LSB].
    """
    ratio = float(lit[:, READING_SENSES_TOP].sum() / lit[:, ~READING_SENSES_TOP].sum())
    # Of A and D, one rounds as the other; the same of B and C.
    ratio_std = rest.std_lsb * 2**0.5 / (float(lit.mean()) * len(lit) ** 0.5)
    top, bottom = rest.board.ref_top_ohm, rest.board.ref_bottom_ohm
    off = ratio * bottom / top - 1
    doubt = RATIO_STDS * ratio_std + 2 * rest.offset_lsb / float(lit.mean())
    if abs(off) >= RATIO_TOLERANCE + doubt:
        nominal = {"ref_top_ohm": top, "ref_bottom_ohm": bottom}
        diagnosis.add(Kind.REFERENCE_RATIO, ratio=ratio, off_percent=100 * off, **nominal)
    return ratio
