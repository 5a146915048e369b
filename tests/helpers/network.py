# SPDX-License-Identifier: Apache-2.0
"""Any network of resistors, node by node: the check on `ohmskin.circuit`, which solves only skins.

Symbols

====== ======== ========================================================================= =====
symbol shape    meaning                                                                   unit
====== ======== ========================================================================= =====
N, B            nodes; branches, branch k from node tail[k] to node head[k]
A      (N, B)   incidence: +1 at a branch's tail, -1 at its head                          1
r      (B,)     branch resistance: 0 a short, inf an open branch, which is left out       ohm
L      (N, N)   node Laplacian A diag(1/r) A^T of the branches with 0 < r < inf           S
S      (N, B0)  columns of A of the branches of zero ohm                                  1
v      (N,)     node potentials, known at the nodes k with a source, else unknown (u)     V
i      (B,)     branch currents, from tail to head                                        A
i0     (B0,)    those of the branches of zero ohm                                         A
====== ======== ========================================================================= =====

Equations. Kirchhoff's current law at every node without a source, and no voltage across a short:

    L_uu v_u + S_u i0 = -L_uk v_k ,     S_u^T v_u = -S_k^T v_k .

This is modified nodal analysis [Ho1975]; without shorts, the textbook's node Laplacian. `circuit`
eliminates the wire nodes on paper, never forms L, and takes all four readings from one port
resistance; here every reading is a node of its own circuit, reference resistors included. That
costs 2RC factorisations, and beside a wire of w ohm a resistor of R ohm loses R/w * 1e-16 of itself
in the diagonal of L: `circuit` is the one to compute with.

[Ho1975] C.-W. Ho, A. E. Ruehli, P. A. Brennan, "The modified nodal approach to network analysis",
IEEE Transactions on Circuits and Systems 22(6), 504-509.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from ohmskin.arrays import Float
from ohmskin.circuit.skin import READINGS_PER_CELL, Skin


@dataclass(frozen=True, eq=False)
class Solution:
    """Node potentials v [V], shape (N,), and branch currents i [A], tail to head, shape (B,).

    A node that no conducting path joins to a source has no potential: nan, and no current there.
    """

    node_v: Float
    branch_a: Float


@dataclass(frozen=True, eq=False)
class Network:
    """N nodes, 0 to N-1, and B resistors [ohm] between them: tail, head, branch_ohm, shape (B,).

    Zero ohm is a short, inf an open branch, both exactly. Arrays are copied.
    Raises ValueError for other shapes, nodes that do not exist, resistances below 0 or nan.
    """

    nodes: int
    tail: NDArray[np.intp]
    head: NDArray[np.intp]
    branch_ohm: Float

    def __post_init__(self) -> None:
        for name, dtype in (("tail", np.intp), ("head", np.intp), ("branch_ohm", np.float64)):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=dtype))
        shapes = {self.tail.shape, self.head.shape, self.branch_ohm.shape}
        if len(shapes) != 1 or self.tail.ndim != 1:
            raise ValueError(f"tail, head and branch_ohm must be (branches,), not {shapes}")
        ends = np.concatenate([self.tail, self.head])
        if not np.all((ends >= 0) & (ends < self.nodes)):
            raise ValueError(f"branches must join nodes 0 to {self.nodes - 1}")
        if not np.all(self.branch_ohm >= 0):
            raise ValueError("branch_ohm must be numbers and not negative")

    def solve(self, source_v: Mapping[int, float]) -> Solution:
        """v and i (see above) with an ideal source from ground to each node of `source_v` [V].

        Raises ValueError for a source at no node or not finite, and where shorts make a loop or
        join two sources: nothing tells what current flows there.
        """
        known = np.zeros(self.nodes, dtype=bool)
        node_v = np.full(self.nodes, np.nan)
        for node, volt in source_v.items():
            if not (0 <= node < self.nodes and np.isfinite(volt)):
                raise ValueError(f"no source can hold node {node} of {self.nodes} at {volt} V")
            known[node], node_v[node] = True, volt

        part = self._parts(np.isfinite(self.branch_ohm), np.arange(self.nodes))
        driven = np.isin(part, part[known])
        unknown = driven & ~known
        live = np.isfinite(self.branch_ohm) & driven[self.tail]
        short = live & (self.branch_ohm == 0)
        resistive = live & ~short
        self._refuse_loops(short, known)

        ends = np.concatenate([self.tail, self.head])
        branch = np.tile(np.arange(self.tail.size), 2)
        sign = np.repeat([1.0, -1.0], self.tail.size)
        incidence = sparse.csc_matrix((sign, (ends, branch)), shape=(self.nodes, self.tail.size))
        across = incidence[:, resistive]
        siemens = sparse.diags(1 / self.branch_ohm[resistive])
        laplacian = (across @ siemens @ across.T).tocsr()
        shorts = incidence[:, short].tocsr()

        branch_a = np.zeros(self.tail.size)
        if unknown.any():
            system = sparse.bmat(
                [[laplacian[unknown][:, unknown], shorts[unknown]], [shorts[unknown].T, None]],
                format="csc",
            )
            from_sources = sparse.vstack([laplacian[unknown][:, known], shorts[known].T])
            solved = spsolve(system, -(from_sources @ node_v[known]))
            node_v[unknown], branch_a[short] = np.split(solved, [np.count_nonzero(unknown)])
        drop = node_v[self.tail] - node_v[self.head]
        branch_a[resistive] = drop[resistive] / self.branch_ohm[resistive]
        return Solution(node_v, branch_a)

    def _parts(self, joined: NDArray[np.bool_], name: NDArray[np.intp]) -> NDArray[np.intp]:
        """Number of the part that holds node k, (N,): branches `joined`, between nodes `name`."""
        graph = sparse.coo_matrix(
            (np.ones(np.count_nonzero(joined)), (name[self.tail[joined]], name[self.head[joined]])),
            shape=(self.nodes, self.nodes),
        )
        return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)

    def _refuse_loops(self, short: NDArray[np.bool_], known: NDArray[np.bool_]) -> None:
        """Shorts are a forest, all sources taken for one node, if each leaves one part fewer."""
        one_source = np.where(known, np.argmax(known), np.arange(self.nodes))
        if self.nodes - np.unique(self._parts(short, one_source)).size < np.count_nonzero(short):
            raise ValueError("branches of zero ohm make a loop or join two sources: open one")


def skin_network(skin: Skin) -> Network:
    """The skin alone: N = R + C + 2RC nodes, B = 3RC branches, arrays in row-major order.

    Nodes: row electrodes, column electrodes, top nodes T, bottom nodes B. Branches: cells (T to B),
    top segments (towards T), bottom segments (from B towards the column electrode), so that all
    currents are positive when rows drive columns.
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


def laplacian_readings(skin: Skin, joints: Sequence[tuple[int, int]] = ()) -> Float:
    """What `circuit.readings` returns, (R, C, 4): sense-node voltages / Vdd, configurations A to D.

    Each cell is two circuits: Vdd - ref_top - row electrode i, column electrode j - ref_bottom -
    ground gives A and B; with Vdd and ground exchanged C (column electrode) and D (row electrode).
    joints: pairs of electrodes, rows first, that 0.1 ohm joins.
    """
    rows, columns = skin.shape
    alone = skin_network(skin)
    top_end, bottom_end = alone.nodes, alone.nodes + 1
    one, other = np.array(joints, dtype=np.intp).reshape(-1, 2).T
    references = [skin.ref_top_ohm, skin.ref_bottom_ohm]
    ohm = np.concatenate([alone.branch_ohm, [0.1] * len(joints), references])
    ratio = np.empty((rows, columns, READINGS_PER_CELL))
    for i in range(rows):
        for j in range(columns):
            sense = [i, rows + j]
            network = Network(
                alone.nodes + 2,
                np.concatenate([alone.tail, one, [top_end, bottom_end]]),
                np.concatenate([alone.head, other, sense]),
                ohm,
            )
            ratio[i, j, :2] = network.solve({top_end: 1.0, bottom_end: 0.0}).node_v[sense]
            ratio[i, j, 2:] = network.solve({top_end: 0.0, bottom_end: 1.0}).node_v[sense[::-1]]
    return ratio
