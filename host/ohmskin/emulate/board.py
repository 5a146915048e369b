# SPDX-License-Identifier: Apache-2.0
"""A skin board without hardware: ``emulator://8x8?scene=ghost&seed=1``.

`EmulatedBoard` speaks the board's side of the protocol, sans-IO: `receive` takes bytes from the
host, `advance` lets time pass and returns what was sent. `ohmskin.emulate.driver` runs it.

Not modelled:

- the speed of the line: a scan's bytes come all at once at the end of its period, and none is
  dropped;
- the end of the last scan: `stop` is answered at once, and the scan in progress never comes, where
  a board ends it first;
- EEPROM beyond the life of the object;
- findings of the self-test, and its readings g and h: the board itself is sound (`SkinFaults` are
  faults of the skin).

``simavr://`` has all this, because it runs the firmware itself.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import DEFAULT_REF_OHM
from ohmskin.emulate.faults import LineFaults
from ohmskin.link import framing, protocol
from ohmskin.link.clock import BITS_PER_BYTE
from ohmskin.link.codes import quantise
from ohmskin.version import VERSION

# Readings of the skin: (time since the board was switched on [s], mode) -> (rows, columns, n).
RatioAt = Callable[[float, str], Float]
# What the converter makes of the skin's readings: (readings, start of the scan [s], slot [s],
# settle time [s], mode) -> readings. A scan takes one reading in each slot. It is taken when the
# settle time has passed since the pins changed.
Sampled = Callable[[Float, float, float, float, str], Float]

# Numbers of the firmware, so that the emulated board answers as a real one.
# tests/emulate/test_emulator.py compares them with the firmware's source.
#
# The version that hello says: like a board's firmware, an emulated board has that of the package.
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
# The sample capacitor is off the skin for this time, from the hold of a reading to the end of its
# conversion [ADC clocks] (scan_plan.h).
HELD_ADC_CLOCKS: Final = 11.5
# A slot leaves this time for settling [us] if neither rate nor settle time is asked for, by mode
# (scan_plan.h).
SETTLE_US: Final = dict(zip(protocol.MODES, (20, 35, 40, 101), strict=True))
# Time that the processor needs for each slot, in addition for each reading, and in addition for
# each scan [cycles] (scan_plan.h).
BUSY_A_SLOT, BUSY_A_READING, BUSY_A_SCAN = 165, 240, 5000
# It has the time of so many slots more where they are as long as the rate allows (scan_plan.cpp).
SPARE_SLOTS: Final = 3
# The line is idle for one part in so many of the time (scan_plan.h).
LINE_IDLE_PART: Final = 8
# At least `IDLE_TO_CHANGE` slots are idle between scans of two kinds, and at least `IDLE_OF_FEW`
# after scans of up to `FEW` readings (scan_plan.h).
IDLE_TO_CHANGE, FEW, IDLE_OF_FEW = 3, 3, 5
# Rows and columns that the multiplexers have (scan_sequence.h).
LINES_MAX: Final = 16
# The pins change no later than this after the hold of a reading [cycles] (docs/timing.md).
SELECT_CYCLES: Final = 104

_CONSTANTS: Final = protocol.CONSTANTS
# Clock cycles of an ADC clock, by accuracy (scan_plan.h).
_PRESCALERS: Final = {name: 32 << n for name, n in protocol.ENUMS["accuracy"].values.items()}
_SCAN: Final = protocol.FRAMES["scan"]


@dataclass(frozen=True)
class BoardSettings:
    """What a board is set to when it is switched on.

    rows, columns: of the scan, and of the skin.
    mode: which readings a scan takes of each cell.
    rate_hz: scans a second [Hz]; None: 90, or fewer if readings need more time to settle.
    unit_id: the skin's name.
    """

    rows: int = 8
    columns: int = 8
    mode: str = "near"
    rate_hz: float | None = None
    unit_id: int = 0


class EmulatedBoard:
    """A board whose skin reads `ratio_at(seconds, mode)`, shape (rows, columns, readings).

    settings: those at the start. The skin keeps their rows and columns, whatever a host configures.
    noise_lsb: standard deviation of the converter's noise, before rounding [LSB].
    seed: of the noise.
    sampled: what the converter makes of the skin's readings; None: noise alone changes them.
    says: fields of `hello` that the board says in place of the truth.

    The attribute `settings` has what is set now: the fields of `configure` and `set_unit_id`. A
    test may change `settings` and `says` at any time. The attribute `on_start` is called when scans
    begin, with the time [s].

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
        self.on_start: Callable[[float], None] = lambda now_s: None
        self._noise_ratio = noise_lsb / (1 << protocol.ADC_BITS)
        self._random = np.random.default_rng(seed)
        self._defaults = _defaults(settings)
        self._stored: dict[str, Any] | None = None
        self.now_s = 0.0
        self.reset("power_on")

    def reset(self, cause: str = "external") -> None:
        """Do what the reset button does: scanning stops, and unsaved settings are lost."""
        self._decoder = framing.Decoder()
        self.settings = dict(self._stored or self._defaults)
        self._settings_source = "stored" if self._stored else "defaults_blank"
        self._reset_cause = cause
        self.boot_s = self.now_s
        self._baud = _CONSTANTS["baud_default"]
        self._next_baud: int | None = None  # it comes when the answer to set_baud has left
        # A scan that was saved at the faster line is kept, and refused at start: as the firmware.
        self._plans = self._next_plans = _scan_plans(self.settings, _CONSTANTS["baud_fast"])
        self._started_s: float | None = None
        self._use(self.settings)
        self._sequence = 0
        self._scan = 0
        self._cycles = 0  # from the start of scans to that of the one in progress
        self._whole = False  # whether the scan in progress is a whole one
        self._until_whole = 0  # how many scans come before the next whole one
        self._waited = False  # whether that one has let a region go first
        self._out = bytearray()
        self._send_hello()

    @property
    def next_scan_s(self) -> float | None:
        """When the scan in progress ends [s]; None if there is none."""
        if self._started_s is None:
            return None
        return self._started_s + (self._cycles + self._plan.cycles) / CLOCK_HZ

    @property
    def _plan(self) -> "ScanPlan":
        """The plan of the scan in progress."""
        return self._plans[self._whole]

    def advance(self, now_s: float) -> bytes:
        """Let time pass until `now_s`. Returns what the board has sent since the last call."""
        while (end := self.next_scan_s) is not None and end <= now_s:
            self.now_s = end
            self._send_scan(end - self._plan.cycles / CLOCK_HZ)
        self.now_s = max(self.now_s, now_s)
        sent, self._out = bytes(self._out), bytearray()
        if self._next_baud is not None:
            self._baud, self._next_baud = self._next_baud, None
            self._use(self.settings)
        return sent

    def heard(self, faults: LineFaults, now_s: float) -> bytes:
        """What arrives at the other end of a line with faults; these may also reset the board."""
        if faults.resets(now_s):
            self.reset()
        return faults.apply(self.advance(now_s), now_s)

    def codes_at(self, time_s: float, mode: str = "") -> NDArray[np.uint16]:
        """Codes of a scan, shape (rows, columns, readings); lines beyond the skin are open."""
        rows, columns = self.settings["rows"], self.settings["columns"]
        mode = mode or self._plan.mode
        ratio = np.tile([float(n in "aceg") for n in protocol.MODES[mode]], (rows, columns, 1))
        skin = self._ratio_at(time_s, mode)[:rows, :columns]
        ratio[: skin.shape[0], : skin.shape[1]] = skin
        if self._sampled is not None:
            slot_s = self._plan.slot_cycles / CLOCK_HZ
            ratio = self._sampled(ratio, time_s, slot_s, slot_s - SELECT_CYCLES / CLOCK_HZ, mode)
        if self._noise_ratio:
            ratio += self._noise_ratio * self._random.standard_normal(ratio.shape)
        return quantise(ratio, protocol.ADC_BITS)

    def receive(self, octets: bytes) -> None:
        """Take bytes from the host."""
        for raw in self._decoder.feed(octets):
            frame = protocol.FRAMES_BY_ID.get(raw.type)
            self._rate_mhz = 0  # that can be kept, of the settings that this command asks for
            if frame is None or frame.sender != "host":
                result = "unknown_command"
            elif len(raw.payload) != frame.struct.size:
                result = "bad_length"
            else:
                result = self._execute(frame.name, frame.unpack(raw.payload))
            asks = frame is not None and frame.name in ("configure", "set_region")
            which = {"command": raw.type, "command_sequence": raw.sequence}
            told = {"time_us": self._time_us(self.now_s), "rate_mhz": asks * self._rate_mhz}
            self._send("ack", **which, **told, result=result)

    def _execute(self, name: str, values: dict[str, Any]) -> str:
        scanning = self._started_s is not None
        if self._next_baud is not None and name != "get_hello":
            return "busy"
        if scanning and name in ("configure", "load_defaults", "self_test", "set_baud"):
            return "scanning"
        match name:
            case "get_hello":
                self._send_hello()
            case "configure" | "set_region":
                return self._use(self.settings | values)
            case "start" if not scanning:
                if (result := self._use(self.settings)) != "ok":
                    return result
                self._started_s = self.now_s
                self._scan = self._cycles = self._until_whole = 0
                self._take_turn()
                self.on_start(self.now_s)
            case "stop" if scanning:
                self._started_s = None
            case "set_unit_id":
                self.settings["unit_id"] = values["unit_id"]
            case "save":
                self._stored = dict(self.settings)
            case "load_defaults":
                self._use(dict(self._defaults))
            case "self_test":
                self._send_self_test_report()
            case "set_baud":
                if values["baud"] not in (_CONSTANTS["baud_default"], _CONSTANTS["baud_fast"]):
                    return "bad_baud"
                self._next_baud = values["baud"]
        return "ok"

    def _use(self, wanted: dict[str, Any]) -> str:
        """Use these settings from the next scan on, at the line's speed of now.

        If they cannot be, nothing changes: a plan for the faster line stays. Returns the result,
        "ok" or the reason, by its name in frames.toml.
        """
        try:
            self._next_plans = _scan_plans(wanted, self._baud)
        except _Refused as refusal:
            self._rate_mhz = refusal.rate_mhz
            return refusal.result
        self.settings = wanted
        self._rate_mhz = round(1000 * CLOCK_HZ / self._next_plans[0].cycles)
        if self._started_s is None:
            self._plans = self._next_plans
        return "ok"

    def _take_turn(self) -> None:
        """Decide which scan begins now: one of the region, or a whole one."""
        every = self.settings["whole_every"]
        if self._plans is not self._next_plans and not (self._until_whole or self._waited):
            # A whole scan that is due lets one scan of a new region go first, as in the firmware.
            self._until_whole, self._waited = 1, True
        self._plans = self._next_plans
        self._until_whole = min(self._until_whole, max(every - 1, 0))
        self._whole = every > 0 and self._until_whole == 0
        self._waited &= not self._whole
        self._until_whole = every - 1 if self._whole else max(self._until_whole - 1, 0)

    def _time_us(self, time_s: float) -> int:
        return round((time_s - self.boot_s) * 1e6) % _SCAN.span("time_us")

    def _send_self_test_report(self) -> None:
        """Say the least and the largest code of each reading, over all cells."""
        # As the firmware marks a reading that was not taken: the least is above the largest.
        not_taken = ((1 << protocol.ADC_BITS) - 1, 0)
        bounds = dict.fromkeys(protocol.ENUMS["reading"].values, not_taken)
        for mode in ("near", self.settings["mode"]):
            codes = self.codes_at(self.now_s, mode).reshape(-1, len(protocol.MODES[mode]))
            of_mode = zip(codes.min(0).tolist(), codes.max(0).tolist(), strict=True)
            bounds.update(zip(protocol.MODES[mode], of_mode, strict=True))
        least, largest = zip(*bounds.values(), strict=True)
        self._send("self_test_report", findings=(), code_min=least, code_max=largest)

    def _send(self, name: str, tail: bytes = b"", /, **values: protocol.Value) -> None:
        frame = protocol.FRAMES[name]
        self._out += framing.encode(frame.id, self._sequence, frame.pack(**values) + tail)
        self._sequence += 1

    def _send_scan(self, start_s: float) -> None:
        plan = self._plan
        codes = self.codes_at(start_s)
        lines = map(protocol.lines_of, (plan.row_mask, plan.column_mask), codes.shape)
        self._send(
            "scan",
            protocol.pack_codes(codes[np.ix_(*lines)], protocol.PER_PASS[plan.mode]),
            scan=self._scan % _SCAN.span("scan"),
            time_us=self._time_us(start_s),
            dropped=0,
            rx_errors=self._decoder.stats.damaged % _SCAN.span("rx_errors"),
            rows=codes.shape[0],
            columns=codes.shape[1],
            mode=plan.mode,
            adc_bits=protocol.ADC_BITS,
            row_mask=plan.row_mask,
            column_mask=plan.column_mask,
            slot_cycles=plan.slot_cycles,
        )
        self._scan += 1
        self._cycles += plan.cycles
        self._take_turn()

    def _send_hello(self) -> None:
        region, whole = self._next_plans
        truth: dict[str, protocol.Value] = {
            **{protocol.ASKED.get(name, name): value for name, value in self.settings.items()},
            **_VERSION,
            "layout_crc": protocol.LAYOUT_CRC,
            "board": "emulated",
            "wiring": 0,
            "rows_max": LINES_MAX,
            "columns_max": LINES_MAX,
            "adc_bits": protocol.ADC_BITS,
            "ref_top_ohm": round(DEFAULT_REF_OHM),
            "ref_bottom_ohm": round(DEFAULT_REF_OHM),
            "scan_cycles": region.cycles,
            "slot_cycles": region.slot_cycles,
            "settle_us": region.settle_us,
            "whole_scan_cycles": whole.cycles if self.settings["whole_every"] else 0,
            "clock_hz": CLOCK_HZ,
            "baud": self._baud,
            "settings": self._settings_source,
            "reset_cause": (self._reset_cause,),
            "scanning": int(self._started_s is not None),
            "dropped": 0,
            "late": 0,
        }
        self._send("hello", **(truth | self.says))


class _Refused(Exception):
    """Carries the name of a `result`, and the rate that would be possible [mHz]; 0: not known."""

    def __init__(self, result: str, rate_mhz: int = 0) -> None:
        super().__init__(result)
        self.result, self.rate_mhz = result, rate_mhz


def _defaults(settings: BoardSettings) -> dict[str, Any]:
    """The fields of `configure` and `set_unit_id` of a board that nobody has configured."""
    rate_hz = DEFAULT_RATE_HZ if settings.rate_hz is None else settings.rate_hz
    pace = {"rate_mhz": protocol.rate_mhz(rate_hz), "settle_us": 0, "accuracy": "usual"}
    whole = protocol.whole_masks(settings.rows, settings.columns)
    whole |= {"whole_mode": "near", "whole_every": 0}
    defaults = {n: v for n, v in asdict(settings).items() if n != "rate_hz"} | pace | whole
    try:
        _scan_plans(defaults, _CONSTANTS["baud_default"])
    except _Refused as refusal:
        if settings.rate_hz is not None or refusal.result not in ("too_fast", "line_too_slow"):
            reason = protocol.ENUMS["result"].docs[refusal.result]
            raise ValueError(f"{refusal.result}: {reason}") from None
        defaults["rate_mhz"] = 0
    return defaults


@dataclass(frozen=True)
class ScanPlan:
    """One kind of scan: its lines and readings, and its times.

    row_mask, column_mask: the lines that it reads.
    mode: the readings of each cell.
    cycles: clock cycles from its start to the start of the next scan.
    slot_cycles: clock cycles of a slot.
    settle_us: the least time for settling in a slot [us].
    """

    row_mask: int
    column_mask: int
    mode: str
    cycles: int
    slot_cycles: int
    settle_us: int


def _scan_plans(wanted: dict[str, Any], baud: int) -> tuple[ScanPlan, ScanPlan]:
    """How the firmware would scan: a region, and whole scans in between.

    This is core/scan_plan.cpp, but without its search for the number of slots with which the rate
    is kept best.
    """
    _check_limits(wanted)
    whole = protocol.whole_masks(wanted["rows"], wanted["columns"])
    whole |= {"mode": wanted["whole_mode"], "rate_mhz": 0, "settle_us": 0}
    return _scan_plan(wanted, baud), _scan_plan(wanted | whole, baud)


def _check_limits(wanted: dict[str, Any]) -> None:
    rate = wanted["rate_mhz"]
    limits = {
        "bad_rows": 1 <= wanted["rows"] <= LINES_MAX
        and 0 < wanted["row_mask"] <= protocol.all_lines(wanted["rows"]),
        "bad_columns": 1 <= wanted["columns"] <= LINES_MAX
        and 0 < wanted["column_mask"] <= protocol.all_lines(wanted["columns"]),
        "bad_rate": not rate or _CONSTANTS["rate_mhz_min"] <= rate <= _CONSTANTS["rate_mhz_max"],
        "bad_settle": wanted["settle_us"] <= _CONSTANTS["settle_us_max"],
        "bad_accuracy": wanted["accuracy"] in _PRESCALERS,
        "bad_mode": {wanted["mode"], wanted["whole_mode"]} <= protocol.MODES.keys(),
    }
    for result, kept in limits.items():
        if not kept:
            raise _Refused(result)


def _scan_plan(wanted: dict[str, Any], baud: int) -> ScanPlan:
    """One kind of scan. Raises _Refused if it is too fast."""
    masks, mode = (wanted["row_mask"], wanted["column_mask"]), wanted["mode"]
    prescaler = _PRESCALERS[wanted["accuracy"]]
    readings = math.prod(mask.bit_count() for mask in masks) * len(protocol.MODES[mode])
    idle_min = IDLE_TO_CHANGE if wanted["whole_every"] else 0
    least = readings + (IDLE_OF_FEW if readings <= FEW else idle_min)  # slots
    rate, settle = wanted["rate_mhz"], wanted["settle_us"]
    slot, held = SLOT_ADC_CLOCKS_MIN * prescaler, int(HELD_ADC_CLOCKS * prescaler)
    if settle or not rate:
        slot = max(slot, (settle or SETTLE_US[mode]) * CLOCK_HZ // 1_000_000 + held)
    by_line = _line_cycles(readings, baud)
    busy = BUSY_A_SCAN + BUSY_A_READING * readings
    spare = SPARE_SLOTS + (IDLE_OF_FEW if readings <= FEW else 0)
    slots_busy = readings + spare if rate and not settle else busy // (slot - BUSY_A_SLOT)
    fastest = max(slot * least, busy + BUSY_A_SLOT * slots_busy)
    result = "line_too_slow" if by_line > fastest else "too_fast"
    fastest = max(fastest, by_line)
    if not rate:
        period = slot * -(-fastest // slot)
    else:
        period = round(CLOCK_HZ * 1000 / rate)
        if period < fastest:
            raise _Refused(result, 1000 * CLOCK_HZ // fastest)
        # Equal slots fill the period. With a settle time, they are as short as it allows, so that
        # the scan is over early; else they are as long as possible, so that readings settle best.
        slots = period // slot if settle else max(least, -(-period // SLOT_CYCLES_MAX))
        slot = period // slots
    return ScanPlan(*masks, mode, period, slot, (slot - held) * 1_000_000 // CLOCK_HZ)


def _line_cycles(readings: int, baud: int) -> int:
    """Clock cycles in which the line carries a scan."""
    content = _SCAN.struct.size + protocol.codes_size(readings)
    # Counted as in core/frame_writer.h: type, sequence, CRC and delimiters, and the blocks of COBS.
    octets = content + 6 + 1 + (content + 6) // (framing.MAX_BLOCK_BYTES - 1)
    cycles = octets * (CLOCK_HZ // baud * BITS_PER_BYTE)
    return cycles + cycles // (LINE_IDLE_PART - 1)
