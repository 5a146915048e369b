# SPDX-License-Identifier: Apache-2.0
"""Each benchmark can be run by `make`, and those that are quick do run.

What they measure is not tested. Two of them did not run for weeks, and nobody saw it: since then
mypy reads them, and `make bench-quick` runs all of them.
"""

import json
import runpy
import sys
from collections.abc import Callable

import pytest

from bars import at_least, report
from places import ROOT

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
