# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a simulated skin and its wiring, to see that it is found.

Faults of resistances change a `Skin` (`SkinFaults.damaged`). Shorted lines join electrodes of its
network (`joined_readings`). Hum and slow settling change each reading at its own instant
(`SkinFaults.sampled`). Faults of the serial line are in `ohmskin.emulate.line_faults`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Annotated, Final, Self

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import (
    READING_SENSES_TOP,
    Skin,
    electrode_admittance,
    ratio_from_current,
    readings,
)
from ohmskin.emulate.line_faults import texts_of
from ohmskin.link.protocol import ADC_BITS

# Resistance of a wire that is open [ohm], a million times that of a cell at rest.
OPEN_OHM: Final = 1e12
# Conductance of a short, 0.1 ohm [S].
SHORT_SIEMENS: Final = 10.0
# Conductance of an open cell [S] where a network must be connected: 10 TOhm.
_LEAST_SIEMENS: Final = 1e-13

_LINES: Final = ("open_row", "open_column")
_PAIRS: Final = ("short_rows", "short_columns", "dead", "saturated")
Pair = tuple[int, int]
Line = int | None
Lines = Pair | None
Cell = Pair | None
Ohm = float | None


@dataclass(frozen=True)
class SkinFaults:
    """Faults by the names in `SKIN_FAULTS`. None, zero or a factor of 1 stands for no fault.

    Raises ValueError for a value that cannot be.
    """

    open_row: Annotated[Line, "number of a row that is not connected to the board"] = None
    open_column: Annotated[Line, "number of a column that is not connected to the board"] = None
    short_rows: Annotated[Lines, "two rows, as 2,3, that touch each other"] = None
    short_columns: Annotated[Lines, "two columns, as 2,3, that touch each other"] = None
    dead: Annotated[Cell, "row and column, as 1,2, of a cell that never conducts"] = None
    saturated: Annotated[Cell, "row and column, as 1,2, of a cell whose layers are shorted"] = None
    ref_top: Annotated[Ohm, "true ohms of the rows' reference resistor; hello says 30000"] = None
    ref_bottom: Annotated[Ohm, "the same of the columns"] = None
    wires: Annotated[float, "factor on all wires"] = 1.0
    hum: Annotated[float, "hertz of the mains that every reading picks up"] = 0.0
    hum_lsb: Annotated[float, "amplitude of the hum in LSB, 3 unless told"] = 3.0
    tau_us: Annotated[float, "microseconds of the sense nodes' time constant of settling"] = 0.0

    def __post_init__(self) -> None:
        for name in ("ref_top", "ref_bottom", "wires"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} must be above 0, not {value}")
        for name in ("hum", "hum_lsb", "tau_us"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("short_rows", "short_columns"):
            pair = getattr(self, name)
            if pair is not None and pair[0] == pair[1]:
                raise ValueError(f"{name} wants two different lines, not {pair[0]} twice")

    @classmethod
    def from_texts(cls, texts: Mapping[str, str]) -> Self:
        """The faults that the options of a URL name; other options are left alone.

        Raises ValueError for a text that is no such value.
        """
        values: dict[str, int | float | Pair] = {}
        for name in SKIN_FAULTS.keys() & texts.keys():
            try:
                if name in _PAIRS:
                    first, second = texts[name].split(",")
                    values[name] = (int(first), int(second))
                else:
                    values[name] = (int if name in _LINES else float)(texts[name])
            except ValueError:
                wanted = "two numbers, as 1,2" if name in _PAIRS else "a number"
                raise ValueError(f"{name} is {wanted}, not '{texts[name]}'") from None
        return cls(**values)  # type: ignore[arg-type]

    @property
    def of_resistances(self) -> bool:
        """Whether a resistance of the skin or of the board is changed."""
        return replace(self, hum=0.0, hum_lsb=3.0, tau_us=0.0) != SkinFaults()

    @property
    def of_sampling(self) -> bool:
        """Whether readings depend on the instant at which they are taken."""
        return self.tau_us > 0 or (self.hum > 0 and self.hum_lsb > 0)

    def check(self, rows: int, columns: int) -> None:
        """Raise ValueError for a line or a cell that a rows x columns skin does not have."""
        cells = [cell for cell in (self.dead, self.saturated) if cell is not None]
        named_rows = [self.open_row, *(self.short_rows or ()), *(row for row, _ in cells)]
        named_columns = [self.open_column, *(self.short_columns or ()), *(c for _, c in cells)]
        for what, named, count in (("row", named_rows, rows), ("column", named_columns, columns)):
            for line in named:
                if line is not None and not 0 <= line < count:
                    raise ValueError(f"no {what} {line}: the skin has {what}s 0 to {count - 1}")

    def damaged(self, skin: Skin) -> Skin:
        """`skin` with all faults of resistances except shorted lines."""
        if not self.of_resistances:
            return skin
        cell = skin.cell_siemens.copy()
        if self.dead is not None:
            cell[self.dead] = 0.0
        if self.saturated is not None:
            cell[self.saturated] = SHORT_SIEMENS
        hurt = replace(
            skin,
            cell_siemens=cell,
            top_wire_ohm=self.wires * skin.top_wire_ohm,
            bottom_wire_ohm=self.wires * skin.bottom_wire_ohm,
            ref_top_ohm=skin.ref_top_ohm if self.ref_top is None else self.ref_top,
            ref_bottom_ohm=skin.ref_bottom_ohm if self.ref_bottom is None else self.ref_bottom,
        )
        if self.open_row is not None:
            hurt = cut(hurt, "top", self.open_row)
        return hurt if self.open_column is None else cut(hurt, "bottom", self.open_column)

    def readings(self, damaged: Skin) -> Float:
        """Exact readings (R, C, 4) of a skin that `damaged` has made, with its lines shorted."""
        rows = damaged.shape[0]
        joints = [] if self.short_rows is None else [self.short_rows]
        if self.short_columns is not None:
            joints.append((rows + self.short_columns[0], rows + self.short_columns[1]))
        return joined_readings(damaged, joints) if joints else readings(damaged)

    def sampled(self, ratio: Float, start_s: float, slot_s: float, settle_s: float) -> Float:
        """What the converter reads of a scan with settled readings `ratio` (R, C, 4), same shape.

        The scan starts at start_s and takes one reading a slot, in the order of the link. A node
        that would settle to the voltages x[n], slot by slot, has in slot n the voltage
        v[n] = x[n] + (v[n-1] - x[n]) exp(-settle / tau), with an equal scan before this one. Hum
        adds hum_lsb sin(2 pi hum t) at the reading's own time t.
        """
        order = ratio.transpose(1, 0, 2)  # cells are column-major: rows run fastest
        read = order.reshape(-1)
        if self.tau_us:
            kept = float(np.exp(-settle_s / (1e-6 * self.tau_us)))
            # A pair of readings with the same drive sets both nodes, whichever of them is read.
            top, bottom = (
                _settled(order[..., pairs].reshape(-1), kept)
                for pairs in ([0, 0, 3, 3], [1, 1, 2, 2])
            )
            read = np.where(np.resize(READING_SENSES_TOP, read.shape), top, bottom)
        if self.hum:
            time_s = start_s + slot_s * np.arange(len(read))
            read = read + self.hum_lsb / 2**ADC_BITS * np.sin(2 * np.pi * self.hum * time_s)
        return np.asarray(read.reshape(order.shape).transpose(1, 0, 2))


SKIN_FAULTS: Final = texts_of(SkinFaults)


def _settled(voltage: Float, kept: float) -> Float:
    """v[n] = x[n] + (v[n-1] - x[n]) kept, after a scan of the same voltages x."""
    settled = goals = voltage.tolist()
    for _ in range(2):
        settled = list(accumulate(goals, lambda v, x: x + (v - x) * kept, initial=settled[-1]))[1:]
    return np.array(settled)


def cut(skin: Skin, layer: str, line: int, place: int = 0) -> Skin:
    """`skin` with segment `place` of a row ("top") or column ("bottom") open; 0: all of it."""
    wires = {"top": skin.top_wire_ohm.copy(), "bottom": skin.bottom_wire_ohm.copy()}
    wires[layer][(line, place) if layer == "top" else (place, line)] = OPEN_OHM
    return replace(skin, top_wire_ohm=wires["top"], bottom_wire_ohm=wires["bottom"])


def joined_readings(skin: Skin, joints: Iterable[Pair]) -> Float:
    """As `circuit.skin.readings`, with pairs of electrodes (rows first) joined by 0.1 ohm each.

    A joint adds its conductance to the skin's Y. Z is the inverse of Y with any one electrode
    grounded, and rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j]. Open cells are taken for 10 TOhm.
    """
    rows = skin.shape[0]
    conducting = replace(skin, cell_siemens=np.maximum(skin.cell_siemens, _LEAST_SIEMENS))
    admittance = electrode_admittance(conducting)
    for joint in joints:
        ends = np.array(joint)
        admittance[ends, ends] += SHORT_SIEMENS
        admittance[ends, ends[::-1]] -= SHORT_SIEMENS
    ground = np.argmax(np.diagonal(admittance))
    admittance[ground, ground] *= 2
    impedance = np.linalg.inv(admittance)
    diagonal = np.diagonal(impedance)
    port_ohm = diagonal[:rows, None] + diagonal[None, rows:] - 2 * impedance[:rows, rows:]
    current = 1.0 / (np.maximum(port_ohm, 0.0) + skin.ref_top_ohm + skin.ref_bottom_ohm)
    return ratio_from_current(current, skin.ref_top_ohm, skin.ref_bottom_ohm)
