# SPDX-License-Identifier: Apache-2.0
"""The camera, the robot and the merge, by LeRobot's own classes."""

import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import still  # noqa: F401  (registers a robot of this name)
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

import ohmskin
from lerobot_camera_ohmskin import OhmskinCameraConfig, OhmskinRobotConfig, SkinConfig
from lerobot_camera_ohmskin.merge import merge, windows
from lerobot_camera_ohmskin.robot import SCANS
from ohmskin import live
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Mark

URL = "emulator://8x8?scene=ghost&seed=1&begin=0"


FINDS = """
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.cameras.configs import CameraConfig
from lerobot.robots import RobotConfig
for kind in CameraConfig, RobotConfig:
    print(kind.get_choice_class("ohmskin").__name__)
"""


def test_lerobot_finds_it_by_its_name() -> None:
    done = subprocess.run([sys.executable, "-c", FINDS], capture_output=True, text=True)
    assert done.stdout.split() == ["OhmskinCameraConfig", "OhmskinRobotConfig"], done.stderr


def test_lerobot_makes_the_camera_by_its_type(skin_json: str) -> None:
    config = OhmskinCameraConfig(port=URL, calibration=skin_json, force_max_n=5.0)
    assert config.type == "ohmskin"
    camera = make_cameras_from_configs({"tip": config})["tip"]
    assert (camera.height, camera.width, camera.fps) == (128, 128, 30)
    camera.connect()
    image, force_n = camera.async_read(10_000), camera.skin.newest().force_n
    camera.read_latest(60_000)
    camera.disconnect()
    assert (image.dtype, image.shape) == (np.uint8, (128, 128, 3))
    red = image[8::16, 8::16, 0]
    assert red == pytest.approx(np.clip(51 * force_n, 0, 255), abs=2)
    assert set(zip(*np.nonzero(red > 5), strict=True)) == {(2, 2), (2, 5), (5, 2)}


def test_a_camera_that_is_connected_again_has_its_first_scan_at_once(skin_json: str) -> None:
    """It waited for as many scans as it had given before."""
    config = OhmskinCameraConfig(port=URL, calibration=skin_json)
    camera = make_cameras_from_configs({"tip": config})["tip"]
    camera.connect()
    while camera.skin.since(0)[0] < 50:
        camera.async_read(10_000)
    camera.disconnect()
    camera.connect(warmup=False)
    count, scans = camera.skin.since(0, 20.0)
    camera.async_read(0)  # of what is there already
    camera.disconnect()
    assert scans
    assert count < 50


def test_a_camera_is_connected_once(skin_json: str) -> None:
    """A second skin took the port from the first, whose thread nobody could end."""
    config = OhmskinCameraConfig(port=URL, calibration=skin_json)
    camera = make_cameras_from_configs({"tip": config})["tip"]
    camera.connect()
    first = camera.skin
    with pytest.raises(DeviceAlreadyConnectedError, match="call disconnect"):
        camera.connect()
    assert camera.skin is first
    camera.disconnect()


@pytest.mark.parametrize("set_by_s", [-3600, 3600])
def test_the_age_of_an_image_is_right_when_the_clock_of_the_day_is_set(
    skin_json: str, monkeypatch: pytest.MonkeyPatch, set_by_s: float
) -> None:
    config = OhmskinCameraConfig(port=f"{URL}&vanish=2", calibration=skin_json)
    camera = make_cameras_from_configs({"tip": config})["tip"]
    camera.connect()
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + round(1e9 * set_by_s))
    camera.async_read(20_000)
    camera.read_latest(10_000)
    monkeypatch.setattr(live, "AGAIN_S", 60.0)
    while camera.skin.failure is None:
        time.sleep(0.1)
    time.sleep(0.3)
    with pytest.raises(TimeoutError, match="no scan of the last 250 ms"):
        camera.read_latest(250)
    camera.disconnect()


def wrapped(skin_json: str, tmp_path: Path, url: str = URL) -> Robot:
    config = OhmskinRobotConfig(
        id="a",
        calibration_dir=tmp_path,
        robot={"type": "still", "id": "b", "calibration_dir": str(tmp_path)},
        skins={"tip": SkinConfig(url, skin_json)},
    )
    return make_robot_from_config(config)


def test_every_scan_is_in_one_frame(skin_json: str, tmp_path: Path) -> None:
    robot = wrapped(skin_json, tmp_path)
    features = hw_to_dataset_features(robot.observation_features, "observation")
    names = features["observation.state"]["names"]
    robot.connect()
    numbers, frames = [], []
    begin_s = time.monotonic()
    for frame in range(60):
        state = build_dataset_frame(features, robot.get_observation(), "observation")
        frames.append(dict(zip(names, state["observation.state"].tolist(), strict=True)))
        valid = int(frames[-1]["tip.valid"])
        numbers += [int(frames[-1][f"tip.number.{t}"]) for t in range(valid)]
        assert all(frames[-1][f"tip.number.{t}"] == -1 for t in range(valid, SCANS))
        time.sleep(max(0.0, begin_s + (frame + 1) / 30 - time.monotonic()))
    (window,) = robot.windows
    robot.disconnect()
    assert all(np.isfinite(list(each.values())).all() for each in frames)
    assert len(set(numbers)) == len(numbers)
    assert numbers == sorted(numbers)
    assert window.lost == 0
    last = next(each for each in reversed(frames) if each["tip.valid"])
    assert last["tip.force.0.2.5"] > 0.5
    assert last["joint.pos"] == 0.5


def test_a_pause_loses_no_scan(skin_json: str, tmp_path: Path) -> None:
    robot = wrapped(skin_json, tmp_path)
    robot.connect()
    (window,) = robot.windows
    while window._skin.since(window._count)[0] < window._count + 3 * SCANS:
        time.sleep(0.1)
    numbers, valid = [], SCANS
    while valid == SCANS:
        observation = robot.get_observation()
        valid = int(observation["tip.valid"])
        numbers += [observation[f"tip.number.{t}"] for t in range(valid)]
    given = {float(scan.number) for scan in window._skin.since(0)[1]}
    robot.disconnect()
    assert len(numbers) >= 3 * SCANS
    assert numbers == sorted(number for number in given if number in range_of(numbers))


def test_scans_that_are_in_no_frame_are_logged(
    skin_json: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot = wrapped(skin_json, tmp_path)
    robot.connect()
    (window,) = robot.windows
    window._skin.close()
    window._skin.skipped, window.lost = 3, 2
    with caplog.at_level("INFO"):
        robot.disconnect()
    assert f"{URL}: 3 scans skipped by a busy machine, 2 lost in pauses" in caplog.text


def range_of(numbers: list[float]) -> range:
    return range(int(numbers[0]), int(numbers[-1]) + 1)


def test_a_robot_goes_on_when_its_skin_is_plugged_20_times(
    skin_json: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.1)
    robot = wrapped(skin_json, tmp_path, f"{URL}&vanish=0.2")
    robot.connect()
    (window,) = robot.windows
    end_s = time.monotonic() + 120
    after_plug = set()
    while len(after_plug) <= 20:
        assert time.monotonic() < end_s
        if robot.get_observation()["tip.valid"]:
            after_plug.add(window._skin.opened)
        time.sleep(1 / 30)
    robot.disconnect()


def test_a_camera_goes_on_when_it_is_plugged_20_times(
    skin_json: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.1)
    config = OhmskinCameraConfig(port=f"{URL}&vanish=0.2", calibration=skin_json)
    camera = make_cameras_from_configs({"tip": config})["tip"]
    camera.connect()
    after_plug = set()
    while len(after_plug) <= 20:
        camera.async_read(20_000)
        after_plug.add(camera.skin.opened)
    camera.disconnect()


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Six seconds of a skin, with two episodes of a second, at 1 s and at 3 s."""
    path = tmp_path / "beside.mcap"
    with (
        ohmskin.open(f"{URL}&speed=0") as skin,
        Recorder(path, skin.info, lambda: skin.now_s) as recorder,
    ):
        for scan in islice(skin, 540):
            recorder.add(scan)
        for text, at_s in (("begin", 0.5), ("episode 0", 1.0), ("episode 1", 3.0)):
            recorder.add(Mark(text, at_s))
    return path


def test_windows_are_those_of_the_frames(recorded: Path, skin_json: str) -> None:
    arrays = ohmskin.load_forces(recorded, ohmskin.load_calibration(skin_json))
    episode, time_s = np.repeat([0, 1], 30), np.tile(np.arange(30) / 30, 2)
    force_n, numbers, lost = windows(arrays, episode, time_s)
    assert lost == 0
    assert force_n.shape == (60, SCANS, 8, 8)
    assert np.isfinite(force_n).all()
    for frames in (numbers[:30], numbers[30:]):
        of_episode = frames[frames >= 0]
        assert np.diff(of_episode) == pytest.approx(1)  # each once
        assert of_episode.size == pytest.approx(90, abs=1)
    known = numbers[5, 0]
    at = np.flatnonzero(arrays["number"] == known)[0]
    np.testing.assert_array_equal(force_n[5, 0], arrays["force_n"][at])
    with pytest.raises(ValueError, match="2 marks that begin with 'episode', the dataset has 3"):
        windows(arrays, np.array([0, 1, 2]), np.zeros(3))


def test_scans_that_find_no_place_are_counted(recorded: Path, skin_json: str) -> None:
    """18 scans come from one frame to the next at 5 Hz; it took the newest, and said nothing."""
    arrays = ohmskin.load_forces(recorded, ohmskin.load_calibration(skin_json))
    episode, time_s = np.repeat([0, 1], 5), np.tile(np.arange(5) / 5, 2)
    _, numbers, lost = windows(arrays, episode, time_s)
    assert (numbers >= 0).all()
    assert lost == pytest.approx(10 * (18 - SCANS), abs=2)


def test_a_recording_becomes_a_feature(recorded: Path, skin_json: str, tmp_path: Path) -> None:
    pytest.importorskip("datasets")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    state = {"dtype": "float32", "shape": (1,), "names": ["joint.pos"]}
    features = {"observation.state": state, "action": state}
    dataset = LeRobotDataset.create(
        "local", 30, features, root=tmp_path / "local", use_videos=False
    )
    for _ in range(2):
        for _ in range(30):
            row = np.zeros(1, np.float32)
            dataset.add_frame({"observation.state": row, "action": row, "task": "hold"})
        dataset.save_episode()
    dataset.finalize()
    assert merge(tmp_path / "local", recorded, skin_json, "tip", tmp_path / "touch") == 0
    merged = LeRobotDataset("touch", root=tmp_path / "touch")
    assert merged[7]["observation.tip.force"].shape == (SCANS, 8, 8)
    assert float(merged[7]["observation.tip.force"].max()) > 0.5
