# SPDX-License-Identifier: Apache-2.0
"""Whatever is saved: the file is whole, or the old one."""

import errno
import os
import time
from collections.abc import Callable
from contextvars import copy_context
from pathlib import Path

import numpy as np
import pytest

from calibrations import of_scene
from ohmskin import files
from ohmskin.calibrate.tables import PRESS, save_press_table
from ohmskin.record.readings import save_arrays


def test_where_holes_are_not_known_all_of_a_file_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counted as empty on such a file system, and a recording there as a bomb."""
    seek = os.lseek

    def knows_no_holes(file: int, at: int, how: int) -> int:
        if how != os.SEEK_SET:
            raise OSError(errno.EINVAL, "Invalid argument")
        return seek(file, at, how)

    (tmp_path / "file").write_bytes(b"data")
    monkeypatch.setattr(os, "lseek", knows_no_holes)
    with (tmp_path / "file").open("rb") as file:
        assert files.stored_bytes(file) == 4


def save_bytes(path: Path) -> None:
    with files.whole_file(path) as file:
        file.write(b"new")


SAVERS: dict[str, Callable[[Path], object]] = {
    "bytes": save_bytes,
    "calibration": lambda path: of_scene("rest").save(path),
    "presses": lambda path: save_press_table(path, np.zeros(3, PRESS)),
    "readings": lambda path: save_arrays(path, {"chi2": np.zeros(3)}),
}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("what", SAVERS)
def test_a_file_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str, error: BaseException
) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def fail(_: int) -> None:
        raise error

    monkeypatch.setattr("os.fsync", fail)
    said = {OSError: ": cannot be written: No space left on device"}.get(type(error))
    with pytest.raises(ValueError if said else type(error), match=said):
        SAVERS[what](path)
    assert [each.read_text() for each in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("what", SAVERS)
def test_links_and_permissions_are_kept(tmp_path: Path, what: str) -> None:
    (tmp_path / "far").mkdir()
    file, link = tmp_path / "far" / "file", tmp_path / "link"
    file.write_text("old")
    file.chmod(0o600)
    link.symlink_to("far/file")
    SAVERS[what](link)
    assert str(link.readlink()) == "far/file"
    assert "old" not in file.read_text(errors="replace")
    assert file.stat().st_mode & 0o777 == 0o600
    new = tmp_path / "new"
    SAVERS[what](new)
    plain = tmp_path / "plain"
    plain.touch()
    assert new.stat().st_mode == plain.stat().st_mode


def test_nothing_that_is_no_file_is_replaced(tmp_path: Path) -> None:
    """As root, a device could be."""
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: cannot be written: it is no file"):
        save_bytes(pipe)
    assert pipe.is_fifo()


def test_a_link_in_place_of_the_file_beside_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "token_hex", lambda _: "0")
    (tmp_path / ".ohmskin-0.part").symlink_to(tmp_path / "other")
    with pytest.raises(ValueError, match="file: cannot be written: File exists"):
        save_bytes(tmp_path / "file")
    assert not (tmp_path / "other").exists()


def test_what_a_killed_program_left_hinders_no_other(tmp_path: Path) -> None:
    """It goes with a later save, when nobody can be writing it any more."""
    young, old, foreign = (tmp_path / f".{name}.part" for name in ("ohmskin-1", "ohmskin-2", "x"))
    for left in (young, old, foreign):
        left.write_bytes(b"begun")
    for left in (old, foreign):
        os.utime(left, (0, time.time() - 4000))
    save_bytes(tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == b"new"
    assert {each.name for each in tmp_path.iterdir()} == {"file", young.name, foreign.name}


def test_a_partial_file_of_a_run_that_was_ended_replaces_nothing(tmp_path: Path) -> None:
    """A process elsewhere may go on with it. Those of other runs stay."""
    path, other = tmp_path / "file", tmp_path / "other"
    path.write_text("old")
    in_run = copy_context()
    in_run.run(files.RUN.set, "1a")

    def ended() -> None:
        with files.whole_file(path) as file, files.whole_file(other):
            file.write(b"new")
            files.remove_parts("1b", [path])
            assert len(list(tmp_path.glob("*.part"))) == 3
            files.remove_parts("1a", [path])

    failure = pytest.raises(ValueError, match="cannot be written: No such file")
    with files.whole_file(tmp_path / "third"), failure:
        in_run.run(ended)
    assert {each.name for each in tmp_path.iterdir()} == {"file", "third"}
    assert path.read_text() == "old"


def test_a_name_may_be_as_long_as_the_system_takes(tmp_path: Path) -> None:
    save_bytes(tmp_path / ("x" * 255))
    with pytest.raises(ValueError, match="cannot be written: File name too long"):
        save_bytes(tmp_path / ("x" * 256))


@pytest.mark.parametrize("what", SAVERS)
def test_a_place_that_is_not_there_is_named(tmp_path: Path, what: str) -> None:
    with pytest.raises(ValueError, match="no/file: cannot be written: No such file or directory"):
        SAVERS[what](tmp_path / "no" / "file")
