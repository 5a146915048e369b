# SPDX-License-Identifier: Apache-2.0
"""`make stability`: the verdict, the faults, the sweep over processes, the files."""

import csv
import io
import os
import signal
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np
import pytest

from command_line import Command, finish
from network import laplacian_readings
from ohmskin.circuit.skin import Skin
from ohmskin.estimate.matrix import MatrixEstimator
from studies import conditions, stability
from studies.conditions import SWEEPS, Case
from studies.judge import Verdict
from studies.stability import ALL_SWEEPS, Plan, Row, Task
from waiting import until

TINY = Plan(skins=2, frames=2, paper_skins=0, paper_shape=(2, 2), shape=(3, 3))
FAST = ("ohm", "matrix")
SKINS = [(sweep.name, x) for sweep in ALL_SWEEPS.values() for x in sweep.values]


def tiny_tasks() -> list[Task]:
    return [task for task in stability.tasks_of(TINY, FAST) if task.sweep in ("stuck", "lines")]


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return stability.measure(tiny_tasks(), jobs=1)


@pytest.fixture
def skin() -> Skin:
    random = np.random.default_rng(5)
    cell, top, bottom = (
        middle * np.exp(random.standard_normal((3, 4))) for middle in (2e-5, 300.0, 500.0)
    )
    return Skin(cell, top, bottom, 20e3, 40e3)


@pytest.mark.parametrize(
    ("fault", "short"),
    [
        ("two rows shorted", (1, 2)),
        ("two columns shorted", (3 + 2, 3 + 3)),
        ("row shorted to column", (1, 3 + 2)),
    ],
)
def test_shorted_electrodes(skin: Skin, fault: str, short: tuple[int, int]) -> None:
    found = conditions.with_line_fault(skin, fault, (1, 2))
    assert np.abs(found - laplacian_readings(skin, [short])).max() < 1e-8
    assert np.abs(found - laplacian_readings(skin)).max() > 1e-2


@pytest.mark.parametrize(
    ("fault", "layer", "segment"),
    [
        ("row open", "top_wire_ohm", (1, 0)),
        ("column open", "bottom_wire_ohm", (0, 2)),
        ("row cut midway", "top_wire_ohm", (1, 2)),
    ],
)
def test_cut_lines(skin: Skin, fault: str, layer: str, segment: tuple[int, int]) -> None:
    wires = getattr(skin, layer).copy()
    wires[segment] = 1e12
    found = conditions.with_line_fault(skin, fault, (1, 2))
    expected = laplacian_readings(replace(skin, **{layer: wires}))
    assert np.abs(found - expected).max() < 1e-6
    no_current = np.abs(found - [1, 0, 1, 0]).max(axis=2) < 1e-6
    dead = {"row open": np.s_[1, :], "column open": np.s_[:, 2], "row cut midway": np.s_[:0]}
    assert no_current[dead[fault]].all()
    assert no_current.sum() == no_current[dead[fault]].size


def build(sweep: str, x: float | str, frames: int = 3, seed: int = 1) -> Case:
    return ALL_SWEEPS[sweep].build(x, (3, 4), frames, np.random.default_rng(seed))


@pytest.mark.parametrize(("sweep", "x"), SKINS)
def test_every_condition_gives_readings_of_a_converter(sweep: str, x: float | str) -> None:
    case, again = build(sweep, x), build(sweep, x)
    assert case.knowledge.adc_bits == 10
    judged = [frame for frame in case.frames if frame.cell_siemens is not None]
    assert len(judged) == 3
    ratios = [case.knowledge.rest_ratio, *(frame.ratio for frame in case.frames)]
    for ratio in ratios:
        codes = 1024 * ratio - 0.5
        assert np.array_equal(codes, np.round(codes))
        assert codes.min() >= 0
        assert codes.max() <= 1023
    for frame, same in zip(case.frames, again.frames, strict=True):
        assert np.array_equal(frame.ratio, same.ratio)


def test_faults_since_rest_are_in_the_rest_readings() -> None:
    rest = {
        fault: build(sweep, fault).knowledge.rest_ratio
        for sweep, fault in SKINS
        if str(fault).endswith("since rest")
    }
    low, high = 0.5 / 1024, 1023.5 / 1024
    for fault, ratio in rest.items():
        match fault:
            case "cell at 0 since rest":
                assert (ratio == low).all(axis=2).sum() == 1
            case "row open since rest":
                dead = (ratio == [high, low, high, low]).all(axis=(1, 2))
                assert dead.sum() == 1
            case "two rows shorted since rest":
                assert (np.diff(ratio, axis=0) == 0).all(axis=(1, 2)).any()
            case _:
                pytest.fail(f"what is '{fault}'?")


def test_noise_is_as_strong_as_it_says() -> None:
    exact = np.full((50, 50, 4), 0.5)
    found = conditions.converted(exact, np.random.default_rng(1), 3.0)
    assert 1024 * found.std() == pytest.approx(3.0, rel=0.03)
    assert np.unique(conditions.converted(exact, np.random.default_rng(1), 0.0)).size == 1


def test_told_wires_are_the_swept_ones() -> None:
    assert build("nominal", 0.5).knowledge.nominal_wire_ohm.top == 50
    assert build("nominal", 2.0).knowledge.nominal_wire_ohm.bottom == 400
    assert build("wires", 40.0).knowledge.nominal_wire_ohm.top == 200e3


def test_frames_before_are_read_and_not_judged() -> None:
    assert [f.cell_siemens is None for f in build("before", "all open").frames] == 3 * [True, False]
    assert [frame.afresh for frame in build("before", "none").frames] == [True, True, True]


def test_the_results_do_not_depend_on_processes_or_threads(rows: list[Row]) -> None:
    seen: list[tuple[int, int]] = []
    tasks = tiny_tasks()
    by_two = stability.measure(tasks, jobs=2, progress=lambda *counts: seen.append(counts))
    assert by_two == rows
    assert seen == [(done, len(tasks)) for done in range(1, len(tasks) + 1)]
    with joblib.parallel_backend("threading", n_jobs=2):
        assert stability.measure(tasks) == rows


def test_every_method_meets_every_condition() -> None:
    tasks = stability.tasks_of(stability.QUICK)
    met = {(task.sweep, task.x, method) for task in tasks for method in task.methods}
    assert met == {(*place, method) for place in SKINS for method in ALL_SWEEPS[place[0]].methods}
    for task in tasks:
        paper = {"lsq", "regularized"} & set(task.methods)
        assert task.shape == ((2, 2) if paper else (8, 8))


def test_a_method_that_raises_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(MatrixEstimator, "estimate", fail)
    [row] = stability.verdicts_of(Task("noise", 0.0, ("matrix",), (2, 2), 0, 3))
    assert row == Row("noise", 0.0, "matrix", frames=3, flagged=3, raised=3)


def test_shares_add_up(rows: list[Row]) -> None:
    for row in rows:
        assert row.frames == row.right + row.flagged + row.wrong_unflagged == 4
    shares = stability.shares(rows)
    assert list(shares) == ["ohm", "matrix"]
    for share in shares.values():
        assert sum(share[f"{said}_share"] for said in Verdict) == pytest.approx(1, abs=1e-4)
        assert share["frames"] == 4 * (len(SWEEPS["stuck"].values) + len(SWEEPS["lines"].values))


def test_csv(rows: list[Row]) -> None:
    table = list(csv.DictReader(io.StringIO(stability.csv_text(rows))))
    assert [(line["sweep"], line["x"], line["method"]) for line in table] == [
        (sweep, x, method) for sweep, x in SKINS if sweep in ("stuck", "lines") for method in FAST
    ]


def test_ctrl_c_leaves_the_old_files_and_no_process(command: Command, tmp_path: Path) -> None:
    (tmp_path / "stability.csv").write_text("old")
    process = command("stability", "--jobs", "2", "--out", str(tmp_path), module="studies")
    until(lambda: len(children(process.pid)) >= 2)
    # A worker that is stopped while it starts prints a traceback, joblib's: let them begin to work.
    until(lambda: max(map(processor_s, children(process.pid))) > 1.5)
    workers = children(process.pid)
    process.send_signal(signal.SIGINT)  # to it alone: the terminal would tell its workers as well
    code, out, err = finish(process)
    assert code == 130, err
    assert "picture" not in out
    assert [path.name for path in tmp_path.iterdir()] == ["stability.csv"]
    assert (tmp_path / "stability.csv").read_text() == "old"
    until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))


def children(parent: int) -> list[int]:
    """Processes that the one thread of `parent` has started."""
    return list(map(int, Path(f"/proc/{parent}/task/{parent}/children").read_text().split()))


def processor_s(process: int) -> float:
    """Seconds of processor time that a process has used; 0 if it is gone."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
