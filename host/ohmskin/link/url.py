# SPDX-License-Identifier: Apache-2.0
"""The URL of a port, taken apart: ``emulator://8x8?scene=ghost&seed=1``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self, TypeVar
from urllib.parse import parse_qsl

from ohmskin.errors import PortError
from ohmskin.link.protocol import CONSTANTS

_Number = TypeVar("_Number", int, float)


@dataclass(frozen=True)
class PortUrl:
    """The parts of a port's URL.

    text: all of it, as it was given.
    scheme: what kind of port it is, "emulator"; "" for a serial port, which has a plain name.
    place: which port of this kind, "8x8".
    options: the texts after the "?", by their names.
    """

    text: str
    scheme: str
    place: str
    options: dict[str, str]

    @classmethod
    def of(cls, text: str) -> Self:
        """The parts of this text. A text of any form has them: who uses them checks them."""
        scheme, separator, behind = text.partition("://")
        place, _, query = (behind if separator else text).partition("?")
        options = dict(parse_qsl(query, keep_blank_values=True))
        return cls(text, scheme if separator else "", place, options)

    def check_options(self, *names: str) -> None:
        """Raise PortError for an option that has none of these names."""
        for name in self.options:
            if name not in names:
                raise PortError(f"{self.text}: no option '{name}': there are {', '.join(names)}")

    def number(self, name: str, default: _Number) -> _Number:
        """The value of an option, of the type of its default. Raises ValueError for another."""
        text = self.options.get(name, default)
        try:
            return type(default)(text)
        except ValueError:
            kind = {int: "a whole number", float: "a number"}[type(default)]
            raise ValueError(f"{name} must be {kind}, not '{text}'") from None

    def number_if_given(self, name: str) -> float | None:
        """As `number`; None where the option is not given."""
        return self.number(name, 0.0) if name in self.options else None

    @property
    def baud(self) -> int | None:
        """The speed of the line that the option ``baud`` asks for; None: it is not given.

        :raises PortError: no board has this speed.
        """
        speeds = CONSTANTS["baud_default"], CONSTANTS["baud_fast"]
        text = self.options.get("baud")
        if text is not None and text not in map(str, speeds):
            raise PortError(f"baud={text}: a board knows {speeds[0]} and {speeds[1]}")
        return None if text is None else int(text)

    @contextmanager
    def blamed(self) -> Iterator[None]:
        """Let the body's ValueError or OSError be a PortError that names this URL.

        The values of its options are wrong then, or name a file that cannot be read.
        """
        try:
            yield
        except (ValueError, OSError) as exc:
            raise PortError(f"{self.text}: {exc}") from exc
