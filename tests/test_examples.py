# SPDX-License-Identifier: Apache-2.0
"""The examples run, and print what they say they print."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"


def output_of(*command: str) -> str:
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=True, timeout=60
    ).stdout


def test_every_scan_prints_consecutive_scans() -> None:
    lines = output_of(str(EXAMPLES / "every_scan.py"), "emulator://2x2", "5").splitlines()
    numbers = [int(line.split()[0]) for line in lines]
    assert numbers == list(range(numbers[0], numbers[0] + 5))


def test_estimate_prints_the_moving_finger() -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import estimate; "
        "estimate.main('emulator://8x8?scene=moving', seconds=1.0)"
    )
    text = output_of("-c", code, str(EXAMPLES))
    touches = re.findall(r"\((\d), (\d)\): ([\d.]+) \+- ([\d.]+) microsiemens", text)
    assert touches
    assert all(float(value) > 0 for *_, value, _ in touches)


def test_every_example_is_run_here() -> None:
    tested = {"every_scan.py", "estimate.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == tested
