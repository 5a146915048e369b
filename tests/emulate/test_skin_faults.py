# SPDX-License-Identifier: Apache-2.0
"""Faults of simulated skins: what their readings become, node by node and reading by reading."""

from dataclasses import replace

import numpy as np
import pytest

from network import Network, SkinCircuit, laplacian_readings, leaks, skin_network
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.faults import SKIN_FAULTS, SkinFaults, faults_of
from ohmskin.emulate.scenes import BEGIN_S, LEAD_OHM, Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import PortError
from ohmskin.link.protocol import ENUMS, MODES
from skins import scan_order

R, C = 4, 5


FAULTS = {
    "none": (SkinFaults(), {}, []),
    "open row": (SkinFaults(open_row=2), {"top": ((2, 0), np.inf)}, []),
    "open column": (SkinFaults(open_column=4), {"bottom": ((0, 4), np.inf)}, []),
    "dead": (SkinFaults(dead=(1, 2)), {"cell": ((1, 2), 0.0)}, []),
    "saturated": (SkinFaults(saturated=(3, 0)), {"cell": ((3, 0), 10.0)}, []),
    "broken row": (SkinFaults(broken_row=(2, 3)), {"top": ((2, 3), np.inf)}, []),
    "broken column": (SkinFaults(broken_column=(1, 4)), {"bottom": ((1, 4), np.inf)}, []),
    "rows": (SkinFaults(short_rows=(0, 3)), {}, [(0, 3)]),
    "columns": (SkinFaults(short_columns=(2, 1)), {}, [(R + 2, R + 1)]),
    "far rows": (SkinFaults(short_far_rows=(0, 3)), {}, [(R + C, R + C + 3)]),
    "far columns": (SkinFaults(short_far_columns=(4, 1)), {}, [(R + C + R + 4, R + C + R + 1)]),
    "many": (
        SkinFaults(short_rows=(0, 1), short_columns=(2, 3), dead=(3, 0), open_column=4),
        {"cell": ((3, 0), 0.0), "bottom": ((0, 4), np.inf)},
        [(0, 1), (R + 2, R + 3)],
    ),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", FAULTS)
def test_readings_are_those_of_the_network(name: str, mode: str) -> None:
    faults, changes, joints = FAULTS[name]
    sound = Scene("rest", R, C, seed=4).skin(0.0)
    of = {"cell": sound.cell_siemens, "top": sound.top_wire_ohm, "bottom": sound.bottom_wire_ohm}
    layers = {layer: values.copy() for layer, values in of.items()}
    leads = np.full(R + C, LEAD_OHM)
    for layer, (place, value) in changes.items():
        layers[layer][place] = value
    finite = [np.where(np.isinf(layers[layer]), 1e15, layers[layer]) for layer in layers]
    expected = laplacian_readings(Skin(*finite, lead_ohm=leads), joints, MODES[mode])
    found = Scene("rest", R, C, seed=4, faults=faults).ratio(0.0, mode)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    changed = np.abs(found - Scene("rest", R, C, seed=4).ratio(0.0, mode)).max()
    assert changed > 1e-2 or name == "none"


@pytest.mark.parametrize("mode", MODES)
def test_a_damp_skin_reads_as_one_whose_neighbouring_lines_leak_at_each_crossing(mode: str) -> None:
    """The emulator has the leaks at the ends of lines: that is 3 % of what they do."""
    names = [ENUMS["reading"].values[name] for name in MODES[mode]]
    for scene, leak_ohm in (("rest", 1e6), ("multi", 1e6), ("multi", 3e5)):
        sound = Scene(scene, 8, 8, seed=4).skin(BEGIN_S)
        circuit = SkinCircuit(Scene("rest", 8, 8, seed=4).skin(0.0), leaks((8, 8), leak_ohm))
        expected = circuit.readings(sound.cell_siemens)[..., names]
        found = Scene(scene, 8, 8, seed=4, faults=SkinFaults(damp=leak_ohm)).ratio(BEGIN_S, mode)
        of_leaks = np.abs(Scene(scene, 8, 8, seed=4).ratio(BEGIN_S, mode) - expected).max()
        assert np.abs(found - expected).max() < 0.03 * of_leaks


@pytest.mark.parametrize("mode", MODES)
def test_lines_have_the_leads_that_a_url_gives_them(mode: str) -> None:
    """All lines one, and a crimp adds to its line's."""
    url = f"emulator://{R}x{C}?scene=multi&begin=0&seed=4&lead=300&crimp_row=1&crimp_ohm=700"
    leads = np.full(R + C, 300.0)
    leads[1] += 700.0
    touched = replace(Scene("multi", R, C, seed=4).skin(BEGIN_S), lead_ohm=leads)
    expected = laplacian_readings(touched, names=MODES[mode])
    np.testing.assert_allclose(emulated(url)[1].ratio(0.0, mode), expected, rtol=0, atol=1e-9)


def test_far_ends_that_are_exchanged_or_open_change_no_near_reading() -> None:
    """Readings a e b f. Exchanged ends read each other's node; open ones what was there before."""

    def ratio(**faults: int | tuple[int, int]) -> Float:
        return Scene("multi", R, C, seed=4, faults=SkinFaults(**faults)).ratio(BEGIN_S, "far")

    a, e, b, f = np.moveaxis(ratio(), -1, 0)
    exchanged = ratio(swap_far_rows=(1, 3), swap_far_columns=(0, 4))
    np.testing.assert_allclose(exchanged[..., ::2], np.stack([a, b], axis=-1), atol=1e-12)
    rows, columns = [0, 3, 2, 1], [4, 1, 2, 3, 0]
    skin = Scene("multi", R, C, seed=4).skin(BEGIN_S)
    far = all_ends(skin)
    i, j = np.indices((R, C))
    np.testing.assert_allclose(exchanged[..., 1], far[i, j, np.take(rows, i)], atol=1e-9)
    np.testing.assert_allclose(exchanged[..., 3], far[i, j, R + np.take(columns, j)], atol=1e-9)
    opened = ratio(open_far_row=2, open_far_column=3)
    np.testing.assert_array_equal(opened[..., ::2], np.stack([a, b], axis=-1))
    np.testing.assert_array_equal(opened[2, :, 1], e[1])
    np.testing.assert_array_equal(opened[:, 3, 3], [f[-1, 2]] * R)
    first = ratio(open_far_row=0)[0, :, 1]
    np.testing.assert_array_equal(first, np.roll(e[-1], 1))


def all_ends(skin: Skin) -> Float:
    """Potentials of all far ends, (R, C, R + C), rows first, while each cell is selected."""
    network = skin_network(skin)
    top, bottom = np.arange(R + C, network.nodes).reshape(2, R, C)
    ends = [*top[:, -1], *bottom[-1]]
    references = skin.ref_top_ohm, skin.ref_bottom_ohm
    volt = np.empty((R, C, R + C))
    for i in range(R):
        for j in range(C):
            whole = Network(
                network.nodes + 2,
                np.append(network.tail, [network.nodes, R + j]),
                np.append(network.head, [i, network.nodes + 1]),
                np.append(network.branch_ohm, skin.lead_ohm[[i, R + j]] + references),
            )
            volt[i, j] = whole.node_v({network.nodes: 1.0, network.nodes + 1: 0.0})[ends]
    return volt


def test_a_dead_cell_never_conducts_and_is_not_called_touched() -> None:
    scene = Scene("single", R, C, faults=SkinFaults(dead=(R // 2, C // 2), saturated=(0, 0)))
    assert scene.skin(BEGIN_S).cell_siemens[R // 2, C // 2] == 0
    assert not scene.touched(BEGIN_S).any()


def test_true_references_and_wires() -> None:
    skin = Scene("rest", R, C, faults=SkinFaults(ref_top=33e3, ref_bottom=29e3, wires=2.5)).skin(0)
    sound = Scene("rest", R, C).skin(0.0)
    assert (skin.ref_top_ohm, skin.ref_bottom_ohm) == (33e3, 29e3)
    np.testing.assert_allclose(skin.top_wire_ohm, 2.5 * sound.top_wire_ohm)
    np.testing.assert_allclose(skin.bottom_wire_ohm, 2.5 * sound.bottom_wire_ohm)
    crimps = SkinFaults(crimp_row=1, crimp_column=2, crimp_ohm=700.0)
    crimped = Scene("rest", R, C, faults=crimps).skin(0.0)
    more = np.zeros(R + C)
    more[[1, R + 2]] = 700
    np.testing.assert_array_equal(sound.lead_ohm, [LEAD_OHM] * (R + C))
    np.testing.assert_array_equal(crimped.lead_ohm, sound.lead_ohm + more)
    np.testing.assert_array_equal(crimped.top_wire_ohm, sound.top_wire_ohm)
    ratio = Scene("rest", R, C, faults=SkinFaults(ref_top=33e3)).ratio(0.0)
    np.testing.assert_allclose((1 - ratio[..., 0]) / ratio[..., 1], 1.1)
    np.testing.assert_allclose(ratio[..., 3] / (1 - ratio[..., 2]), 1.1)


def test_hum_is_met_by_every_reading_at_its_own_time() -> None:
    flat = np.full((3, 2, 4), 0.5)
    slot_s, start_s = 1e-3, 7.1234
    found = SkinFaults(hum=50, hum_lsb=4).sampled(flat, start_s, slot_s, 1e-4, "near")
    for at, place in enumerate(scan_order(3, 2)):
        hum = 4 / 1024 * np.sin(2 * np.pi * 50 * (start_s + at * slot_s))
        assert found[place] == pytest.approx(0.5 + hum, abs=1e-12)
    assert np.array_equal(flat, np.full((3, 2, 4), 0.5))


def test_nodes_settle_slot_by_slot() -> None:
    """Both nodes, stepped one slot at a time, through scan after scan."""
    ratio = Scene("single", 3, 2).ratio(BEGIN_S)
    settle_s, tau_us = 30e-6, 20.0
    kept = np.exp(-settle_s / (1e-6 * tau_us))
    top = bottom = 0.0
    for _ in range(5):
        expected = np.empty_like(ratio)
        for row, column, reading in scan_order(3, 2):
            a, b, c, d = ratio[row, column]
            top_goal, bottom_goal = (a, b) if reading < 2 else (d, c)
            top = top_goal + (top - top_goal) * kept
            bottom = bottom_goal + (bottom - bottom_goal) * kept
            expected[row, column, reading] = (top, bottom, bottom, top)[reading]
    found = SkinFaults(tau_us=tau_us).sampled(ratio, 0.0, 40e-6, settle_s, "near")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.abs(found - ratio).max() > 0.05
    quick = SkinFaults(tau_us=0.5).sampled(ratio, 0.0, 40e-6, settle_s, "near")
    np.testing.assert_allclose(quick, ratio, rtol=0, atol=1e-9)


def test_every_fault_has_a_name_an_explanation_and_an_option() -> None:
    assert list(SKIN_FAULTS) == list(SkinFaults.__dataclass_fields__)
    values = {
        name: "1,2" for name in SKIN_FAULTS if name.startswith(("short", "swap", "dead", "broken"))
    }
    values["saturated"] = "0,0"
    for name in SKIN_FAULTS:
        board, _, _ = emulated(f"emulator://{R}x{C}?{name}={values.get(name, '2')}&noise=0")
        assert board.codes_at(0.0).shape == (R, C, 4)
    found = faults_of(SkinFaults, {"short_rows": "0,2", "noise": "3"})
    assert found == SkinFaults(short_rows=(0, 2))


def test_nodes_settle_slot_by_slot_in_mode_far() -> None:
    """Four nodes under one drive: each heads for its own voltage of the cell, and keeps it."""
    ratio = Scene("single", 3, 2).ratio(BEGIN_S, "far")
    settle_s, tau_us = 30e-6, 20.0
    kept = np.exp(-settle_s / (1e-6 * tau_us))
    node = np.zeros(4)
    for _ in range(5):
        expected = np.empty_like(ratio)
        for row, column, reading in scan_order(3, 2):
            node = ratio[row, column] + (node - ratio[row, column]) * kept
            expected[row, column, reading] = node[reading]
    found = SkinFaults(tau_us=tau_us).sampled(ratio, 0.0, 40e-6, settle_s, "far")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.abs(found - ratio).max() > 0.02


@pytest.mark.parametrize(
    ("option", "reason"),
    [
        ("open_row=4", "no row 4: the skin has rows 0 to 3"),
        ("open_column=-1", "no column -1"),
        ("short_rows=1,4", "no row 4"),
        ("open_far_row=4", "no row 4"),
        ("broken_row=4,0", "no row 4"),
        ("broken_row=0,5", "no column 5"),
        ("crimp_column=5", "no column 5"),
        ("swap_far_columns=1,5", "no column 5"),
        ("mode=middle", "no such mode"),
        ("short_rows=1,1", "two different"),
        ("short_columns=3", "two different numbers, as 1,2"),
        ("dead=0,5", "no column 5"),
        ("dead=a,b", "two numbers"),
        ("open_row=x", "a number, not 'x'"),
        ("ref_top=0", "from 1e-6 to"),
        ("lead=-1", "lead_ohm must be finite and not negative"),
        ("lead=x", "lead must be a number"),
        ("wires=nan", "from 1e-6 to"),
        ("hum=-50", "0, or from 1e-6 to"),
        ("tau_us=inf", "0, or from 1e-6 to"),
        # Finite, but the arithmetic would overflow.
        ("wires=1e308", "wires must be"),
        ("ref_top=1e308", "ref_top must be"),
        ("hum=1e308&hum_lsb=1e308", "hum must be"),
        ("reset=1e-320", "reset must be"),
    ],
)
def test_wrong_faults_are_refused(option: str, reason: str) -> None:
    with pytest.raises(PortError, match=reason):
        emulated(f"emulator://{R}x{C}?{option}")
