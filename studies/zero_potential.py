# SPDX-License-Identifier: Apache-2.0
"""Zero-potential readout, the usual hardware answer to ghosts, with the wires of a textile.

One row electrode is at Vdd and all others are at ground. An operational amplifier at each column
electrode holds it at ground, too, and gives the current I that flows there. Without wires every
other cell has no voltage, so I / Vdd is the conductance of the cell. Wires change that: the voltage
that they lose is missing at the cell, and what the lines carry for other cells adds to it.
(Such circuits: Hidalgo-López et al., Sensors 17, 2513, 2017; Wu et al., Sensors 16, 720, 2016.)

Symbols, for one driven row k

====== ======= ======================================================================== =====
symbol shape   meaning                                                                  unit
====== ======= ======================================================================== =====
v      (2RC,)  potentials over Vdd of the crossings, T of the rows first, then B        1
L      2RC^2   Laplacian of cells and wires, all electrodes at a known potential        S
w_T    (R,)    conductance of each row's first segment, from its electrode to T[i, 0]   S
w_B    (C,)    of each column's first segment, from its electrode to B[0, j]            S
y      (R, C)  I / Vdd                                                                  S
====== ======= ======================================================================== =====

    L v = w_T[k] at T[k, 0] ,        y[k, j] = w_B[j] v(B[0, j]) .

Everything but the wires is ideal: amplifiers, switches, references. The converter has so many bits
over full_scale_siemens. Nothing here uses `ohmskin.circuit`, beyond the arrays of a `Skin`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.link.codes import quantise, ratio_from_codes

USUAL_SIEMENS: Final = 1e-3  # full scale of the converter: the hardest touch, 1 kohm
LEAST_OHM: Final = 300.0  # no cell is believed to resist less. Chosen: below any touch.
ROUNDS: Final = 100  # that `solved` takes at most. Chosen.
MOST_CHANGE: Final = 2.0  # factor by which `solved` may change a cell in a round. Chosen.


def currents(skin: Skin) -> Float:
    """y [S], (R, C): exact currents of the columns per Vdd, for each driven row."""
    rows, columns = skin.shape
    cells = rows * columns
    top, bottom = np.arange(2 * cells).reshape(2, rows, columns)
    of_top, of_bottom = 1 / skin.top_wire_ohm, 1 / skin.bottom_wire_ohm
    # Between crossings: cells, then segments within rows and within columns.
    one = np.concatenate([top, top[:, 1:], bottom[1:]], axis=None)
    other = np.concatenate([bottom, top[:, :-1], bottom[:-1]], axis=None)
    siemens = np.concatenate([skin.cell_siemens, of_top[:, 1:], of_bottom[1:]], axis=None)
    # From crossings to electrodes.
    ends = np.concatenate([top[:, 0], bottom[0]])
    at_ends = np.concatenate([of_top[:, 0], of_bottom[0]])
    row = np.concatenate([one, other, one, other, ends])
    column = np.concatenate([one, other, other, one, ends])
    value = np.concatenate([siemens, siemens, -siemens, -siemens, at_ends])
    laplacian = coo_array((value, (row, column)), shape=(2 * cells, 2 * cells)).tocsc()
    driven = np.zeros((2 * cells, rows))
    driven[top[:, 0], np.arange(rows)] = of_top[:, 0]
    potential = splu(laplacian).solve(driven)
    return np.asarray(potential[bottom[0]].T * of_bottom[0])


def converted(siemens: Float, full_scale_siemens: float, bits: int) -> Float:
    """What a converter of so many bits makes of it [S]; what exceeds the scale is the last code."""
    codes = quantise(siemens / full_scale_siemens, bits)
    return full_scale_siemens * ratio_from_codes(codes, bits)


def less_path(siemens: Float, wire_ohm: tuple[float, float]) -> Float:
    """1 / (1 / y - r) [S], r the nominal wires from the cell's row and column electrode to it.

    The simplest correction: exact for a single cell that conducts. siemens (..., R, C).
    """
    rows, columns = siemens.shape[-2:]
    path = wire_ohm[0] * np.arange(1, columns + 1) + wire_ohm[1] * np.arange(1, rows + 1)[:, None]
    return np.asarray(1 / np.maximum(1 / siemens - path, LEAST_OHM))


def solved(siemens: Float, wire_ohm: tuple[float, float]) -> Float:
    """Cells (R, C) [S] whose currents, with these wires in all segments, are those read.

    Each round scales every cell by its current read over the modelled one. It is what a user would
    do who knows the wires and can solve the circuit: no longer a reading, but an estimate.
    """
    top, bottom = (np.full(siemens.shape, ohm) for ohm in wire_ohm)
    cell = siemens
    for _ in range(ROUNDS):
        factor = siemens / currents(Skin(cell, top, bottom))
        cell = np.minimum(cell * np.clip(factor, 1 / MOST_CHANGE, MOST_CHANGE), 1 / LEAST_OHM)
        if np.abs(factor - 1).max() < 1e-4:
            break
    return np.asarray(cell)
