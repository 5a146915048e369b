# SPDX-License-Identifier: Apache-2.0
"""The server of the page: a few files, the list of boards, a websocket for each panel."""

import json
import secrets
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Final

import anyio
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from ohmskin.errors import OhmskinError
from ohmskin.link.serial_port import serial_ports
from ohmskin.view.access import Guard, is_loopback
from ohmskin.view.boards import ViewedBoards
from ohmskin.view.panel import Panel

_PAGE: Final = Path(__file__).parent / "page"
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_LONGEST_PORT: Final = 500
_LONGEST_MESSAGE: Final = 8192  # of the page, in bytes
_SHUTDOWN_S: Final = 2


def make_app(boards: ViewedBoards, host: str, token: str | None = None) -> Starlette:
    """The page of `boards`, which closes them at its end. host, token: see `Guard`."""

    async def ports(request: Request) -> Response:
        return JSONResponse(
            [asdict(found) for found in await anyio.to_thread.run_sync(serial_ports)]
        )

    async def list_boards(request: Request) -> Response:
        return JSONResponse([{"number": n, "port": p} for n, p in boards.ports().items()])

    async def add_board(request: Request) -> Response:
        try:
            asked = json.loads(await _body(request))
            place = asked["port"].strip()
            if not 0 < len(place) <= _LONGEST_PORT or not place.isprintable():
                raise ValueError("a port is a serial port's name or a URL")
            return JSONResponse({"number": boards.add(place), "port": place})
        except (KeyError, TypeError, AttributeError, RecursionError):
            return JSONResponse({"error": "say which port"}, 400)
        except ValueError as exc:
            return JSONResponse({"error": str(exc)}, 400)

    async def remove_board(request: Request) -> Response:
        await anyio.to_thread.run_sync(boards.remove, request.path_params["number"])
        return Response(status_code=204)

    async def panel(connection: WebSocket) -> None:
        board = boards.find(connection.path_params["number"])
        if board is None:
            await connection.close()
        else:
            await Panel(board, connection).serve()

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        await anyio.to_thread.run_sync(boards.close)

    files = _files()
    public = [path for path in files if path != "/"]
    return Starlette(
        routes=[
            *(Route(path, _file(name), methods=["GET"]) for path, name in files.items()),
            Route("/ports", ports),
            Route("/boards", list_boards, methods=["GET"]),
            Route("/boards", add_board, methods=["POST"]),
            Route("/boards/{number:int}", remove_board, methods=["DELETE"]),
            WebSocketRoute("/boards/{number:int}", panel),
        ],
        middleware=[Middleware(Guard, host=host, token=token, public=public)],
        lifespan=lifespan,
    )


async def _body(request: Request) -> bytes:
    octets = b""
    async for chunk in request.stream():
        octets += chunk
        if len(octets) > _LONGEST_MESSAGE:
            raise ValueError("that is too long for a port")
    return octets


def _files() -> dict[str, str]:
    """Name of each file of the page, by its path."""
    names = sorted(file.name for file in _PAGE.iterdir() if file.suffix in _TYPES)
    return {"/" if name == "index.html" else f"/{name}": name for name in names}


def _file(name: str) -> Callable[[Request], Response]:
    content = (_PAGE / name).read_bytes()
    media_type = _TYPES[Path(name).suffix]

    def answer(request: Request) -> Response:
        return Response(content, media_type=media_type)

    return answer


def serve(
    boards: ViewedBoards, host: str, port: int, started: Callable[[str], None] = lambda url: None
) -> None:
    """Serve until SIGINT or SIGTERM; then the boards are closed. SIGINT raises KeyboardInterrupt.

    port: 0: any that is free. started: is called with the page's address when it can be opened.

    :raises OhmskinError: the address cannot be had.
    """
    with boards, _listening(host, port) as listening:
        number = listening.getsockname()[1]
        token = None if is_loopback(host) else secrets.token_urlsafe(16)
        name = socket.gethostname() if host in ("0.0.0.0", "::") else host
        name = f"[{name}]" if ":" in name else name
        started(f"http://{name}:{number}/" + ("" if token is None else f"?token={token}"))
        app = make_app(boards, host, token)
        config = uvicorn.Config(
            app,
            ws="wsproto",
            ws_max_size=_LONGEST_MESSAGE,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_SHUTDOWN_S,
        )
        uvicorn.Server(config).run(sockets=[listening])


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as exc:
        raise OhmskinError(
            f"{host} port {port} cannot be had: {exc.strerror or exc}: say another with "
            "--http-port; 0 is any that is free"
        ) from exc
