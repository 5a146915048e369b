# SPDX-License-Identifier: Apache-2.0
"""Measure what those without the token can do to the page of ``ohmskin view``.

    make bench-strangers
    .venv/bin/python benchmarks/bench_strangers.py

The server is a process of its own with an emulated 8x8 skin at 90 Hz, and may have 1,024
descriptors. A page looks at it and records. Then strangers connect, keep their connections, and say
nothing, begin a request, send a request and no body, send what is no request, or ask for a file.

strangers              how many.
flood_ratio            the same while FLOOD_HZ others a second connect and say that; 500 stay.
left_open              connections of theirs that are open 10 s after the first.
new_page_s             until another page with the token has its first scan, meanwhile.
scans_ratio            scans/s of the page that looks, among strangers, over those before.
missed                 scans that the recording lacks.
stderr_bytes           what the server prints.
"""

from __future__ import annotations

import json
import resource
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, Ping, Request, TextMessage

from bars import Part, at_least, at_most, run  # beside this file
from ohmskin.record.recording import load_recording

STRANGERS = 2000
DESCRIPTORS = 1024
SECONDS = 5.0  # scans are counted for so long, before and after. Chosen.
CLOSED_AFTER_S = 10.0
FLOOD_HZ = 2000
SAID = (
    b"",
    b"GET / HTTP/1.1\r\n",
    b"POST /boards HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 999\r\n\r\nx",
    b"\x16\x03\x01\r\n\r\n",
    b"GET /page.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
)


class Page:
    """A page that looks at the first board, and acknowledges its scans."""

    def __init__(self, url: str) -> None:
        host, _, query = url.removeprefix("http://").partition("/?")
        self._socket = socket.create_connection(host.split(":"), timeout=20)  # type: ignore[arg-type]
        self._line = WSConnection(ConnectionType.CLIENT)
        origin = [(b"origin", f"http://{host}".encode())]
        asks = Request(host=host, target=f"/boards/0?{query}", extra_headers=origin)
        self._socket.sendall(self._line.send(asks))
        self._scan = b""

    def say(self, **message: object) -> None:
        self._socket.sendall(self._line.send(TextMessage(json.dumps(message))))

    def scans(self, seconds: float, most: int = 1_000_000) -> int:
        """How many come within this time, or until there are so many."""
        count, end_s = 0, time.monotonic() + seconds
        while count < most and time.monotonic() < end_s:
            self._line.receive_data(self._socket.recv(65536))
            for event in self._line.events():
                assert isinstance(event, AcceptConnection | TextMessage | BytesMessage | Ping), (
                    event
                )
                if isinstance(event, Ping):
                    self._socket.sendall(self._line.send(event.response()))
                if isinstance(event, BytesMessage):
                    self._scan += event.data
                    if event.message_finished:
                        self._acknowledge()
                        count += 1
        return count

    def _acknowledge(self) -> None:
        (length,) = struct.unpack_from("<I", self._scan)
        self.say(do="ack", scan=json.loads(self._scan[4 : 4 + length])["scan"])
        self._scan = b""

    def close(self) -> None:
        self._socket.close()


def is_open(connection: socket.socket) -> bool:
    """Whether the server has not closed it."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


def connect(port: int, said: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    with suppress(OSError):  # it is cut off already
        connection.sendall(said)
    return connection


def flood(port: int, seconds: float) -> None:
    """Strangers who come and go. The last line says how many."""
    begin_s, count, there = time.monotonic(), 0, deque[socket.socket](maxlen=500)
    while (passed_s := time.monotonic() - begin_s) < seconds:
        if count > FLOOD_HZ * passed_s:
            time.sleep(0.001)
            continue
        with suppress(OSError):
            there.append(connect(port, SAID[count % len(SAID)]))
        count += 1
    print(round(count / seconds))


def measure(part: Part) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    count, seconds = part.of(STRANGERS), max(0.5, part.share * SECONDS)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, STRANGERS + DESCRIPTORS), hard))
    command = [sys.executable, "-m", "ohmskin", "view", "emulator://8x8?scene=moving"]
    command += ["--http-port", "0", "--no-browser"]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        errors = stack.enter_context((folder / "stderr").open("wb"))
        server = subprocess.Popen(
            command,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, hard)),
        )
        stack.callback(server.wait)
        stack.callback(server.terminate)
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        page = Page(url)
        page.scans(2.0)
        page.say(do="record")
        before = page.scans(seconds) / seconds
        begin_s = time.monotonic()
        port = int(url.split("/")[2].rpartition(":")[2])
        strangers = [connect(port, SAID[index % len(SAID)]) for index in range(count)]
        asked_s = time.monotonic()
        new = Page(url)
        new.scans(20.0, most=1)
        new_page_s = time.monotonic() - asked_s
        new.close()
        page.scans(0.2)  # what has come meanwhile
        among = page.scans(seconds) / seconds
        page.scans(max(0.0, begin_s + CLOSED_AFTER_S - time.monotonic()))
        left_open = sum(map(is_open, strangers))
        for each in strangers:
            each.close()
        flooding = [sys.executable, __file__, "flood", str(port), str(seconds + 1)]
        with subprocess.Popen(flooding, stdout=subprocess.PIPE, text=True) as others:
            page.scans(1.0)
            in_flood = page.scans(seconds) / seconds
            flood_hz = int(others.communicate()[0])
        page.say(do="stop")
        page.scans(1.0)
        recording = load_recording(next(folder.glob("*.mcap")))
        return {
            "strangers": count,
            "left_open": left_open,
            "new_page_s": round(new_page_s, 2),
            "scans_ratio": round(among / before, 2),
            "flood_hz": flood_hz,
            "flood_ratio": round(in_flood / before, 2),
            "missed": sum(scan.missed for scan in recording.scans[1:]),
            "stderr_bytes": (folder / "stderr").stat().st_size,
        }


BARS = (
    at_most("left_open", 0),
    at_most("new_page_s", 5),
    at_least("scans_ratio", 0.8),
    at_least("flood_ratio", 0.8),
    at_most("missed", 0),
    at_most("stderr_bytes", 1000),
)


if __name__ == "__main__":
    if sys.argv[1:2] == ["flood"]:
        flood(int(sys.argv[2]), float(sys.argv[3]))
        sys.exit()
    sys.exit(run(__doc__, measure, BARS))
