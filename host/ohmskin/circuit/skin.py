# SPDX-License-Identifier: Apache-2.0
"""The skin's circuit: from resistances to the four readings of every cell, and back to a current.

Symbols

====== ============ ==================================================================== =========
symbol shape        meaning                                                              unit
====== ============ ==================================================================== =========
R, C                row stripes (top layer), column stripes (bottom layer)
g      (R, C)       cell conductance, joins top node T[i,j] and bottom node B[i,j]       S
Rt     (R, C)       top wire segment that ends at T[i,j], from T[i,j-1] or the electrode  ohm
Rb     (R, C)       bottom segment that ends at B[i,j], from B[i-1,j] or the electrode    ohm
K      (RC, RC)     voltage lost in the wires to cell e per current of cell f            ohm
E      (R+C, RC)    incidence: +1 at a cell's row electrode, -1 at its column electrode
Y      (R+C, R+C)   admittance of the skin seen from its electrodes                      S
Z      (R+C, R+C)   inverse of Y, one electrode of each connected part grounded          ohm
rho    (R, C)       port resistance between row electrode i and column electrode j       ohm
I      (R, C)       current through a selected port, per volt of Vdd                     S
y      (R, C, 4)    sense-node voltage / Vdd, in the order of `CONFIGURATIONS`           1
====== ============ ==================================================================== =========

Equations. With x the cell currents and V the electrode potentials,

    (diag(1/g) + K) x = E^T V ,     Y = E (diag(1/g) + K)^-1 E^T ,
    rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j] ,     I = 1 / (rho + R_top + R_bottom) .

This is Kirchhoff's law on the network of 2RC nodes with the wire nodes eliminated: along a chain,
cells j and k share the wire up to the nearer of them, so K is a sum of segments. Open cells (g = 0)
and wires of zero ohm need no special value. What is factorised is 1 + sqrt(g) K sqrt(g).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.small import cholesky, one_blas_thread, solve, solve_lower
from ohmskin.link.protocol import MODES

Wire = float | Float  # segments of a layer: one number for all of them, or (R, C)

NEAR: Final = MODES["near"]
CONFIGURATIONS: Final = tuple(name.upper() for name in NEAR)
READINGS_PER_CELL: Final = len(NEAR)
# Every configuration reads y = offset + sign * R * I, R the reference resistor of the sensed layer.
READING_OFFSET: Final[Float] = np.array([1.0, 0.0, 1.0, 0.0])
READING_SIGN: Final[Float] = np.array([-1.0, 1.0, -1.0, 1.0])
READING_SENSES_TOP: Final[NDArray[np.bool_]] = np.array([True, False, False, True])

# Readings of the same node with the supplies exchanged: near and far row, near and far column.
EXCHANGED: Final = {"a": "d", "b": "c", "e": "h", "f": "g"}

DEFAULT_REF_OHM: Final = 30_000.0


@dataclass(frozen=True, eq=False)
class Skin:
    """Every resistance of the circuit: cells (R, C) [S], wire segments (R, C) [ohm], references.

    `top_wire_ohm[i, j]` ends at T[i, j], `bottom_wire_ohm[i, j]` at B[i, j]; index 0 along the
    stripe is the segment from the electrode. Zeros are exact. Arrays are copied and read-only.
    Raises ValueError for other shapes, values that are negative or not finite, references not > 0.
    """

    cell_siemens: Float
    top_wire_ohm: Float
    bottom_wire_ohm: Float
    ref_top_ohm: float = DEFAULT_REF_OHM
    ref_bottom_ohm: float = DEFAULT_REF_OHM

    def __post_init__(self) -> None:
        check_references(self.ref_top_ohm, self.ref_bottom_ohm)
        shape = np.shape(self.cell_siemens)
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"cell_siemens must be (rows, columns), at least 1x1, not {shape}")
        for name in ("cell_siemens", "top_wire_ohm", "bottom_wire_ohm"):
            resistances = np.array(getattr(self, name), dtype=np.float64)
            if resistances.shape != shape:
                raise ValueError(f"{name} has shape {resistances.shape}, cell_siemens {shape}")
            if not np.all(np.isfinite(resistances) & (resistances >= 0)):
                raise ValueError(f"{name} must be finite and not negative")
            resistances.setflags(write=False)
            object.__setattr__(self, name, resistances)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.cell_siemens.shape
        return rows, columns


def check_references(ref_top_ohm: float, ref_bottom_ohm: float) -> None:
    """Raise ValueError unless both reference resistors are positive and finite."""
    for name, ohm in (("ref_top_ohm", ref_top_ohm), ("ref_bottom_ohm", ref_bottom_ohm)):
        if not (np.isfinite(ohm) and ohm > 0):
            raise ValueError(f"{name} must be positive and finite, not {ohm}")


@lru_cache(maxsize=8)
def _incidence(rows: int, columns: int) -> Float:
    """E^T, (RC, R+C): a cell's voltage is the potential of its row less that of its column."""
    by_row = np.kron(np.eye(rows), np.ones((columns, 1)))
    return np.hstack([by_row, -np.tile(np.eye(columns), (rows, 1))])


_triangle = lru_cache(maxsize=8)(np.tri)  # ones: which cells are behind a segment


@lru_cache(maxsize=8)
def _unit_coupling(rows: int, columns: int) -> tuple[Float, Float]:
    """K of top wires, and of bottom wires, of 1 ohm a segment."""
    shape = rows, columns
    ones, zeros = np.ones(shape), np.zeros(shape)
    return wire_coupling_ohm(ones, zeros, shape), wire_coupling_ohm(zeros, ones, shape)


def wire_coupling_ohm(top_wire_ohm: Wire, bottom_wire_ohm: Wire, shape: tuple[int, int]) -> Float:
    """K [ohm], shape (RC, RC): K[e, f] is the wire shared by the paths to cells e and f."""
    rows, columns = shape
    if isinstance(top_wire_ohm, float) and isinstance(bottom_wire_ohm, float):
        by_top, by_bottom = _unit_coupling(rows, columns)
        return np.asarray(top_wire_ohm * by_top + bottom_wire_ohm * by_bottom)
    i, j = np.arange(rows), np.arange(columns)
    coupling = np.zeros((rows, columns, rows, columns))
    np.einsum("ijik->ijk", coupling)[:] = np.cumsum(top_wire_ohm, 1)[:, np.minimum.outer(j, j)]
    np.einsum("ijkj->ikj", coupling)[:] += np.cumsum(bottom_wire_ohm, 0)[np.minimum.outer(i, i)]
    return coupling.reshape(rows * columns, rows * columns)


def factorised(
    root: Float, top_wire_ohm: Wire, bottom_wire_ohm: Wire, to_sense: Float | None = None
) -> tuple[Float, Float]:
    """L and L^-1 sqrt(g) [E^T F] with L L^T = 1 + sqrt(g) K sqrt(g): `root` is sqrt(g), (R, C).

    The second, without F, gives Y = half^T half.
    """
    system = wire_coupling_ohm(top_wire_ohm, bottom_wire_ohm, root.shape)
    system *= root.reshape(-1, 1)
    system *= root.reshape(1, -1)
    system.ravel()[:: len(system) + 1] += 1.0
    factor, ends = cholesky(system), _incidence(*root.shape)
    if to_sense is not None:
        ends = np.hstack([ends, to_sense])
    return factor, solve_lower(factor, ends * root.reshape(-1, 1))


def admittance_of(half: Float) -> Float:
    """Y = half^T half. No current leaves the skin: a diagonal made from its row keeps small
    conductances that rounding of the large ones would drown.
    """
    admittance: Float = half.T @ half
    diagonal = np.einsum("ii->i", admittance)
    diagonal[:] = 0.0
    diagonal[:] = -admittance.sum(axis=1)
    return admittance


@one_blas_thread
def port_resistance_ohm(skin: Skin) -> Float:
    """rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j] [ohm], shape (R, C), all other electrodes floating.

    A port that no chain of cells connects (all of them open) is inf.
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
    """Z and rho (R, C) of Y, which is overwritten. part: each electrode's; None: all are connected.

    Grounding any one electrode of a connected part changes no resistance within it. The best
    connected one costs the least precision.
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


def _path_of_lines(top_wire_ohm: Wire, bottom_wire_ohm: Wire, shape: tuple[int, int]) -> Float:
    """Wire from each cell to the near end of its row, and of its column [ohm], (RC, R+C)."""
    if isinstance(top_wire_ohm, float) and isinstance(bottom_wire_ohm, float):
        each = np.repeat([top_wire_ohm, bottom_wire_ohm], shape)
        return np.asarray(_unit_path(*shape) * each)
    rows, columns = shape
    to_cell = np.zeros((rows, columns, rows + columns))
    np.einsum("iji->ij", to_cell[..., :rows])[:] = np.cumsum(top_wire_ohm, 1)
    np.einsum("ijj->ij", to_cell[..., rows:])[:] = np.cumsum(bottom_wire_ohm, 0)
    return to_cell.reshape(rows * columns, -1)


@lru_cache(maxsize=8)
def _unit_path(rows: int, columns: int) -> Float:
    """The same of wires of 1 ohm a segment."""
    ones = np.ones((rows, columns))
    return _path_of_lines(ones, ones, ones.shape)


@one_blas_thread
def end_admittance(skin: Skin) -> Float:
    """Y [S] of both ends of all lines, (2(R+C), 2(R+C)): near ends, rows first, then far ends.

    A far end is behind 1 ohm, a multiplexer's, at T[i, C-1] or B[R-1, j]: one more cell of its
    line, which shares wires with the others.
    """
    rows, columns = skin.shape
    cells, lines = rows * columns, rows + columns
    shared = _path_of_lines(skin.top_wire_ohm, skin.bottom_wire_ohm, skin.shape)
    whole = np.diag(shared.max(axis=0))
    coupling = wire_coupling_ohm(skin.top_wire_ohm, skin.bottom_wire_ohm, skin.shape)
    sign = np.diag(np.repeat([1.0, -1.0], (rows, columns)))
    ends = np.block([[_incidence(rows, columns), np.zeros((cells, lines))], [sign, -sign]])
    root = np.sqrt(np.concatenate([skin.cell_siemens.ravel(), np.ones(lines)]))[:, None]
    system = np.eye(len(root)) + root * np.block([[coupling, shared], [shared.T, whole]]) * root.T
    return admittance_of(solve_lower(cholesky(system), ends * root))


def port_difference(lines: Float, rows: int) -> Float:
    """What a port's row has less what its column has, (RC, n), from all lines, (R+C, n)."""
    return (lines[:rows, None] - lines[None, rows:]).reshape(-1, lines.shape[1])


def wire_current(cell_current: Float) -> Float:
    """Currents through all wires, (n, 2, R, C), from those through the cells (n, R, C).

    A wire segment carries what the cells behind it draw: sums as products, which is faster.
    """
    _, rows, columns = cell_current.shape
    current = np.empty((len(cell_current), 2, rows, columns))
    by_row = cell_current.reshape(-1, columns) @ _triangle(columns)
    current[:, 0] = by_row.reshape(cell_current.shape)
    np.matmul(_triangle(rows).T, cell_current, out=current[:, 1])
    return current


class PortCircuit:
    """Ports of a skin whose cells conduct (g > 0), in row-major order, and what moves them.

    A port is driven at its near ends, and sensed there or at far ends, where no current flows.
    port_ohm: voltage between the sensed ends per current through the port (RC,): rho, or at far
    ends the cell without its wires. drop_ohm (2, RC): what wires lose up to the sensed ends, of
    row and column. The others are slopes, d port_ohm / d log r_e = r_e i_e j_e [ohm]: i_e is the
    current through resistance e, j_e that of a current through the sensed ends (Tellegen). So the
    currents that give port_ohm give all RC x 3RC derivatives. A port's currents are those of its
    row less those of its column. Cells (R, C) [S], wires (R, C) [ohm], or one number where all
    segments of their layer are alike. far: whether rows, and columns, are sensed at their far ends.

    F (RC, R+C) is the voltage that current into the sensed end of a line inserts in the paths of
    its cells: the wire that they share. With Q = E (diag(1/g) + K)^-1 F, the sensed ends have the
    potentials (Z (1 - Q))^T per current into the near ends.
    """

    def __init__(
        self,
        cell_siemens: Float,
        top_wire_ohm: Wire,
        bottom_wire_ohm: Wire,
        *,
        far: tuple[bool, bool] = (False, False),
    ) -> None:
        self.shape, self.rows = cell_siemens.shape, len(cell_siemens)
        self.wire_ohm, self.far = (top_wire_ohm, bottom_wire_ohm), far
        self._root, to_sense = np.sqrt(cell_siemens), None
        if any(far):
            sign = np.repeat([1.0 * far[0], -1.0 * far[1]], self.shape)
            to_sense = sign * _path_of_lines(top_wire_ohm, bottom_wire_ohm, self.shape)
        self.factor, self._half = factorised(self._root, *self.wire_ohm, to_sense)
        near = self._half[:, : sum(self.shape)]
        self._impedance, port_ohm = impedance_of(admittance_of(near), self.rows)
        self._sensed = self._impedance
        if to_sense is not None:
            lost = self._impedance @ (near.T @ self._half[:, sum(self.shape) :])
            self._sensed = self._impedance - lost
            drop = _ends_of_ports(lost, self.rows)
            self.drop_ohm: Float = np.stack([drop[0], -drop[1]]).reshape(2, -1)
            port_ohm = port_ohm - self.drop_ohm.sum(axis=0).reshape(self.shape)
        self.port_ohm: Float = port_ohm.ravel()

    @cached_property
    def _currents(self) -> Float:
        """Currents through all cells per potential of each electrode, and those that F drives."""
        currents = solve_lower(self.factor, self._half, transposed=True)
        currents *= self._root.reshape(-1, 1)
        return currents

    @property
    def per_potential(self) -> Float:
        """Currents through all cells per potential of each electrode, (RC, R+C) [S]."""
        return self._currents[:, : sum(self.shape)]

    @cached_property
    def cell_current(self) -> Float:
        """Currents through all cells per current into each electrode, (R+C, R, C)."""
        return (self._impedance @ self.per_potential.T).reshape(-1, *self.shape)

    @cached_property
    def sense_current(self) -> Float:
        """The same per current into each sensed end."""
        if not any(self.far):
            return self.cell_current
        driven = self._currents[:, sum(self.shape) :].T
        return (self._sensed.T @ self.per_potential.T + driven).reshape(-1, *self.shape)

    @cached_property
    def _wire_current(self) -> Float:
        """Currents through all wires, (R+C, 2, R, C), per current into each electrode."""
        return wire_current(self.cell_current)

    @cached_property
    def _wire_sense_current(self) -> Float:
        """The same per current into each sensed end: it flows back through the whole far line."""
        if not any(self.far):
            return self._wire_current
        current = wire_current(self.sense_current)
        if self.far[0]:
            np.einsum("iij->ij", current[: self.rows, 0])[:] -= 1.0
        if self.far[1]:
            np.einsum("jij->ij", current[self.rows :, 1])[:] += 1.0
        return current

    def line_current(self, layer: int) -> Float:
        """Currents through a port's own row (layer 0), or column, (lines, ports, segments)."""
        rows, current = self.rows, self._wire_current[:, layer]
        if layer == 0:
            own = np.einsum("iik->ik", current[:rows])[:, None]
            return np.asarray(own - current[rows:].transpose(1, 0, 2))
        own = np.einsum("jkj->jk", current[rows:])[:, None]
        return np.asarray(current[:rows].transpose(2, 0, 1) - own)

    def _slopes(self, current: Float, sensed: Float, ohm: Float) -> Float:
        slopes = port_difference(current.reshape(len(current), -1), self.rows)
        if sensed is current:
            slopes *= slopes
        else:
            slopes *= port_difference(sensed.reshape(len(sensed), -1), self.rows)
        slopes *= ohm.ravel()
        return slopes

    def by_cell(self) -> Float:
        """Slopes by the cells, (RC, RC)."""
        return self._slopes(self.cell_current, self.sense_current, self._root**-2.0)

    def by_wires(self) -> Float:
        """Slopes by the wire segments, (RC, 2RC): top ones, then bottom ones."""
        ohm = np.empty((2, *self.shape))
        ohm[0], ohm[1] = self.wire_ohm
        return self._slopes(self._wire_current, self._wire_sense_current, ohm)

    def by_layers(self) -> Float:
        """Their sums over each layer, (RC, 2): a product of lines instead of squares of ports."""
        found, lines = [], len(self._impedance)
        for layer, ohm in enumerate(self.wire_ohm):
            current = self._wire_current[:, layer].reshape(lines, -1)
            sensed = self._wire_sense_current[:, layer].reshape(lines, -1)
            row, column = _ends_of_ports((current * np.ravel(ohm)) @ sensed.T, self.rows)
            found.append((row - column).ravel())
        return np.transpose(found)


def _ends_of_ports(lines: Float, rows: int) -> Float:
    """At row and at column, (2, R, C), of what each line's current makes at lines, (R+C, R+C)."""
    own, by_row, by_column = lines.diagonal(), lines[:rows, rows:], lines[rows:, :rows]
    return np.stack([own[:rows, None] - by_column.T, by_row - own[rows:]])


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


@lru_cache(maxsize=8)
def reference_ohm(ref_top_ohm: float, ref_bottom_ohm: float) -> Float:
    """The reference resistor that each configuration senses [ohm], shape (4,), read-only."""
    reference = np.where(READING_SENSES_TOP, ref_top_ohm, ref_bottom_ohm)
    reference.setflags(write=False)
    return reference


def ratio_from_current(
    current_siemens: ArrayLike, ref_top_ohm: float, ref_bottom_ohm: float
) -> Float:
    """y = offset + sign * R_ref * I, shape (..., 4), for currents per Vdd (...) [S]."""
    current = np.asarray(current_siemens, dtype=np.float64)[..., None]
    slope = READING_SIGN * reference_ohm(ref_top_ohm, ref_bottom_ohm)
    return np.asarray(READING_OFFSET + slope * current, dtype=np.float64)


def node_ratio(ratio: Float, reading_names: Sequence[str], node: str) -> Float:
    """Potential over Vdd, top pin high, where reading `node` (a, b, e, f) is taken, (...).

    Mean of what readings (..., n) of these names have of it: with the supplies exchanged, each is 1
    less. Raises ValueError if none of them is of this node.
    """
    high = [ratio[..., k] for k, name in enumerate(reading_names) if name == node]
    low = [1 - ratio[..., k] for k, name in enumerate(reading_names) if name == EXCHANGED[node]]
    if not (high or low):
        raise ValueError(
            f"readings {' '.join(reading_names)}: neither {node} nor {EXCHANGED[node]}"
        )
    return np.asarray(sum(high + low) / len(high + low), dtype=np.float64)


def as_near(ratio: Float, reading_names: Sequence[str]) -> Float:
    """Readings a to d, from (..., n) of these names, which have both near ends."""
    if tuple(reading_names) == NEAR:
        return ratio
    a, b = (node_ratio(ratio, reading_names, node) for node in "ab")
    return np.stack([a, b, 1 - b, 1 - a], axis=-1)


def current_from_ratio(ratio: Float, ref_top_ohm: float, ref_bottom_ohm: float) -> Float:
    """I = sum_k R_k s_k (y_k - offset_k) / sum_k R_k^2, per Vdd [S], shape (...,) from (..., 4).

    Each reading alone gives I_k = s_k (y_k - offset_k) / R_k; weights R_k^2 are the combination of
    least variance when all readings are equally noisy.
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    weight = READING_SIGN * reference / (reference @ reference)
    return np.asarray((ratio - READING_OFFSET) @ weight, dtype=np.float64)


def current_std(ratio_std: float, ref_top_ohm: float, ref_bottom_ohm: float) -> float:
    """Standard deviation of `current_from_ratio` [S]: ratio_std * sum_k R_k / sum_k R_k^2.

    The sum is linear, not quadratic, because without other noise all four readings round alike. For
    other noise this is an upper bound (too large by 2 at most).
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    return float(ratio_std * np.sum(reference) / np.sum(reference**2))


def readings(skin: Skin) -> Float:
    """Sense-node voltages / Vdd, shape (R, C, 4): y = offset + sign R_ref / (rho + Rt + Rb)."""
    current = 1.0 / (port_resistance_ohm(skin) + skin.ref_top_ohm + skin.ref_bottom_ohm)
    return ratio_from_current(current, skin.ref_top_ohm, skin.ref_bottom_ohm)


@one_blas_thread
def all_readings(skin: Skin, admittance: Float) -> Float:
    """Readings a to h, shape (R, C, 8). admittance: of the ends, as `end_admittance`; overwritten.

    v_k = Z[k, i] - Z[k, j] is the potential of end k per current of the port of row i and column j.
    A far end's differs from its near end's by the wire between them, as far as it carries current.
    Both supplies exchanged turn each reading y into 1 - y.
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
