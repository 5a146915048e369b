# SPDX-License-Identifier: Apache-2.0
"""The circuit of a skin: from resistances to the resistances of ports, and readings of every cell.

Symbols

====== ============ ==================================================================== =========
symbol shape        meaning                                                              unit
====== ============ ==================================================================== =========
R, C                number of rows (stripes of the top layer) and columns (bottom layer)
g      (R, C)       cell conductance, joins top node T[i,j] and bottom node B[i,j]       S
Rt     (R, C)       top wire segment that ends at T[i,j], from T[i,j-1] or the electrode  ohm
Rb     (R, C)       bottom segment that ends at B[i,j], from B[i-1,j] or the electrode    ohm
Rl     (R+C,)       lead of a line: between the multiplexer's common pin and electrode    ohm
K      (RC, RC)     voltage lost in the wires up to cell e per current through cell f    ohm
E      (R+C, RC)    incidence: +1 at a cell's row electrode, -1 at its column electrode  1
Y      (R+C, R+C)   admittance of the skin seen from its electrodes                      S
Z      (R+C, R+C)   inverse of Y, one electrode of each connected part grounded          ohm
rho    (R, C)       port resistance between row electrode i and column electrode j       ohm
I      (R, C)       current through a selected port, per volt of Vdd                     S
y      (R, C, 4)    sense-node voltage / Vdd, in the order of `CONFIGURATIONS`           1
F      (RC, R+C)    voltage in a cell's path per current into a line's far end           ohm
Q      (R+C, R+C)   E (diag(1/g) + K)^-1 F: currents of electrodes that F drives         1
====== ============ ==================================================================== =========

Equations. With x the cell currents and V the electrode potentials,

    (diag(1/g) + K) x = E^T V ,     Y = E (diag(1/g) + K)^-1 E^T ,
    rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j] ,     I = 1 / (rho + Rl[i] + Rl[j] + R_top + R_bottom) .

A lead (switch of the multiplexer, crimp, margin of yarn) carries the whole current of a port, and
none while another line is selected. So it adds to the port's resistance, as a reference does.

These are Kirchhoff's laws on the network of 2RC nodes, from which the nodes along the wires have
been eliminated. Two cells of a line share the wire up to the nearer of them, so each element of K
is a sum of segments. The matrix that is factorised is 1 + sqrt(g) K sqrt(g), because it needs no
special value for open cells (g = 0), nor for wires of 0 ohm.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import DEFAULT_REF_OHM, check_references, ratio_from_current
from ohmskin.circuit.small import cholesky, one_blas_thread, solve, solve_lower

# Wire segments of a layer [ohm]: one number if all are alike, which is faster, or (R, C).
Wire = float | Float


@dataclass(frozen=True, eq=False)
class Skin:
    """Every resistance of the circuit. Arrays are copied and read-only.

    cell_siemens: conductance of each cell (R, C) [S]; 0 is an open cell.
    top_wire_ohm: segments of the top layer (R, C) [ohm]; [i, j] ends at T[i, j], and [i, 0] comes
        from the electrode of row i. 0 is a wire without resistance.
    bottom_wire_ohm: segments of the bottom layer (R, C) [ohm]; [i, j] ends at B[i, j], and [0, j]
        comes from the electrode of column j.
    ref_top_ohm, ref_bottom_ohm: reference resistors [ohm].
    lead_ohm: leads of the rows, then of the columns (R+C,) [ohm]; if it is given as one number, all
        have it.

    Raises ValueError for other shapes, values that are negative or not finite, references not > 0.
    """

    cell_siemens: Float
    top_wire_ohm: Float
    bottom_wire_ohm: Float
    ref_top_ohm: float = DEFAULT_REF_OHM
    ref_bottom_ohm: float = DEFAULT_REF_OHM
    lead_ohm: Float = field(default_factory=lambda: np.array(0.0))

    def __post_init__(self) -> None:
        check_references(self.ref_top_ohm, self.ref_bottom_ohm)
        shape = np.shape(self.cell_siemens)
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"cell_siemens must be (rows, columns), at least 1x1, not {shape}")
        expected = dict.fromkeys(("cell_siemens", "top_wire_ohm", "bottom_wire_ohm"), shape)
        for name, expected_shape in (expected | {"lead_ohm": (sum(shape),)}).items():
            resistances = np.array(getattr(self, name), dtype=np.float64)
            if name == "lead_ohm" and not resistances.ndim:
                resistances = np.full(expected_shape, resistances)
            if resistances.shape != expected_shape:
                raise ValueError(
                    f"{name} has shape {resistances.shape}, not {expected_shape}, as cell_siemens "
                    f"has {shape}"
                )
            if not np.all(np.isfinite(resistances) & (resistances >= 0)):
                raise ValueError(f"{name} must be finite and not negative")
            resistances.setflags(write=False)
            object.__setattr__(self, name, resistances)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.cell_siemens.shape
        return rows, columns


@lru_cache(maxsize=8)
def incidence(rows: int, columns: int) -> Float:
    """E^T, (RC, R+C): a cell's voltage is the potential of its row less that of its column."""
    by_row = np.kron(np.eye(rows), np.ones((columns, 1)))
    return np.hstack([by_row, -np.tile(np.eye(columns), (rows, 1))])


@lru_cache(maxsize=8)
def _unit_coupling(
    rows: int, columns: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float, Float]:
    """Pairs of cells that share wire, (2, k), and flat indices of their elements in K, (k,); and
    these of a skin with 1 ohm in each top segment alone, and in each bottom segment alone, (k,).
    """
    shape = rows, columns
    by_top, by_bottom = wire_coupling_ohm(1.0, 0.0, shape), wire_coupling_ohm(0.0, 1.0, shape)
    pairs = np.nonzero(by_top + by_bottom)
    flat = np.ravel_multi_index(pairs, by_top.shape)
    return np.array(pairs), flat, by_top[pairs], by_bottom[pairs]


def wire_coupling_ohm(top_wire_ohm: Wire, bottom_wire_ohm: Wire, shape: tuple[int, int]) -> Float:
    """K [ohm], shape (RC, RC): K[e, f] is the wire shared by the paths to cells e and f."""
    rows, columns = shape
    to_top = np.cumsum(np.broadcast_to(top_wire_ohm, shape), 1)
    to_bottom = np.cumsum(np.broadcast_to(bottom_wire_ohm, shape), 0)
    i, j = np.arange(rows), np.arange(columns)
    coupling = np.zeros((rows, columns, rows, columns))
    np.einsum("ijik->ijk", coupling)[:] = to_top[:, np.minimum.outer(j, j)]
    np.einsum("ijkj->ikj", coupling)[:] += to_bottom[np.minimum.outer(i, i)]
    return coupling.reshape(rows * columns, rows * columns)


def factorised(
    root: Float, top_wire_ohm: Wire, bottom_wire_ohm: Wire, to_sense: Float | None = None
) -> tuple[Float, Float]:
    """L of L L^T = 1 + sqrt(g) K sqrt(g), (RC, RC), and "half", L^-1 sqrt(g) [E^T F].

    With the columns of "half" that belong to E^T, Y is half^T half.

    root: sqrt(g), (R, C).
    to_sense: F (RC, R+C); None: near ends are sensed, and "half" has no columns of F.
    """
    cells, roots = root.size, root.ravel()
    if isinstance(top_wire_ohm, float) and isinstance(bottom_wire_ohm, float):
        # Only cells of a line share wire: most elements are 0.
        pairs, flat, by_top, by_bottom = _unit_coupling(*root.shape)
        one, other = roots[pairs]
        system = np.zeros((cells, cells))
        system.ravel()[flat] = (top_wire_ohm * by_top + bottom_wire_ohm * by_bottom) * one * other
    else:
        system = wire_coupling_ohm(top_wire_ohm, bottom_wire_ohm, root.shape)
        system *= roots[:, None]
        system *= roots
    system.ravel()[:: cells + 1] += 1.0
    factor, ends = cholesky(system), incidence(*root.shape)
    if to_sense is not None:
        ends = np.hstack([ends, to_sense])
    return factor, solve_lower(factor, ends * root.reshape(-1, 1))


def admittance_of(half: Float) -> Float:
    """Y = half^T half, (R+C, R+C) [S].

    No current leaves the skin, so the sum of each row is 0. The diagonal is computed from this, and
    not from the product: so small conductances are not lost in the rounding of large ones.
    """
    admittance: Float = half.T @ half
    diagonal = np.einsum("ii->i", admittance)
    diagonal[:] = 0.0
    diagonal[:] = -admittance.sum(axis=1)
    return admittance


@one_blas_thread
def port_resistance_ohm(skin: Skin) -> Float:
    """rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j] [ohm], shape (R, C), all other electrodes floating.

    It is inf for a port whose row and column no chain of conducting cells connects.
    """
    rows, root = skin.shape[0], np.sqrt(skin.cell_siemens)
    half = factorised(root, skin.top_wire_ohm, skin.bottom_wire_ohm)[1]
    part = _connected_parts(skin.cell_siemens)
    _, resistance = impedance_of(admittance_of(half), rows, part)
    connected = part[:rows, None] == part[None, rows:]
    return np.where(connected, np.maximum(resistance, 0.0), np.inf)


def impedance_of(
    admittance: Float, rows: int, part: NDArray[np.intp] | None = None
) -> tuple[Float, Float]:
    """Z (R+C, R+C) and rho (R, C) of Y, which is overwritten.

    part: the number of the connected part that each electrode is in; None: all are connected.

    Y is singular, because potentials have no zero. So one electrode of each part is grounded, by a
    conductance as large as its own element of the diagonal. Whichever it is, resistances within the
    part are the same. The best connected electrode is taken, which costs the least precision.
    """
    diagonal = admittance.diagonal()
    grounds = [diagonal.argmax()]
    if part is not None:
        grounds = [np.where(part == one, diagonal, -1.0).argmax() for one in np.unique(part)]
    for ground in grounds:
        admittance[ground, ground] = 2 * admittance[ground, ground] or 1.0
    impedance = solve(cholesky(admittance), np.eye(len(admittance)))
    diagonal = impedance.diagonal()
    port_ohm = diagonal[:rows, None] + diagonal[None, rows:] - 2 * impedance[:rows, rows:]
    return np.asarray(impedance), np.asarray(port_ohm)


def path_of_lines(top_wire_ohm: Wire, bottom_wire_ohm: Wire, shape: tuple[int, int]) -> Float:
    """Wire from each cell to the near end of its row, and of its column [ohm], (RC, R+C)."""
    rows, columns = shape
    to_cell = np.zeros((*shape, rows + columns))
    top_ohm, bottom_ohm = (np.broadcast_to(ohm, shape) for ohm in (top_wire_ohm, bottom_wire_ohm))
    np.einsum("iji->ij", to_cell[..., :rows])[:] = np.cumsum(top_ohm, 1)
    np.einsum("ijj->ij", to_cell[..., rows:])[:] = np.cumsum(bottom_ohm, 0)
    return to_cell.reshape(rows * columns, -1)


def leak_admittance(shape: tuple[int, int], leak_siemens: tuple[float, float]) -> Float:
    """What leaks between neighbouring lines of a layer add to Y, (R+C, R+C) [S].

    leak_siemens: leaks of rows and of columns, at each crossing [S]. They are taken to join the
        electrodes of the lines, because they resist a thousand times as much as the wires up to
        them.
    """
    rows, columns = shape
    leaks = np.zeros((rows + columns, rows + columns))
    of_layers = columns * leak_siemens[0], rows * leak_siemens[1]
    for layer, leak in zip((leaks[:rows, :rows], leaks[rows:, rows:]), of_layers, strict=True):
        chain = np.diff(np.eye(len(layer)), axis=0)  # a row for each pair of neighbours
        layer[:] = leak * (chain.T @ chain)
    return leaks


@one_blas_thread
def end_admittance(skin: Skin) -> Float:
    """Y [S] of both ends of all lines, (2(R+C), 2(R+C)): near ends, rows first, then far ends.

    A near end is in front of the line's lead, so the lead is added to the first segment. A far end
    is joined to T[i, C-1] or B[R-1, j] by 1 ohm, which stands for its multiplexer. So it is
    computed as one more cell of its line, at the end of the line's wire, that leads to an electrode
    of its own.
    """
    rows, columns = skin.shape
    cells, lines = rows * columns, rows + columns
    top_ohm, bottom_ohm = skin.top_wire_ohm.copy(), skin.bottom_wire_ohm.copy()
    top_ohm[:, 0] += skin.lead_ohm[:rows]
    bottom_ohm[0] += skin.lead_ohm[rows:]
    shared = path_of_lines(top_ohm, bottom_ohm, skin.shape)
    whole = np.diag(shared.max(axis=0))
    coupling = wire_coupling_ohm(top_ohm, bottom_ohm, skin.shape)
    sign = np.diag(np.repeat([1.0, -1.0], (rows, columns)))
    ends = np.block([[incidence(rows, columns), np.zeros((cells, lines))], [sign, -sign]])
    root = np.sqrt(np.concatenate([skin.cell_siemens.ravel(), np.ones(lines)]))[:, None]
    system = np.eye(len(root)) + root * np.block([[coupling, shared], [shared.T, whole]]) * root.T
    return admittance_of(solve_lower(cholesky(system), ends * root))


def _connected_parts(cell_siemens: Float) -> NDArray[np.intp]:
    """Number of the connected part of each electrode, shape (R+C,): rows first, then columns."""
    rows, columns = cell_siemens.shape
    joined = cell_siemens > 0
    if joined.all():
        return np.zeros(rows + columns, dtype=np.intp)
    from scipy.sparse.csgraph import connected_components  # loaded when needed

    graph = np.zeros((rows + columns, rows + columns))
    graph[:rows, rows:] = joined
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def readings(skin: Skin) -> Float:
    """Sense-node voltages / Vdd, shape (R, C, 4): y = offset + sign R_ref I."""
    rows, leads = skin.shape[0], skin.lead_ohm
    port_ohm = port_resistance_ohm(skin) + leads[:rows, None] + leads[rows:]
    current = 1.0 / (port_ohm + skin.ref_top_ohm + skin.ref_bottom_ohm)
    return ratio_from_current(current, skin.ref_top_ohm, skin.ref_bottom_ohm)


@one_blas_thread
def all_readings(skin: Skin, admittance: Float) -> Float:
    """Readings a to h, shape (R, C, 8). admittance: `end_admittance` of the skin; overwritten.

    v_k = Z[k, i] - Z[k, j] is the potential of end k per current of the port of row i and column j.
    A far end differs from its near end by what the wire between them loses. With both supplies
    exchanged, each reading y becomes 1 - y.
    """
    rows, lines = skin.shape[0], sum(skin.shape)
    part = _connected_parts(skin.cell_siemens)
    impedance, _ = impedance_of(admittance, rows, np.tile(part, 2))
    row, column = np.arange(rows)[:, None], np.arange(rows, lines)
    near_row, near_column, far_row, far_column = (
        impedance[end, row] - impedance[end, column]
        for end in (row, column, lines + row, lines + column)
    )
    port_ohm = np.maximum(near_row - near_column, 0.0)
    port_ohm[part[row] != part[column]] = np.inf
    current = 1.0 / (port_ohm + skin.ref_top_ohm + skin.ref_bottom_ohm)
    a, b = 1.0 - skin.ref_top_ohm * current, skin.ref_bottom_ohm * current
    e, f = a - current * (near_row - far_row), b + current * (far_column - near_column)
    return np.stack([a, b, 1.0 - b, 1.0 - a, e, f, 1.0 - f, 1.0 - e], axis=-1)
