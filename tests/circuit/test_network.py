# SPDX-License-Identifier: Apache-2.0
"""The node Laplacian against Qucs and hand arithmetic; the forward model against the Laplacian."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network import Network, laplacian_readings, skin_network
from ohmskin.circuit.skin import Skin, readings
from places import DATA

CROSSBARS = json.loads((DATA / "qucs_crossbars.json").read_text())


def network(*branches: tuple[int, int, float]) -> Network:
    tail, head, ohm = zip(*branches, strict=True)
    return Network(max(tail + head) + 1, tail, head, ohm)


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
    solution = skin_network(skin).solve(source_v)
    top_v, bottom_v = solution.node_v[rows + columns :].reshape(2, rows, columns)[:, ::-1]
    cell_a, top_a, bottom_a = solution.branch_a.reshape(3, rows, columns)[:, ::-1]
    solved = {
        "I_out": bottom_a[-1:],
        "I_dev": cell_a,
        "I_wl": top_a,
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
    seed=st.integers(0, 2**32 - 1),
)
def test_the_forward_model_agrees_with_the_laplacian(
    rows: int, columns: int, zero_wires: float, open_cells: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    shape = (rows, columns)
    cell_siemens = 1 / np.exp(random.uniform(np.log(1e3), np.log(2e6), shape))
    top, bottom = random.uniform(1, 1000, (2, *shape))
    skin = Skin(
        np.where(random.random(shape) < open_cells, 0, cell_siemens),
        np.where(random.random(shape) < zero_wires, 0, top),
        np.where(random.random(shape) < zero_wires, 0, bottom),
        ref_top_ohm=27e3,
        ref_bottom_ohm=33e3,
    )
    # Measured: 2e-12, all of it the Laplacian's own rounding.
    np.testing.assert_allclose(readings(skin), laplacian_readings(skin), rtol=0, atol=5e-11)


def test_a_cube_of_resistors_has_five_sixths_from_corner_to_corner() -> None:
    edges = [(a, a | bit, 1.0) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    solution = network(*edges).solve({0: 5 / 6, 7: 0.0})
    np.testing.assert_allclose(solution.branch_a[:3], 1 / 3, rtol=1e-12)
    np.testing.assert_allclose(solution.node_v[[1, 2, 4]], 1 / 2, rtol=1e-12)


def test_a_short_carries_the_current_of_an_unbalanced_bridge() -> None:
    # 1.5 V over each resistor: 1.5 A come to the bridge's one end, 0.75 A leave it for ground.
    bridge = network((0, 1, 1), (0, 2, 2), (1, 3, 2), (2, 3, 1), (1, 2, 0))
    solution = bridge.solve({0: 3.0, 3: 0.0})
    np.testing.assert_allclose(solution.node_v, [3, 1.5, 1.5, 0], rtol=1e-12)
    np.testing.assert_allclose(solution.branch_a, [1.5, 0.75, 0.75, 1.5, 0.75], rtol=1e-12)


def test_what_no_path_joins_to_a_source_has_no_potential_and_no_current() -> None:
    solution = network((0, 1, 10), (1, 2, np.inf), (2, 3, 10), (3, 4, 0)).solve({0: 2.0})
    np.testing.assert_array_equal(solution.node_v, [2, 2, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(solution.branch_a, np.zeros(4))


@pytest.mark.parametrize(
    "branches",
    [
        [(0, 1, 0), (1, 2, 0)],
        [(0, 2, 0)],
        [(0, 1, 5), (1, 3, 0), (3, 4, 0), (1, 4, 0), (1, 2, 5)],
        [(0, 1, 5), (1, 1, 0), (1, 2, 5)],
    ],
    ids=["between sources", "a branch between sources", "a loop", "a branch on one node"],
)
def test_shorts_that_leave_a_current_open_are_refused(
    branches: list[tuple[int, int, float]],
) -> None:
    with pytest.raises(ValueError, match="zero ohm"):
        network(*branches).solve({0: 1.0, 2: 0.0})


@pytest.mark.parametrize(
    ("branch", "message"),
    [
        (([0], [1], [1.0, 2.0]), "must be"),
        (([[0]], [[1]], [[1.0]]), "must be"),
        (([0], [2], [1.0]), "nodes 0 to 1"),
        (([-1], [1], [1.0]), "nodes 0 to 1"),
        (([0], [1], [-1.0]), "not negative"),
        (([0], [1], [np.nan]), "not negative"),
    ],
)
def test_impossible_networks_are_refused(branch: tuple[list, list, list], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Network(2, *branch)


@pytest.mark.parametrize("source_v", [{2: 1.0}, {-1: 1.0}, {0: np.nan}, {0: np.inf}])
def test_impossible_sources_are_refused(source_v: dict[int, float]) -> None:
    with pytest.raises(ValueError, match="no source"):
        network((0, 1, 1)).solve(source_v)
