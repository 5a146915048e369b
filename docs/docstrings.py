# SPDX-License-Identifier: Apache-2.0
"""Docstrings as they are written, in the site: what Markdown would take for something else."""

from __future__ import annotations

import re
from typing import Any

import griffe

_BEGINS = re.compile(r"=+( +=+)+ *$|>>> ")


class Docstrings(griffe.Extension):
    """Indents tables of symbols (reStructuredText) and sessions of Python, which Markdown then
    takes for code; and `y[i] [ohm]` is no link.
    """

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """A docstring has been read."""
        if obj.docstring:
            obj.docstring.value = indented(obj.docstring.value)


def indented(text: str) -> str:
    """A table goes from its first border, a session from its first prompt, to a blank line."""
    out, inside = [], False
    for line in text.splitlines():
        if _BEGINS.match(line) and not inside:
            inside = True
            out.append("")
        elif not line.strip():
            inside = False
        if inside:
            line = f"    {line}"
        out.append(line if line.startswith("    ") else line.replace("] [", "] \\["))
    return "\n".join(out)
