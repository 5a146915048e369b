# SPDX-License-Identifier: Apache-2.0
"""Each benchmark can be run by `make`, and those that are quick do run.

What they measure is not tested. Two of them did not run for weeks, and nobody saw it: since then
mypy reads them, and `make bench-quick` runs all of them.
"""

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import bench_knead
from bars import at_least, at_most, report
from bench_firmware import capacitor_error_lsb
from bench_honest import Pooled
from kneaded_skin import KneadedSkin
from places import ROOT
from pressed_skin import Plan

BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("bench_*.py"))
SHORT = (
    *("bench_estimators", "bench_far", "bench_fingers", "bench_honest", "bench_host"),
    *("bench_knead", "bench_newtons", "bench_tables"),
    pytest.param("bench_desk", marks=pytest.mark.simavr),
)


@pytest.fixture
def printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str, str], str]:
    """A function that runs a benchmark with an option: what it prints."""

    def call(name: str, option: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, option])
        with pytest.raises(SystemExit, match="0"):
            runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return call


@pytest.mark.parametrize("name", BENCHMARKS)
def test_it_has_a_target_and_says_what_it_measures(
    name: str, printed: Callable[[str, str], str]
) -> None:
    target = name.replace("_", "-")
    makefile = (ROOT / "Makefile").read_text()
    assert f"\n{target}: " in makefile
    assert f"\t$(BENCH)/{name}.py\n" in makefile
    assert f"    make {target}" in (ROOT / "benchmarks" / f"{name}.py").read_text()
    assert "--quick" in printed(name, "--help")


@pytest.mark.parametrize("name", SHORT)
def test_it_runs(name: str, printed: Callable[[str, str], str]) -> None:
    assert json.loads(printed(name, "--quick").splitlines()[-1])


def test_a_bar_of_what_nobody_measures_is_an_error() -> None:
    """A figure that was renamed would else have no bar, and nobody would know."""
    with pytest.raises(KeyError, match="speed"):
        report({"spede": 5.0}, [at_least("speed", 1)])


def test_a_bar_of_all_figures_of_a_name_needs_one() -> None:
    found = Pooled([], 1, lambda done, of: None)
    found["line_start_random_joint_named"] = 100.0
    found.bar(at_least, "line_start", "named", 100)
    assert [bar.figure for bar in found.bars] == list(found)
    with pytest.raises(KeyError, match="lines_start"):
        found.bar(at_least, "lines_start", "named", 100)


def test_a_figure_is_held_to_all_of_its_bars(capsys: pytest.CaptureFixture[str]) -> None:
    """The last one was the only one: the others passed whatever the figure was."""
    bars = [at_least("speed", 1), at_most("speed", 3), at_most("speed", 3)]
    assert report({"speed": 2.0}, bars)
    assert not report({"speed": 4.0}, bars)
    assert not report({"speed": 0.5}, bars)
    assert ">= 1, <= 3 " in capsys.readouterr().out


@pytest.mark.simavr
@pytest.mark.parametrize("node_pf", [100, 200])
def test_an_error_of_less_than_a_code_is_measured(node_pf: int) -> None:
    """It was read as 0 LSB: a reading far from the next code shows nothing of it.

    By arithmetic: the charge that 14 pF bring is shared with the node, and goes through 30 kOhm. It
    has 353 cycles: a slot of 689, less the 10.5 ADC clocks until the simulator's capacitor joins.
    """
    joined_pf = 14 + node_pf
    shared_lsb = 1024 * 14 / joined_pf * np.exp(-353 / 16e6 / (30e3 * 1e-12 * joined_pf))
    found_lsb = capacitor_error_lsb("uno", 0, sample_pf=14, node_pf=node_pf)
    assert found_lsb == pytest.approx(shared_lsb, abs=0.05)


def test_the_memory_of_kneading_is_that_of_the_command(tmp_path: Path) -> None:
    """It was that of the benchmark itself, which has all forces of a skin of 16x16."""
    skin = KneadedSkin(Plan((100.0, 200.0), "series", 1, shape=(2, 2), touches=1), 500)
    skin.record_kneading(tmp_path / "skin.mcap")
    held = np.ones(100_000_000)  # 0.8 GB of this process
    said = bench_knead.knead(tmp_path / "skin.mcap", tmp_path / "skin.json")
    assert said["presses"] > 0
    assert said["gigabytes"] < 1e-9 * held.nbytes / 2
