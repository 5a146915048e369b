# SPDX-License-Identifier: Apache-2.0
"""Writes recordings (`ohmskin.record.recording` says what is in them).

What is added reaches the file within `FLUSH_EVERY_S`, as a chunk. The file of a recorder that was
killed, or whose disk was full, can be read up to its last whole chunk.
"""

import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Final

from mcap.writer import Writer

from ohmskin.errors import RecordingError
from ohmskin.files import Closing, PathName
from ohmskin.link.device import Device, mean_ratio, scans_for
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.force_sensor import ForceSensor
from ohmskin.record.recording import (
    KINDS,
    LARGEST_RECORD,
    SCHEMAS,
    TOPIC,
    ForceSample,
    Recorded,
    Tare,
)

# A recording that is killed lacks what came in so long, and while that was written [s]: below 0.5.
FLUSH_EVERY_S: Final = 0.4
# A record of an MCAP file begins with its kind and 8 bytes of its length.
_HEAD_SIZE: Final = 9


class Recorder(Closing):
    """Writes a recording, from any thread, until it is closed, removed, or the disk is full.

    board: what the board says of itself, which comes first. scans, missed, forces: counts of what
    was added. size: bytes of the file. board, tare, force: the newest that was added.

    :raises RecordingError: the file is there already, or cannot be written. From then on nothing
        more is written, and what was written before can be read.
    """

    def __init__(self, path: PathName, board: Hello) -> None:
        self.path = Path(path)
        self.scans = self.missed = self.forces = 0
        self.size = self._readable = 0
        self.board = board
        self.tare: Tare | None = None
        self.force: ForceSample | None = None
        self._failure: RecordingError | None = None
        self._closed = threading.Event()
        self._lock = threading.Lock()
        try:
            self._file = self.path.open("xb")
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another name") from None
        except OSError as exc:
            raise RecordingError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
        self._links = os.fstat(self._file.fileno()).st_nlink
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._writer = Writer(self._file, chunk_size=LARGEST_RECORD // 4)
        self._flusher = threading.Thread(target=self._flush_often, name=f"flush {path}")
        try:
            with self._writing():
                self._writer.start(profile="", library="ohmskin")
                self._channels = {name: self._channel(name) for name in SCHEMAS}
            self.add(board)
            self._flush()
        except BaseException:
            with suppress(OSError):
                self._file.close()
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
        name = next(name for name, kind in KINDS.items() if isinstance(message, kind))
        content = {"host_time_s": time.monotonic(), **vars(message)}
        for array in {"codes", "rest_ratio"} & SCHEMAS[name].keys():
            readings = content[array]
            rows, columns, _ = readings.shape
            content |= {"rows": rows, "columns": columns, array: readings.reshape(-1).tolist()}
        number = content.get("number", 0) & 0xFFFFFFFF
        content = {key: content[key] for key in SCHEMAS[name]}
        octets = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        log_ns = self._epoch_ns + round(content["host_time_s"] * 1e9)
        with self._writing():
            if self._closed.is_set():
                raise RecordingError(f"{self.path}: the recording is closed")
            self._writer.add_message(self._channels[name], log_ns, octets, log_ns, number)
            match message:
                case Hello():
                    self.board = message
                case Scan():
                    self.scans += 1
                    self.missed += message.missed
                case Tare():
                    self.tare = message
                case ForceSample():
                    self.force = message
                    self.forces += 1

    def _flush(self) -> None:
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._kept()

    def _kept(self) -> None:
        """Count what reached the file, if there still is one."""
        self._readable, self.size = self.scans, self._file.tell()
        if os.fstat(self._file.fileno()).st_nlink < self._links:
            self._failure = RecordingError(
                f"{self.path}: recording ended: somebody has removed the file, and {self.scans} "
                "scans with it: record to a new one"
            )
            raise self._failure

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """One thread at a time, and none after the file could not be written once."""
        with self._lock:
            if self._failure is not None:
                raise self._failure
            try:
                yield
            except OSError as exc:
                with suppress(OSError), self.path.open("rb") as file:
                    # The last chunk may be whole, and only the index after it cut off.
                    file.seek(self.size)
                    size = int.from_bytes(file.read(_HEAD_SIZE)[1:], "little")
                    if self.size + _HEAD_SIZE + size <= os.fstat(file.fileno()).st_size:
                        self._readable = self.scans
                self._failure = RecordingError(
                    f"{self.path}: recording ended: {exc.strerror or exc}; {self._readable} scans "
                    "are in the file and can be read"
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
            with self._writing():
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
                self._kept()
                os.fsync(self._file.fileno())
        finally:
            with suppress(OSError):  # what did not fit still does not
                self._file.close()


def record(
    skin: Device,
    recorder: Recorder,
    scans: Iterable[Scan],
    *,
    count: int = 0,
    seconds: float = 0.0,
    tare_s: float = 0.0,
    sensor: ForceSensor | None = None,
    beside: Callable[[Scan], None] | None = None,
) -> None:
    """Record these scans of `skin`: all of them, or so many, or those of so many seconds (0: all).

    What the board says of itself is recorded whenever it changes. tare_s: the mean of the scans of
    so many seconds at first is recorded as a tare, also if less of them come. sensor: its forces
    are recorded as well. beside: is called after each scan.

    :raises RecordingError: as `Recorder.add`.
    :raises DeviceLost: as `ForceSensor.take`.
    """

    def keep(scan: Scan) -> None:
        if skin.info is not recorder.board:
            recorder.add(skin.info)
        recorder.add(scan)
        for sample in sensor.take() if sensor is not None else ():
            recorder.add(sample)
        if beside is not None:
            beside(scan)

    coming = islice(scans_for(scans, seconds or math.inf), count or None)
    untouched: list[Scan] = []
    try:
        for scan in scans_for(coming, tare_s) if tare_s else ():
            keep(scan)
            untouched.append(scan)
    finally:
        if untouched:
            recorder.add(Tare(mean_ratio(untouched), time.monotonic(), untouched[-1].mode))
    for scan in coming:
        keep(scan)
