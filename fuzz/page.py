# SPDX-License-Identifier: Apache-2.0
"""The page's server before the token: connections of strangers, without sockets and in no time."""

import asyncio
import logging
from pathlib import Path
from typing import Any

from ohmskin.view.boards import ViewedBoards
from ohmskin.view.connections import LONGEST_WAIT_S, MOST_WAITING, Server, Waiting
from ohmskin.view.server import make_app

# Turns of the loop in which a request is answered, or a connection that was cut off is forgotten.
_TURNS = 20


class _Stranger(asyncio.Transport):
    """A connection. What it is told is in `told`."""

    def __init__(self, server: "Strangers") -> None:
        super().__init__({"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 8765)})
        self.told, self.is_open = b"", True
        self.protocol: Any = server.protocol()
        self._lost = lambda: server.loop.call_soon(self.protocol.connection_lost, None)
        self.protocol.connection_made(self)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        self.protocol = protocol

    def write(self, data: Any) -> None:
        self.told += bytes(data)

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            self._lost()

    abort = close

    def is_closing(self) -> bool:
        return not self.is_open

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass


class Strangers(logging.Handler):
    """A server whose time passes when it is told. It keeps what would be printed."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s, self.printed = 0.0, list[str]()
        self.loop = asyncio.new_event_loop()
        self.loop.time = lambda: self.now_s  # type: ignore[method-assign]
        self.loop.set_exception_handler(lambda _, context: self.printed.append(str(context)))
        app = make_app(ViewedBoards((), (), Path(), force=False), "127.0.0.1", "the token")
        self._server = Server(app, longest_message_bytes=8192, shutdown_s=2)
        self._server.config.load()
        self._state = {"waiting": Waiting()}

    def emit(self, record: logging.LogRecord) -> None:
        self.printed.append(self.format(record))

    def protocol(self) -> asyncio.Protocol:
        made: asyncio.Protocol = self._server.config.http_protocol_class(  # type: ignore[operator]
            config=self._server.config,
            server_state=self._server.server_state,
            app_state=self._state,
            _loop=self.loop,
        )
        return made

    async def _turns(self) -> None:
        for _ in range(_TURNS):
            await asyncio.sleep(0)

    def pass_s(self, seconds: float) -> None:
        self.now_s += seconds
        self.loop.run_until_complete(self._turns())

    def meet(self, stretches: list[tuple[int, bytes]]) -> None:
        """Each stretch is said by one of eight strangers, or ends one, or lets a second pass.

        A stranger who was cut off connects again.
        """
        logs = [logging.getLogger(name) for name in ("uvicorn.error", "asyncio")]
        for log in logs:
            log.addHandler(self)
        try:
            self._meet(stretches)
        finally:
            for log in logs:
                log.removeHandler(self)

    def _meet(self, stretches: list[tuple[int, bytes]]) -> None:
        there: dict[int, _Stranger] = {}
        ever: list[_Stranger] = []

        async def do(kind: int, content: bytes) -> None:
            one = there.get(kind % 8)
            if one is None or not one.is_open:
                one = there[kind % 8] = _Stranger(self)
                ever.append(one)
            match kind // 8 % 4:
                case 0 | 1 if content:  # a loop never brings nothing
                    one.protocol.data_received(content)
                case 2:
                    one.protocol.eof_received()
                    one.close()
                case 3:
                    self.now_s += 1.0
            await self._turns()

        for kind, content in stretches[: 2 * MOST_WAITING]:
            self.loop.run_until_complete(do(kind, content))
            assert sum(one.is_open for one in ever) <= MOST_WAITING
        self.pass_s(LONGEST_WAIT_S + 1)
        self.pass_s(0)
        assert not any(one.is_open for one in ever), "a connection stays"
        assert not self.printed, self.printed
        assert not asyncio.all_tasks(self.loop), "a request is never answered"
        for one in ever:
            check(one.told)


def check(told: bytes) -> None:
    """A stranger is told what the page's own files are, that it is refused, or nothing."""
    head, _, _ = told.partition(b"\r\n\r\n")
    assert not told or told.count(b"HTTP/1.1") == 1, told
    if told[9:12] == b"200":
        assert b"text/javascript" in head or b"text/css" in head or b"image/" in head, told
    else:
        assert told[9:10] in (b"", b"4"), told
