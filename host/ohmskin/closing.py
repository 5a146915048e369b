# SPDX-License-Identifier: Apache-2.0
"""What is open until it is closed, as a context manager."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """``with`` closes it on every way out."""

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds. May be called again."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
