# SPDX-License-Identifier: Apache-2.0
"""Docstrings as they are written, in the site: what Markdown would take for something else."""

from __future__ import annotations

import re
from typing import Any

import griffe

_BEGINS = re.compile(r"=+( +=+)+ *$|>>> ")
_FIELD = re.compile(r"([a-z_]\w*(?:, [a-z_]\w*)*): ")


class Docstrings(griffe.Extension):
    """Indents tables of symbols (reStructuredText) and sessions of Python, which Markdown then
    takes for code; makes a list of lines that describe fields; and `y[i] [ohm]` is no link.
    """

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """A docstring has been read."""
        if obj.docstring:
            obj.docstring.value = indented(obj.docstring.value)


def indented(text: str) -> str:
    """A table goes from its first border, a session from its first prompt, to a blank line. A field
    goes from its name at a line's beginning to the next line that is not indented.
    """
    out, in_code, in_field = [], False, False
    for line in text.splitlines():
        if _BEGINS.match(line) and not in_code:
            in_code, in_field = True, False
            out.append("")
        elif not line.strip():
            in_code = False
        if in_code:
            out.append(f"    {line}")
            continue
        if field := _FIELD.match(line):
            out += [] if in_field else [""]
            in_field, line = True, f"- `{field[1]}`: {line[field.end() :]}"
        elif in_field and line.startswith("    "):
            line = line[2:]  # goes on
        elif in_field:
            in_field = False
            out.append("")
        out.append(line if line.startswith("    ") else line.replace("] [", "] \\["))
    return "\n".join(out)
