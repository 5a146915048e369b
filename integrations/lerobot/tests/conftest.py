# SPDX-License-Identifier: Apache-2.0

import subprocess
import sys
from pathlib import Path

import pytest

PRESSES = Path(__file__).parents[3] / "examples" / "presses.csv"


def calibrated(path: Path, *more: str) -> str:
    """A calibration by presses of an emulated skin."""
    words = ("calibrate", "table", "emulator://8x8", PRESSES, path, "--indenter-mm2", "80")
    words += ("--wires", "100,200", "--leads", "80", *more)
    subprocess.run([sys.executable, "-m", "ohmskin", *map(str, words)], check=True)
    return str(path)


@pytest.fixture(scope="session")
def skin_json(tmp_path_factory: pytest.TempPathFactory) -> str:
    return calibrated(tmp_path_factory.mktemp("skin") / "skin.json")
