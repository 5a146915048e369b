# SPDX-License-Identifier: Apache-2.0
"""A skin board without hardware: ``emulator://8x8?scene=ghost&seed=1``.

`EmulatedBoard` speaks the board's side of the protocol, sans-IO: `receive` takes bytes from the
host, `advance` lets time pass and returns what was sent. `ohmskin.emulate.driver` runs it.

Not modelled:

- the speed of the line: a scan's bytes come all at once at the scan's end, and none is dropped;
- EEPROM beyond the life of the object;
- findings of the self-test, and its readings g and h: the board itself is sound (`SkinFaults` are
  faults of the skin).

``simavr://`` has all these, for it runs the firmware itself.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import DEFAULT_REF_OHM
from ohmskin.emulate.faults import LineFaults
from ohmskin.link import framing, protocol
from ohmskin.link.codes import quantise
from ohmskin.version import VERSION

# Readings of the skin: (time since the board was switched on [s], mode) -> (rows, columns, 4).
RatioAt = Callable[[float, str], Float]
# What the converter makes of them: (readings, start of the scan [s], slot [s], settle time [s],
# mode) -> readings. A scan takes one reading a slot, each that settle time after the pins changed.
Sampled = Callable[[Float, float, float, float, str], Float]

# Numbers of the firmware, by which `hello` answers as a real board does. That they are those of its
# source is tested in tests/emulate/test_emulator.py.
#
# The version that hello says: as a board's firmware, an emulated board has that of the package.
_VERSION_FIELDS: Final = ("version_major", "version_minor", "version_patch")
_VERSION: Final = dict(zip(_VERSION_FIELDS, map(int, VERSION.split(".")), strict=True))
# The processor's clock on an Uno and a Mega 2560 [Hz] (Arduino's data sheets).
CLOCK_HZ: Final = 16_000_000
# The scan rate of a board that nobody has configured [Hz] (firmware/src/core/settings.h).
DEFAULT_RATE_HZ: Final = 90.0
# A slot is not longer than this [cycles] (firmware/src/core/scan_plan.h): timer 1 has 16 bits.
SLOT_CYCLES_MAX: Final = 60_000
# A slot is not shorter than this [ADC clocks], so that a conversion ends in it (scan_plan.h).
SLOT_ADC_CLOCKS_MIN: Final = 15
# From the hold of a reading to the end of its conversion, the sample capacitor is off the skin for
# this time [ADC clocks] (scan_plan.h).
HELD_ADC_CLOCKS: Final = 11.5
# A slot leaves this time for settling [us] if neither rate nor settle time is asked for, by mode
# (scan_plan.h).
SETTLE_US: Final = {"near": 20, "far": 35}
# The pins change at most this time after the hold of a reading [cycles] (docs/timing.md).
SELECT_CYCLES: Final = 120

_CONSTANTS: Final = protocol.CONSTANTS
_PRESCALERS: Final = protocol.ENUMS["adc_prescaler"].values
_REASONS: Final = protocol.ENUMS["result"].docs
_SCAN: Final = protocol.FRAMES["scan"]
# Settings that hello says by the same name.
_OF_HELLO: Final = ("unit_id", "rows", "columns", "mode", "adc_prescaler")


@dataclass(frozen=True)
class BoardSettings:
    """What a board is set to when it is switched on.

    rows, columns: of the scan, and of the skin.
    mode: which readings a scan takes of each cell.
    rate_hz: scans a second [Hz]; None: 90, or as many as readings settle in if that is less.
    unit_id: the skin's name.
    """

    rows: int = 8
    columns: int = 8
    mode: str = "near"
    rate_hz: float | None = None
    unit_id: int = 0


class EmulatedBoard:
    """A board whose skin reads `ratio_at(seconds, mode)`, shape (rows, columns, 4).

    settings: those of the start. The skin keeps their rows and columns, whatever a host configures.
    noise_lsb: standard deviation of the converter's noise, before rounding [LSB].
    seed: of the noise.
    sampled: what the converter makes of the skin's readings; None: noise alone changes them.
    says: fields of `hello` that the board says in place of the truth.

    The attribute `settings` has what is set now: the fields of `configure` and `set_unit_id`. A
    test of a host may change it, and `says`, at any time. `on_start` is called with the time [s]
    when scans begin.

    :raises ValueError: a board cannot do that.
    """

    def __init__(
        self,
        ratio_at: RatioAt,
        settings: BoardSettings,
        *,
        noise_lsb: float = 0.0,
        seed: int = 0,
        sampled: Sampled | None = None,
        says: Mapping[str, protocol.Value] = {},
    ) -> None:
        if not 0 <= noise_lsb <= 1 << protocol.ADC_BITS:
            raise ValueError(f"noise must be from 0 to {1 << protocol.ADC_BITS}, not {noise_lsb}")
        self.says = dict(says)
        self._ratio_at = ratio_at
        self._sampled = sampled
        self._skin_shape = (settings.rows, settings.columns)
        self.on_start: Callable[[float], None] = lambda now_s: None
        self._noise_ratio = noise_lsb / (1 << protocol.ADC_BITS)
        self._random = np.random.default_rng(seed)
        self._defaults = _defaults(settings)
        self._stored: dict[str, Any] | None = None
        self.now_s = 0.0
        self.reset("power_on")

    def reset(self, cause: str = "external") -> None:
        """Do what the reset button does: scanning stops, unsaved settings are lost."""
        self._decoder = framing.Decoder()
        self.settings = dict(self._stored or self._defaults)
        self._settings_source = "stored" if self._stored else "defaults_blank"
        self._reset_cause = cause
        self.boot_s = self.now_s
        self._plan = _scan_plan(self.settings)
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
        rows, columns = self.settings["rows"], self.settings["columns"]
        mode = mode or self.settings["mode"]
        ratio = np.tile([float(n in "aceg") for n in protocol.MODES[mode]], (rows, columns, 1))
        have = (min(rows, self._skin_shape[0]), min(columns, self._skin_shape[1]))
        ratio[: have[0], : have[1]] = self._ratio_at(time_s, mode)[: have[0], : have[1]]
        if self._sampled is not None:
            slot_s = self._plan["slot_cycles"] / CLOCK_HZ
            ratio = self._sampled(ratio, time_s, slot_s, slot_s - SELECT_CYCLES / CLOCK_HZ, mode)
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
                self.settings.update(values)
            case "start" if not scanning:
                self._started_s, self._scan = self.now_s, 0
                self.on_start(self.now_s)
            case "stop" if scanning:
                self._started_s = None
            case "set_unit_id":
                self.settings["unit_id"] = values["unit_id"]
            case "save":
                self._stored = dict(self.settings)
            case "load_defaults":
                self.settings = dict(self._defaults)
                self._plan = _scan_plan(self.settings)
            case "self_test":
                self._send_self_test_report()
            case "set_baud":
                if values["baud"] not in (_CONSTANTS["baud_default"], _CONSTANTS["baud_fast"]):
                    return "bad_baud"
                self._baud = values["baud"]
        return "ok"

    def _send_self_test_report(self) -> None:
        """Say the least and the largest code of each reading, over all cells."""
        # As the firmware says a reading that it has not taken: the least is above the largest.
        not_taken = ((1 << protocol.ADC_BITS) - 1, 0)
        bounds = dict.fromkeys(protocol.ENUMS["reading"].values, not_taken)
        for mode in ("near", self.settings["mode"]):
            codes = self.codes_at(self.now_s, mode).reshape(-1, protocol.READINGS_PER_CELL)
            of_mode = zip(codes.min(0).tolist(), codes.max(0).tolist(), strict=True)
            bounds.update(zip(protocol.MODES[mode], of_mode, strict=True))
        least, largest = zip(*bounds.values(), strict=True)
        self._send("self_test_report", findings=(), code_min=least, code_max=largest)

    def _send(self, name: str, tail: bytes = b"", /, **values: protocol.Value) -> None:
        frame = protocol.FRAMES[name]
        self._out += framing.encode(frame.id, self._sequence, frame.pack(**values) + tail)
        self._sequence += 1

    def _send_scan(self, start_s: float) -> None:
        codes = self.codes_at(start_s)
        self._send(
            "scan",
            protocol.pack_codes(codes),
            scan=self._scan % _SCAN.span("scan"),
            time_us=round((start_s - self.boot_s) * 1e6) % _SCAN.span("time_us"),
            dropped=0,
            rx_errors=self._decoder.stats.damaged % _SCAN.span("rx_errors"),
            rows=codes.shape[0],
            columns=codes.shape[1],
            mode=self.settings["mode"],
        )
        self._scan += 1

    def _send_hello(self) -> None:
        truth: dict[str, protocol.Value] = {
            **{name: self.settings[name] for name in _OF_HELLO},
            **self._plan,
            **_VERSION,
            "layout_crc": protocol.LAYOUT_CRC,
            "board": "emulated",
            "readings_per_cell": protocol.READINGS_PER_CELL,
            "adc_bits": protocol.ADC_BITS,
            "ref_top_ohm": round(DEFAULT_REF_OHM),
            "ref_bottom_ohm": round(DEFAULT_REF_OHM),
            "rate_asked_mhz": self.settings["rate_mhz"],
            "clock_hz": CLOCK_HZ,
            "settle_asked_us": self.settings["settle_us"],
            "baud": self._baud,
            "settings": self._settings_source,
            "reset_cause": (self._reset_cause,),
            "scanning": int(self._started_s is not None),
        }
        self._send("hello", **(truth | self.says))


class _Refused(Exception):
    """Carries the name of a `result`."""


def _defaults(settings: BoardSettings) -> dict[str, Any]:
    """The fields of `configure` and `set_unit_id` of a board that nobody has configured."""
    rate_hz = DEFAULT_RATE_HZ if settings.rate_hz is None else settings.rate_hz
    pace = {"rate_mhz": protocol.rate_mhz(rate_hz), "settle_us": 0, "adc_prescaler": "clock_500khz"}
    defaults = {n: value for n, value in asdict(settings).items() if n != "rate_hz"} | pace
    try:
        _scan_plan(defaults)
    except _Refused as refusal:
        if settings.rate_hz is not None or str(refusal) != "too_fast":
            raise ValueError(f"{refusal}: {_REASONS[str(refusal)]}") from None
        defaults["rate_mhz"] = 0
    return defaults


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
    slot, held = SLOT_ADC_CLOCKS_MIN * prescaler, int(HELD_ADC_CLOCKS * prescaler)
    if settle or not rate:
        slot = max(slot, (settle or SETTLE_US[wanted["mode"]]) * CLOCK_HZ // 1_000_000 + held)
    if not rate:
        shortest = CLOCK_HZ * 1000 / _CONSTANTS["rate_mhz_max"]
        period = slot * max(readings, math.ceil(shortest / slot))
    else:
        period = round(CLOCK_HZ * 1000 / rate)
        if period < slot * readings:
            raise _Refused("too_fast")
        # Equal slots fill the period: as short as the settle time lets them be, or long ones.
        slots = period // slot if settle else max(readings, -(-period // SLOT_CYCLES_MAX))
        slot = period // slots
    settle_us = (slot - held) * 1_000_000 // CLOCK_HZ
    return {"scan_cycles": period, "slot_cycles": slot, "settle_us": settle_us}
