# SPDX-License-Identifier: Apache-2.0
"""Files that are complete or as they were, whatever interrupts their making."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file to write beside `path`, which takes its place at the end if nothing was raised.

    Raises ValueError, which names the path, if it cannot be written.
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            with partial.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"{target}: cannot be written: {error.strerror or error}") from error


def save_whole(contents: Mapping[Path, bytes]) -> None:
    """Write all of these files, or none."""
    with ExitStack() as stack:
        for path, content in contents.items():
            file = stack.enter_context(whole_file(path))
            file.write(content)
            file.flush()
