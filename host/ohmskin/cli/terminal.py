# SPDX-License-Identifier: Apache-2.0
"""Where commands print. Text from files and boards may be anything, and is made harmless here."""

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment


def printable(text: str) -> str:
    """The text with "?" in place of what a terminal may obey: escapes, changes of direction."""
    if text.replace("\n", "").isprintable():
        return text
    return "".join(each if each.isprintable() or each == "\n" else "?" for each in text)


class Terminal(Console):
    """A console of rich for which no text has markup, emoji by name, or escape sequences.

    Colours are those of `rich.text.Text` and of styles. What the terminal's encoding lacks is "?".
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """All that is printed, also in tables and live pictures, comes by here."""
        for segment in super().render(renderable, options):
            if segment.control:  # of rich itself
                yield segment
            else:
                text = printable(segment.text).encode(self.encoding, "replace")
                yield segment._replace(text=text.decode(self.encoding))
