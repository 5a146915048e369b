# SPDX-License-Identifier: Apache-2.0
"""Any network of resistors, node by node: the check on `ohmskin.circuit`, which solves only skins.

Symbols

====== ======== ========================================================================= =====
symbol shape    meaning                                                                   unit
====== ======== ========================================================================= =====
N, B            nodes; branches, branch k from node tail[k] to node head[k]
r      (B,)     branch resistance: 0 a short, inf an open branch                          ohm
P               points: each is a node, or several that shorts join
L      (P, P)   Laplacian of the points, by the branches with 0 < r < inf                 S
v      (P,)     potentials, known at the points k with a source, else unknown (u)         V
====== ======== ========================================================================= =====

Kirchhoff's current law at every point without a source: L_uu v_u = -L_uk v_k. `circuit` eliminates
the wire nodes on paper, never forms L, and takes all four readings from one port resistance; here
every reading is a point of its own circuit, reference resistors included. That costs 2RC
factorisations, and beside a wire of w ohm a resistor of R ohm loses R/w * 1e-16 of itself in the
diagonal of L: `circuit` is the one to compute with.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin


class Network(NamedTuple):
    """N nodes, 0 to N-1, and B resistors [ohm] between them: tail, head, branch_ohm, shape (B,)."""

    nodes: int
    tail: NDArray[np.intp]
    head: NDArray[np.intp]
    branch_ohm: Float

    def node_v(self, source_v: Mapping[int, float]) -> Float:
        """Potentials [V], (N,), with an ideal source from ground to each node of `source_v` [V].

        A node that no conducting path joins to a source has none: nan.
        """
        point = _parts(self.nodes, self.tail, self.head, self.branch_ohm == 0)
        points = int(point.max()) + 1
        resistive = (self.branch_ohm > 0) & np.isfinite(self.branch_ohm)
        one, other = point[self.tail[resistive]], point[self.head[resistive]]
        siemens = 1 / self.branch_ohm[resistive]
        laplacian = np.zeros((points, points))
        for first, second in ((one, other), (other, one)):
            np.add.at(laplacian, (first, first), siemens)
            np.add.at(laplacian, (first, second), -siemens)
        point_v = np.full(points, np.nan)
        point_v[point[list(source_v)]] = list(source_v.values())
        known = np.isfinite(point_v)
        part = _parts(points, one, other, np.full(one.size, True))
        unknown = np.isin(part, part[known]) & ~known
        from_sources = laplacian[np.ix_(unknown, known)] @ point_v[known]
        point_v[unknown] = np.linalg.solve(laplacian[np.ix_(unknown, unknown)], -from_sources)
        return np.asarray(point_v[point])


def _parts(
    nodes: int, tail: NDArray[np.intp], head: NDArray[np.intp], joins: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Number of the part that holds each node, (nodes,), where these branches join nodes."""
    ends = (tail[joins], head[joins])
    graph = sparse.coo_matrix((np.ones(ends[0].size), ends), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def skin_network(skin: Skin) -> Network:
    """The skin alone: N = R + C + 2RC nodes, B = 3RC branches, arrays in row-major order.

    Nodes: row electrodes, column electrodes, top nodes T, bottom nodes B. Branches: cells (T to B),
    top segments (towards T), bottom segments (from B towards the column electrode).
    """
    rows, columns = skin.shape
    cells = rows * columns
    row, column, top, bottom = np.split(
        np.arange(rows + columns + 2 * cells), np.cumsum([rows, columns, cells])
    )
    top, bottom = top.reshape(skin.shape), bottom.reshape(skin.shape)
    before_top = np.column_stack([row, top[:, :-1]])
    before_bottom = np.vstack([column, bottom[:-1]])
    with np.errstate(divide="ignore"):
        cell_ohm = 1 / skin.cell_siemens
    return Network(
        rows + columns + 2 * cells,
        np.concatenate([top, before_top, bottom], axis=None),
        np.concatenate([bottom, top, before_bottom], axis=None),
        np.concatenate([cell_ohm, skin.top_wire_ohm, skin.bottom_wire_ohm], axis=None),
    )


def laplacian_readings(
    skin: Skin, joints: Sequence[tuple[int, int]] = (), names: Sequence[str] = "abcd"
) -> Float:
    """Sense-node voltages / Vdd of the readings named, (R, C, n).

    Each cell is two circuits: Vdd - ref_top - row electrode i, column electrode j - ref_bottom -
    ground gives A, B, E and F; with Vdd and ground exchanged D, C, H and G. Each electrode is
    behind its line's lead, where its near end is; a far end is behind 1 ohm. joints: pairs of ends
    that 0.1 ohm joins: near ends, rows first, then far ends.
    """
    rows, columns = skin.shape
    alone, lines = skin_network(skin), rows + columns
    top, bottom = np.arange(lines, alone.nodes).reshape(2, rows, columns)
    line_ends = np.concatenate([np.arange(lines), top[:, -1], bottom[-1]])
    ends = alone.nodes + np.arange(2 * lines)
    top_end, bottom_end = alone.nodes + 2 * lines, alone.nodes + 2 * lines + 1
    one, other = ends[np.array(joints, dtype=np.intp).reshape(-1, 2).T]
    references = [skin.ref_top_ohm, skin.ref_bottom_ohm]
    to_ends = np.concatenate([skin.lead_ohm, [1.0] * lines])
    ohm = np.concatenate([alone.branch_ohm, to_ends, [0.1] * len(joints), references])
    ratio = np.empty((rows, columns, len(names)))
    for i in range(rows):
        for j in range(columns):
            network = Network(
                alone.nodes + 2 * lines + 2,
                np.concatenate([alone.tail, line_ends, one, [top_end, bottom_end]]),
                np.concatenate([alone.head, ends, other, ends[[i, rows + j]]]),
                ohm,
            )
            sense = ends[[i, rows + j, lines + i, lines + rows + j]]
            top_high = network.node_v({top_end: 1.0, bottom_end: 0.0})[sense]
            top_low = network.node_v({top_end: 0.0, bottom_end: 1.0})[sense]
            found = dict(zip("abefdchg", [*top_high, *top_low], strict=True))
            ratio[i, j] = [found[name] for name in names]
    return ratio


def floating_share(skin: Skin) -> Float:
    """The mean of 2 v - 1 over all lines but row i and column j, for each port (R, C).

    v: potentials of near ends over Vdd, where Vdd and ground drive row and column by references.
    """
    alone, (rows, columns) = skin_network(skin), skin.shape
    top, bottom = alone.nodes, alone.nodes + 1
    ohm = np.concatenate([alone.branch_ohm, [skin.ref_top_ohm, skin.ref_bottom_ohm]])
    share = np.empty(skin.shape)
    for i, j in np.ndindex(rows, columns):
        driven = [i, rows + j]
        tail, head = np.append(alone.tail, [top, bottom]), np.append(alone.head, driven)
        line_v = Network(alone.nodes + 2, tail, head, ohm).node_v({top: 1.0, bottom: 0.0})
        share[i, j] = np.mean(2 * np.delete(line_v[: rows + columns], driven) - 1)
    return share


def leaks(shape: tuple[int, int], leak_ohm: float) -> tuple[NDArray[np.intp], Float]:
    """Branches between nodes of `skin_network` (2, n), and their resistances (n,): a damp skin.

    Neighbouring stripes of a layer leak into each other by `leak_ohm` at each crossing.
    """
    rows, columns = shape
    lines = rows + columns
    top, bottom = np.arange(lines, lines + 2 * rows * columns).reshape(2, rows, columns)
    one = np.concatenate([top[:-1], bottom[:, :-1].T], axis=None)
    other = np.concatenate([top[1:], bottom[:, 1:].T], axis=None)
    return np.stack([one, other]), np.full(one.size, leak_ohm)


class SkinCircuit:
    """The Laplacian of one untouched skin, inverted once: readings of many frames, fast.

    The point of row 0 is grounded: only differences are used. With Z = L^-1, D the branches of the
    cells and q the cells that conduct more than at rest by dg, Woodbury's identity gives
    Z - Z D_q^T (1/dg + D_q Z D_q^T)^-1 D_q Z. Cells at rest conduct, and no wire is a short.
    more: branches that no skin should have, and their resistances: as `leaks` has them.
    """

    def __init__(self, rest: Skin, more: tuple[NDArray[np.intp], Float] | None = None) -> None:
        rows, columns = rest.shape
        network, cells, lines = skin_network(rest), rows * columns, rows + columns
        if more is not None:
            tail, head, ohm = network[1:]
            network = Network(
                network.nodes,
                np.concatenate([tail, more[0][0]]),
                np.concatenate([head, more[0][1]]),
                np.concatenate([ohm, more[1]]),
            )
        branch = np.arange(network.tail.size)
        incidence = np.zeros((branch.size, network.nodes))
        incidence[branch, network.tail], incidence[branch, network.head] = 1.0, -1.0
        laplacian = incidence.T @ (incidence / network.branch_ohm[:, None])
        impedance = np.zeros_like(laplacian)
        impedance[1:, 1:] = np.linalg.inv(laplacian[1:, 1:])
        top, bottom = np.arange(lines, network.nodes).reshape(2, rows, columns)
        ends = np.concatenate([np.arange(lines), top[:, -1], bottom[-1]])
        over_cell = incidence[:cells] @ impedance
        self.rest = rest
        self._ends = impedance[np.ix_(ends, ends[:lines])]
        self._end_by_cell, self._cells = over_cell[:, ends], over_cell @ incidence[:cells].T

    def readings(self, cell_siemens: Float) -> Float:
        """Readings a to h / Vdd, (R, C, 8), of these cells (R, C) [S], behind the skin's leads."""
        more = np.ravel(cell_siemens - self.rest.cell_siemens)
        pressed = np.flatnonzero(more)
        inner = self._cells[np.ix_(pressed, pressed)] + np.diag(1 / more[pressed])
        by_cell = self._end_by_cell[pressed]
        lines, lead_ohm = self._ends.shape[1], self.rest.lead_ohm
        of_end = self._ends - by_cell.T @ np.linalg.solve(inner, by_cell[:, :lines])
        row, column = np.ogrid[: self.rest.shape[0], : self.rest.shape[1]]
        column = column + self.rest.shape[0]
        near_row, near_column, far_row, far_column = (
            of_end[end, row] - of_end[end, column]
            for end in (row, column, lines + row, lines + column)
        )
        port_ohm = near_row - near_column + lead_ohm[row] + lead_ohm[column]
        current = 1 / (port_ohm + self.rest.ref_top_ohm + self.rest.ref_bottom_ohm)
        a, b = 1 - self.rest.ref_top_ohm * current, self.rest.ref_bottom_ohm * current
        at_column = b + lead_ohm[column] * current - near_column * current
        e, f = at_column + far_row * current, at_column + far_column * current
        return np.stack([a, b, 1 - b, 1 - a, e, f, 1 - f, 1 - e], axis=-1)
