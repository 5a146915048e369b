# SPDX-License-Identifier: Apache-2.0
"""Zero-potential readout: against arithmetic by hand and ngspice."""

import numpy as np
import pytest

from ohmskin.circuit.skin import Skin
from skins import uniform_skin
from spice import resistors, run_ngspice
from studies.trials import skin_at_rest, touch
from studies.zero_potential import converted, currents, less_path, solved


def touched(rows: int, columns: int, touches: int, seed: int, scale: float = 1.0) -> Skin:
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random, wire_ohm=(100 * scale, 200 * scale))
    return touch(rest, touches, random)


def test_a_row_of_two_cells_by_hand() -> None:
    """Cells of 800 ohm, wires of 100 and 200: the first segment carries both cells' currents."""
    skin = uniform_skin((1, 2), 1 / 800, (100.0, 200.0))
    # Paths from the first crossing to ground: 800 + 200 = 1,000 and 100 + 800 + 200 = 1,100 ohm,
    # together 1,100,000 / 2,100 ohm. So its potential is 1,100,000 / (1,100,000 + 210,000).
    at_crossing = 110 / 131
    expected = [[at_crossing / 1_000, at_crossing / 1_100]]
    np.testing.assert_allclose(currents(skin), expected, rtol=1e-12)


def test_a_column_of_two_cells_by_hand() -> None:
    """Cells of 900 ohm, wires of 100 and 200. The row at ground takes current from the column."""
    skin = uniform_skin((2, 1), 1 / 900, (100.0, 200.0))
    # Row 0 is driven: 1,000 ohm to B[0]; from there 200 ohm to the amplifier, and 200 + 900 + 100 =
    # 1,200 ohm to ground by row 1. 200 || 1,200 = 1,200 / 7 ohm.
    first = (1200 / 7) / (1000 + 1200 / 7) / 200
    # Row 1 is driven: 1,000 ohm to B[1], 200 ohm to B[0]; from there 200 ohm to the amplifier and
    # 1,000 ohm to ground by row 0. 200 || 1,000 = 500 / 3 ohm.
    second = (500 / 3) / (1200 + 500 / 3) / 200
    np.testing.assert_allclose(currents(skin), [[first], [second]], rtol=1e-12)


@pytest.mark.ngspice
def test_currents_agree_with_ngspice() -> None:
    skin = touched(3, 4, 5, seed=2)
    lines: list[str] = []
    for driven in range(3):
        wires = skin.top_wire_ohm, skin.bottom_wire_ohm
        lines += resistors(1 / skin.cell_siemens, *wires, end=f"n{driven}")
        lines += [f"vr{i}n{driven} row{i}n{driven} 0 {int(i == driven)}" for i in range(3)]
        lines += [f"vc{j}n{driven} column{j}n{driven} 0 0" for j in range(4)]
    wanted = [f"i(vc{j}n{driven})" for driven in range(3) for j in range(4)]
    expected = run_ngspice(lines, wanted).reshape(3, 4)
    np.testing.assert_allclose(currents(skin), expected, rtol=1e-6, atol=1e-14)


def test_no_wires_no_ghosts() -> None:
    skin = touched(5, 5, 10, seed=3, scale=1e-6)
    np.testing.assert_allclose(currents(skin), skin.cell_siemens, rtol=1e-4)


def test_a_converter_saturates() -> None:
    found = converted(np.array([0.0, 0.4e-3, 2e-3]), 1e-3, 10)
    np.testing.assert_allclose(found, np.array([0.5, 409.5, 1023.5]) / 1024 * 1e-3, rtol=1e-12)


def test_the_path_is_all_that_one_cell_needs() -> None:
    """Cell (1, 2) of 5 kohm: 3 segments of 100 ohm and 2 of 200. All others hardly conduct."""
    cell = np.full((3, 4), 1e-12)
    cell[1, 2] = 1 / 5e3
    skin = Skin(cell, np.full((3, 4), 100.0), np.full((3, 4), 200.0))
    read = currents(skin)
    np.testing.assert_allclose(read[1, 2], 1 / 5_700, rtol=1e-6)
    np.testing.assert_allclose(less_path(read, (100.0, 200.0))[1, 2], 1 / 5e3, rtol=1e-6)


def test_known_wires_give_the_cells_back() -> None:
    random = np.random.default_rng(4)
    skin = touch(uniform_skin((6, 6)), 8, random)
    found = solved(currents(skin), (100.0, 200.0))
    np.testing.assert_allclose(found, skin.cell_siemens, rtol=1e-3)
