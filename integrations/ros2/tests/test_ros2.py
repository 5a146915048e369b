# SPDX-License-Identifier: Apache-2.0
"""The node in a process of its own, by a subscriber of rclpy; and the package, by colcon."""

import ast
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.client import Client
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

# Programs are ended as by a keyboard. Where this process was started with SIGINT ignored, as in the
# background of a shell, they would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

HERE = Path(__file__).parents[1]
URL = "emulator://8x8?scene=ghost&seed=1"
TOUCHED = f"{URL}&begin=0"
TOLD = ("--wires", "100,200", "--leads", "80")
WATCHED_S = 60.0  # scans that are lost are counted for so long
ENOUGH_S = 60.0  # a test waits so long for what comes at once, unless it never comes


@pytest.fixture(scope="module")
def skin_json(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("skin") / "skin.json"
    presses = HERE.parents[1] / "examples" / "presses.csv"
    for words in (
        ("calibrate", "table", "emulator://8x8", presses, path, "--indenter-mm2", "80", *TOLD),
        ("skin", path, "--pitch-mm", "10,20", "--frame", "palm"),
    ):
        subprocess.run([sys.executable, "-m", "ohmskin", *map(str, words)], check=True)
    return path


@pytest.fixture
def node(skin_json: Path) -> Iterator[Callable[[str], subprocess.Popen]]:
    started = []

    def start(url: str, name: str = "ohmskin") -> subprocess.Popen:
        parameters = ("-p", f"calibration:={skin_json}", "-p", f"port:='{url}'")
        remaps = ("-r", f"__node:={name}")
        command = [sys.executable, "-m", "ohmskin_ros.node", "--ros-args", *parameters, *remaps]
        started.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
        assert (process.returncode, "Traceback" in said) == (0, False), said


@pytest.fixture
def reader() -> Iterator[Node]:
    rclpy.init()
    yield (node := rclpy.create_node("reader"))
    node.destroy_node()
    rclpy.try_shutdown()


def until(reader: Node, ready: Callable[[], bool], limit_s: float = ENOUGH_S) -> None:
    end_s = time.monotonic() + limit_s
    while not ready():
        assert time.monotonic() < end_s
        rclpy.spin_once(reader, timeout_sec=0.1)


def asked(reader: Node, client: Client) -> Trigger.Response:
    answer = client.call_async(Trigger.Request())
    until(reader, answer.done)
    return answer.result()


def stamp_ns(message: PointCloud2 | Image) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_clouds_and_images_come(node: Callable, reader: Node) -> None:
    clouds, images, late_ms = [], [], []

    def take(cloud: PointCloud2) -> None:
        clouds.append(cloud)
        late_ms.append(1e-6 * (time.time_ns() - stamp_ns(cloud)) - 1e3 * 0.5 / 90)

    reader.create_subscription(PointCloud2, "/ohmskin/points", take, qos_profile_sensor_data)
    reader.create_subscription(Image, "/ohmskin/image", images.append, 100)  # reliable, as RViz
    node(TOUCHED)
    until(reader, lambda: len(clouds) >= 300 and len(images) >= 300)
    end_s = time.monotonic() + WATCHED_S
    until(reader, lambda: time.monotonic() > end_s, 2 * WATCHED_S)
    print(f"figure: last byte to subscriber, median: {np.median(late_ms[100:]):.1f} ms")
    cloud, picture = clouds[-1], {stamp_ns(i): i for i in images}.get(stamp_ns(clouds[-1]))
    assert cloud.header.frame_id == "palm"
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (8, 8, 32, 256)
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "force", "force_std")
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        (name, 4 * index, 7) for index, name in enumerate(names)
    ]
    cells = np.frombuffer(bytes(cloud.data), "<f4").reshape(8, 8, 8)
    assert cells[3, 5, :6] == pytest.approx([0.05, 0.06, 0, 0, 0, 1])
    touched = {tuple(cell) for cell in np.argwhere(cells[..., 6] > 0.1)}
    assert touched == {(2, 2), (2, 5), (5, 2)}
    if picture is not None:
        assert (picture.encoding, picture.step) == ("32FC1", 32)
        np.testing.assert_array_equal(
            np.frombuffer(bytes(picture.data), "<f4").reshape(8, 8), cells[..., 6]
        )
    # In order, and none twice. (A machine that is too busy for 90 estimates a second skips scans.)
    periods = np.diff([stamp_ns(cloud) for cloud in clouds]) / (1e9 / 90)
    assert (periods > 0.5).all()
    lost = int(np.sum(np.round(periods) - 1))
    print(f"figure: scans lost before a subscriber, of {periods.size + lost}: {lost}")


def test_a_tare_is_a_service(node: Callable, reader: Node) -> None:
    client = reader.create_client(Trigger, "/ohmskin/tare")
    node(TOUCHED)
    assert client.wait_for_service(ENOUGH_S)

    said = asked(reader, client)
    while "being opened" in said.message:
        said = asked(reader, client)
    assert not said.success
    assert "cells (2, 2), (2, 5), (5, 2) are touched" in said.message


def test_it_goes_on_when_the_board_is_plugged_20_times(node: Callable, reader: Node) -> None:
    """It vanishes half a second after it was opened, and is opened again a second later."""
    stamps, states = [], []
    reader.create_subscription(
        PointCloud2, "/ohmskin/points", lambda cloud: stamps.append(stamp_ns(cloud)), 100
    )
    reader.create_subscription(
        DiagnosticArray, "/diagnostics", lambda each: states.append(each.status[0]), 10
    )
    node(f"{TOUCHED}&vanish=0.5")
    until(reader, lambda: np.sum(np.diff(stamps) > 0.5e9) >= 20, 4 * ENOUGH_S)
    assert (np.diff(stamps) > 0).all()
    assert {b"\x00", b"\x02"} <= {state.level for state in states}
    assert any("is gone" in state.message for state in states)
    opened = {value.key: value.value for value in states[-1].values}["times the port was opened"]
    assert int(opened) >= 20


def test_the_doctor_says_what_is_wrong(node: Callable, reader: Node) -> None:
    """A row that is torn off, by the service, and in the diagnostics after it."""
    client, states = reader.create_client(Trigger, "/tip/examine"), []
    reader.create_subscription(
        DiagnosticArray, "/diagnostics", lambda each: states.append(each.status), 10
    )
    node("emulator://8x8?scene=rest&seed=1&open_row=3", "tip")
    assert client.wait_for_service(ENOUGH_S)
    said, before = asked(reader, client), 0
    while "being opened" in said.message:
        before = len(states)
        said = asked(reader, client)
    assert len(states) >= before + 3  # diagnostics go on meanwhile
    assert not said.success
    assert "not sound: 1 finding, first open row (row 3)" in said.message
    until(reader, lambda: len(states) > 0 and len(states[-1]) == 2)
    doctor = states[-1][1]
    assert (states[-1][0].name, doctor.name) == ("tip", "tip: doctor")  # of several nodes
    assert doctor.message == said.message
    assert doctor.values[0].key == "open_row: row 3"
    before = int(states[-1][0].values[0].value)  # scans
    until(reader, lambda: int(states[-1][0].values[0].value) > before + 90)  # it goes on


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ("calibration:=no.json", "no.json: cannot be read"),
        ("every:=maybe", "'every' to 'maybe' of type 'STRING', expecting type 'BOOL'"),
    ],
)
def test_what_is_wrong_with_a_parameter_is_said(told: str, said: str) -> None:
    """A parameter of another type ended the node by a traceback."""
    command = [sys.executable, "-m", "ohmskin_ros.node", "--ros-args", "-p", told]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def built(tmp_path: Path) -> Path:
    """Where colcon has installed the package."""
    here = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    colcon = [shutil.which("colcon", path=here), "build", "--base-paths", str(HERE)]
    places = ("--build-base", tmp_path / "build", "--install-base", tmp_path / "install")
    done = subprocess.run(
        [*colcon, *map(str, places)], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    return tmp_path / "install" / "ohmskin_ros"


def test_colcon_builds_it(tmp_path: Path) -> None:
    installed = built(tmp_path)
    assert (installed / "share/ament_index/resource_index/packages/ohmskin_ros").exists()
    assert (installed / "share/ohmskin_ros/launch/skin.launch.py").exists()
    assert (installed / "lib/ohmskin_ros/skin").exists()


def test_the_launch_file_is_python() -> None:
    tree = ast.parse((HERE / "launch/skin.launch.py").read_text())
    assert "generate_launch_description" in {
        node.name for node in tree.body if isinstance(node, ast.FunctionDef)
    }


if find_spec("launch_ros"):  # PyPI does not have it: where ROS is sourced

    def test_the_launch_file_starts_a_node(skin_json: Path, tmp_path: Path, reader: Node) -> None:
        """As `ros2 launch` does it, from what colcon has built; Ctrl-C ends it.

        A frame_id that looks like a number is text all the same.
        """
        installed = built(tmp_path)
        told = {"port": TOUCHED, "calibration": str(skin_json), "frame_id": "42", "name": "tip"}
        program = f"""
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
source = AnyLaunchDescriptionSource("{installed}/share/ohmskin_ros/launch/skin.launch.py")
include = IncludeLaunchDescription(source, launch_arguments={list(told.items())})
service = LaunchService()
service.include_launch_description(LaunchDescription([include]))
raise SystemExit(service.run())
"""
        sourced = {
            "AMENT_PREFIX_PATH": installed,
            "PYTHONPATH": next(installed.glob("lib/python*/site-packages")),
        }
        process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env=os.environ
            | {name: f"{path}:{os.environ.get(name, '')}" for name, path in sourced.items()},
        )
        clouds: list[PointCloud2] = []
        states: list[str] = []
        reader.create_subscription(PointCloud2, "/tip/points", clouds.append, 100)
        reader.create_subscription(
            DiagnosticArray, "/diagnostics", lambda each: states.append(each.status[0].message), 10
        )
        try:  # the terminal is told before the diagnostics
            until(reader, lambda: len(clouds) >= 10 and "scanning" in states)
        finally:
            os.killpg(process.pid, signal.SIGINT)
            printed, _ = process.communicate(timeout=30)
        assert process.returncode == 0, printed
        assert clouds[-1].header.frame_id == "42"
        assert "[tip]: " + TOUCHED + " gives scans" in printed
        assert "process has finished cleanly" in printed


def test_the_terminal_says_what_is_wrong(skin_json: Path) -> None:
    """A board that goes away, and two ports that are wrong: each in a line, once."""
    for port, said in (
        (f"{TOUCHED}&vanish=5", "is gone: is the board still plugged in?"),
        ("/dev/ttyNone", "no port /dev/ttyNone: 'ohmskin ports' lists the ports there are"),
        ("emulator://6x6", "this calibration is of a 8x8 skin, the board scans 6x6"),
    ):
        parameters = ("-p", f"calibration:={skin_json}", "-p", f"port:='{port}'")
        command = [sys.executable, "-m", "ohmskin_ros.node", "--ros-args", *parameters]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        printed = ""
        while said not in printed and (line := process.stderr.readline()):
            printed += line
        time.sleep(2)  # it is tried again meanwhile
        process.send_signal(signal.SIGINT)
        printed += process.communicate(timeout=30)[1]
        assert printed.count(said) == 1, printed
        assert "Traceback" not in printed


def diagnosis_of(
    skin_json: Path, text: str, meanwhile: Callable[[], object] = lambda: None
) -> DiagnosticStatus:
    """The first diagnosis with this text, of a node in this process. meanwhile: once it scans."""
    from ohmskin_ros.node import SkinNode

    told = ["--ros-args", "-p", f"calibration:={skin_json}", "-p", f"port:='{TOUCHED}'"]
    states: list[DiagnosticStatus] = []
    rclpy.init(args=told)
    skin_node, watcher = SkinNode(), rclpy.create_node("watcher")
    watcher.create_subscription(
        DiagnosticArray, "/diagnostics", lambda each: states.append(each.status[0]), 10
    )
    end_s = time.monotonic() + ENOUGH_S
    try:
        while not any(text in each.message for each in states):
            assert time.monotonic() < end_s, [each.message for each in states]
            rclpy.spin_once(skin_node, timeout_sec=0.1)
            rclpy.spin_once(watcher, timeout_sec=0.1)
            if states and skin_node.skin.newest() is not None:
                meanwhile()
    finally:
        skin_node.close()
        watcher.destroy_node()
        rclpy.try_shutdown()
    return next(each for each in states if text in each.message)


def test_scans_that_are_skipped_are_a_warning(
    skin_json: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, where an estimate takes as long as on a machine that is too slow."""
    from ohmskin.force.reader import SkinReader

    read = SkinReader.read

    def slow(self: SkinReader, scan: object) -> object:
        time.sleep(0.05)
        return read(self, scan)

    monkeypatch.setattr(SkinReader, "read", slow)
    warned = diagnosis_of(skin_json, "were skipped: this machine is too slow")
    assert warned.level == DiagnosticStatus.WARN


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_node_that_publishes_no_more_is_an_error(
    skin_json: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It said OK, because scans came: the thread that had ended is the one that publishes them."""
    from ohmskin_ros import node

    monkeypatch.setattr(node, "image", lambda scan, head: 1 / 0)
    wrong = diagnosis_of(skin_json, "nothing is published any more")
    assert wrong.level == DiagnosticStatus.ERROR


@pytest.mark.parametrize("set_by_s", [-3600, 3600])
def test_stamps_that_are_off_are_a_warning(
    skin_json: Path, monkeypatch: pytest.MonkeyPatch, set_by_s: int
) -> None:
    """The clock of the day is set while the node runs."""
    now_ns = time.time_ns

    def set_clock() -> None:
        monkeypatch.setattr(time, "time_ns", lambda: now_ns() + set_by_s * 10**9)

    warned = diagnosis_of(skin_json, "clock of this machine are 3600.0 s apart", set_clock)
    assert warned.level == DiagnosticStatus.WARN


def test_the_example_listens(node: Callable) -> None:
    node(TOUCHED)
    command = [sys.executable, str(HERE / "listen.py")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert "Traceback" not in said
    found = re.fullmatch(r"([\d.]+) N in all, most of it on cell \((\d), (\d)\)\n", line)
    assert 2 < float(found[1]) < 4
    assert (int(found[2]), int(found[3])) in {(2, 2), (2, 5), (5, 2)}
