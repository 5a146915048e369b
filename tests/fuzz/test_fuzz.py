# SPDX-License-Identifier: Apache-2.0
"""The short run of `make fuzz`: what once broke something, and some thousand seeded mutations."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from command_line import ENVIRONMENT
from fuzz.__main__ import CORPUS
from fuzz.mutate import mutated
from fuzz.targets import TARGETS, seeds
from places import ROOT

# Mutations of each target: about a second.
COUNTS = {"frames": 800, "boards": 100, "recordings": 500, "readings": 500, "urls": 500}
SEEDS = seeds()
PATH = os.pathsep.join([str(ROOT), str(ROOT / "tests/helpers"), ENVIRONMENT["PYTHONPATH"]])


@pytest.mark.parametrize("target", TARGETS)
def test_nothing_from_outside_raises(target: str) -> None:
    kept = [file.read_bytes() for file in sorted((CORPUS / target).glob("*"))]
    inputs = [*SEEDS[target], *kept, b""]
    for octets in [*inputs, *mutated(inputs, COUNTS.get(target, 1500), seed=1)]:
        try:
            TARGETS[target](octets)
        except Exception as error:
            error.add_note(f"input: {octets!r}")
            raise


def test_every_kept_input_has_its_target() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} <= set(TARGETS)


@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="needs atheris")
def test_fuzzing_is_not_guided_by_the_arithmetic_of_the_circuit() -> None:
    """atheris leaves out modules by their whole names. That of their package left out none."""
    code = (
        "import atheris; from fuzz.__main__ import ARITHMETIC, GUIDED\n"
        "with atheris.instrument_imports(GUIDED, ARITHMETIC): import ohmskin.circuit.ports"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=ENVIRONMENT | {"PYTHONPATH": PATH},
        capture_output=True,
        text=True,
        check=True,
    )
    guided = set(re.findall(r"Instrumenting (ohmskin\S*)", done.stderr))
    assert "ohmskin.link.protocol" in guided
    assert not {f"ohmskin.circuit.{name}" for name in ("configurations", "ports", "skin")} & guided


@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="needs atheris")
def test_make_fuzz_runs(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fuzz", "2", "urls"],
        cwd=tmp_path,
        env=ENVIRONMENT | {"PYTHONPATH": PATH},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.splitlines()[2].split()[1]) > 100
    assert list((tmp_path / "build/fuzz/urls").iterdir())


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_firmware_s_frame_reader_agrees_with_an_oracle(tmp_path: Path) -> None:
    """Under AddressSanitizer and UndefinedBehaviorSanitizer."""
    program = tmp_path / "frame_reader"
    subprocess.run(["make", "-s", "-C", ROOT, f"FUZZED={program}", program], check=True)
    subprocess.run([program, "200000", "1"], check=True)
