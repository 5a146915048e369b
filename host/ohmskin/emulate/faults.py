# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with an emulated board's line and skin, to test that a host finds it.

`LineFaults` change the bytes that the board sends. `SkinFaults` act in three places, in this order:

============  ===================================================================================
`damaged`     changes resistances: open lines, bad contacts, dead cells, wrong references
`readings`    changes how ends of lines are connected: shorts, far ends that are open or exchanged
`sampled`     changes each reading at its own instant: hum, and nodes that have not settled
============  ===================================================================================

A field of these classes is an option of ``emulator://`` of the same name. Its annotation says which
values it takes (`_Kind`), and what ``ohmskin emulate --help`` says of it.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Annotated, Any, Final, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import DEFAULT_REF_OHM, EXCHANGED
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, leak_admittance, readings
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES, PER_PASS, from_scan_order, in_scan_order

# An open wire, and a cell without contact, have this resistance [ohm]. It is not infinite, so that
# the network of resistors stays connected and can be solved. Chosen: a million times that of a cell
# at rest, so that no code shows its current.
OPEN_OHM: Final = 1e12
# A short has this conductance [S]. Chosen: 0.1 ohm, much less than a segment of wire.
SHORT_SIEMENS: Final = 10.0
# A stall begins this time after the board's start [s]. Chosen: a host has connected by then.
_STALL_AFTER_S: Final = 2.0

FaultsT = TypeVar("FaultsT")
Pair = tuple[int, int]


@dataclass(frozen=True)
class _Kind:
    """How an option is read, which values can be, and what they are in words."""

    read: Callable[[str], Any]
    can_be: Callable[[Any], bool]
    words: str


def _pair(text: str) -> Pair:
    first, second = text.split(",")
    return int(first), int(second)


Share = Annotated[float, _Kind(float, lambda share: 0 <= share <= 1, "a share, from 0 to 1")]
# No skin and no line has numbers beyond these, with which arithmetic would overflow.
_ABOVE_0: Final = _Kind(float, lambda n: 1e-6 <= n <= 1e9, "from 1e-6 to 1e9")
_OR_0: Final = _Kind(float, lambda n: n == 0 or _ABOVE_0.can_be(n), "0, or from 1e-6 to 1e9")
Amount = Annotated[float, _OR_0]
Positive = Annotated[float, _ABOVE_0]
Line = Annotated[int | None, _Kind(int, lambda line: True, "a number")]
Lines = Annotated[
    Pair | None, _Kind(_pair, lambda pair: pair[0] != pair[1], "two different numbers, as 1,2")
]
Cell = Annotated[Pair | None, _Kind(_pair, lambda cell: True, "two numbers, as 1,2")]


def _options(faults: type) -> dict[str, tuple[_Kind, str]]:
    """Kind of values, and text for the help, of each fault."""
    hints = get_type_hints(faults, include_extras=True)
    return {n: hint.__metadata__ for n, hint in hints.items() if hasattr(hint, "__metadata__")}


def faults_of(faults: type[FaultsT], options: Mapping[str, str], **others: Any) -> FaultsT:
    """The faults that the options of a URL name; options that are no faults are left alone.

    others: fields that are no options.

    :raises ValueError: a value that cannot be.
    """
    for name, (kind, _) in _options(faults).items():
        if name in options:
            with suppress(ValueError):
                others[name] = kind.read(options[name])
            if name not in others or not kind.can_be(others[name]):
                raise ValueError(f"{name} must be {kind.words}, not '{options[name]}'")
    return faults(**others)


@dataclass
class LineFaults:
    """Faults of the line, by the names in `LINE_FAULTS`.

    seed: of all that is random here.
    """

    drop: Annotated[Share, "share of sent chunks that never arrive"] = 0.0
    bitflip: Annotated[Share, "share of bits that arrive inverted"] = 0.0
    garbage: Annotated[Share, "share of sent chunks after which random bytes come"] = 0.0
    reset: Annotated[Amount, "seconds between resets of the board"] = 0.0
    stall: Annotated[Amount, "seconds of silence, once, 2 s after the board's start"] = 0.0
    vanish: Annotated[Amount, "seconds until the board is unplugged"] = 0.0
    silent: Annotated[Amount, "1: the board never says anything"] = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._resets_done = 0

    def apply(self, chunk: bytes, now_s: float) -> bytes:
        """What arrives of a chunk sent at `now_s`."""
        if not chunk:
            return chunk
        if self.silent or (self.stall and 0 <= now_s - _STALL_AFTER_S < self.stall):
            return b""
        if self.drop and self._random.random() < self.drop:
            chunk = b""
        if self.bitflip:
            octets = np.frombuffer(chunk, dtype=np.uint8)
            flips = self._random.random((octets.size, 8)) < self.bitflip
            chunk = (octets ^ np.packbits(flips, axis=1)[:, 0]).tobytes()
        if self.garbage and self._random.random() < self.garbage:
            chunk += self._random.bytes(int(self._random.integers(1, 64)))
        return chunk

    def resets(self, now_s: float) -> bool:
        """Whether a reset has become due since the last call."""
        due, done = int(now_s / self.reset) if self.reset else 0, self._resets_done
        self._resets_done = max(due, done)
        return due > done

    def vanished(self, now_s: float) -> bool:
        """Whether the board has been unplugged by now."""
        return bool(self.vanish) and now_s >= self.vanish


LINE_FAULTS: Final = {name: text for name, (_, text) in _options(LineFaults).items()}


@dataclass(frozen=True)
class SkinFaults:
    """Faults of the skin by the names in `SKIN_FAULTS`."""

    open_row: Annotated[Line, "number of a row that is not connected to the board"] = None
    open_column: Annotated[Line, "number of a column that is not connected to the board"] = None
    short_rows: Annotated[Lines, "two rows, as 2,3, that touch each other"] = None
    short_columns: Annotated[Lines, "two columns, as 2,3, that touch each other"] = None
    open_far_row: Annotated[Line, "number of a row whose far end is not connected"] = None
    open_far_column: Annotated[Line, "the same of a column"] = None
    short_far_rows: Annotated[Lines, "two rows, as 2,3, whose far ends touch each other"] = None
    short_far_columns: Annotated[Lines, "the same of columns"] = None
    swap_far_rows: Annotated[Lines, "two rows, as 2,3, whose far ends are exchanged"] = None
    swap_far_columns: Annotated[Lines, "the same of columns"] = None
    broken_row: Annotated[Cell, "row and column of the cell before which the row is broken"] = None
    broken_column: Annotated[Cell, "row and column of the cell before which the column is"] = None
    crimp_row: Annotated[Line, "number of a row whose lead has crimp_ohm more"] = None
    crimp_column: Annotated[Line, "the same of a column"] = None
    crimp_ohm: Annotated[Positive, "ohms that a bad contact adds, 500 unless told"] = 500.0
    dead: Annotated[Cell, "row and column, as 1,2, of a cell that never conducts"] = None
    saturated: Annotated[Cell, "row and column, as 1,2, of a cell whose layers are shorted"] = None
    ref_top: Annotated[Positive, "true ohms of the rows' reference resistor"] = DEFAULT_REF_OHM
    ref_bottom: Annotated[Positive, "the same of the columns; hello says 30000"] = DEFAULT_REF_OHM
    wires: Annotated[Positive, "factor on all wires"] = 1.0
    damp: Annotated[Amount, "ohms that leak between neighbouring lines at each crossing"] = 0.0
    hum: Annotated[Amount, "hertz of the mains that every reading picks up"] = 0.0
    hum_lsb: Annotated[Amount, "amplitude of the hum in LSB, 3 unless told"] = 3.0
    tau_us: Annotated[Amount, "microseconds of the sense nodes' time constant of settling"] = 0.0

    def check(self, rows: int, columns: int) -> None:
        """Raise ValueError for a line or a cell that a rows x columns skin does not have."""
        for axis, (what, count) in enumerate((("row", rows), ("column", columns))):
            cells = (self.dead, self.saturated, self.broken_row, self.broken_column)
            lines = [cell[axis] for cell in cells if cell is not None]
            for name, value in vars(self).items():
                if what in name and "broken" not in name and value is not None:
                    lines += value if isinstance(value, tuple) else (value,)
            for line in lines:
                if not 0 <= line < count:
                    raise ValueError(f"no {what} {line}: the skin has {what}s 0 to {count - 1}")

    def damaged(self, skin: Skin) -> Skin:
        """`skin` with those faults that change its resistances."""
        cell = skin.cell_siemens.copy()
        if self.dead is not None:
            cell[self.dead] = 0.0
        if self.saturated is not None:
            cell[self.saturated] = SHORT_SIEMENS
        top_ohm, bottom_ohm = self.wires * skin.top_wire_ohm, self.wires * skin.bottom_wire_ohm
        if self.broken_row is not None:
            top_ohm[self.broken_row] = OPEN_OHM
        if self.broken_column is not None:
            bottom_ohm[self.broken_column] = OPEN_OHM
        rows, lead_ohm = len(cell), skin.lead_ohm.copy()
        for what, near_ohm in (("row", lead_ohm[:rows]), ("column", lead_ohm[rows:])):
            if (line := getattr(self, f"crimp_{what}")) is not None:
                near_ohm[line] += self.crimp_ohm
            if (line := getattr(self, f"open_{what}")) is not None:
                near_ohm[line] = OPEN_OHM
        return Skin(cell, top_ohm, bottom_ohm, self.ref_top, self.ref_bottom, lead_ohm)

    def readings(self, damaged: Skin, mode: str = "near") -> Float:
        """Exact readings (R, C, n) of a skin that `damaged` has made, with the faults of its ends.

        The sense node of an open far end is connected to nothing. So it keeps its charge, and with
        it the voltage of the far end to which it was connected in the cell that was scanned before.
        """
        rows, far = len(damaged.cell_siemens), sum(damaged.shape)
        firsts = {"rows": 0, "columns": rows, "far_rows": far, "far_columns": far + rows}
        shorts = [(n, getattr(self, f"short_{what}")) for what, n in firsts.items()]
        joints = [(n + pair[0], n + pair[1]) for n, pair in shorts if pair]
        if mode == "near" and not (joints or self.damp):
            return readings(damaged)  # is quicker; near ends show no fault of far ends
        ends = np.arange(2 * far)
        for n, pair in ((far, self.swap_far_rows), (far + rows, self.swap_far_columns)):
            if pair:
                ends[[n + pair[0], n + pair[1]]] = n + pair[1], n + pair[0]
        a_to_h = joined_readings(damaged, joints, ends, 1 / self.damp if self.damp else 0.0)
        if (row := self.open_far_row) is not None:
            before = a_to_h[row - 1] if row else np.roll(a_to_h[-1], 1, axis=0)
            a_to_h[row, :, 4::3] = before[:, 4::3]  # e and h
        if (column := self.open_far_column) is not None:
            a_to_h[:, column, 5:7] = a_to_h[-1, column - 1, 5:7]  # f and g
        return np.asarray(a_to_h[..., [ENUMS["reading"].values[name] for name in MODES[mode]]])

    def sampled(
        self, ratio: Float, start_s: float, slot_s: float, settle_s: float, mode: str
    ) -> Float:
        """What the converter reads if settled readings would be `ratio` (R, C, n), same shape.

        The scan starts at start_s, and takes one reading in each slot. In slot n, a node goes
        towards x[n], and reaches v[n] = x[n] + (v[n-1] - x[n]) exp(-settle / tau). The scan before
        this one is taken to have been equal. Hum adds hum_lsb sin(2 pi hum t), t the time of the
        reading.
        """
        per_pass = PER_PASS[mode]
        read = in_scan_order(ratio, per_pass)
        if self.tau_us:
            kept = float(np.exp(-settle_s / (1e-6 * self.tau_us)))
            names = MODES[mode]
            which = in_scan_order(np.broadcast_to(np.arange(len(names)), ratio.shape), per_pass)
            for k, name in enumerate(names):
                node = next(node for node in EXCHANGED.items() if name in node)
                # In each slot, the drive sets this node as well, even if another node is read.
                goals = [names.index(node[other in EXCHANGED.values()]) for other in names]
                settled = _settled(in_scan_order(ratio[..., goals]), kept)
                read = np.where(which == k, settled, read)
        if self.hum:
            time_s = start_s + slot_s * np.arange(len(read))
            read = read + self.hum_lsb / 2**ADC_BITS * np.sin(2 * np.pi * self.hum * time_s)
        return from_scan_order(read, ratio.shape, per_pass)


SKIN_FAULTS: Final = {name: text for name, (_, text) in _options(SkinFaults).items()}


def _settled(voltage: Float, kept: float) -> Float:
    """v[n] = x[n] + (v[n-1] - x[n]) kept, after a scan of the same voltages x."""
    settled = goals = voltage.tolist()
    for _ in range(2):  # first the scan before, then this one
        settled = list(accumulate(goals, lambda v, x: x + (v - x) * kept, initial=settled[-1]))[1:]
    return np.array(settled)


def joined_readings(
    skin: Skin, joints: Iterable[Pair], ends: NDArray[np.intp], leak_siemens: float = 0.0
) -> Float:
    """Readings a to h, (R, C, 8), with pairs of ends joined by 0.1 ohm each.

    joints: pairs of ends, by their numbers in `circuit.skin.end_admittance`.
    ends: which end the multiplexers reach where they expect each end, by the same numbers.
    leak_siemens: what leaks between neighbouring lines at each crossing [S]. One half of it joins
        their near ends, and the other half their far ends.

    Near ends are joined in front of their leads. A joint adds its conductance to Y. Cells without
    contact have `OPEN_OHM`.
    """
    skin = replace(skin, cell_siemens=np.maximum(skin.cell_siemens, 1 / OPEN_OHM))
    admittance = end_admittance(skin)
    for joint in joints:
        pair = np.array(joint)
        admittance[pair, pair] += SHORT_SIEMENS
        admittance[pair, pair[::-1]] -= SHORT_SIEMENS
    if leak_siemens:
        half = leak_admittance(skin.shape, (0.5 * leak_siemens, 0.5 * leak_siemens))
        admittance += np.kron(np.eye(2), half)
    return all_readings(skin, admittance[np.ix_(ends, ends)])
