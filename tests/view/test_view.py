# SPDX-License-Identifier: Apache-2.0
"""``ohmskin view`` without a browser: what the server sends, takes, refuses and leaves behind."""

import json
import os
import re
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock
from urllib.error import HTTPError
from urllib.request import urlopen

import anyio
import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from bench_board import Bench
from calibrations import NEWTON_SIEMENS, of_scene
from command_line import Command, Done, Run, assert_one_line, finish, python
from ohmskin.arrays import Float
from ohmskin.circuit.skin import port_resistance_ohm
from ohmskin.emulate.scenes import BEGIN_S, Scene
from ohmskin.force.calibration import Calibration
from ohmskin.link.device import Device
from ohmskin.record.recording import Tare, load_recording
from ohmskin.view import boards, server
from ohmskin.view.boards import MOST_BOARDS, ViewedBoards
from ohmskin.view.panel import Panel
from ohmskin.view.server import make_app
from ports import Serve
from recordings import write_recording
from waiting import until

GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"
REST = "emulator://8x8?scene=rest&seed=1"
HOST = "127.0.0.1:8765"
ORIGIN = f"http://{HOST}"
TOKEN = "secret"
PAGE = Path(server.__file__).parent / "page"
LIMIT_S = 60.0  # a server that says nothing for so long hangs, on a busy machine too
TARE_S = 0.3

Message = dict[str, Any]


@pytest.fixture(autouse=True)
def _short_tare(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boards, "TARE_S", TARE_S)


class Page:
    """The page's end of a panel's websocket."""

    def __init__(self, socket: WebSocketTestSession) -> None:
        self.socket = socket
        self.state: Message = {}

    def say(self, **message: object) -> None:
        self.socket.send_text(json.dumps(message))

    def take(self) -> Message:
        """The next message; a scan is of kind "scan", and is not acknowledged."""
        message = self.socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect(message["code"])
        if message.get("text") is None:
            return decode(message["bytes"])
        content: Message = json.loads(message["text"])
        if content["kind"] == "state":
            self.state = content
        return content

    def until(self, wanted: Callable[[Message], object]) -> Message:
        """The first message that is wanted; scans are acknowledged meanwhile."""
        end_s = time.monotonic() + LIMIT_S
        while time.monotonic() < end_s:
            self.say(do="clock", page_ms=0)  # so that there always is a message
            message = self.take()
            if message["kind"] == "scan":
                self.say(do="ack", scan=message["scan"])
            if wanted(message):
                return message
            if message["kind"] == "clock":
                time.sleep(0.005)
        raise AssertionError(f"not within {LIMIT_S} s; the last state was {self.state}")

    def scan(self, wanted: Callable[[Message], object] = lambda scan: True) -> Message:
        return self.until(lambda message: message["kind"] == "scan" and wanted(message))

    def until_state(self, wanted: Callable[[Message], object]) -> Message:
        if self.state and wanted(self.state):
            return self.state
        return self.until(lambda message: message["kind"] == "state" and wanted(message))

    def command(self, **message: object) -> Message:
        self.say(**message)
        return self.until(lambda answer: answer["kind"] == "notice")

    def refused(self, words: str, **message: object) -> Message:
        """The answer to a command that is refused with these words."""
        answer = self.command(**message)
        assert not answer["good"]
        assert words in answer["text"]
        return answer


def decode(octets: bytes) -> Message:
    """As the page does it: see `ohmskin.view.boards.Shown`."""
    (length,) = struct.unpack_from("<I", octets)
    scan: Message = json.loads(octets[4 : 4 + length])
    shape = (len(scan["planes"]), scan["rows"], scan["columns"])
    planes = np.frombuffer(octets, dtype="<f4", offset=4 + length).reshape(shape)
    return {"kind": "scan", **scan, **dict(zip(scan["planes"], planes, strict=True))}


@contextmanager
def served(
    *ports: str,
    calibrations: Sequence[Calibration] = (),
    folder: Path = Path(),
    force: bool = False,
) -> Iterator[TestClient]:
    app = make_app(ViewedBoards(ports, calibrations, folder, force=force), "127.0.0.1", TOKEN)
    with TestClient(app, base_url=ORIGIN) as client:
        client.params = {"token": TOKEN}
        yield client


@contextmanager
def panel(client: TestClient, number: int = 0, **headers: str) -> Iterator[Page]:
    given = {"host": HOST, "origin": ORIGIN, **headers}
    with client.websocket_connect(f"/boards/{number}", headers=given) as socket:
        yield Page(socket)


def assert_refused(client: TestClient, path: str = "/boards/0", **headers: str) -> None:
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(path, headers=headers):
        pass


# --------------------------------------------------------------------------------------- scans


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
    monkeypatch.setattr(boards, "AGAIN_S", 0.1)
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


BAD_PORTS = ("", "[]", "{", '{"port": 3}', '{"port": " "}', '{"port": "a\\u0000"}', "[" * 5000)


def test_a_port_is_opened_and_closed_from_the_page() -> None:
    with served() as client:
        assert client.get("/boards").json() == []
        assert all(
            {"path", "description", "board"} == set(port) for port in client.get("/ports").json()
        )
        own = {"origin": ORIGIN}
        for body in BAD_PORTS:
            answer = client.post("/boards", content=body, headers=own)
            assert answer.status_code == 400, body
            assert answer.json()["error"]
        assert client.post("/boards", content="x" * 10_000, headers=own).status_code == 400
        for _ in range(2):  # the second is the same
            answer = client.post("/boards", json={"port": REST}, headers=own)
            assert answer.json() == {"number": 0, "port": REST}
        with panel(client) as page:
            page.scan()
            assert client.delete("/boards/0", headers=own).status_code == 204
            with pytest.raises(WebSocketDisconnect) as closed:
                page.until(lambda message: False)
            assert closed.value.code == 4001
        assert client.get("/boards").json() == []
        assert client.post("/boards", json={"port": REST}, headers=own).json()["number"] == 1
        assert_refused(client, host=HOST, origin=ORIGIN)


def test_there_is_a_limit_of_boards(tmp_path: Path) -> None:
    ports = [str(tmp_path / str(number)) for number in range(MOST_BOARDS)]
    with ViewedBoards(ports) as boards, pytest.raises(ValueError, match="close one first"):
        boards.add("/dev/one-too-many")


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


def test_a_replay_shows_the_tare_of_the_recording_and_ends(tmp_path: Path) -> None:
    path, bench = tmp_path / "skin.mcap", Bench(GHOST)
    tare = Tare(Scene("ghost", 8, 8, seed=1).rest_ratio, 0.0)
    write_recording(path, bench.info, [tare, *islice(bench, 30)])
    with served(f"replay://{path}") as client, panel(client) as page:
        assert page.scan()["touched"].sum() == 3
        state = page.until_state(lambda state: state["status"] == "ended")
        assert "played to its end" in state["text"]
        assert state["tared"]


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


# ------------------------------------------------------------------------------------- refusals

BAD = [
    *("", "{", "null", "3", '"tare"', "[]", '{"do": 1}', '{"do": "reboot"}', "[" * 4000, "é"),
    *('{"do": "ack"}', '{"do": "ack", "scan": "1"}', '{"do": "clock", "page_ms": "x"}'),
    *('{"do": "clock", "page_ms": 1e999}', '{"do": "clock", "page_ms": NaN}'),
    '{"do": "clock", "page_ms": -1' + "0" * 400 + "}",
    *('{"do": "tare"}', '{"do": "tare", "force": 1}', '{"do": "mark"}'),
    *('{"do": "mark", "text": null}', '{"do": "method", "method": []}'),
    '{"do": "method", "method": "__class__"}',
]


def test_a_number_that_python_does_not_read_is_no_board() -> None:
    with served(REST) as client:
        for number in ("9" * 10, "9" * 5000, "\u0663"):
            assert client.delete(f"/boards/{number}", headers={"origin": ORIGIN}).status_code == 204
            assert client.get(f"/boards/{number}").status_code == 404
            assert_refused(client, f"/boards/{number}", host=HOST, origin=ORIGIN)
        with panel(client) as page:
            page.scan()


def test_bad_messages_are_refused_without_harm() -> None:
    with served(REST) as client, panel(client) as page:
        before = page.scan()
        state = dict(page.state)
        for text in BAD:
            page.socket.send_text(text)
            answer = page.until(lambda message: message["kind"] == "notice")
            assert not answer["good"], text
        page.socket.send_bytes(b"\x00\xff")
        assert not page.until(lambda message: message["kind"] == "notice")["good"]
        assert page.scan(lambda scan: scan["scan"] > before["scan"] + 10)["missed"] == 0
        assert page.state == state


@pytest.mark.parametrize(
    "host", ["evil.example:8765", "evil.example", "", "127.0.0.1.evil.example"]
)
def test_a_foreign_name_is_refused(host: str) -> None:
    with served() as client:
        for path in ("/", "/boards", "/ports", "/page.js"):
            assert client.get(path, headers={"host": host}).status_code == 403
        assert_refused(client, host=host, origin=f"http://{host}")


@pytest.mark.parametrize("name", ["localhost:8765", "127.0.0.1:9000", "[::1]:8765", "LOCALHOST"])
def test_names_of_this_machine_are_known_at_any_port(name: str) -> None:
    with served(REST) as client:
        assert client.get("/", headers={"host": name}).status_code == 200
        with panel(client, 0, host=name, origin=f"http://{name}") as page:
            page.scan()


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "", "http://127.0.0.1:9000", "https://127.0.0.1:8765"]
)
def test_another_page_is_refused(origin: str) -> None:
    with served(REST) as client:
        assert_refused(client, host=HOST, origin=origin)
        headers = {"origin": origin}
        assert client.get("/boards", headers=headers).status_code == 403
        assert client.post("/boards", json={"port": GHOST}, headers=headers).status_code == 403
        assert client.delete("/boards/0", headers=headers).status_code == 403
        assert client.get("/boards").json() == [{"number": 0, "port": REST}]


def test_nobody_commands_without_saying_who_asks() -> None:
    with served(REST) as client:
        assert client.post("/boards", json={"port": GHOST}).status_code == 403
        assert_refused(client, host=HOST)


@pytest.mark.parametrize(("address", "host"), [("0.0.0.0", "lab.example:8765"), ("::1", HOST)])
def test_the_token_is_asked_for(address: str, host: str) -> None:
    """On loopback too, where every user of this machine reaches the page."""
    boards = ViewedBoards([REST])
    headers = {"host": host, "origin": f"http://{host}"}
    with TestClient(make_app(boards, address, TOKEN), base_url=f"http://{host}") as client:
        for path in ("/", "/boards", "/ports"):
            assert client.get(path).status_code == 403
            assert client.get(f"{path}?token=").status_code == 403
            assert client.get(f"{path}?token=secre").status_code == 403
            assert client.get(f"{path}?token=secret").status_code == 200
        assert client.get("/page.js").status_code == 200  # the page asks for it without
        for change in (client.post, client.delete):
            assert change("/boards/0", headers=headers).status_code == 403
        for wrong in ("", "?token=", "?token=%C3%A9"):
            assert_refused(client, f"/boards/0{wrong}", **headers)
        assert_refused(client, "/boards/0?token=secret", host=host, origin="http://evil.example")
        with client.websocket_connect("/boards/0?token=secret", headers=headers) as socket:
            Page(socket).scan()


def test_the_page_is_small_and_asks_no_other_host() -> None:
    files = sorted(PAGE.iterdir())
    assert sum(file.stat().st_size for file in files) < 60_000
    for file in files:
        assert not re.search(r"https?://|//[a-z]+\.[a-z]", file.read_text()), file
    with served() as client:
        for file in files:
            path = "/" if file.name == "index.html" else f"/{file.name}"
            answer = client.get(path)
            assert answer.status_code == 200
            assert answer.content == file.read_bytes()
            assert "default-src 'none'" in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"
        for path in ("/../server.py", "/%2e%2e/server.py", "/__init__.py", "/docs"):
            assert client.get(path).status_code == 404


# ---------------------------------------------------------------------------- the command itself


def test_ctrl_c_ends_it_and_nothing_listens_beyond_loopback(command: Command) -> None:
    process = command("view", REST, "--http-port", "0", "--no-browser")
    url = process.stdout.readline().strip()
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{20,})", url)
    port = int(found[1])  # type: ignore[index]
    if Path("/proc/net/tcp").exists():
        assert listening(process.pid) == {("127.0.0.1", port)}
    with urlopen(url) as page:
        assert page.status == 200
    with pytest.raises(HTTPError, match="403"):
        urlopen(url.partition("?")[0])
    process.send_signal(signal.SIGINT)
    assert finish(process) == Done(0, "", "")


def test_ctrl_c_counts_from_the_moment_the_address_is_known() -> None:
    """Python's own handler would end the server while it starts, with a warning on stderr."""
    handlers = []

    def started(_: str) -> None:
        handlers.append(signal.getsignal(signal.SIGINT))
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        server.serve(ViewedBoards((), (), Path()), "127.0.0.1", 0, started)
    assert handlers
    assert signal.default_int_handler not in handlers


def listening(pid: int) -> set[tuple[str, int]]:
    """Addresses and ports at which a process takes connections, or any datagrams."""
    sockets = set()
    for file in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            sockets.add(os.readlink(file))
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            address, _, port = fields[1].partition(":")
            if f"socket:[{fields[9]}]" in sockets and (table[:3] == "udp" or fields[3] == "0A"):
                octets = bytes.fromhex(address)[::-1]
                found.add((".".join(map(str, octets)), int(port, 16)))
    return found


def test_a_port_that_is_taken(run: Run) -> None:
    import socket

    with ExitStack() as stack:
        taken = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        port = str(taken.getsockname()[1])
        assert_one_line(run("view", "--http-port", port), port, "--http-port")
    assert_one_line(run("view", "--host", "192.0.2.1", "--http-port", "0"), "192.0.2.1")
    assert_one_line(run("view", "--calibration", "/no/such.json"), "/no/such.json")


def test_without_the_extra_it_says_what_to_install() -> None:
    program = "import sys; sys.modules['starlette'] = None; import ohmskin.__main__"
    assert_one_line(python("-c", program, "view"), "pip install '.[view]'")


def gone_socket(error: Exception) -> AsyncMock:
    """The server's end of a websocket that can be written to no more."""
    socket = AsyncMock(WebSocket)
    socket.send_text.side_effect = error
    socket.receive.side_effect = anyio.sleep_forever
    return socket


@pytest.mark.parametrize("error", [WebSocketDisconnect(), WebSocketDisconnected("gone")])
def test_a_page_that_is_gone_ends_its_panel_and_hides_no_fault(
    tmp_path: Path, error: Exception
) -> None:
    with ViewedBoards([GHOST], folder=tmp_path) as boards:
        board = boards.get(0)
        assert board is not None
        anyio.run(Panel(board, gone_socket(error)).serve)
        with pytest.raises(ExceptionGroup):
            anyio.run(Panel(board, gone_socket(RuntimeError("a fault"))).serve)
