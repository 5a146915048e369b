# SPDX-License-Identifier: Apache-2.0
"""The studies as commands: what they write and print, and what interrupts them."""

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from command_line import Run
from studies import ablate, chart, commands, far, force_experiment, force_kneading, stability
from studies.conditions import SWEEPS
from studies.force_experiment import Comparison
from studies.force_limits import Detection
from studies.force_trial import Plan

SMALL = Plan(seeds=1, presses=6, test_presses=2, frames_per_press=2)
FEW = ("voltage", "truth")
SURFACES = (
    Comparison(2, 2, SMALL, ("voltage", "joint", "touch", "truth"), ("whole",)),
    Comparison(2, 2, replace(SMALL, frames_per_press=1), FEW, ("whole",)),
    Comparison(3, 3, replace(SMALL, test_presses=1), FEW, ("whole",)),
)
METHODS = ("ohm", "matrix", "joint")
KNEADED = (3, replace(SMALL, test_presses=1), 20.0)
DETECTION = Detection(seeds=1, empty_frames=40, frames=8, forces=4, methods=("voltage", "joint"))
CHART = chart.Plan(1, 8, warm_up=2, repeats=1, sizes=(chart.Size(2, 2, 3),), methods=METHODS)
STABILITY = stability.Plan(1, 1, paper_skins=0, paper_shape=(2, 2), shape=(2, 2))
ABLATED = ("prior.SEGMENT_STD", "sparse_fit.RIVAL_SHARE")


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch, run: Run) -> Run:
    """A function that runs ``python -m studies ARGUMENTS``; what is quick is tiny."""
    monkeypatch.setattr(chart, "QUICK", CHART)
    monkeypatch.setattr(stability, "QUICK", STABILITY)
    monkeypatch.setattr(far, "QUICK", far.Plan(skins=1, frames=2))
    monkeypatch.setattr(far, "WIRE_OHM", (100.0, 1000.0))
    monkeypatch.setattr(ablate, "measure", partial(ablate.measure, scenes=["ngspice_random"]))
    monkeypatch.setattr(force_experiment, "QUICK", SURFACES)
    monkeypatch.setattr(force_kneading, "QUICK", KNEADED)
    monkeypatch.setattr(commands, "QUICK_DETECTION", DETECTION)
    return partial(run, program="studies")


@pytest.fixture
def answered(study: Run, tmp_path: Path) -> Any:
    """A function that runs a study into a new folder: its answer, table, and stderr."""

    def call(command: str) -> tuple[dict[str, Any], str, str]:
        folder = tmp_path / "new"
        code, out, err = study(*command.split(), "--out", str(folder))
        assert code == 0
        assert out.count("\n") == 1
        answer = json.loads(out)
        files = {Path(answer[kind]) for kind in ("picture", "table") if kind in answer}
        assert set(folder.iterdir()) == files
        if "picture" in answer:
            octets = Path(answer["picture"]).read_bytes()
            assert octets.startswith(b"\x89PNG\r\n\x1a\n")
            assert len(octets) > 30_000
            assert answer["quick"]
        return answer, Path(answer["table"]).read_text() if "table" in answer else "", err

    return call


def test_chart(answered: Any) -> None:
    _, table, _ = answered("chart --quick")
    assert table.startswith("scene,source,rows,columns,bits,method,")
    assert {line["method"] for line in csv.DictReader(table.splitlines())} > set(METHODS)


def test_stability(answered: Any) -> None:
    answer, table, _ = answered("stability --quick --jobs 1")
    assert answer["methods"]["ohm"]["frames"] == sum(len(each.values) for each in SWEEPS.values())
    assert table.startswith("sweep,x,method,frames,right,flagged,wrong_unflagged\n")


def test_far(answered: Any) -> None:
    _, table, err = answered("far --quick")
    assert table.startswith("sweep,scene,wire_ohm,bend,bits,readout,")
    assert {line["readout"] for line in csv.DictReader(table.splitlines())} == set(far.READOUTS)
    assert "| eight touches, 1000/2000 ohm |" in err


def test_ablate(answered: Any, study: Run) -> None:
    only = "ablate --only RIVAL_SHARE,prior.SEGMENT_STD"
    _, table, err = answered(f"{only} --skins 3 --frames 4 --jobs 1")
    assert {line["constant"] for line in csv.DictReader(table.splitlines())} == set(ABLATED)
    assert "worst loss" in err
    assert "no constant NONSENSE" in study("ablate", "--only", "NONSENSE").err


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("curved", "rows"),
        ("kneaded", "rows"),
        ("timeseries", "cross_talk"),
        ("minimum", "smallest_forces"),
    ],
)
def test_experiments(answered: Any, name: str, key: str) -> None:
    answer, _, err = answered(f"experiment {name} --quick --json")
    assert answer["simulated"]
    assert answer[key]
    assert err == ""


def test_an_experiment_prints_tables_beside_the_papers_numbers(answered: Any) -> None:
    answer, _, err = answered("experiment flat --quick")
    assert answer["rows"]
    assert "simulated" in err
    assert "3.52" in err  # naive, flat, cell (1, 1)
    assert "…" not in err


@pytest.mark.parametrize(
    ("command", "where", "file"),
    [
        ("chart", "chart.measure", "speed-accuracy.csv"),
        ("chart", "chart_figure.picture", "speed-accuracy.csv"),
        ("experiment flat", "force_experiment.measure", "force-flat.png"),
    ],
)
def test_ctrl_c_leaves_the_old_files(
    study: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str, where: str, file: str
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(chart, "measure", lambda *_: [])
    monkeypatch.setattr(f"studies.{where}", interrupt)
    (tmp_path / file).write_text("old")
    code, out, err = study(*command.split(), "--quick", "--out", str(tmp_path))
    assert (code, out) == (130, "")
    assert "Traceback" not in err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]
