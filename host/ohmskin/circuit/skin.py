# SPDX-License-Identifier: Apache-2.0
"""The circuit of a skin: from resistances to the readings of every cell, and back to a current.

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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.small import cholesky, one_blas_thread, solve, solve_lower
from ohmskin.link.protocol import MODES

# Wire segments of a layer [ohm]: one number if all are alike, which is faster, or (R, C).
Wire = float | Float

NEAR: Final = MODES["near"]
CONFIGURATIONS: Final = tuple(name.upper() for name in NEAR)
READINGS_PER_CELL: Final = len(NEAR)
# Configurations A to D read y = offset + sign * R_ref * I, R_ref the resistor that they sense.
READING_OFFSET: Final[Float] = np.array([1.0, 0.0, 1.0, 0.0])
READING_SIGN: Final[Float] = np.array([-1.0, 1.0, -1.0, 1.0])
READING_SENSES_TOP: Final[Bool] = np.array([True, False, False, True])

# A node's reading with the top pin high, and its reading with the bottom pin high: near end of the
# row, near end of the column, far end of the row, far end of the column.
EXCHANGED: Final = {"a": "d", "b": "c", "e": "h", "f": "g"}

# A reference resistor, unless told [ohm]: that of the wiring in README.md.
DEFAULT_REF_OHM: Final = 30_000.0
# No reference, wire or lead has more [ohm]. Chosen: a gigohm. No converter sees a current through
# it, and squares of what is computed with it stay finite.
MAX_OHM: Final = 1e9


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


def check_references(ref_top_ohm: float, ref_bottom_ohm: float) -> None:
    """Raise ValueError unless both reference resistors are within 1..`MAX_OHM`."""
    for name, ohm in (("ref_top_ohm", ref_top_ohm), ("ref_bottom_ohm", ref_bottom_ohm)):
        if not 1 <= ohm <= MAX_OHM:
            raise ValueError(f"{name} must be from 1 to {MAX_OHM:g}, not {ohm:g}")


@lru_cache(maxsize=8)
def _incidence(rows: int, columns: int) -> Float:
    """E^T, (RC, R+C): a cell's voltage is the potential of its row less that of its column."""
    by_row = np.kron(np.eye(rows), np.ones((columns, 1)))
    return np.hstack([by_row, -np.tile(np.eye(columns), (rows, 1))])


# Ones on and below the diagonal, (n, n): which cells k of a line are behind segment j, k >= j.
_triangle = lru_cache(maxsize=8)(np.tri)


@lru_cache(maxsize=8)
def _unit_coupling(rows: int, columns: int) -> tuple[Float, Float]:
    """K of a skin with 1 ohm in each top segment alone, and in each bottom segment alone."""
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
    """L of L L^T = 1 + sqrt(g) K sqrt(g), (RC, RC), and "half", L^-1 sqrt(g) [E^T F].

    With the columns of "half" that belong to E^T, Y is half^T half.

    root: sqrt(g), (R, C).
    to_sense: F (RC, R+C); None: near ends are sensed, and "half" has no columns of F.
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


def _path_of_lines(top_wire_ohm: Wire, bottom_wire_ohm: Wire, shape: tuple[int, int]) -> Float:
    """Wire from each cell to the near end of its row, and of its column [ohm], (RC, R+C)."""
    if isinstance(top_wire_ohm, float) and isinstance(bottom_wire_ohm, float):
        segment_ohm = np.repeat([top_wire_ohm, bottom_wire_ohm], shape)
        return np.asarray(_unit_path(*shape) * segment_ohm)
    rows, columns = shape
    to_cell = np.zeros((rows, columns, rows + columns))
    np.einsum("iji->ij", to_cell[..., :rows])[:] = np.cumsum(top_wire_ohm, 1)
    np.einsum("ijj->ij", to_cell[..., rows:])[:] = np.cumsum(bottom_wire_ohm, 0)
    return to_cell.reshape(rows * columns, -1)


@lru_cache(maxsize=8)
def _unit_path(rows: int, columns: int) -> Float:
    """`_path_of_lines` of wires of 1 ohm a segment."""
    ones = np.ones((rows, columns))
    return _path_of_lines(ones, ones, ones.shape)


def leak_admittance(shape: tuple[int, int], leak_siemens: tuple[float, float]) -> Float:
    """What leaks between neighbouring lines of a layer add to Y, (R+C, R+C) [S].

    leak_siemens: leaks of rows and of columns, at each crossing [S]. They are taken to join the
        electrodes of the lines, because they resist a thousand times as much as the wires up to
        them.
    """
    rows, columns = shape
    leaks = np.zeros((rows + columns, rows + columns))
    for first, lines, leak in (
        (0, rows, columns * leak_siemens[0]),
        (rows, columns, rows * leak_siemens[1]),
    ):
        chain = np.diff(np.eye(lines), axis=0)  # a row for each pair of neighbours
        leaks[first : first + lines, first : first + lines] = leak * (chain.T @ chain)
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
    shared = _path_of_lines(top_ohm, bottom_ohm, skin.shape)
    whole = np.diag(shared.max(axis=0))
    coupling = wire_coupling_ohm(top_ohm, bottom_ohm, skin.shape)
    sign = np.diag(np.repeat([1.0, -1.0], (rows, columns)))
    ends = np.block([[_incidence(rows, columns), np.zeros((cells, lines))], [sign, -sign]])
    root = np.sqrt(np.concatenate([skin.cell_siemens.ravel(), np.ones(lines)]))[:, None]
    system = np.eye(len(root)) + root * np.block([[coupling, shared], [shared.T, whole]]) * root.T
    return admittance_of(solve_lower(cholesky(system), ends * root))


def port_difference(lines: Float, rows: int) -> Float:
    """For each port, the values of its row less those of its column: (RC, n), from (R+C, n)."""
    return (lines[:rows, None] - lines[None, rows:]).reshape(-1, lines.shape[1])


def wire_current(cell_current: Float) -> Float:
    """Currents through all wires, (n, 2, R, C), from those through the cells (n, R, C).

    A wire segment carries the sum of the currents of all cells behind it. These sums are computed
    as products with a triangle of ones, which is faster than adding up.
    """
    _, rows, columns = cell_current.shape
    current = np.empty((len(cell_current), 2, rows, columns))
    by_row = cell_current.reshape(-1, columns) @ _triangle(columns)
    current[:, 0] = by_row.reshape(cell_current.shape)
    np.matmul(_triangle(rows).T, cell_current, out=current[:, 1])
    return current


class PortCircuit:
    """What the ports of a skin show, and its slopes by all resistances. All cells conduct (g > 0).

    Ports (RC,) are in row-major order. A port is driven at its near ends. It is sensed there, or at
    far ends, where no current flows out.

    shape, rows: (R, C), and R.
    wire_ohm: segments of the top and of the bottom layer, as they were given.
    far: whether rows, and whether columns, are sensed at their far ends.
    leak_siemens: between neighbouring rows, and columns, at each crossing [S] (`leak_admittance`).
    impedance: potentials of electrodes per current into each electrode, (R+C, R+C) [ohm].
    sensed: potentials of electrodes per current into each sensed end, (R+C, R+C) [ohm].
    factor: L of `factorised` (RC, RC).
    port_ohm: voltage between the sensed ends per current through the port (RC,) [ohm]. At near ends
        this is rho; at far ends it is rho less what the wires up to them lose.
    drop_ohm: voltage that the wire of the row, and that of the column, lose up to the sensed end,
        per current of the port (2, RC) [ohm]; 0 for lines that are sensed at near ends. Only a
        circuit that senses far ends has this attribute.

    **Slopes.** d port_ohm / d log r_e = r_e i_e j_e [ohm], by Tellegen's theorem. i_e is the
    current through resistance e while a current of one flows through the driven ends of the port,
    and j_e is the same if it flowed through the sensed ends. So the currents that give port_ohm
    also give all its RC x 3RC slopes. A port's currents are those of its row less those of its
    column: so R+C solutions are enough.

    **Far ends.** A current into the far end of a line flows through all of the line's wire. Each
    cell of the line shares a part of this wire, so a voltage is added in the path to this cell: F
    per current. By reciprocity, the sensed ends have the potentials (Z (1 - Q))^T per current into
    the near ends.
    """

    def __init__(
        self,
        cell_siemens: Float,
        top_wire_ohm: Wire,
        bottom_wire_ohm: Wire,
        *,
        far: tuple[bool, bool] = (False, False),
        leak_siemens: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Cells (R, C) [S], all > 0; wire segments [ohm]; far, leak_siemens: as the attributes."""
        self.shape, self.rows = cell_siemens.shape, len(cell_siemens)
        self.wire_ohm, self.far = (top_wire_ohm, bottom_wire_ohm), far
        self._root, to_sense = np.sqrt(cell_siemens), None
        if any(far):
            sign = np.repeat([1.0 * far[0], -1.0 * far[1]], self.shape)
            to_sense = sign * _path_of_lines(top_wire_ohm, bottom_wire_ohm, self.shape)
        self.factor, self._half = factorised(self._root, *self.wire_ohm, to_sense)
        near = self._half[:, : sum(self.shape)]
        admittance, self.leak_siemens = admittance_of(near), leak_siemens
        if any(leak_siemens):
            admittance += leak_admittance(self.shape, leak_siemens)
        self.impedance, port_ohm = impedance_of(admittance, self.rows)
        self.sensed = self.impedance
        if to_sense is not None:
            lost = self.impedance @ (near.T @ self._half[:, sum(self.shape) :])
            self.sensed = self.impedance - lost
            drop = _ends_of_ports(lost, self.rows)
            self.drop_ohm: Float = np.stack([drop[0], -drop[1]]).reshape(2, -1)
            port_ohm = port_ohm - self.drop_ohm.sum(axis=0).reshape(self.shape)
        self.port_ohm: Float = port_ohm.ravel()

    @cached_property
    def _currents(self) -> Float:
        """Currents through all cells per potential of each electrode, (RC, R+C).

        If far ends are sensed, R+C columns follow: the currents that F drives.
        """
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
        return (self.impedance @ self.per_potential.T).reshape(-1, *self.shape)

    @cached_property
    def sense_current(self) -> Float:
        """Currents through all cells per current into each sensed end, (R+C, R, C)."""
        if not any(self.far):
            return self.cell_current
        driven = self._currents[:, sum(self.shape) :].T
        return (self.sensed.T @ self.per_potential.T + driven).reshape(-1, *self.shape)

    @cached_property
    def _wire_current(self) -> Float:
        """Currents through all wires, (R+C, 2, R, C), per current into each electrode."""
        return wire_current(self.cell_current)

    @cached_property
    def _wire_sense_current(self) -> Float:
        """Currents through all wires per current into each sensed end, (R+C, 2, R, C).

        A current into a far end flows back to the near end, through the whole line.
        """
        if not any(self.far):
            return self._wire_current
        current = wire_current(self.sense_current)
        if self.far[0]:
            np.einsum("iij->ij", current[: self.rows, 0])[:] -= 1.0
        if self.far[1]:
            np.einsum("jij->ij", current[self.rows :, 1])[:] += 1.0
        return current

    def line_current(self, layer: int) -> Float:
        """Currents through the segments of a line, per current through each port of this line.

        (lines, ports of the line, segments); layer 0: lines are rows; layer 1: columns.
        """
        rows, current = self.rows, self._wire_current[:, layer]
        if layer == 0:
            by_row = np.einsum("iik->ik", current[:rows])[:, None]
            return np.asarray(by_row - current[rows:].transpose(1, 0, 2))
        by_column = np.einsum("jkj->jk", current[rows:])[:, None]
        return np.asarray(current[:rows].transpose(2, 0, 1) - by_column)

    def _slopes(self, current: Float, sensed: Float, ohm: Float) -> Float:
        """r_e i_e j_e of all ports, (RC, resistances), from currents of lines (R+C, ...)."""
        slopes = port_difference(current.reshape(len(current), -1), self.rows)
        if sensed is current:
            slopes *= slopes
        else:
            slopes *= port_difference(sensed.reshape(len(sensed), -1), self.rows)
        slopes *= ohm.ravel()
        return slopes

    def shorted_port_ohm(self, first: NDArray[np.intp], short_ohm: float) -> Float:
        """`port_ohm` if two near ends were joined, for each of k shorts by itself, (RC, k) [ohm].

        first: the first electrode of each short, of R+C; the other is the next one, (k,).
        short_ohm: what joins them, above 0.

        A current of one through a port makes the voltage x between both near ends. Joined, they
        carry x / (z + short_ohm), where z is their own port resistance (Thevenin). By reciprocity,
        this lowers the voltage at the sensed ends by xs of it: x for a current that flows through
        the sensed ends.
        """
        x, sensed = (
            port_difference((each[first] - each[first + 1]).T, self.rows)
            for each in (self.impedance, self.sensed)
        )
        apart = self.impedance[first] - self.impedance[first + 1]
        z = apart[np.arange(len(first)), first] - apart[np.arange(len(first)), first + 1]
        return np.asarray(self.port_ohm[:, None] - x * sensed / (z + short_ohm))

    def by_cell(self) -> Float:
        """Slopes by the log resistance of each cell, (RC, RC) [ohm]."""
        return self._slopes(self.cell_current, self.sense_current, self._root**-2.0)

    def by_wires(self) -> Float:
        """Slopes by the log of each wire segment, (RC, 2RC) [ohm]: top segments come first."""
        ohm = np.empty((2, *self.shape))
        ohm[0], ohm[1] = self.wire_ohm
        return self._slopes(self._wire_current, self._wire_sense_current, ohm)

    def by_layers(self) -> Float:
        """Slopes by the log of all segments of a layer together, (RC, 2) [ohm].

        They are the sums of `by_wires` over each layer. Here a product of the currents of lines
        gives them without the slopes by single segments, which takes less time.
        """
        slopes, lines = [], len(self.impedance)
        for layer, ohm in enumerate(self.wire_ohm):
            current = self._wire_current[:, layer].reshape(lines, -1)
            sensed = self._wire_sense_current[:, layer].reshape(lines, -1)
            row, column = _ends_of_ports((current * np.ravel(ohm)) @ sensed.T, self.rows)
            slopes.append((row - column).ravel())
        return np.transpose(slopes)

    def by_leaks(self) -> Float:
        """Slopes by the leaks of rows, and of columns, (RC, 2) [ohm / S]."""
        volt, sensed = (
            port_difference(potential.T, self.rows) for potential in (self.impedance, self.sensed)
        )
        return leak_slopes(volt, sensed, self.shape)


def leak_slopes(volt: Float, sensed: Float, shape: tuple[int, int]) -> Float:
    """d port_ohm / d leak of rows, and of columns, at each crossing, (n, 2) [ohm / S].

    For a single conductance, d port_ohm / d g = -v v', v and v' the voltages over it. A leak is one
    conductance between each two neighbouring lines at each crossing, so the products are summed.

    volt, sensed: potentials of electrodes (n, R+C), per current through the driven ends, and
        through the sensed ends, of n ports [ohm].
    """
    rows, columns = shape
    return np.stack(
        [
            -crossings * np.einsum("pl,pl->p", np.diff(volt[:, lines]), np.diff(sensed[:, lines]))
            for lines, crossings in ((slice(rows), columns), (slice(rows, None), rows))
        ],
        axis=1,
    )


def _ends_of_ports(lines: Float, rows: int) -> Float:
    """What the current of each port causes at its row and at its column, (2, R, C).

    lines[i, j] (R+C, R+C): what a current into line j causes at line i; or transposed. The current
        of a port flows into its row and out of its column.
    """
    at_itself, by_row, by_column = lines.diagonal(), lines[:rows, rows:], lines[rows:, :rows]
    return np.stack([at_itself[:rows, None] - by_column.T, by_row - at_itself[rows:]])


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


@lru_cache(maxsize=8)  # each frame asks for it again
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
    """Potential over Vdd of the node of reading a, b, e or f while the top pin is high, (...).

    It is the mean of those of the readings (..., n), of these names, that are taken at this node. A
    reading with exchanged supplies is 1 minus the potential. Raises ValueError if there is none.
    """
    high = [ratio[..., k] for k, name in enumerate(reading_names) if name == node]
    low = [1 - ratio[..., k] for k, name in enumerate(reading_names) if name == EXCHANGED[node]]
    if not (high or low):
        raise ValueError(
            f"readings {' '.join(reading_names)}: neither {node} nor {EXCHANGED[node]}"
        )
    return np.asarray(sum(high + low) / len(high + low), dtype=np.float64)


def is_near(reading_names: Iterable[str]) -> bool:
    """Whether these are readings at near ends, some of a to d: all say the same of a skin."""
    return set(reading_names) <= set(NEAR)


def as_near(ratio: Float, reading_names: Sequence[str]) -> Float:
    """Readings a to d (..., 4), made of readings at both ends. Those of near ends alone stay."""
    if is_near(reading_names):
        return ratio
    a, b = (node_ratio(ratio, reading_names, node) for node in "ab")
    return np.stack([a, b, 1 - b, 1 - a], axis=-1)


def current_from_ratio(ratio: Float, ref_top_ohm: float, ref_bottom_ohm: float) -> Float:
    """I = sum_k R_k s_k (y_k - offset_k) / sum_k R_k^2, per Vdd [S], shape (...,) from (..., 4).

    Each reading alone gives I_k = s_k (y_k - offset_k) / R_k, with s_k its `READING_SIGN` and R_k
    the reference that it senses. If all readings are equally noisy, the mean with the weights R_k^2
    has the least variance.
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    weight = READING_SIGN * reference / (reference @ reference)
    return np.asarray((ratio - READING_OFFSET) @ weight, dtype=np.float64)


def current_std(ratio_std: float, ref_top_ohm: float, ref_bottom_ohm: float) -> float:
    """Standard deviation of `current_from_ratio` [S]: ratio_std * sum_k R_k / sum_k R_k^2.

    Deviations are added, and not variances, because without other noise all four readings are
    rounded alike. For independent noise, the result is too large by a factor of at most 2.
    """
    reference = reference_ohm(ref_top_ohm, ref_bottom_ohm)
    return float(ratio_std * np.sum(reference) / np.sum(reference**2))


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
