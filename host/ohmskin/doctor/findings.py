# SPDX-License-Identifier: Apache-2.0
"""What the doctor finds, as data: kinds, lines and cells, and figures whose names carry units.

Words are made of it elsewhere: `ohmskin.cli.doctor_words`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any, Final, Self

import numpy as np

from ohmskin.arrays import Bool

Cell = tuple[int, int]  # row, column


class Severity(StrEnum):
    """How bad a finding is, the worst first."""

    FAULT = "fault"  # readings are wrong
    WARNING = "warning"  # readings are worse than they could be
    NOTE = "note"  # good to know; nothing is wrong with the skin


_FAULT, _WARNING, _NOTE = Severity
_CELLS: Final = "worst cell_ohm plate_ohm off_percent most_percent"  # of resistors of a plate


class Kind(Enum):
    """What can be found: its id, its severity, and the names of the values that describe it.

    The order is the order in which findings are told: what hides or explains others comes first.
    """

    PORT_UNUSABLE = "port_unusable", _FAULT, "port problem remedy"
    NOTHING_ANSWERS = "nothing_answers", _FAULT, "port problem remedy"
    PROTOCOL_MISMATCH = "protocol_mismatch", _FAULT, "port problem remedy"
    LOST = "lost", _FAULT, "problem"
    SELF_TEST = "self_test", _FAULT, "name code_min code_max"
    NOTHING_CONDUCTS = "nothing_conducts", _FAULT, "one_cell"
    OPEN_ROW = "open_row", _FAULT, "line_count cells_per_line"
    OPEN_COLUMN = "open_column", _FAULT, "line_count cells_per_line"
    SHORT_ROWS = "short_rows", _FAULT, ""
    SHORT_COLUMNS = "short_columns", _FAULT, ""
    SHORT_FAR = "short_far", _FAULT, ""
    SWAPPED_FAR = "swapped_far", _FAULT, ""
    OPEN_FAR = "open_far", _FAULT, ""
    BROKEN_YARN = "broken_yarn", _FAULT, "between"
    DEAD_CELL = "dead_cell", _FAULT, "percent_of_usual"
    SATURATED_CELL = "saturated_cell", _FAULT, "cell_ohm rest_megohm"
    SWAPPED_LINES = "swapped_lines", _FAULT, ""
    OPEN_JOINT = "open_joint", _FAULT, _CELLS
    BRIDGE = "bridge", _FAULT, _CELLS
    WRONG_RESISTOR = "wrong_resistor", _FAULT, _CELLS
    REFERENCE_VALUE = "reference_value", _FAULT, "ohm nominal_ohm off_percent most_percent"
    REFERENCE_RATIO = "reference_ratio", _FAULT, "ratio off_percent ref_top_ohm ref_bottom_ohm"
    SETTLING = "settling", _FAULT, "change_lsb most_lsb settle_us longer_us needed_us pressed"
    LINEARITY = "linearity", _FAULT, "readings lines most"
    RESET_CAUSE = "reset_cause", _WARNING, "cause"
    RESTARTED = "restarted", _WARNING, "restarts causes"
    LOSS = "loss", _WARNING, "received missed made dropped_by_board rate_hz"
    DAMAGED = "damaged", _WARNING, "damaged crc_errors commands"
    HUM = "hum", _WARNING, "mains_hz amplitude_lsb most_lsb rate_hz seen_hz"
    NOISE = "noise", _WARNING, "noise_lsb sound_lsb"
    ADC_NOISE = "adc_noise", _WARNING, "clocks most_lsb"
    BAD_CRIMP = "bad_crimp", _WARNING, "more_ohm std_ohm between"
    BAD_SEGMENT = "bad_segment", _WARNING, "more_ohm std_ohm between"
    LINE_WIRE = "line_wire", _WARNING, "ohm std_ohm usual_ohm"
    WIRES = "wires", _WARNING, "share nominal_ohm"
    TOUCHED = "touched", _NOTE, "moves"
    VERSION = "version", _NOTE, "firmware host"
    USB_LATENCY = "usb_latency", _NOTE, "timer_ms file"

    def __init__(self, id: str, severity: Severity, names: str) -> None:
        self.id = id
        self.severity = severity
        self.names = frozenset(names.split())


@dataclass(frozen=True)
class Place:
    """Lines and cells of a skin by number; all of them empty: the whole skin."""

    rows: tuple[int, ...] = ()
    columns: tuple[int, ...] = ()
    cells: tuple[Cell, ...] = ()

    @classmethod
    def of_cells(cls, where: Bool) -> Self:
        """Each cell that is true in `where` (R, C)."""
        return cls(cells=tuple((int(row), int(column)) for row, column in np.argwhere(where)))


WHOLE_SKIN: Final = Place()


def lines_of(where: Bool) -> tuple[int, ...]:
    """Number of each line that is true in `where` (R,) or (C,)."""
    return tuple(map(int, np.flatnonzero(where)))


@dataclass(frozen=True)
class Finding:
    """One thing found. values: what describes it, by the names that `kind` lists, and no others."""

    kind: Kind
    place: Place
    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.values.keys() != self.kind.names:
            raise ValueError(f"{self.kind.id} has {set(self.kind.names)}, not {set(self.values)}")


@dataclass(frozen=True)
class WireShare:
    """Wire resistance over the nominal one, and its deviation.

    place: lines, or the whole layers. known: the deviation is small enough to tell the share.
    differs: the wires are clearly not nominal, and no other share tells it already.
    """

    place: Place
    share: float
    std: float
    known: bool
    differs: bool


@dataclass(frozen=True)
class LineWire:
    """A row or a column from its near end to its far end, each of its segments, and deviations."""

    place: Place
    ohm: float
    std_ohm: float
    segment_ohm: list[float]
    segment_std_ohm: list[float]


@dataclass
class Diagnosis:
    """All that was found. Findings stand in the order of their kinds.

    measured: figures by name, None for one that could not be had. nominal_ohm: wires of a segment,
    top and bottom; None if touches or faults hide the wires. pressed: the share of all wires that
    presses show, then of each row and column; None if nobody was asked to press. lines: their
    wires, where far ends show them.
    """

    findings: list[Finding] = field(default_factory=list)
    measured: dict[str, Any] = field(default_factory=dict)
    nominal_ohm: tuple[float, float] | None = None
    pressed: list[WireShare] | None = None
    lines: list[LineWire] = field(default_factory=list)

    def add(self, kind: Kind, place: Place = WHOLE_SKIN, /, **values: Any) -> None:
        """Add a finding with these values."""
        self.findings.append(Finding(kind, place, values))

    @property
    def worse(self) -> list[Finding]:
        """The findings that are more than notes: with any, the skin is not sound."""
        return [each for each in self.findings if each.kind.severity is not Severity.NOTE]

    @property
    def wires_hidden(self) -> bool:
        """Whether no press has told the wires, though no touch or fault hides them."""
        return self.nominal_ohm is not None and not (self.pressed and self.pressed[0].known)
