# SPDX-License-Identifier: Apache-2.0
"""The conversation with a board: one thread reads, and commands wait for their answers.

port -> `_read`, in a thread of its own -> `_take` -> `BoardDecoder` -> `_keep` -> who waits for it

A scan goes to the queues of `Device`, an answer to the thread that waits for it in `_command`. The
thread also looks after the board: one that was reset while it scanned is made to scan again.
"""

import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    DeviceSilent,
    OhmskinError,
    ProtocolError,
    ProtocolMismatch,
)
from ohmskin.link import framing, layouts, protocol
from ohmskin.link.clock import ScanClock, answer_delay_s, byte_s
from ohmskin.link.device import COMMAND_TRIES, LOG, Device, configuration
from ohmskin.link.messages import (
    Ack,
    BoardDecoder,
    ForeignHello,
    Hello,
    Message,
    Scan,
    SelfTestReport,
)
from ohmskin.link.serial_port import Link


class Attempt(NamedTuple):
    """One step of the way to a board's hello.

    speed: of the line, by the name of a constant in ``frames.toml``.
    asks: whether the host asks for hello first, or only listens.
    listen_s: how long it listens [s].
    """

    speed: str
    asks: bool
    listen_s: float


# How a board is made to say hello where opening the port does not reset it, so that it may be
# asked at once: often, because answers get lost. Chosen: 0.3 s is far above what an answer takes.
ATTEMPTS = 3 * (4 * [Attempt("baud_default", True, 0.3)] + [Attempt("baud_fast", True, 0.3)])
# How a board is made to say hello where opening the port resets it. Then it says hello by itself,
# and its boot loader must be left alone: it takes a byte for the start of an upload, and the Mega's
# then waits for 5 s after the last byte (firmware/sim/README.md). So the questions at both speeds
# come close to each other, and the silence after them is longer than 5 s: a board that was reset
# late, and heard both questions in its boot loader, says hello 5.0 s after the second.
ATTEMPTS_AFTER_RESET: Final = (
    Attempt("baud_default", False, 2.0),
    Attempt("baud_default", True, 0.5),
    Attempt("baud_fast", True, 0.5),
    Attempt("baud_default", False, 5.5),
    Attempt("baud_default", True, 1.0),
)
# Time that a board has for its answer, besides the time for the scan that it ends first. Chosen:
# far above what a USB bridge and the slowest command, `save`, take.
COMMAND_TIMEOUT_S = 1.0
# A board that does not scan has answered in this time [s]. Chosen: five times what a USB bridge may
# keep an answer.
_ANSWER_S: Final = 0.1
# A scanning board that sends no valid frame for so long, and for the time of a scan more, is asked
# who it is. Chosen: a board that is reset and left alone says hello within 2 s, and only what stays
# silent has to be asked.
_SPEED_LOST_S = 2.5
# A silent board is asked again after so long. Chosen: the Mega's boot loader, if it took the
# question for an upload, waits for 5 s (see `ATTEMPTS_AFTER_RESET`), and then the firmware starts.
_ASK_AGAIN_S = 6.5
# A board has answered, or has said how it scans after a reset, in this time [s], or it is asked at
# the other speed, or told again how to. Chosen: as long as an answer of `ATTEMPTS` may take.
_BACK_S: Final = 0.3
# A board has taken its new speed this long after its answer came. Chosen: a command that came too
# early would be lost, and the next one would come after the board has returned to its old speed.
_SPEED_CHANGE_S: Final = 0.02
# Remedies of errors.
_FLASH: Final = "flash it with 'ohmskin flash'"
_BROKEN: Final = f"open it again; if that does not help, {_FLASH}"


def _size(of: Hello | Scan) -> str:
    return f"{of.rows}x{of.columns}"


class Session(Device):
    """A board at a `Link` that has said hello. One that is reset while it scans is started again.

    baud: speed of the line to change to.

    :raises DeviceSilent: nothing that is a skin board answers.
    :raises ProtocolMismatch: the board was built from another protocol definition.
    :raises ProtocolError: the board says what cannot be.
    :raises DeviceLost: the port went away meanwhile.
    """

    def __init__(self, link: Link, baud: int | None = None) -> None:
        self._link = link
        self._decoder = BoardDecoder()
        super().__init__(link.name, self._decoder.stats)
        self._acks: dict[int, Ack] = {}  # by the sequence numbers of their commands
        # When the line had taken them [s], by the same numbers.
        self._sent_s: dict[int, float] = {}
        self._closing, self._ends = False, threading.Lock()
        self._sequence = 0  # number of the last command
        self._clock = ScanClock(time.time_ns() - round(1e9 * self.now_s))
        self._heard_s = self.now_s  # when a valid frame last came
        self._was_asked = False  # whether it was asked since, at the speed that its hello says
        # A board that was reset is told how to scan. Until its hello says that it does so, its
        # scans count for nothing. When it is told again [s]; None: it scans as it should.
        self._tell_s: float | None = None
        self._misfits = 0  # how often its hello has said that it scans otherwise
        self._begin_thread(self._read, f"read {self.name}")
        try:
            self._connect()
            if self.info.scanning:
                self._command("stop")
                self._refresh()
            else:  # the answer shows the line's delays; a board that is just reset gives none
                sequence = self._send("stop")
                self._wait(lambda: sequence in self._acks, _ANSWER_S)
            if baud is not None and baud != self.info.baud:
                self._command("set_baud", baud=baud)
                link.set_baud(baud)
                # The board changes when its answer has left: be later.
                self._wait(lambda: False, _SPEED_CHANGE_S)
                self._refresh()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        """Wait for hello, by whichever attempt it comes."""
        for speed, asks, listen_s in ATTEMPTS_AFTER_RESET if self._link.resets_board else ATTEMPTS:
            if self._hello is not None:
                return
            self._link.set_baud(protocol.CONSTANTS[speed])
            if asks:
                self._send("get_hello")
            if self._wait(lambda: self._hello is not None, listen_s):
                return
        said = "sends bytes that are no frames" if self._stats.line.octets else "is silent"
        remedy = f"is it the skin board's port? Check its cable, and {_FLASH}"
        raise DeviceSilent(f"{self.name} {said}", remedy)

    def close(self) -> None:
        """Stop the board and give the port back. May be called again."""
        with self._ends:  # threads may close at the same time
            if self._closing:
                return
            if self._want_scans and self._failure is None:
                with suppress(OhmskinError):  # it may be gone already
                    self._send("stop")
            self._closing = True
            super().close()
            self._link.close()
        self._want_scans = False

    def _send(self, name: str, **values: protocol.Value) -> int:
        """Send a command and return its sequence number; nothing waits for the answer."""
        definition = self._decoder.definition
        taken = layouts.asked(definition, name, values)
        if taken is None:
            raise CommandRefused(name, "unknown_command", f"its firmware is too old: {_FLASH}")
        frame = definition.frames[name]
        with self._changed:
            self._wait(lambda: False, 0.0)  # raises what has ended it, such as close()
            sequence = self._sequence = (self._sequence + 1) % framing.SEQUENCE_SPAN
            self._acks.pop(sequence, None)
        octets = framing.encode(frame.id, sequence, frame.pack(**taken))
        on_line_s = len(octets) * byte_s(self._hello) if self._hello else 0.0
        self._sent_s[sequence] = self.now_s + on_line_s
        self._link.write(octets)
        return sequence

    def _command(self, name: str, **values: protocol.Value) -> None:
        """Send until it is answered: every command may be repeated without harm.

        :raises CommandRefused: the board's answer is not ok.
        :raises DeviceLost: there is none.
        """
        with self._commands:
            limit_s = COMMAND_TIMEOUT_S + 1 / self.info.rate_hz
            for _ in range(COMMAND_TRIES):
                sequence = self._send(name, **values)
                if self._wait(lambda: sequence in self._acks, limit_s):  # noqa: B023
                    ack = self._acks.pop(sequence)
                    break
            else:
                raise DeviceLost(f"{self.name} does not answer '{name}': unplug and plug it again")
        if ack.result != "ok":
            reason = protocol.ENUMS["result"].docs.get(ack.result, "reason of a newer firmware")
            if ack.result in ("bad_rows", "bad_columns"):
                reason += f" (at most {self.info.rows_max}x{self.info.columns_max})"
            if ack.result == "bad_rate":
                low, high = (protocol.CONSTANTS[f"rate_mhz_{end}"] for end in ("min", "max"))
                reason += f" ({low // 1000} to {high // 1000} scans/s)"
            if ack.rate_mhz:
                reason += f" (at most {ack.rate_mhz / 1000:g} scans/s)"
            raise CommandRefused(name, ack.result, reason)

    def _read(self) -> None:
        """The work of the reading thread, until the session is closed."""
        while not self._closing:
            self._take(self._link.read())

    def _take(self, octets: bytes) -> None:
        """Act on what has arrived; ask a board that has been silent for too long."""
        now_s = self.now_s
        with self._changed:
            messages = self._decoder.feed(octets, now_s)
            if not self._want_scans:
                self._tell_s = None
            for message in messages:
                self._keep(message, now_s)
            if messages:
                self._heard_s, self._was_asked = now_s, False
                self._changed.notify_all()
        silent_s = now_s - self._heard_s
        if self._want_scans and silent_s > _SPEED_LOST_S + 1 / self.info.rate_hz:
            # A board whose conversions end too late answers at its speed. One that was reset is
            # back at its default speed, at which its hello was not understood.
            baud = protocol.CONSTANTS["baud_default"] if self._was_asked else self.info.baud
            self._heard_s = now_s - _SPEED_LOST_S + (_ASK_AGAIN_S if self._was_asked else _BACK_S)
            self._was_asked = not self._was_asked
            self._link.set_baud(baud)
            self._send("get_hello")

    def _keep(self, message: Message, now_s: float) -> None:
        """Give a message that came now to who waits for it.

        :raises ProtocolError: no board can say that.
        """
        if isinstance(message, Hello):
            self._check_unit(message)
        match message:
            case Hello() if odd := message.impossible():
                raise ProtocolError(f"{self.name}: hello says {odd}, which cannot be", _BROKEN)
            case Scan() if self._tell_s is not None:
                if now_s >= self._tell_s:  # the answer was lost
                    self._bring_back(now_s)
            case Scan() if self._want_scans and _size(message) != _size(self.info):
                said = f"{_size(self.info)} cells, its scans have {_size(message)}"
                raise ProtocolError(f"{self.name}: hello says {said}", _BROKEN)
            # A board that was reset right before "start" scans in its own way until it is stopped.
            case Scan() if self._hello is not None and (self._want_scans or self._is_as_wanted()):
                timed = replace(message, delay_s=self._clock.board.delay_s)
                time_ns = self._clock.time_ns(timed, self._hello)
                self._publish(replace(timed, time_ns=time_ns))
            case Ack():
                sent_s = self._sent_s.pop(message.command_sequence, None)
                if sent_s is not None and message.time_us is not None and self._hello is not None:
                    known_s = now_s - answer_delay_s(self._hello)
                    self._clock.board.answered(message.time_us, sent_s, known_s)
                self._acks[message.command_sequence] = message
            case SelfTestReport():
                self._report = message
            case Hello() if self._want_scans and not message.scanning:
                if self._tell_s is None:
                    self._stats.restarts += 1
                    LOG.warning("%s: was reset (%s)", self.name, ", ".join(message.reset_cause))
                    news = ("unit_id", "baud", "settings", "reset_cause")
                    self._hello = replace(self.info, **{n: getattr(message, n) for n in news})
                    self._misfits = 0
                if self._tell_s is None or now_s >= self._tell_s:
                    self._bring_back(now_s)
            case Hello() if self._tell_s is not None and configuration(message) != self._aim:
                self._misfits += 1
                if self._misfits == COMMAND_TRIES:
                    problem = f"{self.name} was reset and cannot scan as before"
                    raise DeviceLost(problem, "open it again, or ask for a lower rate")
                self._bring_back(now_s)
            case Hello():
                self._hello = message
                self._tell_s = None
            case ForeignHello():
                both = f"0x{message.layout_crc:04X}, this host 0x{protocol.LAYOUT_CRC:04X}"
                raise ProtocolMismatch(f"{self.name}: board speaks layout {both}", _FLASH)

    @property
    def _aim(self) -> dict[str, protocol.Value]:
        """The fields of `configure` that the board should scan by."""
        return self._wanted or configuration(self.info)

    def _bring_back(self, now_s: float) -> None:
        """Tell a board that was reset to scan as before, and ask how it scans.

        Nothing waits for answers, because this is done by the thread that reads them.
        """
        if self._tell_s is not None:  # it may scan already
            self._send("stop")
        self._send("configure", **self._aim)
        self._send("start")
        self._send("get_hello")
        self._tell_s = now_s + _BACK_S
