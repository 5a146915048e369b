# SPDX-License-Identifier: Apache-2.0
"""The package as others get it: sdist, wheel made of it, an empty environment, another folder."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from places import ROOT


def run(*command: str | Path, place: Path) -> str:
    # Nothing of this checkout, nor of this environment, may help.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command], cwd=place, env=kept, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_sdist_and_wheel_run_the_demo_in_an_empty_environment(tmp_path: Path) -> None:
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path, place=ROOT)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for needed in (
        *("firmware/src/main.cpp", "protocol/frames.toml", "platformio.ini", "Makefile"),
        *("tests/data/README.md", "docs/calibrate.md", "tools/setup.sh", "LICENSE"),
    ):
        assert needed in names
    run(*pip, "wheel", "-q", "--no-deps", "-w", tmp_path, sdist, place=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = archive.namelist()
    assert "ohmskin/frames.toml" in packed
    assert "ohmskin/view/page/index.html" in packed
    assert not any(name.startswith(("tests/", "docs/", "firmware/")) for name in packed)

    place = tmp_path / "empty"
    venv.create(place, with_pip=True)
    binaries = place / ("Scripts" if os.name == "nt" else "bin")
    run(binaries / "python", "-m", "pip", "install", "-q", wheel, place=tmp_path)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    out = run(binaries / "ohmskin", "demo", "--seconds", "1", place=elsewhere)
    assert "no ghost" in out
    assert "0 missed, 0 damaged" in out
    assert "sound" in run(binaries / "ohmskin", "doctor", "emulator://2x2", place=elsewhere)
