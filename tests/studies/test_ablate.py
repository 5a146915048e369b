# SPDX-License-Identifier: Apache-2.0
"""`make ablate`: which constants there are, that each is put back, what the figures say."""

import ast
from pathlib import Path

import numpy as np
import pytest

from ohmskin.estimate import (
    cells_at_rest,
    far_wires,
    full_fit,
    joint,
    port_faults,
    port_noise,
    prior,
    sparse_fit,
    staying_faults,
    wire_belief,
)
from studies import ablate
from studies.ablate import OFF, Constant, Row
from studies.ablate_scenes import Plan

TINY = Plan(skins=3, frames=4)
SCENE = "ngspice_random"
MODULES = (
    *(cells_at_rest, far_wires, full_fit, joint, port_faults, port_noise, prior, sparse_fit),
    *(staying_faults, wire_belief),
)
BY_LABEL = {constant.label: constant for constant in ablate.constants()}
TRIED = [BY_LABEL["prior.SEGMENT_STD"], BY_LABEL["sparse_fit.RIVAL_SHARE"]]


def test_every_number_is_tried() -> None:
    """Each once, where it stands; what is private or another's is none."""
    variants = BY_LABEL["prior.LEFT_OUT_STDS"].variants
    assert variants == {"off": 1e-3, "halved": 0.125, "doubled": 0.5}
    assert BY_LABEL["prior.MAX_ITERATIONS"].variants == {"halved": 20, "doubled": 80}
    assert not {"full_fit.LEFT_OUT_STDS", "sparse_fit._HIGHEST_LOG_SIEMENS"} & set(BY_LABEL)
    assert set(OFF) <= set(BY_LABEL)


def test_numbers_that_moved_out_of_joint_are_tried_still() -> None:
    assert {
        "cells_at_rest.LEAK_GAIN",
        "staying_faults.STAYING_SURPRISE",
        "wire_belief.LARGE_MOVE_LOG",
    } <= set(BY_LABEL)


@pytest.mark.parametrize(
    "path", sorted(Path(joint.__file__).parent.glob("*.py")), ids=lambda path: path.stem
)
def test_no_default_keeps_a_constant_as_it_is(path: Path) -> None:
    """`REST_FITS` was one: it was changed, and the function went on with 3 fits."""
    kept: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            kept += [*node.args.defaults, *node.args.kw_defaults]
        elif isinstance(node, ast.ClassDef):
            kept += [field.value for field in node.body if isinstance(field, ast.AnnAssign)]
    names = {
        name.id
        for value in kept
        if value is not None
        for name in ast.walk(value)
        if isinstance(name, ast.Name)
    }
    # A constant of its own; and a default that no method takes.
    names -= {"paper": {"MAX_ITERATIONS"}, "prior": {"REACH_STDS"}}.get(path.stem, set())
    assert not names & {constant.name for constant in BY_LABEL.values()}


@pytest.mark.parametrize("constant", BY_LABEL.values(), ids=lambda constant: constant.label)
def test_a_constant_is_changed_wherever_it_is_read_and_put_back(constant: Constant) -> None:
    def constants() -> list[dict[str, object]]:
        return [
            {name: vars(module)[name] for name in vars(module) if name.isupper()}
            for module in MODULES
        ]

    before = constants()

    def fail_inside() -> None:
        with ablate.changed(constant, 1.25):
            for module, own in zip(MODULES, before, strict=True):
                if constant.name in own:
                    assert getattr(module, constant.name) == 1.25
            raise KeyError("from inside")

    with pytest.raises(KeyError, match="from inside"):
        fail_inside()
    assert constants() == before


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return ablate.measure(TRIED, TINY, scenes=[SCENE], jobs=1)


def test_constants_that_matter_move_figures(rows: list[Row]) -> None:
    figures = [row for row in rows if row.figure not in ablate.INFORMATIVE]
    for constant in TRIED:
        assert any(row.constant == constant.label for row in figures)
    # Without the rule against ghosts, a frame of many touches is one of ghosts.
    off = [
        row for row in figures if (row.constant, row.variant) == ("sparse_fit.RIVAL_SHARE", "off")
    ]
    assert any(abs(row.ratio - 1) > ablate.LEAST_CHANGE for row in off)
    assert all(row.low <= row.high for row in rows)


def test_a_resample_is_that_of_the_values_of_its_skins() -> None:
    """Against numpy's quantile and mean of the values that were drawn, written out."""
    random = np.random.default_rng(3)
    skins = random.integers(0, 5, 60)
    values = random.standard_normal(60)
    draws = np.random.default_rng(5).multinomial(5, np.full(5, 0.2), ablate.RESAMPLES)
    found = {of: ablate.resampled(values, skins, of) for of in (None, 0.5, 0.9)}
    for number, times in enumerate([np.ones(5, dtype=int), *draws[:20]]):
        drawn = np.repeat(values, times[skins])
        assert found[None][number] == pytest.approx(drawn.mean())
        for of in (0.5, 0.9):
            expected = np.quantile(drawn, of, method="inverted_cdf")
            assert found[of][number] == pytest.approx(expected)
