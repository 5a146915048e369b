# SPDX-License-Identifier: Apache-2.0
"""The page's server and those who only connect, or say too much: nobody else may notice them."""

import os
import signal
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.request import urlopen

import pytest
from starlette.websockets import WebSocketDisconnect

from calibrations import of_scene
from command_line import ENVIRONMENT, Command, Done, finish, python
from ohmskin.view import connections, server
from ohmskin.view.boards import ViewedBoard, ViewedBoards
from ohmskin.view.connections import MOST_WAITING, Waiting
from ohmskin.view.panel import MOST_COMMANDS
from ohmskin.view.server import make_app
from places import ROOT
from viewed import HOST, LIMIT_S, ORIGIN, REST, TOKEN, panel, served

resource = pytest.importorskip("resource")

KEY = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
UPGRADE = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"


class Served(NamedTuple):
    url: str
    port: int
    host: str  # with port
    query: str  # with the token


@contextmanager
def viewed(command: Command, *ports: str) -> Iterator[Served]:
    """``ohmskin view`` that may have 256 descriptors; it must print nothing but its address."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    few = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))}
    process = command("view", *ports, "--http-port", "0", "--no-browser", **few)
    url = process.stdout.readline().strip()
    host = url.split("/")[2]
    yield Served(url, int(host.partition(":")[2]), host, url.partition("?")[2])
    process.send_signal(signal.SIGINT)
    assert finish(process) == Done(0, "", "")


def connect(port: int, begin: bytes = b"") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S)
    connection.sendall(begin)
    return connection


def is_cut_off(connection: socket.socket) -> bool:
    """Whether it ends without an answer; waits for that."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_half_open_connections_neither_stop_the_page_nor_are_told_of(command: Command) -> None:
    """1,100 took all descriptors, a core, and 2.5 MB/s on stderr; they were never closed."""
    count = 300
    with viewed(command) as page, ExitStack() as stack:
        begun = b"GET / HTTP/1.1\r\n"
        held = [stack.enter_context(connect(page.port, begun)) for _ in range(count)]
        for connection in held[: count - MOST_WAITING]:
            assert is_cut_off(connection)
        with urlopen(page.url, timeout=LIMIT_S) as answer:
            assert answer.status == 200


@pytest.mark.parametrize("begun", [b"", b"GET /page.js HTTP/1.1\r\nHost: 127.0.0.1\r\n"])
def test_a_connection_that_asks_for_nothing_is_closed(
    begun: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "LONGEST_WAIT_S", 0.05)
    app = make_app(ViewedBoards(), "127.0.0.1", TOKEN)
    runner = connections.Server(app, longest_message_bytes=1000, shutdown_s=1)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=runner.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            with connect(listening.getsockname()[1], begun) as silent:
                assert is_cut_off(silent)
        finally:
            runner.should_exit = True
            thread.join(LIMIT_S)


def hostile(page: Served) -> dict[str, bytes]:
    """Requests that printed a line or a traceback; some of them need no token."""
    own = f"Host: {page.host}\r\nOrigin: http://{page.host}\r\n"
    post = f"POST /boards?{page.query} HTTP/1.1\r\n{own}"
    asks = f"GET /boards/0?{page.query} HTTP/1.1\r\n"
    texts = {
        "no request": "\x16\x03\x01\r\n\r\n",
        "aborted POST": f'{post}Content-Length: 50\r\n\r\n{{"po',
        "bad chunk after a request": f"{post}Transfer-Encoding: chunked\r\n\r\nZZ\r\n",
        "host that is no name": f"GET / HTTP/1.1\r\n{UPGRADE}{KEY}Host: \xff\xfe\r\n\r\n",
        "unknown upgrade": f"GET / HTTP/1.1\r\n{own}Upgrade: h2c\r\nConnection: Upgrade\r\n\r\n",
        "no key": f"{asks}{own}{UPGRADE}\r\n",
        "no frame": f"{asks}{own}{UPGRADE}{KEY}\r\n" + 20 * "\xff",
        "long header": f"GET / HTTP/1.1\r\n{own}a: {100_000 * 'b'}\r\n\r\n",
    }
    return {name: text.encode("latin-1") for name, text in texts.items()}


def test_a_hostile_request_prints_nothing(command: Command) -> None:
    reset = struct.pack("ii", 1, 0)
    with viewed(command, REST) as page:
        for octets in hostile(page).values():
            for is_reset in (False, True):
                try:
                    with connect(page.port, octets) as connection:
                        if is_reset:
                            linger = (socket.SOL_SOCKET, socket.SO_LINGER, reset)
                            connection.setsockopt(*linger)
                        else:
                            connection.shutdown(socket.SHUT_WR)
                            is_cut_off(connection)
                except ConnectionError:  # it was cut off earlier
                    pass
        with urlopen(page.url, timeout=LIMIT_S) as answer:
            assert answer.status == 200


def test_messages_are_not_unpacked(command: Command) -> None:
    """A message's size was looked at after it was unpacked: 97 kB became 100 MB."""
    with viewed(command, REST) as page:
        own = f"Host: {page.host}\r\nOrigin: http://{page.host}\r\n"
        packed = "Sec-WebSocket-Extensions: permessage-deflate\r\n"
        text = f"GET /boards/0?{page.query} HTTP/1.1\r\n{own}{UPGRADE}{KEY}{packed}\r\n"
        with connect(page.port, text.encode()) as connection:
            answer = connection.recv(4096).partition(b"\r\n\r\n")[0].lower()
    assert b"101" in answer
    assert b"deflate" not in answer


def test_a_websocket_that_was_closed_for_its_message_is_gone() -> None:
    """uvicorn raised a RuntimeError, as for a defect, where a scan was sent after that."""
    told: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            await receive()
            scope["state"]["waiting"] = Waiting()
            await send({"type": "lifespan.startup.complete"})
            await receive()
            return
        await receive()
        await send({"type": "websocket.accept"})
        told.append((await receive())["code"])
        try:
            await send({"type": "websocket.send", "text": ""})
        except OSError as gone:
            told.append(gone)

    limited = connections.Server(app, longest_message_bytes=100, shutdown_s=1)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=limited.run, args=([listening],))
        thread.start()
        masked = b"\x81" + bytes([0x80 | 126, 0, 126]) + bytes(4) + 126 * b"x"
        asks = f"GET / HTTP/1.1\r\nHost: a\r\n{UPGRADE}{KEY}\r\n".encode()
        with connect(listening.getsockname()[1], asks) as connection:
            assert b" 101 " in connection.recv(4096)
            connection.sendall(masked)
            while connection.recv(4096):
                pass
        limited.should_exit = True
        thread.join(LIMIT_S)
    assert told[0] == 1009
    assert isinstance(told[1], OSError)


def test_commands_of_a_page_do_not_pile_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """205,000 in 8 s took 670 MB, and the next page waited 6.5 s."""
    told = threading.Event()

    def use_when_told(_: ViewedBoard, method: str) -> str:
        told.wait(LIMIT_S)
        return method

    monkeypatch.setattr(ViewedBoard, "use", use_when_told)
    with served(REST) as client, panel(client) as page:
        page.scan()
        for _ in range(MOST_COMMANDS + 10):
            page.say(do="method", method="touch")
        for _ in range(10):
            answer = page.until(lambda message: message["kind"] == "notice")
            assert not answer["good"]
            assert "one thing at a time" in answer["text"]
        told.set()
        for _ in range(MOST_COMMANDS):
            assert page.until(lambda message: message["kind"] == "notice")["good"]
        assert page.command(do="method", method="touch")["good"]


def test_there_is_a_limit_of_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MOST_PANELS", 1)
    with served(REST) as client:
        with panel(client) as page:
            page.scan()
            headers = {"host": HOST, "origin": ORIGIN}
            with (
                pytest.raises(WebSocketDisconnect),
                client.websocket_connect("/boards/0", headers=headers),
            ):
                pass
        with panel(client) as page:  # as soon as the other is gone
            page.scan()


PROGRAM = """
import sys
from ohmskin.force.calibration import load_calibration
from viewed import GHOST, panel, served

with served(GHOST, calibrations=[load_calibration(sys.argv[1])]) as client:
    before = set(sys.modules)
    with panel(client) as page:
        for method in ("ohm", "matrix", "joint", "touch"):
            assert page.command(do="method", method=method)["good"]
            page.scan(lambda scan: scan["method"] == method and scan["contacts"])
        assert page.command(do="tare", force=True)["good"]
    print(sorted(set(sys.modules) - before))
"""


def test_nothing_is_imported_after_the_page_can_be_opened(tmp_path: Path) -> None:
    """Where no descriptor was left, an import failed, and the board was ended for good."""
    of_scene("ghost").save(tmp_path / "skin.json")
    helpers = str(ROOT / "tests" / "helpers")
    paths = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], helpers])
    done = python("-c", PROGRAM, tmp_path / "skin.json", PYTHONPATH=paths)
    assert done.out == "[]\n", done
