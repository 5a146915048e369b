# SPDX-License-Identifier: Apache-2.0
"""What files and boards say reaches a terminal as text alone."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.live import Live
from rich.table import Table
from rich.text import Text

from command_line import Run, python
from ohmskin.cli.stream import coloured
from ohmskin.cli.terminal import Terminal, printable
from recordings import URL, scan, write_recording
from stepped import stepped

# What a terminal obeys, what rich takes for markup, and what no encoding has.
HOSTILE = {
    "\x1b]0;title\x07\x1b[2Jgone": "?]0;title?[2Jgone",
    "\x9b31mred": "?31mred",
    "[/x]": "[/x]",
    "[link=https://example.org]here[/link]": "[link=https://example.org]here[/link]",
    ":smile:": ":smile:",
    "\ud800": "?",
    "\u202eturned\u2069": "?turned?",
}


@pytest.mark.parametrize("text", HOSTILE)
def test_what_a_recording_says_of_its_board_is_text(tmp_path: Path, run: Run, text: str) -> None:
    """Markup ended in a traceback, after the work was done."""
    hello = replace(stepped(URL).info, board=text, settings=text, reset_cause=(text,))
    path = tmp_path / "a.mcap"
    write_recording(path, hello, [scan(1)])
    out = run("info", f"replay://{path}").out
    assert out.count(HOSTILE[text]) == 3
    assert "\x1b" not in out


@pytest.mark.parametrize("text", HOSTILE)
def test_tables_and_live_pictures_show_text_alone(text: str) -> None:
    file = io.StringIO()
    terminal = Terminal(file=file, force_terminal=True, width=100)
    table = Table(text, title=text)
    table.add_row(text)
    terminal.print(table)
    with Live(Text(text, "red"), console=terminal, auto_refresh=False):
        pass
    said = Text.from_ansi(file.getvalue()).plain
    assert said.count(HOSTILE[text]) >= 2  # columns are as wide as what is left without escapes
    assert "title\x07" not in file.getvalue()
    assert "\x1b[2J" not in file.getvalue()


def test_a_table_of_16x16_fits_into_a_terminal_with_four_lines_beside_it() -> None:
    """The live picture of 21 lines and four more was cut at its end, which has the contacts."""
    file = io.StringIO()
    Terminal(file=file, width=80).print(coloured(np.full((16, 16), 12.3), 500.0))
    lines = file.getvalue().splitlines()
    assert len(lines) <= 24 - 4
    assert max(map(len, lines)) <= 80


def test_names_of_files_are_text(tmp_path: Path) -> None:
    whole, cut, out = (tmp_path / name for name in ("a.mcap", "c\x1b[2Jut.mcap", "[red]left.npz"))
    write_recording(whole, stepped(URL).info, map(scan, range(200)))
    cut.write_bytes(whole.read_bytes()[:-200])
    # With the bar that a wide terminal shows: a program looks at these when it starts.
    shows = {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "300"}
    said = python("-m", "ohmskin", "export", cut, out, **shows).err
    assert f"{tmp_path}/c?[2Jut.mcap was cut off" in said
    assert "[red]left.npz" in said
    assert "\x1b[2J" not in said


def test_an_error_shows_text_alone(run: Run) -> None:
    done = run("estimate", "no\x1b[2J\nfile.npz", "--method", "ohm", "--out", "x.npz")
    assert done.err.startswith("ohmskin: no?[2J file.npz: ")


def test_what_the_terminal_has_no_letter_for_is_said_without_it() -> None:
    program = "from ohmskin.cli.terminal import Terminal; Terminal().print('10 \u2126')"
    done = python("-c", program, PYTHONIOENCODING="ascii")
    assert (done.code, done.out) == (0, "10 ?\n")


def test_plain_text_stays() -> None:
    text = "10 µS\na line \N{GREEK CAPITAL LETTER OMEGA}"
    assert printable(text) == text
