# SPDX-License-Identifier: Apache-2.0
"""Writes recordings (`ohmskin.record.recording` says what is in them).

What is added reaches the file within `FLUSH_EVERY_S`, as a chunk. The file of a recorder that was
killed, or whose disk was full, can be read up to its last whole chunk. So whoever records for an
hour loses half a second at most, whatever happens to the program.
"""

import atexit
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
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
    LARGEST_RECORD_BYTES,
    SCHEMAS,
    TOPIC,
    ForceSample,
    Recorded,
    Tare,
    check_message,
)

# Messages are kept for so long before they are written [s]. If the recorder is killed, the file
# lacks them, and what came while they were written. Chosen: together less than half a second.
FLUSH_EVERY_S: Final = 0.4


class Recorder(Closing):
    """Writes a recording, from any thread, until it is closed, removed, or the disk is full.

    board: what the board says of itself, written at once; as an attribute, the newest that was
        added.
    now_s: gives the time by the clock of `Scan.host_time_s` [s]. Whoever adds a mark or a tare
        takes its time from here, so that all messages are on one clock, also where the time of a
        skin is stepped.
    tare: the newest tare that was added; None if none was.
    force: the newest force that was added; None if none was.
    scans: how many scans were added.
    missed: how many scans were missed before the scans that were added.
    forces: how many forces were added.
    size: bytes of the file.
    failure: why nothing more is written; None as long as all is well. `add` and `close` raise it.

    :raises RecordingError: the file is there already, or cannot be written. From then on nothing
        more is written, and what was written before can be read.
    """

    def __init__(
        self, path: PathName, board: Hello, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.path = Path(path)
        self.now_s = now_s
        self.scans = self.missed = self.forces = self.size = 0
        self._readable = 0  # scans that have been written to the file
        self.board = board
        self.tare: Tare | None = None
        self.force: ForceSample | None = None
        self.failure: RecordingError | None = None
        self._closed = threading.Event()
        self._lock = threading.Lock()
        try:
            self._file = self.path.open("xb")
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another name") from None
        except OSError as exc:
            raise RecordingError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
        # The number of names that the file has. If it becomes less, somebody has removed the file.
        self._links = os.fstat(self._file.fileno()).st_nlink
        # Added to a time of `now_s`, it gives the time since 1970 [ns].
        self._epoch_ns = time.time_ns() - round(1e9 * now_s())
        # The writer ends a chunk of this size by itself; `flush` ends it long before.
        self._writer = Writer(self._file, chunk_size=LARGEST_RECORD_BYTES // 4)
        self._flusher = threading.Thread(
            target=self._flush_often, name=f"flush {path}", daemon=True
        )
        try:
            with self._writing():
                self._writer.start(profile="", library="ohmskin")
                self._channels = {name: self._channel(name) for name in SCHEMAS}
            self.add(board)
            self.flush()
        except BaseException:
            with suppress(OSError):
                self._file.close()
            raise
        self._flusher.start()
        atexit.register(self.close)  # for programs that end by an error

    def _channel(self, name: str) -> int:
        """Make the channel of a topic, with its schema. Returns the channel's id."""
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
        :raises ValueError: a mark is longer than readers take.
        :raises TypeError: it is none of these messages.
        """
        name = next((name for name, kind in KINDS.items() if isinstance(message, kind)), None)
        if name is None:
            kinds = ", ".join(kind.__name__ for kind in KINDS.values())
            raise TypeError(f"a recording has {kinds}, and no {type(message).__name__}")
        content = {"host_time_s": self.now_s(), **vars(message)}
        for array in {"codes", "rest_ratio"} & SCHEMAS[name].keys():
            readings = content[array]
            rows, columns, _ = readings.shape
            content |= {"rows": rows, "columns": columns, array: readings.reshape(-1).tolist()}
        number = content.get("number", 0) & 0xFFFFFFFF  # MCAP has 32 bits for it
        content = {key: content[key] for key in SCHEMAS[name]}
        octets = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        check_message(name, octets)
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

    def flush(self) -> None:
        """Write what was added to the file now, as a chunk.

        :raises RecordingError: as `add`.
        """
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._count_written()

    def _count_written(self) -> None:
        """Note how much has been written. Raises RecordingError if the file was removed."""
        self._readable, self.size = self.scans, self._file.tell()
        if os.fstat(self._file.fileno()).st_nlink < self._links:
            # The system keeps a removed file until it is closed, so that writing does not fail.
            self.failure = RecordingError(
                f"{self.path}: recording ended: somebody has removed the file, and {self.scans} "
                "scans with it: record to a new one"
            )
            raise self.failure

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Let one thread write at a time, and none after the file could not be written once."""
        with self._lock:
            if self.failure is not None:
                raise self.failure
            try:
                yield
            except OSError as exc:
                self.failure = RecordingError(
                    f"{self.path}: recording ended: {exc.strerror or exc}; {self._readable} scans "
                    "are in the file and can be read"
                )
                raise self.failure from exc

    def _flush_often(self) -> None:
        # In a thread, so that the last scans of a board get into the file even if it falls silent.
        while not self._closed.wait(FLUSH_EVERY_S):
            try:
                self.flush()
            except RecordingError:
                return  # the next `add` or `close` raises it

    def close(self) -> None:
        """Write what is left, and the file's index. May be called again.

        :raises RecordingError: that could not be written.
        """
        if self._closed.is_set():
            return
        self._closed.set()
        atexit.unregister(self.close)
        self._flusher.join()
        try:
            with self._writing():
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
                self._count_written()
                os.fsync(self._file.fileno())
        finally:
            with suppress(OSError):  # what did not fit still does not
                self._file.close()


def record(
    skin: Device,
    recorder: Recorder,
    scans: Iterable[Scan],
    *,
    tare_s: float = 0.0,
    sensor: ForceSensor | None = None,
    beside: Callable[[Scan], None] | None = None,
) -> None:
    """Record scans of `skin` until there are no more.

    What the board says of itself is recorded whenever it changes.

    tare_s: the mean of the scans of the first so many seconds is recorded as a tare, even if the
        scans end before that; 0: no tare.
    sensor: its forces are recorded beside the scans.
    beside: is called after each scan, when it is recorded.

    :raises RecordingError: as `Recorder.add`.
    :raises DeviceLost: as `ForceSensor.take`.
    """

    def keep(scan: Scan) -> None:
        board = scan.board or skin.info
        if board is not recorder.board:
            recorder.add(board)
        recorder.add(scan)
        for sample in sensor.take() if sensor is not None else ():
            recorder.add(sample)
        if beside is not None:
            beside(scan)

    coming = iter(scans)
    untouched: list[Scan] = []
    try:
        for scan in scans_for(coming, tare_s) if tare_s else ():
            keep(scan)
            untouched.append(scan)
    finally:  # also if the scans end, or fail, during the tare
        if untouched:
            ratio = mean_ratio(untouched)
            of = next(s for s in reversed(untouched) if s.is_whole and s.codes.shape == ratio.shape)
            recorder.add(Tare(ratio, recorder.now_s(), of.mode))
    for scan in coming:
        keep(scan)
