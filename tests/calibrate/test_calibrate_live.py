# SPDX-License-Identifier: Apache-2.0
"""``calibrate weights`` and ``sensor``: a scripted person presses a simulated skin.

Time is simulated and runs as fast as the scans are taken; what is left to real time is short.
"""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from rich.console import Console
from test_force_sensor import PtySensor, sketch

from command_line import Done, assert_one_line
from ohmskin.arrays import Float
from ohmskin.calibrate.guide import Ask, Guide
from ohmskin.calibrate.press_table import load_press_table
from ohmskin.calibrate.press_watch import PressWatch
from ohmskin.circuit.skin import readings
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.scenes import Scene
from ohmskin.errors import DeviceLost
from ohmskin.force.calibration import load_calibration
from ohmskin.link import framing, protocol
from ohmskin.link.messages import BoardDecoder, Hello, Scan
from ohmskin.link.serial_port import PausableLink
from ohmskin.record.recording import load_recording

__all__ = ["sketch"]

Run = Callable[..., Done]
# From when on [s], the cells, and the force on each [N].
Script = Sequence[tuple[float, Sequence[tuple[int, int]], float]]

GRAMS = (50, 200, 1000)
TOLD = ("--indenter-mm2", "100")
CELLS = ((0, 0), (0, 1))
PUT_S, OFF_S = 2.2, 0.8


def newtons(mass_g: float) -> float:
    return 9.80665e-3 * mass_g


def rise(force_n: float) -> float:
    """Conductance above rest of every cell that has crept [S]."""
    return 30e-6 * force_n**1.7


class Skin:
    """A 1x2 skin on which somebody puts weights by a script; what is put on creeps for a while.

    begin_s: when, by the board's clock, the script begins.
    """

    def __init__(self, script: Script) -> None:
        self.rest = Scene("rest", 1, 2, seed=1).skin(0.0)
        self.begin_s = float("inf")
        self._script = script

    def ratio(self, time_s: float) -> Float:
        now = [step for step in self._script if step[0] <= time_s - self.begin_s]
        siemens = self.rest.cell_siemens.copy()
        if now:
            put_s, cells, force_n = now[-1]
            share = 1 - 0.15 * np.exp((put_s - (time_s - self.begin_s)) / 0.4)
            for cell in cells:
                siemens[cell] += rise(force_n) * share
        return readings(replace(self.rest, cell_siemens=siemens))


class FastLink:
    """An emulated board whose time goes on whenever a scan is wanted.

    From `begin` on somebody acts: presses Ctrl-C after interrupt_s, and pulls the plug after end_s.
    """

    def __init__(self, board: EmulatedBoard, skin: Skin, interrupt_s: float, end_s: float) -> None:
        self.name = "fast"
        self._board = board
        self._skin = skin
        self._interrupt_s = interrupt_s
        self._end_s = end_s
        self._wake = threading.Condition()
        self._paused = True
        self._waiting = bytearray()

    def read(self) -> bytes:
        with self._wake:
            if not self._waiting:
                due = self._board.next_scan_s
                if due is None or self._paused:
                    self._wake.wait(0.02)
                elif due - self._skin.begin_s >= self._end_s:
                    raise DeviceLost("the script is over")
                elif due - self._skin.begin_s >= self._interrupt_s:
                    self._interrupt_s = float("inf")
                    self._paused = True
                    os.kill(os.getpid(), signal.SIGINT)
                else:
                    self._waiting += self._board.advance(due)
            octets = bytes(self._waiting)
            self._waiting.clear()
            return octets

    def begin(self) -> None:
        with self._wake:
            self._skin.begin_s = self._board.now_s

    def write(self, octets: bytes) -> None:
        with self._wake:
            self._board.receive(octets)
            self._waiting += self._board.advance(self._board.now_s)
            self._wake.notify_all()

    def pause(self, paused: bool) -> None:
        with self._wake:
            self._paused = paused
            self._wake.notify_all()

    def set_baud(self, baud: int) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def weigh(monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path) -> Callable[..., Done]:
    """A function that runs the command for `OUT` while somebody acts by a script."""

    def call(script: Script, *options: str, interrupt_s: float = float("inf")) -> Done:
        skin = Skin(script)
        board = EmulatedBoard(skin.ratio, 1, 2, rate_hz=10, noise_lsb=0.3, unit_id=7)
        link = FastLink(board, skin, interrupt_s, end_s=script[-1][0] + 5 if script else 0.0)
        assert isinstance(link, PausableLink)

        class Watched(Guide):
            def __init__(self, asked: list[Ask]) -> None:
                super().__init__(asked)
                link.begin()  # the rest before it is read ahead, as far as the machine likes

        monkeypatch.setattr("ohmskin.cli.calibrate_live.Guide", Watched)
        monkeypatch.setattr("ohmskin.opening.open_link", lambda url: (link, None))
        out = str(tmp_path / "skin.json")
        return run("calibrate", "weights", "fast", out, *TOLD, *options)

    return call


def putting(presses: Sequence[tuple[tuple[int, int], float]], begin_s: float = 0.5) -> Script:
    """A script: each cell and mass [g] for a while, one after another."""
    steps: list[tuple[float, Sequence[tuple[int, int]], float]] = []
    for cell, mass_g in presses:
        steps.append((begin_s, [cell], newtons(mass_g)))
        steps.append((begin_s + PUT_S, [], 0.0))
        begin_s += PUT_S + OFF_S
    return steps


ASKED = [(cell, mass_g) for cell in CELLS for mass_g in GRAMS]
OPTIONS = ("--grams", "50,200,1000", "--repeats", "1")


def pairs_of(path: Path) -> list[tuple[tuple[int, int], int]]:
    table = load_press_table(path)
    cells = zip(table.row.tolist(), table.column.tolist(), strict=True)
    masses_g = np.rint(table.force_n / 9.80665e-3).astype(int).tolist()
    return list(zip(cells, masses_g, strict=True))


@pytest.mark.usefixtures("nothing_left")
def test_weights_are_asked_for_had_and_learned(weigh: Callable[..., Done], tmp_path: Path) -> None:
    out, table = tmp_path / "skin.json", tmp_path / "skin.presses.csv"
    # The fourth weight is first put on the wrong cell, then beside a hand.
    script = [*putting(ASKED[:3])]
    begin_s = script[-1][0] + OFF_S
    script += [(begin_s, [(0, 0)], newtons(50)), (begin_s + 2, list(CELLS), newtons(50))]
    script += putting(ASKED[3:], begin_s + 4)

    done = weigh(script, *OPTIONS, interrupt_s=begin_s + 4 + 1.2 * PUT_S)
    assert (done.code, done.err) == (130, "")
    lines = done.out.splitlines()
    assert lines[0] == "take everything off the skin: its rest is measured, 1 s"
    assert re.fullmatch(r"rest: \d\.\d\d to \d\.\d\d microsiemens", lines[1])
    assert lines[2] == "put 50 g (0.490 N) on cell (0, 0), row 0, column 0"
    assert re.fullmatch(r"1 of 6: .*microsiemens above rest: take it off", lines[3])
    wrong = lines.index("cell (0, 0) is pressed: put the weight on (0, 1) alone")
    assert lines[wrong - 1] == "put 50 g (0.490 N) on cell (0, 1), row 0, column 1"
    assert "cells (0, 0), (0, 1) are pressed: put the weight on (0, 1) alone" in lines[wrong:]
    assert lines[-1] == f"4 of 6 presses are in {table}: the same command goes on"
    assert pairs_of(table) == ASKED[:4]
    assert not out.exists()

    done = weigh(putting(ASKED[4:]), *OPTIONS)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[2] == "put 200 g (1.961 N) on cell (0, 1), row 0, column 1"
    assert "held-out error" in done.out
    assert f"{out}: calibration of unit 7" in done.out
    assert pairs_of(table) == ASKED

    rest = Skin([]).rest.cell_siemens
    kept = load_press_table(table)
    truth = rest[kept.row, kept.column] + rise(kept.force_n)
    # Creep has not quite ended, and wires of 300 ohm are not told apart from a cell of 700.
    np.testing.assert_allclose(kept.conductance, truth, rtol=0.12)
    assert (kept.conductance_std > 0).all()
    assert (kept.conductance_std < 0.02 * kept.conductance).all()
    calibration = load_calibration(out)
    assert (calibration.unit_id, calibration.method) == (7, "joint")
    assert calibration.indenter_area_m2 == pytest.approx(1e-4)
    for mass_g in (100, 500):
        force_n, _ = calibration.predict(rest + rise(newtons(mass_g)), np.zeros((1, 2)))
        np.testing.assert_allclose(force_n, newtons(mass_g), rtol=0.1)

    # Cells that are redone: asked again, the others kept.
    before = load_press_table(table)
    done = weigh(putting(ASKED[:3]), *OPTIONS, "--redo", "0,0", interrupt_s=0.5 + PUT_S)
    assert done.code == 130
    assert f"4 of 6 presses are in {table}: the same command without --redo goes on" in done.out
    assert pairs_of(table) == [*ASKED[3:], ASKED[0]]
    done = weigh(putting(ASKED[1:3]), *OPTIONS)
    assert done.code == 0
    after = load_press_table(table)
    assert sorted(pairs_of(table)) == sorted(ASKED)
    assert after.conductance[:3].tolist() == before.conductance[3:].tolist()


def test_a_full_table_is_fitted_at_once(weigh: Callable[..., Done], tmp_path: Path) -> None:
    table, out = tmp_path / "mine.csv", tmp_path / "skin.json"
    rest = Skin([]).rest.cell_siemens
    lines = ["row,column,force_n,conductance"]
    lines += [
        f"0,{column},{newtons(mass_g)},{rest[0, column] + rise(newtons(mass_g))}"
        for (_, column), mass_g in ASKED
    ]
    table.write_text("\n".join(lines) + "\n")
    done = weigh([], *OPTIONS, "--table", str(table))
    assert (done.code, done.err) == (0, "")
    assert "put" not in done.out
    assert load_calibration(out).columns == 2
    # What cannot be fitted leaves the calibration as it was, and the table.
    was, of_table = out.read_bytes(), table.read_text()
    table.write_text(of_table.replace(f"{newtons(1000)},", f"{newtons(1000)},-"))
    done = weigh([], *OPTIONS, "--table", str(table))
    assert_one_line(done, "mine.csv: row 4: conductance is -")
    assert out.read_bytes() == was


def test_wrong_uses_of_weights(run: Run, tmp_path: Path) -> None:
    out, port = str(tmp_path / "skin.json"), "emulator://1x2"
    table = tmp_path / "skin.presses.csv"
    good = {"--grams": "50,100,200", "--indenter-mm2": "100"}
    for options, words in (
        ({"--method": "voltage"}, ["presses are kept as conductances, which 'voltage'"]),
        ({"--method": "magic"}, ["no method 'magic'", "joint"]),
        ({"--grams": "50,no"}, ["--grams '50,no': give weights above 0"]),
        ({"--grams": "50,-1"}, ["give weights above 0"]),
        ({"--grams": "50,50"}, ["stands twice: say --repeats"]),
        ({"--grams": "50", "--repeats": "9"}, ["give two or more in --grams"]),
        ({"--repeats": "0"}, ["--repeats is 0"]),
        ({"--indenter-mm2": "0"}, ["--indenter-mm2 is 0"]),
        ({"--top-wire": "-1"}, ["--top-wire is -1"]),
        ({"--cells": "0;1"}, ["'0;1' is no cell: write row,column"]),
        ({"--cells": "0,0 1,0"}, ["cell (1, 0) is not on this 1x2 skin"]),
        ({"--cells": "0,0"}, ["one cell does not tell how much cells differ"]),
        ({"--cells": "0,0", "--repeats": "1"}, ["3 presses are too few: 5 are needed"]),
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
    assert_one_line(replace(done, out=""), "skin.presses.csv: row 3: cell (1, 1) is not on this")
    assert table.read_bytes() == was
    assert not Path(out).exists()


# -------------------------------------------------------------------------------------- sensor

# When a press begins [s], the cell, the force [N]: at irregular intervals.
PRESSES = (
    (1.6, 0, 1.0),
    (3.0, 1, 4.0),
    (4.1, 0, 7.0),
    (5.8, 1, 1.5),
    (6.9, 0, 2.5),
    (8.6, 1, 6.0),
    (9.8, 0, 4.5),
    (11.4, 1, 3.0),
    (12.5, 0, 1.8),
    (14.6, 1, 5.2),
)
PRESS_S = 0.8


def pressed(time_s: float) -> tuple[int, float]:
    """Which column is pressed, and its force [N]: up, hold, down, each a third."""
    for begin_s, column, force_n in PRESSES:
        share = (time_s - begin_s) / PRESS_S
        if 0 <= share < 1:
            return column, force_n * min(3 * share, 1.0, 3 - 3 * share)
    return 0, 0.0


def finger(time_s: float) -> Float:
    skin = Scene("rest", 1, 2, seed=1).skin(0.0)
    column, force_n = pressed(time_s)
    siemens = skin.cell_siemens.copy()
    siemens[0, column] += rise(force_n)
    return readings(replace(skin, cell_siemens=siemens))


class ScriptedSensor:
    """A force sensor as a `Link`; `say` returns when what it said is read and kept."""

    def __init__(self) -> None:
        self.name = "scale"
        self._wake = threading.Condition()
        self._line = b""
        self._said = self._taken = self._kept = 0
        self._open = False

    def opened(self, path: str, baud: int) -> Self:
        assert (path, baud) == ("scale", 57_600)
        self._open = True
        return self

    def say(self, line: bytes) -> None:
        with self._wake:
            if self._open:
                self._line, self._said = line, self._said + 1
                self._wake.notify_all()
                self._wake.wait_for(lambda: self._kept == self._said or not self._open, 1.0)

    def read(self) -> bytes:
        with self._wake:
            self._kept = self._taken
            self._wake.notify_all()
            self._wake.wait_for(lambda: self._taken < self._said or not self._open, 0.05)
            line = self._line if self._taken < self._said else b""
            self._taken = self._said
            return line

    def close(self) -> None:
        with self._wake:
            self._open = False
            self._wake.notify_all()


class TimedLink(FastLink):
    """A `FastLink` that is all clocks at once: `clock_s`. A force sensor speaks meanwhile."""

    STEP_S = 0.025

    def __init__(self, board: EmulatedBoard, sensor: ScriptedSensor) -> None:
        super().__init__(board, Skin([]), float("inf"), float("inf"))
        self._sensor = sensor
        self.clock_s = 0.0

    def read(self) -> bytes:
        with self._wake:
            due = self._board.next_scan_s
            if not self._waiting and not (due is not None and self._paused):
                until_s = self.clock_s + self.STEP_S if due is None else due
                while (next_s := self.clock_s + self.STEP_S) <= until_s:
                    self.clock_s = next_s
                    mass_g = pressed(next_s)[1] / newtons(1) + 3  # not quite zeroed
                    self._sensor.say(b"%.2f\r\n" % mass_g)
                self._waiting += self._board.advance(until_s)
            return super().read()


@pytest.mark.usefixtures("nothing_left")
def test_a_force_sensor_calibrates(
    monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path
) -> None:
    out, sensor = tmp_path / "skin.json", ScriptedSensor()
    board = EmulatedBoard(finger, 1, 2, rate_hz=40, noise_lsb=0.3, unit_id=7)
    link = TimedLink(board, sensor)
    monkeypatch.setattr("ohmskin.opening.open_link", lambda url: (link, None))
    monkeypatch.setattr("ohmskin.calibrate.force_sensor.SerialLink", sensor.opened)
    monkeypatch.setattr(time, "monotonic", lambda: link.clock_s)
    found = run(
        *("calibrate", "sensor", "fast", "scale", str(out), *TOLD, "--seconds", "16.5"),
        *("--scale", "0.00980665", "--rest", "1.5", "--baud", "57600"),
    )
    assert (found.code, found.err) == (0, "")
    assert "touch nothing for 1.5 s" in found.out
    assert re.search(r"skin.mcap: \d+ scans, missed 0\n", found.out)
    assert "zero of the force sensor +0.029 N" in found.out

    recording = load_recording(tmp_path / "skin.mcap")
    assert not recording.cut_off
    assert len(recording.tares) == 1
    times_s = [sample.host_time_s for sample in recording.forces]
    assert times_s == sorted(set(times_s))
    assert max(sample.force_n for sample in recording.forces) == pytest.approx(7.03, abs=0.1)
    assert {sample.source for sample in recording.forces} == {"scale"}

    calibration = load_calibration(out)
    rest = Scene("rest", 1, 2, seed=1).skin(0.0).cell_siemens
    for force_n in (2.0, 5.0):
        seen, _ = calibration.predict(rest + rise(force_n), np.zeros((1, 2)))
        np.testing.assert_allclose(seen, force_n, rtol=0.15)


@contextmanager
def speaking(sketch: PtySensor, line: Callable[[], bytes]) -> Iterator[None]:
    """A sensor prints lines meanwhile, until it vanishes."""
    done = threading.Event()

    def speak() -> None:
        with suppress(IndexError, OSError):
            while not done.wait(0.01):
                sketch.print(line())

    thread = threading.Thread(target=speak)
    thread.start()
    yield
    done.set()
    thread.join()


def wait_for_scans(recording: Path) -> None:
    """Return when scans are in a recording: its file has grown beyond the board's hello."""
    sizes: set[int] = set()
    end_s = time.monotonic() + 20
    while len(sizes) < 2 and time.monotonic() < end_s:
        time.sleep(0.02)
        if recording.exists() and recording.stat().st_size:
            sizes.add(recording.stat().st_size)


def test_a_sensor_that_fails_leaves_a_recording(
    run: Run, sketch: PtySensor, tmp_path: Path
) -> None:
    out, recording = tmp_path / "skin.json", tmp_path / "own.mcap"
    arguments = ("calibrate", "sensor", "emulator://2x2", sketch.path, str(out), *TOLD)

    def vanish() -> None:
        wait_for_scans(recording)
        sketch.vanish()

    thread = threading.Thread(target=vanish)
    thread.start()
    with speaking(sketch, lambda: b"0.1\n"):
        found = run(*arguments, "--recording", str(recording))
    thread.join()
    assert_one_line(
        replace(found, out=""),
        f"{sketch.path} is gone: is the force sensor still plugged in?",
        "own.mcap, for 'ohmskin calibrate recording'",
    )
    given = load_recording(recording)
    assert not given.cut_off
    assert given.scans
    assert given.forces
    assert not out.exists()
    assert_one_line(run(*arguments, "--recording", str(recording)), "own.mcap is there already")


def test_sensors_that_say_nothing(
    run: Run, sketch: PtySensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.calibrate.force_sensor.SILENCE_S", 0.3)
    out = str(tmp_path / "skin.json")

    def calibrate(port: str, *options: str) -> Done:
        return run("calibrate", "sensor", "emulator://2x2", port, out, *TOLD, *options)

    assert_one_line(calibrate(sketch.path), "has said nothing for 0.3 s", "does its sketch print?")
    with speaking(sketch, lambda: b"12 g\n"):
        done = calibrate(sketch.path, "--baud", "9600")
    assert_one_line(done, "prints no numbers (", "damaged lines)", "--baud 9600")
    for arguments, words in (
        (("/dev/ttyNONE",), ["no port /dev/ttyNONE"]),
        ((sketch.path, "--scale", "0"), ["scale is 0"]),
        ((sketch.path, "--rest", "0"), ["--rest is 0"]),
        ((sketch.path, "--seconds", "9"), ["--seconds is 9, 15 are needed"]),
        ((sketch.path, "--method", "magic"), ["no method 'magic'"]),
    ):
        assert_one_line(calibrate(*arguments), *words)
    assert list(tmp_path.iterdir()) == []


def test_sigterm_ends_a_recording_whole(run: Run, sketch: PtySensor, tmp_path: Path) -> None:
    out, recording = tmp_path / "skin.json", tmp_path / "skin.mcap"

    def end() -> None:
        wait_for_scans(recording)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=end)
    thread.start()
    with speaking(sketch, lambda: b"%.2f\n" % (time.monotonic() % 1)):
        found = run("calibrate", "sensor", "emulator://1x2", sketch.path, str(out), *TOLD)
    thread.join()
    # So short a time tells no force.
    assert_one_line(replace(found, out=""), "skin.mcap: ", "15 s are needed")
    given = load_recording(recording)
    assert not given.cut_off
    assert len(given.tares) == 1
    assert given.forces
    assert not out.exists()


def test_a_watch_counts_what_is_pressed() -> None:
    board = EmulatedBoard(finger, 1, 2, noise_lsb=0.3)
    hello, scans = say(board, 8.4)
    watch = PressWatch(hello, 1.5)
    looks = sum(watch.see(scan, 0.5 if scan.number < 100 else None) for scan in scans)
    assert 50 < looks < 90
    assert watch.counts.tolist() == [[3, 2]]  # of `PRESSES`, until then
    console = Console(width=100)
    with console.capture() as captured:
        console.print(watch.table())
    lines = captured.get().splitlines()
    assert lines[0] == f"8 s   {len(scans)} scans   force 0.50 N   pressed: none"
    assert lines[-1].split() == ["0", "3", "2"]


def say(board: EmulatedBoard, seconds: float) -> tuple[Hello, list[Scan]]:
    """What a board says of itself, and its scans, heard as soon as they are complete."""
    decoder = BoardDecoder()
    (hello,) = (each for each in decoder.feed(board.advance(0.0), 0.0) if isinstance(each, Hello))
    start = protocol.FRAMES["start"]
    board.receive(framing.encode(start.id, 1, start.pack()))
    scans: list[Scan] = []
    while (end_s := board.next_scan_s) is None or end_s <= seconds:
        scans += [
            each
            for each in decoder.feed(board.advance(end_s or 0.0), end_s or 0.0)
            if isinstance(each, Scan)
        ]
    return hello, scans
