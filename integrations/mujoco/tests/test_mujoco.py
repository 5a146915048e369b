# SPDX-License-Identifier: Apache-2.0
"""The pad against forces that are known without it: a weight, and the motors of a gripper."""

import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import ohmskin
from ohmskin_mujoco import Pad

HERE = Path(__file__).parents[1]
POWER = HERE.parents[1] / "examples" / "presses.csv"
TOLD = ("--wires", "100,200", "--leads", "80")
WEIGHT = """<mujoco><option timestep="0.001"/><worldbody>
<body name="plate"><geom type="box" size="0.04 0.04 0.005" pos="0 0 -0.005"/>
<site name="skin" pos="-0.035 -0.035 0"/></body>
<body pos="{x} {y} 0.0199"><freejoint/><geom type="sphere" size="0.02" mass="{kg}"/></body>
</worldbody></mujoco>"""


def calibrated(
    path: Path, presses: Path, skin: str = "emulator://8x8", told: Iterable[str] = TOLD
) -> str:
    for words in (
        ("calibrate", "table", skin, presses, path, "--indenter-mm2", "80", *told),
        ("skin", path, "--pitch-mm", "10,10"),
    ):
        subprocess.run([sys.executable, "-m", "ohmskin", *map(str, words)], check=True)
    return str(path)


@pytest.fixture(scope="module")
def skin_json(tmp_path_factory: pytest.TempPathFactory) -> str:
    """As the README makes one, by presses on a line."""
    return calibrated(tmp_path_factory.mktemp("skin") / "skin.json", HERE / "presses.csv")


@pytest.fixture(scope="module")
def power_json(tmp_path_factory: pytest.TempPathFactory) -> str:
    """By presses of the emulated skin, whose law is a power."""
    return calibrated(tmp_path_factory.mktemp("power") / "skin.json", POWER)


def resting(kg: float, x: float = 0.0, y: float = 0.0) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(WEIGHT.format(x=x, y=y, kg=kg))
    data = mujoco.MjData(model)
    for _ in range(1500):
        mujoco.mj_step(model, data)
    return model, data


def test_a_weight_lies_on_the_skin(skin_json: str) -> None:
    """m g by hand; at a place between taxels, which its centre must be."""
    model, data = resting(0.3, x=0.012, y=-0.007)
    pad = Pad(model, "skin", ohmskin.load_calibration(skin_json))
    assert pad.spread_m == pytest.approx(0.01)
    with pytest.raises(ValueError, match=r"spread_m is 0, it must be 0\.0001 or more"):
        Pad(model, "skin", ohmskin.load_calibration(skin_json), spread_m=0.0)
    true_n = pad.force_n(data)
    assert true_n.sum() == pytest.approx(0.3 * 9.81, rel=1e-3)
    column, row = (np.array([0.012, -0.007]) + 0.035) / 0.01
    assert (true_n.sum(0) @ np.arange(8)) / true_n.sum() == pytest.approx(column, abs=0.05)
    assert (true_n.sum(1) @ np.arange(8)) / true_n.sum() == pytest.approx(row, abs=0.05)
    scan = pad.read(data)
    assert scan.force_n.sum() == pytest.approx(0.3 * 9.81, rel=0.02)
    assert scan.wrench[0] == pytest.approx([0, 0, -0.3 * 9.81], rel=0.02)
    (contact,) = scan.contacts
    assert (contact.row, contact.column) == pytest.approx((row, column), abs=0.3)


def test_a_skin_of_one_cell_gets_the_whole_weight(tmp_path: Path) -> None:
    """There is no other cell whose distance says how far the pad spreads a force."""
    lines = [f"0,0,{force_n},{20e-6 * force_n}" for force_n in (1, 2, 4, 6, 8)]
    (tmp_path / "one.csv").write_text("\n".join(["row,column,force_n,conductance", *lines]))
    one = calibrated(tmp_path / "one.json", tmp_path / "one.csv", "emulator://1x1")
    model, data = resting(0.3, x=0.012, y=-0.007)
    for spread_m in (None, 0.01):
        pad = Pad(model, "skin", ohmskin.load_calibration(one), spread_m=spread_m)
        assert pad.force_n(data) == pytest.approx(np.array([[0.3 * 9.81]]), rel=1e-3)


def test_nothing_touches_it(skin_json: str) -> None:
    model, data = resting(0.3, x=0.2)  # it has fallen beside
    pad = Pad(model, "skin", skin_json)  # a path, as every other class takes it
    assert not pad.force_n(data).any()
    assert not pad.read(data).contacts


@pytest.mark.parametrize(("calibration", "share"), [("skin_json", 0.02), ("power_json", 0.04)])
def test_1_to_10_newtons_are_shown(
    calibration: str, share: float, request: pytest.FixtureRequest
) -> None:
    sys.path.insert(0, str(HERE))
    from squeeze import squeezed

    table = squeezed(request.getfixturevalue(calibration))
    _, motor_n, on_skin_n, shown_n = table.T
    assert motor_n.min() < 1.7
    assert motor_n.max() > 9.9
    assert on_skin_n == pytest.approx(motor_n, rel=0.05, abs=0.2)  # the gripper moves slowly
    rms = np.sqrt(np.mean((shown_n - on_skin_n) ** 2)) / on_skin_n.mean()
    print(f"figure: {calibration}: total force shown, rms over the mean: {100 * rms:.2f} %")
    assert rms < share


def test_one_cell_shows_too_little_with_and_without_a_clock(tmp_path: Path) -> None:
    """10 N on one cell, where nobody has told the wires; spread over a pitch, they are right."""
    sys.path.insert(0, str(HERE))
    from spread import shown

    untold = calibrated(tmp_path / "skin.json", POWER, told=())
    for spread, least_n, most_n in ((0.2, 4.0, 7.0), (1.0, 9.6, 10.4)):
        _, *sums = shown(untold, spread)
        for sum_n in sums:
            assert least_n < sum_n < most_n


def test_the_program_of_the_page_runs(
    skin_json: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    [code] = re.findall(r"^```python\n(.*?)^```", (HERE / "README.md").read_text(), re.M | re.S)
    monkeypatch.chdir(Path(skin_json).parent)
    exec(compile(code, "README.md", "exec"), {})
    true_n, shown_n = map(float, capsys.readouterr().out.split())
    assert true_n == pytest.approx(0.3 * 9.81, rel=0.02)
    assert shown_n == pytest.approx(true_n, rel=0.1)


def test_what_is_missing_is_said(skin_json: str) -> None:
    model, _ = resting(0.1)
    known = ohmskin.load_calibration(skin_json)
    with pytest.raises(ValueError, match="no site 'hand'"):
        Pad(model, "hand", known)
    with pytest.raises(ValueError, match="ohmskin skin FILE --pitch-mm"):
        Pad(model, "skin", replace(known, geometry=None))
    done = subprocess.run(
        [sys.executable, HERE / "squeeze.py", "no.json"], capture_output=True, text=True
    )
    line = "squeeze: no.json: cannot be read: No such file or directory\n"  # it was a traceback
    assert (done.returncode, done.stdout, done.stderr) == (1, "", line)
    code = f"""
import runpy, sys
sys.modules["matplotlib"], sys.argv = None, ["squeeze.py", {skin_json!r}, "a.png"]
runpy.run_path({str(HERE / "squeeze.py")!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")  # it was said after the simulation
    assert re.fullmatch("squeeze: .*matplotlib.*\n", done.stderr)
