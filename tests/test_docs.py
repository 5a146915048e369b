# SPDX-License-Identifier: Apache-2.0
"""What the pages say is there: commands and their options, code, files, names, printed numbers."""

import pkgutil
import re
import shlex
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any

import pytest
from mkdocs.exceptions import PluginError

import ohmskin
from command_line import python
from lockstep import Rig
from ohmskin.cli.main import app
from pin_maps import DEFAULT
from places import ROOT

DOCS = ROOT / "docs"
COMMAND = re.compile(r"^(?:\.venv/bin/)?ohmskin (.*)")
CODE = re.compile(r"`([^`\n]+)`")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s:#]+)(?:#[^)\s]*)?\)")
FILE = re.compile(r"[\w.-]+(?:/[\w.-]+)+\.\w+")
TARGET = re.compile(r"\bmake ([a-z-]+)")
NAME = re.compile(r"(?<![/\w])(?:ohmskin|studies)(?:\.[A-Za-z_]\w*)+")


class Page:
    """A page of the documentation, and what it quotes.

    code: the lines of code blocks, fenced and indented ones. quoted: code in the text.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = path.read_text()
        self.fences = FENCE.findall(self.text)
        plain = FENCE.sub("", self.text)
        fenced = [line for _, block in self.fences for line in block.splitlines()]
        indented = [line.strip() for line in plain.splitlines() if line.startswith("    ")]
        self.code = fenced + indented
        self.quoted = CODE.findall(plain)

    def commands(self, lines: list[str]) -> list[list[str]]:
        """The words of command lines, without the description that follows in a list of them."""
        found = [match[1] for line in lines if (match := COMMAND.match(line))]
        return [shlex.split(re.split(r"\s{3,}", line)[0], comments=True) for line in found]


PAGES = [
    Page(path)
    for pattern in (
        *("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md"),
        *("docs/*.md", "examples/*.md", "integrations/*/*.md", ".github/ISSUE_TEMPLATE/*.md"),
    )
    for path in sorted(ROOT.glob(pattern))
]
every_page = pytest.mark.parametrize("page", PAGES, ids=[page.path.name for page in PAGES])
COMMANDS: Any = app


def found(arguments: list[str]) -> tuple[Any, list[str]]:
    """The command that the words name, and the words that are left."""
    command, left = COMMANDS, list(arguments)
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


@every_page
def test_commands_exist_and_parse(page: Page) -> None:
    for words in page.commands(page.quoted):  # these may be cut short
        check_options(words)
    for words in page.commands(page.code):
        check_options(words)
        command, left = found(words)
        if left:  # a bare name stands in a list of commands
            command.make_context("ohmskin", left)


def test_a_wrong_command_line_would_be_noticed() -> None:
    for line in ("strean PORT", "calibrate weight PORT"):
        with pytest.raises(AssertionError, match="no command"):
            check_options(line.split())
    with pytest.raises(AssertionError, match="no option"):
        check_options(["stream", "PORT", "--tara", "1"])
    command, left = found(["tare", "/dev/ttyACM0"])
    with pytest.raises(Exception, match=r"(?i)missing"):
        command.make_context("ohmskin", left)


@every_page
def test_code_files_links_and_names_exist(page: Page) -> None:
    for language, text in page.fences:
        assert language == "python", f"a fence of {language!r}"
        compile(text, page.path.name, "exec")
    for path in LINK.findall(page.text):
        assert (page.path.parent / path).exists(), path
    code = CODE.findall(page.text)
    for span in code:
        for path in FILE.findall(span) if "://" not in span else ():
            places = (ROOT, DOCS, ROOT / "host/ohmskin")
            assert span.startswith("/") or any((place / path).exists() for place in places), path
        for name in NAME.findall(span):
            pkgutil.resolve_name(name)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = [line.partition("#")[0] for line in (*page.code, *code)]
    assert {target for line in named for target in TARGET.findall(line)} <= targets


def test_no_text_installs_a_name_that_nobody_has_registered() -> None:
    """The package is not published: whoever registers its name would be trusted."""
    folders = ("host", "studies", "examples", "tools", "firmware", "benchmarks")
    texts = [path for folder in folders for path in ROOT.glob(f"{folder}/**/*.py")]
    assert len(texts) > 100
    for path in (*texts, *(page.path for page in PAGES)):
        found = re.search(r"pip install \S*\bohmskin\b(?!-)", path.read_text())
        assert found is None, (path, found)


def test_every_public_name_has_a_place() -> None:
    pages = "\n".join(page.text for page in PAGES if page.path.name.startswith("api"))
    shown = set(re.findall(r"^::: ohmskin\.(\w+)$", pages, re.MULTILINE))
    errors = {name for name in ohmskin.__all__ if hasattr(ohmskin.errors, name)}
    assert "::: ohmskin.errors" in pages
    assert set(ohmskin.__all__) == shown & set(ohmskin.__all__) | errors


def test_figures_stand_beside_their_commands() -> None:
    headings = re.findall(r"^(.*)\n\|[-|]+\|$", (DOCS / "figures.md").read_text(), re.MULTILINE)
    assert len(headings) >= 6
    for heading in headings:
        assert re.match(r"\| `(make|benchmarks/)[^`]+` prints? ", heading), heading


def test_both_pages_have_the_same_wiring() -> None:
    rows = {
        page: re.findall(r"^\|.*\b(?:multiplexer|EN)\b.*\|$", (ROOT / page).read_text(), re.M)
        for page in ("README.md", "docs/build.md")
    }
    assert len(rows["README.md"]) == 7
    assert rows["README.md"] == rows["docs/build.md"]


def test_the_example_of_another_wiring_is_in_platformio_ini_and_has_its_number() -> None:
    page = (DOCS / "wiring.md").read_text()
    [example] = re.findall(r"^    \[env:uno\]\n(?:    .*\n)+", page, re.MULTILINE)
    section = [line.strip() for line in example.splitlines() if "-DOHMSKIN" not in line]
    ini = re.sub(r"^;.*\n", "", (ROOT / "platformio.ini").read_text(), flags=re.MULTILINE)
    assert "\n".join(section) in ini
    told = dict(re.findall(r"-DOHMSKIN_(\w+)=(\S+)", example))
    assert told.keys() == {"ROW_PINS", "REF_TOP_OHM", "REF_BOTTOM_OHM"}
    wired = replace(DEFAULT["uno"], rows=tuple(map(int, told["ROW_PINS"].split(","))))
    assert f"wiring another one, 0x{wired.crc:04X}; " in page
    assert f"\n      {wired}\n" in page
    assert f"{told['REF_TOP_OHM']} Ohm top, {told['REF_BOTTOM_OHM']} Ohm bottom" in page


def loaded(name: str) -> SimpleNamespace:
    """What a module in docs/ defines."""
    return SimpleNamespace(**run_path(str(DOCS / f"{name}.py")))


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
    shown = loaded("docstrings").indented(text)
    assert "\n    === ===\n    a   b\n    === ===\n" in shown
    assert "\n    >>> f()\n    1\n" in shown
    assert "\nx[i] \\[ohm]\n" in shown
    assert shown.endswith("\nend")


def test_lines_that_describe_fields_are_a_list() -> None:
    text = "What it is.\n\nx_ohm, y_ohm: first [ohm],\n    and more.\nz: last.\nA text: prose.\n"
    shown = loaded("docstrings").indented(text)
    assert "\n- `x_ohm, y_ohm`: first [ohm],\n  and more.\n- `z`: last.\n\nA text: prose." in shown


@pytest.mark.browser
def test_the_site_is_searched_from_the_disk_and_follows_the_scheme(
    tmp_path: Path, browser: Any
) -> None:
    build = ("-m", "mkdocs", "build", "-q", "-f", ROOT / "mkdocs.yml", "-d", tmp_path)
    assert python(*build, NO_MKDOCS_2_WARNING="1").code == 0
    foreign: list[str] = []
    for scheme, name in (("light", "default"), ("dark", "slate")):
        page = browser.new_context(color_scheme=scheme).new_page()
        page.on("request", lambda request: foreign.append(request.url))
        page.goto((tmp_path / "integrations/foxglove.html").as_uri())
        assert page.locator("body").get_attribute("data-md-color-scheme") == name
    page.locator(".md-search__input").click()
    page.keyboard.type("brown-out", delay=30)
    found = page.locator(".md-search-result__item h1", has_text="Troubleshooting")
    found.wait_for(timeout=20_000)
    assert [url for url in foreign if not url.startswith("file:")] == []


@pytest.fixture(scope="module")
def draw() -> SimpleNamespace:
    return loaded("draw")


def test_pictures_are_current(
    draw: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["draw.py", "--check"])
    assert (draw.main(), capsys.readouterr().err) == (0, "")


def test_changed_numbers_make_a_picture_stale(draw: SimpleNamespace) -> None:
    drawn = draw.numbers()
    drawn["slot"]["hold"] += 1
    assert [path.name for path in draw.stale(drawn)] == ["slot.svg"]


def test_printed_numbers_are_those_of_the_pages(
    draw: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    draw.report(draw.numbers())
    pages = [line for page in ("build.md", "timing.md") for line in Page(DOCS / page).code]
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) > 10
    assert [line for line in printed if line.strip() not in pages] == []


def test_precision_is_that_of_all_ten_bit_codes(draw: SimpleNamespace) -> None:
    """std(g)/g from every code that a cell can give: half the spread of a code, over sqrt(3)."""
    ref_ohm, cell_ohm = 30_000.0, 100_000.0
    current = 1 / (cell_ohm + 2 * ref_ohm)
    ends = [current + side / (2048 * ref_ohm) for side in (-1, 1)]
    low, high = (end / (1 - 2 * ref_ohm * end) for end in ends)
    expected = (high - low) / 2 / 3**0.5 * cell_ohm
    assert draw.relative_std(cell_ohm, ref_ohm) == pytest.approx(expected, rel=1e-3)


@pytest.mark.simavr
def test_slot_is_that_of_the_firmware(draw: SimpleNamespace) -> None:
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
