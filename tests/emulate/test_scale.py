# SPDX-License-Identifier: Apache-2.0
"""The emulated scale: what it prints, and that a force sensor's port reads it."""

import threading
import time

import numpy as np
import pytest

from command_line import Command
from ohmskin.emulate.driver import PtyServer
from ohmskin.emulate.scale import EmulatedScale
from ohmskin.emulate.urls import emulated, scale_under
from ohmskin.errors import PortError
from ohmskin.record.force_sensor import ForceLineDecoder, ForceSensor
from waiting import until


def numbers(scale: EmulatedScale, until_s: float) -> list[float]:
    return ForceLineDecoder().feed(b"\n" + scale.heard(until_s))


def test_it_shows_a_step_through_one_pole() -> None:
    scale = EmulatedScale(lambda time_s: 5.0 * (time_s > 1.0), rate_hz=10, lag_s=0.4, noise_g=0)
    seen = numbers(scale, 2.05)
    assert scale.next_s == pytest.approx(2.1)
    times_s = 0.1 * np.arange(1, 21)
    expected = 5.0 * (1 - np.exp(-np.maximum(times_s - 1.0, 0) / 0.4))
    np.testing.assert_allclose(seen, expected, atol=0.001)


def test_it_prints_as_scales_do() -> None:
    scale = EmulatedScale(lambda time_s: -1.0 * (time_s > 0.5), rate_hz=4, lag_s=0, noise_g=0)
    assert scale.heard(0.6) == 2 * b"ST,GS,+    0.0 g\r\n"
    assert scale.heard(1.0) == b"US,GS,-  102.0 g\r\nST,GS,-  102.0 g\r\n"
    assert scale.heard(1.0) == b""


def test_noise_is_that_of_the_option() -> None:
    with pytest.raises(ValueError, match="and its noise 0 to 1000000 g"):
        EmulatedScale(lambda _: 3.0, noise_g=-1)
    seen_n = numbers(EmulatedScale(lambda _: 3.0, lag_s=0, noise_g=5, seed=1), 300.0)
    assert np.std(seen_n) == pytest.approx(5 * 0.00980665, rel=0.05)
    assert np.mean(seen_n) == pytest.approx(3.0, abs=0.005)


def test_options_of_a_url() -> None:
    url = "emulator://2x2?scene=knead&scale_rate=80&scale_lag=0&scale_noise=0&seed=3"
    _, scene, _ = emulated(url)
    seen_n = numbers(scale_under(scene, url), 12.0)
    wanted_n = [scene.force_n(step / 80).sum() for step in range(1, 961)]
    np.testing.assert_allclose(seen_n, wanted_n, atol=0.0006)
    with pytest.raises(PortError, match="a scale prints"):
        scale_under(scene, "emulator://2x2?scene=knead&scale_rate=0")


def test_a_force_sensors_port_reads_it_from_when_it_is_opened() -> None:
    """What was printed before, while nobody read, is gone as at a real port."""
    board, _, _ = emulated("emulator://2x2")
    scale = EmulatedScale(lambda time_s: 9.0 if time_s < 60 else 1.0, lag_s=0.0, rate_hz=100)
    with PtyServer(board, None, scale) as server:
        server.begin_s -= 59.0
        server.serve(1.2)
        thread = threading.Thread(target=server.serve)
        thread.start()
        with ForceSensor(server.scale_path) as sensor:
            begin_s, seen = time.monotonic(), []
            until(lambda: seen.extend(sensor.take()) or len(seen) > 50)
        server.close()
        thread.join()
    assert sensor.damaged == 0
    assert {round(sample.force_n, 1) for sample in seen} == {1.0}
    assert min(sample.host_time_s for sample in seen) > begin_s - 0.1


def test_the_command_serves_both(command: Command) -> None:
    process = command("emulate", "emulator://2x2?scene=knead&begin=0&scale_rate=50")
    board, scale = process.stdout.readline().strip(), process.stdout.readline().strip()
    assert board != scale
    with ForceSensor(scale) as sensor:
        sensor.wait()
        assert sensor.take()
    process.kill()
    process.communicate()
