# SPDX-License-Identifier: Apache-2.0
"""What the pages say is there: commands and their options, code, files, names, printed numbers."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from mkdocs.exceptions import PluginError

import ohmskin
from lockstep import Rig
from ohmskin.cli.main import app
from places import ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("examples/*.md"))]
NAMES = [page.name for page in PAGES]

COMMAND = re.compile(r"^(?:\.venv/bin/)?ohmskin (.*)")
CODE = re.compile(r"`([^`\n]+)`")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s:#]+)(?:#[^)\s]*)?\)")
FILE = re.compile(r"[\w.-]+(?:/[\w.-]+)+\.\w+")
TARGET = re.compile(r"\bmake ([a-z-]+)")


def code_lines(page: Path) -> list[str]:
    """Lines of code blocks: fenced and indented ones."""
    text = page.read_text()
    fenced = [line for block in FENCE.finditer(text) for line in block[2].splitlines()]
    outside = FENCE.sub("", text).splitlines()
    return fenced + [line.strip() for line in outside if line.startswith("    ")]


def commands(page: Path) -> tuple[list[str], list[str]]:
    """Command lines in code blocks, and those quoted in the text, which may be cut short."""
    blocks = [match[1] for line in code_lines(page) if (match := COMMAND.match(line))]
    quoted = CODE.findall(FENCE.sub("", page.read_text()))
    return blocks, [match[1] for code in quoted if (match := COMMAND.match(code))]


def words(line: str) -> list[str]:
    """Without comments, and without the description that follows in a list of commands."""
    return shlex.split(re.split(r"\s{3,}", line)[0], comments=True)


def found(arguments: list[str]) -> tuple[Any, list[str]]:
    """The command that the line names, and what is left of the line."""
    command: Any = app
    left = list(arguments)
    while hasattr(command, "commands") and left and not left[0].startswith("-"):
        assert left[0] in command.commands, f"no command {left[0]!r}"
        command = command.commands[left.pop(0)]
        command = command.load() if hasattr(command, "load") else command
    return command, left


def check_options(arguments: list[str]) -> None:
    command, left = found(arguments)
    known = {"--help", "-h", *(name for p in command.params for name in p.opts + p.secondary_opts)}
    for word in left:
        if word.startswith("-"):
            assert word.partition("=")[0] in known, f"no option {word!r}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_quoted_commands_exist(page: Path) -> None:
    blocks, quoted = commands(page)
    for line in (*blocks, *quoted):
        check_options(words(line))


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_command_lines_parse(page: Path) -> None:
    for line in commands(page)[0]:
        command, left = found(words(line))
        if left:  # a bare name stands in a list of commands
            command.make_context("ohmskin", left)


def test_a_wrong_command_line_would_be_noticed() -> None:
    for line in ("strean PORT", "calibrate weight PORT"):
        with pytest.raises(AssertionError, match="no command"):
            check_options(words(line))
    with pytest.raises(AssertionError, match="no option"):
        check_options(words("stream PORT --tara 1"))
    command, left = found(words("tare /dev/ttyACM0"))
    with pytest.raises(Exception, match=r"(?i)missing"):
        command.make_context("ohmskin", left)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_compiles(page: Path) -> None:
    for language, text in FENCE.findall(page.read_text()):
        assert language == "python", f"{page.name}: a fence of {language!r}"
        compile(text, page.name, "exec")


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_and_links_exist(page: Path) -> None:
    text = page.read_text()
    for path in LINK.findall(text):
        assert (page.parent / path).exists(), path
    for code in CODE.findall(text):
        for path in FILE.findall(code) if "://" not in code else ():
            places = (ROOT, DOCS, ROOT / "host/ohmskin")
            assert code.startswith("/") or any((place / path).exists() for place in places), path


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    code = [*code_lines(page), *CODE.findall(page.read_text())]
    named = {target for line in code for target in TARGET.findall(line.partition("#")[0])}
    assert named <= targets


def test_every_public_name_has_a_place() -> None:
    pages = "\n".join(page.read_text() for page in DOCS.glob("api*.md"))
    shown = set(re.findall(r"^::: ohmskin\.(\w+)$", pages, re.MULTILINE))
    errors = {name for name in ohmskin.__all__ if hasattr(ohmskin.errors, name)}
    assert "::: ohmskin.errors" in pages
    assert set(ohmskin.__all__) == shown & set(ohmskin.__all__) | errors


def test_both_pages_have_the_same_wiring() -> None:
    rows = {
        page: re.findall(r"^\|.*\b(?:multiplexer|EN)\b.*\|$", (ROOT / page).read_text(), re.M)
        for page in ("README.md", "docs/build.md")
    }
    assert len(rows["README.md"]) == 7
    assert rows["README.md"] == rows["docs/build.md"]


# --------------------------------------------------------------------------------------- the site


def loaded(name: str) -> ModuleType:
    """A module in docs/."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def page_at(uri: str) -> Any:
    return SimpleNamespace(file=SimpleNamespace(src_uri=uri))


def test_links_of_the_repository_become_those_of_the_site() -> None:
    moved = loaded("hooks").on_page_markdown
    for uri, link, expected in (
        ("readme.md", "docs/paper.md#here", "paper.md#here"),
        ("readme.md", "docs/ghost.png", "ghost.png"),
        ("readme.md", "protocol/FRAMES.md", "frames.md"),
        ("frames.md", "../README.md", "readme.md"),
        ("index.md", "../ARCHITECTURE.md", "architecture.md"),
        ("index.md", "build.md#size", "build.md#size"),
        ("index.md", "https://semver.org", "https://semver.org"),
        ("index.md", "#here", "#here"),
    ):
        assert moved(f"see [it]({link}).", page=page_at(uri)) == f"see [it]({expected})."


def test_a_page_that_loads_from_another_host_is_refused() -> None:
    checked = loaded("hooks").on_post_page
    sound = '<a href="https://semver.org">x</a><script src="assets/x.js"></script>'
    assert checked(sound, page=page_at("index.md")) == sound
    for foreign in (
        '<script async src="https://cdn.example/x.js"></script>',
        '<link rel="stylesheet" href="//fonts.example/css">',
        "<img src=http://example/x.png>",
    ):
        with pytest.raises(PluginError, match="another host"):
            checked(sound + foreign, page=page_at("index.md"))


def test_tables_and_sessions_in_docstrings_stay_as_they_are() -> None:
    text = "Symbols\n\n=== ===\na   b\n=== ===\n\nx[i] [ohm]\n\n>>> f()\n1\n\nend"
    shown = loaded("docstrings")._indented(text)
    assert "\n    === ===\n    a   b\n    === ===\n" in shown
    assert "\n    >>> f()\n    1\n" in shown
    assert "\nx[i] \\[ohm]\n" in shown
    assert shown.endswith("\nend")


# ------------------------------------------------------------------------------------ docs/draw.py


@pytest.fixture(scope="module")
def draw() -> ModuleType:
    return loaded("draw")


def test_pictures_are_current() -> None:
    done = subprocess.run(
        [sys.executable, str(DOCS / "draw.py"), "--check"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_changed_numbers_make_a_picture_stale(draw: ModuleType) -> None:
    drawn = draw.numbers()
    drawn["slot"]["hold"] += 1
    assert [path.name for path in draw.stale(drawn)] == ["slot.svg"]


def test_printed_numbers_are_those_of_the_pages(
    draw: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    draw.report(draw.numbers())
    pages = [line for page in ("build.md", "timing.md") for line in code_lines(DOCS / page)]
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) > 10
    assert [line for line in printed if line.strip() not in pages] == []


def test_precision_is_that_of_all_ten_bit_codes(draw: ModuleType) -> None:
    """std(g)/g from every code that a cell can give: half the spread of a code, over sqrt(3)."""
    ref_ohm, cell_ohm = 30_000.0, 100_000.0
    current = 1 / (cell_ohm + 2 * ref_ohm)
    ends = [current + side / (2048 * ref_ohm) for side in (-1, 1)]
    low, high = (end / (1 - 2 * ref_ohm * end) for end in ends)
    expected = (high - low) / 2 / 3**0.5 * cell_ohm
    assert draw.relative_std(cell_ohm, ref_ohm) == pytest.approx(expected, rel=1e-3)


@pytest.mark.simavr
def test_slot_is_that_of_the_firmware(draw: ModuleType) -> None:
    slot = draw.slot()
    with Rig("uno") as rig:
        rig.run(0.05)
        rig.start_scan()
        hello = rig.hello()
        rig.sim.reset_stats()
        rig.run(0.1)
        latest = rig.sim.stats()["change_after_hold_cycles_max"]
    assert slot["cycles"] * slot["slots"] == hello["scan_cycles"]
    assert int(slot["settle_us"]) == hello["settle_us"]
    assert slot["interrupt"] < slot["hold"] + latest <= slot["pins_set"]
    assert slot["trigger"] < slot["hold"] < slot["conversion_done"] < slot["cycles"]
