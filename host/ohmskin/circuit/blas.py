# SPDX-License-Identifier: Apache-2.0
"""One BLAS thread while a circuit is solved: for matrices of a skin's size, more are slower."""

import threading
from contextlib import ContextDecorator
from typing import Any

from threadpoolctl import ThreadpoolController


class _OneBlasThread(ContextDecorator):
    """A context manager, or decorator, that any number of threads may be in at once.

    The limit is the process's: the first thread that comes in sets it, and the last one that leaves
    restores what was there before.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._libraries: list[Any] | None = None
        self._before: list[tuple[Any, int]] = []

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                if self._libraries is None:
                    # Looking through all loaded libraries takes milliseconds: so only once.
                    found = ThreadpoolController().lib_controllers
                    self._libraries = [library for library in found if library.user_api == "blas"]
                numbers = ((library, library.num_threads) for library in self._libraries)
                self._before = [(library, number) for library, number in numbers if number != 1]
                _set_threads([(library, 1) for library, _ in self._before])
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                _set_threads(self._before)


def _set_threads(numbers: list[tuple[Any, int]]) -> None:
    for library, number in numbers:
        library.set_num_threads(number)
        # Since 3.8 threadpoolctl lets one thread alone set limits, until that gives the right back.
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread()


one_blas_thread = _OneBlasThread()
