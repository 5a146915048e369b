# SPDX-License-Identifier: Apache-2.0
"""``ohmskin view`` without a browser: what its pages are sent, and what their commands do."""

import threading
import time
from datetime import datetime
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibrations import NEWTON_SIEMENS, of_scene
from ohmskin import live
from ohmskin.arrays import Float
from ohmskin.circuit.skin import port_resistance_ohm
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.force.focus import Focus
from ohmskin.link.device import Device
from ohmskin.record.recording import Tare, load_recording
from ohmskin.view import boards
from ohmskin.view.boards import MOST_BOARDS, ViewedBoard, ViewedBoards
from ports import Serve
from recordings import write_recording
from stepped import stepped
from viewed import GHOST, LIMIT_S, REST, panel, served
from waiting import until


@pytest.fixture(autouse=True)
def _short_tare(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boards, "TARE_S", 0.3)


def test_a_scan_is_shown_with_its_estimate_and_as_it_was_read() -> None:
    skin = Scene("ghost", 8, 8, seed=1).skin(BEGIN_S)
    at_rest = Scene("rest", 8, 8, seed=1).skin(0.0)
    with served(GHOST, calibrations=[of_scene("ghost")]) as client, panel(client) as page:
        state = page.until_state(lambda state: state["status"] == "scanning")
        scan = page.scan(lambda scan: scan["rate_hz"] > 0)
    assert (state["port"], state["board"]["rows"], state["board"]["unit_id"]) == (GHOST, 8, 0)
    assert (state["method"], state["force_method"]) == ("touch", "touch")
    assert state["rest_date"] == "2025-03-01"
    assert scan["touched"].sum() == 3
    assert scan["raw_touched"].sum() > 3
    assert scan["raw_touched"][5, 5]  # the ghost
    assert scan["raw"][5, 5] > 10 * scan["siemens"][5, 5]
    true_n = (skin.cell_siemens - at_rest.cell_siemens) / NEWTON_SIEMENS
    assert np.abs(scan["force"] - true_n).max() < 0.05
    assert np.all(scan["force_std"] >= 0)
    contacts = {(row, column): force_n for _, row, column, force_n, _ in scan["contacts"]}
    assert contacts == {
        cell: pytest.approx(true_n[cell], rel=0.03) for cell in ((2, 2), (2, 5), (5, 2))
    }
    assert (scan["missed"], scan["text"]) == (0, "")
    assert scan["rate_hz"] == pytest.approx(90, abs=1)
    assert scan["chi2"] > 0


def test_without_a_calibration_there_are_conductances() -> None:
    truth = Scene("ghost", 8, 8, seed=1).skin(BEGIN_S).cell_siemens
    with served(GHOST) as client, panel(client) as page:
        scan = page.scan()
    assert scan["planes"] == ["raw", "raw_touched", "siemens", "siemens_std", "touched"]
    assert page.state["rest_date"] is None
    assert page.state["force_method"] is None
    pressed = scan["touched"].astype(bool)
    assert pressed.sum() == 3
    np.testing.assert_allclose(scan["siemens"][pressed], truth[pressed], rtol=0.1)
    rises = sorted(amount for *_, amount, _ in scan["contacts"])
    np.testing.assert_allclose(rises, np.sort(truth[pressed]) - 1e-6, rtol=0.1)


def test_a_page_that_is_slow_gets_the_newest_scan_and_no_other() -> None:
    with served(REST) as client, panel(client) as page:
        while (first := page.take())["kind"] != "scan":
            pass
        time.sleep(0.5)
        for _ in range(5):  # nothing was queued up meanwhile
            asked_s = time.monotonic()
            page.say(do="clock", page_ms=1.5)
            answer = page.take()
            assert (answer["kind"], answer["page_ms"]) == ("clock", 1.5)
            assert asked_s <= answer["host_s"] <= time.monotonic()
        for wrong in (first["scan"] - 1, first["scan"] + 1):
            page.say(do="ack", scan=wrong)
        page.say(do="clock", page_ms=0)
        assert page.take()["kind"] == "clock"
        page.say(do="ack", scan=first["scan"])
        second = page.take()
        assert second["scan"] - first["scan"] >= 30
        assert second["host_time_s"] - first["host_time_s"] > 0.3
        page.say(do="ack", scan=second["scan"])
        assert page.take()["scan"] > second["scan"]


def test_a_contact_keeps_its_number_over_scans_that_nobody_saw() -> None:
    with (
        served("emulator://8x8?scene=ghost&begin=0&seed=1&rate=5") as client,
        panel(client) as page,
    ):
        first = page.scan(lambda scan: scan["contacts"])
        later = page.scan(lambda scan: scan["scan"] >= first["scan"] + 3)
    assert [each[0] for each in later["contacts"]] == [each[0] for each in first["contacts"]]


def test_two_pages_of_one_board_do_not_hold_up_each_other() -> None:
    with served(REST) as client, panel(client) as slow, panel(client) as quick:
        while (held := slow.take())["kind"] != "scan":
            pass
        last = quick.scan(lambda scan: scan["scan"] > held["scan"] + 20)
        slow.say(do="ack", scan=held["scan"])
        assert slow.take()["scan"] > held["scan"] + 10
        assert last["rows"] == 8


def test_two_boards_have_a_panel_each() -> None:
    with served(GHOST, "emulator://4x6?scene=rest&unit=7") as client:
        assert client.get("/boards").json() == [
            {"number": 0, "port": GHOST},
            {"number": 1, "port": "emulator://4x6?scene=rest&unit=7"},
        ]
        with panel(client, 0) as one, panel(client, 1) as other:
            assert one.scan()["siemens"].shape == (8, 8)
            assert other.scan()["siemens"].shape == (4, 6)
            other.until_state(lambda state: state["board"])
            assert other.state["board"]["unit_id"] == 7


# ------------------------------------------------------------------------------------ commands


def test_a_method_is_switched_and_back() -> None:
    with served(GHOST, calibrations=[of_scene("ghost")]) as client, panel(client) as page:
        page.scan(lambda scan: scan["method"] == "touch" and "force" in scan)
        assert page.command(do="method", method="ohm")["good"]
        scan = page.scan(lambda scan: scan["method"] == "ohm")
        assert "force" not in scan
        assert scan["touched"].sum() > 3
        assert page.state["method"] == "ohm"
        page.refused("joint", do="method", method="magic")
        assert page.command(do="method", method="touch")["good"]
        assert "force" in page.scan(lambda scan: scan["method"] == "touch")


def test_far_ends_are_shown_beside_what_the_near_ends_read(tmp_path: Path) -> None:
    """The raw plane is by Ohm's law from readings a and b, as it is of mode near."""
    skin = Scene("ghost", 8, 8, seed=1).skin(BEGIN_S)
    port_siemens = 1 / port_resistance_ohm(skin)  # by the node Laplacian: with wires and ghosts
    with served(f"{GHOST}&mode=far", folder=tmp_path) as client, panel(client) as page:
        scan = page.scan(lambda scan: scan["touched"].sum() == 3)
        assert page.until_state(lambda state: state["status"] == "scanning")
        assert page.state["methods"] == ["joint", "touch"]
        # A code of I is 1 / (1024 * 30 kOhm); references in series are 60 kOhm.
        off = 1 / (1 / scan["raw"] + 60e3) - 1 / (1 / port_siemens + 60e3)
        assert np.abs(off).max() < 1.1 / 1024 / 30e3
        assert scan["raw"][5, 5] > 10 * scan["siemens"][5, 5]  # the ghost
        pressed = scan["touched"].astype(bool)
        truth = skin.cell_siemens[pressed]
        np.testing.assert_allclose(scan["siemens"][pressed], truth, rtol=0.02)
        page.refused("'ohm' takes the readings a b c d, not a e b f", do="method", method="ohm")
        assert page.command(do="method", method="touch")["good"]
        assert page.scan(lambda scan: scan["method"] == "touch")["touched"].sum() == 3
        assert page.state["status"] == "scanning"
        page.refused("are touched", do="tare", force=False)
        assert page.command(do="record")["good"]
        assert page.command(do="tare", force=True)["good"]
        assert page.command(do="stop")["good"]
    (path,) = tmp_path.glob("*.mcap")
    recorded = load_recording(path)
    assert {scan.mode for scan in recorded.scans} == {"far"}
    assert [tare.mode for tare in recorded.tares] == ["far"]


@pytest.mark.parametrize("mode", ["half", "quick"])
def test_few_readings_are_shown(mode: str) -> None:
    with served(f"{GHOST}&mode={mode}") as client, panel(client) as page:
        page.scan(lambda scan: scan["touched"].sum() == 3)
        assert set(page.state["methods"]) == {"ohm", "matrix", "touch", "joint"}


def test_the_board_follows_contacts_if_it_shall(tmp_path: Path) -> None:
    url = "emulator://8x8?scene=single&begin=0"
    with served(url, folder=tmp_path) as client, panel(client) as page:
        page.scan(lambda scan: scan["touched"].sum() == 1)
        assert page.command(do="focus", on=True)["good"]
        assert page.until_state(lambda state: state["focus"])
        page.scan(lambda scan: scan["rate_hz"] > 300 and scan["touched"].sum() == 1)
        assert page.command(do="record")["good"]
        page.scan(lambda scan: scan["recorded"] > 60)
        assert page.command(do="stop")["good"]
        assert page.command(do="focus", on=False)["good"]
        page.scan(lambda scan: scan["rate_hz"] < 91)
        assert not page.state["focus"]
    (path,) = tmp_path.glob("*.mcap")
    assert {scan.is_whole for scan in load_recording(path).scans} == {True, False}


def test_a_silent_board_whose_contacts_are_followed_is_closed_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, waited = threading.Event(), list[bool]()
    monkeypatch.setattr(Focus, "close", lambda _: waited.append(answers.wait(20)))
    board = ViewedBoard(REST, [], tmp_path)
    until(lambda: board.opened)
    board.follow(True)
    board.close()
    assert board.ended
    assert waited == []
    answers.set()
    until(lambda: waited == [True])


@pytest.mark.parametrize("calibrated", [True, False])
def test_tare_is_refused_while_something_touches_the_skin(calibrated: bool) -> None:
    known = [of_scene("ghost")] if calibrated else []
    with served(GHOST, calibrations=known) as client, panel(client) as page:
        page.scan()
        words = "cells (2, 2), (2, 5), (5, 2) are touched"
        assert page.refused(words, do="tare", force=False)["refused"] == "tare"
        assert not page.state["tared"]
        assert page.command(do="tare", force=True)["good"]
        page.until_state(lambda state: state["tared"])
        page.scan(lambda scan: scan["touched"].sum() == 0 and not scan["contacts"])
        assert page.command(do="undo")["good"]
        page.scan(lambda scan: scan["touched"].sum() == 3)
        assert not page.state["tared"]
        page.refused("no tare", do="undo")


def test_a_tare_makes_a_conductance_certain() -> None:
    with served(REST) as client, panel(client) as page:
        before = page.scan()
        assert page.command(do="tare", force=False)["good"]
        after = page.scan(lambda scan: scan["scan"] > before["scan"] + 40)
        assert page.state["rest_date"].startswith("20")
    truth = Scene("rest", 8, 8, seed=1).skin(0.0).cell_siemens
    assert np.abs(after["siemens"] - truth).max() < 0.1e-6
    assert after["touched"].sum() == after["raw_touched"].sum() == 0


def test_one_thing_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, told, mean_ratio = threading.Event(), threading.Event(), Device.mean_ratio

    def mean_ratio_when_told(skin: Device, seconds: float) -> Float:
        begun.set()
        told.wait(LIMIT_S)
        return mean_ratio(skin, seconds)

    monkeypatch.setattr(Device, "mean_ratio", mean_ratio_when_told)
    with served(REST) as client, panel(client) as page, panel(client) as other:
        page.scan()
        page.say(do="tare", force=False)
        assert begun.wait(LIMIT_S)
        page.refused("one thing at a time", do="record")
        other.refused("one thing at a time", do="tare", force=False)
        told.set()
        assert page.until(lambda message: message["kind"] == "notice")["good"]


def test_a_recording_holds_every_scan_tare_and_mark(tmp_path: Path) -> None:
    with served(REST, folder=tmp_path) as client, panel(client) as page:
        page.scan()
        page.refused("start one first", do="mark", text="too soon")
        page.refused("nothing", do="stop")
        assert page.command(do="record")["good"]
        assert "already" in page.command(do="record")["text"]
        path = Path(page.state["recording"])
        assert path.parent == tmp_path.resolve()
        assert page.command(do="mark", text=" poke at (2, 3) ")["good"]
        assert not page.command(do="mark", text=" ")["good"]
        assert page.command(do="tare", force=False)["good"]
        page.say(do="ack", scan=0)
        assert page.scan(lambda scan: scan["recorded"] > 60)
        answer = page.command(do="stop")
        assert answer["good"]
        assert "whole" in answer["text"]
        page.until_state(lambda state: not state["recording"] and str(path) in state["recorded"])
        whole = load_recording(path)  # while the page goes on
        page.scan()
        assert page.command(do="record")["good"]  # begins with the tare that is in force
        page.scan(lambda scan: scan["recorded"] > 5)
        second = Path(page.state["recording"])
    assert not whole.cut_off
    numbers = [scan.number for scan in whole.scans]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) > 60
    assert [mark.text for mark in whole.marks] == ["poke at (2, 3)"]
    assert len(whole.tares) == 1
    assert np.abs(whole.tares[0].rest_ratio - Scene("rest", 8, 8, seed=1).rest_ratio).max() < 1e-3
    again = load_recording(second)
    assert not again.cut_off  # although the page was ended meanwhile
    np.testing.assert_array_equal(again.tares[0].rest_ratio, whole.tares[0].rest_ratio)
    assert path != second


def test_recordings_begun_in_one_second_have_names_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one board, and of two that nobody has given a unit id."""
    monkeypatch.setattr(boards, "datetime", SimpleNamespace(now=lambda: datetime(2025, 3, 1)))
    with served(REST, GHOST, folder=tmp_path) as client:
        for board in (0, 0, 0, 1):
            with panel(client, board) as page:
                page.scan()
                assert page.command(do="record")["good"]
                assert page.command(do="stop")["good"]
    name = "ohmskin-20250301-000000-unit0"
    assert {each.name for each in tmp_path.iterdir()} == {
        *(f"{name}.mcap", f"{name}-2.mcap", f"{name}-3.mcap", f"{name}-4.mcap")
    }


def test_a_recording_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with served(REST, folder=tmp_path / "none") as client, panel(client) as page:
        page.scan()
        page.refused("cannot be written", do="record")
        assert not page.state["recording"]
        page.scan()


# ------------------------------------------------------------------- boards that come and go


def test_a_board_that_is_pulled_out_comes_back_by_itself(
    pty_board: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.1)
    port = tmp_path / "skin"
    first = pty_board(REST)
    port.symlink_to(first.path)
    with served(str(port), folder=tmp_path) as client, panel(client) as page:
        page.scan()
        page.command(do="method", method="matrix")
        page.command(do="tare", force=False)
        page.command(do="record")
        page.scan(lambda scan: scan["recorded"] > 10)
        recording = Path(page.state["recording"])
        port.unlink()  # another test's board may get the same pseudo-terminal
        first.close()
        state = page.until_state(lambda state: state["status"] == "gone")
        assert str(port) in state["text"]
        for refused in ({"do": "tare", "force": False}, {"do": "record"}):
            assert "is not there" in page.command(**refused)["text"]
        page.until_state(lambda state: not state["recording"])
        assert "is gone" in page.state["recorded"]
        assert not load_recording(recording).cut_off
        second = pty_board(REST)
        port.symlink_to(second.path)
        page.until_state(lambda state: state["status"] == "scanning")
        assert page.state["tared"]  # it is the same skin
        assert page.scan()["method"] == "matrix"


def test_there_is_a_limit_of_boards(tmp_path: Path) -> None:
    ports = [str(tmp_path / str(number)) for number in range(MOST_BOARDS)]
    with ViewedBoards(ports) as boards, pytest.raises(ValueError, match="close one first"):
        boards.add("/dev/one-too-many")


def test_a_board_may_be_closed_while_the_list_of_boards_is_read() -> None:
    class Leaving:
        """A board that is closed while somebody asks for its port."""

        @property
        def port(self) -> str:
            listed.pop(0, None)
            return REST

    listed = ViewedBoards()
    listed.update({0: Leaving(), 1: Leaving()})
    with pytest.raises(ValueError, match="speed=0"):
        listed.add(f"{REST}&speed=0")


def test_a_skin_in_stepped_time_is_refused() -> None:
    """Stopping its recording waited for ever."""
    with ViewedBoards() as boards, pytest.raises(ValueError, match="leave out speed=0"):
        boards.add("emulator://4x4?speed=0")


@pytest.mark.parametrize(
    ("port", "words"),
    [
        ("/dev/ttyACM99", "no port /dev/ttyACM99"),
        ("emulator://big", "1x1 to 16x16"),
        ("emulator://4x4?foreign=1", "ohmskin flash"),
        ("replay:///no/such.mcap", "/no/such.mcap"),
    ],
)
def test_a_port_that_cannot_be_opened_says_why(port: str, words: str) -> None:
    with served(port) as client, panel(client) as page:
        page.until_state(lambda state: state["status"] == "gone" and words in state["text"])


def test_a_calibration_of_another_unit_is_not_taken_unless_forced() -> None:
    other = of_scene("ghost", unit_id=7)
    with served(GHOST, calibrations=[other]) as client, panel(client) as page:
        assert "force" not in page.scan()
        assert "of unit 7, the board is unit 0" in page.state["note"]
    both = [other, of_scene("ghost")]
    with served(GHOST, calibrations=both) as client, panel(client) as page:
        assert "force" in page.scan()
        assert page.state["note"] == ""
    with served(GHOST, calibrations=[other], force=True) as client, panel(client) as page:
        assert "force" in page.scan()


def test_a_calibration_whose_method_takes_whole_scans_is_not_taken_in_mode_half() -> None:
    by_voltage = of_scene("ghost", method="voltage", siemens=0.01)
    with served(f"{GHOST}&mode=half", calibrations=[by_voltage]) as client, panel(client) as page:
        assert "force" not in page.scan()
        assert "'voltage' takes whole scans, the board scans in mode half" in page.state["note"]
    both = [by_voltage, of_scene("ghost")]
    with served(f"{GHOST}&mode=half", calibrations=both) as client, panel(client) as page:
        assert "force" in page.scan()


def test_a_replay_shows_the_tare_of_the_recording_and_ends(tmp_path: Path) -> None:
    path, bench = tmp_path / "skin.mcap", stepped(GHOST)
    tare = Tare(Scene("ghost", 8, 8, seed=1).rest_ratio, 0.0)
    write_recording(path, bench.info, [tare, *islice(bench, 30)])
    with served(f"replay://{path}") as client, panel(client) as page:
        assert page.scan()["touched"].sum() == 3
        state = page.until_state(lambda state: state["status"] == "ended")
        assert "played to its end" in state["text"]
        assert state["tared"]


def test_the_newest_scan_is_there_while_the_next_is_estimated() -> None:
    """It was not: where estimates take longer than scans, half of them were never sent."""
    with ViewedBoards([REST]) as boards:
        board = boards.get(0)
        assert board is not None
        board.watchers.add(lambda: None)
        until(lambda: board.shown is not None)
        first, number = board.shown, 0
        while number < 50:
            assert board.shown is not None
            assert first is not None
            number = board.shown.number - first.number


def test_nothing_is_left_when_boards_are_closed(nothing_left: None, tmp_path: Path) -> None:
    with ViewedBoards([GHOST, "/dev/ttyACM99"], folder=tmp_path) as boards:
        board = boards.get(0)
        assert board is not None
        until(lambda: board.state()["status"] == "scanning")
        assert board.shown is None  # nobody looks
        board.record()
        (path,) = tmp_path.iterdir()
    assert not load_recording(path).cut_off
    time.sleep(0.05)
