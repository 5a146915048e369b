# SPDX-License-Identifier: Apache-2.0
"""What no touches can make of a skin is said, and nothing of the kind where touches are all."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from network import SkinCircuit, floating_share
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, port_resistance_ohm, readings
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_faults import ALIKE_FRAMES, DOUBT_FRAMES
from ohmskin.estimate.port_readings import PortReader
from skins import shorted_readings, ten_bits, told
from studies.trials import Trial, finger_trial, random_trial, skin_at_rest, touch


def reader_of(rest_ratio: Float | None) -> PortReader:
    """Of an 8x8 skin at rest, with its wires; without rest readings nothing is known of it."""
    known = SkinKnowledge(8, 8, adc_bits=10) if rest_ratio is None else told(rest_ratio)
    return PortReader(known)


@pytest.fixture
def rest() -> Skin:
    return skin_at_rest(8, 8, np.random.default_rng(1))


@pytest.fixture
def touched(rest: Skin) -> Skin:
    return touch(rest, 5, np.random.default_rng(2))


def test_touches_are_no_fault() -> None:
    faults = []
    for seed in range(20):
        trial = random_trial(8, 8, 10, 10, seed)
        told = trial.rounded(10)
        reader = reader_of(told.rest_ratio)
        faults += [reader.read(ratio).fault for ratio in told.ratio]
    # Two lines may draw the same currents by chance.
    assert sum(map(bool, faults)) <= 0.02 * len(faults)
    assert all("alike" in fault for fault in faults if fault)


def test_no_touch_lowers_a_current(rest: Skin) -> None:
    """Rayleigh's monotonicity law, on which a fault is founded, on random skins."""
    random = np.random.default_rng(3)
    for _ in range(30):
        more = rest.cell_siemens * np.exp(np.abs(random.normal(0, 3, rest.shape)))
        below = port_resistance_ohm(rest) - port_resistance_ohm(replace(rest, cell_siemens=more))
        assert below.min() > -1e-9 * port_resistance_ohm(rest).max()


@pytest.mark.parametrize(("layer", "line"), [("top", "(3, "), ("bottom", ", 3)")])
def test_an_open_line_is_named(rest: Skin, touched: Skin, layer: str, line: str) -> None:
    wires = getattr(touched, f"{layer}_wire_ohm").copy()
    wires[(3, 0) if layer == "top" else (0, 3)] = 1e12
    cut = replace(touched, **{f"{layer}_wire_ohm": wires})
    fault = reader_of(readings(rest)).read(ten_bits(readings(cut))).fault
    assert "conducts less than at rest" in fault
    assert line in fault


def test_a_skin_that_drifted_asks_for_new_rest_readings(rest: Skin) -> None:
    drifted = replace(rest, cell_siemens=0.7 * rest.cell_siemens)
    fault = reader_of(readings(rest)).read(ten_bits(readings(drifted))).fault
    assert fault == "the whole skin conducts less than at rest: take the rest readings anew"


def test_half_a_code_less_of_what_hardly_conducts_is_noise() -> None:
    """Cells of 20 megohm: a fifth of their current, but fewer than five deviations."""
    none = np.zeros((2, 2))
    rest = ten_bits(readings(Skin(np.full((2, 2), 1 / 20e6), none, none)))
    reader = PortReader(told(rest, wires=False))
    less = rest + 0.5 / 1024 * np.array([1, -1, 1, -1])
    assert np.all(reader.read(less).current < 0.81 * reader.read(rest).current)
    assert [reader.read(ratio).fault for ratio in (rest, less)] == ["", ""]


def test_a_line_open_since_rest_is_named(rest: Skin) -> None:
    wires = rest.top_wire_ohm.copy()
    wires[2, 0] = 1e12
    ratio = ten_bits(readings(replace(rest, top_wire_ohm=wires)))
    assert "row 2 conducted nothing at rest" in reader_of(ratio).read(ratio).fault


@pytest.mark.parametrize(("first", "said"), [(4, "rows 4 and 5"), (8 + 1, "columns 1 and 2")])
def test_shorted_lines_that_nothing_touches_are_named(rest: Skin, first: int, said: str) -> None:
    shorted = ten_bits(shorted_readings(rest, first, first + 1))
    assert said in reader_of(readings(rest)).read(shorted).fault
    assert said in reader_of(shorted).read(shorted).fault


def test_touched_lines_are_in_doubt_then_shorted_if_they_stay_alike(rest: Skin) -> None:
    cells = rest.cell_siemens.copy()
    cells[4, 3] += 2e-4
    touched = replace(rest, cell_siemens=cells)
    reader, apart = reader_of(readings(rest)), ten_bits(readings(touched))
    alike = ten_bits(shorted_readings(touched, 4, 5))
    lines = np.zeros((8, 8), dtype=bool)
    lines[4:6] = True
    for doubted in (1, DOUBT_FRAMES, DOUBT_FRAMES):  # frames have shown the lines apart, later
        frames = [reader.read(alike) for _ in range(ALIKE_FRAMES)]
        assert not any(frame.fault for frame in frames[:-1])
        assert "rows 4 and 5" in frames[-1].fault
        assert not any(frame.doubt.any() for frame in frames[: doubted - 1])
        assert all(np.array_equal(frame.doubt, lines) for frame in frames[doubted - 1 : -1])
        shown = reader.read(apart)
        assert not shown.fault
        assert not shown.doubt.any()
    reader.reset()
    assert reader.read(alike).doubt.any()


def test_a_finger_that_lies_evenly_on_two_lines_is_in_doubt_and_no_short() -> None:
    """The first frame that a program reads, with the finger exactly between two rows."""
    random, row, column = np.random.default_rng(5), *np.indices((8, 8))
    doubted = []
    for place, peak_siemens in product(np.arange(1.0, 6.1, 0.5), (2e-5, 1e-4)):
        rest = skin_at_rest(8, 8, random)
        circuit = SkinCircuit(rest)
        away = (row - 3.5) ** 2 + (column - place) ** 2
        finger = peak_siemens * np.exp(-away / (2 * 1.5**2))
        frames = [circuit.readings(rest.cell_siemens)] * 20
        frames.append(circuit.readings(rest.cell_siemens + finger))
        exact = np.array(frames)[..., :4]
        *at_rest, now = ten_bits(exact + 0.3 / 1024 * random.standard_normal(exact.shape))
        known = SkinKnowledge(8, 8, adc_bits=10, rest_ratio=np.mean(at_rest, axis=0))
        frame = PortReader(known).read(now, in_order=True)
        assert not frame.fault
        doubted.append(frame.doubt[3:5].all())
    assert np.mean(doubted) > 0.5


@pytest.mark.parametrize("half", [np.s_[:4], np.s_[:, :4]], ids=["rows", "columns"])
def test_lines_beside_a_press_on_half_the_skin_are_not_shorted(half: Any) -> None:
    """It ties the other layer's lines to one node, from which untouched lines draw alike."""
    faults = []
    for seed in range(5):
        rest = skin_at_rest(8, 8, np.random.default_rng(seed))
        circuit, cells = SkinCircuit(rest), rest.cell_siemens.copy()
        cells[half] += 2e-4
        untouched, pressed = (
            ten_bits(circuit.readings(one)[..., :4]) for one in (rest.cell_siemens, cells)
        )
        faults.append(reader_of(untouched).read(pressed).fault)
    assert faults == [""] * 5


def test_a_row_shorted_to_a_column_is_named(rest: Skin, touched: Skin) -> None:
    shorted = ten_bits(shorted_readings(touched, 5, 8 + 6))
    fault = reader_of(readings(rest)).read(shorted).fault
    assert fault == "cell (5, 6): less resistance than any touch leaves: is it a short?"
    assert reader_of(None).read(shorted).fault == fault  # where nobody has told the wires, too


@pytest.mark.parametrize("stuck", range(4))
@pytest.mark.parametrize("at", [0.0, 1.0])
def test_one_stuck_reading_of_a_cell_is_left_out(
    rest: Skin, touched: Skin, stuck: int, at: float
) -> None:
    reader = reader_of(readings(rest))
    ratio = ten_bits(readings(touched))
    good = reader.read(ratio)
    place = tuple(np.argwhere(touched.cell_siemens > rest.cell_siemens)[0])
    ratio[(*place, stuck)] = at
    found = reader.read(ratio)
    assert not found.fault
    np.testing.assert_allclose(found.current, good.current, atol=2 * good.current_std.max())
    assert found.current_std[place] > good.current_std[place]


def test_readings_that_disagree_are_named(rest: Skin, touched: Skin) -> None:
    ratio = ten_bits(readings(touched))
    reader = reader_of(readings(rest))
    ratio[2, 7, 1:3] = 0.9, 0.4
    assert "cell (2, 7): its readings disagree by" in reader.read(ratio).fault
    ratio[..., 0] = 0.0
    assert "readings of most cells disagree" in reader.read(ratio).fault


@pytest.mark.parametrize(
    ("codes", "offset"),
    [(0.0, 0), (0.05, 0), (0.15, 0), (0.3, 0), (1.0, 0), (4.0, 0), (0.3, 2), (1.0, -5)],
)
def test_errors_of_currents_are_as_large_as_stated(rest: Skin, codes: float, offset: int) -> None:
    """Normal noise of so many codes, then rounding. Noise makes the four readings independent.

    offset: of the top node's readings [codes], of which the currents show nothing.
    """
    random = np.random.default_rng(4)
    reader = reader_of(None)
    exact = reader.read(readings(rest)).current
    away = []
    for _ in range(20):
        noisy = readings(rest) + codes / 1024 * random.standard_normal((8, 8, 4))
        noisy[..., [0, 3]] += offset / 1024
        found = reader.read(ten_bits(noisy))
        assert not found.fault
        away.append((found.current - exact) / found.current_std)
    assert 0.7 < np.std(away) < 1.05


def test_what_stays_from_frame_to_frame_is_no_noise(rest: Skin) -> None:
    """Lines that have not settled err alike in every frame; noise does not, and is not halved."""
    random = np.random.default_rng(6)
    stays = readings(rest) + 10 / 1024 * random.standard_normal((8, 8, 4))
    reader = reader_of(None)
    first, *_, last = (
        reader.read(ten_bits(stays + 3e-4 * random.standard_normal(stays.shape)), in_order=True)
        for _ in range(3)
    )
    assert last.current_std.mean() < 0.3 * first.current_std.mean()
    for _ in range(10):
        noisy = readings(rest) + 10 / 1024 * random.standard_normal(stays.shape)
        found = reader.read(ten_bits(noisy), in_order=True)
        assert found.current_std.mean() > 0.7 * first.current_std.mean()
        again = reader.read(ten_bits(noisy))  # one scan at rest, not a mean of many
        np.testing.assert_array_equal(again.current_std, found.current_std)


def test_what_moves_both_near_ends_alike_is_once_in_what_wires_lose(rest: Skin) -> None:
    """Mode far, both near ends off by 14 LSB in every frame: 12 % of it, and noise of two codes."""
    exact = all_readings(rest, end_admittance(rest))[..., [0, 4, 1, 5]]
    sign = np.arange(64).reshape(8, 8) % 3 - 1.0  # median 0: no offset of the board
    sign[0, 0] = 0.0  # the first port has settled
    stays = 14 / 1024 * sign
    ratio = ten_bits(exact + stays[..., None] * [1, 0, 1, 0])
    reader = PortReader(SkinKnowledge(8, 8, adc_bits=10, reading_names=tuple("aebf")))
    _, found = (reader.read(ratio, in_order=True) for _ in range(2))
    current = (1 - exact[..., 0] + exact[..., 2]) / 60e3
    std_lsb = (1024 * found.drop_std * current)[sign != 0]
    np.testing.assert_allclose(std_lsb, np.hypot(0.12 * 14, (2 * 2 / 12) ** 0.5), rtol=0.1)


def test_without_rest_readings_nothing_is_said_of_a_change(rest: Skin) -> None:
    dark = replace(rest, cell_siemens=np.full((8, 8), 1e-9))
    assert not reader_of(None).read(ten_bits(readings(dark))).fault


@pytest.mark.parametrize("trial", [random_trial(8, 8, 6, 8, 3), finger_trial(8, 8, 8, 3)])
def test_lines_draw_from_the_end_that_they_are_nearer_to(trial: Trial) -> None:
    """The sums of the other currents of row and column told too little: references limit these."""
    drawn, errors = 8.0 / 1024, []
    for skin in trial.frames:
        exact, share = readings(skin), floating_share(skin)
        row, column = drawn * (1 + share), drawn * (1 - share)
        ratio = exact + np.stack([-row, -column, column, row], axis=-1)
        found = reader_of(trial.readings.rest_ratio).read(ratio)
        errors.append(skin.ref_top_ohm * found.current - exact[..., 3])
    assert 1024 * np.sqrt(np.mean(np.square(errors))) < 0.35
