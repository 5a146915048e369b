# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a skin and its wiring, for a simulated one: to see that it is found.

Faults of resistances change a `Skin` (`SkinFaults.damaged`); shorted lines join electrodes of its
network (`joined_readings`); hum and slow settling act on each reading at its own instant
(`SkinFaults.sampled`). Faults of the line are in `ohmskin.emulate.line_faults`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Final, Self

import numpy as np
import scipy.signal

from ohmskin.arrays import Float
from ohmskin.circuit.skin import (
    READING_SENSES_TOP,
    Skin,
    electrode_admittance,
    ratio_from_current,
    readings,
)
from ohmskin.link.protocol import ADC_BITS

OPEN_OHM: Final = 1e12
SHORT_SIEMENS: Final = 10.0
_LEAST_SIEMENS: Final = 1e-13  # an open cell in a network that must be connected

SKIN_FAULTS: Final = {
    "open_row": "number of a row that is not connected to the board",
    "open_column": "number of a column that is not connected to the board",
    "short_rows": "two rows, as 2,3, that touch each other",
    "short_columns": "two columns, as 2,3, that touch each other",
    "dead": "row and column, as 1,2, of a cell that never conducts",
    "saturated": "row and column, as 1,2, of a cell whose layers are shorted",
    "ref_top": "true ohms of the reference resistor of the rows; the board goes on saying 30000",
    "ref_bottom": "the same of the columns",
    "wires": "factor on all wires",
    "hum": "hertz of the mains that every reading picks up",
    "hum_lsb": "amplitude of the hum in LSB, 3 unless told",
    "tau_us": "microseconds of the time constant with which the sense nodes settle",
}
Pair = tuple[int, int]


@dataclass(frozen=True)
class SkinFaults:
    """Faults by the names in `SKIN_FAULTS`; None, or zero, or a factor of 1, is none.

    Raises ValueError for a value that cannot be.
    """

    open_row: int | None = None
    open_column: int | None = None
    short_rows: Pair | None = None
    short_columns: Pair | None = None
    dead: Pair | None = None
    saturated: Pair | None = None
    ref_top: float | None = None
    ref_bottom: float | None = None
    wires: float = 1.0
    hum: float = 0.0
    hum_lsb: float = 3.0
    tau_us: float = 0.0

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
        """The faults that the options of a URL name; other options are left alone."""
        values: dict[str, int | float | Pair] = {}
        for field in fields(cls):
            if field.name not in texts:
                continue
            text, kind = texts[field.name], str(field.type)
            try:
                if kind.startswith("Pair"):
                    first, second = text.split(",")
                    values[field.name] = (int(first), int(second))
                else:
                    values[field.name] = int(text) if kind.startswith("int") else float(text)
            except ValueError:
                wanted = "two numbers, as 1,2" if kind.startswith("Pair") else "a number"
                raise ValueError(f"{field.name} is {wanted}, not '{text}'") from None
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
        """Raise ValueError unless a rows x columns skin has the lines and cells that are named."""
        named = {
            "row": [self.open_row, *(self.short_rows or ())],
            "column": [self.open_column, *(self.short_columns or ())],
        }
        for row, column in filter(None, (self.dead, self.saturated)):
            named["row"].append(row)
            named["column"].append(column)
        for what, count in (("row", rows), ("column", columns)):
            for line in named[what]:
                if line is not None and not 0 <= line < count:
                    raise ValueError(f"no {what} {line}: the skin has {what}s 0 to {count - 1}")

    def damaged(self, skin: Skin) -> Skin:
        """`skin` with all faults of resistances but shorted lines."""
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
        """Exact readings (R, C, 4) of a skin that `damaged` has made, lines shorted."""
        rows = damaged.shape[0]
        joints = [] if self.short_rows is None else [self.short_rows]
        if self.short_columns is not None:
            joints.append((rows + self.short_columns[0], rows + self.short_columns[1]))
        return joined_readings(damaged, joints) if joints else readings(damaged)

    def sampled(self, ratio: Float, start_s: float, slot_s: float, settle_s: float) -> Float:
        """What the converter meets: readings (R, C, 4) of a scan, one each slot [s], in its order.

        With x the settled voltages of a node, slot by slot, a node of time constant tau reads
        v[n] = x[n] + (v[n-1] - x[n]) exp(-settle / tau), as after many equal scans, and hum adds
        hum_lsb sin(2 pi hum t) at the reading's own time t.
        """
        order = ratio.transpose(1, 0, 2)  # cells are column-major: rows run fastest
        read = order.reshape(-1)
        if self.tau_us:
            kept = float(np.exp(-settle_s / (1e-6 * self.tau_us)))
            read = read.copy()
            for senses_top in (True, False):
                at = np.tile(senses_top == READING_SENSES_TOP, len(read) // 4)
                read[at] = _settled(_node_voltage(order, senses_top), kept)[at]
        if self.hum:
            time_s = start_s + slot_s * np.arange(len(read))
            read = read + self.hum_lsb / 2**ADC_BITS * np.sin(2 * np.pi * self.hum * time_s)
        return np.asarray(read.reshape(order.shape).transpose(1, 0, 2))


def _node_voltage(order: Float, top: bool) -> Float:
    """Settled voltage of one sense node in every slot: in A and B, then in C and D, it is driven
    alike, whichever of the nodes is read.
    """
    first, second = (0, 3) if top else (1, 2)
    return np.asarray(order[..., [first, first, second, second]].reshape(-1))


def _settled(voltage: Float, kept: float) -> Float:
    """v[n] = x[n] + (v[n-1] - x[n]) kept, after a scan of the same voltages before it."""
    twice = np.concatenate([voltage, voltage])
    start = [kept * voltage[-1]]
    settled, _ = scipy.signal.lfilter([1 - kept], [1.0, -kept], twice, zi=start)
    return np.asarray(settled[len(voltage) :])


def cut(skin: Skin, layer: str, line: int, place: int = 0) -> Skin:
    """`skin` with segment `place` of a row ("top") or column ("bottom") open; 0: all of it."""
    if layer == "top":
        top = skin.top_wire_ohm.copy()
        top[line, place] = OPEN_OHM
        return replace(skin, top_wire_ohm=top)
    bottom = skin.bottom_wire_ohm.copy()
    bottom[place, line] = OPEN_OHM
    return replace(skin, bottom_wire_ohm=bottom)


def joined_readings(skin: Skin, joints: Iterable[Pair]) -> Float:
    """`circuit.readings`, pairs of electrodes (rows first) joined by 0.1 ohm.

    A joint adds its conductance to Y of the skin; rho[i,j] = Z[i,i] + Z[j,j] - 2 Z[i,j] with Z
    the inverse of Y, any one electrode grounded. Open cells are taken for 10 TOhm.
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
