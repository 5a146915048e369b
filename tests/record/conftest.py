# SPDX-License-Identifier: Apache-2.0
"""A board's hello and a place for its recording, for several test files."""

from pathlib import Path

import pytest

from ohmskin.link.messages import Hello
from recordings import URL
from stepped import stepped


@pytest.fixture(scope="session")
def hello() -> Hello:
    return stepped(URL).info


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a recording is written."""
    return tmp_path / "a.mcap"
