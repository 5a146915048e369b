# SPDX-License-Identifier: Apache-2.0
"""A recording as a port: ``replay://FILE.mcap?speed=1``.

Scans come as they were recorded, with the same codes, numbers, board times and gaps, through the
same frames and decoder as a board's. ``speed``: 1 as they came, 2 twice as fast, 0 as fast as they
are taken: then nothing is lost however slow the reader, and `latest` gives each in turn. Nothing
comes before somebody first asks for scans. A pause longer than `LONGEST_PAUSE_S` is shortened.

At the recording's end iterators end, and everything else raises `RecordingEnded`. Commands other
than start and stop, which let the replay run and pause, raise `CommandRefused`.

Not modelled: board times that had wrapped (after 71 minutes) before the first scan or during a
pause begin anew below 2^32 us; ``host_time_s`` is the time of the replay; marks and forces are in
`recording.load_recording` alone. Tares are told apart from the line, by `tare_before`.
"""

from __future__ import annotations

import threading
import time
from dataclasses import fields
from typing import Final

from ohmskin.errors import CommandRefused, DeviceLost, PortError, RecordingEnded, RecordingError
from ohmskin.link import framing, protocol
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.serial_port import READ_TIMEOUT_S
from ohmskin.record.recording import Tare, messages

# Shorter than the silence after which a board counts as lost.
LONGEST_PAUSE_S: Final = 2.0
_UNKNOWN: Final = "unknown_"  # see protocol.Enum.name_of


class ReplayLink:
    """Plays the recording `path`, `speed` times as fast as it came; 0: as fast as it is taken.

    :raises RecordingError: it cannot be read.
    :raises PortError: it was made with another converter than this protocol knows.
    :raises ValueError: a negative speed.
    """

    def __init__(self, path: str, speed: float = 1.0, name: str = "") -> None:
        if not 0 <= speed < float("inf"):
            raise ValueError(f"speed must be 0 or more, not {speed}")
        self.name = name or f"replay://{path}"
        self._speed = speed
        self._messages = messages(path)
        hello = next(self._messages)
        assert isinstance(hello, Hello)
        self._hello = hello
        self._wake = threading.Condition()
        self._decoder = framing.Decoder()
        self._answers = bytearray()
        self._next: tuple[Scan, bytes] | None = None
        self._tare: Tare | None = None
        self._tares: dict[tuple[int, int], Tare] = {}  # by the number and time of the next scan
        self._played: list[tuple[float, Tare]] = []  # with the time when that scan was played
        self._running = False
        self._paused = True
        self._closed = False
        self._last: tuple[float, float] | None = None  # when a scan was due [s], and was recorded
        self._sequence = 0
        try:
            made = (hello.adc_bits, hello.readings_per_cell)
            if made != (protocol.ADC_BITS, protocol.READINGS_PER_CELL):
                raise PortError(
                    f"{path}: {made[0]} bits and {made[1]} readings a cell cannot be replayed: "
                    "'ohmskin export' reads it"
                )
            self._greeting()
        except BaseException:
            self.close()
            raise

    def read(self) -> bytes:
        """See `Link.read`."""
        with self._wake:
            deadline_s = time.monotonic() + READ_TIMEOUT_S
            while True:
                if self._closed:
                    raise DeviceLost(f"{self.name} was closed")
                if self._answers:
                    octets = bytes(self._answers)
                    self._answers.clear()
                    return octets
                now_s = time.monotonic()
                held = self._paused and (self._speed == 0 or self._last is None)
                due_s = float("inf")
                if self._running and not held:
                    scan, frame = self._upcoming()
                    if self._answers:
                        continue  # a hello comes before it
                    due_s = self._due_s(scan, now_s)
                    if now_s >= due_s:
                        self._next, self._last = None, (due_s, scan.host_time_s)
                        if (tare := self.tare_before(scan)) is not None:
                            self._played.append((now_s, tare))
                        return frame
                if now_s >= deadline_s:
                    return b""
                self._wake.wait(min(deadline_s, due_s) - now_s)

    def _upcoming(self) -> tuple[Scan, bytes]:
        while self._next is None:
            try:
                message = next(self._messages)
            except StopIteration:
                text = f"{self.name} has been played to where it was cut off"
                raise RecordingEnded(text) from None
            if message is None:
                raise RecordingEnded(f"{self.name} has been played to its end")
            if isinstance(message, Hello):
                self._hello = message
                self._answers += self._greeting()
            elif isinstance(message, Tare):
                self._tare = message
            elif isinstance(message, Scan):
                if self._tare is not None:
                    self._tares[_identity(message)], self._tare = self._tare, None
                self._next = (message, self._scan(message))
        return self._next

    def _due_s(self, scan: Scan, now_s: float) -> float:
        if self._speed == 0 or self._last is None:
            return now_s
        pause_s = (scan.host_time_s - self._last[1]) / self._speed
        return self._last[0] + min(max(pause_s, 0.0), LONGEST_PAUSE_S)

    def write(self, octets: bytes) -> None:
        """See `Link.write`.

        :raises CommandRefused: a recording cannot do that.
        """
        with self._wake:
            if self._closed:
                raise DeviceLost(f"{self.name} was closed")
            for raw in self._decoder.feed(octets):
                name = protocol.FRAMES_BY_ID[raw.type].name
                if name == "get_hello":
                    self._answers += self._greeting()
                elif name == "start":
                    self._running = True
                elif name == "stop":
                    self._running, self._last = False, None
                else:
                    raise CommandRefused(
                        name, "recorded", f"{self.name} is a recording, which stays as it is"
                    )
                ack = protocol.FRAMES["ack"].pack(
                    command=raw.type, command_sequence=raw.sequence, result="ok"
                )
                self._answers += self._frame("ack", ack)
            self._wake.notify_all()

    def tare_before(self, scan: Scan) -> Tare | None:
        """The tare that was recorded right before this scan of the replay, if any."""
        return self._tares.get(_identity(scan))

    def tare_at(self, host_time_s: float) -> Tare | None:
        """The newest tare that was recorded before what has been played by then, if any."""
        played = [tare for time_s, tare in self._played if time_s <= host_time_s]
        return played[-1] if played else None

    def pause(self, paused: bool) -> None:
        """See `PausableLink.pause`."""
        with self._wake:
            self._paused = paused
            self._wake.notify_all()

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`: a file has no speed."""

    def close(self) -> None:
        """See `Link.close`."""
        with self._wake:
            self._closed = True
            self._messages.close()
            self._wake.notify_all()

    # ------------------------------------------------------------------------------- frames

    def _frame(self, name: str, payload: bytes) -> bytes:
        self._sequence += 1
        return framing.encode(protocol.FRAMES[name].id, self._sequence, payload)

    def _greeting(self) -> bytes:
        values = {f.name: getattr(self._hello, f.name) for f in fields(Hello)}
        # It scans already: whatever number the first scan has, none was missed before it.
        values.update(layout_crc=protocol.LAYOUT_CRC, scanning=1)
        try:
            for each in protocol.FRAMES["hello"].fields:
                text = values[each.name]
                if each.enum and text.startswith(_UNKNOWN):
                    values[each.name] = int(text.removeprefix(_UNKNOWN))
            return self._frame("hello", protocol.FRAMES["hello"].pack(**values))
        except (ValueError, KeyError) as exc:
            raise RecordingError(f"{self.name}: hello cannot be replayed: {exc}") from exc

    def _scan(self, scan: Scan) -> bytes:
        most = (protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
        try:
            if scan.rows > most[0] or scan.columns > most[1]:
                raise ValueError(f"{scan.rows}x{scan.columns} cells, more than a board has")
            header = protocol.FRAMES["scan"].pack(
                scan=scan.number % (1 << 32),
                time_us=scan.time_us % (1 << 32),
                dropped=0,
                rx_errors=0,
                rows=scan.rows,
                columns=scan.columns,
            )
            return self._frame("scan", header + protocol.pack_codes(scan.codes))
        except ValueError as exc:
            text = f"{self.name}: scan {scan.number} cannot be replayed: {exc}"
            raise RecordingError(text) from exc


def _identity(scan: Scan) -> tuple[int, int]:
    """What a scan has of its own on the line, whatever wraps the decoder resolves."""
    return scan.number % (1 << 32), scan.time_us % (1 << 32)
