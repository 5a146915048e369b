# SPDX-License-Identifier: Apache-2.0
"""Bad lines and boards: the host gets over it, or says so in one of the documented errors."""

import itertools
import os
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import ohmskin
from lockstep import LockstepSim
from ohmskin.emulate import simavr
from ohmskin.emulate.driver import PtyServer, SteppedLink, SteppedSkin
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import CommandRefused, DeviceLost, DeviceSilent, OhmskinError
from ohmskin.link import framing, protocol, session
from ohmskin.link.codes import quantise
from ohmskin.link.serial_port import READ_TIMEOUT_S, SerialLink
from ohmskin.link.session import Session
from ports import Serve
from stepped import stepped, stepped_link

pytestmark = pytest.mark.usefixtures("nothing_left")

ADC = "fine"


@pytest.mark.parametrize(
    "faults", ["drop=0.1", "bitflip=3e-4", "garbage=0.3", "drop=0.05&bitflip=3e-4&garbage=0.1"]
)
def test_all_that_was_made_is_counted_and_all_that_came_is_the_truth(faults: str) -> None:
    bench = stepped(f"emulator://2x2?scene=multi&begin=0&seed=2&noise=0&rate=100&{faults}")
    found = list(itertools.islice(bench, 5000))
    expected = quantise(Scene("multi", 2, 2, seed=2).ratio(BEGIN_S))
    assert (np.array([scan.codes for scan in found]) == expected).all()
    # Where the answer to "start" was lost, the first ones came before somebody iterated.
    steps = np.diff([scan.number for scan in found])
    assert steps.min() > 0
    assert [1 + scan.missed for scan in found[1:]] == steps.tolist()
    stats = bench.stats
    print(f"{faults}: {stats}")
    assert stats.scans + stats.missed == found[-1].number + 1
    assert (stats.missed > 300) == (faults != "garbage=0.3")
    assert (stats.line.damaged > 300) == (faults != "drop=0.1")


def test_a_served_board_counts_what_nobody_takes_and_may_be_closed_again() -> None:
    with PtyServer(emulated("emulator://8x8")[0]) as server:
        server.serve(0.01)
        assert server.lost_bytes == 0  # of a hello
        server.board.receive(framing.encode(protocol.FRAMES["start"].id, 0, b""))
        server.begin_s -= 10.0  # 900 scans are due
        server.serve(0.01)
        assert server.lost_bytes > 100_000
        server.close()
        server.serve()  # does nothing any more


def test_a_bad_line_at_a_port(pty_board: Serve) -> None:
    faults = "drop=0.05&bitflip=1e-4&garbage=0.3"
    port = pty_board(f"emulator://8x8?scene=multi&begin=0&seed=5&noise=0&rate=120&{faults}").path
    expected = quantise(Scene("multi", 8, 8, seed=5).ratio(BEGIN_S))
    with ohmskin.open(port) as skin:
        found = list(itertools.islice(skin, 100))
        skin.stop()
        stats = skin.stats
    for scan in found:
        np.testing.assert_array_equal(scan.codes, expected)
    for before, after in itertools.pairwise(found):
        assert after.missed == after.number - before.number - 1
    assert stats.scans >= 100
    assert stats.restarts == 0
    # What the iterator has seen, and what had come or gone before it began.
    assert found[0].missed <= found[0].number
    assert stats.missed >= sum(scan.missed for scan in found) > 0
    assert stats.line.damaged > 10


@pytest.mark.simavr
@pytest.mark.parametrize("baud", [500_000, 1_000_000])
def test_a_reset_of_the_firmware(baud: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its line speed is that of the start again, too."""
    monkeypatch.setattr(simavr, "SkinSim", LockstepSim)
    link = simavr.SimavrLink("uno", Scene())
    with Session(link, baud) as skin:
        skin.start()
        kept = skin.configure(rows=3, columns=7, rate_hz=110, settle_us=40, accuracy=ADC)
        scans = iter(skin)
        for _ in range(20):
            assert next(scans).codes.shape == (3, 7, 4)
        for restarts in (1, 2):
            link.sim.reset()
            until = next(scan for scan in scans if skin.stats.restarts == restarts)
            for scan in itertools.islice(scans, 20):
                assert scan.codes.shape == (3, 7, 4)
                assert scan.missed == 0
            assert until.codes.shape == (3, 7, 4)
            print(f"reset at {baud} baud: {skin.stats}")
            assert skin.stats.restarts == restarts
        assert skin.info.reset_cause == ("external",)
        assert skin.info.baud == 500_000
        skin.set_unit_id(5)  # asks the board what it keeps
        assert skin.info == replace(
            kept, unit_id=5, baud=500_000, reset_cause=("external",), scanning=1
        )


def test_a_reset_board_says_its_name_anew() -> None:
    """A name that was not saved is gone after a reset, and `info` must not pretend otherwise."""
    with stepped("emulator://2x2?reset=0.5&unit=3") as skin:
        skin.set_unit_id(7)
        for _ in skin:
            if skin.stats.restarts:
                break
        assert skin.info.unit_id == 3


def test_restarts_and_missed_scans_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "ohmskin")
    with stepped("emulator://2x2?reset=0.5&drop=0.3") as skin:
        for scan in skin:
            if skin.stats.restarts and scan.missed:
                break
    said = {(each.levelname, each.message.split(" ", 1)[1]) for each in caplog.records}
    assert ("WARNING", "was reset (external)") in said
    assert ("INFO", f"missed {scan.missed} scans before scan {scan.number}") in said


class ResetAfterConfigure(SteppedLink):
    """Resets the board right after its first answer to `configure`."""

    resets, reset_due = 0, False

    def write(self, octets: bytes) -> None:
        super().write(octets)
        (frame,) = framing.Decoder().feed(octets)
        self.reset_due = frame.type == protocol.FRAMES["configure"].id and not self.resets

    def read(self, limit_s: float = READ_TIMEOUT_S) -> bytes:
        answer = super().read(limit_s)
        if self.reset_due:
            self.board.reset()
            self.resets, self.reset_due = 1, False
        return answer


def test_a_reset_right_after_configure_does_not_undo_it() -> None:
    link = ResetAfterConfigure(emulated("emulator://4x4")[0])
    with SteppedSkin(link) as skin:
        skin.start()
        assert skin.configure(rows=2, rate_hz=77).rows == 2
        assert link.resets == 1
        assert skin.info.rate_asked_mhz == 77_000
        assert skin.latest().codes.shape == (2, 4, 4)


def test_a_reset_while_stopped_does_not_undo_the_configuration() -> None:
    link = stepped_link("emulator://4x4")
    with SteppedSkin(link) as skin:
        skin.configure(rows=2, columns=3, rate_hz=77)
        link.board.reset()
        skin.start()
        assert skin.latest().codes.shape == (2, 3, 4)
        assert skin.info.rate_asked_mhz == 77_000


class ResetBeforeStart(SteppedLink):
    """Its board is reset before it hears "start", and does not hear the first "stop" after that."""

    left: tuple[str, ...] = ()  # what has still to happen

    def write(self, octets: bytes) -> None:
        (frame,) = framing.Decoder().feed(octets)
        name = protocol.FRAMES_BY_ID[frame.type].name
        is_due = name in self.left[:1]
        self.left = self.left[is_due:]
        if is_due and name == "start":
            self.board.reset()
        if not is_due or name == "start":
            super().write(octets)


def test_a_reset_right_before_start_gives_no_scans_of_another_configuration() -> None:
    """Those that came before the board was stopped again were kept for iterators."""
    link = ResetBeforeStart(emulated("emulator://4x4")[0])
    with SteppedSkin(link) as skin:
        skin.configure(rows=2, mode="half")
        link.left = "start", "stop"
        found = list(itertools.islice(skin, 5))
        assert not link.left
    assert [(scan.number, scan.mode, scan.codes.shape) for scan in found] == [
        (number, "half", (2, 4, 2)) for number in range(5)
    ]


def test_a_stall_of_two_seconds() -> None:
    with stepped("emulator://2x2?rate=200&stall=2") as skin:
        scans = iter(skin)
        skin.step(5.0)
        found = list(itertools.islice(scans, skin.stats.scans))
        gaps = [scan.missed for scan in found if scan.missed]
        assert gaps == [pytest.approx(400, abs=1)]
        assert skin.stats.missed == gaps[0]
        assert found[-1].number + 1 == len(found) + gaps[0]


READS: dict[str, Callable[[ohmskin.Device], object]] = {
    "iterator": lambda skin: list(skin),
    "latest": lambda skin: [skin.latest() for _ in range(100_000)],
    "command": lambda skin: [skin.set_unit_id(1) for _ in range(1_000_000)],
    "configure": lambda skin: [skin.configure(rows=2) for _ in range(1_000_000)],
}


@pytest.mark.parametrize("asked", [{"rate_hz": 30.0}, {"rows": 4}])
@pytest.mark.parametrize("losses", [1, 2, 3])
def test_a_reset_board_scans_as_before_where_commands_are_lost(
    asked: dict[str, float], losses: int
) -> None:
    """The first of those that bring it back: configure, start and get_hello."""
    link = Lossy(emulated("emulator://8x8")[0])
    with SteppedSkin(link) as skin:
        kept = skin.configure(**asked)
        scans = iter(skin)
        before = next(scans)
        link.losses = losses
        link.board.reset()
        found = list(itertools.islice(scans, 20))
        assert skin.stats.restarts >= 1
        assert skin.info.rate_hz == kept.rate_hz
    assert {scan.codes.shape for scan in found} == {before.codes.shape}
    steps_s = np.diff([1e-6 * scan.time_us for scan in found])
    np.testing.assert_allclose(steps_s, 1 / kept.rate_hz, rtol=1e-3)


def test_a_board_that_comes_in_place_of_another_says_what_it_is() -> None:
    """Behind an adapter that stays plugged, as another board may."""
    link = stepped_link("emulator://8x8")
    with SteppedSkin(link) as skin:
        scans = iter(skin)
        next(scans)
        link.board.says |= {"ref_top_ohm": 10_000, "unit_id": 9}
        link.board.reset()
        after = list(itertools.islice(scans, 3))[-1]
        assert (skin.info.unit_id, skin.info.ref_top_ohm) == (9, 10_000)
        assert after.board == skin.info


def test_a_reset_board_that_cannot_scan_as_before_is_lost() -> None:
    """As where the faster line is gone, and the slower one cannot keep up."""
    link = stepped_link("emulator://8x8")
    with SteppedSkin(link) as skin:
        skin.configure(rate_hz=30)
        scans = iter(skin)
        next(scans)
        link.board.says["rate_asked_mhz"] = 90_000
        link.board.reset()
        with pytest.raises(DeviceLost, match="was reset and cannot scan as before"):
            list(itertools.islice(scans, 100))
        assert skin.stats.restarts == 1


def test_two_hellos_of_one_reset_are_one_restart() -> None:
    link = stepped_link("emulator://8x8")
    with SteppedSkin(link) as skin:
        scans = iter(skin)
        next(scans)
        link.board.reset()
        link.write(framing.encode(protocol.FRAMES["get_hello"].id, 0, b""))
        assert [scan.number for scan in itertools.islice(scans, 3)] == [0, 1, 2]
        assert skin.stats.restarts == 1


@pytest.mark.parametrize("use", READS)
def test_a_serial_port_that_goes_away(use: str, pty_board: Serve) -> None:
    server = pty_board("emulator://2x2?rate=300")
    timer = threading.Timer(0.4, server.close)
    with ohmskin.open(server.path) as skin:
        timer.start()
        with pytest.raises(DeviceLost, match="still plugged in"):
            READS[use](skin)
        with pytest.raises(DeviceLost):
            READS["latest"](skin)
    timer.join()


def test_a_board_that_stops_talking() -> None:
    with stepped("emulator://2x2?stall=600") as skin:
        skin.start()
        skin.step(2.0)
        with pytest.raises(DeviceLost, match=r"said nothing for 5\.0 s"):
            list(skin)
        with pytest.raises(DeviceLost, match="said nothing"):
            READS["latest"](skin)
        with pytest.raises(DeviceLost, match="does not answer 'set_unit_id'"):
            skin.set_unit_id(1)


def test_a_conversion_that_was_late_long_ago_is_no_reason_for_silence() -> None:
    link = stepped_link("emulator://2x2?stall=600")
    link.board.says["late"] = 1
    with SteppedSkin(link) as skin, pytest.raises(DeviceLost, match="said nothing"):
        list(skin)


def test_a_port_with_other_things_to_say(
    monkeypatch: pytest.MonkeyPatch, silent_port: tuple[int, str]
) -> None:
    """As of a board with another sketch, which prints lines for ever."""
    monkeypatch.setattr(session, "ATTEMPTS", session.ATTEMPTS[:1])
    master, path = silent_port
    done = threading.Event()

    def chatter() -> None:
        while not done.wait(0.01):
            os.write(master, b"A0=512 A1=13\r\n")

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        with pytest.raises(DeviceSilent, match="no frames"):
            ohmskin.open(path)
    finally:
        done.set()
        thread.join()


@pytest.mark.simavr
@pytest.mark.parametrize("board", ["uno", "megaatmega2560"])
def test_a_board_on_a_desk(board: str) -> None:
    """Its boot loader runs first, as its port opens; then it reads with a desk's errors."""
    with ohmskin.open(f"simavr://{board}?desk=1&line_pf=1&node_pf=10&scene=ghost&begin=0") as skin:
        codes = [scan.codes for scan in itertools.islice(skin, 100)]
        assert skin.stats.restarts == 0
    y = Scene("ghost").ratio(BEGIN_S)
    lsb = 1024 * y + 2 + 2 * y + 1.5 * 4 * y * (1 - y)  # offset, gain, bow
    np.testing.assert_allclose(np.mean(codes, axis=0), lsb, atol=0.4)


def test_a_lost_answer_is_asked_for_again() -> None:
    for seed in range(5):
        with stepped(f"emulator://2x2?rate=200&drop=0.15&seed={seed}") as skin:
            for unit_id in range(10):
                try:
                    skin.set_unit_id(unit_id)
                except DeviceLost:
                    continue  # three answers lost in a row: rare, and said
                assert skin.info.unit_id == unit_id


class Lossy(SteppedLink):
    """Loses the next `losses` commands."""

    losses = 0

    def write(self, octets: bytes) -> None:
        if self.losses:
            self.losses -= 1
        else:
            super().write(octets)


def test_a_command_that_cannot_stop_the_board_lets_it_scan() -> None:
    link = Lossy(emulated("emulator://4x4")[0])
    with SteppedSkin(link) as skin:
        scans = iter(skin)
        link.losses = 3
        with pytest.raises(DeviceLost, match="does not answer 'stop'"):
            skin.configure(rate_hz=30)
        link.board.reset()  # which a device that should scan gets over
        assert len(list(itertools.islice(scans, 1000))) == 1000


def test_refusals_on_a_bad_line_stay_refusals() -> None:
    with stepped("emulator://4x4?drop=0.1&bitflip=1e-4&seed=4") as skin:
        before = skin.info
        for _ in range(5):
            with pytest.raises(CommandRefused, match="bad_rows"):
                skin.configure(rows=0)
        assert skin.info == before
        assert skin.latest().codes.shape == (4, 4, 4)


def test_no_thread_or_file_is_left_when_opening_fails(
    monkeypatch: pytest.MonkeyPatch, silent_port: tuple[int, str]
) -> None:
    monkeypatch.setattr(session, "ATTEMPTS", session.ATTEMPTS[:1])
    for fault in ("silent=1", "foreign=1", "vanish=1e-6", ""):
        with pytest.raises(OhmskinError):
            ohmskin.open(f"emulator://2x2?{fault}" if fault else silent_port[1])


def test_a_wrong_option_leaves_no_port_open(pty_board: Serve) -> None:
    path = pty_board("emulator://2x2").path
    with pytest.raises(OhmskinError, match="baud=7"):
        ohmskin.open(f"{path}?baud=7")
    SerialLink(path).close()  # it was locked if it were still open
