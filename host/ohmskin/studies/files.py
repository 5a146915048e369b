# SPDX-License-Identifier: Apache-2.0
"""Files that are complete or as they were, whatever interrupts their making."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from ohmskin.errors import OhmskinError


def save_files(contents: Mapping[Path, bytes]) -> None:
    """Write all to temporary files beside their places, and rename these when all are written.

    :raises OhmskinError: one cannot be written.
    """
    partial = {path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in contents}
    try:
        for path, content in contents.items():
            partial[path].write_bytes(content)
        for path in contents:
            os.replace(partial[path], path)
    except OSError as error:
        raise OhmskinError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        for each in partial.values():
            each.unlink(missing_ok=True)
