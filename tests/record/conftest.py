# SPDX-License-Identifier: Apache-2.0
"""A board's hello, a place for its recording, and one of regions, for several test files."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from ohmskin.link.device import Region, scans_for
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recorder import Recorder, record
from recordings import URL
from stepped import stepped


@pytest.fixture(scope="session")
def hello() -> Hello:
    return stepped(URL).info


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a recording is written."""
    return tmp_path / "a.mcap"


@pytest.fixture
def regions(path: Path) -> list[Scan]:
    """A tare in mode near, a region of one reading and of two, and whole scans in between."""
    skin = stepped("emulator://4x4?scene=single&begin=1&seed=1")
    given: list[Scan] = []

    def kept(seconds: float) -> Iterator[Scan]:
        for each in scans_for(skin, seconds):
            given.append(each)
            yield each

    with Recorder(path, skin.info, lambda: skin.now_s) as recorder:
        record(skin, recorder, kept(1.5), tare_s=0.5)
        for mode in ("quick", "half"):
            skin.set_region(Region(range(1, 4), range(3), mode=mode, whole_every=10))
            record(skin, recorder, kept(0.1))
    return given
