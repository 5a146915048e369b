# SPDX-License-Identifier: Apache-2.0
"""The server of the page: a few files, the list of boards, a websocket for each panel.

It answers its own page alone, which has the token of the address. Neither other users of this
machine nor pages of other sites may read or command the skin. A browser says in ``Origin`` which
page asks: another page is refused. And it says in ``Host`` which name it asked for. On loopback,
names of other machines are refused: somebody has made such a name lead here (DNS rebinding).
"""

import json
import mimetypes
import re
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Final

import anyio
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from ohmskin.errors import OhmskinError
from ohmskin.link.serial_port import serial_ports
from ohmskin.view.boards import LONGEST_TEXT_CHARS, MOST_BOARDS, ViewedBoards, load_all
from ohmskin.view.connections import Server, Waiting
from ohmskin.view.panel import GONE_CODE, Panel

# The port of the page, unless told. Chosen: few other programs use it.
HTTP_PORT: Final = 8765
# So many ports are tried, from this one on. Chosen: nobody has as many pages open.
_PORTS_TRIED: Final = 100
_PAGE: Final = Path(__file__).parent / "page"
# A page's message has at most so many bytes. Chosen: a text of `LONGEST_TEXT_CHARS` has at most
# 4000 in UTF-8, and names are added.
_LONGEST_MESSAGE_BYTES: Final = 8192
# When the server ends, open connections have so much time to close [s]. Chosen: a page on this
# machine takes milliseconds, and nobody likes to wait after Ctrl-C.
_SHUTDOWN_S: Final = 2
# What a browser lets the page do: load its own files, talk to its own server, and nothing else.
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",  # the address may hold the token
    "cache-control": "no-store",  # a page of one version never meets a server of another
    "connection": "close",  # a page asks for so little that none needs to be kept
}
# All pages together have at most so many panels, because each takes a file descriptor, and time to
# be sent to. Chosen: four pages of as many boards as there can be.
MOST_PANELS: Final = 4 * MOST_BOARDS
# The names by which this machine calls itself.
_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
# Requests that change nothing. Browsers need not say in ``Origin`` which page sends them.
_READS: Final = ("GET", "HEAD")


class _BoardList:
    """Answers what the page asks for besides its files: ports, the list of boards, their panels."""

    def __init__(self, boards: ViewedBoards) -> None:
        self._boards = boards
        self._panels = 0

    def routes(self) -> list[BaseRoute]:
        """Which request is answered by which method."""
        return [
            Route("/ports", self.ports),
            Route("/boards", self.list_boards, methods=["GET"]),
            Route("/boards", self.add_board, methods=["POST"]),
            Route("/boards/{number}", self.remove_board, methods=["DELETE"]),
            WebSocketRoute("/boards/{number}", self.panel),
        ]

    async def ports(self, _: Request) -> Response:
        """The serial ports of this machine."""
        # In a thread, because on some systems it takes long to look for ports.
        ports = await anyio.to_thread.run_sync(serial_ports)
        return JSONResponse([asdict(port) for port in ports])

    async def list_boards(self, _: Request) -> Response:
        """Numbers and ports of the boards that are open."""
        boards = tuple(self._boards.items())  # another thread may close one
        return JSONResponse([{"number": number, "port": board.port} for number, board in boards])

    async def add_board(self, request: Request) -> Response:
        """Open the board at a port, and say its number."""
        try:
            asked = json.loads(await _body(request))
            place = asked["port"].strip()
            if not 0 < len(place) <= LONGEST_TEXT_CHARS or not place.isprintable():
                raise ValueError("a port is a serial port's name or a URL")
            return JSONResponse({"number": self._boards.add(place), "port": place})
        except (KeyError, TypeError, AttributeError, RecursionError, ClientDisconnect):
            return JSONResponse({"error": "say which port"}, 400)
        except ValueError as exc:
            return JSONResponse({"error": str(exc)}, 400)

    async def remove_board(self, request: Request) -> Response:
        """Close a board."""
        await anyio.to_thread.run_sync(self._boards.remove, self._number(request))
        return Response(status_code=204)

    async def panel(self, socket: WebSocket) -> None:
        """Show a board until its page goes."""
        board = self._boards.get(self._number(socket))
        if board is None:
            await socket.accept()  # else the page cannot see the code
            await socket.close(GONE_CODE)
            return
        if self._panels >= MOST_PANELS:
            await socket.close()
            return
        self._panels += 1
        try:
            await Panel(board, socket).serve()
        finally:
            self._panels -= 1

    def _number(self, asked: HTTPConnection) -> int:
        """The number of the board that the path names; -1: there is none.

        `int` is not used, because it refuses a text of thousands of digits with an error.
        """
        text = asked.path_params["number"]
        return next((number for number in tuple(self._boards) if str(number) == text), -1)


def make_app(
    boards: ViewedBoards, host: str, token: str, started: Callable[[], None] = lambda: None
) -> Starlette:
    """The page of `boards`, which closes them at its end. host, token: see `Guard`."""

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[dict[str, Waiting]]:
        await anyio.to_thread.run_sync(load_all)
        started()  # from here on, Ctrl-C lets the server end properly
        yield {"waiting": Waiting()}
        await anyio.to_thread.run_sync(boards.close)

    mimetypes.add_type("text/javascript", ".js")  # some systems know it by another name
    files = [_file(file) for file in sorted(_PAGE.iterdir())]
    # A browser asks for the parts of a page without the token.
    public = [file.path for file in files if file.path != "/"]
    return Starlette(
        routes=[*_BoardList(boards).routes(), *files],
        middleware=[Middleware(Guard, host=host, token=token, public=public)],
        lifespan=lifespan,
    )


def _file(file: Path) -> Route:
    """A file of the page. It is read once, so that a request needs no file descriptor for it."""
    content, kind = file.read_bytes(), mimetypes.guess_type(file.name)[0]

    async def send(_: Request) -> Response:
        return Response(content, media_type=kind)

    return Route("/" if file.name == "index.html" else f"/{file.name}", send)


async def _body(request: Request) -> bytes:
    """The body of a request. Raises ValueError, and reads no further, if it is too long."""
    octets = b""
    async for chunk in request.stream():
        octets += chunk
        if len(octets) > _LONGEST_MESSAGE_BYTES:
            raise ValueError("that is too long for a port")
    return octets


def _listen(host: str, port: int | None) -> socket.socket:
    """A socket that listens at `port`; None: at `HTTP_PORT`, or the next that is free.

    :raises OhmskinError: the address cannot be had.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    first, count = (HTTP_PORT, _PORTS_TRIED) if port is None else (port, 1)
    failures: list[OSError] = []
    for tried in range(first, first + count):
        try:
            return socket.create_server((host, tried), family=family)
        except OSError as exc:
            failures.append(exc)
            if isinstance(exc, socket.gaierror):
                break  # a name without an address has none at the next port either
    problem = f"{host} port {first} cannot be had: {failures[0].strerror or failures[0]}"
    remedy = "say another with --http-port; 0 is any that is free"
    if isinstance(failures[0], socket.gaierror):
        remedy = "say another with --host"
    raise OhmskinError(problem, remedy) from failures[0]


def serve(
    boards: ViewedBoards, host: str, port: int | None, started: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM; then the boards are closed. SIGINT raises KeyboardInterrupt.

    port: 0: any that is free; None: `HTTP_PORT`, or the next that is free.
    started: is called with the page's address when it can be opened.

    :raises OhmskinError: the address cannot be had.
    """
    with _server(boards, host, port, started) as (server, listening):
        server.run(sockets=[listening])


@contextmanager
def served(
    boards: ViewedBoards, host: str, port: int | None, started: Callable[[str], None]
) -> Iterator[None]:
    """As `serve`, in a thread, while the block runs."""
    with _server(boards, host, port, started) as (server, listening):
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield
        finally:
            server.should_exit = True
            thread.join()


@contextmanager
def _server(
    boards: ViewedBoards, host: str, port: int | None, started: Callable[[str], None]
) -> Iterator[tuple[Server, socket.socket]]:
    """The server of `serve`, and where it listens."""
    with boards, _listen(host, port) as listening:
        token = secrets.token_urlsafe(16)
        name = socket.gethostname() if host in ("", "0.0.0.0", "::") else host
        name = f"[{name}]" if ":" in name else name
        url = f"http://{name}:{listening.getsockname()[1]}/?token={token}"
        app = make_app(boards, host, token, lambda: started(url))
        limits = {"longest_message_bytes": _LONGEST_MESSAGE_BYTES, "shutdown_s": _SHUTDOWN_S}
        yield Server(app, **limits), listening


class Guard:
    """ASGI middleware that refuses strangers.

    host: the address at which the server listens. On loopback, the name in ``Host`` must be one of
        this machine. The port in ``Host`` is not checked: through an SSH tunnel it is another one.
    token: must be in the query.
    public: paths that need no token, because a browser asks for the parts of a page without it.
    """

    def __init__(self, app: ASGIApp, host: str, token: str, public: Collection[str]) -> None:
        self._app = app
        self._public = public
        self._token = token.encode()
        self._is_far = host not in _LOOPBACK

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 to a stranger, and let everybody else through."""
        refusal = "" if scope["type"] == "lifespan" else self._refusal(scope)
        if refusal and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        answer = PlainTextResponse(f"{refusal}\n", 403) if refusal else self._app
        await answer(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> str:
        asked = HTTPConnection(scope)
        host, origin = asked.headers.get("host", ""), asked.headers.get("origin")
        name = re.sub(r":\d*$", "", host).strip("[]").lower()
        if not self._is_far and name not in _LOOPBACK:
            return "this page is at 127.0.0.1, and by no other name"
        if scope["path"] not in self._public:
            given = asked.query_params.get("token", "")
            if not secrets.compare_digest(given.encode(), self._token):
                return "open the address that 'ohmskin view' has printed, with its token"
        changes = scope["type"] == "websocket" or scope["method"] not in _READS
        if (changes or origin is not None) and origin != f"http://{host}":
            return "only this page itself may ask that"
        return ""
