# SPDX-License-Identifier: Apache-2.0
"""Lines, cells and reference resistors, from the mean readings of a skin at rest.

Symbols

======== ======== ==========================================================================
symbol   shape    meaning
======== ======== ==========================================================================
shown    (R,C,4)  what each reading shows of its current: B, D, and what A, C lack to Vdd [LSB]
current  (R, C)   mean of these: the current of a port [LSB]
siemens  (R, C)   conductances of the cells by the method `matrix`, open lines left out [S]
======== ======== ==========================================================================

The rules, in this order; each leaves out what those before it have found:

- A line is open if no port of it draws current. If it has one port only, its cell may be dead.
- Two lines are shorted if their ports draw the same currents, and if `matrix` finds twice the
  conductance of other lines in both: it takes them for two lines, of which each draws the current
  of both. Where there are no other lines, it is enough that many ports agree.
- A cell is dead if it conducts far less than other cells. A cell whose row and whose column have a
  touched cell is not judged, because little current goes through it.
- A cell that conducts more than other cells is touched, or saturated if its resistance is no more
  than that of the wires to it.

By reciprocity a port has the same resistance in both directions, so R_top / R_bottom is the sum of
what A and D show over that of B and C. The readings are ratios: a factor common to all resistances,
references included, changes none of them and cannot be known.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import READING_SENSES_TOP, READING_SIGN
from ohmskin.doctor import limits
from ohmskin.doctor.findings import Diagnosis, Kind, Place, lines_of
from ohmskin.doctor.signal import Rest
from ohmskin.estimate.joint import JointEstimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.prior import HIGHEST_TOUCH_SIEMENS
from ohmskin.link.protocol import LARGEST_CODE

# Open lines. A port is dark if what it shows may be noise, rounding or offset, and no current.
# [1] Noise shows as a current of this share of its deviation, since no code is below zero: the mean
# of what is above zero of normal noise is 1 / sqrt(2 pi) of its deviation.
DARK_NOISE: Final = 0.4
# [1] At most this share of the usual current is taken for offset. Chosen: no sound line draws that
# little.
DARK_SHARE: Final = 0.08

# Shorted lines.
# [LSB] Mean readings of shorted lines differ by less, noise apart. Chosen: rounding is the same.
ALIKE_LSB: Final = 0.05
# [1] `matrix` finds shorted lines more conductive than others by this factor. Chosen: between 1 and
# 2, which sound lines and shorted ones have.
DOUBLED: Final = 1.4
# [ports] Lines do not agree in so many ports by chance. Chosen: cells scatter by 10 %.
ALIKE_PORTS: Final = 5

# Touched and saturated cells.
# [1] This share of the cells, at least, is taken to be at rest. Chosen: a hand covers less.
REST_QUANTILE: Final = 0.25
# [S] No cell at rest conducts more. Chosen: 1e-6 is usual.
MOST_AT_REST_SIEMENS: Final = 5e-6
# [1] A touched cell conducts more than one at rest by this factor. Chosen: cells scatter by 10 %.
TOUCHED_SHARE: Final = 2.0
# [cells] The scatter of fewer cells is not known. Chosen: the lowest 16 % must be a cell or more.
MANY_CELLS: Final = 8
# [log] Cells at rest scatter by less: a wider scatter is of touches. Chosen: four times 10 %.
MOST_SPREAD: Final = 0.4

# Reference resistors.
# [1] The ratio of two sound ones is off by less. Chosen: two of 1 % make 2 %, and some for ageing.
RATIO_TOLERANCE: Final = 0.03


@dataclass(frozen=True, eq=False)
class LinesAndCells:
    """What the near ends of a skin show of its lines and cells.

    left_out: which rows (R,) and which columns (C,) are open, or are shorted to one before.
    shorts: groups of shorted lines by number; of rows, and of columns.
    touched: which cells are touched, (R, C).
    dead: which cells are dead, (R, C).
    wrong: which cells are dead or saturated, or in an open or a shorted line, (R, C).
    """

    left_out: tuple[Bool, Bool]
    shorts: tuple[list[list[int]], list[list[int]]]
    touched: Bool
    dead: Bool
    wrong: Bool


def examine_circuit(rest: Rest, diagnosis: Diagnosis) -> LinesAndCells:
    """Add what is wrong with lines, cells and references.

    While something moves on the skin, shorted lines and dead cells are not judged: the means then
    belong to no single state of the skin.
    """
    shown = np.where(READING_SIGN > 0, rest.codes, LARGEST_CODE - rest.codes)
    current = shown.mean(axis=2)
    # The converter's offset looks like a current, too.
    usual = float(np.median(current))
    offset_lsb = min(limits.ADC_ERROR_LSB + limits.ROUNDING_LSB, DARK_SHARE * usual)
    dark = current < max(limits.ROUNDING_LSB + DARK_NOISE * rest.noise_lsb, offset_lsb)
    left_out, none = (dark.all(axis=1), dark.all(axis=0)), np.zeros_like(dark)
    if dark.all():
        diagnosis.add(Kind.NOTHING_CONDUCTS, one_cell=dark.size == 1)
        diagnosis.measured |= {"reference_ratio": None, "cell_ohm": None}
        return LinesAndCells(left_out, ([], []), none, none, dark)
    for axis, kind in enumerate((Kind.OPEN_ROW, Kind.OPEN_COLUMN)):
        if left_out[axis].any():
            place = Place.of_lines(axis, lines_of(left_out[axis]))
            counts = {"line_count": dark.shape[axis], "cells_per_line": dark.shape[1 - axis]}
            diagnosis.add(kind, place, **counts)
    wrong = left_out[0][:, None] | left_out[1]
    siemens, siemens_std = _cells(rest, *left_out)
    shorts: tuple[list[list[int]], list[list[int]]] = ([], [])
    if not rest.moves:
        std_lsb = rest.noise_lsb / (4 * rest.scans) ** 0.5
        judged = ~wrong
        for axis, kind in enumerate((Kind.SHORT_ROWS, Kind.SHORT_COLUMNS)):
            for group in _shorted(axis, current, siemens, judged, std_lsb):
                diagnosis.add(kind, Place.of_lines(axis, group))
                shorts[axis].append(group)
                np.moveaxis(wrong, axis, 0)[group] = True
                left_out[axis][group[1:]] = True
        if any(shorts):
            # Shorted lines are one line: with one of them alone, all other cells come out right.
            siemens, siemens_std = _cells(rest, *left_out)
    touched, dead, saturated = _judge_cells(siemens, siemens_std, ~wrong, rest, diagnosis)
    ratio = _reference_ratio(shown[~dark], rest, diagnosis)
    cell_ohm = 1 / np.nanmedian(siemens)
    diagnosis.measured |= {"reference_ratio": round(ratio, 4), "cell_ohm": float(f"{cell_ohm:.3g}")}
    return LinesAndCells(left_out, shorts, touched, dead, wrong | dead | saturated)


def examine_leaks(rest: Rest, diagnosis: Diagnosis) -> None:
    """Add whether neighbouring lines leak into each other, by a skin that is otherwise sound."""
    known = SkinKnowledge.of(rest.board, np.clip(rest.ratio, 0.0, 1.0), rest.told)
    if (leak_ohm := JointEstimator(known).leak_ohm()) is not None:
        row_megohm, column_megohm = (1e-6 * ohm for ohm in leak_ohm)
        diagnosis.add(Kind.DAMP, row_megohm=row_megohm, column_megohm=column_megohm)


def _cells(rest: Rest, no_row: Bool, no_column: Bool) -> tuple[Float, Float]:
    """Conductances and their deviations, (R, C) [S], NaN in the lines that are left out."""
    kept = np.ix_(~no_row, ~no_column)
    ratio = rest.ratio[kept]
    rest_of_board = replace(rest.board, rows=ratio.shape[0], columns=ratio.shape[1])
    knowledge = SkinKnowledge.of(rest_of_board, ref_log_std=0.0)
    estimate = make_estimator("matrix", knowledge).estimate(ratio)
    siemens, std = np.full((2, *rest.codes.shape[:2]), np.nan)
    siemens[kept], std[kept] = estimate.cell_siemens, estimate.cell_siemens_std
    return siemens, std


def _shorted(
    axis: int, current: Float, siemens: Float, judged: Bool, std_lsb: float
) -> list[list[int]]:
    """Groups of rows (axis 0) or columns (axis 1) that are shorted to each other.

    judged: which cells are in no open line, (R, C).
    std_lsb: deviation of a port's current, by noise [LSB].
    """
    if axis:
        current, siemens, judged = current.T, siemens.T, judged.T
    lines, ports = np.flatnonzero(judged.any(axis=1)), np.flatnonzero(judged.any(axis=0))
    current, siemens = current[np.ix_(lines, ports)], siemens[np.ix_(lines, ports)]
    apart_lsb = np.abs(current[:, None] - current[None, :]).max(axis=2)
    alike = apart_lsb < ALIKE_LSB + limits.ALL_STDS * std_lsb * 2**0.5
    level, few = np.median(siemens, axis=1), len(ports) < ALIKE_PORTS
    groups: list[list[int]] = []
    for line in range(len(lines)):
        members = [line, *np.flatnonzero(alike[line, line + 1 :]) + line + 1]
        if len(members) < 2 or any(int(lines[line]) in group for group in groups):
            continue
        is_short, others = not few, np.log(np.delete(level, members))
        if len(others):
            rise = float(np.log(level[members].min()) - np.median(others))
            # Few ports may agree by chance. Then the conductance of these lines must also stand out
            # of the scatter of the other lines.
            is_short = rise > max(np.log(DOUBLED), limits.FEW_STDS * few * float(np.std(others)))
        if is_short:
            groups.append([int(lines[member]) for member in members])
    return groups


def _judge_cells(
    siemens: Float, std: Float, judged: Bool, rest: Rest, diagnosis: Diagnosis
) -> tuple[Bool, Bool, Bool]:
    """Add dead and saturated cells. Returns which are touched, dead and saturated, (R, C) each."""
    dead: Bool = np.zeros(siemens.shape, dtype=np.bool_)
    if not judged.any():
        return dead, dead, dead
    level = min(float(np.quantile(siemens[judged], REST_QUANTILE)), MOST_AT_REST_SIEMENS)
    share = TOUCHED_SHARE
    if judged.sum() >= MANY_CELLS:  # where cells at rest scatter widely, a touch is above that
        lower, middle = np.quantile(siemens[judged], (0.16, 0.5))  # one deviation apart
        spread = min(float(np.log(middle / lower)), MOST_SPREAD)
        share = max(share, float(np.exp(limits.MANY_STDS * spread)))
    high: Bool = judged & (siemens > share * level)
    if not rest.moves and high.sum() < judged.sum() > 1:
        usual = float(np.median(siemens[judged & ~high]))
        hidden = np.logical_and.outer(high.any(axis=1), high.any(axis=0))
        # Touches elsewhere make a cell uncertain, so it is dead only beyond that doubt. On an
        # untouched skin, all cells are known well.
        doubt = limits.MANY_STDS * std if high.any() else 0.0
        dead = np.asarray(judged & ~hidden & (siemens + doubt < limits.DEAD_SHARE * usual))
    if dead.any():
        percent = 100 * float(np.max(siemens[dead] / usual))
        diagnosis.add(Kind.DEAD_CELL, Place.of_cells(dead), percent_of_usual=percent)
    rows, columns = siemens.shape
    top, bottom = rest.wire_ohm
    path_ohm = bottom * np.arange(1, rows + 1)[:, None] + top * np.arange(1, columns + 1)
    path_ohm += 2 * rest.lead_ohm[0]
    # A saturated cell shows the wires up to it, and these may be above nominal by the share that is
    # no fault. The cell itself conducts more than the hardest touch could make it.
    most_ohm = (1 + limits.CHANGED_SHARE) * path_ohm + 1 / HIGHEST_TOUCH_SIEMENS
    saturated = high & (siemens * most_ohm > 1)
    if saturated.any():
        place, ohm = Place.of_cells(saturated), float(np.max(1 / siemens[saturated]))
        diagnosis.add(Kind.SATURATED_CELL, place, cell_ohm=ohm, rest_megohm=1e-6 / level)
    return high & ~saturated, dead, saturated


def _reference_ratio(shown: Float, rest: Rest, diagnosis: Diagnosis) -> float:
    """R_top / R_bottom. Adds a finding if it is far from what the board says.

    shown: what the readings show of the current, of ports that draw some, (P, 4) [LSB].
    """
    top_lsb = float(shown[:, READING_SENSES_TOP].mean())
    bottom_lsb = float(shown[:, ~READING_SENSES_TOP].mean())
    ratio = top_lsb / bottom_lsb
    # A and D round alike, and so do B and C: of four readings, two are independent.
    ratio_std = rest.std_lsb * np.hypot(1 / top_lsb, 1 / bottom_lsb) / len(shown) ** 0.5
    top, bottom = rest.board.ref_top_ohm, rest.board.ref_bottom_ohm
    off = ratio * bottom / top - 1
    doubt = limits.FEW_STDS * ratio_std + rest.offset_lsb * (1 / top_lsb + 1 / bottom_lsb)
    # Both sides have the same of rounding, and of the gain's error, which A and C alone show.
    both_lsb = limits.ROUNDING_LSB + limits.ADC_ERROR_LSB / 2
    doubt += both_lsb * abs(1 / top_lsb - 1 / bottom_lsb)
    if abs(off) >= RATIO_TOLERANCE + doubt:
        nominal = {"ref_top_ohm": top, "ref_bottom_ohm": bottom}
        diagnosis.add(Kind.REFERENCE_RATIO, ratio=ratio, off_percent=100 * off, **nominal)
    return ratio
