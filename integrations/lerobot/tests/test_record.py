# SPDX-License-Identifier: Apache-2.0
"""An episode of 60 s at 30 Hz beside a skin of 90 Hz, by LeRobot's own program lerobot-record."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import calibrated
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_camera_ohmskin.robot import SCANS

URL = "emulator://8x8?scene=moving&seed=1&begin=0"
EPISODE_S, RATE_HZ = 60, 30
HERE = Path(__file__).parent


@pytest.fixture
def plugins(tmp_path: Path) -> Path:
    """A folder from which LeRobot takes a robot of one joint and what moves it, as it takes any."""
    told = tmp_path / "plugins" / "lerobot_robot_still-0.1.dist-info"
    told.mkdir(parents=True)
    (told / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_robot_still\nVersion: 0.1\n"
    )
    (told.parent / "lerobot_robot_still.py").write_text((HERE / "still.py").read_text())
    return told.parent


def test_every_scan_of_an_episode_is_in_it_once(plugins: Path, tmp_path: Path) -> None:
    """By `ohm`, which takes the least time: a busy machine then has all of its scans, too."""
    skin_json = calibrated(tmp_path / "skin.json", "--method", "ohm")
    root = tmp_path / "episode"
    words = {
        "robot.type": "ohmskin",
        "robot.robot": "{type: still}",
        "robot.skins": f"{{tip: {{port: '{URL}', calibration: {skin_json}}}}}",
        "teleop.type": "still",
        "dataset.repo_id": "local/episode",
        "dataset.root": root,
        "dataset.single_task": "hold",
        "dataset.fps": RATE_HZ,
        "dataset.episode_time_s": EPISODE_S,
        "dataset.reset_time_s": 0,
        "dataset.num_episodes": 1,
        "dataset.push_to_hub": "false",
        "dataset.no_stamp": "true",
        "play_sounds": "false",
    }
    program = Path(sys.executable).with_name("lerobot-record")
    done = subprocess.run(
        [program, *(f"--{name}={value}" for name, value in words.items())],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(plugins), "HF_HOME": str(tmp_path / "hf")},
    )
    assert done.returncode == 0, done.stderr[-4000:]
    dataset = LeRobotDataset("local/episode", root=root)
    frames = dataset.hf_dataset.with_format("numpy")
    states = np.stack(frames["observation.state"][:])
    names = dataset.meta.features["observation.state"]["names"]
    column = {name: index for index, name in enumerate(names)}
    assert np.isfinite(states).all()
    valid = states[:, column["tip.valid"]].astype(int)
    assert valid.max() <= SCANS
    numbers = states[:, [column[f"tip.number.{t}"] for t in range(SCANS)]]
    given = np.concatenate([row[:count] for row, count in zip(numbers, valid, strict=True)])
    spoilt = sum((row[count:] != -1).sum() for row, count in zip(numbers, valid, strict=True))
    assert spoilt == 0
    steps = np.diff(given)
    assert (steps > 0).all()  # in order, and none twice
    missing = int((steps - 1).sum())
    scans = f"{given.size} scans, each once, {missing} missing, {valid.max()} a frame at most"
    print(f"figure: {len(states)} frames of lerobot-record in {EPISODE_S} s: {scans}")
    # How many are missing depends on what else the machine does; that these are there does not.
    assert given.size > EPISODE_S
