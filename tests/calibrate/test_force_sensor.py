# SPDX-License-Identifier: Apache-2.0
"""A force sensor at a pseudo-terminal: its numbers, its silence, its end."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from ohmskin.calibrate.force_sensor import QUEUE_SAMPLES, ForceSensor
from ohmskin.errors import DeviceLost, PortError
from ohmskin.record.recording import ForceSample

tty = pytest.importorskip("tty")
pytestmark = pytest.mark.usefixtures("nothing_left")


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
    end_s = time.monotonic() + 2.0
    while len(samples) < count and time.monotonic() < end_s:
        samples += sensor.take()
        time.sleep(0.01)
    assert len(samples) == count
    return samples


def until_lost(sensor: ForceSensor) -> list[ForceSample]:
    """What can be taken before it raises that the sensor is lost."""
    samples: list[ForceSample] = []
    end_s = time.monotonic() + 5.0
    while time.monotonic() < end_s:
        try:
            samples += sensor.take()
        except DeviceLost:
            return samples
        time.sleep(0.01)
    pytest.fail("the sensor is never lost")


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
    assert (first.row, first.column, first.source) == (-1, -1, sketch.path)
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


def test_a_silent_sensor(sketch: PtySensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.calibrate.force_sensor.SILENCE_S", 0.2)
    with ForceSensor(sketch.path) as sensor:
        assert sensor.take() == []
        with pytest.raises(DeviceLost, match=r"has said nothing for 0.2 s: is it the force"):
            sensor.wait()
        sketch.print(b"\n1\n")
        end_s = time.monotonic() + 2.0
        samples: list[ForceSample] = []
        while not samples and time.monotonic() < end_s:
            with suppress(DeviceLost):
                samples = sensor.take()
        assert len(samples) == 1
        assert until_lost(sensor) == []


def test_a_sensor_that_prints_no_numbers(
    sketch: PtySensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.calibrate.force_sensor.SILENCE_S", 0.2)
    with ForceSensor(sketch.path, 9600) as sensor:
        sketch.print(b"\n" + b"weight: 12 g\n" * 7)
        end_s = time.monotonic() + 2.0
        while sensor.damaged < 7 and time.monotonic() < end_s:
            time.sleep(0.01)
        with pytest.raises(DeviceLost, match=r"no numbers \(7 damaged lines\).*--baud 9600"):
            sensor.wait()


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
        end_s = time.monotonic() + 2.0
        while sensor.dropped < 500 and time.monotonic() < end_s:
            time.sleep(0.01)
        samples = sensor.take()
    assert [sample.force_n for sample in samples] == list(range(500, QUEUE_SAMPLES + 500))
    assert sensor.dropped == 500


def test_ports_that_cannot_be_opened(sketch: PtySensor) -> None:
    with pytest.raises(PortError, match="no port /dev/ttyNONE"):
        ForceSensor("/dev/ttyNONE")
    with pytest.raises(PortError, match="cannot open /dev/null"):
        ForceSensor("/dev/null")
    with (
        ForceSensor(sketch.path),
        pytest.raises(PortError, match="is busy: close the other program"),
    ):
        ForceSensor(sketch.path)
    for scale in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale is"):
            ForceSensor(sketch.path, newtons_per_unit=scale)
