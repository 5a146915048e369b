# SPDX-License-Identifier: Apache-2.0
"""Files that are read within bounds and written whole or not at all; what a ``with`` closes."""

import csv
import errno
import os
import shutil
import stat
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import TextIOWrapper
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO, Final, Self

PathName = str | os.PathLike[str]
# A partial file that is so old [s] was left by a program that was killed. Chosen: an hour, which no
# file of ours takes to write.
_LEFT_S: Final = 3600.0
# The names of partial files begin so where it is set: `remove_parts` of the same run finds them.
RUN: Final = ContextVar("run", default="")


@contextmanager
def naming(what: PathName) -> Iterator[None]:
    """Put this before the text of a ValueError from inside, and keep it one line.

    what: what is wrong, such as a file or a field.
    """
    try:
        yield
    except ValueError as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{os.fspath(what)}: {reason}") from error


def read_bounded(path: PathName, most_bytes: int) -> bytes:
    """All bytes of a file. Raises ValueError if it cannot be read, or has more than these bytes."""
    try:
        with open(path, "rb") as file:
            octets = file.read(most_bytes + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    if len(octets) > most_bytes:
        raise ValueError(f"more than {most_bytes} bytes")
    return octets


def require_file(path: PathName) -> None:
    """Raise OSError if the path is a device or a pipe: readers that seek never come to its end."""
    mode = os.stat(path).st_mode
    # The system's own error, when it is opened, says that a folder is one.
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError("it is no file")


def stored_bytes(file: BinaryIO) -> int:
    """How many bytes of a file are on the disk: without holes, where the system knows of them.

    The file is left at its beginning.
    """
    stored, at, end = 0, 0, os.fstat(file.fileno()).st_size
    try:
        while hasattr(os, "SEEK_DATA") and at < end:
            begin = os.lseek(file.fileno(), at, os.SEEK_DATA)
            at = os.lseek(file.fileno(), begin, os.SEEK_HOLE)
            stored += at - begin
    except OSError as error:
        if error.errno != errno.ENXIO:  # else there is nothing but a hole from there on
            stored = end
    os.lseek(file.fileno(), 0, os.SEEK_SET)
    return stored if hasattr(os, "SEEK_DATA") else end


def check_place(path: Path, *inputs: Path | None, ending: str = "") -> None:
    """Raise ValueError if `path` is no place for a file, or is one of the inputs.

    ending: what its name must end with, where the command writes one kind of file alone. Whoever
        forgets an argument may have named a recording, which would be lost.
    """
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"{path}: cannot be written: say a file in a directory there is")
    if path.exists() and any(each and each.exists() and each.samefile(path) for each in inputs):
        raise ValueError(f"{path}: is what is read: say another file to write")
    if ending and path.suffix != ending:
        raise ValueError(f"{path}: the file to write is a {ending}: say a name that ends so")


@contextmanager
def whole_file(path: PathName) -> Iterator[BinaryIO]:
    """A new file beside `path` to write to. At the end it replaces `path`, if nothing was raised.

    It gets the permissions of the file that it replaces; if `path` is a link, its target is
    replaced. Partial files of programs that were killed are removed once they are older than
    `_LEFT_S`. Raises ValueError, naming the path, if it cannot be written, or is no file.
    """
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".ohmskin-{RUN.get()}{token_hex(8)}.part")  # a short name
    try:
        for left in target.parent.glob(".ohmskin-*.part"):
            with suppress(FileNotFoundError):  # another program has removed it
                if time.time() - left.lstat().st_mtime > _LEFT_S:
                    left.unlink()
        if target.exists() and not target.is_file():
            raise OSError("it is no file")
        try:
            with partial.open("xb") as file:
                if target.exists():
                    shutil.copymode(target, partial)
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"{target}: cannot be written: {error.strerror or error}") from error


def remove_parts(run: str, paths: Iterable[PathName]) -> None:
    """Remove the partial files that others, for whom `RUN` was this, have left beside `paths`.

    One that is still being written cannot replace its path any more: its writer raises ValueError.
    """
    for folder in {Path(os.path.realpath(path)).parent for path in paths}:
        for left in folder.glob(f".ohmskin-{run}*.part"):
            with suppress(OSError):  # its writer has removed it, or it is another user's
                left.unlink()


def save_table(path: PathName, names: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV file with these column names, as `whole_file`. Numbers are kept bit for bit."""
    with whole_file(path) as file:
        text = TextIOWrapper(file, encoding="ascii", newline="", write_through=True)
        table = csv.writer(text, lineterminator="\n")
        table.writerow(names)
        table.writerows(rows)
        text.detach()


class Closing(ABC):
    """An object that ``with`` closes, also if an error is raised inside."""

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds. May be called again."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
