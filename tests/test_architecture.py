# SPDX-License-Identifier: Apache-2.0
"""What ARCHITECTURE.md says of the code, where a test can hold it. import-linter holds layers."""

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from ohmskin.link import protocol
from places import ROOT

HOST = ROOT / "host" / "ohmskin"
CORE = ROOT / "firmware" / "src" / "core"
TEXT = (ROOT / "ARCHITECTURE.md").read_text()
LINTER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
STARTS_THREADS = {"Thread", "ThreadPoolExecutor", "Timer", "Process", "ProcessPoolExecutor"}
RUNS_TEXT = {"eval", "exec", "compile", "__import__"}


@cache
def trees(folder: Path = HOST) -> dict[str, ast.Module]:
    """Each Python file below a folder, by its path there."""
    return {
        str(path.relative_to(folder)): ast.parse(path.read_text()) for path in folder.rglob("*.py")
    }


def called(tree: ast.Module) -> set[str]:
    """Last words of all that is called."""
    calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
    return {ast.unparse(function).rpartition(".")[2] for function in calls}


def imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def importers(*packages: str) -> set[str]:
    """Files of the package that import one of these."""
    return {
        path
        for path, tree in trees().items()
        if any(name.partition(".")[0] in packages for name in imported(tree))
    }


def included(path: Path) -> set[str]:
    return set(re.findall(r'^#include [<"](.*?)[>"]', path.read_text(), re.MULTILINE))


def contract(kind: str, name: str = "") -> dict[str, list[str]]:
    (found,) = (
        each for each in LINTER["contracts"] if each["type"] == kind and name in each["name"]
    )
    return found


def test_every_room_has_a_row() -> None:
    rows = set(re.findall(r"^\| `(\w+)` \|", TEXT, re.MULTILINE))
    assert {path.parent.name for path in HOST.glob("*/__init__.py")} <= rows


def test_the_layers_are_those_that_are_checked() -> None:
    layers = [layer for layer in contract("layers")["layers"] if layer != "__main__"]
    assert "\n".join(f"    {layer}" for layer in layers) + "\n" in TEXT
    rooms = {f"ohmskin.{room}" for layer in layers for room in layer.split(" | ")}
    core = contract("forbidden", "the core")
    assert rooms == {*core["source_modules"], *core["forbidden_modules"]}


def test_threads_are_started_where_the_table_says() -> None:
    started = {path for path, tree in trees().items() if called(tree) & STARTS_THREADS}
    told = re.findall(r"^\| `([\w/]+\.py)` \|", TEXT, re.MULTILINE)
    assert sorted(started) == sorted(set(told))


def test_the_core_of_the_firmware_reaches_hardware_through_its_board_alone() -> None:
    for path in CORE.iterdir():
        own = {name for name in included(path) if not re.fullmatch(r"(std\w+|string)\.h", name)}
        free = {"board.h", "board_numbers.h", "frames.h", "version.h"}
        assert all(name in free or name.startswith("core/") for name in own), path
        assert not re.search(r"\b(Serial|millis|delay|micros)\b\s*[(.]", path.read_text()), path


def test_interrupts_are_the_scan_s_the_line_s_and_the_watchdog_s() -> None:
    board = (ROOT / "firmware" / "src" / "board_avr.cpp").read_text()
    interrupts = set(re.findall(r"^ISR\((\w+)_vect\)", board, re.MULTILINE))
    assert interrupts == {"TIMER1_COMPA", "USART_RX", "USART0_RX", "WDT"}


LARGE = [
    name
    for name, number in protocol.CONSTANTS.items()
    if number >= 500 and not re.fullmatch("10+", str(number))
]


# A small number, or a power of ten, means many things; a large one can hardly be anything else.
@pytest.mark.parametrize("name", LARGE)
def test_no_number_of_the_link_is_written_again(name: str) -> None:
    number = protocol.CONSTANTS[name]
    for path, tree in trees().items():
        literals = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        assert number not in {n for n in literals if type(n) is int}, path
    for path in CORE.iterdir():
        assert not re.search(rf"(?<![\w.]){number}u?l?\b", path.read_text(), re.IGNORECASE), path


def test_nothing_from_outside_is_run() -> None:
    for path, tree in trees().items():
        assert not {name for name in called(tree) & RUNS_TEXT if name != "compile"}, path
        assert "allow_pickle=True" not in ast.unparse(tree), path
    assert not importers("pickle", "marshal", "shelve", "dill")


def test_sockets_are_the_page_s() -> None:
    assert {path.partition("/")[0] for path in importers("socket", "uvicorn", "starlette")} == {
        "view"
    }


def test_the_definition_of_the_link_uses_its_reader_alone() -> None:
    for path, tree in trees(ROOT / "protocol").items():
        assert {n for n in imported(tree) if n.startswith("ohmskin")} <= {
            "ohmskin.link.protocol",
            "ohmskin.link",
        }, path


def test_every_function_of_the_trail_is_in_its_file() -> None:
    rows = re.findall(r"^\| `([\w./]+)` \| `(.+?)` \|", (ROOT / "docs/trail.md").read_text(), re.M)
    assert len(rows) > 40
    for place, name in rows:
        path = ROOT / place if place.startswith("firmware/") else HOST / place
        text = path.read_text()
        *owner, function = re.split(r"::|\.", name.removesuffix(")").partition("ISR(")[2] or name)
        for word in (*owner, function):
            assert re.search(rf"(?:\bdef |\bclass |\w |^  |::|ISR\(){word}\b", text, re.M), (
                place,
                name,
            )
