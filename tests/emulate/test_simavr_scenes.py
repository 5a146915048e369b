# SPDX-License-Identifier: Apache-2.0
"""Boards of the AVR simulator that are opened by a URL: their scenes, EEPROM and leads."""

import os
import signal
import time
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from command_line import Command
from ohmskin.circuit.skin import readings
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.emulate.simavr import SimavrLink
from ohmskin.errors import PortError
from ohmskin.link.codes import quantise
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan

pytestmark = [pytest.mark.simavr, pytest.mark.usefixtures("nothing_left")]


def take(skin: Device, count: int) -> list[Scan]:
    return list(islice(skin, count))


def test_a_moving_scene_moves_in_the_simulator_too() -> None:
    with ohmskin.open("simavr://uno?scene=moving") as skin:
        codes = [scan.codes for scan in take(skin, 360)]  # touched after 3 s
    assert (codes[0] != codes[-1]).any()


def test_a_scene_begins_untouched_in_the_simulator_too() -> None:
    with ohmskin.open("simavr://uno?scene=single&begin=1") as skin:
        codes = [scan.codes for scan in take(skin, 180)]
    scene = Scene("single", 8, 8)
    for found, expected in ((codes[0], scene.rest_ratio), (codes[-1], scene.ratio(BEGIN_S))):
        np.testing.assert_allclose(found, quantise(expected), rtol=0, atol=1)


def test_the_simulator_says_which_forces_a_scan_has_read() -> None:
    same_skin = Scene("weights", 2, 2)
    with ohmskin.open("simavr://uno?scene=presses&begin=0&rows=2&columns=2", start=False) as skin:
        skin.configure(rows=2, columns=2)
        scans = take(skin, 270)
        assert skin.true_force_n is not None
        force_n = np.array([skin.true_force_n(scan) for scan in scans])
    peaks_n = set()
    # Two scans on either side have the same forces: on a busy machine, a change that is said to be
    # of one scan may have come amid the scan before it.
    around_n = np.lib.stride_tricks.sliding_window_view(force_n, 5, axis=0)
    for near_n, now, scan in zip(around_n, force_n[2:], scans[2:], strict=False):
        if now.any() and (near_n == now[..., None]).all():  # it does not change
            peaks_n.add(now.max())
            same_skin.put(((0, 0), now[0, 0]))  # the robot presses this cell for 4 s
            np.testing.assert_allclose(scan.codes, quantise(same_skin.ratio(0.0)), rtol=0, atol=1)
    assert len(peaks_n) > 2


def test_what_a_scan_has_read_can_be_asked_while_the_skin_moves() -> None:
    """The thread of a session reads meanwhile."""

    class Meanwhile(float):
        def __ge__(self, other: float) -> bool:
            time.sleep(0.03)  # longer than a skin is shown
            link.read()
            return super().__ge__(other)

    with closing(SimavrLink("uno", Scene("moving", begin_s=0.0))) as link:
        assert link.scene_s(Meanwhile(9.0)) >= 0.0
        assert link.scene_s(Meanwhile(-1.0)) == 0.0


def test_a_slip_is_too_fast_for_a_skin_that_is_told_now_and_then() -> None:
    """It was taken: its 200 Hz were shown as 45 Hz, and larger."""
    with pytest.raises(PortError, match=r"too fast .*: take emulator://8x8\?scene=slip"):
        ohmskin.open("simavr://uno?scene=slip&begin=0")


def test_a_weight_can_be_put_on_a_simulated_skin() -> None:
    with ohmskin.open("simavr://uno?scene=weights&rows=2&columns=2", start=False) as skin:
        skin.configure(rows=2, columns=2)
        assert skin.put is not None
        codes = []
        for weight in (None, ((0, 1), 3.0), None):
            skin.put(weight)
            codes.append(take(skin, 40)[-1].codes.astype(int))
    change = np.abs(codes[1] - codes[0]).max(axis=2)
    assert np.unravel_index(change.argmax(), change.shape) == (0, 1)
    assert change.max() > 100
    np.testing.assert_allclose(codes[2], codes[0], rtol=0, atol=1)


def test_the_simulator_keeps_its_eeprom_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "board.eeprom"
    url = f"simavr://uno?eeprom={path}"
    with ohmskin.open(url, start=False) as skin:
        skin.configure(rows=3, columns=5)
        skin.set_unit_id(7)
        skin.save()
        skin.configure(rows=2, columns=2)  # not saved
    assert path.stat().st_size == 1024
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    with ohmskin.open(url, start=False) as skin:
        assert (skin.info.rows, skin.info.columns, skin.info.unit_id) == (3, 5, 7)
    for wrong, reason in (
        (url.replace("uno", "megaatmega2560"), "is no EEPROM of this board"),
        (f"simavr://uno?eeprom={tmp_path}/no/board", "cannot be written"),
    ):
        with pytest.raises(PortError, match=reason):
            ohmskin.open(wrong)


def test_ctrl_c_keeps_the_simulator_s_eeprom(tmp_path: Path, command: Command) -> None:
    """A terminal sends it to all processes that a command has started."""
    path = tmp_path / "board.eeprom"
    process = command("stream", f"simavr://uno?eeprom={path}", start_new_session=True)
    assert process.stdout is not None
    process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)
    process.communicate()
    assert path.stat().st_size == 1024


@pytest.mark.parametrize("lines", ["", "&line_pf=1"])
def test_the_simulator_has_leads_in_its_table_and_in_its_lines(lines: str) -> None:
    """Without capacitances it reads the table, with them a circuit. 6 kOhm are 30 codes."""
    with ohmskin.open(f"simavr://uno?scene=single&begin=0&lead=3000{lines}") as skin:
        codes = take(skin, 5)[-1].codes
    touched = replace(Scene("single", 8, 8).skin(BEGIN_S), lead_ohm=np.array(3000.0))
    np.testing.assert_allclose(codes, quantise(readings(touched)), rtol=0, atol=1)
