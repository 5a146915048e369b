# SPDX-License-Identifier: Apache-2.0
"""The untouched skin, solved once, and what k touched cells make of it.

Symbols

====== ======== ================================================================== =====
symbol shape    meaning                                                            unit
====== ======== ================================================================== =====
rho0   (RC,)    port resistance of the untouched skin                              ohm
H      (RC, RC) voltage over cell e per current through port p                     ohm
M      (RC, RC) voltage over cell e per current forced through cell f from outside ohm
d      (k,)     what the touches add to the conductance of k cells                 S
q      (k, RC)  current that the added conductance draws, per port current         1
v      (RC, RC) voltage over cell e per current through port p, cells touched      ohm
====== ======== ================================================================== =====

Added conductances are a change of rank k (Woodbury):

    q = (diag(1/d) + M_kk)^-1 H_k ,   rho = rho0 - sum_k H_k q ,   v = H - M_k^T q ,

over the touched cells v_k = q / d. All derivatives follow: d rho / d g_e = -v_e^2 (Tellegen).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ohmskin.arrays import Float
from ohmskin.circuit.cholesky import solve_lower
from ohmskin.circuit.skin import by_wires, factorised, impedance_of

Cells = NDArray[np.intp]


class RestNetwork:
    """rho0, H and M of cells (R, C) [S] that all conduct, and wires (R, C) [ohm]."""

    def __init__(self, cell_siemens: Float, top_wire_ohm: Float, bottom_wire_ohm: Float) -> None:
        self.shape = rows, columns = cell_siemens.shape
        self.cell_siemens = cell_siemens.ravel()
        self.top_wire_ohm, self.bottom_wire_ohm = top_wire_ohm, bottom_wire_ohm
        root = np.sqrt(cell_siemens)
        factor, half = factorised(root, top_wire_ohm, bottom_wire_ohm)
        impedance, self.port_ohm = impedance_of(half, rows)
        # With L of the factor, L' = L^-1 sqrt(g): cell currents x are L'^T half V of the electrode
        # potentials V, and L'^T (1 - half Z half^T) L' of voltages inserted in series with cells.
        inverse = solve_lower(factor, np.diag(root.ravel()))
        cell_ohm = 1.0 / self.cell_siemens
        potential = (impedance[:, :rows, None] - impedance[:, None, rows:]).reshape(
            rows + columns, -1
        )
        self.port_volt = (inverse.T @ (half @ potential)) * cell_ohm[:, None]
        between = half @ impedance @ half.T
        between *= -1.0
        between.ravel()[:: len(cell_ohm) + 1] += 1.0
        in_series = inverse.T @ between @ inverse
        self.cell_volt = -cell_ohm[:, None] * in_series * cell_ohm
        self.cell_volt.ravel()[:: len(cell_ohm) + 1] += cell_ohm
        self.own_port_volt = np.diagonal(self.port_volt).copy()
        self.own_cell_volt = np.diagonal(self.cell_volt).copy()

    def by_wires(self) -> Float:
        """d rho0 / d log r of all wires, (RC, 2RC) [ohm]."""
        current = (self.port_volt * self.cell_siemens[:, None]).T
        return by_wires(current.reshape(-1, *self.shape), self.top_wire_ohm, self.bottom_wire_ohm)

    def path_ohm(self, log_wires: Float) -> Float:
        """Wire between each cell and its electrodes [ohm], (RC,), for log resistances (2RC,)."""
        top, bottom = np.exp(log_wires).reshape(2, *self.shape)
        path: Float = np.cumsum(top, axis=1) + np.cumsum(bottom, axis=0)
        return path.ravel()


class TouchedNetwork:
    """A `RestNetwork` with conductances `added` (k,) > 0 [S] at `cells` (k,).

    port_ohm: rho (RC,). volt: v of the touched cells (k, RC).
    """

    def __init__(self, rest: RestNetwork, cells: Cells, added: Float) -> None:
        self._rest = rest
        self._cells = cells
        self._added = added
        self._coupling = rest.cell_volt[cells]
        port_volt = rest.port_volt[cells]
        system = rest.cell_volt[cells[:, None], cells]
        system.ravel()[:: len(cells) + 1] += 1.0 / added
        self._system = system
        _, self._current, _ = lapack.dposv(system, port_volt, lower=1)
        self.volt = self._current / added[:, None]
        self.port_ohm = rest.port_ohm - np.einsum("ij,ij->j", port_volt, self._current)

    def own_volt(self) -> tuple[Float, Float]:
        """Diagonals of v and of the touched M, (RC,): each cell at its own port, and alone."""
        _, drawn, _ = lapack.dposv(self._system, self._coupling, lower=1)
        port = self._rest.own_port_volt - np.einsum("ij,ij->j", self._coupling, self._current)
        cell = self._rest.own_cell_volt - np.einsum("ij,ij->j", self._coupling, drawn)
        return port, cell

    def cell_current(self, ports: Cells) -> Float:
        """Current through all cells per current through some ports, (m, RC)."""
        rest = self._rest
        volt: Float = rest.port_volt[:, ports] - self._coupling.T @ self._current[:, ports]
        siemens = rest.cell_siemens.copy()
        siemens[self._cells] += self._added
        volt *= siemens[:, None]
        return volt.T
