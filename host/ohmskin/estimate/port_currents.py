# SPDX-License-Identifier: Apache-2.0
"""From the readings of a cell to one current through its port.

Symbols

======== ========= ============================================================== =========
symbol   shape     meaning                                                        unit
======== ========= ============================================================== =========
n                  readings of near ends that a cell has: 4 (A to D), or 2 (A, B)
y_k      (R, C, n) reading k of each cell                                         V/Vdd
I        (R, C)    current through a port, per Vdd                                S
R_k      (n,)      reference resistor that reading k senses                       ohm
s_k      (n,)      sign of the current in reading k: +1 or -1                     1
b_k      (n,)      reading k where no current flows: 0 or 1                       V/Vdd
c        (R, C)    half of the current that floating lines draw from a port       S
q        (R, C)    share of it that the row gives, less that of the column        1
Z        (N, N)    impedance of the network of cells; N = R + C lines             ohm
a, b     (R, C)    potentials of the near ends of row and column                  V/Vdd
e, f     (R, C)    potentials of the far ends of row and column                   V/Vdd
U        (R, C)    voltage between the sensed ends, e - f                         V/Vdd
R_s                both reference resistors in series, R_top + R_bottom           ohm
u        (R, C)    current of the port, were there no wires up to its far ends    S
p_r, p_c (R, C)    what the wires of row and column lose per current              ohm
======== ========= ============================================================== =========

**The current.** Reading k is y_k = b_k + s_k R_k I. All readings of a cell show the same current,
so it is that of least squares,

    I = sum_k s_k R_k (y_k - b_k) / sum_k R_k^2 .

**Offsets.** A and D are readings of the row's sense node, B and C of the column's. An offset of a
node adds the same to both of its readings, but the current has opposite signs in them. So the
offset cancels in I, and the mean of the two residuals shows it. It belongs to the board, not to a
cell, so it is the median over all cells. In mode far, only A and B are read. The mean of these two
residuals shows only the offset that both nodes have in common.

**Lines that charge.** The lines of other ports float. They have a capacitance, and they charge
through the skin until they have settled. Until then the current into the row is larger than the
current out of the column by what these lines draw, 2 c on average over both polarities. Least
squares give the mean of both currents. The port's own current is that into the row, I + c, less
what the lines draw from the row:

    I + c - 2 c (1 + q) / 2 = I - c q .

By reciprocity, the row gives v_l of a charge that line l takes, and the column 1 - v_l, with v_l
the potential over Vdd that the line has in the end, the row driven high and the column low. All
lines have about the same capacitance, so q is the mean of 2 v_l - 1 over all that float. Per
current from row i to column j, line l has the potential Z_li - Z_lj, if the middle of row and
column has (Z_ii - Z_jj) / 2. So in sum over all lines, where row and column cancel,

    q = I N / (N - 2) (w_j - w_i) ,  w_l = Z_ll - 2 (mean of Z_lk over all k) .

Z is that of cells without wires. They are not known yet, but from the conductances of the ports,
1 / (1 / I - R_s), nearly (`cells_of_ports`).

**Far ends.** Nothing draws current from a far end. So its potential differs from that of the near
end by what the wires of the line lose, and

    u = I / (U + R_s I) ,    p_r = (a - e) / I ,    p_c = (f - b) / I .

In mode far, a node is read at one supply only. An offset of all readings, and lines that charge,
move a and b alike, but neither moves I. So a and b are not taken as they are read, but as the
current gives them: 1 - R_top I and R_bottom I.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import (
    EXCHANGED,
    NEAR,
    READING_OFFSET,
    READING_SENSES_TOP,
    READING_SIGN,
    READINGS_PER_CELL,
    as_near,
    node_ratio,
    reference_ohm,
)
from ohmskin.circuit.ports import cells_of_ports, solve_ports
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS, MIN_CELL_SIEMENS, SkinKnowledge

# Largest offset of a sense node that is believed, over Vdd. A larger one stays in the residuals and
# counts as noise. Chosen: nearly twice the absolute accuracy that the ATmega328P's data sheet gives
# (4.5 LSB of 10 bits at 1 MHz).
MOST_OFFSET_RATIO: Final = 0.008
# Sign of each reading's residual in c: c is half of the current into the row, which readings of the
# top node show, less the current out of the column, which readings of the bottom node show.
_INTO_ROW: Final = READING_SIGN * np.where(READING_SENSES_TOP, 1.0, -1.0)
# A port is dead if its current is below so many deviations. Chosen: as `FAULT_STDS` of
# `port_faults`.
DEAD_STDS: Final = 5.0
# [1] U, over the voltage R_s I that the references lose, is taken to be at least this. Chosen: u is
# 1 / (R_s (1 + this)), which noise must not make infinite or negative.
LEAST_APART: Final = -0.9
# [1] 1 - ohm I of `PortCurrents.without` is at least this. Chosen: noise, and a lead that is told
# wrongly, then leave a current that is finite.
LEAST_LEFT: Final = 0.1


class PortCurrents(NamedTuple):
    """A current per Vdd of each port, and its standard deviation, both (R, C) [S]."""

    current: Float
    std: Float

    def without(self, ohm: Float) -> "PortCurrents":
        """The currents if each port had so much less in series (R, C) [ohm]: 1/I' = 1/I - ohm."""
        left = np.maximum(1.0 - self.current * ohm, LEAST_LEFT)
        return PortCurrents(self.current / left, self.std / left**2)


class NearReadings(NamedTuple):
    """What the near ends of one frame show.

    ratio: readings of near ends alone (R, C, n) [V/Vdd].
    current: of each port, by least squares over its readings (R, C) [S].
    residual: of each reading, less the offset of its node (R, C, n) [V/Vdd].
    offset_ratio: of the sense node of each reading (n,) [V/Vdd].
    """

    ratio: Float
    current: Float
    residual: Float
    offset_ratio: Float


def row_share(current: Float, ref_ohm: float) -> Float:
    """q by currents (R, C); ref_ohm: R_s."""
    # Noise may make currents negative.
    port_ohm = 1.0 / np.maximum(current, MIN_CELL_SIEMENS) - ref_ohm
    port = 1.0 / np.clip(port_ohm, 1.0 / MAX_CELL_SIEMENS, 1.0 / MIN_CELL_SIEMENS)
    _, impedance = solve_ports(cells_of_ports(port))
    rows, lines = len(current), len(impedance)
    away = impedance.diagonal() - 2.0 * impedance.mean(axis=0)
    share = lines / max(lines - 2, 1) * current * (away[rows:] - away[:rows, None])
    return np.asarray(np.clip(share, -1.0, 1.0))


class NearEnds:
    """Reads the currents at the near ends of the lines. per_cell: n, readings of a cell there."""

    def __init__(self, knowledge: SkinKnowledge) -> None:
        names = knowledge.checked_names
        for node in "ab":
            if node not in names and EXCHANGED[node] not in names:
                raise ValueError(f"readings {' '.join(names)}: of each near end, one is needed")
        self._names = names
        self.per_cell = n = READINGS_PER_CELL if names == NEAR else 2
        reference = reference_ohm(knowledge.ref_top_ohm, knowledge.ref_bottom_ohm)[:n]
        self._slope_ohm, self._at_no_current = READING_SIGN[:n] * reference, READING_OFFSET[:n]
        self.square_ohm = float(np.sum(reference**2))  # sum_k R_k^2
        self._ref_ohm = knowledge.ref_ohm  # R_s
        self._into_row = _INTO_ROW[:n] / reference / n
        # The node of each reading, A to D: 0 is that of the row, 1 that of the column.
        self._node = [0, 1, 1, 0][:n]

    def read(self, ratio: Float) -> NearReadings:
        """Currents and residuals of checked readings (R, C, m), one for each name of this skin."""
        ratio = as_near(ratio, self._names)[..., : self.per_cell]
        signal = ratio - self._at_no_current
        current: Float = signal @ self._slope_ohm / self.square_ohm
        residual = signal - current[..., None] * self._slope_ohm
        # Of each cell, the mean of the residuals of a node: A with D, and B with C. In mode far,
        # A with B for both nodes.
        of_nodes = 0.5 * (residual[..., :2] + residual[..., :-3:-1]).reshape(-1, 2)
        middle = len(of_nodes) // 2
        offset = np.partition(of_nodes.T, middle)[self._node, middle]  # faster than median
        offset = np.minimum(np.maximum(offset, -MOST_OFFSET_RATIO), MOST_OFFSET_RATIO)
        residual -= offset
        return NearReadings(ratio, current, residual, offset)

    def charging(self, near: NearReadings) -> Float:
        """What lines that charge add to the currents of least squares, (R, C) [S]."""
        charging = near.residual @ self._into_row  # c
        return np.asarray(charging * row_share(near.current, self._ref_ohm))

    def best_three(self, ratio: Float) -> tuple[float, float]:
        """Leave out one of the four readings (4,) of a cell in mode near: the one that fits least.

        It is the one without which the other three agree best. Returns by how much these three
        disagree, the root mean square of their residuals [V/Vdd], and the current that they show
        [S].
        """
        threes = []
        for left_out in range(READINGS_PER_CELL):
            kept = np.arange(READINGS_PER_CELL) != left_out
            slope, signal = self._slope_ohm[kept], (ratio - self._at_no_current)[kept]
            current = float(slope @ signal / (slope @ slope))
            residual = signal - slope * current
            degrees = kept.sum() - 1  # three residuals, of which the current has taken one
            threes.append((float(residual @ residual / degrees) ** 0.5, current))
        return min(threes, key=lambda three: three[0])


class FarReadings(NamedTuple):
    """What the far ends of one frame show.

    ports: u and its standard deviation.
    near_current: I, but at least its deviation by rounding, because losses are divided by it (R, C)
        [S].
    drop: what the wires of row and of column lose, p_r I and p_c I, (2, R, C) [V/Vdd]. The near end
        is computed from I, so that lines that charge do not matter.
    read_drop: the same, but the near end is taken as it was read, so that the values of the
        references do not matter.
    ends: e and f, or a and b where no far end is sensed, (2, R, C) [V/Vdd].
    is_dead: ports whose near ends show no current, as of an open line: far ends show nothing of
        their wires (R, C).
    """

    ports: PortCurrents
    near_current: Float
    drop: Float
    read_drop: Float
    ends: Float
    is_dead: Bool


def far_ends_of(names: Sequence[str]) -> tuple[bool, bool]:
    """Whether readings of these names are taken at far ends of rows, and of columns."""
    row, column = (node in names or EXCHANGED[node] in names for node in "ef")
    return row, column


def read_far_ends(
    ratio: Float, knowledge: SkinKnowledge, near: PortCurrents, variance: Float
) -> FarReadings:
    """What the far ends of checked readings show; near: the currents of the same frame.

    variance (R, C): of the difference between both ends of a line [V^2/Vdd^2]. A side that is not
    sensed at far ends takes the near end: no wires, as far as they are concerned.
    """
    names, ref_ohm = knowledge.checked_names, knowledge.ref_ohm
    current = np.maximum(near.current, knowledge.current_std)
    near_end = 1.0 - knowledge.ref_top_ohm * current, knowledge.ref_bottom_ohm * current  # a, b
    ends = row_end, column_end = np.stack(
        [
            node_ratio(ratio, names, node) if is_sensed else potential
            for node, is_sensed, potential in zip("ef", far_ends_of(names), near_end, strict=True)
        ]
    )
    # Behind long wires, other cells may carry more to the far ends than the port's own: U < 0.
    apart = np.maximum(row_end - column_end, LEAST_APART * ref_ohm * current)  # U
    whole = apart + ref_ohm * current
    # By d u / d I = U / (U + R_s I)^2 and d u / d U = - I / (U + R_s I)^2.
    std = np.sqrt(apart**2 * near.std**2 + variance * current**2) / whole**2
    drop = np.stack([near_end[0] - row_end, column_end - near_end[1]])
    a, b = (node_ratio(ratio, names, node) for node in "ab")
    read_drop = np.stack([a - row_end, column_end - b])
    ports, is_dead = PortCurrents(current / whole, std), near.current < DEAD_STDS * near.std
    return FarReadings(ports, current, drop, read_drop, ends, is_dead)
