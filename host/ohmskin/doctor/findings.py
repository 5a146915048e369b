# SPDX-License-Identifier: Apache-2.0
"""What the doctor finds, as data: kinds, lines and cells, and figures whose names carry units.

Words are made of it elsewhere: `ohmskin.cli.doctor_words`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from enum import Enum, StrEnum
from typing import Any, Final, Self

import numpy as np

from ohmskin.arrays import Bool
from ohmskin.estimate.knowledge import WireOhm

Cell = tuple[int, int]  # row, column


class Severity(StrEnum):
    """How bad a finding is, the worst first."""

    FAULT = "fault"  # readings are wrong
    WARNING = "warning"  # readings are worse than they could be
    NOTE = "note"  # good to know; nothing is wrong with the skin


_FAULT, _WARNING, _NOTE = Severity
_CELLS: Final = "worst cell_ohm plate_ohm off_percent most_percent"  # of resistors of a plate
_CHANGE: Final = "change_lsb most_lsb mean settle_us longer_us needed_us pressed"


class Kind(Enum):
    """What can be found.

    id: its name for users. Two kinds may have one, if users need not tell them apart.
    severity: how bad it is.
    names: the values that describe it.
    explains: the kinds that it explains, if it concerns the same lines or cells: see `merged`.

    The order is the order in which findings are told: what hides or explains others comes first.
    """

    PORT_UNUSABLE = "port_unusable", _FAULT, "port problem remedy"
    NOTHING_ANSWERS = "nothing_answers", _FAULT, "port problem remedy"
    PROTOCOL_MISMATCH = "protocol_mismatch", _FAULT, "port problem remedy"
    LOST = "lost", _FAULT, "problem late"
    SELF_TEST = "self_test", _FAULT, "name code_min code_max"
    NOTHING_CONDUCTS = "nothing_conducts", _FAULT, "one_cell"
    OPEN_ROW = "open_row", _FAULT, "line_count cells_per_line"
    OPEN_COLUMN = "open_column", _FAULT, "line_count cells_per_line"
    SHORT_ROWS = "short_rows", _FAULT, ""
    SHORT_COLUMNS = "short_columns", _FAULT, ""
    SHORT_FAR = "short_far", _FAULT, "", "SHORT_ROWS SHORT_COLUMNS"
    SWAPPED_FAR = "swapped_far", _FAULT, ""
    OPEN_FAR = "open_far", _FAULT, ""
    BROKEN_YARN = "broken_yarn", _FAULT, "between", "DEAD_CELL"
    DEAD_CELL = "dead_cell", _FAULT, "percent_of_usual"
    SATURATED_CELL = "saturated_cell", _FAULT, "cell_ohm rest_megohm"
    SWAPPED_LINES = "swapped_lines", _FAULT, ""
    OPEN_JOINT = "open_joint", _FAULT, _CELLS
    BRIDGE = "bridge", _FAULT, _CELLS
    WRONG_RESISTOR = "wrong_resistor", _FAULT, _CELLS
    REFERENCE_VALUE = "reference_value", _FAULT, "ohm nominal_ohm off_percent most_percent"
    REFERENCE_RATIO = "reference_ratio", _FAULT, "ratio off_percent ref_top_ohm ref_bottom_ohm"
    SETTLING = "settling", _FAULT, _CHANGE
    SETTLING_PRESSED = "settling", _FAULT, _CHANGE, "SETTLING"
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
    DAMP = "damp", _WARNING, "row_megohm column_megohm"
    TOUCHED = "touched", _NOTE, "moves"
    VERSION = "version", _NOTE, "firmware host"
    USB_LATENCY = "usb_latency", _NOTE, "timer_ms file"

    def __init__(self, id: str, severity: Severity, names: str, explains: str = "") -> None:
        self.id = id
        self.severity = severity
        self.names = frozenset(names.split())
        self.explains = frozenset(explains.split())


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

    @classmethod
    def of_lines(cls, axis: int, numbers: Iterable[int]) -> Self:
        """Rows (axis 0) or columns (axis 1) of these numbers."""
        lines = tuple(map(int, numbers))
        return cls(columns=lines) if axis else cls(rows=lines)

    def without(self, other: "Place") -> "Place | None":
        """The lines and cells that `other` has not; None if nothing is left.

        The whole skin is not taken apart: only the whole skin leaves nothing of it.
        """
        if WHOLE_SKIN in (self, other):
            return None if other == WHOLE_SKIN else self
        pairs = zip(astuple(self), astuple(other), strict=True)
        left = Place(*(tuple(one for one in mine if one not in its) for mine, its in pairs))
        return None if left == WHOLE_SKIN else left


WHOLE_SKIN: Final = Place()


def lines_of(where: Bool) -> tuple[int, ...]:
    """Number of each line that is true in `where` (R,) or (C,)."""
    return tuple(map(int, np.flatnonzero(where)))


@dataclass(frozen=True)
class Finding:
    """One thing found.

    kind: what it is.
    place: the lines and cells that it names.
    values: what describes it, by the names that `kind` lists, and no others.
    explained: lines and cells at which it explains findings of other kinds; None: at its place.
    """

    kind: Kind
    place: Place
    values: Mapping[str, Any]
    explained: Place | None = None

    def __post_init__(self) -> None:
        if self.values.keys() != self.kind.names:
            raise ValueError(f"{self.kind.id} has {set(self.kind.names)}, not {set(self.values)}")


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """The findings that users are told. Examiners do not know what others have found, so here

    1. each finding loses the lines and cells at which another one explains it, by `Kind.explains`.
       One that has none left is dropped. Cells beyond a break in a yarn are dead, but it is the
       yarn that must be mended.
    2. findings are put in the order of their kinds. Those of one kind stay as they were found.
    """
    kinds, kept = list(Kind), []
    for finding in findings:
        place: Place | None = finding.place
        for other in findings:
            if place is not None and finding.kind.name in other.kind.explains:
                place = place.without(other.explained or other.place)
        if place is not None:
            kept.append(replace(finding, place=place))
    return sorted(kept, key=lambda finding: kinds.index(finding.kind))


@dataclass(frozen=True)
class WireShare:
    """Wire resistance over the nominal one, as pressed corners show it.

    place: the row and the column that were measured, or the whole skin.
    share: the resistance over the nominal one.
    std: standard deviation of this share.
    known: the deviation is small enough for the share to mean something.
    differs: the wires are clearly not nominal. Either all wires together differ or single lines
        do, because one change is one finding.
    """

    place: Place
    share: float
    std: float
    known: bool
    differs: bool


@dataclass(frozen=True)
class LineWire:
    """The wire of a row or a column, from its near end to its far end.

    place: the line.
    ohm: its resistance from end to end, without its lead [ohm].
    std_ohm: standard deviation of that [ohm].
    segment_ohm: each of its segments, the one at the near end first [ohm].
    segment_std_ohm: their standard deviations [ohm].
    """

    place: Place
    ohm: float
    std_ohm: float
    segment_ohm: list[float]
    segment_std_ohm: list[float]


@dataclass
class Diagnosis:
    """What examiners found. Each adds its own; `examine` merges the findings at the end.

    findings: all that was found.
    measured: figures by name, None for one that could not be had.
    nominal_ohm: nominal wires of a segment, top and bottom; None if touches or faults hide wires.
    is_told: whether somebody has told what is nominal.
    pressed: the share of all wires that presses show, then that of each row and column; empty if
        nobody pressed, or if touches or faults hide the wires; None if nobody was asked to.
    lines: wires of the lines, where far ends show them.
    wires_by_far_ends: a segment of each layer and the leads, where far ends show both layers.
    """

    findings: list[Finding] = field(default_factory=list)
    measured: dict[str, Any] = field(default_factory=dict)
    nominal_ohm: tuple[float, float] | None = None
    is_told: bool = True
    pressed: list[WireShare] | None = None
    lines: list[LineWire] = field(default_factory=list)
    wires_by_far_ends: WireOhm | None = None

    def add(self, kind: Kind, place: Place = WHOLE_SKIN, /, **values: Any) -> None:
        """Add a finding with these values."""
        self.findings.append(Finding(kind, place, values))

    @property
    def worse(self) -> list[Finding]:
        """The findings that are more than notes: with any, the skin is not sound."""
        return [one for one in self.findings if one.kind.severity is not Severity.NOTE]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong, and all was done that was asked for."""
        return not self.worse and (self.pressed is None or self._shows_wires)

    @property
    def wires_hidden(self) -> bool:
        """Whether no press has told the wires, though no touch or fault hides them."""
        return self.nominal_ohm is not None and not self._shows_wires

    @property
    def _shows_wires(self) -> bool:
        return self.pressed is not None and any(share.known for share in self.pressed[:1])
