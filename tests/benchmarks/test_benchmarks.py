# SPDX-License-Identifier: Apache-2.0
"""Each benchmark can be run by `make`, and those that are quick do run.

What they measure is not tested. Two of them did not run for weeks, and nobody saw it: since then
mypy reads them, and `make bench-quick` runs all of them.
"""

import importlib
import json
import sys

import pytest

from bars import at_least, report
from places import ROOT

BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("bench_*.py"))
SHORT = (
    *("bench_estimators", "bench_far", "bench_fingers", "bench_tables"),
    pytest.param("bench_desk", marks=pytest.mark.simavr),
)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_it_has_a_target_and_says_what_it_measures(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = name.replace("_", "-")
    makefile = (ROOT / "Makefile").read_text()
    assert f"\n{target}: " in makefile
    assert f"\t$(BENCH)/{name}.py\n" in makefile
    benchmark = importlib.import_module(name)
    assert f"    make {target}" in benchmark.__doc__
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        benchmark.main()
    assert "--quick" in capsys.readouterr().out


@pytest.mark.parametrize("name", SHORT)
def test_it_runs(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--quick"])
    assert importlib.import_module(name).main() == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_bar_of_what_nobody_measures_is_an_error() -> None:
    """A figure that was renamed would else have no bar, and nobody would know."""
    with pytest.raises(KeyError, match="speed"):
        report({"spede": 5.0}, [at_least("speed", 1)])
