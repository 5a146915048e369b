# SPDX-License-Identifier: Apache-2.0
"""The calibration file: the same bits after a round trip, and whatever else it may hold refused."""

import json
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.arrays import Float
from ohmskin.calibrate.regression import ForceRegression
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import MAX_FILE_BYTES, Calibration, Rest, load_calibration
from ohmskin.force.curve import POWER
from ohmskin.link.codes import quantise, ratio_from_codes


def rest(seed: int, date: str) -> Rest:
    """As `touch` reads a skin of that seed."""
    cell_siemens = 1e-6 * np.exp(0.1 * np.random.default_rng(seed).standard_normal((2, 3)))
    skin = Skin(cell_siemens, np.full((2, 3), 100.0), np.full((2, 3), 200.0))
    ratio = ratio_from_codes(quantise(readings(skin)))
    return Rest.of("touch", SkinKnowledge(2, 3, adc_bits=10, rest_ratio=ratio), date)


def calibration(pressed: int = 5) -> Calibration:
    """A 2x3 skin of which so many cells were pressed, the first by a power law."""
    random = np.random.default_rng(1)
    cells = np.repeat(np.arange(pressed), 20)
    rise = random.uniform(2e-6, 100e-6, cells.size)
    force_n = 10 * (rise / 1e-4) ** np.where(cells == 0, 0.5, 1.0)
    force_n = np.abs(force_n + 0.1 * random.standard_normal(cells.size))
    found = ForceRegression().fit(cells, rise, force_n, shape=(2, 3))
    assert found.model_.kind[0, 0] == POWER
    assert found.model_.pooled.any()
    return Calibration(
        unit_id=7,
        date="2025-03-01T12:00:00+00:00",
        method="touch",
        rest=rest(2, "2025-03-01T11:50:00+00:00"),
        model=found.model_,
        indenter_area_m2=1e-4,
        nominal_wire_ohm=WireOhm(100.0),
        largest_force_n=float(force_n.max()),
        own_lead_ohm=np.array([0.0, 700.25, 0.0, 0.0, -20.0]),
    )


def forces(of_skin: Calibration, level: Float) -> Float:
    """At these levels (2, 3), above the rest that holds now."""
    return of_skin.model.predict(level - of_skin.untouched.level, np.full((2, 3), 1e-7))[0]


def assert_same(first: Any, second: Any) -> None:
    """Two calibrations, or parts of them, field by field."""
    for field in fields(first):
        one, other = getattr(first, field.name), getattr(second, field.name)
        assert type(one) is type(other), field.name
        if is_dataclass(one):
            assert_same(one, other)
        elif isinstance(one, np.ndarray):
            assert one.dtype.kind == other.dtype.kind
            np.testing.assert_array_equal(one, other)
        else:
            assert one == other, field.name


def test_the_curve_of_all_presses_has_the_hidden_wires_of_the_pressed_cells() -> None:
    """Five of six cells were pressed. Each has its own wires in its curve; the last, their mean."""
    of_skin = calibration()
    found = make_estimator("touch", SkinKnowledge(2, 3)).estimate(of_skin.rest.ratio)
    hidden_ohm = np.array([[100.0, -50.0, 400.0], [300.0, -250.0, 900.0]])
    cell_ohm = np.full((2, 3), 2000.0)
    found = replace(found, cell_siemens=1 / cell_ohm, level=1 / (cell_ohm + hidden_ohm))
    expected_ohm = np.array([[2100.0, 1950.0, 2400.0], [2300.0, 1750.0, 2100.0]])
    (level,), (std,) = of_skin.level([found])
    np.testing.assert_allclose(1 / level, expected_ohm)
    # In ohm, the deviation of the last cell is the same.
    np.testing.assert_allclose(std / level**2, found.level_std / found.level**2)
    # Where no cell has a curve of its own, presses were of any.
    model = replace(of_skin.model, pooled=np.ones((2, 3), dtype=bool))
    (level,), _ = replace(of_skin, model=model).level([found])
    np.testing.assert_allclose(1 / level, 2000.0 + hidden_ohm.mean())
    # `matrix` takes no wires into account.
    np.testing.assert_array_equal(of_skin.level([replace(found, wires="")])[0][0], found.level)


@pytest.mark.parametrize("pressed", [1, 5])
def test_round_trip_is_bit_for_bit(tmp_path: Path, pressed: int) -> None:
    saved = calibration(pressed)
    if pressed == 1:
        assert np.isnan(saved.model.residual_std).any()
    path = tmp_path / "skin.json"
    saved.save(path)
    loaded = load_calibration(path)
    assert_same(saved, loaded)
    again = tmp_path / "again.json"
    loaded.save(again)
    assert again.read_bytes() == path.read_bytes()
    level = saved.rest.level + 30e-6
    np.testing.assert_array_equal(forces(saved, level), forces(loaded, level))
    assert not forces(loaded, saved.rest.level).any()


def test_a_tare_is_the_rest_until_it_is_undone(tmp_path: Path) -> None:
    before = calibration()
    wires = WireOhm(150.0, 200.0, 80.0, 0.1, 0.1, 20.0, 100.0, 300.0, 0.0)
    tared = replace(before, tare=rest(3, "2025-03-02T08:00:00+00:00"), nominal_wire_ohm=wires)
    path = tmp_path / "skin.json"
    tared.save(path)
    loaded = load_calibration(path)
    assert_same(tared, loaded)
    assert not forces(loaded, loaded.tare.level).any()
    assert forces(loaded, loaded.rest.level).any()
    assert not forces(replace(loaded, tare=None), before.rest.level).any()


def test_files_of_before_leads_and_modes_are_read(tmp_path: Path) -> None:
    """They had one deviation for the wires of both layers."""
    path = tmp_path / "skin.json"
    calibration().save(path)
    content = json.loads(path.read_text())
    for name in ("mode", "nominal_lead_ohm", "lead_std_ohm", "top_wire_log_std", "curve_lead_ohm"):
        del content[name]
    for name in ("bottom_wire_log_std", "largest_force_n", "own_lead_ohm"):
        del content[name]
    path.write_text(json.dumps(content | {"wire_log_std": 0.125}))
    loaded = load_calibration(path)
    assert (loaded.mode, loaded.largest_force_n, loaded.own_lead_ohm) == ("near", None, None)
    wires = loaded.nominal_wire_ohm
    assert (wires.lead, wires.lead_std_ohm) == (None, None)
    assert (wires.top_log_std, wires.bottom_log_std) == (0.125, 0.125)


def test_forces_far_beyond_those_of_the_presses_are_less_probable() -> None:
    """By a fine grid of logs: flat up to the largest press, and as 1 / q^4 beyond."""
    known = replace(calibration(), largest_force_n=8.0)
    rise = np.array([[200e-6, 20e-6, 300e-6], [400e-6, 200e-6, 200e-6]])
    rise_std = np.array([[10e-6, 200e-6, 2e-3], [50e-6, 200e-6, np.nan]])
    touched = np.array([[True, True, True], [True, False, True]])
    plain, plain_std = known.model.predict(rise, rise_std)
    found, found_std = known.forces(rise, rise_std, touched)
    is_open = touched & ~np.isnan(rise_std)
    np.testing.assert_array_equal(found[~is_open], plain[~is_open])
    np.testing.assert_array_equal(found_std[~is_open], plain_std[~is_open])
    assert plain_std[0, 0] < 2.0
    assert (plain_std[0, 1:] > 8.0).all()
    for row, column in np.argwhere(is_open):
        force_n, std_n = plain[row, column], plain_std[row, column]
        four_stds = np.log((force_n + 4.0 * std_n) / force_n)
        logs = np.log(force_n) + np.linspace(-four_stds, four_stds, 100_001)
        share = np.exp(-8.0 * ((logs - np.log(force_n)) / four_stds) ** 2)
        share[logs > np.log(8.0)] *= np.exp(4.0 * (np.log(8.0) - logs[logs > np.log(8.0)]))
        likely_n = min(share @ np.exp(logs) / share.sum(), force_n)
        assert found[row, column] == pytest.approx(likely_n, rel=3e-3)
        std_of_grid_n = np.sqrt(share @ (np.exp(logs) - likely_n) ** 2 / share.sum())
        assert found_std[row, column] == pytest.approx(std_of_grid_n, rel=1e-2)
        assert found_std[row, column] < std_n
    is_lower = np.array([[True, False, True], [True, False, False]])
    np.testing.assert_array_equal(found < plain, is_lower)
    same = replace(known, largest_force_n=None).forces(rise, rise_std, touched)
    np.testing.assert_array_equal(same[0], plain)


@given(st.floats(1e-6, 1e-3), st.floats(0.0, 1.0), st.floats(0.0, 100.0), st.floats(0.1, 100.0))
@settings(max_examples=50)
def test_forces_rise_with_the_rise_and_without_jumps(
    rise: float, more: float, std_share: float, largest_n: float
) -> None:
    known = replace(calibration(), largest_force_n=largest_n)
    rises = rise * np.array([1.0, 1.0 + 1e-9, 1.0 + more])[:, None, None] * np.ones((3, 2, 3))
    plain, _ = known.model.predict(rises, std_share * rises)
    found, std = known.forces(rises, std_share * rises, np.full((3, 2, 3), True))
    assert (found <= plain * (1 + 1e-12)).all()
    assert (found[2] >= found[0] * (1 - 1e-3)).all()
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3)
    assert (np.isfinite(std) & (std > 0)).all()


def test_a_certain_force_beyond_those_of_the_presses_stays() -> None:
    known = replace(calibration(), largest_force_n=2.0)
    rise = np.full((2, 3), 400e-6)
    certain, std = known.model.predict(rise, 1e-9 * rise)
    found, _ = known.forces(rise, 1e-9 * rise, np.full((2, 3), True))
    assert (certain > 3.0 * 2.0).all()
    np.testing.assert_array_less(np.abs(found - certain), 0.5 * std)


def test_rest_is_what_the_method_reads() -> None:
    ratio = rest(2, "2025-03-01").ratio
    cell_siemens = 1e-6 * np.exp(0.1 * np.random.default_rng(2).standard_normal((2, 3)))
    for method, tolerance in (("joint", 0.05), ("ohm", 0.7)):
        level = Rest.of(method, SkinKnowledge(2, 3, rest_ratio=ratio), "2025-03-01").level
        np.testing.assert_allclose(level, cell_siemens, rtol=tolerance)
    a, b, c, d = np.moveaxis(ratio, -1, 0)
    level = Rest.of("voltage", SkinKnowledge(2, 3, rest_ratio=ratio), "2025-03-01").level
    np.testing.assert_allclose(level, (1 - a + b + 1 - c + d) / 4, rtol=1e-12)
    with pytest.raises(ValueError, match="the readings of the untouched skin are not known"):
        Rest.of("ohm", SkinKnowledge(2, 3), "2025-03-01")


def cells(value: Any) -> list[list[Any]]:
    return [[value] * 3] * 2


def put(*place: Any) -> Callable[[dict[str, Any]], None]:
    """An edit that puts the last of these where the others lead to."""
    *way, last, value = place

    def edit(content: Any) -> None:
        for step in way:
            content = content[step]
        content[last] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda content: content.pop("slope"), "no field 'slope'"),
        (put("colour", "red"), "unknown field 'colour'"),
        (put("format", "other"), "no calibration: field 'format' is not 'ohmskin calibration'"),
        (put("schema", 2), "field 'schema' is not 1: written by another version of ohmskin"),
        (put("schema", True), "field 'schema' is not 1: written by another version of ohmskin"),
        (put("unit_id", "7"), "unit_id holds str, not int"),
        (put("unit_id", 2**32), "unit_id is 4294967296, not in 0..4294967295"),
        (put("date", "yesterday"), "date is 'yesterday', not ISO 8601"),
        (put("date", 20250301), "date holds int, not str"),
        (put("method", "magic"), "method is 'magic', not one of ohm, matrix, "),
        (put("mode", "middle"), "mode is 'middle', not one of near, far"),
        (put("rows", 2.0), "rows holds float, not int"),
        (put("rows", 0), "kind has not the shape (0, 3)"),
        (put("columns", 10**18), "kind has not the shape (2, 1000000000000000000)"),
        (put("slope", [[1.0] * 3, [1.0] * 2]), "slope has not the shape (2, 3)"),
        (put("kind", 1, 2, "x" * 10**6), "kind of cell (1, 2) is neither linear nor power"),
        (put("columns", 4), "kind has not the shape (2, 4)"),
        (put("rest", None), "rest holds NoneType, not dict"),
        (put("tare", [1]), "tare holds list, not dict"),
        (put("tare", {"date": "2025-03-02"}), "no field 'tare.level'"),
        (put("rest", "colour", 1), "unknown field 'rest.colour'"),
        (put("rest", "date", "today"), "rest: date is 'today', not ISO 8601"),
        (put("rest", "ratio", [0.5]), "rest.ratio has not the shape (2, 3, 4)"),
        (put("rest", "ratio", cells([2.0] * 4)), "rest: ratio at rest of cell (0, 0), reading A"),
        (put("rest", "ratio", cells([None] * 4)), "rest: ratio at rest of cell (0, 0), reading A"),
        (
            put("rest", "ratio", [[[None] * 4] * 3, [[0.5] * 4] * 3]),
            "rest: ratio at rest of cell (0, 0) is without any reading",
        ),
        (put("rest", "ratio", [[[None, 0.5, 0.5, 0.5], *[[0.5] * 4] * 2]] * 2), "rest: ratio at"),
        (put("rest", "level", None), "rest.level has not the shape (2, 3)"),
        (put("rest", "level", cells(-1e-6)), "rest: level at rest of cell (0, 0) is not finite"),
        (put("rest", "level", cells(None)), "rest.level holds NoneType, not float"),
        (put("slope", 1, 2, "1"), "slope holds str, not float"),
        (put("slope", 1, 2, True), "slope holds bool, not float"),
        (put("slope", 1, 2, 10**400), "slope holds a number that is not finite"),
        (put("slope", 1, 2, float("nan")), "slope holds a number that is not finite"),
        (put("indenter_area_m2", float("-inf")), "indenter_area_m2 holds a number that is not fin"),
        (put("slope", 1, 2, 1e61), "slope holds a number that is not finite, or beyond 1e+60"),
        (put("slope", 1, 2, -1.0), "slope of cell (1, 2) is not above 0"),
        (put("slope_std", 1, 2, -1.0), "slope_std of cell (1, 2) is not finite and >= 0"),
        (put("exponent", 1, 2, 99), "exponent of cell (1, 2) is not in 0.2..5"),
        (put("correlation", 1, 2, 2), "correlation of cell (1, 2) is not in -1..1"),
        (put("held_out_rmse", 1, 2, -1), "held_out_rmse of cell (1, 2) is negative or inf"),
        (put("kind", 1, 2, "cubic"), "kind of cell (1, 2) is neither linear nor power"),
        (put("kind", 1, 2, 1), "kind holds int, not str"),
        (put("pooled", 1, 2, 1), "pooled holds int, not bool"),
        (put("indenter_area_m2", 0), "indenter_area_m2 is 0.0, it must be above 0"),
        (put("largest_force_n", -1), "largest_force_n is -1.0, it must be above 0"),
        (put("nominal_top_wire_ohm", -1), "nominal_top_wire_ohm is -1, it must be from 0"),
        (put("nominal_bottom_wire_ohm", []), "nominal_bottom_wire_ohm holds list, not float"),
        (put("own_lead_ohm", [0.0] * 6), "own_lead_ohm has not the shape (5,)"),
        (put("own_lead_ohm", [1e50] * 5), "own_lead_ohm must be 5 numbers within"),
    ],
)
def test_edited_files_are_refused_by_field(
    tmp_path: Path, edit: Callable[[dict[str, Any]], Any], reason: str
) -> None:
    path = tmp_path / "skin.json"
    calibration().save(path)
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="^" + re.escape(f"{path}: {reason}")) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("raw", "reason"),
    [
        (b"", "no calibration file: "),
        (b"\x89PNG\r\n\x1a\n", "no calibration file: it is no text"),
        (b"[" * 100_000, "no calibration file: "),
        (b'{"unit_id": 1, "a": {"b": 1, "b": 2}}', "no calibration file: field 'b' stands twice"),
        (b'{"a": ' + b"9" * 5000 + b"}", "no calibration file: "),
        (b"[]", "no calibration: field 'format' is not 'ohmskin calibration'"),
        (b"{}", "no calibration: field 'format' is not 'ohmskin calibration'"),
        (b" " * (MAX_FILE_BYTES + 1), f"more than {MAX_FILE_BYTES} bytes"),
    ],
    ids=lambda each: None if isinstance(each, bytes) else each[:24],
)
def test_foreign_files_are_refused(tmp_path: Path, raw: bytes, reason: str) -> None:
    path = tmp_path / "foreign.json"
    path.write_bytes(raw)
    with pytest.raises(ValueError, match="^" + re.escape(f"{path}: {reason}")) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none.json", "No such file or directory"),
        (tmp_path, "Is a directory"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"{path}: cannot be read: {reason}")):
            load_calibration(path)


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "skin.json"
    calibration().save(path)
    whole = path.read_bytes().rstrip()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"skin\.json: no calibration file"):
            load_calibration(path)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "skin.json"
    calibration().save(path)
    return path


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@given(draw=st.data())
def test_whatever_a_field_holds_it_is_taken_or_refused_in_one_line(
    saved: Path, draw: st.DataObject
) -> None:
    content = json.loads(saved.read_text())
    name = draw.draw(st.sampled_from(sorted(content)))
    value = draw.draw(JSON)
    if isinstance(content[name], list) and draw.draw(st.booleans()):
        row = content[name][0]
        (row if isinstance(row, list) else content[name])[0] = value
    else:
        content[name] = value
    edited = saved.with_name("edited.json")
    edited.write_text(json.dumps(content))
    refusal = ""
    try:
        forces(load_calibration(edited), np.full((2, 3), 1e-5))
    except ValueError as error:
        refusal = str(error)
    assert not refusal or refusal.startswith(f"{edited}: ")
    assert "\n" not in refusal
