# SPDX-License-Identifier: Apache-2.0
"""`ohmskin.open` and `Device`: the same tests over an emulated board in this process, one behind a
pseudo-terminal that is opened like a serial port, and the firmware in the AVR simulator.
"""

import gc
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

import ohmskin
from ohmskin.emulate.driver import EmulatorLink, SteppedLink, SteppedSkin
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import CommandRefused, DeviceLost, PortError
from ohmskin.link import device, framing, protocol
from ohmskin.link.messages import Scan
from ohmskin.link.session import Session
from ports import Serve
from stepped import stepped, stepped_link
from waiting import until

REST = "emulator://3x4?scene=rest&rate=100"
SCENE = "scene=multi&begin=0&seed=3"
EXPECTED = Scene("multi", 8, 8, seed=3).ratio(BEGIN_S)
NOISE_LSB = 0.3  # of the emulator, by default; the simulator has none
DESK_LSB = 40, 5  # of the preset `desk` of the simulator: largest error of a reading, of their mean

pytestmark = pytest.mark.usefixtures("nothing_left")

BACKENDS = [
    "emulator",
    "stepped",
    "pty",
    pytest.param("uno", marks=pytest.mark.simavr),
    pytest.param("megaatmega2560", marks=pytest.mark.simavr),
    pytest.param("uno?desk=1&bootloader=", marks=pytest.mark.simavr),
]


@pytest.fixture(params=BACKENDS)
def url(request: pytest.FixtureRequest, pty_board: Serve) -> str:
    emulator = f"emulator://8x8?{SCENE}"
    if request.param in ("emulator", "stepped"):
        return emulator + (request.param == "stepped") * "&speed=0"
    if request.param == "pty":
        return pty_board(emulator).path
    return f"simavr://{request.param}{'&' if '?' in request.param else '?'}{SCENE}"


def take(scans: Iterator[Scan], count: int) -> list[Scan]:
    return list(itertools.islice(scans, count))


def assert_reads_the_scene(ratio: np.ndarray, url: str) -> None:
    assert ratio.shape[2] == 4
    largest_lsb, mean_lsb = DESK_LSB if "desk" in url else (0.5 + 6 * NOISE_LSB, 0.05)
    error = 1024 * (ratio - EXPECTED[: ratio.shape[0], : ratio.shape[1]])
    assert np.abs(error).max() <= largest_lsb
    assert np.abs(error.mean()) < mean_lsb


def with_far_ends(url: str) -> str:
    """The preset `desk` has no far multiplexers unless told."""
    return f"{url}&far_open=0" if "desk" in url else url


# ----------------------------------------------------------------------------- every backend


def test_info(url: str) -> None:
    with ohmskin.open(url, start=False) as skin:
        info = skin.info
        assert skin.name == url
    assert info.layout_crc == protocol.LAYOUT_CRC
    assert info.board in ("emulated", "uno", "megaatmega2560")
    assert (info.rows, info.columns, info.readings_per_cell, info.adc_bits) == (8, 8, 4, 10)
    assert (info.ref_top_ohm, info.ref_bottom_ohm) == (30_000, 30_000)
    assert info.rate_hz == pytest.approx(90, rel=0.0005)
    assert (info.scanning, info.unit_id, info.settings) == (0, 0, "defaults_blank")


def test_every_scan_comes_in_order(url: str) -> None:
    with ohmskin.open(url) as skin:
        # The hello of a board that boots may be cut in two by the opening of its port.
        before = skin.stats.line.damaged
        found = take(iter(skin), 60)
        rate_hz, stats = skin.info.rate_hz, skin.stats
    numbers = [scan.number for scan in found]
    assert numbers == list(range(numbers[0], numbers[0] + 60))
    assert [scan.missed for scan in found] == [0] * 60
    assert [scan.codes.shape for scan in found] == [(8, 8, 4)] * 60
    steps_us = np.diff([scan.time_us for scan in found])
    assert np.abs(steps_us - 1e6 / rate_hz).max() <= 2
    assert all(a.host_time_s <= b.host_time_s for a, b in itertools.pairwise(found))
    assert_reads_the_scene(np.mean([scan.ratio for scan in found], axis=0), url)
    assert_reads_the_scene(found[-1].ratio, url)
    assert stats.scans >= 60
    assert (stats.missed, stats.dropped_by_board, stats.board_rx_errors) == (0, 0, 0)
    assert before <= 1
    assert stats.line.damaged == before
    assert (stats.unknown, stats.restarts, stats.overflowed) == (0, 0, 0)
    assert stats.line.octets > 60 * 320


def test_latest_is_the_newest_and_each_comes_once(url: str) -> None:
    with ohmskin.open(url) as skin:
        numbers = [skin.latest().number for _ in range(10)]
        assert all(a < b for a, b in itertools.pairwise(numbers))
        first = skin.latest()
        if isinstance(skin, SteppedSkin):
            skin.step(0.5)
        until(lambda: skin.stats.scans >= first.number + 30)
        received = skin.stats.scans
        newest = skin.latest()
        assert newest.number >= received - 1  # numbers count from 0
        assert_reads_the_scene(newest.ratio, url)
        assert skin.stats.overflowed == 0


def test_an_iterator_and_latest_in_two_threads(url: str) -> None:
    with ohmskin.open(url) as skin:
        every: list[Scan] = []
        scans = iter(skin)
        thread = threading.Thread(target=lambda: every.extend(take(scans, 50)))
        thread.start()
        some = [skin.latest() for _ in range(30)]
        thread.join()
    numbers = [scan.number for scan in every]
    assert numbers == list(range(numbers[0], numbers[0] + 50))
    assert [scan.missed for scan in every] == [0] * 50
    assert all(a.number < b.number for a, b in itertools.pairwise(some))
    by_number = {scan.number: scan for scan in every}
    shared = [(by_number[s.number], s) for s in some if s.number in by_number]
    assert shared
    for one, other in shared:
        np.testing.assert_array_equal(one.codes, other.codes)


def test_configure_while_scanning(url: str) -> None:
    with ohmskin.open(url) as skin:
        assert skin.latest().codes.shape == (8, 8, 4)
        kept = skin.configure(rows=3, columns=5, rate_hz=120.0, settle_us=40)
        assert (kept.rows, kept.columns, kept.settle_asked_us) == (3, 5, 40)
        assert kept.rate_hz == pytest.approx(120, rel=0.002)
        assert kept == skin.info
        found = take(iter(skin), 30)
        assert [scan.codes.shape for scan in found] == [(3, 5, 4)] * 30
        assert [scan.missed for scan in found] == [0] * 30
        assert_reads_the_scene(np.mean([scan.ratio for scan in found], axis=0), url)
        elapsed_us = found[-1].time_us - found[0].time_us
        assert 29e6 / elapsed_us == pytest.approx(120, rel=0.002)
        kept = skin.configure(accuracy="fine")
        assert (kept.rows, kept.accuracy, kept.settle_asked_us) == (3, "fine", 40)
        assert skin.latest().codes.shape == (3, 5, 4)
        assert skin.stats.missed == 0


def test_scans_say_which_readings_they_hold(url: str) -> None:
    far = Scene("multi", 8, 8, seed=3).ratio(BEGIN_S, "far")
    assert np.abs(far - EXPECTED).max() > 0.1
    with ohmskin.open(with_far_ends(url)) as skin:
        assert (skin.info.mode, skin.latest().reading_names) == ("near", tuple("abcd"))
        assert skin.configure(mode="far").mode == "far"
        scan = skin.latest()
        assert scan.reading_names == ("a", "e", "b", "f")
        largest_lsb = DESK_LSB[0] if "desk" in url else 0.5 + 6 * NOISE_LSB
        assert 1024 * np.abs(scan.ratio - far).max() <= largest_lsb
        assert skin.configure(rows=3).mode == "far"  # what is not told stays
        skin.configure(mode="near")
        assert skin.latest().reading_names == tuple("abcd")


# One of each; all limits are checked in test_emulator.py.
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"rows": 17}, "bad_rows"),
    ({"columns": 0}, "bad_columns"),
    ({"rate_hz": 0.9}, "bad_rate"),
    ({"settle_us": 3001}, "bad_settle"),
    ({"accuracy": 16}, "bad_accuracy"),
    ({"rate_hz": 90, "rows": 16, "columns": 16}, "too_fast"),
    ({"rate_hz": 200}, "line_too_slow"),
]
IMPOSSIBLE: list[dict[str, Any]] = [
    *({"rows": rows} for rows in (-1, 256)),
    {"columns": 1000},
    *({"settle_us": settle_us} for settle_us in (-1, 65536)),
    *({"rate_hz": rate_hz} for rate_hz in (-1.0, 1e7, 0.0001, float("inf"), float("nan"))),
    {"accuracy": "fast"},
    {"mode": "middle"},
    {"rows": 8.5},  # was taken for 8
    {"rows": "8"},
]


def test_refused_values_change_nothing(url: str) -> None:
    with ohmskin.open(url) as skin:
        skin.configure(rows=7, columns=8, rate_hz=95)
        before = asdict(skin.info)
        for values, result in REFUSED:
            with pytest.raises(CommandRefused) as refusal:
                skin.configure(**values)
            assert (refusal.value.command, refusal.value.result) == ("configure", result), values
            assert protocol.ENUMS["result"].docs[result] in str(refusal.value)
        for values in IMPOSSIBLE:
            with pytest.raises(ValueError, match=r"."):
                skin.configure(**values)
        found = take(iter(skin), 5)
        assert [scan.codes.shape for scan in found] == [(7, 8, 4)] * 5
        assert [scan.missed for scan in found] == [0] * 5
        skin.stop()
        skin.set_unit_id(0)  # asks who the board is
        assert asdict(skin.info) == before


def test_an_accuracy_and_modes_may_be_numbers() -> None:
    with stepped("emulator://4x4") as skin:
        assert skin.configure(accuracy=1).accuracy == "fine"  # type: ignore[arg-type]
        assert skin.set_region(device.Region([0], mode=2)).mode == "half"  # type: ignore[arg-type]
        assert skin.latest().mode == "half"
        assert skin.stats.restarts == 0


def test_stop_and_start(url: str) -> None:
    with ohmskin.open(url, start=False) as skin:
        time.sleep(0.1)
        assert skin.stats.scans == 0
        skin.start()
        skin.start()
        skin.latest()
        skin.stop()
        stopped = skin.stats.scans
        time.sleep(0.1)
        assert skin.stats.scans == stopped
        skin.stop()
        skin.start()
        first = take(iter(skin), 3)
        assert first[0].number <= 3  # again from 0; what came before the iterator is not its own
        assert skin.stats.missed == 0


def test_name_and_settings_of_a_board(url: str) -> None:
    with ohmskin.open(url) as skin:
        skin.set_unit_id(0xC0FFEE)
        assert skin.info.unit_id == 0xC0FFEE
        assert skin.info.scanning == 1
        skin.save()
        for wrong in (-1, 1 << 32):
            with pytest.raises(ValueError, match=f"unit_id is {wrong}"):
                skin.set_unit_id(wrong)
        skin.configure(rows=2)
        defaults = skin.load_defaults()
        assert (defaults.rows, defaults.unit_id) == (8, 0)
        assert skin.latest().rows == 8


def test_self_test_of_a_sound_board(url: str) -> None:
    with ohmskin.open(with_far_ends(url)) as skin:
        report = skin.self_test()
        assert report.findings == ()
        assert (report.code_min[4:], report.code_max[4:]) == (4 * (1023,), 4 * (0,))  # not taken
        skin.configure(mode="far")
        report = skin.self_test()
        assert report.findings == ()
        for low, high in zip(report.code_min[:6], report.code_max, strict=False):
            assert 0 <= low <= high <= 1023
        # Where little current flows, A, C and E read near Vdd, B, D and F near ground.
        assert min(report.code_max[reading] for reading in (0, 2, 4)) > 700
        assert max(report.code_min[reading] for reading in (1, 3, 5)) < 300
        assert skin.latest().codes.shape == (8, 8, 4)


def test_after_close_everything_says_lost(url: str) -> None:
    skin = ohmskin.open(url)
    scans = iter(skin)
    next(scans)
    skin.close()
    skin.close()
    with pytest.raises(DeviceLost, match="closed"):
        list(scans)  # those that had come before, and no more
    with pytest.raises(DeviceLost):
        skin.latest()
    with pytest.raises(DeviceLost):
        next(iter(skin))
    uses: list[Callable[[], object]] = [
        skin.stop,
        skin.start,
        skin.save,
        skin.self_test,
        skin.load_defaults,
        lambda: skin.set_unit_id(1),
        lambda: skin.configure(rows=2),
    ]
    for use in uses:
        with pytest.raises(DeviceLost):
            use()
    assert skin.stats.scans >= 1
    assert skin.info.rows == 8


def test_the_context_closes_on_an_exception(url: str) -> None:
    with suppress(KeyError), ohmskin.open(url) as skin:
        raise KeyError("mine")
    with pytest.raises(DeviceLost):
        skin.stop()


def test_close_stops_the_board_and_its_port_can_be_opened_again(pty_board: Serve) -> None:
    server = pty_board("emulator://4x4")
    for round_number in range(3):
        with ohmskin.open(server.path) as skin:
            assert skin.info.unit_id == round_number
            assert skin.latest().codes.shape == (4, 4, 4)
            assert server.board.next_scan_s is not None
            skin.set_unit_id(round_number + 1)
        until(lambda: server.board.next_scan_s is None)


def test_a_board_left_scanning_is_taken_over(pty_board: Serve) -> None:
    from ohmskin.link.serial_port import SerialLink

    path = pty_board("emulator://4x4").path
    left = SerialLink(path)
    start = protocol.FRAMES["start"]
    left.write(framing.encode(start.id, 0, b""))
    time.sleep(0.2)
    left.close()
    with ohmskin.open(path) as skin:
        found = take(iter(skin), 5)
        assert [scan.missed for scan in found] == [0] * 5
        assert found[0].number < 5


@pytest.mark.parametrize("board", ["pty", pytest.param("uno", marks=pytest.mark.simavr)])
def test_the_faster_line(board: str, pty_board: Serve) -> None:
    url = pty_board("emulator://8x8").path if board == "pty" else f"simavr://{board}"
    with ohmskin.open(f"{url}?baud=1000000") as skin:
        assert skin.info.baud == 1_000_000
        assert [scan.missed for scan in take(iter(skin), 20)] == [0] * 20
    with pytest.raises(PortError, match="9600"):
        ohmskin.open(f"{url}?baud=9600")


# --------------------------------------------------------------------------------- one backend


@pytest.mark.parametrize("fault", ["", "&drop=0.2"])
def test_a_slow_iterator_is_told_what_it_lost(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "QUEUE_SCANS", 16)
    with stepped(f"emulator://1x1?rate=1000{fault}") as skin:
        slow, quick = iter(skin), iter(skin)
        begun = skin.stats.scans  # some, if the answer to start was dropped
        skin.step(0.01)
        before = next(slow)
        taken = take(quick, skin.stats.scans - begun)
        for _ in range(10):
            skin.step(0.01)
            taken += take(quick, skin.stats.scans - begun - len(taken))
        later = take(slow, 16)
        stats = skin.stats
    assert later[-1] == taken[-1]
    for scan in later:
        assert scan.missed == scan.number - before.number - 1
        before = scan
    assert stats.overflowed == stats.scans - 17  # `slow` is there since the start
    assert len(taken) == stats.scans - begun
    assert (stats.missed > 0) == bool(fault)


def test_an_iterator_that_starts_the_board_has_its_first_scan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a busy machine, scans came before the start returned, and they were lost."""
    start = SteppedSkin.start

    def slowly(skin: SteppedSkin) -> None:
        start(skin)
        skin.step(0.1)

    monkeypatch.setattr(SteppedSkin, "start", slowly)
    with stepped("emulator://4x4") as skin:
        assert next(iter(skin)).number == 0


def test_an_iterator_never_used_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "QUEUE_SCANS", 16)
    with stepped("emulator://1x1?rate=1000") as skin:
        unused = iter(skin)
        skin.step(0.1)
        before = skin.stats
        assert before.overflowed > 0  # somebody may still use it
        del unused
        gc.collect()
        skin.step(0.1)
        assert skin.stats.overflowed == before.overflowed
        assert skin.stats.line.frames >= before.line.frames + 100  # `before` is a copy


def test_latest_waits_as_long_as_told() -> None:
    with stepped("emulator://1x1?rate=1") as skin:
        skin.start()
        skin.step(0.8)
        # It said to unplug the board.
        with pytest.raises(DeviceLost, match=r"no scan for 0\.1 s: wait for longer"):
            skin.latest(timeout_s=0.1)
        assert skin.now_s == pytest.approx(0.9)
        skin.step(0.2)
        assert skin.latest(timeout_s=10).number == 0


class HelloEaterLink(SteppedLink):
    """Loses the next hello of its board, as a line that damages a frame does."""

    eats = False

    def read(self, limit_s: float = 0.1) -> bytes:
        octets = super().read(limit_s)
        frames = framing.Decoder().feed(octets)
        hellos = [raw for raw in frames if raw.type == protocol.FRAMES["hello"].id]
        if not (self.eats and hellos):
            return octets
        self.eats = False
        left = (raw for raw in frames if raw is not hellos[0])
        return b"".join(framing.encode(raw.type, raw.sequence, raw.payload) for raw in left)


def test_what_a_board_keeps_is_asked_again_if_its_hello_is_lost() -> None:
    """Its answer came, so the hello of before was taken for what it now keeps."""
    link = HelloEaterLink(emulated("emulator://8x8")[0])
    skin = SteppedSkin(link)
    skin.start()
    link.eats = True
    assert skin.set_region(device.Region([3], [4])).row_mask == 1 << 3
    link.eats = True
    assert skin.configure(rows=4, rate_hz=50).rows == 4
    assert not link.eats
    assert skin.latest().rows == 4  # its scans contradicted the hello, which ended the session


def test_two_threads_close_a_port_once(monkeypatch: pytest.MonkeyPatch) -> None:
    link = EmulatorLink(emulated("emulator://1x1")[0])
    skin, both, closed = Session(link), threading.Barrier(2), list[str]()
    skin.start()
    monkeypatch.setattr(link, "close", lambda: closed.append("once"))

    def write(_: bytes) -> None:
        with suppress(threading.BrokenBarrierError):
            both.wait(0.3)

    monkeypatch.setattr(link, "write", write)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: skin.close(), range(2)))
    assert closed == ["once"]


def test_a_mean_is_not_of_scans_of_two_modes() -> None:
    """Where somebody configures the board meanwhile, the mean is of the scans after that."""
    near, far = (
        list(itertools.islice(stepped(f"{REST}&mode={mode}"), 9)) for mode in ("near", "far")
    )
    mean = device.mean_ratio([*near[:4], *far])
    np.testing.assert_allclose(mean, np.mean([scan.ratio for scan in far], axis=0))
    assert np.abs(mean - near[0].ratio).max() > 0.3


def test_a_mean_is_not_of_regions_and_of_few_readings_where_there_are_more() -> None:
    skin = stepped(REST)
    skin.set_region(device.Region(range(2), range(2), whole_every=5))
    scans = list(itertools.islice(skin, 20))
    near = [scan.ratio for scan in scans if scan.is_complete]
    assert 3 <= len(near) <= 4
    np.testing.assert_array_equal(device.mean_ratio(scans), np.mean(near, axis=0))
    with pytest.raises(DeviceLost, match="none of all cells"):
        device.mean_ratio(scan for scan in scans if not scan.is_whole)


def test_a_region_may_be_told_by_arrays() -> None:
    """An array of one line was taken for no lines, and the board refused an empty mask."""
    skin = stepped(REST)
    for line in range(2):
        skin.set_region(device.Region(np.array([line]), np.array([0, line])))
        assert (skin.info.row_mask, skin.info.column_mask) == (1 << line, 1 | 1 << line)
    skin = stepped("emulator://16x16")  # NumPy says that 1 << 9 is 0 in eight bits
    assert skin.set_region(device.Region(np.array([9], np.uint8))).row_mask == 1 << 9


@pytest.mark.parametrize("rows", [np.arange(3) != 1, [True, False, True], [1.5], "12", [None]])
def test_a_region_of_what_are_no_numbers_of_lines_is_refused(rows: Any) -> None:
    """A mask of three rows was taken for the rows 1, 0 and 1; others were a TypeError."""
    skin = stepped(REST)
    with pytest.raises(ValueError, match="a row is told by its number, not as"):
        skin.set_region(device.Region(rows))
    assert skin.info.is_whole


@pytest.mark.parametrize(
    ("seconds", "times_s", "taken"),
    [
        (1.0, (5.0, 5.4, 5.9, 6.1, 6.2), 4),  # the one that comes then is the last
        (0.0, (5.0, 5.4), 1),
        (float("inf"), (5.0, 5.4), 2),
        (1.0, (5.0, 5.4, 0.1, 0.6, 0.8, 0.9), 5),  # the board was reset after 0.4 s
    ],
)
def test_scans_for_so_long_by_the_board_s_clock(
    seconds: float, times_s: tuple[float, ...], taken: int
) -> None:
    """The host reads all of them at once, as it does after it was busy for a while."""
    codes = np.zeros((1, 1, 4), np.uint16)
    scans = iter([Scan(codes, n, round(1e6 * time_s), 9.0, 0) for n, time_s in enumerate(times_s)])
    assert len(list(device.scans_for(scans, seconds))) == taken
    assert len(list(scans)) == len(times_s) - taken  # no scan is taken too many


def test_slow_scans_are_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "SILENCE_TIMEOUT_S", 0.1)
    with stepped("emulator://1x1?rate=2") as skin:
        assert [scan.number for scan in take(iter(skin), 2)] == [0, 1]


def test_a_slow_scan_is_no_reason_to_change_the_speed_of_the_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link, speeds = stepped_link("emulator://16x16"), list[int]()
    with SteppedSkin(link) as skin:
        assert skin.configure(rate_hz=0, settle_us=3000).rate_hz < 1 / 3
        monkeypatch.setattr(link, "set_baud", speeds.append)
        assert len(take(iter(skin), 3)) == 3
    assert not speeds


def test_close_while_another_thread_waits() -> None:
    skin = ohmskin.open("emulator://1x1?rate=1")
    failures: list[BaseException] = []

    def wait(use: Callable[[], object]) -> None:
        try:
            use()
        except DeviceLost as exc:
            failures.append(exc)

    uses = [skin.latest, lambda: take(iter(skin), 5)]
    threads = [threading.Thread(target=wait, args=(use,)) for use in uses]
    for thread in threads:
        thread.start()
    time.sleep(0.1)
    skin.close()
    for thread in threads:
        thread.join(5)
    assert [str(failure) for failure in failures] == ["emulator://1x1?rate=1 was closed"] * 2


def test_what_is_asked_of_a_closed_skin_says_that_it_was_closed(url: str) -> None:
    with ohmskin.open(url) as skin:
        skin.latest()
    for use in (skin.latest, lambda: iter(skin), lambda: skin.configure(rows=3), skin.self_test):
        with pytest.raises(DeviceLost) as lost:
            use()
        assert str(lost.value) == f"{skin.name} was closed"


def test_commands_of_two_threads_are_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """While one is being sent and answered, the other is not written."""
    link = EmulatorLink(emulated("emulator://1x1")[0])
    with Session(link) as skin:
        other, written, early = threading.Thread(target=skin.save), threading.Event(), []
        write = link.write

        def send(octets: bytes) -> None:
            if threading.current_thread() is other:
                written.set()
            elif not other.is_alive():
                other.start()
                early.append(written.wait(0.2))
            write(octets)

        monkeypatch.setattr(link, "write", send)
        skin.save()
        other.join()
    assert early == [False]
    assert written.is_set()
