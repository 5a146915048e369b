# SPDX-License-Identifier: Apache-2.0
"""The server of ``ohmskin view``: what it refuses, and how it starts and ends."""

import os
import re
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import AsyncMock, Mock
from urllib.error import HTTPError
from urllib.request import urlopen

import anyio
import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from command_line import Command, Done, Run, assert_one_line, finish, python
from ohmskin.cli.view import view
from ohmskin.errors import PortError
from ohmskin.view import server
from ohmskin.view.boards import ViewedBoards
from ohmskin.view.panel import Panel
from ohmskin.view.server import make_app
from viewed import GHOST, HOST, ORIGIN, REST, TOKEN, Page, panel, served
from waiting import until

PAGE = Path(server.__file__).parent / "page"


def assert_refused(client: TestClient, path: str = "/boards/0", **headers: str) -> None:
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(path, headers=headers):
        pass


def assert_gone(client: TestClient, path: str) -> None:
    """A page that asks again for a board that was closed is told so, and asks no more."""
    own = {"host": HOST, "origin": ORIGIN}
    with client.websocket_connect(path, headers=own) as socket:
        assert socket.receive() == {"type": "websocket.close", "code": 4001, "reason": ""}


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
        assert_gone(client, "/boards/0")


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
            assert client.get(f"/boards/{number}").status_code == 405
            assert_gone(client, f"/boards/{number}")
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


def test_a_board_that_is_not_there_is_told_of_in_the_terminal(command: Command) -> None:
    """The address came, and nothing else, for ever."""
    process = command("view", "/dev/nothing", "--http-port", "0", "--no-browser")
    said = process.stderr.readline()
    assert process.stdout.readline().startswith("http://127.0.0.1:")
    process.send_signal(signal.SIGINT)
    done = finish(process)
    text = "ohmskin: no port /dev/nothing: 'ohmskin ports' lists the ports there are\n"
    assert (said, done) == (text, Done(0, "", ""))


def test_boards_are_read_though_nobody_reads_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in 'ohmskin view 2>&1 | head -1': a line that could not be written ended the thread."""

    def serve(boards: ViewedBoards, *_: object) -> None:
        (board,) = boards.values()
        until(lambda: closed.write.called and board.failure)
        assert isinstance(board.failure, PortError)
        boards.close()

    monkeypatch.setattr(server, "serve", serve)
    closed = Mock(write=Mock(side_effect=BrokenPipeError))
    monkeypatch.setattr(sys, "stderr", closed)
    view(["/dev/nothing"])


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
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert_one_line(run("view", "--http-port", port), port, "--http-port")
    assert_one_line(run("view", "--host", "192.0.2.1", "--http-port", "0"), "192.0.2.1")
    assert_one_line(run("view", "--calibration", "/no/such.json"), "/no/such.json")


def test_a_host_without_an_address_is_not_tried_at_port_after_port(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Mock(side_effect=socket.gaierror(-2, "Name or service not known"))
    monkeypatch.setattr(socket, "create_server", asked)
    assert_one_line(run("view", "--host", "nosuch.invalid"), "not known", "--host")
    assert asked.call_count <= 2


def test_the_address_of_a_page_that_all_machines_reach_has_a_name() -> None:
    urls = list[str]()

    def started(url: str) -> None:
        urls.append(url)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        server.serve(ViewedBoards(), "", 0, started)
    assert urls[0].startswith(f"http://{socket.gethostname()}:")


def test_without_a_port_the_next_free_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever had a page open and began another was told to say a port."""
    urls = list[str]()

    def started(url: str) -> None:
        urls.append(url)
        signal.raise_signal(signal.SIGINT)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(server, "HTTP_PORT", port)
        with pytest.raises(KeyboardInterrupt):
            server.serve(ViewedBoards(), "127.0.0.1", None, started)
    (found,) = re.findall(r":(\d+)/", urls[0])
    assert port < int(found) < port + 100


def test_without_the_extra_it_says_what_to_install() -> None:
    program = "import sys; sys.modules['starlette'] = None; import ohmskin.__main__ as m; m.main()"
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
