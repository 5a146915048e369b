# SPDX-License-Identifier: Apache-2.0
"""Of how much time a mean of scans is: of as much as was asked for, or of none."""

import itertools
from pathlib import Path

import pytest

import ohmskin
from recordings import write_recording
from stepped import stepped


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_a_mean_of_no_time_is_refused(seconds: float) -> None:
    """That of NaN seconds went on for ever."""
    with (
        stepped("emulator://1x1?vanish=9") as skin,
        pytest.raises(ValueError, match=rf"no mean of {seconds:g} seconds: say 0 or more"),
    ):
        skin.mean_ratio(seconds)


def test_a_mean_is_not_of_less_time_than_was_asked_for(tmp_path: Path) -> None:
    """A recording that was shorter gave that of all of it, its touches among them."""
    path, board = tmp_path / "a.mcap", stepped("emulator://1x1?rate=5")
    write_recording(path, board.info, [*itertools.islice(board, 5)])
    for seconds in (0.0, 0.5, 1.0):
        with ohmskin.open(f"replay://{path}?speed=0") as skin:
            assert skin.mean_ratio(seconds).shape == (1, 1, 4)
    with (
        ohmskin.open(f"replay://{path}?speed=0") as skin,
        pytest.raises(ValueError, match=r"no mean of 2 seconds: replay.* ends before"),
    ):
        skin.mean_ratio(2.0)
