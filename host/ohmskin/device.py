# SPDX-License-Identifier: Apache-2.0
"""A connected skin board: scans as they come, commands with answers, counts of what was lost.

One thread reads the port and decodes; everything else waits on one condition. Nothing polls.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import TracebackType
from typing import Self

from ohmskin import framing, protocol
from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    DeviceSilent,
    OhmskinError,
    ProtocolMismatch,
)
from ohmskin.link import Link
from ohmskin.messages import (
    Ack,
    BoardDecoder,
    BoardStats,
    ForeignHello,
    Hello,
    Message,
    Scan,
    SelfTestReport,
)

# A board that is reset by the opening of its port is silent for up to 3 s.
CONNECT_TIMEOUT_S = 4.0
_HELLO_EVERY_S = 0.3
_COMMAND_TIMEOUT_S = 1.0
_COMMAND_TRIES = 3
# Silence after which a scanning board counts as lost.
SILENCE_TIMEOUT_S = 5.0
# Silence, or nothing but damage, after which a scanning board is asked who it is.
_SPEED_LOST_S = 2.5
# Scans kept for an iterator that is slower than the board: 11 s at 90 Hz.
QUEUE_SCANS = 1024


class Device:
    """A board at a `Link`. Made by `ohmskin.open`; closes with ``with`` or `close`.

    Two ways to read, for two needs: iterating gives every scan, in order, and tells which are
    missing; `latest` gives the newest and skips the rest. Both may be used at once, from several
    threads.

    :raises DeviceSilent: nothing that is a skin board answers.
    :raises ProtocolMismatch: the board was built from another protocol definition.
    :raises DeviceLost: the port went away meanwhile.
    """

    def __init__(self, link: Link, *, start: bool = True, baud: int | None = None) -> None:
        self._link = link
        self._decoder = BoardDecoder()
        self._changed = threading.Condition()
        self._hello: Hello | ForeignHello | None = None
        self._acks: dict[int, Ack] = {}
        self._report: SelfTestReport | None = None
        self._newest: Scan | None = None
        self._newest_taken = False
        # Weak: an iterator that is dropped unused takes its queue along.
        self._queues: weakref.WeakSet[_Queue] = weakref.WeakSet()
        self._failure: OhmskinError | None = None
        self._closing = False
        self._want_scans = False
        self._wanted: dict[str, protocol.Value] | None = None  # fields of the last `configure`
        self._overflowed = 0
        self._restarts = 0
        self._sequence = 0
        self._commands = threading.RLock()
        self._reader = threading.Thread(target=self._read, name=f"read {link.name}", daemon=True)
        self._reader.start()
        try:
            self._connect()
            if baud is not None and baud != self.info.baud:
                self._set_baud(baud)
            if start:
                self.start()
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------- reading

    def __iter__(self) -> Iterator[Scan]:
        """Every scan from now on; ``missed`` of each counts what was lost before it.

        An iterator that falls behind by more than `QUEUE_SCANS` loses the oldest scans, which are
        counted too.

        :raises DeviceLost: the board went away, or said nothing for `SILENCE_TIMEOUT_S`.
        """
        self.start()
        queue = _Queue()
        with self._changed:
            self._queues.add(queue)
        return self._scans(queue)

    def _scans(self, queue: _Queue) -> Iterator[Scan]:
        try:
            while True:
                with self._changed:
                    self._wait(lambda: bool(queue.scans), self._silence_s())
                    scan = queue.take()
                yield scan
        finally:
            with self._changed:
                self._queues.discard(queue)

    def latest(self, timeout_s: float | None = None) -> Scan:
        """The newest scan, each one once: waits for the next if this one was given out already.

        timeout_s: how long to wait [s], by default `SILENCE_TIMEOUT_S`, or longer for slow scans.

        :raises DeviceLost: the board went away, or no scan came in time.
        """
        self.start()
        with self._changed:
            limit = self._silence_s() if timeout_s is None else timeout_s
            self._wait(lambda: self._newest is not None and not self._newest_taken, limit)
            self._newest_taken = True
            assert self._newest is not None
            return self._newest

    @property
    def info(self) -> Hello:
        """What the board has last said of itself."""
        assert isinstance(self._hello, Hello)
        return self._hello

    @property
    def name(self) -> str:
        """The port's name."""
        return self._link.name

    @property
    def stats(self) -> BoardStats:
        """Counts since the connection was made, as a copy."""
        with self._changed:
            return replace(
                self._decoder.snapshot(), restarts=self._restarts, overflowed=self._overflowed
            )

    # ------------------------------------------------------------------------------ commands

    def start(self) -> None:
        """Start scanning. Does nothing when the board scans already."""
        with self._commands:
            if self._want_scans:
                return
            for _ in range(_COMMAND_TRIES):
                self._restore()
                with self._changed:
                    self._newest = None  # it may be of another configuration
                self._command("start")
                # The hello of a reset that came in between was read before this ack.
                if self._as_wanted():
                    break
                self._command("stop")
            self._want_scans = True

    def stop(self) -> None:
        """Stop scanning, after a whole scan."""
        with self._commands:
            self._want_scans = False
            self._command("stop")

    def configure(
        self,
        *,
        rows: int | None = None,
        columns: int | None = None,
        rate_hz: float | None = None,
        settle_us: int | None = None,
        adc_prescaler: str | None = None,
    ) -> Hello:
        """Change how the board scans; what is not given stays. Returns what the board now keeps.

        rate_hz: scans per second; 0: as fast as the converter runs. settle_us: least time from a
        multiplexer change to the sample; 0: as long as the rate allows. adc_prescaler: a name of
        the enum `adc_prescaler`.

        :raises ValueError: a value that no board could be sent.
        :raises CommandRefused: a value out of range, or too much for the rate; nothing changes.
        """
        given = {
            "rows": rows,
            "columns": columns,
            "rate_mhz": None if rate_hz is None else protocol.rate_mhz(rate_hz),
            "settle_us": settle_us,
            "adc_prescaler": adc_prescaler,
        }
        with self._paused():
            wanted = _configuration(self.info)
            wanted.update({name: value for name, value in given.items() if value is not None})
            self._command("configure", **wanted)
            self._wanted = wanted
            self._refresh()
            self._restore()
            return self.info

    def set_unit_id(self, unit_id: int) -> None:
        """Name this skin; `save` makes the name last."""
        self._command("set_unit_id", unit_id=unit_id)
        self._refresh()

    def save(self) -> None:
        """Keep configuration and unit id in the board's EEPROM.

        :raises CommandRefused: the EEPROM is worn out.
        """
        self._command("save")

    def load_defaults(self) -> Hello:
        """Return to the built-in configuration; the EEPROM keeps what it holds until `save`."""
        with self._paused():
            self._command("load_defaults")
            self._wanted = None
            return self._refresh()

    def self_test(self) -> SelfTestReport:
        """Read both sense nodes with each drive at all multiplexer inputs, and judge them."""
        with self._paused():
            self._report = None
            self._command("self_test")
            if self._report is None:
                raise DeviceLost(f"{self.name}: the report of the self-test was lost: try again")
            return self._report

    # ------------------------------------------------------------------------------- closing

    def close(self) -> None:
        """Stop the board and give the port back. May be called again."""
        if self._closing:
            return
        if self._want_scans and self._failure is None:
            with suppress(OhmskinError):  # it may be gone already
                self._send("stop")
        self._closing = True
        self._reader.join()
        self._link.close()
        with self._changed:
            self._want_scans = False
            self._newest = None
            self._failure = self._failure or DeviceLost(f"{self.name} was closed")
            self._changed.notify_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # ------------------------------------------------------------------------- reader thread

    def _read(self) -> None:
        heard_s = time.monotonic()
        try:
            while not self._closing:
                chunk = self._link.read()
                if chunk and self._take(chunk):
                    heard_s = time.monotonic()
                elif self._want_scans and time.monotonic() - heard_s > _SPEED_LOST_S:
                    # A board that was reset is back at its default speed.
                    heard_s = time.monotonic()
                    self._link.set_baud(protocol.CONSTANTS["baud_default"])
                    self._send("get_hello")
        except OhmskinError as exc:
            with self._changed:
                self._failure = exc
                self._changed.notify_all()

    def _take(self, chunk: bytes) -> bool:
        host_time_s = time.monotonic()
        with self._changed:
            messages = self._decoder.feed(chunk, host_time_s)
            for message in messages:
                self._keep(message)
            if messages:
                self._changed.notify_all()
        return bool(messages)

    def _keep(self, message: Message) -> None:
        match message:
            case Scan():
                self._newest, self._newest_taken = message, False
                for queue in self._queues:
                    self._overflowed += queue.put(message)
            case Ack():
                self._acks[message.command_sequence] = message
            case SelfTestReport():
                self._report = message
            case Hello() if self._want_scans and not message.scanning:
                # It was reset: bring it back to where it was.
                self._restarts += 1
                self._resume(message)
            case Hello() | ForeignHello():
                self._hello = message

    def _as_wanted(self) -> bool:
        return self._wanted is None or _configuration(self.info) == self._wanted

    def _restore(self) -> None:
        """A board that was reset while it stood still has forgotten how to scan."""
        for _ in range(_COMMAND_TRIES):
            if self._as_wanted() or self._wanted is None:
                return
            self._command("configure", **self._wanted)
            self._refresh()

    def _resume(self, restarted: Hello) -> None:
        before = self.info
        self._send("configure", **_configuration(before))
        self._hello = replace(
            before,
            unit_id=restarted.unit_id,
            baud=restarted.baud,
            settings=restarted.settings,
            reset_cause=restarted.reset_cause,
        )
        self._send("start")

    # ------------------------------------------------------------------------------ plumbing

    def _connect(self) -> None:
        speeds = [protocol.CONSTANTS["baud_default"], protocol.CONSTANTS["baud_fast"]]
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        tries = 0
        while not self._greeted():
            # A board that was left at the other speed answers there; most never were.
            self._link.set_baud(speeds[1] if tries % 5 == 4 else speeds[0])
            self._send("get_hello")
            tries += 1
            with self._changed:
                try:
                    self._wait(self._greeted, _HELLO_EVERY_S)
                except DeviceLost:
                    if self._failure is not None:
                        raise
            if not self._greeted() and time.monotonic() > deadline:
                raise DeviceSilent(self._silence())
        if isinstance(self._hello, ForeignHello):
            raise ProtocolMismatch(
                f"{self.name}: board speaks layout 0x{self._hello.layout_crc:04X}, this host "
                f"0x{protocol.LAYOUT_CRC:04X}: flash it with 'ohmskin flash'"
            )
        if self.info.scanning:
            self._command("stop")
            self._refresh()

    def _greeted(self) -> bool:
        return self._hello is not None

    def _silence(self) -> str:
        if self._decoder.stats.line.octets:
            return (
                f"{self.name} sends bytes that are no frames: is it the skin board's port? "
                "Flash the board with 'ohmskin flash'"
            )
        return (
            f"{self.name} is silent: is it the skin board's port? "
            "Flash the board with 'ohmskin flash', and check its USB cable"
        )

    def _set_baud(self, baud: int) -> None:
        self._command("set_baud", baud=baud)
        self._link.set_baud(baud)
        self._refresh()

    def _refresh(self) -> Hello:
        """Ask for `hello`, which comes before its own ack."""
        self._command("get_hello")
        return self.info

    @contextmanager
    def _paused(self) -> Iterator[None]:
        """Hold the scan for commands that are refused meanwhile, and go on whatever they did."""
        with self._commands:
            was_scanning = self._want_scans
            if was_scanning:
                self.stop()
            try:
                yield
            finally:
                if was_scanning and self._failure is None:
                    self.start()

    def _send(self, name: str, **values: protocol.Value) -> int:
        frame = protocol.FRAMES[name]
        payload = frame.pack(**values)
        with self._changed:
            self._sequence = (self._sequence + 1) & 0xFF
            sequence = self._sequence
            self._acks.pop(sequence, None)
        self._link.write(framing.encode(frame.id, sequence, payload))
        return sequence

    def _command(self, name: str, **values: protocol.Value) -> None:
        """Send until it is answered: every command may be repeated without harm."""
        with self._commands:
            for _ in range(_COMMAND_TRIES):
                sequence = self._send(name, **values)
                try:
                    with self._changed:
                        self._wait(lambda: sequence in self._acks, self._command_s())  # noqa: B023
                        ack = self._acks.pop(sequence)
                    break
                except DeviceLost:
                    if self._failure is not None:
                        raise
            else:
                raise DeviceLost(f"{self.name} does not answer '{name}': unplug and plug it again")
        if ack.result != "ok":
            reason = protocol.ENUMS["result"].docs.get(ack.result, "reason of a newer firmware")
            raise CommandRefused(name, ack.result, reason)

    def _command_s(self) -> float:
        """An answer waits for the end of the scan."""
        hello = self._hello
        return _COMMAND_TIMEOUT_S + (1 / hello.rate_hz if isinstance(hello, Hello) else 0)

    def _silence_s(self) -> float:
        return SILENCE_TIMEOUT_S + 2 / self.info.rate_hz

    def _wait(self, ready: Callable[[], bool], limit_s: float) -> None:
        """Wait, holding `_changed`, until `ready()`; a failure of the reader is raised here."""
        self._changed.wait_for(lambda: ready() or self._failure is not None, limit_s)
        if ready():
            return
        if self._failure is not None:
            raise self._failure
        raise DeviceLost(f"{self.name} has said nothing for {limit_s:.1f} s: unplug and plug it")


def _configuration(board: Hello) -> dict[str, protocol.Value]:
    """What `configure` would have to say for a board to scan as this one does."""
    return {
        "rows": board.rows,
        "columns": board.columns,
        "rate_mhz": board.rate_asked_mhz,
        "settle_us": board.settle_asked_us,
        "adc_prescaler": board.adc_prescaler,
    }


class _Queue:
    """The scans an iterator has not taken yet."""

    def __init__(self) -> None:
        self.scans: deque[Scan] = deque()
        self._lost = 0

    def put(self, scan: Scan) -> int:
        """Append; returns how many old scans had to go for it."""
        self.scans.append(scan)
        if len(self.scans) <= QUEUE_SCANS:
            return 0
        oldest = self.scans.popleft()
        self._lost += 1 + oldest.missed
        return 1

    def take(self) -> Scan:
        scan, lost = self.scans.popleft(), self._lost
        self._lost = 0
        return replace(scan, missed=scan.missed + lost) if lost else scan
