# SPDX-License-Identifier: Apache-2.0
"""From an emulated skin to newtons by commands alone, and how near they come to the truth."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import Done, Run, assert_one_line, well
from ohmskin.arrays import Float
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.force.calibration import load_calibration
from ohmskin.link.messages import Scan
from ohmskin.record.recording import load_recording

INDENTER = ("--indenter-mm2", "80")


def by_robot(run: Run, skin: str, folder: Path) -> Path:
    """A calibration from what the scene "presses" does to the skin."""
    recording, out = folder / "presses.mcap", folder / "skin.json"
    url = f"emulator://{skin}?scene=presses&rate=45&speed=0"
    seconds = ("--seconds", str(8 + 4.6 * np.prod([int(n) for n in skin.split("x")])))
    done = well(run("record", url, str(recording), "--force-port", "truth", *seconds))
    given = load_recording(recording)
    assert f"{len(given.scans)} scans, missed 0" in done.out
    assert f", {len(given.forces)} forces\n" in done.out
    assert {sample.source for sample in given.forces} == {"truth"}
    well(run("calibrate", "recording", str(recording), str(out), *INDENTER))
    return out


def by_weights(run: Run, skin: str, folder: Path) -> Path:
    """A calibration from weights, which the scene "weights" puts where it is asked to."""
    out = folder / "skin.json"
    url = f"emulator://{skin}?scene=weights&rate=20&speed=0"
    grams = ("--grams", "50,200,400", "--repeats", "2")
    done = well(run("calibrate", "weights", url, str(out), *grams, *INDENTER))
    asked = [line for line in done.out.splitlines() if line.startswith("put ")]
    assert len(asked) == len(set(asked)) * 2 == 6 * np.prod([int(n) for n in skin.split("x")])
    assert "wrong" not in done.out
    return out


def streamed(run: Run, url: str, calibration: Path) -> tuple[Float, Float]:
    """Forces and true forces of the cells in one scan [N]."""
    done: Done = well(
        run("stream", url, "--calibration", str(calibration), "--scans", "3", "--json")
    )
    line = json.loads(done.out.splitlines()[-1])
    return np.array(line["force_n"], dtype=float), np.array(line["true_force_n"])


@pytest.mark.parametrize("calibrated", [by_robot, by_weights])
def test_forces_of_many_touches_are_those_of_the_scene(
    run: Run, tmp_path: Path, calibrated: Callable[[Run, str, Path], Path]
) -> None:
    out = calibrated(run, "3x3", tmp_path)
    for scene in ("ghost", "single"):
        url = f"emulator://3x3?scene={scene}&begin=0&speed=0"
        force_n, true_n = streamed(run, url, out)
        pressed = true_n > 0
        assert pressed.sum() == {"ghost": 3, "single": 1}[scene]
        np.testing.assert_allclose(force_n[pressed], true_n[pressed], rtol=0.1)
        assert force_n[~pressed].max() < 0.1
    done = well(run("stream", url, "--calibration", str(out), "--scans", "1"))
    assert f"truth: {true_n.max():.2f} N at (1.0, 1.0)\n" in done.out


def test_only_a_simulated_skin_has_a_truth(run: Run, tmp_path: Path) -> None:
    recording = tmp_path / "a.mcap"
    well(run("record", "emulator://2x2?speed=0", str(recording), "--scans", "5"))
    again = ("record", f"replay://{recording}?speed=0", str(tmp_path / "b.mcap"))
    assert_one_line(run(*again, "--force-port", "truth"), "only emulator:// and simavr:// know it")


@pytest.mark.parametrize("option", [("--force-unit", "g"), ("--force-scale", "2")])
def test_the_truth_has_no_unit(run: Run, tmp_path: Path, option: tuple[str, str]) -> None:
    """The options of a sensor were taken, and did nothing."""
    for command in (("record", str(tmp_path / "a.mcap")), ("calibrate", "knead", "a.json")):
        words = (*command[:-1], "emulator://2x2?scene=knead", command[-1])
        done = run(*words, "--force-port", "truth", *option)
        assert_one_line(done, "--force-port truth is in newtons")


def test_a_simulated_board_may_be_slower_than_the_host(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy machine simulates two seconds in three: what it records has the board's times."""
    every_scan = SteppedSkin.__iter__

    def late(skin: SteppedSkin) -> Iterator[Scan]:
        return (replace(scan, host_time_s=1.5 * scan.host_time_s) for scan in every_scan(skin))

    monkeypatch.setattr(SteppedSkin, "__iter__", late)
    out = by_robot(run, "2x2", tmp_path)
    assert load_calibration(out).model.held_out_rmse.max() < 0.5
