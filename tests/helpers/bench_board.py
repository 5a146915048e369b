# SPDX-License-Identifier: Apache-2.0
"""An emulated board examined in simulated time, as the doctor would do it, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ohmskin.cli.doctor import LONGEST
from ohmskin.doctor.examine import Examined
from ohmskin.doctor.press import CornerScans
from ohmskin.doctor.signal import LEAST_SCANS, REST_S, SETTLED_S, comparison
from ohmskin.emulate.line_faults import Faults
from ohmskin.link import framing, protocol
from ohmskin.link.messages import BoardDecoder, Hello, Message, Scan, SelfTestReport
from ohmskin.opening import emulated


@dataclass
class Bench:
    """An `emulator://` URL's board, and the host's half of the line. `now_s`: simulated time."""

    url: str
    now_s: float = 0.0
    messages: list[Message] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.board, _, self.faults = emulated(self.url)
        self._decoder = BoardDecoder()
        self._take(self.faults)

    def _take(self, faults: Faults) -> None:
        octets = self.board.heard(faults, self.now_s)
        self.messages += self._decoder.feed(octets, self.now_s)

    def ask(self, name: str, **values: protocol.Value) -> None:
        frame = protocol.FRAMES[name]
        self.board.receive(framing.encode(frame.id, 1, frame.pack(**values)))
        self._take(Faults())  # commands are repeated until they are answered

    def hello(self) -> Hello:
        self.ask("get_hello")
        return [each for each in self.messages if isinstance(each, Hello)][-1]

    def scan(self, seconds: float) -> list[Scan]:
        self.messages.clear()
        self.ask("start")
        fast = self.hello().rate_hz * seconds >= LEAST_SCANS
        end_s = self.now_s + seconds * (1 if fast else LONGEST)
        while (due_s := self.board.next_scan_s) is not None and due_s <= end_s:
            self.now_s = due_s
            self._take(self.faults)
        self.ask("stop")
        return [each for each in self.messages if isinstance(each, Scan)]

    def examined(self) -> Examined:
        """All that the doctor reads."""
        self.ask("self_test")
        report = next(each for each in self.messages if isinstance(each, SelfTestReport))
        scans = self.scan(REST_S)
        board = self.hello()
        settled = None
        stats = self._decoder.snapshot()
        other = comparison(board)
        if other is not None:
            wanted = {"rate_mhz": protocol.rate_mhz(other[1]), "settle_us": other[0]}
            wanted |= {"rows": board.rows, "columns": board.columns}
            self.ask("configure", adc_prescaler=board.adc_prescaler, **wanted)
            now = self.hello()
            assert now.settle_us >= other[0]
            settled = (now, self.scan(SETTLED_S))
        return Examined(board, scans, stats, settled, report)

    def pressed(self) -> Examined:
        """All that the doctor reads of a skin in the scene "corners", until they have moved."""
        read = self.examined()
        presses = CornerScans(read.board)
        for scan in self.scan(9.0 - self.now_s):
            presses.take(scan)
        return replace(read, presses=presses)


def examined(url: str, **changes: object) -> Examined:
    """What the doctor reads of the board at an `emulator://` URL, and what is told besides."""
    return replace(Bench(url).examined(), **changes)
