# SPDX-License-Identifier: Apache-2.0
"""Frames that no skin gives: no exception, and finite numbers where promised."""

from dataclasses import replace

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import MIN_CELL_SIEMENS, SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from skins import told
from studies.trials import skin_at_rest, touch

# Frames of each shape: enough to reach every branch of the estimators. Larger skins take longer.
FRAMES = {(1, 1): 160, (1, 4): 160, (3, 1): 160, (2, 2): 48, (3, 3): 24, (8, 8): 16}
NONSENSE = ("noise", "rails", "one current", "all alike", "one cell at a rail", "shorts")
# The wires learn from a touch, in the state in which nonsense has left the estimator.
KINDS = (*NONSENSE, "touch", "one reading at a rail")


def rest_of(shape: tuple[int, int]) -> Skin:
    return skin_at_rest(*shape, np.random.default_rng(1))


def frame(kind: str, shape: tuple[int, int], random: np.random.Generator) -> Float:
    ratio = random.random((*shape, 4))
    if kind == "rails":
        return np.round(ratio)
    if kind == "shorts":
        return np.where(random.random(shape)[..., None] < 0.5, [1.0, 0.0, 1.0, 0.0], 0.5)
    if kind == "one current":
        current = 0.5 * random.random(shape)[..., None]
        return np.where([True, False, True, False], 1 - current, current)
    if kind == "all alike":
        return np.broadcast_to(random.integers(0, 2, 4).astype(float), ratio.shape).copy()
    if kind == "one cell at a rail":
        ratio = np.full_like(ratio, [0.9, 0.1, 0.9, 0.1])
        ratio[tuple(random.integers(shape))] = random.integers(0, 2)
    if kind in ("touch", "one reading at a rail"):
        ratio = readings(touch(rest_of(shape), 2, random))
    if kind == "one reading at a rail":
        ratio[tuple(random.integers((*shape, 4)))] = random.integers(0, 2)
    return ratio


def check(estimator: Estimator, ratio: Float) -> None:
    found = estimator.estimate(ratio)
    assert np.isfinite(found.cell_ohm).all()
    assert np.isfinite(found.cell_siemens_std).all()
    assert (found.cell_siemens_std > 0).all()
    assert np.isfinite(found.chi2)
    assert found.converged == (not found.message)
    if estimator.name in ("joint", "touch"):
        assert np.isfinite(found.top_wire_ohm).all()
        assert np.isfinite(found.bottom_wire_ohm).all()


def knowledge_of(shape: tuple[int, int], what: str) -> SkinKnowledge:
    random = np.random.default_rng(1)
    if what in ("nothing", "exact"):
        return SkinKnowledge(*shape, adc_bits=10 if what == "nothing" else None)
    return told(random.random((*shape, 4)) if what == "nonsense" else readings(rest_of(shape)))


@pytest.mark.parametrize("what", ["all", "nothing", "exact", "nonsense"])
@pytest.mark.parametrize("shape", FRAMES)
@pytest.mark.parametrize("method", ["ohm", "matrix", "joint", "touch"])
def test_nonsense_is_answered(method: str, shape: tuple[int, int], what: str) -> None:
    random = np.random.default_rng([*shape, len(what)])
    estimator = make_estimator(method, knowledge_of(shape, what))
    for number in range(FRAMES[shape]):
        check(estimator, frame(KINDS[number % len(KINDS)], shape, random))


@pytest.mark.parametrize("method", ["ohm", "matrix", "joint", "touch"])
@pytest.mark.parametrize("ratio", [0.0, 1.0])
def test_all_readings_at_a_rail_are_flagged(method: str, ratio: float) -> None:
    found = make_estimator(method, knowledge_of((4, 4), "all")).estimate(np.full((4, 4, 4), ratio))
    assert not found.converged
    assert "readings of most cells disagree" in found.message


@pytest.mark.parametrize("method", ["ohm", "matrix", "joint", "touch"])
@pytest.mark.parametrize("what", ["all", "nothing"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_line_stuck_at_half_is_flagged(method: str, what: str, axis: int) -> None:
    """All its ports look shorted: as touches, to `ohm`."""
    knowledge = knowledge_of((8, 8), what)
    ratio = np.moveaxis(readings(touch(rest_of((8, 8)), 2, np.random.default_rng(2))), axis, 0)
    ratio[3] = 0.5
    found = make_estimator(method, knowledge).estimate(np.moveaxis(ratio, 0, axis))
    assert "less resistance than any touch leaves" in found.message


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (8, 8)])
def test_readings_that_no_cells_give_are_flagged(shape: tuple[int, int]) -> None:
    """Every port reads twice the current of a short. Nothing else contradicts it: no rest."""
    ratio = np.broadcast_to([0.0, 1.0, 0.0, 1.0], (*shape, 4))
    found = make_estimator("matrix", knowledge_of(shape, "nothing")).estimate(ratio)
    assert found.chi2 > 1e6
    assert "no cells give these readings: they miss 50 % of Vdd" in found.message


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_after_nonsense_a_good_frame_is_answered_as_if_nothing_had_been(method: str) -> None:
    random = np.random.default_rng(3)
    knowledge = knowledge_of((8, 8), "all")
    used, new = (make_estimator(method, knowledge) for _ in range(2))
    for kind in 2 * NONSENSE[:4]:
        used.estimate(frame(kind, (8, 8), random))
    after, first = used.estimate(knowledge.rest_ratio), new.estimate(knowledge.rest_ratio)
    apart = np.abs(after.cell_siemens - first.cell_siemens) / first.cell_siemens_std
    assert apart.max() < 0.5
    assert after.converged


def test_cells_on_a_bound_cost_matrix_few_steps() -> None:
    """Half of the cells end there. Steps that take what those do the wrong way: 211, not 163."""
    steps = 0
    for seed in range(6):
        random = np.random.default_rng(seed)
        estimator = make_estimator("matrix", SkinKnowledge(4, 4, adc_bits=10))
        found = estimator.estimate(frame("one current", (4, 4), random))
        assert np.count_nonzero(found.cell_siemens == MIN_CELL_SIEMENS) >= 7
        steps += found.iterations
    assert steps < 185


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("shape", [(12, 12), (6, 24)])
def test_nonsense_is_given_up_early(method: str, shape: tuple[int, int]) -> None:
    random = np.random.default_rng(6)
    estimator = make_estimator(method, knowledge_of(shape, "all"))
    for _ in range(3):
        found = estimator.estimate(frame("one current", shape, random))
        assert not found.converged
        assert found.iterations == 12


def test_a_cell_beyond_the_hardest_touch_is_named() -> None:
    rest = rest_of((4, 4))
    cells = rest.cell_siemens.copy()
    for siemens, message in ((1 / 600, ""), (1 / 100, "cell (2, 1): conducts more than any touch")):
        cells[2, 1] = siemens
        ratio = readings(Skin(cells, rest.top_wire_ohm, rest.bottom_wire_ohm))
        found = make_estimator("joint", told(readings(rest))).estimate(ratio)
        assert found.message.startswith(message)
        assert found.converged == (not message)


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize(("ohm", "is_too_much"), [(1e3, False), (5e4, True)])
def test_wires_as_large_as_cells_at_rest_are_said(
    method: str, ohm: float, *, is_too_much: bool
) -> None:
    wires = np.full((8, 8), ohm)
    rest = readings(Skin(rest_of((8, 8)).cell_siemens, wires, wires))
    knowledge = replace(told(rest), nominal_wire_ohm=WireOhm(ohm, ohm, lead=0.0))
    found = make_estimator(method, knowledge).estimate(rest)
    assert ("wires resist too much" in found.message) == is_too_much


def test_wires_that_were_measured_badly_are_known_worse_than_nominal_ones() -> None:
    rest = rest_of((4, 4))
    knowledge = told(readings(rest))
    ratio = readings(touch(rest, 3, np.random.default_rng(2)))
    stated = []
    for wires in (knowledge.nominal_wire_ohm, knowledge.nominal_wire_ohm._replace(top_log_std=1.0)):
        known = replace(knowledge, nominal_wire_ohm=wires)
        stated.append(make_estimator("joint", known).estimate(ratio).cell_siemens_std.max())
    assert stated[1] > 1.2 * stated[0]
