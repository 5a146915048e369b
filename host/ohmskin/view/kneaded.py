# SPDX-License-Identifier: Apache-2.0
"""A skin that is kneaded, on the page: how well each cell is known, and where to press next."""

import threading
from collections.abc import Callable
from typing import Any, Final

from ohmskin.arrays import Bool, Float
from ohmskin.link.messages import Hello, Scan
from ohmskin.view.shown import Shown, of_board

# The page is told what is new so often [s]. Chosen: nobody reads faster, and scales show ten
# numbers a second.
_EVERY_S: Final = 0.2


class KneadedBoard:
    """Takes the place of a `ViewedBoard` while its board is kneaded. It takes no command.

    port: of the board.
    """

    def __init__(self, port: str, board: Hello) -> None:
        self.port, self._board = port, board
        self.shown: Shown | None = None
        self.watchers: set[Callable[[], None]] = set()
        self.closing = threading.Event()
        self._words, self._status, self._said_s = "", "scanning", float("-inf")

    def state(self) -> dict[str, Any]:
        """What the page shows besides the map, as values for JSON: all else is none."""
        return {
            "port": self.port,
            "status": self._status,
            "note": self._words,
            "board": of_board(self._board),
            "kneaded": True,
        }

    def show(
        self, scan: Scan, log_std: Float, known: Bool, next_cell: tuple[int, int], words: str
    ) -> None:
        """Show what is known after a scan, and say it in words.

        log_std, known: how well each cell is known, and whether that is enough, (R, C).
        next_cell: the one to press next.
        """
        if scan.host_time_s - self._said_s < _EVERY_S:
            return
        self._said_s, self._words = scan.host_time_s, words
        contacts = [["next", *next_cell, None, None]]
        planes: dict[str, Float | Bool] = {"log_std": log_std, "touched": known}
        self.shown = Shown.of(scan, {"contacts": contacts}, planes)
        self._tell()

    def end(self, words: str) -> None:
        """Say that it has ended."""
        self._words, self._status = words, "ended"
        self._tell()

    def close(self) -> None:
        """The page shows it no longer."""
        self.closing.set()
        self._tell()

    def _tell(self) -> None:
        for wake in tuple(self.watchers):
            wake()
