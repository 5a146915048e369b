# SPDX-License-Identifier: Apache-2.0
"""The node Laplacian against Qucs and hand arithmetic; the forward model against the Laplacian."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network import Network, SkinCircuit, laplacian_readings, skin_network
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, readings
from places import DATA

CROSSBARS = json.loads((DATA / "qucs_crossbars.json").read_text())


def network(*branches: tuple[int, int, float]) -> Network:
    tail, head, ohm = map(np.array, zip(*branches, strict=True))
    return Network(int(max(*tail, *head)) + 1, tail, head, ohm)


def test_all_crossbars_are_there() -> None:
    assert len(CROSSBARS) == 33


@pytest.mark.parametrize("name", CROSSBARS)
def test_voltages_and_currents_agree_with_qucs(name: str) -> None:
    crossbar = {key: np.array(quantity) for key, quantity in CROSSBARS[name].items()}
    # Columns are grounded below their last row, a skin's electrode is before its first.
    cell_ohm = crossbar["R"][::-1]
    rows, columns = cell_ohm.shape
    skin = Skin(
        1 / cell_ohm,
        np.full(cell_ohm.shape, crossbar["r_i_wl"]),
        np.full(cell_ohm.shape, crossbar["r_i_bl"]),
    )
    source_v = dict(enumerate(crossbar["V"][::-1, 0])) | {rows + j: 0.0 for j in range(columns)}
    node_v = skin_network(skin).node_v(source_v)[rows + columns :]
    top_v, bottom_v = node_v.reshape(2, rows, columns)[:, ::-1]
    cell_a = (top_v - bottom_v) / crossbar["R"]
    bottom_a = np.cumsum(cell_a, axis=0)  # a segment carries what the cells before it give
    solved = {
        "I_out": bottom_a[-1:],
        "I_dev": cell_a,
        "I_wl": np.cumsum(cell_a[:, ::-1], axis=1)[:, ::-1],
        "I_bl": bottom_a,
        "V_wl": top_v,
        "V_bl": bottom_v,
    }
    assert solved.keys() | {"R", "V", "r_i_wl", "r_i_bl"} == crossbar.keys()
    for key, quantity in solved.items():
        # Measured: 4e-15 V, 2e-15 A, where the largest are 3 V and 0.6 A.
        np.testing.assert_allclose(quantity, crossbar[key], rtol=0, atol=2e-14, err_msg=key)


@settings(max_examples=50)
@given(
    rows=st.integers(1, 5),
    columns=st.integers(1, 5),
    zero_wires=st.sampled_from([0.0, 0.3, 1.0]),
    open_cells=st.sampled_from([0.0, 0.3, 0.8, 1.0]),
    zero_leads=st.sampled_from([0.0, 0.3, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_forward_model_agrees_with_the_laplacian(
    rows: int, columns: int, zero_wires: float, open_cells: float, zero_leads: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    shape = (rows, columns)
    cell_siemens = 1 / np.exp(random.uniform(np.log(1e3), np.log(2e6), shape))
    top, bottom = random.uniform(1, 1000, (2, *shape))
    leads = random.uniform(1, 5000, rows + columns)
    skin = Skin(
        np.where(random.random(shape) < open_cells, 0, cell_siemens),
        np.where(random.random(shape) < zero_wires, 0, top),
        np.where(random.random(shape) < zero_wires, 0, bottom),
        ref_top_ohm=27e3,
        ref_bottom_ohm=33e3,
        lead_ohm=np.where(random.random(leads.size) < zero_leads, 0, leads),
    )
    # Measured: 2e-12, all of it the Laplacian's own rounding.
    expected = laplacian_readings(skin, names="abcdefgh")
    np.testing.assert_allclose(readings(skin), expected[..., :4], rtol=0, atol=5e-11)
    found = all_readings(skin, end_admittance(skin))
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-11)


@pytest.mark.parametrize("wire_ohm", [1.0, 100.0, 1e4])
def test_many_frames_of_one_skin_agree_with_the_laplacian(wire_ohm: float) -> None:
    random, shape = np.random.default_rng(1), (3, 4)
    cell = 1e-6 * random.uniform(0.5, 2, shape)
    wires = wire_ohm * random.uniform(0.5, 2, (2, *shape))
    rest = Skin(cell, *wires, 27e3, 33e3, lead_ohm=random.uniform(0, 3000, 7))
    circuit = SkinCircuit(rest)
    for pressed in (0, 1, 5, 12):
        more = np.zeros(cell.size)
        more[random.choice(cell.size, pressed, replace=False)] = 1e-3 * random.random(pressed)
        skin = replace(rest, cell_siemens=cell + more.reshape(shape))
        expected = laplacian_readings(skin, names="abcdefgh")
        found = circuit.readings(skin.cell_siemens)
        np.testing.assert_allclose(found, expected, rtol=0, atol=5e-11)


def test_a_cube_of_resistors_has_five_sixths_from_corner_to_corner() -> None:
    edges = [(a, a | bit, 1.0) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    node_v = network(*edges).node_v({0: 5 / 6, 7: 0.0})
    np.testing.assert_allclose(node_v[[1, 2, 4]], 1 / 2, rtol=1e-12)  # 1/3 A in each


def test_a_short_joins_the_ends_of_an_unbalanced_bridge() -> None:
    node_v = network((0, 1, 1), (0, 2, 2), (1, 3, 2), (2, 3, 1), (1, 2, 0)).node_v({0: 3, 3: 0})
    np.testing.assert_allclose(node_v, [3, 1.5, 1.5, 0], rtol=1e-12)


def test_what_no_path_joins_to_a_source_has_no_potential() -> None:
    node_v = network((0, 1, 10), (1, 2, np.inf), (2, 3, 10), (3, 4, 0)).node_v({0: 2.0})
    np.testing.assert_array_equal(node_v, [2, 2, np.nan, np.nan, np.nan])


@pytest.mark.parametrize("far", [(False, False), (True, False), (False, True), (True, True)])
def test_a_short_of_near_ends_is_that_of_the_network(far: tuple[bool, bool]) -> None:
    random = np.random.default_rng(4)
    rows, columns = shape = (4, 3)
    skin = Skin(
        np.exp(random.normal(-10, 2, shape)),
        np.exp(random.normal(5, 1, shape)),
        np.exp(random.normal(6, 1, shape)),
    )
    circuit = PortCircuit(skin.cell_siemens, skin.top_wire_ohm, skin.bottom_wire_ohm, far=far)
    firsts = np.array([0, 2, rows + 1])
    found = circuit.shorted_port_ohm(firsts, 30.0)
    alone = skin_network(skin)
    top, bottom = np.arange(rows + columns, alone.nodes).reshape(2, rows, columns)
    row_ends = top[:, -1] if far[0] else np.arange(rows)
    column_ends = bottom[-1] if far[1] else np.arange(rows, rows + columns)
    for number, first in enumerate(firsts):
        for i, j in np.ndindex(shape):
            source = alone.nodes
            network = Network(
                alone.nodes + 1,
                np.append(alone.tail, [first, source]),
                np.append(alone.head, [first + 1, i]),
                np.append(alone.branch_ohm, [30.0, 1e3]),
            )
            volt = network.node_v({source: 1.0, rows + j: 0.0})
            current = (1.0 - volt[i]) / 1e3
            port_ohm = (volt[row_ends[i]] - volt[column_ends[j]]) / current
            assert found[i * columns + j, number] == pytest.approx(port_ohm, rel=1e-9)
