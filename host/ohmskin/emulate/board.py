# SPDX-License-Identifier: Apache-2.0
"""A skin board without hardware: ``emulator://8x8?scene=ghost&seed=1``.

`EmulatedBoard` speaks the board's side of the protocol, sans-IO: `receive` takes bytes from the
host, `advance` lets time pass and returns what was sent. `EmulatorLink` and `PtyServer` run it in
real time, as a `Link` and at a pseudo-terminal.

Not modelled:

- the speed of the line: a scan's bytes come all at once at the scan's end, and none is dropped;
- EEPROM beyond the life of the object;
- findings of the self-test, and its readings g and h: the board itself is sound (`SkinFaults` are
  faults of the skin).

``simavr://`` has all these, for it runs the firmware itself.
"""

import math
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import DEFAULT_REF_OHM
from ohmskin.emulate.faults import LineFaults
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing
from ohmskin.link import framing, protocol
from ohmskin.link.codes import quantise
from ohmskin.link.serial_port import READ_TIMEOUT_S

RatioAt = Callable[[float, str], Float]
Sampled = Callable[[Float, float, float, float, str], Float]

VERSION = {"version_major": 0, "version_minor": 1, "version_patch": 0}
CLOCK_HZ = 16_000_000
DEFAULT_RATE_HZ = 90.0
_CONSTANTS = protocol.CONSTANTS
_PRESCALERS = protocol.ENUMS["adc_prescaler"].values
_REASONS = protocol.ENUMS["result"].docs
# Longest time from the hold of a reading to the change of pins [s]; the longest slot [cycles], and
# what it leaves for settling unless asked [us], by mode (firmware/src/core/scan_plan.h).
_SELECT_S = 120 / CLOCK_HZ
_SLOT_CYCLES_MAX = 60_000
_SETTLE_US = {"near": 20, "far": 35}
# Settings that hello says by the same name.
_OF_HELLO = ("unit_id", "rows", "columns", "mode", "adc_prescaler")
# At a pseudo-terminal: without scans, faults that are due are looked for as often as this [s].
_IDLE_S = 0.2
# The largest number of bytes that is taken there from the host at once.
_READ_SIZE = 4096


class EmulatedBoard:
    """A board whose skin reads `ratio_at(seconds, mode)`, shape (rows, columns, 4).

    rate_hz: the scan rate at boot; None: 90, or as fast as the converter runs if that is less.
    noise_lsb: standard deviation of the ADC's noise [LSB], before rounding. seed: of the noise.
    sampled(readings, start_s, slot_s, settle_s, mode): what the converter reads, (rows, columns,
    4), in a scan that starts at a time, one reading a slot, each so long after the change of pins.

    :raises ValueError: a board cannot do that.
    """

    def __init__(
        self,
        ratio_at: RatioAt,
        rows: int,
        columns: int,
        *,
        rate_hz: float | None = None,
        noise_lsb: float = 0.0,
        seed: int = 0,
        unit_id: int = 0,
        mode: str = "near",
        layout_crc: int = protocol.LAYOUT_CRC,
        sampled: Sampled | None = None,
    ) -> None:
        if not 0 <= noise_lsb <= 1 << protocol.ADC_BITS:
            raise ValueError(f"noise must be from 0 to {1 << protocol.ADC_BITS}, not {noise_lsb}")
        self._ratio_at = ratio_at
        self._sampled = sampled
        self._skin_shape = (rows, columns)
        self._noise_ratio = noise_lsb / (1 << protocol.ADC_BITS)
        self._random = np.random.default_rng(seed)
        self._layout_crc = layout_crc
        rate_mhz = protocol.rate_mhz(DEFAULT_RATE_HZ if rate_hz is None else rate_hz)
        skin = {"unit_id": unit_id, "rows": rows, "columns": columns, "mode": mode}
        pace = {"rate_mhz": rate_mhz, "settle_us": 0, "adc_prescaler": "clock_500khz"}
        self._defaults: dict[str, Any] = {**skin, **pace}
        try:
            _scan_plan(self._defaults)
        except _Refused as refusal:
            if rate_hz is not None or str(refusal) != "too_fast":
                raise ValueError(f"{refusal}: {_REASONS[str(refusal)]}") from None
            self._defaults["rate_mhz"] = 0
        self._stored: dict[str, Any] | None = None
        self.now_s = 0.0
        self.reset("power_on")

    def reset(self, cause: str = "external") -> None:
        """Do what the reset button does: scanning stops, unsaved settings are lost."""
        self._decoder = framing.Decoder()
        self._settings = dict(self._stored or self._defaults)
        self._settings_source = "stored" if self._stored else "defaults_blank"
        self._reset_cause = cause
        self._boot_s = self.now_s
        self._plan = _scan_plan(self._settings)
        self._baud = _CONSTANTS["baud_default"]
        self._sequence = 0
        self._scan = 0
        self._started_s: float | None = None
        self._out = bytearray()
        self._send_hello()

    @property
    def next_scan_s(self) -> float | None:
        """When the scan in progress ends [s]; None if there is none."""
        if self._started_s is None:
            return None
        return self._started_s + (self._scan + 1) * self._period_s

    @property
    def _period_s(self) -> float:
        return self._plan["scan_cycles"] / CLOCK_HZ

    def advance(self, now_s: float) -> bytes:
        """Let time pass until `now_s`. Returns what the board has sent since the last call."""
        while (end := self.next_scan_s) is not None and end <= now_s:
            self.now_s = end
            self._send_scan(end - self._period_s)
        self.now_s = max(self.now_s, now_s)
        sent, self._out = bytes(self._out), bytearray()
        return sent

    def heard(self, faults: LineFaults, now_s: float) -> bytes:
        """As `advance`, at the other end of a bad line; `faults` may also reset the board."""
        if faults.resets(now_s):
            self.reset()
        return faults.apply(self.advance(now_s), now_s)

    def codes_at(self, time_s: float, mode: str = "") -> NDArray[np.uint16]:
        """Codes of a scan, shape (rows, columns, 4); lines beyond the skin are open."""
        rows, columns = self._settings["rows"], self._settings["columns"]
        mode = mode or self._settings["mode"]
        ratio = np.tile([float(n in "aceg") for n in protocol.MODES[mode]], (rows, columns, 1))
        have = (min(rows, self._skin_shape[0]), min(columns, self._skin_shape[1]))
        ratio[: have[0], : have[1]] = self._ratio_at(time_s, mode)[: have[0], : have[1]]
        if self._sampled is not None:
            slot_s = self._plan["slot_cycles"] / CLOCK_HZ
            ratio = self._sampled(ratio, time_s, slot_s, slot_s - _SELECT_S, mode)
        if self._noise_ratio:
            ratio += self._noise_ratio * self._random.standard_normal(ratio.shape)
        return quantise(ratio, protocol.ADC_BITS)

    def receive(self, octets: bytes) -> None:
        """Take bytes from the host."""
        for raw in self._decoder.feed(octets):
            frame = protocol.FRAMES_BY_ID.get(raw.type)
            if frame is None or frame.sender != "host":
                result = "unknown_command"
            elif len(raw.payload) != frame.struct.size:
                result = "bad_length"
            else:
                result = self._execute(frame.name, frame.unpack(raw.payload))
            self._send("ack", command=raw.type, command_sequence=raw.sequence, result=result)

    def _execute(self, name: str, values: dict[str, Any]) -> str:
        scanning = self._started_s is not None
        if scanning and name in ("configure", "load_defaults", "self_test", "set_baud"):
            return "scanning"
        match name:
            case "get_hello":
                self._send_hello()
            case "configure":
                try:
                    self._plan = _scan_plan(values)
                except _Refused as refusal:
                    return str(refusal)
                self._settings.update(values)
            case "start" if not scanning:
                self._started_s, self._scan = self.now_s, 0
            case "stop" if scanning:
                self._started_s = None
            case "set_unit_id":
                self._settings["unit_id"] = values["unit_id"]
            case "save":
                self._stored = dict(self._settings)
            case "load_defaults":
                self._settings = dict(self._defaults)
                self._plan = _scan_plan(self._settings)
            case "self_test":
                none = (1 << protocol.ADC_BITS) - 1, 0
                bounds = dict.fromkeys(protocol.ENUMS["reading"].values, none)
                for mode in ("near", self._settings["mode"]):
                    codes = self.codes_at(self.now_s, mode).reshape(-1, protocol.READINGS_PER_CELL)
                    each = zip(codes.min(0).tolist(), codes.max(0).tolist(), strict=True)
                    bounds.update(zip(protocol.MODES[mode], each, strict=True))
                least, most = zip(*bounds.values(), strict=True)
                self._send("self_test_report", findings=(), code_min=least, code_max=most)
            case "set_baud":
                if values["baud"] not in (_CONSTANTS["baud_default"], _CONSTANTS["baud_fast"]):
                    return "bad_baud"
                self._baud = values["baud"]
        return "ok"

    def _send(self, name: str, tail: bytes = b"", /, **values: protocol.Value) -> None:
        frame = protocol.FRAMES[name]
        self._out += framing.encode(frame.id, self._sequence, frame.pack(**values) + tail)
        self._sequence += 1

    def _send_scan(self, start_s: float) -> None:
        codes = self.codes_at(start_s)
        self._send(
            "scan",
            protocol.pack_codes(codes),
            scan=self._scan % (1 << 32),
            time_us=round((start_s - self._boot_s) * 1e6) % (1 << 32),
            dropped=0,
            rx_errors=self._decoder.stats.damaged % (1 << 16),
            rows=codes.shape[0],
            columns=codes.shape[1],
            mode=self._settings["mode"],
        )
        self._scan += 1

    def _send_hello(self) -> None:
        self._send(
            "hello",
            layout_crc=self._layout_crc,
            **{name: self._settings[name] for name in _OF_HELLO},
            **self._plan,
            **VERSION,
            board="emulated",
            readings_per_cell=protocol.READINGS_PER_CELL,
            adc_bits=protocol.ADC_BITS,
            ref_top_ohm=round(DEFAULT_REF_OHM),
            ref_bottom_ohm=round(DEFAULT_REF_OHM),
            rate_asked_mhz=self._settings["rate_mhz"],
            clock_hz=CLOCK_HZ,
            settle_asked_us=self._settings["settle_us"],
            baud=self._baud,
            settings=self._settings_source,
            reset_cause=(self._reset_cause,),
            scanning=int(self._started_s is not None),
        )


class _Refused(Exception):
    """Carries the name of a `result`."""


def _scan_plan(wanted: dict[str, Any]) -> dict[str, int]:
    """How the firmware would scan: `scan_cycles`, `slot_cycles` and `settle_us` of `hello`.

    It is core/scan_plan.cpp without the search for the number of slots that keeps the rate best.
    """
    rate, settle = wanted["rate_mhz"], wanted["settle_us"]
    limits = {
        "bad_rows": 1 <= wanted["rows"] <= _CONSTANTS["rows_max"],
        "bad_columns": 1 <= wanted["columns"] <= _CONSTANTS["columns_max"],
        "bad_rate": not rate or _CONSTANTS["rate_mhz_min"] <= rate <= _CONSTANTS["rate_mhz_max"],
        "bad_settle": settle <= _CONSTANTS["settle_us_max"],
        "bad_prescaler": wanted["adc_prescaler"] in _PRESCALERS,
        "bad_mode": wanted["mode"] in protocol.MODES,
    }
    for result, kept in limits.items():
        if not kept:
            raise _Refused(result)
    prescaler = _PRESCALERS[wanted["adc_prescaler"]]
    readings = wanted["rows"] * wanted["columns"] * protocol.READINGS_PER_CELL
    # From the hold to the end of the conversion the sample capacitor is off.
    slot, held = 15 * prescaler, 11 * prescaler + prescaler // 2
    if settle or not rate:
        slot = max(slot, (settle or _SETTLE_US[wanted["mode"]]) * CLOCK_HZ // 1_000_000 + held)
    if not rate:
        shortest = CLOCK_HZ * 1000 / _CONSTANTS["rate_mhz_max"]
        period = slot * max(readings, math.ceil(shortest / slot))
    else:
        period = round(CLOCK_HZ * 1000 / rate)
        if period < slot * readings:
            raise _Refused("too_fast")
        # Equal slots fill the period: as short as the settle time lets them be, or long ones.
        slots = period // slot if settle else max(readings, -(-period // _SLOT_CYCLES_MAX))
        slot = period // slots
    settle_us = (slot - held) * 1_000_000 // CLOCK_HZ
    return {"scan_cycles": period, "slot_cycles": slot, "settle_us": settle_us}


class _Running:
    """An `EmulatedBoard` in real time, from now on, with the `LineFaults` of a bad line."""

    def __init__(self, board: EmulatedBoard, faults: LineFaults | None) -> None:
        self._board = board
        self._faults = faults or LineFaults()
        self._begin_s = time.monotonic()

    def _now_s(self) -> float:
        return time.monotonic() - self._begin_s


class EmulatorLink(_Running):
    """A running board as a `Link`."""

    resets_board = False

    def __init__(self, board: EmulatedBoard, name: str, faults: LineFaults | None = None) -> None:
        super().__init__(board, faults)
        self.name = name
        self._wake = threading.Condition()
        self._waiting = bytearray()  # bytes that the host has not read yet
        self._closed = False

    def read(self) -> bytes:
        """See `Link.read`."""
        with self._wake:
            deadline = self._now_s() + READ_TIMEOUT_S
            while (now := self._listen()) < deadline and not self._waiting:
                self._wake.wait(min(deadline, self._board.next_scan_s or deadline) - now)
            octets, self._waiting = bytes(self._waiting), bytearray()
            return octets

    def write(self, octets: bytes) -> None:
        """See `Link.write`."""
        with self._wake:
            self._listen()
            self._board.receive(octets)
            self._wake.notify_all()

    def _listen(self) -> float:
        """Take what arrives from the board by now; returns now."""
        now = self._now_s()
        if self._closed or self._faults.vanished(now):
            raise DeviceLost(f"{self.name} is gone: is the board still plugged in?")
        self._waiting += self._board.heard(self._faults, now)
        return now

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`: an emulated line has no speed."""

    def close(self) -> None:
        """See `Link.close`."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()


class PtyServer(_Running, Closing):
    """Serves a running board at `path`, for as long as `serve` runs.

    Bytes that no program takes are thrown away, as a serial port does that nobody has open.

    :raises PortError: this system has no pseudo-terminals.
    """

    def __init__(self, board: EmulatedBoard, faults: LineFaults | None = None) -> None:
        try:
            import tty
        except ImportError as exc:
            raise PortError("this system has no pseudo-terminals: use emulator:// itself") from exc
        super().__init__(board, faults)
        self._master, slave = os.openpty()
        self._files = [self._master, slave]
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(slave)

    def serve(self, seconds: float = float("inf")) -> None:
        """Serve for `seconds`, or until the faults let the board vanish."""
        end_s = self._now_s() + seconds
        while (now := self._now_s()) < end_s and not self._faults.vanished(now):
            self._write(self._board.heard(self._faults, now))
            wake_s = min(now + _IDLE_S, end_s, self._board.next_scan_s or end_s)
            if select.select([self._master], [], [], max(0.0, wake_s - self._now_s()))[0]:
                self._write(self._board.heard(self._faults, self._now_s()))
                self._board.receive(os.read(self._master, _READ_SIZE))

    def _write(self, octets: bytes) -> None:
        with suppress(BlockingIOError):
            os.write(self._master, octets)

    def close(self) -> None:
        """Take the pseudo-terminal away. May be called again."""
        while self._files:
            os.close(self._files.pop())
