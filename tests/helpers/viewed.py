# SPDX-License-Identifier: Apache-2.0
"""The server of ``ohmskin view`` without a browser, and the page's end of it."""

import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from ohmskin.force.calibration import Calibration
from ohmskin.view.boards import ViewedBoards
from ohmskin.view.server import make_app

GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"
REST = "emulator://8x8?scene=rest&seed=1"
HOST = "127.0.0.1:8765"
ORIGIN = f"http://{HOST}"
TOKEN = "secret"
LIMIT_S = 60.0  # a server that says nothing for so long hangs, on a busy machine too

Message = dict[str, Any]


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
