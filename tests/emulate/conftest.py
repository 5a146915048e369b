# SPDX-License-Identifier: Apache-2.0
"""Programs that are compiled and simulated, for several test files."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from avr import MCU, SENDING, Build, Simulate
from lockstep import LockstepSim
from ohmskin.emulate.simavr import PROGRAM


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Compile C, or assembler without start-up code, once per program and board."""
    if shutil.which("avr-gcc") is None or not PROGRAM.exists():
        pytest.skip("needs avr-gcc and 'make -C firmware/sim'")
    folder = tmp_path_factory.mktemp("firmware")

    @cache
    def compile_for(board: str, source: str) -> Path:
        stem = folder / f"f{len(list(folder.iterdir()))}"
        assembler = "int main" not in source
        path = stem.with_suffix(".S" if assembler else ".c")
        path.write_text(source if assembler else SENDING + source)
        options = ["-nostartfiles", "-nostdlib"] if assembler else ["-std=gnu99"]
        command = ["avr-gcc", f"-mmcu={MCU[board]}", "-DF_CPU=16000000UL", "-Os", *options]
        subprocess.run([*command, "-o", stem.with_suffix(".elf"), path], check=True)
        return stem.with_suffix(".elf")

    return compile_for


@pytest.fixture
def simulate(build: Build) -> Iterator[Simulate]:
    """A function that simulates a board with a program."""
    with ExitStack() as stack:

        def start(source: str, board: str = "uno", **options: Any) -> LockstepSim:
            return stack.enter_context(LockstepSim(board, build(board, source), **options))

        yield start
