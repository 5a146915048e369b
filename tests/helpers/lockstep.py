# SPDX-License-Identifier: Apache-2.0
"""The built firmware in lock-step with a host that knows what every reading must be.

For tests and benchmarks of the firmware: simulated time passes only in `Rig.run`, so that every
figure is exact and repeatable. In real time there is ``simavr://`` (`ohmskin.emulate.simavr`).
"""

import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.emulate.simavr import SkinSim, table_of
from ohmskin.files import Closing
from ohmskin.link import framing, protocol
from places import ROOT
from skins import scan_order

CPU_HZ = 16_000_000
CYCLES_PER_US = CPU_HZ // 1_000_000
# Slots before the first scan, in which the converter begins: they stand at its first cell already.
SLOTS_BEFORE = 2
BOARDS = ("uno", "megaatmega2560")
READINGS = tuple(protocol.ENUMS["reading"].values)
TABLE_SHAPE = (16, 16, len(READINGS))
DEFAULT_SCAN: dict[str, Any] = {
    "rows": 8,
    "columns": 8,
    "rate_mhz": 90_000,
    "settle_us": 0,
    "accuracy": "usual",
    "mode": "near",
}

# One record of the hold log. cycle: CPU cycles since power-on at the instant of the hold.
# configuration: 0 to 7 are A to H; 8: no current, 9: undriven, 10: of another channel.
# settle_cycles: since row, column or drive pins last changed; 2**32 - 1: never, or longer ago.
HOLD_DTYPE = np.dtype(
    [
        ("cycle", "<u8"),
        *((name, "u1") for name in ("row", "column", "configuration", "channel")),
        ("code", "<u2"),
        ("settle_cycles", "<u4"),
    ]
)


class LockstepSim(SkinSim):
    """All that the simulator can be asked for; operations are those of firmware/sim/README.md."""

    boot_s = 0.01
    """A board has said hello so long after a reset [s]."""
    jitter_cycles = 0
    """By so much a hold may come early or late."""
    adc_bits = protocol.ADC_BITS
    """Bits of its converter."""

    def set_table(self, ratio: NDArray[np.float64]) -> None:
        """Set these readings: `table_of`. Raises SimulationError for a ratio that is not finite.

        An ideal conversion gives the code min(1023, floor(1024 ratio)).
        """
        self.request("T", table_of(ratio))

    def run_cycles(self, cycles: int) -> bytes:
        """Run for `cycles` CPU cycles (16 MHz), to the end of the instruction that reaches them.

        Returns what the device has sent since the last call. 0 only collects that, even after a
        crash. Raises SimulationError if the processor crashes or sleeps for ever, or for more than
        an hour.
        """
        return self.request("R", struct.pack("<Q", cycles))

    def run(self, seconds: float) -> bytes:
        """Run for `seconds` of simulated time; else as `run_cycles`."""
        return self.run_cycles(round(seconds * CPU_HZ))

    def power_on(self) -> None:
        """Let a board with a pseudo-terminal run; its port should be open by then."""
        self.request("G")

    def write(self, uart_bytes: bytes) -> None:
        """Queue bytes on the line to the device; they arrive one after the other at line speed."""
        self.request("W", uart_bytes)

    def set_baud(self, baud: int) -> None:
        """Baud of the host's end of the line; 0 (at the start) follows the device.

        Bytes between ends that differ by more than 4 % arrive as other bytes, at the device with
        FE0 set.
        """
        self.request("B", struct.pack("<I", baud))

    def stats(self) -> dict[str, Any]:
        """Counters since the start or `reset_stats`, even after a crash.

        `state` is "running", "crashed" or "done" (asleep for ever).
        """
        counters: dict[str, Any] = json.loads(self.request("S"))
        return counters

    def reset_stats(self) -> None:
        """Restart all counters but `cycles`, `simulated_s` and `resets`."""
        self.request("Z")

    def hold_log(self, enable: bool) -> None:
        """Log every hold of the ADC from now on, or stop. Records kept so far stay."""
        self.request("L", bytes([enable]))

    def drain_hold_log(self) -> NDArray[np.void]:
        """Take the logged holds, at most 2**20: array of `HOLD_DTYPE`, oldest first."""
        return np.frombuffer(self.request("L", b"\x02"), dtype=HOLD_DTYPE)

    def eeprom(self) -> bytes:
        """The whole EEPROM, 1024 bytes (uno) or 4096 (megaatmega2560)."""
        return self.request("E")

    def write_eeprom(self, content: bytes, offset: int = 0) -> None:
        """Put `content` into the EEPROM at `offset` [bytes], at once."""
        self.request("e", struct.pack("<H", offset) + content)

    def reset(self) -> None:
        """Pull the reset pin, as a USB bridge does when a port opens: sets EXTRF in MCUSR."""
        self.request("X")

    def jump(self, address: int) -> None:
        """Go on at this byte address of the flash, as a fault in the program counter would."""
        self.request("J", struct.pack("<I", address))

    def poke(self, address: int, value: int) -> None:
        """Set a register, r0 (0) to r31 (31) or MCUSR (0x54), as a boot loader may leave it."""
        self.request("D", struct.pack("<HB", address, value))


def elf_of(board: str) -> Path:
    """Where PlatformIO leaves the firmware; it need not exist.

    PlatformIO reads the variable too: by it, `make test-arduino-gcc` builds, and tests, elsewhere.
    """
    built = os.environ.get("PLATFORMIO_BUILD_DIR", ROOT / ".pio" / "build")
    return Path(built) / board / "firmware.elf"


def whole_skin(scan: dict[str, Any]) -> dict[str, Any]:
    """The fields of `configure`; all lines and no whole scans if no region is given."""
    masks = {
        "row_mask": protocol.all_lines(scan["rows"]),
        "column_mask": protocol.all_lines(scan["columns"]),
    }
    return masks | {"whole_mode": "near", "whole_every": 0} | scan


def first_holds(holds: NDArray[np.void], mode: str = "near") -> NDArray[np.intp]:
    """Where in a log of holds each scan of all rows and columns begins.

    The second reading of the first cell comes once a scan, right after the scan's first hold; idle
    slots lie before that. In mode quick, the scan's first hold is the last of those of its cell.
    """
    first_cell = (holds["row"] == 0) & (holds["column"] == 0)
    if len(protocol.MODES[mode]) == 1:
        return np.flatnonzero(first_cell[:-1] & ~first_cell[1:])
    second_reading = READINGS.index(protocol.MODES[mode][1])
    second = first_cell & (holds["configuration"] == second_reading)
    return np.flatnonzero(second) - 1


@dataclass(frozen=True)
class ReceivedScan:
    """A `scan` frame: its header's fields, and the codes of the cells that were read."""

    header: dict[str, Any]
    codes: NDArray[np.uint16]

    def places(self) -> tuple[tuple[NDArray[Any], ...], *tuple[NDArray[Any], ...]]:
        """Of codes in scan order: places in `codes`, rows, columns, and readings a to h."""
        mode = self.header["mode"]
        place = tuple(np.transpose(scan_order(*self.codes.shape[:2], mode)))
        rows, columns = (
            np.array([line for line in range(32) if self.header[mask] >> line & 1])
            for mask in ("row_mask", "column_mask")
        )
        readings = np.array([READINGS.index(name) for name in protocol.MODES[mode]])
        return place, rows[place[0]], columns[place[1]], readings[place[2]]


@dataclass(frozen=True)
class Check:
    """Received scans against the skin's table at the instants of their holds.

    start_cycles: of the first hold of every scan since `start_scan`, received or not.
    """

    readings: int
    wrong: int
    start_cycles: NDArray[np.int64]


class Rig(Closing):
    """A board in lock-step with a host that knows what every reading must be."""

    def __init__(self, board: str, sim: LockstepSim | None = None, lines: int = 16) -> None:
        """lines: of its multiplexers, for rows and for columns."""
        self.board = board
        self._table_shape = lines, lines, len(READINGS)
        self.sim = sim or LockstepSim(board, elf_of(board))
        self.decoder = framing.Decoder()
        self.scans: list[ReceivedScan] = []
        self.log: list[tuple[str, dict[str, Any]]] = []
        """Every frame in order: name and fields."""
        self.malformed = 0
        self._results: dict[int, str] = {}
        self._sequence = 0
        self._table_cycles: list[int] = []
        self._tables: list[NDArray[np.uint16]] = []
        self._holds: list[NDArray[np.void]] = []

    def close(self) -> None:
        """End the simulator."""
        self.sim.close()

    def run_cycles(self, cycles: int) -> None:
        """Let simulated time pass, and take what the board sends."""
        for frame in self.decoder.feed(self.sim.run_cycles(cycles)):
            kind = protocol.FRAMES_BY_ID[frame.type]
            try:
                fields = kind.unpack(frame.payload)
                if kind.name == "scan":
                    tail = frame.payload[kind.struct.size :]
                    lines = [fields[mask].bit_count() for mask in ("row_mask", "column_mask")]
                    shape = (*lines, len(protocol.MODES[fields["mode"]]))
                    per_pass = protocol.PER_PASS[fields["mode"]]
                    codes = protocol.unpack_codes(tail, shape, per_pass, fields["adc_bits"])
                    self.scans.append(ReceivedScan(fields, codes))
            except (ValueError, KeyError):  # a CRC that is right by chance
                self.malformed += 1
                continue
            self.log.append((kind.name, fields))
            if kind.name == "ack":
                self._results[fields["command_sequence"]] = fields["result"]

    @property
    def damaged(self) -> int:
        """Frames that came and were none."""
        return self.decoder.stats.damaged + self.malformed

    def run(self, seconds: float) -> None:
        """Let simulated time pass [s]."""
        self.run_cycles(round(seconds * CPU_HZ))

    def frames(self, name: str) -> list[dict[str, Any]]:
        """The fields of all frames of one kind received so far."""
        return [fields for kind, fields in self.log if kind == name]

    # ---- commands
    def encode(self, name: str, **fields: Any) -> bytes:
        """The bytes of a command with the next sequence number, for `sim.write`."""
        self._sequence = (self._sequence + 1) & 0xFF
        self._results.pop(self._sequence, None)
        frame = protocol.FRAMES[name]
        if name == "configure":
            fields = whole_skin(fields)
        return framing.encode(frame.id, self._sequence, frame.pack(**fields))

    def send(self, name: str, **fields: Any) -> int:
        """Queue a command on the line; its sequence number."""
        self.sim.write(self.encode(name, **fields))
        return self._sequence

    def result_of(self, sequence: int, limit_s: float = 0.5) -> str:
        """Run until the ack of the command with this number has come; its result.

        :raises TimeoutError: none came within `limit_s` of simulated time.
        """
        step_s = 0.0005
        for _ in range(round(limit_s / step_s)):
            if sequence in self._results:
                return self._results.pop(sequence)
            self.run(step_s)
        raise TimeoutError(f"no ack of command {sequence} within {limit_s} s")

    def command(self, name: str, limit_s: float = 0.5, **fields: Any) -> str:
        """Send a command and run until it is answered; its result."""
        return self.result_of(self.send(name, **fields), limit_s)

    def hello(self) -> dict[str, Any]:
        """Ask who the board is.

        :raises RuntimeError: it refuses to say.
        """
        result = self.command("get_hello")
        if result != "ok":
            raise RuntimeError(f"get_hello: {result}")
        return self.frames("hello")[-1]

    def must(self, name: str, **fields: Any) -> None:
        """A command that has to succeed.

        :raises RuntimeError: it does not.
        """
        result = self.command(name, **fields)
        if result != "ok":
            raise RuntimeError(f"{name}: {result}")

    def start_scan(self, **scan: Any) -> None:
        """Configure (the default, but for what is given), forget all scans and start."""
        self.must("configure", **(DEFAULT_SCAN | scan))
        self.forget()
        self.sim.hold_log(True)
        self.must("start")

    def forget(self) -> None:
        """Drop the scans and holds of the run before; the tables stay."""
        self.scans.clear()
        self.sim.hold_log(False)
        self.sim.drain_hold_log()
        self._holds.clear()

    # ---- the skin
    def set_codes(self, codes: NDArray[np.uint16], rng: np.random.Generator) -> None:
        """Make the skin read `codes` (lines, lines, 8): a third each at a step's ends and in it."""
        inside = rng.random(codes.shape)
        steps = 1 << self.sim.adc_bits
        upper_edge = np.nextafter((codes + 1.0) / steps, 0)
        where = rng.integers(3, size=codes.shape)
        ratio = np.choose(where, [codes / steps, upper_edge, (codes + inside) / steps])
        self.sim.set_table(ratio)
        self._table_cycles.append(int(self.sim.stats()["cycles"]))
        self._tables.append(codes)

    def randomize(self, rng: np.random.Generator) -> NDArray[np.uint16]:
        """A new random skin, from this cycle on; the codes that it reads."""
        codes = rng.integers(1 << self.sim.adc_bits, size=self._table_shape, dtype=np.uint16)
        self.set_codes(codes, rng)
        return codes

    def holds(self) -> NDArray[np.void]:
        """Every hold since `start_scan`."""
        self._holds.append(self.sim.drain_hold_log())
        joined = np.concatenate(self._holds) if self._holds else np.empty(0, HOLD_DTYPE)
        self._holds = [joined]
        return joined

    def take_holds(self) -> None:
        """Fetch logged holds, of which the simulator keeps no more than about a million."""
        self._holds.append(self.sim.drain_hold_log())

    def check(self) -> Check:
        """Compare every received scan since `start_scan`: all whole ones of one mode.

        Which hold belongs to which reading follows from the order of a scan.
        """
        holds = self.holds()
        mode = self.scans[0].header["mode"] if self.scans else "near"
        first = first_holds(holds, mode)
        starts = holds["cycle"][first].astype(np.int64)
        if not self.scans:
            return Check(0, 0, starts)
        numbers = np.array([scan.header["scan"] for scan in self.scans])
        wrong = self._wrong(holds, first[numbers])
        return Check(sum(scan.codes.size for scan in self.scans), wrong, starts)

    def check_regions(self) -> Check:
        """Compare every received scan since `start_scan`, whatever rows, columns and modes it has.

        A scan's hold is found by the scan's time, so that is compared, too: to half a slot.
        """
        holds = self.holds()
        cycles = holds["cycle"].astype(np.int64)
        ticks = np.array([scan.header["time_us"] for scan in self.scans], np.int64) * CYCLES_PER_US
        # The board's clock and the simulator's begin at different times.
        due = ticks - ticks[0] + cycles[SLOTS_BEFORE]
        nearest = np.clip(np.searchsorted(cycles, due), 1, len(cycles) - 1)
        nearest -= due - cycles[nearest - 1] < cycles[nearest] - due
        wrong = self._wrong(holds, nearest)
        late = np.abs(cycles[nearest] - due).max()
        assert late <= 2 * CYCLES_PER_US, f"a time stamp is off by {late} cycles"
        return Check(sum(scan.codes.size for scan in self.scans), wrong, cycles[nearest])

    def _wrong(self, holds: NDArray[np.void], first: NDArray[np.intp]) -> int:
        """How many codes of the scans, whose first holds these are, are not those of the table.

        A reading of another place than its scan's order says is wrong, too.
        """
        tables, table_cycles = np.stack(self._tables), np.array(self._table_cycles)
        wrong = 0
        for scan, begin in zip(self.scans, first, strict=True):
            of_scan = holds[begin : begin + scan.codes.size]
            place, row, column, reading = scan.places()
            at_place = (
                (of_scan["row"] == row)
                & (of_scan["column"] == column)
                & (of_scan["configuration"] == reading)
            )
            # The simulator holds first where a hold and a new table fall on the same cycle.
            table = np.searchsorted(table_cycles, of_scan["cycle"], side="left") - 1
            expected = tables[table, row, column, reading]
            wrong += int((~at_place | (scan.codes[place] != expected)).sum())
        return wrong
