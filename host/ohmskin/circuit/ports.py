# SPDX-License-Identifier: Apache-2.0
"""What the ports of a skin show, and their slopes by every resistance.

Symbols are those of `ohmskin.circuit.skin`.
"""

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import (
    Wire,
    admittance_of,
    factorised,
    impedance_of,
    leak_admittance,
    path_of_lines,
)
from ohmskin.circuit.small import solve_lower

# Ones on and below the diagonal, (n, n): which cells k of a line are behind segment j, k >= j.
_triangle = lru_cache(maxsize=8)(np.tri)


def solve_ports(cell_siemens: Float) -> tuple[Float, Float]:
    """rho (R, C) [ohm], and Z, of cells (R, C) [S], all > 0, whose stripes have no resistance."""
    rows, columns = cell_siemens.shape
    laplacian = np.zeros((rows + columns, rows + columns))
    laplacian[:rows, rows:] = -cell_siemens
    laplacian[rows:, :rows] = -cell_siemens.T
    degree = np.concatenate([cell_siemens.sum(axis=1), cell_siemens.sum(axis=0)])
    laplacian.ravel()[:: rows + columns + 1] = degree
    impedance, port_ohm = impedance_of(laplacian, rows)
    return np.maximum(port_ohm, 0.0), impedance


def cells_of_ports(port_siemens: Float) -> Float:
    """About what cells conduct, (R, C) [S], whose stripes have no resistance and whose ports
    conduct G, (R, C), all > 0.

    A port also conducts by paths around its cell: through the other cells of its row, and then
    those of its column. With G_row and G_column the sums of the other G of both, and P = G_row
    G_column / (G_row + G_column), a cell is taken for G^2 / (G + P).
    """
    by_row, by_column = (
        port_siemens.sum(axis=axis, keepdims=True) - port_siemens for axis in (1, 0)
    )
    around = by_row * by_column / np.maximum(by_row + by_column, np.finfo(np.float64).tiny)
    return np.asarray(port_siemens * port_siemens / (port_siemens + around))


def wires_add_ohm(impedance: Float, cell_siemens: Float, wire_ohm: tuple[float, float]) -> Float:
    """What stripes of so much resistance would add to rho of `solve_ports`, (R, C) [ohm], nearly.

    It is the sum of r i^2 over all segments, i the currents while stripes have no resistance.

    impedance, cell_siemens: Z and the cells of `solve_ports`.
    wire_ohm: a segment of the top layer, and of the bottom layer.
    """
    rows, columns = cell_siemens.shape
    current = wire_current((impedance[:, :rows, None] - impedance[:, None, rows:]) * cell_siemens)
    # As many segments lie in one layer as in the other.
    root = np.sqrt(np.repeat(wire_ohm, rows * columns))
    current = root * current.reshape(rows + columns, -1)
    sums = current @ current.T
    own = sums.diagonal()
    return np.asarray(own[:rows, None] + own[rows:] - 2 * sums[:rows, rows:])


def port_difference(lines: Float, rows: int) -> Float:
    """For each port, the values of its row less those of its column: (RC, n), from (R+C, n)."""
    ports = rows * (len(lines) - rows)
    return (lines[:rows, None] - lines[None, rows:]).reshape(ports, lines.shape[1])


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
            to_sense = sign * path_of_lines(top_wire_ohm, bottom_wire_ohm, self.shape)
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
            own, rows = lost.diagonal(), self.rows  # what each line loses of its own current
            of_rows = own[:rows, None] - lost[rows:, :rows].T
            of_columns = own[rows:] - lost[:rows, rows:]
            self.drop_ohm = np.stack([of_rows, of_columns]).reshape(2, -1)
            port_ohm = port_ohm - (of_rows + of_columns)
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
        """r_e i_e j_e of all ports, (RC, k), from currents of lines, (R+C, k), and r, (k,)."""
        # Lines are fewer than ports: so r_e is multiplied by first.
        root = np.sqrt(ohm)
        slopes = port_difference(current * root, self.rows)
        slopes *= port_difference(sensed * root, self.rows) if any(self.far) else slopes
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
        apart, sensed = (each[first] - each[first + 1] for each in (self.impedance, self.sensed))
        shorts = np.arange(len(first))
        z = apart[shorts, first] - apart[shorts, first + 1]
        x, xs = port_difference(apart.T, self.rows), port_difference(sensed.T, self.rows)
        return np.asarray(self.port_ohm[:, None] - x * xs / (z + short_ohm))

    def by_cell(self) -> Float:
        """Slopes by the log resistance of each cell, (RC, RC) [ohm]."""
        current, sensed = _of_lines(self.cell_current), _of_lines(self.sense_current)
        return self._slopes(current, sensed, self._root.ravel() ** -2.0)

    @cached_property
    def segment_ohm(self) -> Float:
        """All wire segments, those of the top layer first, (2RC,) [ohm]."""
        ohm = np.empty((2, *self.shape))
        ohm[0], ohm[1] = self.wire_ohm  # faster than to broadcast and stack them
        return ohm.ravel()

    def by_wires(self, some: NDArray[np.intp] | slice = slice(None)) -> Float:
        """Slopes by the log of each wire segment, (RC, 2RC) [ohm]: top segments come first.

        some: only by these segments.
        """
        current, sensed = _of_lines(self._wire_current), _of_lines(self._wire_sense_current)
        return self._slopes(current[:, some], sensed[:, some], self.segment_ohm[some])

    def most_by_wires(self, weight: Float) -> Float:
        """No slope of `by_wires`, times the weight of its port, is larger than this, (2RC,).

        weight: of each port, at least 0, (RC,).

        With i = a - b of the row and the column of a port, i^2 is at most 2 a^2 + 2 b^2, and of two
        currents i j is at most the mean of their squares.
        """
        by_port = weight.reshape(self.shape)
        heaviest = np.concatenate([by_port.max(axis=1), by_port.max(axis=0)])  # of each line
        square = np.zeros(2 * by_port.size)
        for current in (self._wire_current, self._wire_sense_current):
            each = heaviest[:, None] * _of_lines(current) ** 2
            square += each[: self.rows].max(axis=0) + each[self.rows :].max(axis=0)
        return self.segment_ohm * square

    def by_lines(self) -> Float:
        """Slopes by the log of all segments of a line together, (RC, R+C) [ohm]: rows first."""
        top, bottom = self.segment_ohm.reshape(2, *self.shape)
        (rows, columns), (rows_sensed, columns_sensed) = (
            (each[:, 0].transpose(1, 0, 2), each[:, 1].transpose(2, 0, 1))
            for each in (self._wire_current, self._wire_sense_current)
        )
        by_row = (rows * top[:, None]) @ rows_sensed.transpose(0, 2, 1)
        by_column = (columns * bottom.T[:, None]) @ columns_sensed.transpose(0, 2, 1)
        return self._slopes_of_sums(np.concatenate([by_row, by_column]))

    def by_layers(self) -> Float:
        """Slopes by the log of all segments of a layer together, (RC, 2) [ohm]."""
        lines, ohm = sum(self.shape), self.segment_ohm.reshape(2, -1)
        current = self._wire_current.reshape(lines, 2, -1).transpose(1, 0, 2)
        sensed = self._wire_sense_current.reshape(lines, 2, -1).transpose(1, 2, 0)
        return self._slopes_of_sums(
            np.stack([(current[layer] * ohm[layer]) @ sensed[layer] for layer in (0, 1)])
        )

    def _slopes_of_sums(self, sums: Float) -> Float:
        """The sums of r i j over some segments, (RC, k), for each of k sets of segments.

        With i = a - b of the row and the column of a port, and j = a' - b', this is the sum of
        r a a', less those of r a b' and r b a', and that of r b b': sums of lines are enough.

        sums: of r a a' for each two lines, (k, R+C, R+C) [ohm].
        """
        rows, own = self.rows, np.einsum("kll->kl", sums)
        slopes = own[:, :rows, None] + own[:, None, rows:] - sums[:, :rows, rows:]
        slopes -= sums[:, rows:, :rows].transpose(0, 2, 1)
        return np.asarray(slopes.reshape(len(sums), -1).T)

    def by_leaks(self) -> Float:
        """Slopes by the leaks of rows, and of columns, (RC, 2) [ohm / S]."""
        volt = port_difference(self.impedance.T, self.rows)
        sensed = port_difference(self.sensed.T, self.rows)
        return leak_slopes(volt, sensed, self.shape)


def _of_lines(current: Float) -> Float:
    """(R+C, k), from currents of lines through k resistances in whatever shape."""
    return current.reshape(len(current), -1)


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
