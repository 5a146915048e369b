# SPDX-License-Identifier: Apache-2.0
"""Where cells are, against positions and sums that are written by hand."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from ohmskin.arrays import Float
from ohmskin.force.calibration import load_calibration
from ohmskin.force.geometry import KINDS, Geometry
from ohmskin.force.reader import SkinReader
from stepped import stepped

FLAT = {"kind": "flat", "frame_id": "skin", "pitch_m": [0.01, 0.02]}
CYLINDER = {"kind": "cylinder", "frame_id": "arm", "pitch_m": [0.01, 0.02], "radius_m": 0.04}


def saved(path: Path, geometry: object) -> Path:
    of_scene("ghost").save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"geometry": geometry}))
    return path


def geometry(path: Path, content: dict[str, Any]) -> Geometry:
    known = load_calibration(saved(path, content)).geometry
    assert known is not None
    return known


def test_a_flat_skin(tmp_path: Path) -> None:
    known = geometry(tmp_path / "skin.json", FLAT)
    assert known.position_m[3, 5] == pytest.approx([0.05, 0.06, 0])
    assert known.normal[3, 5] == pytest.approx([0, 0, 1])


def test_a_cylinder_s_columns_go_round_y(tmp_path: Path) -> None:
    known = geometry(tmp_path / "skin.json", CYLINDER)
    angle = 0.05 / 0.04
    expected = [0.04 * np.sin(angle), 0.06, 0.04 * np.cos(angle)]
    assert known.position_m[3, 5] == pytest.approx(expected)
    assert known.normal[3, 5] == pytest.approx([np.sin(angle), 0, np.cos(angle)])


def test_columns_may_go_round_once(tmp_path: Path) -> None:
    """A sleeve is closed: the first column follows the last, a pitch away or nearly so."""
    known = geometry(tmp_path / "skin.json", {**CYLINDER, "radius_m": 0.0127})
    assert np.linalg.norm(known.position_m[0, 7] - known.position_m[0, 0]) > 0.009


def test_it_is_kept(tmp_path: Path) -> None:
    table = {
        "kind": "table",
        "frame_id": "pad",
        "position_m": np.random.default_rng(1).uniform(-1, 1, (8, 8, 3)).tolist(),
        "normal": np.random.default_rng(2).uniform(0.1, 1, (8, 8, 3)).tolist(),
    }
    for content in (FLAT, CYLINDER, table):
        path = saved(tmp_path / "a.json", content)
        load_calibration(path).save(tmp_path / "b.json")
        assert json.loads((tmp_path / "b.json").read_text())["geometry"] == content
        assert load_calibration(tmp_path / "b.json").geometry.frame_id == content["frame_id"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({**FLAT, "kind": "round"}, "kind is 'round'"),
        ({**FLAT, "radius_m": 1}, "unknown field 'geometry.radius_m'"),
        ({**FLAT, "pitch_m": [0.01]}, "pitch_m has not the shape"),
        ({**FLAT, "pitch_m": [0.01, "x"]}, "pitch_m holds str"),
        ({**FLAT, "pitch_m": [0.01, 1e9]}, "beyond 100: is it in metres"),
        ({**FLAT, "pitch_m": [10, 10]}, "cells lie 70 m apart: are these millimetres"),
        ({**FLAT, "pitch_m": [0.01, 0]}, "pitch_m holds 0: cells are 0.0001 or more apart"),
        ({**FLAT, "frame_id": "a\x1b[2J"}, "frame_id must be a name"),
        ({**CYLINDER, "radius_m": 0}, "radius_m is 0, it must be 0.0001 or more"),
        ({**CYLINDER, "radius_m": 5e-324}, "it must be 0.0001 or more"),
        ({**CYLINDER, "radius_m": 0.011}, "8 columns of 0.01 m go round more than once"),
        ({**FLAT, "kind": "table"}, "no field 'geometry.normal'"),
        ([], "geometry holds list"),
    ],
)
def test_what_no_skin_has_is_refused(tmp_path: Path, content: object, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        load_calibration(saved(tmp_path / "skin.json", content))


def test_contacts_and_scans_have_places_and_sums(tmp_path: Path) -> None:
    """Three touches of the scene ghost, at (2, 2), (2, 5) and (5, 2)."""
    known = geometry(tmp_path / "skin.json", CYLINDER)
    url = "emulator://8x8?scene=ghost&seed=1&begin=0&speed=0"
    with ohmskin.open(url, calibration=replace(of_scene("ghost"), geometry=known)) as skin:
        scan = next(iter(skin))
    assert [(contact.row, contact.column) for contact in scan.contacts] == [(2, 2), (2, 5), (5, 2)]
    for contact in scan.contacts:
        cell = int(contact.row), int(contact.column)
        assert contact.position_m == pytest.approx(known.position_m[cell])
        assert contact.normal == pytest.approx(known.normal[cell])
    force_n, torque_nm = scan.wrench
    at = [(2, 2), (2, 5), (5, 2)]
    pushes = [
        (f, known.position_m[c], known.normal[c])
        for c, f in np.ndenumerate(scan.force_n)
        if any(abs(c[0] - row) <= 1 and abs(c[1] - column) <= 1 for row, column in at)
    ]
    assert force_n == pytest.approx(sum(-f * n for f, _, n in pushes))
    assert torque_nm == pytest.approx(sum(np.cross(p, -f * n) for f, p, n in pushes))
    assert force_n[2] < -1


def test_the_noise_of_untouched_cells_is_no_net_force(tmp_path: Path) -> None:
    """No force of a cell is below 0: the sum of all is above 0 on a skin that nothing touches."""
    placed = replace(of_scene("rest"), geometry=geometry(tmp_path / "skin.json", FLAT))
    with ohmskin.open("emulator://8x8?scene=rest&seed=1&speed=0", calibration=placed) as skin:
        scan = next(iter(skin))
    noisy = replace(scan, force_n=np.full((8, 8), 0.005))
    assert noisy.touch_force_n.sum() == 0.0
    assert np.abs(noisy.wrench).max() == 0.0


def test_a_net_force_has_the_weak_edge_of_a_touch(tmp_path: Path) -> None:
    """Of 1 N that lies on some twenty cells, those that count as touched have 0.85 N."""
    placed = replace(of_scene("rest"), geometry=geometry(tmp_path / "skin.json", FLAT))
    row, column = np.indices((8, 8))
    share = np.exp(-((row - 3.3) ** 2 + (column - 3.7) ** 2) / 2)
    scan = ohmskin.SimulatedSkin(placed).step(share / share.sum(), 0.0)
    assert sum(contact.force_n for contact in scan.contacts) < 0.9
    assert scan.touch_force_n.sum() == pytest.approx(1, abs=0.03)
    assert scan.wrench[0] == pytest.approx([0, 0, -1], abs=0.03)


def test_a_wrench_of_many_scans_is_that_of_each() -> None:
    """They were summed over scans and rows."""
    table = np.random.default_rng(0).uniform(-1, 1, (2, 2, 3, 3))
    placed = Geometry("table", "f", 2, 3, dict(zip(KINDS["table"], table, strict=True)))
    force_n = np.arange(24.0).reshape(4, 2, 3)
    force_n[0, 0, 0], force_n[1] = np.nan, np.nan
    together, ones = placed.wrench(force_n), np.ones((2, 3))
    for number in range(4):
        net_n, torque_nm = np.zeros(3), np.zeros(3)
        for cell in np.ndindex(2, 3):
            if number == 1 or np.isfinite(force_n[number][cell]):
                on_cell = -force_n[number][cell] * placed.normal[cell]
                net_n += on_cell
                torque_nm += np.cross(placed.position_m[cell], on_cell)
        for found in (placed.wrench(force_n[number]), [each[number] for each in together]):
            np.testing.assert_allclose(found, [net_n, torque_nm])
    np.testing.assert_array_equal(placed.wrench(np.ones((2, 3)).tolist()), placed.wrench(ones))
    for wrong in ((3, 2), (1, 3), (3,), (4, 2)):
        with pytest.raises(ValueError, match="force_n has shape"):
            placed.wrench(np.ones(wrong))


@pytest.mark.parametrize(
    ("kind", "told", "reason"),
    [
        ("sphere", {}, "no kind 'sphere': there are flat, cylinder, table"),
        ("flat", {}, "kind 'flat' has pitch_m, not $"),
        ("flat", {"pitch_m": np.ones(2), "radius_m": np.ones(())}, "not pitch_m, radius_m"),
        ("flat", {"pitch_m": np.ones(3)}, r"pitch_m has not the shape \(2,\)"),
        ("table", dict.fromkeys(KINDS["table"], np.ones((2, 3, 3))), r"not the shape \(4, 4, 3\)"),
    ],
)
def test_a_geometry_that_no_file_may_have_is_refused(
    kind: str, told: dict[str, Float], reason: str
) -> None:
    """A calibration was saved over a good one, and could not be loaded any more."""
    with pytest.raises(ValueError, match=reason):
        Geometry(kind, "f", 4, 4, told)


def test_without_forces_a_wrench_says_so(tmp_path: Path) -> None:
    """It said that nobody had told where the cells are, though the calibration has it."""
    placed = replace(of_scene("rest"), geometry=geometry(tmp_path / "skin.json", FLAT))
    bench = stepped("emulator://8x8")
    reader = SkinReader(bench.info, placed, method="matrix")
    scan = reader.read(next(iter(bench)))
    with pytest.raises(ValueError, match="no forces: read scans with a calibration, and by its"):
        _ = scan.wrench


def test_without_geometry_a_wrench_says_what_to_do() -> None:
    with ohmskin.open("emulator://8x8?speed=0", calibration=of_scene("rest")) as skin:
        scan = next(iter(skin))
    assert scan.geometry is None
    with pytest.raises(ValueError, match="ohmskin skin FILE --pitch-mm"):
        _ = scan.wrench


def test_icub_s_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "palm.txt"
    path.write_text("[calibration]\n" + "\n".join(f"0.0{k} 0.5 -1e-2 0 0 2" for k in range(4)))
    known = Geometry.of_file(path, 2, 2, "palm")
    assert known.position_m[1, 0] == pytest.approx([0.02, 0.5, -0.01])
    assert known.normal[1, 0] == pytest.approx([0, 0, 1])
    with pytest.raises(ValueError, match=r"palm.txt: 4 taxels, the skin has 2x3 cells"):
        Geometry.of_file(path, 2, 3, "palm")


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ('<array rows="12" cols="12" size="1 1"/>', "an <array> of 12x12 taxels, the skin has 2x3"),
        ('<array size="1 1" order="col-major"/>', "order='col-major' of its <array>: only row-maj"),
        ('<array rows="2" cols="3" size="1 1" offset="1"/>', "offset='1' is not 2 numbers"),
        ('<array rows="2" cols="3"/>', "size='' is not 2 numbers"),
        ('<array size="1 1"/><array size="2 2"/>', "2 <array>s: leave only this skin's"),
        ('<array size="0 0"/>', r"6 cells are at one place, \[0.0, 0.0, 0.0\] m"),
        ('<array size="1 x"/>', "size='1 x' is not 2 numbers"),
    ],
)
def test_an_array_that_is_not_this_skin_s_is_refused(
    tmp_path: Path, arrays: str, reason: str
) -> None:
    """Cells were put where the file had none."""
    path = tmp_path / "robot.urdf"
    path.write_text(f"<robot>{arrays}</robot>")
    with pytest.raises(ValueError, match=reason):
        Geometry.of_file(path, 2, 3, "skin")


def test_urdf_is_read(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    taxels = (
        '<taxel idx="1" xyz="1 0 0" rpy="0 1.5707963 0"/><taxel idx="0" xyz="2 0 0" rpy="0 0 3"/>'
    )
    path.write_text(f"<robot><sensor><tactile><!-- two -->{taxels}</tactile></sensor></robot>")
    known = Geometry.of_file(path, 1, 2, "tip")
    assert known.position_m[0] == pytest.approx(np.array([[2, 0, 0], [1, 0, 0]]))
    assert known.normal[0] == pytest.approx(np.array([[0, 0, 1], [1, 0, 0]]), abs=1e-6)


def test_a_urdf_array_has_x_along_rows(tmp_path: Path) -> None:
    """It was read transposed. By urdf_tactile: x = row * spacing.x - offset.x, y of columns."""
    path = tmp_path / "robot.urdf"
    path.write_text('<robot><array rows="2" cols="3" size="0.005 0.006"/></robot>')
    known = Geometry.of_file(path, 2, 3, "tip")
    assert known.position_m[1, 2] == pytest.approx([0.005, 0.012, 0])
    assert known.normal[1, 2] == pytest.approx([0, 0, 1])
    grid = '<array rows="2" cols="3" size="9 9" spacing="0.02 0.03" offset="0.001 -0.002"/>'
    path.write_text(f"<robot><sensor><tactile>{grid}</tactile></sensor></robot>")
    known = Geometry.of_file(path, 2, 3, "tip")
    assert known.position_m[0, 0] == pytest.approx([-0.001, 0.002, 0])
    assert known.position_m[1, 2] == pytest.approx([0.019, 0.062, 0])


@pytest.mark.parametrize("taxels", ['<taxel/><taxel xyz="1 0 0"/>', '<array size="1 1"/>'])
def test_taxels_of_two_sensors_are_refused(tmp_path: Path, taxels: str) -> None:
    """They were taken for those of one skin, in turn."""
    path = tmp_path / "robot.urdf"
    sensor = f"<sensor><tactile>{taxels}</tactile></sensor>"
    path.write_text(f"<robot><sensor><camera/></sensor>{sensor}{sensor}</robot>")
    with pytest.raises(ValueError, match="2 sensors with taxels: leave only this skin's"):
        Geometry.of_file(path, 2, 2, "skin")
    path.write_text(f"<robot><sensor><camera/></sensor>{sensor}</robot>")
    assert Geometry.of_file(path, 1, 2, "skin").kind == "table"


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ("0 0 0 0 0 1\n10 0 0 0 0 1", "cells lie 10 m apart: are these millimetres"),
        ("0 .5 0 0 0 1\n0 0.5 0 1 0 0", r"2 cells are at one place, \[0.0, 0.5, 0.0\] m"),
    ],
)
def test_taxels_of_no_skin_are_refused(tmp_path: Path, lines: str, reason: str) -> None:
    """Places in millimetres, and all taxels in one place, were taken."""
    (path := tmp_path / "taxels.txt").write_text(lines)
    with pytest.raises(ValueError, match=reason):
        Geometry.of_file(path, 1, 2, "skin")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<robot", "no XML"),
        ('<robot><array rows="1" cols="1" size="1 1"/><taxel/></robot>', "leave only one kind"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot>&a;</robot>', "declares types or entities"),
        ('<robot><taxel xyz="1 2"/></robot>', "is not 3 numbers"),
        ('<robot><taxel rpy="0 inf 0"/></robot>', "is not 3 numbers"),
        ("nothing", "0 taxels"),
        pytest.param("1" * 500 + "x", "0 taxels", id="a long number"),
        ("1 2 3 4 5 6e", "'1 2 3 4 5 6e' is not 6 numbers"),
        ("1 2 3 E.. 5 1e999", "'1 2 3 E.. 5 1e999' is not 6 numbers"),
        ('<robot><taxel idx="a0"/></robot>', "idx='a0' is no whole number"),
        ('<robot><taxel idx="-1"/></robot>', "idx='-1' is no whole number"),
        ('<robot><taxel idx="1"/><taxel idx="01"/></robot>', "two taxels have idx='1'"),
    ],
)
def test_files_of_taxels_that_say_none(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "taxels"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        Geometry.of_file(path, 1, 1, "skin")
