# SPDX-License-Identifier: Apache-2.0
"""Several boards at once: which are opened, what becomes of those that cannot be, every scan."""

import itertools
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from ohmskin.emulate.board import CLOCK_HZ
from ohmskin.errors import DeviceLost, DeviceSilent, PortError, ProtocolMismatch
from ohmskin.force.reader import CalibratedSkin, ForceScan
from ohmskin.link import session
from ohmskin.link.clock import ScanClock
from ohmskin.link.messages import Scan
from ohmskin.several_boards import Boards, BoardScan
from ports import Attach, Serve
from stepped import stepped

pytestmark = pytest.mark.usefixtures("nothing_left")


def units(*numbers: int, rest: str = "") -> list[str]:
    return [f"emulator://8x8?unit={number}{rest}" for number in numbers]


def test_boards_are_named_by_their_skins_and_closed_together() -> None:
    with ohmskin.open_all(units(7, 3)) as skins:
        assert len(skins) == 2
        assert list(skins) == [7, 3]
        assert skins[3].name == "emulator://8x8?unit=3"
        assert {unit: skin.info.unit_id for unit, skin in skins.items()} == {7: 7, 3: 3}
        assert skins[7].latest().codes.shape == (8, 8, 4)
        with pytest.raises(KeyError):
            skins[1]
        devices = list(skins.values())
    for device in devices:
        with pytest.raises(DeviceLost, match=device.name.replace("?", r"\?")):
            device.latest()
    skins.close()


@pytest.mark.parametrize("one", ["emulator://8x8", Path("skin.json")])
def test_one_in_place_of_a_list_is_refused(one: str | Path) -> None:
    """Each letter was opened as a port."""
    with pytest.raises(TypeError, match="takes a list of urls, and got one: put "):
        ohmskin.open_all(one)
    with pytest.raises(TypeError, match="takes a list of calibrations, and got one"):
        ohmskin.open_all(units(1), calibrations=one)


def test_they_need_not_start() -> None:
    with ohmskin.open_all(units(1, 2), start=False) as skins:
        time.sleep(0.1)
        assert [skin.stats.scans for skin in skins.values()] == [0, 0]


def test_every_scan_of_every_board_in_order_of_time() -> None:
    urls = [*units(1, 2), "emulator://4x4?unit=3&rate=200", "emulator://8x8?unit=4&rate=30"]
    with ohmskin.open_all(urls) as skins:
        scans = skins.scans()
        taken = [next(scans)]
        time.sleep(0.7)  # a slow reader loses nothing
        taken += itertools.islice(scans, 400)
    assert all(a.scan.time_ns <= b.scan.time_ns for a, b in itertools.pairwise(taken[100:]))
    for unit in range(1, 5):
        found = [each.scan for each in taken if each.unit_id == unit]
        numbers = [scan.number for scan in found]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert [scan.missed for scan in found] == [0] * len(found)
    rates = Counter(each.unit_id for each in taken[100:])
    assert rates[3] / rates[1] == pytest.approx(200 / 90, rel=0.05)
    assert rates[1] / rates[4] == pytest.approx(90 / 30, rel=0.1)


# What `time.monotonic()` showed 0 at, since 1970 [ns].
EPOCH_NS = 1_700_000_000_000_000_000


def time_s(each: BoardScan) -> float:
    """The middle of the scan by the clock of `Scan.host_time_s`."""
    return 1e-9 * (each.scan.time_ns - EPOCH_NS)


class Past:
    """A board whose scans have come, at made-up times: a few milliseconds late.

    begins_s: when it was switched on, and each time that it was reset; it scans for 2 s from there.
    """

    def __init__(self, url: str, *begins_s: float) -> None:
        random = np.random.default_rng(1)
        self.scans: list[Scan] = []
        clock = ScanClock(EPOCH_NS)
        for begin_s in begins_s:
            bench = stepped(url)
            self.info = bench.info
            for scan in itertools.takewhile(lambda scan: scan.host_time_s <= 2.0, bench):
                arrived_s = begin_s + scan.host_time_s + random.exponential(2e-3)
                arrived = replace(scan, host_time_s=arrived_s)
                self.scans.append(replace(arrived, time_ns=clock.time_ns(arrived, bench.info)))

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)

    def close(self) -> None:
        pass


def past_scans(*boards: Past) -> list[BoardScan]:
    return list(Boards(boards).scans())


def test_times_are_of_the_middle_of_scans_on_one_clock() -> None:
    taken = past_scans(Past(*units(1), 50.0), Past("emulator://8x8?unit=2&rate=45", 50.3))
    assert all(time_s(a) <= time_s(b) for a, b in itertools.pairwise(taken))
    for unit, begin_s, period_s in ((1, 50.0, 1 / 90), (2, 50.3, 1 / 45)):
        found = [each for each in taken if each.unit_id == unit][20:]
        times_s = np.array([time_s(each) for each in found])
        middles_s = [begin_s + 1e-6 * each.scan.time_us + period_s / 2 for each in found]
        assert times_s == pytest.approx(np.array(middles_s), abs=2e-3)
        assert np.diff(times_s) == pytest.approx(period_s, abs=1e-3)


def test_a_slow_board_has_the_time_of_its_readings() -> None:
    """Its scan is short, the rest of its period idle."""
    for each in past_scans(Past("emulator://4x4?rate=2", 50.0)):
        middle_s = 64 * 60_000 / CLOCK_HZ / 2  # 64 slots of 60,000 cycles at most
        begun_s = 50.0 + 1e-6 * each.scan.time_us
        assert time_s(each) - begun_s == pytest.approx(middle_s, abs=5e-3)


def test_a_board_that_is_reset_keeps_the_time() -> None:
    """It begins anew at board time 0."""
    begins_s = (50.0, 52.1, 54.3)
    found = past_scans(Past(*units(1), *begins_s))
    resets = [b.scan.time_us < a.scan.time_us for a, b in itertools.pairwise(found)]
    assert sum(resets) == 2
    begun_s = np.array(begins_s)[np.cumsum([0, *resets])]
    times_s = np.array([time_s(each) for each in found])
    middles_s = begun_s + [1e-6 * each.scan.time_us + 0.5 / 90 for each in found]
    assert times_s == pytest.approx(middles_s, abs=10e-3)
    assert (np.diff(times_s) > 0).all()


def test_a_board_that_vanishes_ends_the_scans_and_is_named() -> None:
    urls = [*units(1), "emulator://8x8?unit=2&vanish=0.5"]
    with (
        ohmskin.open_all(urls) as skins,
        pytest.raises(DeviceLost, match=r"emulator://8x8\?unit=2&vanish=0.5 is gone"),
    ):
        for _ in skins.scans():
            pass


def test_the_boards_of_this_machine(pty_board: Serve, attach: Attach) -> None:
    one, two = (pty_board(f"emulator://8x8?unit={unit}").path for unit in (1, 2))
    attach((one, "uno"), ("/dev/ttyS0", ""), (two, "megaatmega2560"))
    with ohmskin.open_all() as skins:
        assert {unit: skin.name for unit, skin in skins.items()} == {1: one, 2: two}


def test_what_is_no_skin_is_skipped_in_a_search(
    pty_board: Serve, attach: Attach, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "ATTEMPTS", session.ATTEMPTS[:1])
    other, skin = (pty_board(f"emulator://8x8?{what}").path for what in ("silent=1", "unit=5"))
    attach((other, "uno"), (skin, "uno"))
    with ohmskin.open_all() as skins:
        assert list(skins) == [5]
    with pytest.raises(DeviceSilent, match=f"{other} is silent"):
        ohmskin.open_all([skin, other])
    attach((other, "uno"))
    with pytest.raises(PortError, match=f"no skin board answers at {other}"):
        ohmskin.open_all()


def test_a_skin_that_cannot_be_used_is_an_error_of_a_search(
    pty_board: Serve, attach: Attach
) -> None:
    old, skin = (pty_board(f"emulator://8x8?{what}").path for what in ("foreign=1", "unit=5"))
    attach((old, "uno"), (skin, "uno"))
    with pytest.raises(ProtocolMismatch, match=old):
        ohmskin.open_all()
    attach((skin, "uno"))
    with ohmskin.open(skin), pytest.raises(PortError, match=f"{skin} is busy"):
        ohmskin.open_all()


@pytest.mark.parametrize("urls", [None, []])
def test_no_board_is_an_error(urls: list[str] | None, attach: Attach) -> None:
    attach(("/dev/ttyS0", ""))
    with pytest.raises(PortError, match=r"no skin board found: .* 'ohmskin ports' lists"):
        ohmskin.open_all(urls)


def test_one_that_cannot_be_opened_closes_all(pty_board: Serve) -> None:
    path = pty_board("emulator://8x8?unit=1").path
    with pytest.raises(PortError, match="no port /dev/ttyACM99"):
        ohmskin.open_all([path, "/dev/ttyACM99", *units(2)])
    with ohmskin.open(Path(path)) as skin:  # it is free again
        assert skin.info.scanning == 0


def test_two_of_one_unit_are_refused() -> None:
    urls = [*units(1, 2), "emulator://4x4?unit=2"]
    with pytest.raises(PortError) as error:
        ohmskin.open_all(urls)
    assert str(error.value) == (
        f"{urls[1]} and {urls[2]} are both unit 2: rename one: "
        f"ohmskin configure {urls[2]} --unit-id NUMBER --save"
    )


def test_each_board_has_the_calibration_of_its_unit(tmp_path: Path) -> None:
    paths = []
    for unit in (1, 2, 9):
        paths.append(tmp_path / f"unit{unit}.json")
        siemens = 20e-6 / unit
        of_scene("ghost", unit_id=unit, siemens=siemens).save(paths[-1])
    urls = units(2, 1, rest="&scene=ghost&begin=0&seed=1")
    with ohmskin.open_all(urls, calibrations=paths) as skins:
        assert {unit: skin.calibration.unit_id for unit, skin in skins.items()} == {1: 1, 2: 2}
        largest = {}
        for each in itertools.islice(skins.scans(), 20):
            assert isinstance(each.scan, ForceScan)
            assert isinstance(skins[each.unit_id], CalibratedSkin)
            largest[each.unit_id] = np.max(each.scan.force_n)
    assert largest[2] == pytest.approx(2 * largest[1], rel=0.1)


def test_boards_with_calibrations_begin_together() -> None:
    """Each began when the merge first took a scan of it: those of the first one waited."""
    told = [of_scene("rest", unit_id=unit) for unit in (1, 2)]
    with ohmskin.open_all(units(1, 2), calibrations=told, start=False) as skins:
        scans = skins.scans()
        until_s = time.monotonic() + 10
        while not all(skin.stats.scans for skin in skins.values()):
            assert time.monotonic() < until_s, "a board does not scan"
            time.sleep(0.01)
        first = dict[int, int]()
        while len(first) < 2:
            each = next(scans)
            first.setdefault(each.unit_id, each.scan.number)
    assert first == {1: 0, 2: 0}


@pytest.mark.parametrize(
    ("urls", "calibrated", "words"),
    [
        (units(1, 2), (1, 3), r"unit=2: no calibration is of its unit, 2: calibrate"),
        (units(1), (1, 1), "two calibrations are of unit 1"),
        (["emulator://4x4?unit=1"], (1,), r"emulator://4x4\?unit=1: .* 8x8 skin"),
    ],
)
def test_calibrations_of_other_boards_are_refused(
    urls: list[str], calibrated: tuple[int, ...], words: str
) -> None:
    given = [of_scene("ghost", unit_id=unit) for unit in calibrated]
    with pytest.raises(ValueError, match=words):
        ohmskin.open_all(urls, calibrations=given)
