# SPDX-License-Identifier: Apache-2.0
"""The connections of the page's server: how many there may be, and how long they may take.

Every program of this machine can connect, and needs no token for that. So that nobody who has none
can take the descriptors, the time or the terminal of this program, a connection *waits* from its
begin until it ends or a panel is accepted on it, and those that wait are few and short-lived. Where
too many wait, the oldest goes: whoever sends a request at once is answered, however many do not.
"""

import asyncio
import socket
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol
from wsproto.events import Ping

# So many connections may wait. Chosen: a browser opens 6 at once; with the panels of all pages they
# need less than the 256 descriptors that some systems allow a program.
MOST_WAITING: Final = 64
# A connection may wait so long [s]. Chosen: a request and its answer take milliseconds.
LONGEST_WAIT_S: Final = 5.0
# So many connections are accepted before those that came earlier are looked after. Chosen: far
# fewer than may wait, so that a request is read before newer connections push it out.
_ACCEPTED_AT_ONCE: Final = 8
# The system keeps so many for this program while it is busy. Chosen: as many as systems allow.
_QUEUE: Final = 1024
# The system keeps so much that a page has sent until it is read [byte]. Chosen: a page's messages
# are short; what is read at once holds up all other pages.
_RECEIVED_BYTES: Final = 16_384
# A request's line and headers have at most so many bytes. Chosen: those of browsers have some 1000.
_LONGEST_HEADERS_BYTES: Final = 16_384


class Waiting:
    """The connections of one server that wait."""

    def __init__(self) -> None:
        self._until: dict[asyncio.BaseTransport, asyncio.TimerHandle] = {}

    def add(self, connection: asyncio.Transport) -> None:
        """It waits from now on; where that makes too many, the oldest is cut off."""
        while len(self._until) >= MOST_WAITING:
            oldest = next(iter(self._until))
            self.remove(oldest)
            oldest.abort()  # type: ignore[attr-defined]  # only transports with it are added
        later = asyncio.get_running_loop().call_later
        self._until[connection] = later(LONGEST_WAIT_S, connection.abort)

    def remove(self, connection: asyncio.BaseTransport) -> None:
        """It waits no longer, or never did."""
        if (timer := self._until.pop(connection, None)) is not None:
            timer.cancel()


class _Waits(asyncio.Protocol):
    """What both kinds of connections do beside uvicorn's own work."""

    app_state: dict[str, Any]
    transport: asyncio.Transport

    def connection_lost(self, exc: Exception | None) -> None:
        self.app_state["waiting"].remove(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        try:
            super().data_received(data)
        except Exception:  # of a parser, which no line on the terminal of the user explains
            self.transport.abort()


class _Http(_Waits, H11Protocol):
    """A connection until its request is answered, or is found to ask for a websocket."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.app_state["waiting"].add(transport)

    def send_400_response(self, msg: str) -> None:
        # What is no request has no answer: it may come amid that to the request before.
        self.transport.abort()


class _WebSocket(_Waits, WSProtocol):
    """A connection that has asked for a websocket; it waits until it is accepted."""

    async def send(self, message: Any) -> None:
        await self.writable.wait()
        # The server closes it after a message that is too long. If a scan is sent after that,
        # uvicorn would raise what it raises for a defect of the program.
        if self.close_sent:
            raise ClientDisconnected
        await super().send(message)
        if message["type"] == "websocket.accept":
            self.app_state["waiting"].remove(self.transport)

    def handle_ping(self, event: Ping) -> None:
        if self.writable.is_set():  # who reads no answers gets none: they would pile up
            super().handle_ping(event)


class Server(uvicorn.Server):
    """Serves `app`, whose lifespan has a `Waiting` in its state, as ``waiting``.

    longest_message_bytes: a websocket that brings a longer message is closed.
    shutdown_s: connections have so long to end.
    """

    def __init__(self, app: Any, *, longest_message_bytes: int, shutdown_s: int) -> None:
        config = uvicorn.Config(
            app,
            http=_Http,
            ws=_WebSocket,
            ws_max_size=longest_message_bytes,
            # The size would be looked at only after a message of another size is unpacked.
            ws_per_message_deflate=False,
            h11_max_incomplete_event_size=_LONGEST_HEADERS_BYTES,
            backlog=_ACCEPTED_AT_ONCE,
            log_config=None,
            log_level="error",  # a stranger's request that is none is worth no line
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=shutdown_s,
        )
        super().__init__(config)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen. asyncio accepts as many at once as may queue up, unless it is told afterwards."""
        for each in sockets or ():
            each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED_BYTES)
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(_QUEUE)
