# SPDX-License-Identifier: Apache-2.0
"""An emulated board in simulated time, with as much of a `Device` as the doctor needs."""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace

from ohmskin.doctor.examine import Evidence
from ohmskin.doctor.gather import gather
from ohmskin.emulate.board import EmulatedBoard
from ohmskin.emulate.faults import LineFaults
from ohmskin.files import Closing
from ohmskin.link import framing, protocol
from ohmskin.link.device import configuration
from ohmskin.link.messages import BoardDecoder, BoardStats, Hello, Message, Scan, SelfTestReport
from ohmskin.opening import emulated


class Bench(Closing):
    """A board, or that of an `emulator://` URL.

    Time passes only while its scans are taken: `now_s`.
    """

    def __init__(self, of: str | EmulatedBoard, now_s: float = 0.0) -> None:
        self.board, _, self.faults = emulated(of) if isinstance(of, str) else (of, "", LineFaults())
        self.name = str(of)
        self.now_s = 0.0
        self._decoder = BoardDecoder()
        self._messages: list[Message] = []
        self._take(self.faults)
        self.now_s = now_s
        self.board.advance(now_s)

    def _take(self, faults: LineFaults) -> None:
        octets = self.board.heard(faults, self.now_s)
        self._messages += self._decoder.feed(octets, self.now_s)

    def ask(self, name: str, **values: protocol.Value) -> None:
        frame = protocol.FRAMES[name]
        self.board.receive(framing.encode(frame.id, 1, frame.pack(**values)))
        self._take(LineFaults())  # commands are repeated until they are answered

    def __iter__(self) -> Iterator[Scan]:
        self._messages = [self.info]
        self.ask("start")
        while True:
            scans = [each for each in self._messages if isinstance(each, Scan)]
            self._messages = [each for each in self._messages if not isinstance(each, Scan)]
            yield from scans
            due_s = self.board.next_scan_s
            self.now_s = due_s
            self._take(self.faults)

    @property
    def info(self) -> Hello:
        self.ask("get_hello")
        return [each for each in self._messages if isinstance(each, Hello)][-1]

    @property
    def stats(self) -> BoardStats:
        return deepcopy(self._decoder.stats)

    def self_test(self) -> SelfTestReport:
        self.ask("self_test")
        return next(each for each in self._messages if isinstance(each, SelfTestReport))

    def configure(self, *, rate_hz: float, **others: protocol.Value) -> Hello:
        wanted = configuration(self.info) | {"rate_mhz": protocol.rate_mhz(rate_hz)} | others
        self.ask("configure", **wanted)
        assert configuration(self.info) == wanted
        return self.info

    def stop(self) -> None:
        self.ask("stop")

    def close(self) -> None:
        pass


def evidence(url: str, **told: object) -> Evidence:
    """What the doctor reads of the board at an `emulator://` URL, and what it is told besides."""
    return replace(gather(Bench(url)), **told)
