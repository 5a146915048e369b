# SPDX-License-Identifier: Apache-2.0
"""Lines, cells and reference resistors, from the mean readings of a skin at rest.

Symbols

====== ======== ============================================================================
symbol shape    meaning
====== ======== ============================================================================
n      (R, C)   mean current of a port in codes: of B, D, and of what A and C lack to Vdd
g      (R, C)   cell conductances by the method `matrix`, lines that are open left out [S]
====== ======== ============================================================================

What decides, in this order, each leaving out what was found before:

- no current at any port of a line: it is open. With one port on a line its cell may be it as well;
- two lines whose ports draw the same current: shorted, if `matrix`, which does not know of it, also
  finds twice the conductance of other lines in both. Where there are no others, only many ports
  that agree are evidence;
- g far below that of other cells: dead. Cells between a touched row and a touched column are not
  judged, little current goes through them;
- g above that of other cells: touched, or saturated where nothing but wires is left of 1/g.

By reciprocity a port has the same resistance in both directions, so R_top / R_bottom is the sum of
what A and D show over that of B and C. The readings are ratios: a factor common to all resistances,
references included, changes none of them and cannot be known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READING_SENSES_TOP, READING_SIGN
from ohmskin.doctor.findings import Finding, named
from ohmskin.doctor.signal import mean_std_lsb
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello

Bool = NDArray[np.bool_]

TOP_WIRE_OHM: Final = 100.0  # a segment, unless told
BOTTOM_WIRE_OHM: Final = 200.0
DARK_LSB: Final = 0.7  # no current, as rounding and noise let it look
DARK_SHARE: Final = 0.08  # of the usual current, up to the converter's offset
OFFSET_LSB: Final = 2.5
ALIKE_LSB: Final = 0.05
ALIKE_STDS: Final = 6.0
DOUBLED: Final = 1.4  # conductance of shorted lines over that of others; 2 is expected
RISE_STDS: Final = 3.0
ALIKE_PORTS: Final = 5  # that agree are evidence where there are no other lines
DEAD_SHARE: Final = 0.3
CLEAR_STDS: Final = 5.0
TOUCHED_SHARE: Final = 2.0
TOUCHED_STDS: Final = 5.0
MOST_SPREAD: Final = 0.4  # log, of cells at rest; wider, and many are touched
MANY_CELLS: Final = 8
REST_QUANTILE: Final = 0.25
MOST_AT_REST_SIEMENS: Final = 5e-6
SHORTED_OHM: Final = 350.0  # besides wires: the hardest touch has 300
WIRE_SPREAD: Final = 1.15
RATIO_TOLERANCE: Final = 0.03  # resistors of 1 % differ by 2 %
RATIO_STDS: Final = 3.0


@dataclass(frozen=True, eq=False)
class Circuit:
    """What the means show: findings, cells that are touched, conductances (NaN where unknown)."""

    findings: tuple[Finding, ...]
    touched: Bool
    cell_siemens: Float
    reference_ratio: float | None
    wrong: Bool
    """Cells at which a fault was found, and those of open or shorted lines."""


def examine_circuit(
    mean_codes: Float,
    noise_lsb: float,
    scans: int,
    board: Hello,
    wire_ohm: tuple[float, float] | None = None,
    *,
    moved: bool = False,
) -> Circuit:
    """Findings from mean codes (R, C, 4) of so many scans, each reading with this noise [LSB].

    wire_ohm: a segment of the top and bottom layer. moved: something touches the skin and moves;
    then shorted lines and dead cells are not judged, because the means are of no one skin.
    """
    full = (1 << board.adc_bits) - 1
    shown = np.where(READING_SIGN > 0, mean_codes, full - mean_codes)
    current = shown.mean(axis=2)
    std = noise_lsb / (4 * scans) ** 0.5
    findings: list[Finding] = []
    usual = float(np.median(current))
    dark = current < max(DARK_LSB + 0.4 * noise_lsb, min(OFFSET_LSB, DARK_SHARE * usual))
    nothing = np.zeros(current.shape, dtype=np.bool_)
    if dark.all():
        findings.append(_nothing_conducts(current.shape))
        unknown = np.full(current.shape, np.nan)
        return Circuit(tuple(findings), nothing, unknown, None, ~nothing)
    open_rows, open_columns = dark.all(axis=1), dark.all(axis=0)
    findings += _open("row", open_rows, current.shape[1])
    findings += _open("column", open_columns, current.shape[0])
    out = open_rows[:, None] | open_columns
    siemens, siemens_std = _cells(mean_codes, board, open_rows, open_columns)
    shorted = nothing.copy()
    if not moved:
        groups = [_shorted(current, siemens, std, axis, out) for axis in (0, 1)]
        findings += [_short("rows", group) for group in groups[0]]
        findings += [_short("columns", group) for group in groups[1]]
        shorted[[line for group in groups[0] for line in group]] = True
        shorted[:, [line for group in groups[1] for line in group]] = True
        # Shorted lines are one: the network without the others is right for all other cells.
        twins = [[line for group in each for line in group[1:]] for each in groups]
        if any(twins):
            open_rows[twins[0]] = True
            open_columns[twins[1]] = True
            siemens, siemens_std = _cells(mean_codes, board, open_rows, open_columns)
    judged = ~out & ~shorted
    touched, cell_findings, bad = _judge_cells(
        siemens, siemens_std, judged, wire_ohm, judge_dead=not moved
    )
    findings += cell_findings
    ratio, ratio_findings = _references(shown, dark, board, scans, noise_lsb)
    findings += ratio_findings
    return Circuit(tuple(findings), touched, siemens, ratio, out | shorted | bad)


def _cells(
    mean_codes: Float, board: Hello, without_rows: Bool, without_columns: Bool
) -> tuple[Float, Float]:
    """Conductances and their deviations, (R, C) [S], NaN in the lines that are left out."""
    kept = np.ix_(~without_rows, ~without_columns)
    rows, columns = mean_codes[kept].shape[:2]
    knowledge = SkinKnowledge(
        rows, columns, board.ref_top_ohm, board.ref_bottom_ohm, adc_bits=board.adc_bits
    )
    ratio = ratio_from_codes(mean_codes[kept], board.adc_bits)
    estimate = make_estimator("matrix", knowledge).estimate(ratio)
    siemens, std = np.full((2, *mean_codes.shape[:2]), np.nan)
    siemens[kept], std[kept] = estimate.cell_siemens, estimate.cell_siemens_std
    return siemens, std


def _nothing_conducts(shape: tuple[int, ...]) -> Finding:
    return Finding(
        "nothing_conducts",
        "fault",
        "the only cell, its row or its column" if shape == (1, 1) else "every row and column",
        "no current at any cell",
        "a current at every cell, also of an untouched skin",
        "plug in the skin's connectors; check the wires from the multiplexers' common pins",
    )


def _open(what: str, lines: Bool, cells: int) -> list[Finding]:
    numbers = [int(line) for line in np.flatnonzero(lines)]
    if not numbers:
        return []
    name = f"{what}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
    only = "" if cells > 1 else " (or the only cell there is dead)"
    to_do = f"check connector, crimp and solder joint of {name}, then the multiplexer's inputs"
    if numbers == list(range(numbers[0], len(lines))):
        # Lines beyond the skin look open, too.
        to_do += f"; if the skin has no {name}: 'ohmskin configure PORT --{what}s {numbers[0]}'"
    return [
        Finding(
            f"open_{what}",
            "fault",
            f"{name}{only}",
            f"no current at any cell of {name}",
            "a current at every cell, also of an untouched skin",
            to_do,
        )
    ]


def _shorted(current: Float, siemens: Float, std: float, axis: int, out: Bool) -> list[list[int]]:
    """Groups of rows (axis 0) or columns that are one electrode."""
    if axis:
        current, siemens, out = current.T, siemens.T, out.T
    lines = np.flatnonzero(~out.all(axis=1))
    ports = np.flatnonzero(~out.all(axis=0))
    current, siemens = current[np.ix_(lines, ports)], siemens[np.ix_(lines, ports)]
    apart = np.abs(current[:, None] - current[None, :]).max(axis=2)
    alike = apart < ALIKE_LSB + ALIKE_STDS * std * 2**0.5
    np.fill_diagonal(alike, False)
    level = np.median(siemens, axis=1)
    groups: list[list[int]] = []
    for line in range(len(lines)):
        members = [line, *np.flatnonzero(alike[line, line + 1 :]) + line + 1]
        if len(members) < 2 or any(int(lines[line]) in group for group in groups):
            continue
        others = np.log(np.delete(level, members))
        few = len(ports) < ALIKE_PORTS
        if not len(others):
            is_short = not few
        else:
            rise = float(np.log(level[members].min()) - np.median(others))
            # Few ports may agree by chance: then the rise has to stand out as well.
            is_short = rise > max(np.log(DOUBLED), RISE_STDS * few * float(np.std(others)))
        if is_short:
            groups.append([int(lines[member]) for member in members])
    return groups


def _short(what: str, lines: list[int]) -> Finding:
    names = " and ".join(map(str, lines))
    return Finding(
        f"short_{what}",
        "fault",
        f"{what} {names}",
        f"{what} {names} read alike at every cell, and conduct as one",
        "every line has readings of its own",
        f"look for yarn, solder or a wire strand that joins {what} {names}, at the seam and in the "
        "connector first",
    )


def _judge_cells(
    siemens: Float,
    std: Float,
    judged: Bool,
    wire_ohm: tuple[float, float] | None,
    *,
    judge_dead: bool,
) -> tuple[Bool, list[Finding], Bool]:
    """Touched cells, findings, and the cells that are dead or saturated."""
    dead: Bool = np.zeros(siemens.shape, dtype=np.bool_)
    if not judged.any():
        return dead, [], dead
    rest = min(float(np.quantile(siemens[judged], REST_QUANTILE)), MOST_AT_REST_SIEMENS)
    high: Bool = judged & (siemens > _touched_share(siemens[judged]) * rest)
    if judge_dead and high.sum() < judged.sum() > 1:
        usual = float(np.median(siemens[judged & ~high]))
        hidden = np.logical_and.outer(high.any(axis=1), high.any(axis=0))
        # Untouched cells are well known; their deviation has what a wrong reference does to it.
        doubt = CLEAR_STDS * std if high.any() else 0.0
        dead = np.asarray(judged & ~hidden & (siemens + doubt < DEAD_SHARE * usual))
    top, bottom = wire_ohm or (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)
    rows, columns = siemens.shape
    path_ohm = bottom * np.arange(1, rows + 1)[:, None] + top * np.arange(1, columns + 1)
    saturated = high & (siemens * (WIRE_SPREAD * path_ohm + SHORTED_OHM) > 1)
    touched = high & ~saturated
    findings = []
    if dead.any():
        share = float(np.max(siemens[dead] / usual))
        findings.append(
            Finding(
                "dead_cell",
                "fault",
                named(np.argwhere(dead)),
                f"{100 * share:.0f} % of the other cells' conductance or less",
                "cells at rest conduct alike",
                "the layers do not meet there: look for a torn stripe or a seam that holds them "
                "apart",
            )
        )
    if saturated.any():
        ohm = float(np.max(1 / siemens[saturated]))
        findings.append(
            Finding(
                "saturated_cell",
                "fault",
                named(np.argwhere(saturated)),
                f"{ohm:.0f} ohm with its wires: the layers are joined",
                f"about {1e-6 / rest:.2g} MOhm at rest",
                "make sure that nothing presses there; then look for yarn or metal through both "
                "layers, or a row that touches a column",
            )
        )
    return touched, findings, dead | saturated


def _touched_share(siemens: Float) -> float:
    """From where on a cell counts as touched, over the level at rest: cells at rest differ."""
    if siemens.size < MANY_CELLS:
        return TOUCHED_SHARE
    lower, middle = np.quantile(siemens, (0.16, 0.5))
    spread = min(float(np.log(middle / lower)), MOST_SPREAD)
    return max(TOUCHED_SHARE, float(np.exp(TOUCHED_STDS * spread)))


def _references(
    shown: Float, dark: Bool, board: Hello, scans: int, noise_lsb: float
) -> tuple[float, list[Finding]]:
    """R_top / R_bottom, and whether it is far from what the board says."""
    lit = shown[~dark]
    ratio = float(lit[:, READING_SENSES_TOP].sum() / lit[:, ~READING_SENSES_TOP].sum())
    nominal = board.ref_top_ohm / board.ref_bottom_ohm
    # Of A and D, one rounds as the other; the same of B and C.
    rounding = mean_std_lsb(noise_lsb, scans) * 2**0.5 / (float(lit.mean()) * len(lit) ** 0.5)
    off = ratio / nominal - 1
    if abs(off) < RATIO_TOLERANCE + RATIO_STDS * rounding:
        return ratio, []
    finding = Finding(
        "reference_ratio",
        "fault",
        "reference resistors",
        f"top / bottom = {ratio:.3f}, {100 * off:+.1f} % off",
        f"{nominal:.3f}: {board.ref_top_ohm} and {board.ref_bottom_ohm} ohm",
        f"measure both with a meter, skin unplugged: the top one is {100 * abs(off):.1f} % too "
        f"{'large' if off > 0 else 'small'}, or the bottom one too "
        f"{'small' if off > 0 else 'large'}",
    )
    return ratio, [finding]
