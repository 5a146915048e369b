# SPDX-License-Identifier: Apache-2.0
"""The conversation with a board: one thread reads, and commands wait for their answers.

Programs use `ohmskin.link.device.Device`, which has a session.
"""

import threading
import time
from contextlib import suppress
from dataclasses import replace

from ohmskin.errors import CommandRefused, DeviceLost, DeviceSilent, OhmskinError, ProtocolMismatch
from ohmskin.link import framing, protocol
from ohmskin.link.feed import ScanFeed
from ohmskin.link.messages import (
    Ack,
    BoardDecoder,
    BoardStats,
    ForeignHello,
    Hello,
    Message,
    Scan,
    SelfTestReport,
)
from ohmskin.link.serial_port import Link

# Opening a port resets some boards, which are then silent for up to 3 s.
CONNECT_TIMEOUT_S = 4.0
# Time between two questions to a board that has not said hello yet [s].
_HELLO_EVERY_S = 0.3
# Time that a board has for its answer, besides the rest of a scan [s].
_COMMAND_TIMEOUT_S = 1.0
# Times that a command is sent before the board counts as lost.
COMMAND_TRIES = 3
# A scanning board that sends no valid frame for so long is asked who it is [s].
_SPEED_LOST_S = 2.5


class Session:
    """A board at a `Link` that has said hello.

    feed: its scans; everything here waits on its condition. hello, report: what the board has said
    last. want_scans: the board is to scan; a board that was reset is started again. baud: speed of
    the line to change to.

    :raises DeviceSilent: nothing that is a skin board answers.
    :raises ProtocolMismatch: the board was built from another protocol definition.
    :raises DeviceLost: the port went away meanwhile.
    """

    def __init__(self, link: Link, baud: int | None = None) -> None:
        self.link = link
        self.feed = ScanFeed(link.name)
        self.commands = threading.RLock()
        self.report: SelfTestReport | None = None
        self.want_scans = False
        self._decoder = BoardDecoder()
        self._hello: Hello | ForeignHello | None = None
        self._acks: dict[int, Ack] = {}
        self._closing = False
        self._restarts = 0
        self._sequence = 0
        self._thread = threading.Thread(target=self._read, name=f"read {link.name}", daemon=True)
        self._thread.start()
        try:
            self._connect()
            if baud is not None and baud != self.hello.baud:
                self.command("set_baud", baud=baud)
                link.set_baud(baud)
                self.refresh()
        except BaseException:
            self.close()
            raise

    @property
    def hello(self) -> Hello:
        """What the board has last said of itself."""
        assert isinstance(self._hello, Hello)
        return self._hello

    @property
    def stats(self) -> BoardStats:
        """Counts since the connection was made, as a copy."""
        with self.feed.changed:
            return replace(
                self._decoder.snapshot(),
                restarts=self._restarts,
                overflowed=self.feed.overflowed,
            )

    def close(self) -> None:
        """Stop the board and give the port back. May be called again."""
        if self._closing:
            return
        if self.want_scans and self.feed.failure is None:
            with suppress(OhmskinError):  # it may be gone already
                self.send("stop")
        self._closing = True
        self._thread.join()
        self.link.close()
        self.want_scans = False
        self.feed.forget_newest()
        self.feed.fail(self.feed.failure or DeviceLost(f"{self.link.name} was closed"))

    # ------------------------------------------------------------------------------ commands

    def send(self, name: str, **values: protocol.Value) -> int:
        """Send a command and return its sequence number; nothing waits for the answer."""
        frame = protocol.FRAMES[name]
        payload = frame.pack(**values)
        with self.feed.changed:
            self._sequence = (self._sequence + 1) & 0xFF
            sequence = self._sequence
            self._acks.pop(sequence, None)
        self.link.write(framing.encode(frame.id, sequence, payload))
        return sequence

    def command(self, name: str, **values: protocol.Value) -> None:
        """Send until it is answered: every command may be repeated without harm.

        :raises CommandRefused: the board's answer is not ok.
        :raises DeviceLost: there is none.
        """
        with self.commands:
            for _ in range(COMMAND_TRIES):
                sequence = self.send(name, **values)
                try:
                    with self.feed.changed:
                        self.feed.wait(lambda: sequence in self._acks, self._command_s())  # noqa: B023
                        ack = self._acks.pop(sequence)
                    break
                except DeviceLost:
                    if self.feed.failure is not None:
                        raise
            else:
                raise DeviceLost(
                    f"{self.link.name} does not answer '{name}': unplug and plug it again"
                )
        if ack.result != "ok":
            reason = protocol.ENUMS["result"].docs.get(ack.result, "reason of a newer firmware")
            raise CommandRefused(name, ack.result, reason)

    def _command_s(self) -> float:
        """An answer waits for the end of the scan."""
        hello = self._hello
        return _COMMAND_TIMEOUT_S + (1 / hello.rate_hz if isinstance(hello, Hello) else 0)

    def refresh(self) -> Hello:
        """Ask for `hello`, which comes before its own ack."""
        self.command("get_hello")
        return self.hello

    # --------------------------------------------------------------------------- connecting

    def _connect(self) -> None:
        speeds = [protocol.CONSTANTS["baud_default"], protocol.CONSTANTS["baud_fast"]]
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        tries = 0
        while not self._greeted():
            # A board that was left at the other speed answers there; most never were.
            self.link.set_baud(speeds[1] if tries % 5 == 4 else speeds[0])
            self.send("get_hello")
            tries += 1
            with self.feed.changed:
                try:
                    self.feed.wait(self._greeted, _HELLO_EVERY_S)
                except DeviceLost:
                    if self.feed.failure is not None:
                        raise
            if not self._greeted() and time.monotonic() > deadline:
                raise DeviceSilent(self._silence())
        if isinstance(self._hello, ForeignHello):
            raise ProtocolMismatch(
                f"{self.link.name}: board speaks layout 0x{self._hello.layout_crc:04X}, this host "
                f"0x{protocol.LAYOUT_CRC:04X}",
                "flash it with 'ohmskin flash'",
            )
        if self.hello.scanning:
            self.command("stop")
            self.refresh()

    def _greeted(self) -> bool:
        return self._hello is not None

    def _silence(self) -> str:
        if self._decoder.stats.line.octets:
            return (
                f"{self.link.name} sends bytes that are no frames: is it the skin board's port? "
                "Flash the board with 'ohmskin flash'"
            )
        return (
            f"{self.link.name} is silent: is it the skin board's port? "
            "Flash the board with 'ohmskin flash', and check its USB cable"
        )

    # ------------------------------------------------------------------------- reader thread

    def _read(self) -> None:
        heard_s = time.monotonic()
        try:
            while not self._closing:
                chunk = self.link.read()
                if chunk and self._take(chunk):
                    heard_s = time.monotonic()
                elif self.want_scans and time.monotonic() - heard_s > _SPEED_LOST_S:
                    # A board that was reset is back at its default speed.
                    heard_s = time.monotonic()
                    self.link.set_baud(protocol.CONSTANTS["baud_default"])
                    self.send("get_hello")
        except OhmskinError as exc:
            self.feed.fail(exc)

    def _take(self, chunk: bytes) -> bool:
        host_time_s = time.monotonic()
        with self.feed.changed:
            messages = self._decoder.feed(chunk, host_time_s)
            for message in messages:
                self._keep(message)
            if messages:
                self.feed.changed.notify_all()
        return bool(messages)

    def _keep(self, message: Message) -> None:
        match message:
            case Scan():
                self.feed.publish(message)
            case Ack():
                self._acks[message.command_sequence] = message
            case SelfTestReport():
                self.report = message
            case Hello() if self.want_scans and not message.scanning:
                # It was reset: bring it back to where it was.
                self._restarts += 1
                self._resume(message)
            case Hello() | ForeignHello():
                self._hello = message

    def _resume(self, restarted: Hello) -> None:
        before = self.hello
        self.send("configure", **configuration(before))
        self._hello = replace(
            before,
            unit_id=restarted.unit_id,
            baud=restarted.baud,
            settings=restarted.settings,
            reset_cause=restarted.reset_cause,
        )
        self.send("start")


def configuration(board: Hello) -> dict[str, protocol.Value]:
    """What `configure` would have to say for a board to scan as this one does."""
    return {
        "rows": board.rows,
        "columns": board.columns,
        "rate_mhz": board.rate_asked_mhz,
        "settle_us": board.settle_asked_us,
        "adc_prescaler": board.adc_prescaler,
    }
