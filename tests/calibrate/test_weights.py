# SPDX-License-Identifier: Apache-2.0
"""``calibrate weights``: a scripted person puts weights on a simulated skin."""

import os
import re
import signal
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ohmskin
from command_line import Done, Run, assert_one_line, well
from ohmskin.arrays import Float
from ohmskin.calibrate.guide import Press, State, Step
from ohmskin.calibrate.sessions import joined
from ohmskin.calibrate.tables import load_press_table
from ohmskin.circuit.configurations import current_from_ratio
from ohmskin.cli.weights import ANYWHERE, KeptAnywhere, KeptPresses, guided
from ohmskin.force.calibration import load_calibration
from ohmskin.link.messages import Scan
from ohmskin.record.readings import load_readings
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Tare, load_recording
from scripted_skin import REST, ScriptedSkin, rise

Cell = tuple[int, int]
# From when on [s], the cells, and the force on each [N].
Script = Sequence[tuple[float, Sequence[Cell], float]]

TOLD = ("--indenter-mm2", "100")
CELLS = ((0, 0), (0, 1))
ASKED = [(cell, mass_g) for cell in CELLS for mass_g in (50, 200, 1000)]
OPTIONS = ("--grams", "50,200,1000", "--repeats", "1")
PUT_S, OFF_S = 2.2, 0.8


def newtons(mass_g: float) -> float:
    return 9.80665e-3 * mass_g


def on_skin(script: Script, time_s: float) -> Float:
    """Conductances above rest (1, 2) [S]; what is put on creeps for a while."""
    siemens = np.zeros((1, 2))
    now = [step for step in script if step[0] <= time_s]
    if now:
        put_s, cells, force_n = now[-1]
        for cell in cells:
            siemens[cell] = rise(force_n) * (1 - 0.15 * np.exp((put_s - time_s) / 0.4))
    return siemens


def putting(presses: Sequence[tuple[Cell, float]], begin_s: float = 0.5) -> list:
    """A script: each cell and mass [g] for a while, one after another."""
    steps: list[tuple[float, Sequence[Cell], float]] = []
    for cell, mass_g in presses:
        steps.append((begin_s, [cell], newtons(mass_g)))
        steps.append((begin_s + PUT_S, [], 0.0))
        begin_s += PUT_S + OFF_S
    return steps


@pytest.fixture
def weigh(monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path) -> Run:
    """A function that runs the command for skin.json while somebody acts by a script."""

    def call(script: Script, *options: str, interrupt_s: float = float("inf")) -> Done:
        def ctrl_c() -> None:
            os.kill(os.getpid(), signal.SIGINT)

        def too_long() -> None:
            pytest.fail("the script is over, and more presses are wanted")

        happens = [(interrupt_s, ctrl_c), (script[-1][0] + 5 if script else 0.0, too_long)]
        skin = ScriptedSkin(lambda time_s: on_skin(script, time_s), 10.0, happens)

        def rest_measured(seconds: float) -> Float:
            assert skin.only_unit == skin.info.unit_id
            ratio = ScriptedSkin.mean_ratio(skin, seconds)
            skin.begin()
            return ratio

        monkeypatch.setattr(skin, "mean_ratio", rest_measured)
        monkeypatch.setattr(ohmskin, "open", lambda url: skin)
        return run("calibrate", "weights", "fast", str(tmp_path / "skin.json"), *TOLD, *options)

    return call


def pairs_of(path: Path) -> list[tuple[Cell, int]]:
    return [
        ((row, column), round(force_n / 9.80665e-3))
        for row, column, force_n, *_ in load_press_table(path).tolist()
    ]


def test_weights_are_asked_for_read_and_learned(weigh: Run, tmp_path: Path) -> None:
    out, table = tmp_path / "skin.json", tmp_path / "skin.presses.csv"
    # The fourth weight is first put on the wrong cell, then beside a hand.
    script = putting(ASKED[:3])
    begin_s = script[-1][0] + OFF_S
    script += [(begin_s, [(0, 0)], newtons(50)), (begin_s + 2, list(CELLS), newtons(50))]
    script += putting(ASKED[3:], begin_s + 4)

    done = weigh(script, *OPTIONS, interrupt_s=begin_s + 4 + 1.2 * PUT_S)
    assert (done.code, done.err) == (130, "")
    lines = done.out.splitlines()
    asked = "take everything off the skin: its rest is measured in"
    assert lines[:3] == [f"{asked} {left_s} s" for left_s in (3, 2, 1)]
    assert re.fullmatch(r"rest: \d\.\d\d to \d\.\d\d microsiemens", lines[3])
    assert lines[4] == "put 50 g (0.490 N) on cell (0, 0), row 0, column 0"
    assert re.fullmatch(r"1 of 6: .*microsiemens above rest: take it off", lines[5])
    wrong = lines.index("cell (0, 0) is pressed: put the weight on (0, 1) alone")
    assert lines[wrong - 1] == "put 50 g (0.490 N) on cell (0, 1), row 0, column 1"
    assert "cells (0, 0), (0, 1) are pressed: put the weight on (0, 1) alone" in lines[wrong:]
    assert lines[-1] == f"4 of 6 presses are in {table}: the same command goes on"
    assert pairs_of(table) == ASKED[:4]
    assert not out.exists()

    done = well(weigh(putting(ASKED[4:]), *OPTIONS))
    assert done.out.splitlines()[4] == "put 200 g (1.961 N) on cell (0, 1), row 0, column 1"
    assert "held-out error" in done.out
    assert f"{out}: calibration of unit 7, by presses up to 9.81 N" in done.out
    assert pairs_of(table) == ASKED

    rest = REST.cell_siemens
    kept = load_press_table(table)
    truth = rest[kept["row"], kept["column"]] + rise(kept["force_n"])
    # Creep has not quite ended, and wires of 300 ohm are not told apart from a cell of 700.
    np.testing.assert_allclose(kept["conductance"], truth, rtol=0.12)
    assert (kept["conductance_std"] > 0).all()
    # At 700 ohm, noise of 0.3 LSB makes 5 % a scan, and a mean has a few scans.
    assert (kept["conductance_std"] < 0.03 * kept["conductance"]).all()
    calibration = load_calibration(out)
    assert (calibration.unit_id, calibration.method) == (7, "joint")
    assert calibration.indenter_area_m2 == pytest.approx(1e-4)
    for mass_g in (100, 500):
        above = rest + rise(newtons(mass_g)) - calibration.rest.level
        force_n, _ = calibration.model.predict(above, np.zeros((1, 2)))
        # Presses of two cells hardly tell the wires, which are in each curve.
        np.testing.assert_allclose(force_n, newtons(mass_g), rtol=0.2)
    assert "wires: " in done.out
    readings = load_readings(table.with_suffix(".npz"))
    assert readings.ratio.shape == (len(ASKED), 1, 2, 4)
    # A reading is the mean of a steady second: that of its own press.
    current = current_from_ratio(readings.ratio, readings.ref_top_ohm, readings.ref_bottom_ohm)
    own = current[np.arange(len(ASKED)), kept["row"], kept["column"]]
    for column in (0, 1):
        of_cell = kept["column"] == column
        assert (np.argsort(own[of_cell]) == np.argsort(kept["force_n"][of_cell])).all()

    # Cells that are redone: asked again, the others kept.
    before = kept
    done = weigh(putting(ASKED[:3]), *OPTIONS, "--redo", "0,0", interrupt_s=0.5 + PUT_S)
    assert done.code == 130
    assert f"4 of 6 presses are in {table}: the same command without --redo goes on" in done.out
    assert pairs_of(table) == [*ASKED[3:], ASKED[0]]
    redone = load_readings(table.with_suffix(".npz")).ratio
    np.testing.assert_array_equal(redone[:3], readings.ratio[3:])
    done = weigh(putting(ASKED[1:3]), *OPTIONS)
    assert done.code == 0
    after = load_press_table(table)
    assert sorted(pairs_of(table)) == sorted(ASKED)
    assert after["conductance"][:3].tolist() == before["conductance"][3:].tolist()


def test_readings_of_before_a_reset_are_not_kept_for_a_press() -> None:
    """A clock that began anew let every scan since the rest count as one of the press."""
    kept: list[Scan] = []
    told_us = [*range(10**9, 10**9 + 2_000_000, 100_000), *range(0, 6_000_000, 100_000)]
    given = iter(told_us)

    def latest() -> Scan:
        time_us = next(given)
        is_pressed = 1_000_000 <= time_us < 4_000_000
        return Scan(np.full((1, 2, 4), 500 * is_pressed, np.uint16), 0, time_us, 0.0, 0)

    def estimate(ratio: Float) -> SimpleNamespace:
        level = np.array([[0.0, 1e-4 * (ratio[0, 1, 0] > 0.1)]])
        return SimpleNamespace(level=level, touched=level > 0)

    guided(
        SimpleNamespace(latest=latest, put=None),
        SimpleNamespace(estimator=SimpleNamespace(estimate=estimate), rest_level=np.zeros((1, 2))),
        SimpleNamespace(add=lambda step, rest, window: kept.extend(window)),
        [Press((0, 1), 1.0)],
        1,
    )
    assert len(kept) > 5
    assert all(scan.codes.all() for scan in kept)


def test_a_full_table_is_fitted_at_once(weigh: Run, tmp_path: Path) -> None:
    table, out = tmp_path / "skin.presses.csv", tmp_path / "skin.json"
    lines = ["row,column,force_n,conductance"]
    for cell, mass_g in ASKED:
        siemens = REST.cell_siemens[cell] + rise(newtons(mass_g))
        lines.append(f"{cell[0]},{cell[1]},{newtons(mass_g)},{siemens}")
    table.write_text("\n".join(lines) + "\n")
    of_table = table.read_text()
    done = well(weigh([], *OPTIONS))
    assert "put" not in done.out
    assert load_calibration(out).columns == 2
    assert table.read_text() == of_table
    # What cannot be fitted leaves the calibration as it was, and the table.
    was = out.read_bytes()
    table.write_text(of_table.replace(f"{newtons(1000)},", f"{newtons(1000)},-"))
    done = weigh([], *OPTIONS)
    assert_one_line(done, "skin.presses.csv: row 4: conductance is -")
    assert out.read_bytes() == was


@pytest.fixture
def kept(tmp_path: Path) -> KeptPresses:
    """Four presses, and readings that tell whose they are."""
    kept = KeptPresses(tmp_path / "skin.presses.csv")
    for n, column in enumerate((0, 0, 1, 1)):
        scan = Scan(np.full((1, 2, 4), 100 * n, np.uint16), 0, n, 0.0, 0)
        step = Step(State.TAKE_OFF, Press((0, column), 1.0), rise=1.1e-6 * (n + 1), rise_std=0.0)
        kept.add(step, np.zeros((1, 2)), [scan])
    return kept


def kept_readings(path: Path) -> list[int] | None:
    ratios = KeptPresses(path).ratios
    return None if ratios is None else np.round(1023 * ratios[:, 0, 0, 0], -1).astype(int).tolist()


def test_a_table_that_is_edited_by_hand_keeps_the_readings_of_each_press(kept: KeptPresses) -> None:
    """They were those of the row of the same number, whichever row had been deleted."""
    assert kept_readings(kept.path) == [0, 100, 200, 300]
    header, *rows = kept.path.read_text().splitlines()
    for lines, readings in (
        (rows[:1] + rows[2:], [0, 200, 300]),
        (rows[::-1], [300, 200, 100, 0]),
        ([row.replace(",1.0,", ",2.5,") for row in rows[:2]], [0, 100]),
        ([f"0,1,1,{float(rows[3].split(',')[3]):.5e},0"], [300]),  # a spreadsheet's digits
        ([*rows, "0,1,1.0,9e-6,0"], None),
        ([rows[0], rows[0]], None),
    ):
        kept.path.write_text("\n".join([header, *lines]) + "\n")
        assert kept_readings(kept.path) == readings


def test_readings_of_before_tables_were_keyed_count_where_all_are_there(kept: KeptPresses) -> None:
    npz = kept.path.with_suffix(".npz")
    np.savez(npz, ratio=load_readings(npz).ratio)
    assert kept_readings(kept.path) == [0, 100, 200, 300]
    lines = kept.path.read_text().splitlines(keepends=True)
    kept.path.write_text("".join(lines[:2] + lines[3:]))
    assert kept_readings(kept.path) is None
    KeptPresses(kept.path).keep_those([True, True, False])
    assert not npz.exists()


def test_scans_that_came_in_one_read_have_one_force_of_a_weight(tmp_path: Path) -> None:
    """Two of one time were no log of forces, which was found out after the last placement."""
    path = tmp_path / "skin.weights-1.mcap"
    codes = np.zeros((1, 2, 4), np.uint16)
    scans = [Scan(codes, n, 10_000 * n, 0.03 * (n // 3), 0) for n in range(30)]
    with ohmskin.open("emulator://1x2?speed=0") as skin, Recorder(path, skin.info) as recorder:
        recorder.add(Tare(scans[0].ratio, -1.0))
        for scan in scans:
            recorder.add(scan)
        step = Step(State.TAKE_OFF, Press(ANYWHERE, 2.0), rise=1e-6)
        KeptAnywhere(recorder).add(step, np.zeros((1, 2)), scans)
    given = load_recording(path)
    times_s = sorted({scan.host_time_s for scan in given.scans})
    assert [force.host_time_s for force in given.forces] == times_s
    # So it is with recordings of before.
    given.forces = [force for force in given.forces for _ in range(2)]
    assert len(joined([given])[0].forces) == len(times_s)


def test_all_presses_can_be_redone(weigh: Run, tmp_path: Path) -> None:
    table = tmp_path / "skin.presses.csv"
    table.write_text("row,column,force_n,conductance\n0,0,1,1e-5\n0,1,1,1e-5\n")
    redo = ("--redo", "0,0", "--redo", "0,1")
    done = weigh(putting(ASKED), *OPTIONS, *redo, interrupt_s=0.1)
    assert "0 of 6 presses are in" in done.out
    assert not table.exists()


def test_presses_of_another_unit_are_not_gone_on_with(run: Run, tmp_path: Path) -> None:
    """A calibration was learned from the presses of both skins, without a word."""
    out = tmp_path / "skin.json"
    port = "emulator://1x2?scene=weights&speed=0&unit="
    words = ("--grams", "50,100,200", "--repeats", "1", *TOLD)
    well(run("calibrate", "weights", f"{port}1", str(out), *words))
    was = out.read_bytes()
    done = run("calibrate", "weights", f"{port}2", str(out), *words)
    assert_one_line(done, "skin.presses.csv: presses of unit 1, the board is unit 2: ")
    assert out.read_bytes() == was
    well(run("calibrate", "weights", f"{port}1", str(out), *words))


@pytest.mark.parametrize(
    ("port", "now"),
    [
        ("emulator://1x2?mode=far&", "1x2 cells, readings a e b f"),
        ("emulator://2x2?", "2x2 cells, readings a b c d"),
    ],
)
def test_presses_of_another_size_or_mode_are_not_gone_on_with(
    run: Run, tmp_path: Path, port: str, now: str
) -> None:
    """Readings a b c d were taken for a e b f; and of another size, a press was lost first."""
    out, ends = str(tmp_path / "skin.json"), "scene=weights&speed=0"
    words = ("--grams", "50,100,200", "--repeats", "1", *TOLD)
    well(run("calibrate", "weights", f"emulator://1x2?{ends}", out, *words))
    done = run("calibrate", "weights", f"{port}{ends}", out, *words)
    assert_one_line(done, f"presses of 1x2 cells, readings a b c d, the board scans {now}: write")


def test_a_weight_that_is_too_light_to_be_seen_is_asked_after(weigh: Run) -> None:
    """It was waited for without a word."""
    done = weigh([(40.0, [], 0.0)], *OPTIONS, interrupt_s=20.0)
    assert done.out.count("no weight is seen yet: if it lies there, it is too light") == 1
    patient = weigh([(40.0, [], 0.0)], *OPTIONS, interrupt_s=10.0)
    assert "no weight is seen" not in patient.out


def test_wrong_uses_of_weights(run: Run, tmp_path: Path) -> None:
    out, port = str(tmp_path / "skin.json"), "emulator://1x2"
    table = tmp_path / "skin.presses.csv"
    good = {"--grams": "50,100,200", "--indenter-mm2": "100"}
    for options, words in (
        ({"--method": "voltage"}, ["a table has conductances, which 'voltage'"]),
        ({"--method": "magic"}, ["no method 'magic'", "joint"]),
        ({"--grams": "50,no"}, ["--grams '50,no': give 1 or more above 0"]),
        ({"--grams": "50,-1"}, ["give 1 or more above 0"]),
        ({"--grams": "50,50"}, ["a weight stands twice"]),
        ({"--grams": "0.05,0.1,0.2"}, ["the least is 1 g: write 200 for 0.2 kg"]),
        (
            {"--grams": "50", "--repeats": "9"},
            ["--grams, --repeats, --cells: all 18 forces are"],
        ),
        ({"--repeats": "0"}, ["--repeats"]),
        ({"--indenter-mm2": "0"}, ["--indenter-mm2 is 0"]),
        ({"--wires": "-1,2"}, ["--wires says -1 ohm: from 0 to 100000 are likely"]),
        ({"--wires": "100,1e6"}, ["--wires says 1e+06 ohm: from 0 to 100000 are likely"]),
        ({"--leads": "1e9"}, ["--leads says 1e+09 ohm: from 0 to 100000 are likely"]),
        ({"--cells": "0;1"}, ["'0;1' is no cell: write row,column"]),
        ({"--cells": "0,0 1,0"}, ["cell (1, 0) is not on this 1x2 skin"]),
        ({"--cells": "0,0"}, ["too few presses: 3, 5 are needed"]),
        (
            {"--cells": "0,0", "--repeats": "2"},
            ["--cells: all presses are on cell (0, 0): press at least one more"],
        ),
        ({"--redo": "0,2"}, ["cell (0, 2) is not on this 1x2 skin"]),
    ):
        arguments = [word for pair in (good | options).items() for word in pair]
        assert_one_line(run("calibrate", "weights", port, out, *arguments), *words)
    arguments = [word for pair in good.items() for word in pair]
    nowhere = str(tmp_path / "none" / "skin.json")
    done = run("calibrate", "weights", port, nowhere, *arguments)
    assert_one_line(done, "skin.json: cannot be written: say a file in a directory there is")
    table.write_text("row,column,force_n,conductance\n0,0,1,1e-5\n1,1,1,1e-5\n")
    was = table.read_bytes()
    done = run("calibrate", "weights", port, out, *arguments, "--redo", "0,0")
    assert_one_line(done._replace(out=""), "skin.presses.csv: row 3: cell (1, 1) is not on this")
    assert table.read_bytes() == was
    assert not Path(out).exists()
