# SPDX-License-Identifier: Apache-2.0
"""A force sensor: its lines, its port, and ``record --force-port``, which is then calibrated."""

import itertools
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import ohmskin
from command_line import Done, Run, assert_one_line, well
from ohmskin.arrays import Float
from ohmskin.cli.record import PressDisplay
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing
from ohmskin.force.calibration import load_calibration
from ohmskin.link.device import scans_for
from ohmskin.link.messages import Scan
from ohmskin.record.force_sensor import QUEUE_SAMPLES, ForceLineDecoder, ForceSensor
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import ForceSample, load_recording
from scripted_skin import REST, ScriptedSkin, rise
from waiting import until

tty = pytest.importorskip("tty")
pytestmark = pytest.mark.usefixtures("nothing_left")


# --------------------------------------------------------------------------------------- lines


@pytest.mark.parametrize(
    ("line", "forces"),
    [
        (b"12.34\r\n", [12.34]),
        (b"-0.5\n", [-0.5]),
        (b" +3 N\r", [3.0]),
        (b".5N\n", [0.5]),
        (b"1.5e1\n", [15.0]),
        (b"12.3 kg\r\n", [12.3 * 9.80665]),
        # Scales: A&D, CAS, Mettler, Ohaus, Sartorius, Dini Argeo.
        (b"ST,GS,+  123.4 g\r\n", [1.2101406]),
        (b"US,NT,-0.12 kg\r\n", [-1.176798]),
        (b"ST,+00123.45  g\r\n", [1.21063094]),
        (b"US,GS,  5.5\r\n", [5.5]),
        (b"S S     100.00 g\r\n", [0.980665]),
        (b"S D      99.50 g\r\n", [0.97576168]),
        (b"    123.4 g  ?\r\n", [1.2101406]),
        (b"N     +   123.4 g  \r\n", [1.2101406]),
        (b"ST,GS,    123.4,kg\r\n", [1210.14061]),
        # Sketches that print the time first.
        (b"1042,12.3\n", [12.3]),
        (b"1042, -7\n1052;8 g\n1062\t9.5N", [-7.0, 0.0784532]),
        (b"\r\n\r\n", []),
    ],
)
def test_a_line_with_one_number_is_a_force(line: bytes, forces: list[float]) -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"4.2\r\n" + line) == pytest.approx(forces)
    assert decoder.damaged == 0
    doubled = ForceLineDecoder(newtons_per_unit=2.0)
    assert doubled.feed(b"\n" + line) == pytest.approx([2 * force_n for force_n in forces])


@pytest.mark.parametrize(
    "line",
    [
        *(
            b"Reading: 12.3 g",
            b"12.3 lb",
            b"1,5",
            b"1 2",
            b"nan",
            b"1e999",
            b"--1",
            b"\xff",
            b"1_0",
        ),
        *(b".", b"1" * 257, b"x" * 100_000, b"1,2,3", b"1 g,2", b"a,2", b"\xb2", b"1,", b"1,5 g"),
        *(b"OL,GS,+  999.9 g", b"ST,TR,+  123.4 g", b"S I", b"QT,+00000123 PC", b"ST,GS,", b"+"),
    ],
)
def test_another_line_is_counted_and_the_next_is_read(line: bytes) -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"\n" + line + b"\r\n7\r\n") == [7.0]
    assert decoder.damaged == 1


def test_two_numbers_may_be_one_with_a_decimal_comma() -> None:
    """The first of them is a time only if it rises as a time does."""
    decoder = ForceLineDecoder()
    lines = b"".join(b"%d,%d\n" % (150 + 10 * n, n) for n in range(12))
    assert decoder.feed(b"\n" + lines) == [8, 9, 10, 11]
    assert decoder.damaged == 8
    assert decoder.feed(b"1,8421\n3,-2\n4,8425\n") == [-2]  # the sensor was reset
    lines = b"".join(b"%d,%d\n" % (5 + n, n) for n in range(120))
    assert decoder.feed(lines) == list(range(105, 120))


@pytest.mark.parametrize("unit", ["", " g"])
def test_presses_on_a_scale_with_a_decimal_comma_are_no_times(unit: str) -> None:
    """Each lasts for 60 lines, with a pause before and after it."""
    cycles = np.random.default_rng(1).normal(0.5, 0.3, (20, 100))
    cycles[:, 20:80] += np.minimum(10.4 * np.arange(60), 550)
    numbers = [f"{grams:.1f}{unit}\n".replace(".", ",") for grams in cycles.ravel()]
    decoder = ForceLineDecoder(unit="g")
    assert decoder.feed(("\n" + "".join(numbers)).encode()) == []
    assert decoder.damaged == 2000


def test_a_number_with_a_unit_is_no_time_and_force() -> None:
    """As of a scale that is pressed already when it is opened."""
    decoder = ForceLineDecoder()
    assert decoder.feed(b"\n" + b"".join(b"%d,1 g\n" % (100 + n) for n in range(50))) == []
    assert decoder.damaged == 50


def test_a_scale_that_leaves_the_unit_out_is_not_guessed() -> None:
    lines = b"\n100.0 g\n 150.0  \n200.0 g\n"
    decoder = ForceLineDecoder()
    assert decoder.feed(lines) == pytest.approx([0.980665, 1.96133])
    assert (decoder.damaged, decoder.last_damaged) == (1, " 150.0  ")
    told = ForceLineDecoder(unit="g")
    assert told.feed(lines) == pytest.approx([0.980665, 1.4709975, 1.96133])
    assert ForceLineDecoder(unit="kg").feed(lines)[0] == pytest.approx(0.980665)  # as it says
    assert ForceLineDecoder(unit="kg").feed(b"\n1\n") == [9.80665]
    with pytest.raises(ValueError, match="no unit 'lb' of force: there are N, g, kg"):
        ForceLineDecoder(unit="lb")


def test_a_column_is_named_or_numbered() -> None:
    lines = b"\ntime_s, Fx, Fy, Fz\n0.1,1,2,-3.5\n0.2,1,2\n0.3,1,x,-4\n\n0.4,1,2,3,4\n0.5,1,2,z\n"
    named = ForceLineDecoder(-1.0, column="fz")
    assert named.feed(lines) == [3.5, 4.0]
    assert (named.damaged, named.last_damaged) == (3, "0.5,1,2,z")
    numbered = ForceLineDecoder(column="4")
    assert numbered.feed(lines) == [-3.5, -4.0]
    assert numbered.damaged == 4  # the header, too
    for column in ("Fq", "9"):
        decoder = ForceLineDecoder(column=column)
        assert decoder.feed(lines) == []
        assert decoder.damaged == 6


def test_what_a_sensor_prints_first_does_not_hide_its_column() -> None:
    """Such a line told how many fields all others were to have, and no force was read any more."""
    lines = b"0.1,-0.2,12.3\r\n" * 50
    decoder = ForceLineDecoder(column="3")
    assert decoder.feed(b"boot\r\nHX711 ready\r\n" + lines) == [12.3] * 50
    assert decoder.damaged == 1  # the first line may be a part of one
    # Such a line may look like forces: then it takes ten lines to see that it was not.
    decoder = ForceLineDecoder(column="3")
    assert decoder.feed(b"\nversion,1,2,2024\n" + lines) == [2.0, *[12.3] * 41]
    # Damage never lasts so long.
    damaged = b"0.1,-0.2,12.3,5\r\n" * 9
    assert decoder.feed(damaged + lines + damaged) == [12.3] * 50
    for column in ("0", "00"):
        with pytest.raises(ValueError, match="no column 0 of force: the first one is 1"):
            ForceLineDecoder(column=column)


def test_the_first_line_may_be_the_only_header() -> None:
    """So it is where opening the port resets an Arduino. A part of a header names no place."""
    lines = b"\r\n0.1,1,2,-3.5\r\n"
    assert ForceLineDecoder(column="Fz").feed(b"time_s,Fx,Fy,Fz" + lines) == [-3.5]
    for part in (b"Fy,Fz", b"z", b"x,Fy,Fz"):
        assert ForceLineDecoder(column="Fz").feed(part + lines) == []


def test_the_first_line_may_be_a_part_and_counts_for_nothing() -> None:
    decoder = ForceLineDecoder()
    assert decoder.feed(b"x" * 1000) == []
    assert decoder.feed(b"4.1\r\n5.1\r\n6") == [5.1]
    assert decoder.feed(b".1\r") == [6.1]
    assert decoder.damaged == 0


@given(
    st.lists(
        st.sampled_from([b"1.5", b"-2 N", b"x", b"\r\n", b"\n", b"9" * 70, b" "]), max_size=30
    ),
    st.integers(1, 80),
)
def test_lines_do_not_depend_on_how_they_come(pieces: list[bytes], size: int) -> None:
    octets = b"".join([*pieces, b"\n"])
    decoder = ForceLineDecoder()
    found = [
        force_n
        for start in range(0, len(octets), size)
        for force_n in decoder.feed(octets[start : start + size])
    ]
    lines = [line.strip() for line in re.split(rb"[\r\n]", octets)[1:] if line.strip()]
    forces = {b"1.5": 1.5, b"-2 N": -2.0}
    assert found == [forces[line] for line in lines if line in forces]
    assert decoder.damaged == len([line for line in lines if line not in forces])


def test_a_line_without_end_is_damaged_once() -> None:
    decoder = ForceLineDecoder()
    decoder.feed(b"\n")
    for _ in range(1000):
        assert decoder.feed(b"1" * 1000) == []
    assert decoder.damaged == 1
    assert decoder.feed(b"\n3\n") == [3.0]


# ---------------------------------------------------------------------------------------- port


class PtySensor:
    """What a sketch prints at a pseudo-terminal."""

    def __init__(self) -> None:
        self._lock = threading.Lock()  # a closed file's number may soon be another file's
        self._files = list(os.openpty())
        tty.setraw(self._files[1])
        self.path = os.ttyname(self._files[1])

    def print(self, octets: bytes) -> None:
        with self._lock:
            os.write(self._files[0], octets)

    def vanish(self) -> None:
        with self._lock:
            while self._files:
                os.close(self._files.pop())


@pytest.fixture
def sketch() -> Iterator[PtySensor]:
    sensor = PtySensor()
    yield sensor
    sensor.vanish()


def taken(sensor: ForceSensor, count: int) -> list[ForceSample]:
    samples: list[ForceSample] = []
    until(lambda: samples.extend(sensor.take()) or len(samples) >= count)
    assert len(samples) == count
    return samples


def until_lost(sensor: ForceSensor) -> list[ForceSample]:
    """What can be taken before it raises that the sensor is lost."""
    samples: list[ForceSample] = []
    with pytest.raises(DeviceLost):
        until(lambda: samples.extend(sensor.take()))
    return samples


def test_numbers_are_forces_at_their_time(sketch: PtySensor) -> None:
    with ForceSensor(sketch.path, newtons_per_unit=0.00980665) as sensor:
        begin_s = time.monotonic()
        sketch.print(b"7.5\r\n100\r\n")  # the first is perhaps the end of a number
        sensor.wait()
        middle_s = time.monotonic()
        sketch.print(b"-2")
        (first,) = taken(sensor, 1)
        time.sleep(0.02)
        assert sensor.take() == []
        sketch.print(b"50.0\r\n")
        (second,) = taken(sensor, 1)
        end_s = time.monotonic()
    assert first.force_n == pytest.approx(0.980665)
    assert second.force_n == pytest.approx(-2.4516625)
    assert begin_s < first.host_time_s < middle_s < second.host_time_s - 0.02 < end_s
    assert first.source == sketch.path
    assert sensor.damaged == 0


def test_lines_that_arrive_together_have_times_that_rise(sketch: PtySensor) -> None:
    with ForceSensor(sketch.path) as sensor:
        sketch.print(b"\n1\n")
        sensor.wait()
        time.sleep(0.08)
        sketch.print(b"2\n3\n4\n5\n")
        times_s = [sample.host_time_s for sample in taken(sensor, 5)]
        now_s = time.monotonic()
    assert min(after - before for before, after in itertools.pairwise(times_s)) > 0.01
    assert times_s[-1] < now_s


def test_lines_that_are_no_numbers_are_counted(sketch: PtySensor) -> None:
    with ForceSensor(sketch.path, newtons_per_unit=1e300) as sensor:
        sketch.print(b"\nHX711 ready\n1.0\nnan\n1e200\n\n-2e-3\n")
        assert [sample.force_n for sample in taken(sensor, 2)] == [1e300, -2e297]
        assert sensor.damaged == 3  # the text, nan, and what is no number once it is a force


def test_a_sensor_that_falls_silent(sketch: PtySensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.record.force_sensor.SILENCE_TIMEOUT_S", 0.2)
    with ForceSensor(sketch.path) as sensor:
        sketch.print(b"\n1\n")
        samples: list[ForceSample] = []
        while not samples:
            with suppress(DeviceLost):
                samples = sensor.take()
        assert len(samples) == 1
        assert until_lost(sensor) == []


def test_a_sensor_that_vanishes(sketch: PtySensor) -> None:
    with ForceSensor(sketch.path) as sensor:
        sketch.print(b"\n1\n2\n")
        sensor.wait()
        sketch.vanish()
        # What came before is not.
        assert [sample.force_n for sample in until_lost(sensor)] == [1.0, 2.0]
        with pytest.raises(DeviceLost, match="gone: is the force sensor still plugged in"):
            sensor.take()
        with pytest.raises(DeviceLost, match="gone"):
            sensor.wait()


def test_what_nobody_takes_is_bounded_and_counted(sketch: PtySensor) -> None:
    with ForceSensor(sketch.path) as sensor:
        sketch.print(b"\n")
        for block in range(0, QUEUE_SAMPLES + 500, 100):
            sketch.print(b"".join(b"%d\n" % number for number in range(block, block + 100)))
            time.sleep(0.002)
        until(lambda: sensor.dropped == 500)
        samples = sensor.take()
    assert [sample.force_n for sample in samples] == list(range(500, QUEUE_SAMPLES + 500))
    assert sensor.dropped == 500


def test_ports_that_cannot_be_opened(sketch: PtySensor) -> None:
    with pytest.raises(PortError, match="no port /dev/ttyNONE"):
        ForceSensor("/dev/ttyNONE")
    with pytest.raises(PortError, match="/dev/null is no serial port"):
        ForceSensor("/dev/null")
    with (
        ForceSensor(sketch.path),
        pytest.raises(PortError, match="is busy: close the other program"),
    ):
        ForceSensor(sketch.path)
    for scale in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale is"):
            ForceSensor(sketch.path, newtons_per_unit=scale)


# -------------------------------------------------------------------------------- ohmskin record

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
    """Conductances above rest (1, 2) [S]."""
    column, force_n = pressed(time_s)
    return rise(force_n) * (np.arange(2) == column)[None]


class ScriptedSensor(Closing):
    """In place of a `ForceSensor`: what `PRESSES` make by the clock of a scripted skin."""

    STEP_S = 0.025
    damaged = 2

    def __init__(self, skin: ScriptedSkin) -> None:
        self._skin = skin
        self._taken = 0

    def opened(self, *options: object) -> Self:
        assert options == ("scale", 57_600, 2.0, "g", "3")
        return self

    def wait(self) -> None:
        pass

    def take(self) -> list[ForceSample]:
        """Samples until now; the sensor is not quite zeroed."""
        before, self._taken = self._taken, int(self._skin.script_s / self.STEP_S)
        times_s = [self.STEP_S * step for step in range(before + 1, self._taken + 1)]
        return [ForceSample(pressed(at_s)[1] + 0.029, at_s, source="scale") for at_s in times_s]

    def close(self) -> None:
        pass


def scripted() -> ScriptedSkin:
    skin = ScriptedSkin(finger, 40.0)
    skin.begin()
    return skin


def test_a_recorded_force_sensor_calibrates(
    monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path
) -> None:
    out, file = tmp_path / "skin.json", tmp_path / "presses.mcap"
    skin = scripted()
    monkeypatch.setattr(ohmskin, "open", lambda url, start: skin)
    monkeypatch.setattr("ohmskin.cli.record.ForceSensor", ScriptedSensor(skin).opened)
    force = ("--force-port", "scale", "--force-baud", "57600", "--force-scale", "2")
    force += ("--force-unit", "g", "--force-column", "3")
    done = well(run("record", "fast", str(file), *force, "--tare", "1.5", "--seconds", "16.5"))
    assert "touch nothing for 1.5 s" in done.out
    counts = r"presses\.mcap: 66\d scans, missed 0, \d+ bytes, 66\d forces, 2 lines that could"
    assert re.search(counts, done.out)
    recording = load_recording(file)
    assert not recording.cut_off
    assert len(recording.tares) == 1
    times_s = [sample.host_time_s for sample in recording.forces]
    assert times_s == sorted(set(times_s))
    assert max(sample.force_n for sample in recording.forces) == pytest.approx(7.03, abs=0.1)
    assert {sample.source for sample in recording.forces} == {"scale"}

    done = well(run("calibrate", "recording", str(file), str(out), "--indenter-mm2", "100"))
    assert "zero of the force sensor +0.029 N" in done.out
    calibration = load_calibration(out)
    for force_n in (2.0, 5.0):
        above = REST.cell_siemens + rise(force_n) - calibration.rest.level
        seen, _ = calibration.model.predict(above, np.zeros((1, 2)))
        np.testing.assert_allclose(seen, force_n, rtol=0.15)


def test_a_display_counts_what_is_pressed(tmp_path: Path) -> None:
    skin, heads = scripted(), []
    console = Console(width=100)

    def picture() -> list[str]:
        with console.capture() as captured:
            console.print(display.picture())
        return captured.get().splitlines()

    with Recorder(tmp_path / "a.mcap", skin.info) as recorder:
        display = PressDisplay(recorder)
        recorder.add(ForceSample(0.5, 0.0))

        def see(scan: Scan) -> None:
            display.look(scan)
            if scan.number % 4 == 0:
                heads.append(picture()[0])

        record(skin, recorder, scans_for(skin, 8.4), tare_s=1.5, beside=see)
    assert heads[0] == "1 scans   force 0.50 N   touch nothing yet"
    assert any(head.endswith("N   pressed: (0, 1)") for head in heads)
    assert heads[-1].endswith("N   pressed: none")
    assert picture()[-1].split() == ["0", "3", "2"]  # of `PRESSES`, until then


@contextmanager
def speaking(sketch: PtySensor, line: bytes | Callable[[], bytes]) -> Iterator[None]:
    """A sensor prints a line again and again meanwhile, until it vanishes."""
    done = threading.Event()

    def speak() -> None:
        with suppress(IndexError, OSError):
            while not done.wait(0.01):
                sketch.print(line if isinstance(line, bytes) else line())

    thread = threading.Thread(target=speak)
    thread.start()
    yield
    done.set()
    thread.join()


@contextmanager
def once_scans_are_in(recording: Path, act: Callable[[], None]) -> Iterator[None]:
    """Act when scans are in a recording: its file has grown beyond the board's hello."""

    def work() -> None:
        until(recording.exists)
        empty = until(lambda: recording.stat().st_size)
        until(lambda: recording.stat().st_size > empty)
        act()

    thread = threading.Thread(target=work)
    thread.start()
    yield
    thread.join()


@pytest.mark.parametrize("end", ["sensor", "SIGTERM"])
def test_whatever_ends_a_recording_with_forces_it_is_whole(
    run: Run, sketch: PtySensor, tmp_path: Path, end: str
) -> None:
    file = tmp_path / "own.mcap"
    arguments = ("record", "emulator://2x2", str(file), "--force-port", sketch.path)
    stop = {"sensor": sketch.vanish, "SIGTERM": lambda: os.kill(os.getpid(), signal.SIGTERM)}
    with once_scans_are_in(file, stop[end]), speaking(sketch, b"0.1\n"):
        done = run(*arguments)
    if end == "sensor":
        gone = f"{sketch.path} is gone: is the force sensor still plugged in? (what came before is"
        assert_one_line(done._replace(out=""), gone, "own.mcap")
    else:
        assert (done.code, done.err) == (0, "")
    given = load_recording(file)
    assert not given.cut_off
    assert given.scans
    assert given.forces
    assert len(given.tares) == 1


def test_sensors_that_say_nothing(
    run: Run, sketch: PtySensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.record.force_sensor.SILENCE_TIMEOUT_S", 0.5)

    def recorded(force_port: str, *options: str) -> Done:
        file = str(tmp_path / "a.mcap")
        return run("record", "emulator://2x2", file, "--force-port", force_port, *options)

    silent = "for 0.5 s (0 damaged lines): the force sensor must print one number"
    assert_one_line(recorded(sketch.path), silent)
    with speaking(sketch, b"12 lb\n"):
        done = recorded(sketch.path, "--force-baud", "9600")
    assert_one_line(done, "no force from", "damaged lines, the last one '12 lb')", "at 9600 baud")
    assert_one_line(recorded("/dev/ttyNONE"), "no port /dev/ttyNONE")
    assert_one_line(recorded(sketch.path, "--force-scale", "0"), "scale is 0")
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------- ohmskin calibrate scale


def weighed(run: Run, sketch: PtySensor, monkeypatch: pytest.MonkeyPatch, units: float) -> Done:
    """What the command says of a load cell whose numbers are so many units a gram.

    The second weight shows twice the number that it should, if units is below 0.
    """
    on_it, asked = [0.0], list[str]()
    random = np.random.default_rng(1)

    def prompt(text: str, **_: object) -> str:
        asked.append(text)
        mass = re.search(r"put (\d+) g", text)
        on_it[0] = float(mass[1]) * (2 if mass[1] == "500" and units < 0 else 1) if mass else 0.0
        return ""

    def line() -> bytes:
        return b"%d\r\n" % round(84_000 + units * on_it[0] + 20 * random.standard_normal())

    monkeypatch.setattr("typer.prompt", prompt)
    with speaking(sketch, line):
        done = run("calibrate", "scale", sketch.path, "--grams", "200,500")
    assert [text.split(",")[0] for text in asked] == [
        *("take off what is not always on it", "put 200 g on it", "put 500 g on it")
    ]
    return done


def test_two_weights_tell_what_a_number_is(
    run: Run, sketch: PtySensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = well(weighed(run, sketch, monkeypatch, 420.0))
    found = re.search(r"--force-scale (\S+) \(the weights agree within 0\.\d %\)", done.out)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.00980665 / 420, rel=1e-3)
    done = weighed(run, sketch, monkeypatch, -420.0)
    assert_one_line(done, "the weights disagree by", "(200 g: -8", "500 g: -4", "): weigh again")


@pytest.mark.parametrize("grams", ["200", "200,0", "a,b", "200,200", "0.2,0.5"])
def test_a_scale_needs_two_weights(run: Run, grams: str) -> None:
    done = run("calibrate", "scale", "/dev/ttyNONE", "--grams", grams)
    assert_one_line(done, f"--grams '{grams}': ")
