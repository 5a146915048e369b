# SPDX-License-Identifier: Apache-2.0
"""One panel of a page: a websocket over which a board is shown and commanded.

The page is sent texts (JSON) whose ``kind`` is state, notice or clock, and scans (bytes:
`Shown.message`). Always the newest scan is sent, and the next one only after the page has
acknowledged it, so that nothing queues up. The page sends texts (JSON) whose ``do`` is a command of
`Panel._asked`, "ack" with ``scan``, or "clock" with ``page_ms``, which is answered by the host's
clock.
"""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import anyio
from anyio.abc import TaskGroup
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from ohmskin.errors import OhmskinError, TareRefused
from ohmskin.view.boards import ViewedBoard
from ohmskin.view.kneaded import KneadedBoard
from ohmskin.view.shown import Shown

# The close code of a websocket whose board was closed, by this page or by another. page/wire.js has
# the same. Chosen: one of 4000 to 4999, which RFC 6455 leaves to programs.
GONE_CODE: Final = 4001
# A larger time of a page's clock is not sent back [ms], because JavaScript reads numbers that are
# too large as infinite. Chosen: a page counts from its beginning, and 1e15 ms are 30,000 years.
_MOST_MS: Final = 1e15
# A page may have so many commands under way. Chosen: more than anybody gives in a second, which is
# what a tare takes.
MOST_COMMANDS: Final = 4
_Command = Callable[[], str]


class Panel:
    """Serves one connection until the page or the board goes."""

    def __init__(self, board: ViewedBoard | KneadedBoard, socket: WebSocket) -> None:
        self._board = board
        self._socket = socket
        self._news = asyncio.Event()
        self._sent: Shown | None = None
        self._under_way = 0  # commands
        self._awaited: int | None = None  # number of the scan that is not yet acknowledged

    async def serve(self) -> None:
        """Serve it. Returns when the page or the board has gone."""
        await self._socket.accept()
        loop = asyncio.get_running_loop()

        def wake() -> None:
            with suppress(RuntimeError):  # the loop has just ended
                loop.call_soon_threadsafe(self._news.set)

        self._board.watchers.add(wake)
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._send)
                tasks.start_soon(self._receive, tasks)
        except* (WebSocketDisconnect, WebSocketDisconnected):  # the page or the board has gone
            pass
        finally:
            self._board.watchers.discard(wake)

    async def _send(self) -> None:
        said = None
        self._news.set()
        while True:
            await self._news.wait()
            self._news.clear()
            if self._board.closing.is_set():
                await self._socket.close(GONE_CODE)
                raise WebSocketDisconnect(GONE_CODE)
            state, shown = self._board.state(), self._board.shown
            if state != said:
                said = state
                await self._say("state", **state)
            if shown is not None and shown is not self._sent and self._awaited is None:
                self._sent, self._awaited = shown, shown.number
                await self._socket.send_bytes(shown.message)

    async def _say(self, kind: str, **content: Any) -> None:
        await self._socket.send_text(json.dumps({"kind": kind, **content}))

    async def _receive(self, tasks: TaskGroup) -> None:
        while True:
            await asyncio.sleep(0)  # lets other tasks run, however much this page sends
            received = await self._socket.receive()
            if received["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(received.get("code", 1000))
            try:
                message = json.loads(received.get("text") or "")
            except (ValueError, RecursionError):
                message = None
            match message:
                case {"do": "ack", "scan": int(number)}:
                    if number == self._awaited:
                        self._awaited = None
                        self._news.set()
                case {"do": "clock", "page_ms": int() | float() as at_ms} if abs(at_ms) < _MOST_MS:
                    await self._say("clock", page_ms=at_ms, host_s=time.monotonic())
                case _:
                    await self._take(self._asked(message), tasks)

    async def _take(self, command: tuple[str, _Command] | None, tasks: TaskGroup) -> None:
        """Begin a command, unless it is unknown (None) or too many are under way."""
        if command is not None and self._under_way < MOST_COMMANDS:
            self._under_way += 1
            tasks.start_soon(self._run, *command)
            return
        text = "one thing at a time: the last ones are not done yet"
        if command is None:
            text = "the page has asked for what this program does not know"
        await self._say("notice", text=text, good=False, refused="")

    def _asked(self, message: object) -> tuple[str, _Command] | None:
        board = self._board
        if not isinstance(board, ViewedBoard):  # it takes no commands
            return None
        match message:
            case {"do": "method", "method": str(method)}:
                return "method", lambda: board.use(method)
            case {"do": "tare", "force": bool(force)}:
                return "tare", lambda: board.take_rest(force=force)
            case {"do": "focus", "on": bool(on)}:
                return "focus", lambda: board.follow(on)
            case {"do": "undo"}:
                return "undo", board.undo_tare
            case {"do": "record"}:
                return "record", board.record
            case {"do": "stop"}:
                return "stop", board.stop_recording
            case {"do": "mark", "text": str(text)}:
                return "mark", lambda: board.mark(text)
        return None

    async def _run(self, name: str, command: _Command) -> None:
        try:
            answer = {"text": await anyio.to_thread.run_sync(command), "good": True, "refused": ""}
        except (OhmskinError, ValueError, OSError) as exc:
            refused = name if isinstance(exc, TareRefused) else ""
            answer = {"text": str(exc), "good": False, "refused": refused}
        finally:
            self._under_way -= 1
        await self._say("notice", **answer)
