# SPDX-License-Identifier: Apache-2.0
"""`make chart`: the front, the table, the picture, and what a frame can tell at best."""

import csv
import io
import signal
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from command_line import Command, finish
from ohmskin.estimate.methods import METHODS
from studies import chart, chart_figure, published
from studies.chart import Plan, Row, Size, pareto_front
from studies.trials import reference_trial
from waiting import until

TINY = Plan(
    skins=1,
    frames=8,
    warm_up=2,
    repeats=1,
    sizes=(Size(2, 2, 3),),
    methods=("ohm", "matrix", "joint"),
)


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return chart.measure(TINY)


def of(rows: list[Row], **what: object) -> list[Row]:
    return [row for row in rows if all(getattr(row, k) == value for k, value in what.items())]


@pytest.mark.parametrize(
    ("points", "on_front"),
    [
        ([(1, 5), (2, 3), (3, 4), (4, 1)], [True, True, False, True]),
        ([(1, 1), (2, 2), (1, 2), (2, 1)], [True, False, False, False]),
        ([(1, 1), (1, 1), (0, 2)], [True, True, True]),
        ([(1, np.nan), (np.nan, 1), (5, 5)], [False, False, True]),
        ([], []),
    ],
)
def test_pareto_front(points: list[tuple[float, float]], on_front: list[bool]) -> None:
    assert pareto_front(points) == on_front


def test_all_methods_get_the_same_frames(rows: list[Row]) -> None:
    for bits in (None, 10):
        measured = of(rows, scene="random", bits=bits)
        assert [row.method for row in measured] == list(TINY.methods)
        assert {row.frames for row in measured} == {6}
        assert len({row.pressed_cells for row in measured}) == 1
        for row in measured:
            assert row.pressed_cells
            assert 0 < row.ms <= row.ms_p90
            assert 0 <= row.error_percent <= row.error_p90_percent


def test_far_ends_read_the_same_frames(rows: list[Row]) -> None:
    for bits in (None, 10):
        (near,) = of(rows, scene="random", bits=bits, method="joint")
        (far,) = of(rows, scene="random, far ends", bits=bits)
        assert (far.method, far.on_front) == ("joint", False)
        assert (far.frames, far.pressed_cells) == (near.frames, near.pressed_cells)
        assert 0 < far.ms <= far.ms_p90
        assert 0 <= far.error_percent < 2  # per cent; measured: 0.3 at 10 bits


def test_progress_counts_every_method_on_every_skin() -> None:
    seen = list[tuple[int, int]]()
    plan = replace(TINY, methods=("ohm", "touch"), bits=(10,))
    chart.measure(plan, lambda done, steps: seen.append((done, steps)))
    total = (2 + 1) + 2 * 10  # touch at far ends as well, and ten conditions of the sweeps
    assert seen == [(done, total) for done in range(1, total + 1)]


def test_limits_are_ordered(rows: list[Row]) -> None:
    """What is known more exactly leaves less: wires, and readings."""
    exact, rounded = (of(rows, scene="random", bits=bits)[0] for bits in (None, 10))
    for row in (exact, rounded):
        assert row.limit_told_percent < row.limit_percent < row.limit_std_percent
    assert exact.limit_std_percent < rounded.limit_std_percent


def test_median_error_of_normal_deviations() -> None:
    assert chart.median_error(np.ones(1)) == pytest.approx(0.6745, abs=2e-3)
    random = np.random.default_rng(2)
    stds = np.exp(random.standard_normal(40))
    drawn = np.abs(stds * random.standard_normal((20_000, 40)))
    assert chart.median_error(stds) == pytest.approx(np.median(drawn), rel=1e-2)


def test_the_papers_methods_run_on_small_skins_alone() -> None:
    plan = Plan(skins=1, frames=1)
    assert plan.methods_for(Size(3, 3, 1)) == list(METHODS)
    assert {*METHODS} - {*plan.methods_for(Size(4, 4, 1))} == {"lsq", "regularized"}


def test_sweeps_are_the_papers() -> None:
    """The files that are read have the conditions that its figures have."""
    cells, wires = (reference_trial(f"{name}_3x3") for name in ("cell_sweep", "wire_sweep"))
    megohm = published.CONDITIONS_MEGOHM
    np.testing.assert_allclose(1e-6 / cells.cell_siemens[:, 0, 0], megohm["cell_sweep"])
    by_wire = [1e-6 * skin.top_wire_ohm[0, 0] for skin in wires.frames]
    np.testing.assert_allclose(by_wire, megohm["wire_sweep"])


def test_csv_has_every_row_and_column(rows: list[Row]) -> None:
    table = list(csv.DictReader(io.StringIO(chart.csv_text(rows))))
    assert len(table) == len(rows) == 2 * (3 + 1) + 2 * 3 + 2 + 6
    assert list(table[0]) == [column.name for column in fields(Row)]
    for line, row in zip(table, rows, strict=True):
        assert line["method"] == row.method
        assert line["bits"] == str(row.bits or "exact")
        assert line["on_front"] == str(int(row.on_front))
        assert (line["ms"] == "") == (row.ms is None)
        if row.error_percent is not None:
            assert float(line["error_percent"]) == pytest.approx(row.error_percent, rel=1e-3)
    printed = [line for line in table if line["source"] == "Su2024"]
    by_place = {(line["scene"], line["method"]): line for line in printed}
    assert by_place["board", "regularized"]["ms"] == "90"
    assert by_place["board", "regularized"]["error_percent"] == ""
    assert by_place["wire_sweep", "regularized"]["rmse_megohm"] == "0.0829"
    assert by_place["wire_sweep", "regularized"]["ms"] == ""


def test_frames_without_touches_have_a_row_and_a_picture() -> None:
    plan = replace(TINY, sizes=(Size(2, 2, 0),), methods=("ohm",), bits=(10,))
    rows = chart.measure(plan)
    assert (rows[0].pressed_cells, rows[0].error_percent, rows[0].limit_percent) == (0, None, None)
    assert not rows[0].on_front
    assert chart_figure.picture(rows, "a machine").startswith(b"\x89PNG")


def test_ctrl_c_is_not_lost_in_ipopt(command: Command, tmp_path: Path) -> None:
    """CasADi takes the signal: the frame would just not converge, and the run go on."""
    folder = tmp_path / "new"
    process = command("chart", "--out", str(folder), module="studies")
    until(folder.exists)
    time.sleep(1.5)  # by then nearly all time goes into Ipopt, and so for two minutes
    process.send_signal(signal.SIGINT)
    code, out, err = finish(process)
    assert (code, out) == (130, "")
    assert "Traceback" not in err
    assert list(folder.iterdir()) == []
