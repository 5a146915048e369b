# SPDX-License-Identifier: Apache-2.0
"""What the doctor finds, as data: kinds, lines and cells, and figures whose names carry units.

Words are made of it elsewhere: `ohmskin.cli.doctor_words`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]


class Severity(StrEnum):
    """How bad a finding is, the worst first."""

    FAULT = "fault"  # readings are wrong
    WARNING = "warning"  # readings are worse than they could be
    NOTE = "note"  # good to know; nothing is wrong with the skin


_FAULT, _WARNING, _NOTE = Severity


class Kind(Enum):
    """What can be found: its id, its severity, and the names of the values that describe it.

    The order is the order in which findings are told: what hides or explains others comes first.
    """

    PORT_UNUSABLE = "port_unusable", _FAULT, "port problem remedy"
    NOTHING_ANSWERS = "nothing_answers", _FAULT, "port problem"
    PROTOCOL_MISMATCH = "protocol_mismatch", _FAULT, "port problem remedy"
    LOST = "lost", _FAULT, "problem"
    SELF_TEST = "self_test", _FAULT, "name code_min code_max"
    NOTHING_CONDUCTS = "nothing_conducts", _FAULT, "cell_count"
    OPEN_ROW = "open_row", _FAULT, "line_count cells_per_line"
    OPEN_COLUMN = "open_column", _FAULT, "line_count cells_per_line"
    SHORT_ROWS = "short_rows", _FAULT, ""
    SHORT_COLUMNS = "short_columns", _FAULT, ""
    DEAD_CELL = "dead_cell", _FAULT, "share_of_usual"
    SATURATED_CELL = "saturated_cell", _FAULT, "cell_ohm rest_ohm"
    REFERENCE_RATIO = "reference_ratio", _FAULT, "ratio ref_top_ohm ref_bottom_ohm"
    SETTLING = "settling", _FAULT, "change_lsb most_lsb settle_us longer_us needed_us"
    RESET_CAUSE = "reset_cause", _WARNING, "cause"
    RESTARTED = "restarted", _WARNING, "restarts causes"
    LOSS = "loss", _WARNING, "received missed made dropped_by_board rate_hz"
    DAMAGED = "damaged", _WARNING, "damaged crc_errors"
    RECEIVE_ERRORS = "receive_errors", _WARNING, "commands"
    RATE = "rate", _WARNING, "rate_hz asked_hz"
    HUM = "hum", _WARNING, "mains_hz amplitude_lsb most_lsb rate_hz seen_hz"
    NOISE = "noise", _WARNING, "noise_lsb sound_lsb adc_lsb"
    WIRES = "wires", _WARNING, "layers share share_std top_ohm bottom_ohm"
    TOUCHED = "touched", _NOTE, "moves"
    VERSION = "version", _NOTE, "firmware host"
    USB_LATENCY = "usb_latency", _NOTE, "timer_ms file"
    SLOW_HOST = "slow_host", _NOTE, "host_rate_hz rate_hz"

    def __init__(self, id: str, severity: Severity, names: str) -> None:
        self.id = id
        self.severity = severity
        self.names = frozenset(names.split())


_ORDER: Final = {kind: number for number, kind in enumerate(Kind)}


@dataclass(frozen=True)
class Finding:
    """One thing found, and where: lines and cells by number. No line and no cell: the whole skin.

    values: what describes it, by the names that `kind` lists; others are a ValueError.
    """

    kind: Kind
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    cells: tuple[Cell, ...]
    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.values.keys() != self.kind.names:
            raise ValueError(f"{self.kind.id} has {set(self.kind.names)}, not {set(self.values)}")


def found(
    kind: Kind,
    *,
    rows: tuple[int, ...] = (),
    columns: tuple[int, ...] = (),
    cells: tuple[Cell, ...] = (),
    **values: Any,
) -> Finding:
    """A finding with these values."""
    return Finding(kind, rows, columns, cells, values)


def lines_of(where: NDArray[np.bool_]) -> tuple[int, ...]:
    """Number of each line that is true in `where` (R,) or (C,)."""
    return tuple(map(int, np.flatnonzero(where)))


def cells_of(where: NDArray[np.bool_]) -> tuple[Cell, ...]:
    """Row and column of each cell that is true in `where` (R, C)."""
    return tuple((int(row), int(column)) for row, column in np.argwhere(where))


@dataclass(frozen=True)
class WireShare:
    """Wire resistance over the nominal one, of some lines or of whole layers, and its deviation.

    layers: "top", "bottom", or both. rows, columns: the lines; none of them for whole layers.
    known: the deviation is small enough to tell the share. differs: the wires are clearly not
    nominal, and no other share tells it already.
    """

    layers: tuple[str, ...]
    share: float
    std: float
    known: bool
    differs: bool
    rows: tuple[int, ...] = ()
    columns: tuple[int, ...] = ()


@dataclass(frozen=True)
class Wires:
    """All that is known of the wires. nominal_ohm: a segment of the top and the bottom layer.

    untouched: shares of both layers, then of each line if an earlier rest was told. pressed: the
    share of both layers together, then of each row and column that were measured; None if nobody
    was asked to press, empty if no three corners were pressed.
    """

    nominal_ohm: tuple[float, float]
    untouched: tuple[WireShare, ...]
    pressed: tuple[WireShare, ...] | None

    @property
    def known(self) -> bool:
        """Whether the wires of a layer are known."""
        layers = self.untouched[:2] if self.pressed is None else self.pressed[:1]
        return any(each.known for each in layers)


@dataclass(frozen=True)
class Diagnosis:
    """Findings in the order of their kinds, figures by name, and the wires where they were judged.

    A figure that could not be had is None.
    """

    findings: tuple[Finding, ...]
    measured: Mapping[str, Any] = field(default_factory=dict)
    wires: Wires | None = None

    def __post_init__(self) -> None:
        in_order = sorted(self.findings, key=lambda finding: _ORDER[finding.kind])
        object.__setattr__(self, "findings", tuple(in_order))

    @property
    def worse(self) -> tuple[Finding, ...]:
        """The findings that are more than notes: with any, the skin is not sound."""
        return tuple(each for each in self.findings if each.kind.severity is not Severity.NOTE)
