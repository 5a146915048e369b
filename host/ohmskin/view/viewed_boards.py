# SPDX-License-Identifier: Apache-2.0
"""The boards of one page."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from ohmskin.files import Closing
from ohmskin.force.calibration import Calibration
from ohmskin.view.viewed_board import ViewedBoard

MOST_BOARDS: Final = 16


class ViewedBoards(Closing):
    """The boards of one page, by number, from 0. `ViewedBoard` says what the arguments are."""

    def __init__(
        self,
        ports: Sequence[str] = (),
        calibrations: Sequence[Calibration] = (),
        folder: Path = Path(),
        *,
        force: bool = False,
    ) -> None:
        self._calibrations, self._folder, self._force = calibrations, folder, force
        self._boards: dict[int, ViewedBoard] = {}
        self._last = -1
        for port in ports:
            self.add(port)

    def add(self, port: str) -> int:
        """The number of the board at `port`, which is opened if it is new.

        :raises ValueError: there are `MOST_BOARDS` already.
        """
        for number, board in self._boards.items():
            if board.port == port:
                return number
        if len(self._boards) >= MOST_BOARDS:
            raise ValueError(f"there are {MOST_BOARDS} boards: close one first")
        self._last += 1
        folder = self._folder.resolve()
        self._boards[self._last] = ViewedBoard(port, self._calibrations, folder, force=self._force)
        return self._last

    def find(self, number: int) -> ViewedBoard | None:
        """The board of that number, if there is one."""
        return self._boards.get(number)

    def ports(self) -> dict[int, str]:
        """The port of each board, by number."""
        return {number: board.port for number, board in self._boards.items()}

    def remove(self, number: int) -> None:
        """Close a board; nothing happens if there is none of that number."""
        board = self._boards.pop(number, None)
        if board is not None:
            board.close()

    def close(self) -> None:
        """Close all. May be called again."""
        with ThreadPoolExecutor(MOST_BOARDS) as pool:  # some may have to be waited for
            list(pool.map(self.remove, tuple(self._boards)))
