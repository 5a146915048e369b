# SPDX-License-Identifier: Apache-2.0
"""Where reading goes after each scan."""

import time
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from ohmskin.arrays import Bool
from ohmskin.errors import CommandRefused, DeviceLost
from ohmskin.force.focus import WHOLE_HZ, Focus, Lines, wanted_lines
from ohmskin.force.reader import SkinReader
from ohmskin.link.device import Region, scans_for
from ohmskin.link.messages import Hello
from ohmskin.record.recorder import Recorder, record
from stepped import stepped
from studies.judge import STATED_STDS


def touched(*cells: tuple[int, int], shape: tuple[int, int] = (8, 8)) -> Bool:
    found = np.zeros(shape, dtype=bool)
    for cell in cells:
        found[cell] = True
    return found


def test_nothing_touched_is_read_whole() -> None:
    assert wanted_lines(touched(), None) is None
    assert wanted_lines(touched(), Lines(range(3), range(3))) is None


@pytest.mark.parametrize(
    ("cells", "rows", "columns"),
    [
        ([(3, 4)], range(2, 5), range(3, 6)),
        ([(0, 7)], range(2), range(6, 8)),
        ([(2, 2), (3, 4)], range(1, 5), range(1, 6)),
    ],
)
def test_a_region_has_a_margin_where_there_are_lines(
    cells: list[tuple[int, int]], rows: range, columns: range
) -> None:
    assert wanted_lines(touched(*cells), None) == Lines(rows, columns)


def test_two_touches_far_apart_are_read_whole() -> None:
    assert wanted_lines(touched((0, 0), (7, 7)), None) is None


def test_a_region_stays_while_it_holds_what_is_touched_and_little_more() -> None:
    before = Lines(range(2, 6), range(3, 6))
    assert wanted_lines(touched((3, 4)), before) == before
    assert wanted_lines(touched((4, 4)), before) == before
    # A finger that comes near its edge moves it; one that became small shrinks it.
    assert wanted_lines(touched((5, 4)), before) == Lines(range(4, 7), range(3, 6))
    wide = Lines(range(1, 6), range(3, 6))
    assert wanted_lines(touched((3, 4)), wide) == Lines(range(2, 5), range(3, 6))


def test_a_contact_that_is_new_in_a_region_is_looked_at_by_a_whole_scan() -> None:
    """It may be the ghost of touches outside of the region."""
    asked: list[Region] = []
    info = replace(stepped("emulator://8x8").info, whole_scan_cycles=177_000)

    def set_region(region: Region) -> Hello:
        asked.append(region)
        return info

    focus = Focus(SimpleNamespace(info=info, set_region=set_region))
    assert (asked.pop().rows, asked) == (None, [])
    whole, some = SimpleNamespace(is_whole=True), SimpleNamespace(is_whole=False)
    focus.follow(touched((3, 4)), 1, whole)
    focus.follow(touched((3, 4)), 1, some)
    # Twice, where the board has said how long its scans take.
    assert {(region.rows, region.mode) for region in asked} == {(range(2, 5), "near")}
    focus.follow(touched((3, 4), (3, 6)), 2, some)
    assert (asked[-1].rows, asked[-1].mode) == (None, "near")
    focus.follow(touched((3, 4), (3, 6)), 2, whole)
    assert (asked[-1].columns, asked[-1].mode) == (range(3, 8), "near")
    # Three touches outside that close a rectangle show as a cross. A finger that moves along one of
    # the layers is followed.
    cross = touched((3, 4), (3, 5), (2, 4), (4, 4))
    for cells, rows in ((touched((3, 4)), range(2, 5)), (cross, None), (cross, range(1, 6))):
        focus.follow(cells, 1, some if rows is None else whole)
        assert asked[-1].rows == rows
    focus.follow(touched((2, 4), (6, 4)), 1, some)
    assert asked[-1].rows == range(1, 8)
    # What it reads cannot come from the region alone.
    focus.follow(touched((2, 4), (6, 4)), 1, some, is_doubted=True)
    assert asked[-1].rows is None


@pytest.mark.parametrize("settle_us", [0, 20])
@pytest.mark.parametrize("size", [3, 5])
def test_whole_scans_come_as_often_whatever_a_region_takes(size: int, settle_us: int) -> None:
    skin = stepped("emulator://8x8?scene=single&begin=0")
    like = Region(mode="quick", whole_mode="near", settle_us=settle_us)
    with Focus(skin, like) as focus:
        cells = touched(*((row, row) for row in range(2, size)))
        focus.follow(cells, 1, next(iter(skin)))
        board = skin.info
    assert (board.row_mask.bit_count(), board.settle_us > 90) == (size, settle_us == 0)
    period = board.whole_every * board.scan_cycles + board.whole_scan_cycles - board.scan_cycles
    assert 0.9 / WHOLE_HZ < period / board.clock_hz < 1.1 / WHOLE_HZ


def test_who_has_followed_contacts_leaves_the_board_as_it_was() -> None:
    skin = stepped("emulator://8x8?scene=single&begin=0")
    before = skin.configure(rate_hz=50, settle_us=30)
    with Focus(skin) as focus:
        focus.follow(touched((3, 4)), 1, next(iter(skin)))
        assert (skin.info.mode, skin.info.row_mask) == ("near", 0b11100)
    focus.follow(touched((5, 4)), 1, next(iter(skin)))
    assert skin.info == replace(before, scanning=1)


def test_focus_is_refused_for_a_method_that_takes_no_regions() -> None:
    """It was opened, and ended in the middle, when the first touch came."""
    of_skin = of_scene("rest", method="voltage", siemens=0.1)
    with pytest.raises(
        ValueError, match="'voltage' takes whole scans, and focus reads parts: leav"
    ):
        ohmskin.open("emulator://8x8", calibration=of_skin, focus=True)


def test_a_method_that_takes_no_regions_is_not_chosen_while_contacts_are_followed() -> None:
    """The next scan of a region raised: the page lost its board, and a recording its end."""
    skin = stepped("emulator://8x8?scene=single&begin=0")
    reader = SkinReader(skin.info, of_scene("rest", method="voltage", siemens=0.1), method="touch")
    with reader.focus_on(skin) as reader.focus:
        with pytest.raises(ValueError, match="'voltage' takes whole scans, and focus reads parts"):
            reader.use("voltage")
        assert {reader.read(scan).is_whole for scan in islice(skin, 9)} == {True, False}
        reader.use("ohm")
    reader.focus = None
    reader.use("voltage")


@pytest.mark.parametrize(("told_us", "settle_us"), [(0, 100), (40, 40)])
def test_lines_that_take_time_to_settle_have_it_in_a_region(told_us: int, settle_us: int) -> None:
    """A board that was asked for 300 us read its regions, and the whole skin, with 20."""
    skin = stepped("emulator://8x8?scene=single&begin=0")
    skin.configure(rate_hz=10, settle_us=100)
    with Focus(skin, Region(mode="near", settle_us=told_us)) as focus:
        assert skin.info.settle_us >= 100
        focus.follow(touched((3, 4)), 1, next(iter(skin)))
        assert settle_us <= skin.info.settle_us < settle_us + 20


def test_focus_needs_a_calibration() -> None:
    """Without one, the whole skin was read at its usual rate, and nothing said why."""
    with pytest.raises(ValueError, match="scans have with a calibration: give one"):
        ohmskin.open("emulator://8x8", focus=True)


def test_after_a_loop_the_whole_skin_is_read() -> None:
    """The region stayed: where nobody moved it, later touches were not seen."""
    url = "emulator://8x8?scene=single&seed=1&begin=0&speed=0"
    with ohmskin.open(url, calibration=of_scene("single"), focus=True) as skin:
        assert not all(scan.is_whole for scan in islice(skin, 20))
        assert skin.info.row_mask == 0xFF
        skin.latest()
        assert all(skin.latest().is_whole for _ in range(20))


def test_the_port_is_given_back_whatever_the_skin_has_become() -> None:
    """The region of before was beyond a skin of fewer rows: the port stayed open."""
    with ohmskin.open("emulator://8x8", calibration=of_scene("rest"), focus=True) as skin:
        skin.device.configure(rows=4)
    with pytest.raises(DeviceLost, match="was closed"):
        skin.latest()


def test_a_slow_program_gets_regions_that_are_new() -> None:
    """It got every scan, of contacts that were there seconds ago, until its queue was full."""
    url, like = "emulator://8x8?scene=single&begin=0", Region(settle_us=20)
    with ohmskin.open(url, calibration=of_scene("single"), focus=like) as skin:
        begin_s, missed = skin.device.now_s, 0
        for scan in skin:
            missed += scan.missed
            if (now_s := skin.device.now_s) > begin_s + 2.0:
                break
            time.sleep(0.01)
        assert now_s - scan.host_time_s < 0.8
        assert missed > 300
        assert skin.stats.missed == 0


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="only near ends"):
        Focus(stepped("emulator://8x8?mode=far"))
    for like in (Region(mode="far"), Region(whole_mode="far"), Region(mode="bad")):
        with pytest.raises(ValueError, match=r"mode near, half or quick, not (far|bad)"):
            Focus(stepped("emulator://8x8"), like)  # it was refused when the first touch came
    for like in (Region(rows=[1]), Region(columns=range(4)), Region(whole_every=20)):
        with pytest.raises(ValueError, match="follow the contacts: leave them out"):
            Focus(stepped("emulator://8x8"), like)  # they were overwritten in silence
    with pytest.raises(TypeError, match=r"focus is True, False or an .*, not 'quick'"):
        ohmskin.open("emulator://8x8", calibration=of_scene("rest"), focus="quick")
    board = stepped("emulator://4x4")
    with Recorder(tmp_path / "a.mcap", board.info, lambda: board.now_s) as recorder:
        record(board, recorder, scans_for(board, 0.1))
    with ohmskin.open(f"replay://{tmp_path / 'a.mcap'}") as played, pytest.raises(CommandRefused):
        Focus(played)


def test_a_region_follows_the_contacts_of_an_emulated_board() -> None:
    """Its time is stepped, so that no busy machine matters."""
    of_skin = of_scene("single")
    url = "emulator://8x8?scene=single&seed=1&begin=0&speed=0"
    small, whole, first = [], [], None
    with ohmskin.open(url, calibration=of_skin, focus=True) as skin:
        for scan in skin:
            first = scan.time_us if first is None else first
            (whole if scan.is_whole else small).append(scan)
            if scan.time_us - first > 2e6:
                break
        assert skin.device.stats.missed == 0
    assert {scan.mode for scan in whole} == {"near"}
    assert {scan.mode for scan in small} == {"near"}
    assert len(small) > 5 * len(whole)
    # Whole scans still come often.
    times_s = 1e-6 * np.array([scan.time_us for scan in whole])
    assert np.diff(times_s).max() < 0.1
    # A region shows what the whole scan before it has shown.
    touched = [scan for scan in small if scan.contacts]
    assert len(touched) > 0.9 * len(small)
    for scan in touched:
        before = max((one for one in whole if one.number < scan.number), key=lambda one: one.number)
        off_n = np.abs(scan.force_n - before.force_n)[scan.read]
        std_n = np.hypot(scan.force_n_std, before.force_n_std)[scan.read]
        assert (off_n <= STATED_STDS * std_n + 0.05 * before.force_n[scan.read] + 0.05).all()
