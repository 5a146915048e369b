# SPDX-License-Identifier: Apache-2.0
"""When scans were, since 1970: live, and from a recording, long after."""

import itertools
import json
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

import ohmskin
from calibrations import of_scene
from ohmskin.link.device import Region
from ohmskin.record.recorder import Recorder
from stepped import stepped

URL = "emulator://8x8?scene=ghost&seed=1&begin=0"
PERIOD_NS = 1e9 / 90


def test_a_scan_says_when_its_middle_was() -> None:
    """Its readings fill the period of an emulated board, whose time is stepped here."""
    before_ns = time.time_ns()
    skin = stepped(URL)
    after_ns = time.time_ns()
    for scan in itertools.islice(skin, 20):
        middle_ns = 1e9 * scan.host_time_s - PERIOD_NS / 2
        assert before_ns + middle_ns - 1e5 < scan.time_ns < after_ns + middle_ns + 1e5


def test_whole_scans_between_those_of_a_region_say_when_their_middle_was() -> None:
    """The periods differ, 100 ms and 11 ms. Host times are the board's here."""
    before_ns = time.time_ns()
    skin = stepped(URL)
    after_ns = time.time_ns()
    skin.set_region(Region([2, 3], [2, 3], "near", 10.0, whole_every=4))
    scans = list(itertools.islice(skin, 20))
    assert {scan.is_whole for scan in scans} == {False, True}
    for scan in scans:
        readings_ns = scan.codes_read.size * 1e9 * scan.slot_cycles / skin.info.clock_hz
        middle_ns = 1e3 * scan.time_us + readings_ns / 2
        assert before_ns + middle_ns - 1e5 < scan.time_ns < after_ns + middle_ns + 1e5


def test_a_replay_says_when_it_was_recorded(tmp_path: Path) -> None:
    path, skin = tmp_path / "a.mcap", stepped(URL)
    with Recorder(path, skin.info, lambda: skin.now_s) as recorder:
        recorded = list(itertools.islice(skin, 30))
        for scan in recorded:
            recorder.add(scan)
    with path.open("rb") as file:  # what the file says, read by the library of its format
        _, _, first = next(make_reader(file).iter_messages("/skin/scan"))
    epoch_ns = first.log_time - 1e9 * json.loads(first.data)["host_time_s"]
    with ohmskin.open(f"replay://{path}?speed=0", calibration=of_scene("ghost")) as replay:
        played = list(replay)
    for scan, before in zip(played, recorded, strict=True):
        middle_ns = 1e9 * before.host_time_s - PERIOD_NS / 2
        assert scan.time_ns - epoch_ns == pytest.approx(middle_ns, abs=1e5)
