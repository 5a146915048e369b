# SPDX-License-Identifier: Apache-2.0
"""What a board says, as Python objects. They are decoded from bytes, without port or thread.

`BoardDecoder` makes them. What makes a message of a payload alone is in the frames' definition
(`protocol`). The decoder adds what only a row of scans tells: how many are missing before each, and
a board time that does not wrap.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import FULL_SCALE_USIEMENS, heat_map
from ohmskin.link import layouts, protocol
from ohmskin.link.codes import check_adc_bits, ratio_from_codes
from ohmskin.link.framing import Decoder, DecoderStats, RawFrame

_SCAN = protocol.FRAMES["scan"]
# Readings of a cell that show all of it: those of mode near, or as many of mode far.
_COMPLETE_READINGS = len(protocol.MODES["near"])
# Counters of a board go on with 0 after so many: the scan's number, its time [us], and how many
# scans the board has dropped.
_NUMBER_SPAN = _SCAN.span("scan")
_TIME_SPAN_US = _SCAN.span("time_us")
_DROPPED_SPAN = _SCAN.span("dropped")
# A board's second is at most this share longer or shorter than the host's: its ceramic resonator is
# up to 0.5 % off (data sheet of Murata's CSTCE16M0V53, which an Arduino Uno has), a crystal 0.01 %;
# a fifth more is left for delays.
MAX_RATE_ERROR = 0.006
# A scan that comes this much later than expected, when scans begin again, is one of a board that
# was reset meanwhile [s]. Chosen: more than what delays the arrival of scans.
RESET_DELAY_S = 1.0
# No sound board says that a scan takes longer. Chosen: three times the 3.2 s of the largest skin at
# the longest settle time; the protocol has no such number.
_MAX_SCAN_S = 10
# No sound board says that it has a larger reference resistor. Chosen: through one, the leakage of
# the converter's input, 1 uA at most by the ATmega328P's data sheet, would be all that is read.
_MAX_REF_OHM = 10_000_000
# No sound board has longer names of itself. Chosen: three times as long as all causes of a reset.
_MOST_LETTERS = 100
# Attributes that scans of a calibrated skin alone have, and that people ask others for.
_OF_FORCES: Final = (
    *("contacts", "estimate", "force_n", "force_n_std", "geometry", "touch_force_n", "wrench"),
)


@dataclass(frozen=True)
class Hello:
    """The fields of the frame `hello`, as ``protocol/FRAMES.md`` describes them."""

    layout_crc: int
    version_major: int
    version_minor: int
    version_patch: int
    board: str
    wiring: int
    unit_id: int
    rows_max: int
    columns_max: int
    rows: int
    columns: int
    adc_bits: int
    ref_top_ohm: int
    ref_bottom_ohm: int
    rate_asked_mhz: int
    scan_cycles: int
    slot_cycles: int
    whole_scan_cycles: int
    clock_hz: int
    settle_asked_us: int
    settle_us: int
    accuracy: str
    mode: str
    row_mask: int
    column_mask: int
    whole_mode: str
    whole_every: int
    baud: int
    settings: str
    reset_cause: tuple[str, ...]
    scanning: int
    dropped: int
    late: int

    @property
    def version(self) -> str:
        """Firmware version, ``"0.1.0"``."""
        return f"{self.version_major}.{self.version_minor}.{self.version_patch}"

    @property
    def rate_hz(self) -> float:
        """Scan rate that the board keeps [Hz]: clock_hz / scan_cycles."""
        return self.clock_hz / self.scan_cycles

    @property
    def readings_per_cell(self) -> int:
        """Readings that a scan takes of each cell."""
        return len(protocol.MODES[self.mode])

    @property
    def reads_far(self) -> bool:
        """Whether far ends of the lines are read, and not near ends alone."""
        return self.mode == "far"

    @property
    def is_whole(self) -> bool:
        """Whether scans are of all cells, and not of a region."""
        return self.readings == self.rows * self.columns * self.readings_per_cell

    @property
    def is_complete(self) -> bool:
        """Whether scans are complete: `Scan.is_complete`."""
        return self.readings == self.rows * self.columns * _COMPLETE_READINGS

    @property
    def readings(self) -> int:
        """Readings of a scan, those of a whole one in between left out."""
        return self.row_mask.bit_count() * self.column_mask.bit_count() * self.readings_per_cell

    def impossible(self) -> str:
        """A field and what no board of this protocol says in it, ``"rows 0"``; ``""`` for none.

        Whoever gets a hello asks this first. The rest of the host divides by these numbers and
        makes arrays of these sizes, whatever a broken board or a hostile file says.
        """
        limits, modes = protocol.CONSTANTS, protocol.MODES
        all_rows, all_columns = map(protocol.all_lines, (self.rows, self.columns))
        known = self.mode in modes and self.whole_mode in modes
        can_be = {
            "rows_max": 1 <= self.rows_max <= limits["rows_max"],
            "columns_max": 1 <= self.columns_max <= limits["columns_max"],
            "rows": 1 <= self.rows <= self.rows_max,
            "columns": 1 <= self.columns <= self.columns_max,
            "row_mask": 0 < self.row_mask <= all_rows,
            "column_mask": 0 < self.column_mask <= all_columns,
            "adc_bits": 1 <= self.adc_bits <= limits["adc_bits_max"],
            "ref_top_ohm": 0 < self.ref_top_ohm <= _MAX_REF_OHM,
            "ref_bottom_ohm": 0 < self.ref_bottom_ohm <= _MAX_REF_OHM,
            "baud": self.baud > 0,
            "clock_hz": self.clock_hz > 0,
            "mode": self.mode in modes,
            "whole_mode": self.whole_mode in modes,
            "scan_cycles": 0 < self.scan_cycles <= _MAX_SCAN_S * self.clock_hz,
            "whole_scan_cycles": self.whole_scan_cycles <= _MAX_SCAN_S * self.clock_hz,
            "slot_cycles": known and 0 < self.slot_cycles * self.readings <= self.scan_cycles,
            "accuracy": self.accuracy in protocol.ENUMS["accuracy"].values,
            "settings": len(self.settings) <= _MOST_LETTERS,
            "reset_cause": len("".join(self.reset_cause)) <= _MOST_LETTERS,
            "board": len(self.board) <= _MOST_LETTERS,
        }
        odd = [f"{name} {getattr(self, name)!s:.40}" for name, can in can_be.items() if not can]
        return odd[0] if odd else ""


@dataclass(frozen=True)
class ForeignHello:
    """A `hello` of another protocol definition. Only its CRC can be read."""

    layout_crc: int


@dataclass(frozen=True)
class Ack:
    """A board's answer to a command.

    command: id of the command's frame.
    command_sequence: sequence number of the command's frame.
    result: name of a member of the enum `result`.
    time_us: board time at which the command's last byte was read [us]; wraps. None: it is not said,
        by boards of before there was this field.
    rate_mhz: where the command asked for a rate, the one that is kept or could be [mHz]; else 0.
    """

    command: int
    command_sequence: int
    result: str
    time_us: int | None
    rate_mhz: int


@dataclass(frozen=True)
class SelfTestReport:
    """What the sense nodes read over all multiplexer inputs.

    findings: names of the members of the enum `finding`; empty on a sound board.
    code_min: smallest code of each of the readings a to h; the largest there is, if not taken.
    code_max: largest code of each of the readings a to h; 0, if not taken.
    """

    findings: tuple[str, ...]
    code_min: tuple[int, ...]
    code_max: tuple[int, ...]


def missing_attribute(of: object, name: str, of_calibrated: Collection[str], whose: str) -> Any:
    """For `__getattr__`: raise as ever, and say of names that calibrated `whose` have why not."""
    if name not in of_calibrated or hasattr(type(of), name):
        return object.__getattribute__(of, name)  # raises, with a property's own error
    text = f"'{type(of).__name__}' object has no attribute '{name}': {whose} have it "
    text += "where a calibration is given: ohmskin.open(port, calibration='skin.json')"
    raise AttributeError(text, name=name, obj=of)


@dataclass(frozen=True, eq=False)
class Scan:
    """The readings of a skin, or of a region of it, at one time.

    codes: ADC codes of `reading_names`, shape (rows, columns, readings); 0 where nothing was read.
    number: of the scan since the command `start`; scans that the board dropped count.
    time_us: when the scan began, since the board was switched on or reset [us], without wraps.
    host_time_s: `time.monotonic()` when the scan's last byte was read [s].
    missed: scans made since the one before this that never came: the board dropped them, or they
        were damaged on the way.
    mode: which readings these are, a name of the enum `mode`.
    time_ns: when the middle of the scan was, since 1970 [ns], by `ScanClock`; 0: nobody asked it.
    delay_s: constant delays of both directions of the line together, by `BoardClock` [s]; 0: not
        known.
    adc_bits: of a code.
    row_mask, column_mask: which rows and columns were read, bit 0 for the first; 0: all.
    slot_cycles: time from one reading to the next [clock cycles of the board]; 0: that of `board`.
    rest_ratio: of a recording that is played, the tare in force (rows, columns, 4); else None.
    board: what the board had last said of itself when a `Device` got the scan; else None.
    """

    codes: NDArray[np.uint16]
    number: int
    time_us: int
    host_time_s: float
    missed: int
    mode: str = field(default="near", kw_only=True)
    time_ns: int = field(default=0, kw_only=True)
    delay_s: float = field(default=0.0, kw_only=True)
    adc_bits: int = field(default=protocol.ADC_BITS, kw_only=True)
    row_mask: int = field(default=0, kw_only=True)
    column_mask: int = field(default=0, kw_only=True)
    slot_cycles: int = field(default=0, kw_only=True)
    rest_ratio: NDArray[np.float64] | None = field(default=None, kw_only=True)
    board: Hello | None = field(default=None, kw_only=True)

    if not TYPE_CHECKING:  # a type checker would take any name for an attribute

        def __getattr__(self, name: str) -> Any:
            return missing_attribute(self, name, _OF_FORCES, "scans")

    def __repr__(self) -> str:
        size = f"{self.rows}x{self.columns} cells, mode {self.mode}"
        return f"<{type(self).__name__} {self.number}: {size}, missed {self.missed} before it>"

    def _repr_html_(self) -> str:
        """A heat map, in a notebook: of the readings B, which small conductances are like."""
        thousandths = 1e3 * self.ratio[:, :, self.reading_names.index("b")]
        text = f"{self!r} [reading B, thousandths of Vdd]"
        return heat_map(thousandths, FULL_SCALE_USIEMENS, text)

    @property
    def ratio(self) -> NDArray[np.float64]:
        """Sense-node voltages over Vdd, (code + 0.5) / 2^bits, shape (rows, columns, readings).

        NaN where nothing was read.
        """
        ratio = ratio_from_codes(self.codes, self.adc_bits)
        if not self.is_whole:
            ratio[~self.read] = np.nan
        return ratio

    @property
    def read(self) -> NDArray[np.bool_]:
        """Which cells were read, shape (rows, columns)."""
        read = np.zeros(self.codes.shape[:2], dtype=np.bool_)
        read[self._lines()] = True
        return read

    @property
    def is_whole(self) -> bool:
        """Whether all cells were read."""
        if not self.row_mask and not self.column_mask:  # of most scans, and asked often
            return True
        return self.masks == (protocol.all_lines(self.rows), protocol.all_lines(self.columns))

    @property
    def is_complete(self) -> bool:
        """Whether all cells were read, in mode near or far: what is learned of a skin needs it."""
        return self.is_whole and len(self.reading_names) == _COMPLETE_READINGS

    @property
    def codes_read(self) -> NDArray[np.uint16]:
        """Codes of the rows and columns that were read, shape (their rows, columns, readings)."""
        return self.codes if self.is_whole else self.codes[self._lines()]

    @property
    def masks(self) -> tuple[int, int]:
        """Which rows, and which columns, were read; bit 0 is the first."""
        all_lines = protocol.all_lines
        return self.row_mask or all_lines(self.rows), self.column_mask or all_lines(self.columns)

    def _lines(self) -> tuple[NDArray[Any], ...]:
        """Indices of the rows and columns that were read."""
        return np.ix_(*map(protocol.lines_of, self.masks, self.codes.shape))

    @property
    def reading_names(self) -> tuple[str, ...]:
        """What the readings of each cell are, of the names a to h: see the enum `reading`."""
        return protocol.MODES[self.mode]

    @property
    def kind(self) -> tuple[tuple[int, ...], str]:
        """Shape of the codes, and mode: scans that differ in it cannot be averaged."""
        return self.codes.shape, self.mode

    @property
    def rows(self) -> int:
        """Rows of the skin."""
        return int(self.codes.shape[0])

    @property
    def columns(self) -> int:
        """Columns of the skin."""
        return int(self.codes.shape[1])


Message = Hello | ForeignHello | Ack | SelfTestReport | Scan


@dataclass
class BoardStats:
    """Counts since the connection was made. All that went missing is counted here.

    line: bytes, frames and damaged frames.
    scans: scans that arrived whole.
    missed: scans that the board made and that never came.
    dropped_by_board: those of `missed` that the board dropped because the line was full. The others
        were damaged on the line.
    board_rx_errors: damaged commands, as the board reports.
    unknown: valid frames whose type or size this host does not know.
    restarts: times that the board was reset while it scanned.
    overflowed: scans lost to iterators slower than the board.
    """

    line: DecoderStats = field(default_factory=DecoderStats)
    scans: int = 0
    missed: int = 0
    dropped_by_board: int = 0
    board_rx_errors: int = 0
    unknown: int = 0
    restarts: int = 0
    overflowed: int = 0


def _codes(
    values: dict[str, Any], packed: bytes, per_pass: Mapping[str, int]
) -> NDArray[np.uint16]:
    """Codes (rows, columns, readings) of a scan whose header has these values.

    :raises ValueError: the header says what cannot be, or `packed` has the wrong length for it.
    """
    mode, rows, columns = values["mode"], values["rows"], values["columns"]
    limits = protocol.CONSTANTS
    if mode not in per_pass:
        raise ValueError(f"no mode {mode}")
    bits, readings = check_adc_bits(values["adc_bits"]), len(protocol.MODES[mode])
    masks = values["row_mask"], values["column_mask"]
    read = list(map(protocol.lines_of, masks, (rows, columns)))
    if not (all(read) and rows <= limits["rows_max"] and columns <= limits["columns_max"]):
        raise ValueError(f"no lines, or more than a board has: {rows}x{columns}")
    of_lines = protocol.unpack_codes(
        packed, (len(read[0]), len(read[1]), readings), per_pass[mode], bits
    )
    if of_lines.shape[:2] == (rows, columns):
        return of_lines
    codes = np.zeros((rows, columns, readings), np.uint16)
    codes[np.ix_(*read)] = of_lines
    return codes


class BoardDecoder:
    """Messages from a board's bytes. `feed` takes any chunk and never raises for what is in it.

    It keeps what connects one scan with the next: counters that wrap, and gaps in the numbers.
    """

    def __init__(self) -> None:
        self._frames = Decoder()
        # What the board was built from. Its hello says that, and comes first.
        self.definition = protocol.NOW
        self.stats = BoardStats(line=self._frames.stats)
        # Number of the last scan. -1: none since the command `start`; None: not known.
        self._number: int | None = None
        self._time_us = 0  # `Scan.time_us` of the last scan
        self._host_time_s: float | None = None  # and its `Scan.host_time_s`
        self._dropped = 0  # how many the board had dropped then

    def feed(self, chunk: bytes, host_time_s: float) -> list[Message]:
        """The messages that `chunk`, read at `host_time_s`, completes."""
        frames = self._frames.feed(chunk)
        decoded = (self._message(frame, host_time_s) for frame in frames)
        messages = [message for message in decoded if message is not None]
        self.stats.unknown += len(frames) - len(messages)
        return messages

    def _message(self, raw: RawFrame, host_time_s: float) -> Message | None:
        """The message of a frame; None if this host does not know it."""
        if raw.type == protocol.FRAMES["hello"].id:
            return self._hello(raw.payload)
        frame = self.definition.frames_by_id.get(raw.type)
        if frame is None or frame.sender != "board":
            return None
        try:
            values = layouts.today(frame.name, frame.unpack(raw.payload))
            if frame.name == "scan":
                return self._scan(values, raw.payload[frame.struct.size :], host_time_s)
        except ValueError:
            return None
        return Ack(**values) if frame.name == "ack" else SelfTestReport(**values)

    def _hello(self, payload: bytes) -> Message | None:
        # The first field stays what it is in every definition, so that this host can say which one
        # a board has whose other fields it cannot read.
        size = protocol.FRAMES["hello"].fields[0].size
        if len(payload) < size:
            return None
        layout_crc = int.from_bytes(payload[:size], "little")
        definition = protocol.definition(layout_crc)
        if definition is None or len(payload) != definition.frames["hello"].struct.size:
            return ForeignHello(layout_crc)
        self.definition = definition
        hello = Hello(**layouts.today("hello", definition.frames["hello"].unpack(payload)))
        if not hello.scanning:
            self._number = -1  # the next scan is the first since `start`, with the number 0
        return hello

    def _scan(self, values: dict[str, Any], packed: bytes, host_time_s: float) -> Scan:
        codes = _codes(values, packed, self.definition.per_pass)
        number, dropped = values["scan"], values["dropped"]
        step = 1 if self._number is None else (number - self._number) % _NUMBER_SPAN
        # A step above half of the span is one back: there was a `start` that nobody saw.
        if self._number is None or self._number < 0 or not 0 < step < _NUMBER_SPAN // 2:
            # The first scan since `start`. All before it are missed, unless the host came late.
            missed = 0 if self._number is None else number
            self._dropped = dropped if self._number is None else 0
            self._time_us = self._time_of_first(values["time_us"], host_time_s)
        else:
            missed = step - 1
            self._time_us += (values["time_us"] - self._time_us) % _TIME_SPAN_US
        stats = self.stats
        stats.scans += 1
        stats.missed += missed
        stats.dropped_by_board += (dropped - self._dropped) % _DROPPED_SPAN
        stats.board_rx_errors = values["rx_errors"]
        self._number, self._dropped = number, dropped
        self._host_time_s = host_time_s
        same = ("mode", "adc_bits", "row_mask", "column_mask", "slot_cycles")
        of_scan = {name: values[name] for name in same}
        return Scan(codes, number, self._time_us, host_time_s, missed, **of_scan)

    def _time_of_first(self, counter_us: int, host_time_s: float) -> int:
        """Board time of the first scan since the command `start` [us].

        A board that was only stopped has the same clock as before, which may have wrapped several
        times meanwhile: of the times with this counter, the nearest to the one expected is taken.
        A board that was reset began at 0, so the counter is far from what is expected: it is the
        time.
        """
        if self._host_time_s is None:
            return counter_us
        elapsed_us = (host_time_s - self._host_time_s) * 1e6
        expected_us = self._time_us + elapsed_us
        wraps = round((expected_us - counter_us) / _TIME_SPAN_US)
        time_us = counter_us + _TIME_SPAN_US * wraps
        is_near = abs(time_us - expected_us) < 1e6 * RESET_DELAY_S + MAX_RATE_ERROR * elapsed_us
        return time_us if time_us >= 0 and is_near else counter_us
