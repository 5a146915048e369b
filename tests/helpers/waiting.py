# SPDX-License-Identifier: Apache-2.0
"""Waiting for what comes sooner or later, as busy as the machine may be."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")


def until(ready: Callable[[], Found], limit_s: float = 30.0) -> Found:
    """What `ready` returns once it is true."""
    end_s = time.monotonic() + limit_s
    while not (found := ready()):
        assert time.monotonic() < end_s, "it never came"
        time.sleep(0.01)
    return found
