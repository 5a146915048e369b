# SPDX-License-Identifier: Apache-2.0
"""Writes recordings (`ohmskin.record.recording` says what is in them).

What is written reaches the file at least every `FLUSH_EVERY_S`, as whole chunks, or not at all: a
file of a recorder that was killed, or whose disk was full, can be read up to its last whole chunk.
"""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import suppress
from dataclasses import asdict
from io import RawIOBase
from pathlib import Path
from typing import IO, Any, Final, cast

from mcap.writer import CompressionType, Writer

from ohmskin.errors import RecordingError
from ohmskin.files import Closing
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recording import (
    LARGEST_RECORD,
    SCHEMAS,
    TOPIC,
    ForceSample,
    Mark,
    Recorded,
    Tare,
)

FLUSH_EVERY_S: Final = 0.5


class Recorder(Closing):
    """Writes a recording, from any thread, until it is closed or the disk is full.

    hello: the board's, which comes first. file: for tests, written to instead of a new file `path`.

    :raises RecordingError: the file is there already, or cannot be written. From then on nothing
        more is written, and what was written before can be read.
    """

    def __init__(
        self, path: str | os.PathLike[str], hello: Hello, *, file: RawIOBase | None = None
    ) -> None:
        self.path = Path(path)
        self.scans = self.missed = 0
        self._failure: RecordingError | None = None
        self._closed = threading.Event()
        self._lock = threading.Lock()
        try:
            self._tail = _Tail(file or cast(RawIOBase, self.path.open("xb", buffering=0)))
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another name") from None
        except OSError as exc:
            raise RecordingError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._writer = Writer(
            cast(IO[Any], self._tail),
            chunk_size=LARGEST_RECORD // 4,
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile="", library="ohmskin")
        self._channels = {name: self._channel(name) for name in SCHEMAS}
        self._flusher = threading.Thread(target=self._flush_often, name=f"flush {path}")
        try:
            self.add(hello)
            self._flush()
        except BaseException:
            self._tail.close()
            raise
        self._flusher.start()

    def _channel(self, name: str) -> int:
        properties = SCHEMAS[name]
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"ohmskin.{name}",
            "type": "object",
            "properties": properties,
            "required": list(properties),
        }
        schema_id = self._writer.register_schema(
            f"ohmskin.{name}", "jsonschema", json.dumps(schema).encode()
        )
        return self._writer.register_channel(TOPIC + name, "json", schema_id)

    def add(self, message: Recorded) -> None:
        """Keep a message.

        :raises RecordingError: the file can no longer be written.
        """
        match message:
            case Hello():
                self._write("hello", {"host_time_s": time.monotonic(), **asdict(message)})
            case Scan(codes=codes):
                content = {
                    "number": message.number,
                    "time_us": message.time_us,
                    "host_time_s": message.host_time_s,
                    "missed": message.missed,
                    "rows": message.rows,
                    "columns": message.columns,
                    "codes": codes.reshape(-1).tolist(),
                }
                self._write("scan", content, sequence=message.number & 0xFFFFFFFF)
                self.scans += 1
                self.missed += message.missed
            case Tare(rest_ratio=rest_ratio):
                content = {
                    "host_time_s": message.host_time_s,
                    "rows": rest_ratio.shape[0],
                    "columns": rest_ratio.shape[1],
                    "rest_ratio": rest_ratio.reshape(-1).tolist(),
                }
                self._write("tare", content)
            case Mark():
                self._write("mark", asdict(message))
            case ForceSample():
                self._write("force", asdict(message))

    def _write(self, name: str, content: dict[str, Any], sequence: int = 0) -> None:
        octets = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        log_ns = self._epoch_ns + round(content["host_time_s"] * 1e9)
        with self._lock:
            if self._failure is not None:
                raise self._failure
            if self._closed.is_set():
                raise RecordingError(f"{self.path}: the recording is closed")
            self._writer.add_message(self._channels[name], log_ns, octets, log_ns, sequence)

    def _flush(self) -> None:
        with self._lock:
            if self._failure is not None:
                raise self._failure
            try:
                self._writer.flush()  # type: ignore[no-untyped-call]
            except OSError as exc:
                self._fail(exc)

    def _fail(self, exc: OSError) -> None:
        self._failure = RecordingError(
            f"{self.path}: recording ended after {self.scans} scans: {exc.strerror or exc}; "
            "what is in the file can be read"
        )
        raise self._failure from exc

    def _flush_often(self) -> None:
        # A thread, because a board that falls silent must not keep its last scans from the file.
        while not self._closed.wait(FLUSH_EVERY_S):
            try:
                self._flush()
            except RecordingError:
                return  # the next `add` or `close` raises it

    def close(self) -> None:
        """Write what is left, and the file's index. May be called again.

        :raises RecordingError: that could not be written.
        """
        if self._closed.is_set():
            return
        self._closed.set()
        self._flusher.join()
        try:
            self._flush()
            with self._lock:
                try:
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    self._tail.flush(sync=True)
                except OSError as exc:
                    self._fail(exc)
        finally:
            self._tail.close()


class _Tail:
    """The file as `Writer` sees it: grows by whole flushes, or by nothing at all."""

    def __init__(self, file: RawIOBase) -> None:
        self._file = file
        self._written = 0
        self._waiting = bytearray()

    def tell(self) -> int:
        return self._written + len(self._waiting)

    def write(self, octets: bytes) -> int:
        self._waiting += octets
        return len(octets)

    def flush(self, *, sync: bool = False) -> None:
        view = memoryview(bytes(self._waiting))
        try:
            at = 0
            while at < len(view):
                at += self._file.write(view[at:]) or 0
            if sync:
                with suppress(ValueError):  # a file of the tests
                    os.fsync(self._file.fileno())
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._written)
            raise
        self._written += len(view)
        self._waiting.clear()

    def close(self) -> None:
        self._file.close()
