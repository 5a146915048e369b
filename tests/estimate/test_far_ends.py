# SPDX-License-Identifier: Apache-2.0
"""`joint` and `touch` on readings at far ends: against ngspice, and against Laplacians."""

from dataclasses import replace

import numpy as np
import pytest

from network import laplacian_readings  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.circuit.skin import Skin, all_readings, end_admittance
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import METHODS, make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.link.protocol import MODES
from places import DATA
from skins import ten_bits
from studies.trials import finger_trial, skin_at_rest, touch

ALL = "abcdefgh"
ENDS = [(True, True), (True, False), (False, True), (False, False)]


def seen(skin: Skin, names: str = "aebf") -> Float:
    """Exact readings of these names."""
    found = all_readings(skin, end_admittance(skin))
    return np.asarray(found[..., [ALL.index(name) for name in names]])


def knowledge(rest: Float, names: str = "aebf", bits: int | None = 10) -> SkinKnowledge:
    return SkinKnowledge(
        *rest.shape[:2],
        adc_bits=bits,
        rest_ratio=rest,
        nominal_wire_ohm=WireOhm(lead=0.0),
        reading_names=tuple(names),
    )


def sensed_ohm(skin: Skin, far: tuple[bool, bool]) -> Float:
    """Voltage between the sensed ends per current of each port, by a Laplacian."""
    a, b, e, f = np.moveaxis(laplacian_readings(skin, names="abef"), -1, 0)
    row, column = (e if far[0] else a), (f if far[1] else b)
    return np.asarray((row - column) * skin.ref_bottom_ohm / b)


@pytest.mark.parametrize("far", ENDS)
@pytest.mark.parametrize("size", [(1, 1), (1, 4), (3, 1), (3, 4)])
def test_sensed_ports_and_their_slopes_are_a_laplacians(
    size: tuple[int, int], far: tuple[bool, bool]
) -> None:
    random = np.random.default_rng(3)
    logs = random.uniform(np.log(50), np.log(50e3), (3, *size))

    def skin(logs: Float) -> Skin:
        cell, top, bottom = np.exp(logs)
        return Skin(1 / cell, top, bottom)

    whole = skin(logs)
    circuit = PortCircuit(whole.cell_siemens, whole.top_wire_ohm, whole.bottom_wire_ohm, far=far)
    expected = sensed_ohm(whole, far)
    np.testing.assert_allclose(circuit.port_ohm, expected.ravel(), rtol=1e-8)
    slopes = np.hstack([circuit.by_cell(), circuit.by_wires()])
    for number in range(logs.size):
        ends = []
        for step in (-1e-4, 1e-4):
            moved = logs.copy()
            moved.flat[number] += step
            ends.append(sensed_ohm(skin(moved), far).ravel())
        slope = (ends[1] - ends[0]) / 2e-4
        np.testing.assert_allclose(slopes[:, number], slope, atol=3e-6 * expected.max())
    by_wires = circuit.by_wires()
    by_top, by_bottom = by_wires.reshape(-1, 2, *size).transpose(1, 0, 2, 3)
    by_lines = np.hstack([by_top.sum(axis=2), by_bottom.sum(axis=1)])
    np.testing.assert_allclose(circuit.by_lines(), by_lines, atol=1e-9 * expected.max())
    layers = np.stack([by_top.sum(axis=(1, 2)), by_bottom.sum(axis=(1, 2))], axis=1)
    np.testing.assert_allclose(circuit.by_layers(), layers, atol=1e-9 * expected.max())
    weight = random.uniform(0.1, 10.0, len(by_wires))
    bound = circuit.most_by_wires(weight) * (1 + 1e-9)
    assert (np.abs(weight[:, None] * by_wires) <= bound).all()
    some = np.flatnonzero(np.arange(by_wires.shape[1]) % 3 == 1)
    np.testing.assert_array_equal(circuit.by_wires(some), by_wires[:, some])


def test_what_wires_lose_is_the_current_through_their_segments() -> None:
    random = np.random.default_rng(5)
    skin = touch(skin_at_rest(3, 5, random, spread=0.3), 4, random)
    wires = skin.top_wire_ohm, skin.bottom_wire_ohm
    circuit = PortCircuit(skin.cell_siemens, *wires, far=(True, True))
    a, e, b, f = np.moveaxis(seen(skin), -1, 0)
    current = b / skin.ref_bottom_ohm
    row = np.einsum("ipk,ik->ip", circuit.line_current(0), wires[0])
    column = np.einsum("jpk,kj->pj", circuit.line_current(1), wires[1])
    for lost, shown, model in zip((a - e, f - b), (row, column), circuit.drop_ohm, strict=True):
        np.testing.assert_allclose(shown, lost / current, rtol=1e-8)
        np.testing.assert_allclose(model, shown.ravel(), rtol=1e-8)


def scored(method: str, kind: str) -> tuple[Float, Float, Float]:
    """Pressed cells of cold frames, nothing told: errors, stated deviations; ghosts [uS]."""
    errors, stds, ghosts = [], [], []
    for number in (0, 1):
        with np.load(DATA / "far" / f"{kind}_{number}.npz", allow_pickle=False) as file:
            arrays = dict(file)
        pick = [list(arrays["reading_names"]).index(name) for name in MODES["far"]]
        rest = 1 / arrays["rest_ohm"]
        estimator = make_estimator(method, knowledge(ten_bits(arrays["rest_ratio"][..., pick])))
        for ratio, ohm in zip(arrays["ratio"][..., pick], arrays["cell_ohm"], strict=True):
            estimator.reset()
            found = estimator.estimate(ten_bits(ratio))
            pressed = 1 / ohm > 1.5 * rest
            errors.append(np.abs(found.cell_siemens * ohm - 1)[pressed])
            stds.append((found.cell_siemens_std * ohm)[pressed])
            ghosts.append(1e6 * (found.cell_siemens - 1 / ohm)[~pressed].max(initial=0.0))
    return np.concatenate(errors), np.concatenate(stds), np.array(ghosts)


# Errors of pressed cells: median, 90th percentile.
BARS = {
    "random_8x8": (0.004, 0.02),
    "random_5x9": (0.004, 0.02),
    "harsh_8x8": (0.005, 0.03),
    "finger_8x8": (0.012, 0.05),
}


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("kind", BARS)
def test_whoever_knows_no_wires_reads_cells_at_far_ends(kind: str, method: str) -> None:
    errors, stds, ghosts = scored(method, kind)
    assert np.median(errors) < BARS[kind][0]
    assert np.percentile(errors, 90) < BARS[kind][1]
    assert np.mean(errors < 4 * stds) > 0.97
    assert np.median(stds / np.maximum(errors, 1e-9)) < 4
    assert np.percentile(ghosts, 95) < 0.5


def one_frame(names: str) -> Estimate:
    random = np.random.default_rng(11)
    rest = skin_at_rest(6, 7, random)
    touched = touch(rest, 4, random)
    known = knowledge(ten_bits(seen(rest, names)), names)
    return make_estimator("joint", known).estimate(ten_bits(seen(touched, names)))


@pytest.mark.parametrize("names", ["abef", "dcgh", "cdhg", "abeg", "fbea"])
def test_readings_may_come_in_any_order_and_polarity(names: str) -> None:
    expected, found = one_frame("aebf"), one_frame(names)
    # Rounding down is up where supplies are exchanged.
    np.testing.assert_allclose(found.cell_siemens, expected.cell_siemens, rtol=0.03)
    assert found.converged


@pytest.mark.parametrize("names", ["abe", "abf", "dch"])
def test_one_far_end_is_better_than_none(names: str) -> None:
    random = np.random.default_rng(12)
    off: dict[str, list[Float]] = {names: [], "ab": []}
    for _ in range(24):
        rest = skin_at_rest(6, 6, random, wire_ohm=(300.0, 300.0))
        touched = touch(rest, 3, random)
        for each, found in off.items():
            known = knowledge(ten_bits(seen(rest, each)), each)
            cell = make_estimator("joint", known).estimate(ten_bits(seen(touched, each)))
            pressed = touched.cell_siemens > 1.5 * rest.cell_siemens
            found.append(np.abs(cell.cell_siemens / touched.cell_siemens - 1)[pressed])
    one, none = (np.median(np.concatenate(found)) for found in off.values())
    assert one < 0.7 * none


@pytest.mark.parametrize("names", ["abe", "abf"])
@pytest.mark.parametrize("method", ["joint", "touch"])
def test_what_lessons_say_of_a_far_layer_is_no_level_of_the_near_one(
    method: str, names: str
) -> None:
    """All segments are 500 Ohm, so none differs from its layer, and a level is the cell's."""
    random = np.random.default_rng(2)
    wires = np.full((8, 8), 500.0)
    rest = replace(skin_at_rest(8, 8, random), top_wire_ohm=wires, bottom_wire_ohm=wires)
    estimator = make_estimator(method, knowledge(ten_bits(seen(rest, names)), names))
    off = []
    for _ in range(8):
        found = estimator.estimate(ten_bits(seen(touch(rest, 3, random), names)))
        off.append(np.abs(found.level / found.cell_siemens - 1)[found.touched])
    assert np.concatenate(off).max() < 0.05


def test_methods_without_wires_say_what_they_take() -> None:
    rest = seen(skin_at_rest(3, 3, np.random.default_rng(1)))
    for method in set(METHODS) - {"joint", "touch"}:
        with pytest.raises(ValueError, match=f"'{method}' takes the readings a b c d, not a e b f"):
            make_estimator(method, knowledge(rest))


@pytest.mark.parametrize("names", ["efgh", "aehd"])
def test_both_near_ends_are_needed(names: str) -> None:
    rest = seen(skin_at_rest(3, 3, np.random.default_rng(1)), names)
    with pytest.raises(ValueError, match="of each near end, one is needed"):
        make_estimator("joint", knowledge(rest, names))


@pytest.mark.parametrize("codes", [0.0, 1.5])
def test_errors_of_currents_at_far_ends_are_as_large_as_stated(codes: float) -> None:
    random = np.random.default_rng(4)
    rest = skin_at_rest(8, 8, random)
    reader = PortReader(knowledge(ten_bits(seen(rest))))
    away = []
    for _ in range(40):
        exact = seen(touch(rest, 5, random))
        current = exact[..., 2] / 30e3
        bare = current / (exact[..., 1] - exact[..., 3] + 60e3 * current)
        noisy = exact + codes / 1024 * random.standard_normal(exact.shape)
        found = reader.read(ten_bits(np.clip(noisy, 0, 1)))
        away.append((found.current - bare) / found.current_std)
    assert 0.5 < np.sqrt(np.mean(np.square(away))) < 1.2


def test_an_offset_of_the_converter_is_in_all_readings_alike() -> None:
    random = np.random.default_rng(6)
    rest = skin_at_rest(5, 5, random)
    touched = touch(rest, 3, random)
    known = knowledge(seen(rest) + 3 / 1024, bits=None)
    found = make_estimator("joint", known).estimate(seen(touched) + 3 / 1024)
    np.testing.assert_allclose(found.cell_siemens, touched.cell_siemens, rtol=2e-3)
    np.testing.assert_allclose(np.median(found.top_wire_ohm), 100, rtol=0.1)


def test_lines_that_charge_move_near_ends_alike_which_is_no_fault() -> None:
    """Of the first port, one near end alone: the other has settled before the scan."""
    random = np.random.default_rng(13)
    rest = skin_at_rest(6, 6, random)
    exact = seen(touch(rest, 3, random))
    charge = 14 / 1024 * random.choice([-1.0, 0.0, 1.0], (6, 6), p=[0.4, 0.2, 0.4])
    ratio = exact.copy()
    ratio[..., 0] += charge
    ratio[..., 2] += charge
    ratio[0, 0] = exact[0, 0] + [0, 0, 24 / 1024, 0]
    reader = PortReader(knowledge(ten_bits(seen(rest))))
    a, e, b, f = exact[0, 0]
    assert a > e > f > b
    for _ in range(3):
        ports = reader.read(ten_bits(ratio), in_order=True)
        assert not ports.fault
        assert abs(ports.current[0, 0] - b / (e - f + 2 * b) / 30e3) < 4 * ports.current_std[0, 0]


def test_wires_that_nobody_expects_are_measured_before_the_fit() -> None:
    """Wires of 1 and 2 kOhm, without rest readings: the prior is 150 Ohm."""
    random = np.random.default_rng(14)
    rest = skin_at_rest(8, 8, random, wire_ohm=(1000.0, 2000.0))
    known = replace(knowledge(seen(rest)), rest_ratio=None)
    estimator, off = make_estimator("joint", known), []
    for _ in range(10):
        touched = touch(rest, 4, random)
        estimator.reset()
        found = estimator.estimate(ten_bits(seen(touched)))
        pressed = touched.cell_siemens > 1.5 * rest.cell_siemens
        off.append(np.abs(found.cell_siemens / touched.cell_siemens - 1)[pressed])
    assert np.median(np.concatenate(off)) < 0.01


def test_a_far_end_that_floats_is_named() -> None:
    random = np.random.default_rng(2)
    rest = skin_at_rest(5, 6, random)
    ratio = ten_bits(seen(touch(rest, 3, random)))
    ratio[3, :, 1] = 0.95  # the far end of row 3, above its near end
    found = make_estimator("joint", knowledge(ten_bits(seen(rest)))).estimate(ratio)
    assert found.message.startswith("far row 3 does not follow its line: is it open?")


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_exact_nonsense_is_answered(method: str) -> None:
    known = SkinKnowledge(
        1, 1, nominal_wire_ohm=WireOhm(1e9, 1e9, lead=0.0), reading_names=tuple("aebf")
    )
    found = make_estimator(method, known).estimate(np.full((1, 1, 4), 0.5))
    assert np.isfinite([found.cell_siemens, found.cell_siemens_std]).all()
    assert not found.converged


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_segments_are_learned_from_touches(method: str) -> None:
    random = np.random.default_rng(9)
    rest = skin_at_rest(8, 8, random, wire_ohm=(300.0, 200.0))
    estimator = make_estimator(method, knowledge(ten_bits(seen(rest))))
    for _ in range(50):
        found = estimator.estimate(ten_bits(seen(touch(rest, 6, random))))
    pairs = (found.top_wire_ohm, rest.top_wire_ohm), (found.bottom_wire_ohm, rest.bottom_wire_ohm)
    off = np.concatenate([np.abs(found / truth - 1).ravel() for found, truth in pairs])
    assert np.median(off) < 0.05  # 0.067 of those whose layer alone is known
    known = estimator.wires()
    assert known.top == pytest.approx(300, rel=0.05)
    assert known.bottom == pytest.approx(200, rel=0.05)


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_bent_skin_is_read_as_the_same_at_once(method: str) -> None:
    random = np.random.default_rng(10)
    rest = skin_at_rest(8, 8, random)
    estimator = make_estimator(method, knowledge(ten_bits(seen(rest))))
    bent = replace(
        rest,
        top_wire_ohm=1.35 * rest.top_wire_ohm,
        bottom_wire_ohm=1.35 * rest.bottom_wire_ohm,
    )
    for _ in range(10):
        estimator.estimate(ten_bits(seen(touch(rest, 4, random))))
    off = []
    for _ in range(20):
        touched = touch(bent, 4, random)
        found = estimator.estimate(ten_bits(seen(touched)))
        pressed = touched.cell_siemens > 1.5 * rest.cell_siemens
        off.append(np.abs(found.cell_siemens / touched.cell_siemens - 1)[pressed])
    assert np.median(np.concatenate(off)) < 0.005
    assert np.median(found.top_wire_ohm) == pytest.approx(135, rel=0.07)
    assert np.median(found.bottom_wire_ohm) == pytest.approx(270, rel=0.07)


@pytest.mark.parametrize("at_near_end", [False, True])
@pytest.mark.parametrize(
    ("lines", "near_far", "name"),
    [
        (np.s_[:], (0, 1), "far rows"),
        (np.s_[:], (2, 3), "far columns"),
        (np.s_[3], (0, 1), "far row 3"),
    ],
)
def test_far_ends_that_show_nothing_of_their_lines_are_named(
    lines: slice | int, near_far: tuple[int, int], name: str, at_near_end: bool
) -> None:
    """From the middle of a run on; not before, and an untouched skin is as bad as a touched one."""
    random = np.random.default_rng(20)
    rest = skin_at_rest(8, 8, random)
    estimator = make_estimator("joint", knowledge(ten_bits(seen(rest))))
    near, far = near_far
    for frame in range(20):
        ratio = ten_bits(seen(rest if frame == 19 else touch(rest, 6, random)))
        if frame >= 10:
            ratio[lines, :, far] = ratio[lines, :, near] if at_near_end else 0.5
        found = estimator.estimate(ratio)
        assert (frame >= 10) or found.converged
    assert name in found.message


@pytest.mark.parametrize(("near", "far", "name"), [(0, 1, "far rows"), (2, 3, "far columns")])
def test_far_ends_that_were_their_near_ends_at_rest_are_named_sooner(
    near: int, far: int, name: str
) -> None:
    """The rest readings count as one frame, however often they are read."""
    random = np.random.default_rng(20)
    skin = skin_at_rest(8, 8, random)
    exact = np.array([*90 * [seen(skin)], *(seen(touch(skin, 4, random)) for _ in range(20))])
    noisy = exact + 0.3 / 1024 * random.standard_normal(exact.shape)
    noisy[..., far] = noisy[..., near]
    ratio = np.array([ten_bits(one) for one in noisy])
    rest, frames = ratio[:90].mean(axis=0), ratio[90:]

    def first_named(rest_reads: int) -> int:
        reader = PortReader(knowledge(rest))
        for _ in range(rest_reads):
            reader.read(rest)
        reader.reset()
        return [name in reader.read(one, in_order=True).fault for one in frames].index(True)

    assert first_named(0) > first_named(1) == first_named(2)


@pytest.mark.parametrize("apart", [0.025, -0.025])
def test_references_that_are_off_are_no_fault_of_a_far_line(apart: float) -> None:
    """Once, what they change was half of what a line seemed to lose: 5 of these frames."""
    random = np.random.default_rng(24002)
    trial = finger_trial(8, 8, 60, 24002, sigma_cells=(0.6, 1.0), peak_siemens=(3e-5, 3e-4))
    told = trial.rest.ref_top_ohm
    skins = [
        replace(each, ref_top_ohm=told * (1 + apart), ref_bottom_ohm=told * (1 - apart))
        for each in (trial.rest, *trial.frames)
    ]
    rest, *frames = map(seen, skins)
    known = SkinKnowledge(8, 8, adc_bits=10, rest_ratio=rest, reading_names=tuple("aebf"))
    estimator = make_estimator("joint", known)
    for frame in frames:
        noisy = frame + 0.3 / 1024 * random.standard_normal(frame.shape)
        assert estimator.estimate(ten_bits(noisy)).converged


def test_other_cells_may_carry_more_to_far_ends_than_the_ports_own() -> None:
    """Behind wires of 41 kOhm, the voltage between far ends may be below 0."""
    random = np.random.default_rng(21)
    rest = skin_at_rest(4, 4, random, wire_ohm=(41e3, 41e3), spread=0.3)
    touched = touch(rest, 4, random)
    expected = sensed_ohm(touched, (True, True))
    assert expected.min() < 0
    ports = PortReader(knowledge(seen(rest), bits=None)).read(seen(touched))
    np.testing.assert_allclose(1 / ports.current - 60e3, expected, rtol=1e-6)


def test_an_open_near_line_does_not_spoil_what_others_lose() -> None:
    random = np.random.default_rng(22)
    rest = skin_at_rest(6, 6, random)
    ratio = ten_bits(seen(touch(rest, 4, random)))
    ratio[2] = [1.0, 0.6, 0.0, 0.6]
    ports = PortReader(knowledge(ten_bits(seen(rest)))).read(ratio)
    assert ports.drop_std[2].min() > 1e6 > ports.drop_std[[0, 1, 3, 4, 5]].max()
    assert "far" not in ports.fault
