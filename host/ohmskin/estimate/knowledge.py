# SPDX-License-Identifier: Apache-2.0
"""What is known of a skin before a frame is read: its size, its references, its rest, its wires.

Estimators, and the modules that prepare readings for them, are told a `SkinKnowledge`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import (
    DEFAULT_REF_OHM,
    MAX_OHM,
    NEAR,
    check_references,
    current_std,
    is_near,
)
from ohmskin.estimate.prior import (
    LAYER_STD,
    LEAD_STD,
    SEGMENT_STD,
    UNKNOWN_LEAD_OHM,
    UNKNOWN_WIRE_OHM,
    USUAL_LEAD_STD_OHM,
)
from ohmskin.link.codes import check_adc_bits, ratio_std
from ohmskin.link.messages import Hello
from ohmskin.link.protocol import MODES

# An open cell counts as so much [S]. Chosen: no converter sees a gigohm, and its log is finite.
MIN_CELL_SIEMENS: Final = 1e-9
# Standard deviation of the log of a board's references, for an error that both have in common.
# Chosen: usual resistors are within 1 % (E96), and the pins that drive them add less than that:
# some 30 ohm to 30 kOhm.
REF_LOG_STD: Final = 0.01
# Deviation that all segments share, of a skin that has not been bent since its wires were told:
# temperature, wear. And the odds, to 1, that it has not. Chosen: behind wires of some hundred ohms,
# forces are 15 % better where it has not been, 15 % worse where wires resist 5 to 10 % less, and as
# good where they resist 30 % more or less.
STILL_STD: Final = 0.02
STILL_ODDS: Final = 0.3
# Wires of less count as so much [ohm]. Chosen: its log is finite, and no reading shows it.
LEAST_WIRE_OHM: Final = 1e-3
# A shorted cell counts as so much [S]. Chosen: beside references of 30 kOhm, an ohm is nothing.
MAX_CELL_SIEMENS: Final = 1.0


class WireOhm(NamedTuple):
    """What is told of the wires of a skin. None: not known.

    top: nominal resistance of one segment of the top layer [ohm].
    bottom: the same of the bottom layer [ohm].
    lead: what lies between a multiplexer's common pin and the first crossing of a line, nominal
        for all lines alike [ohm]; 0: nothing.
    top_log_std, bottom_log_std: standard deviations of the logs of these, where they were measured.
    lead_std_ohm: the same of the lead [ohm]. A lead may be next to nothing, which has no log.
    curve_top, curve_bottom, curve_lead: the wires that the levels of the curves were computed with
        [ohm], if others have been learned since; None: top, bottom and lead.
    """

    top: float | None = None
    bottom: float | None = None
    lead: float | None = None
    top_log_std: float | None = None
    bottom_log_std: float | None = None
    lead_std_ohm: float | None = None
    curve_top: float | None = None
    curve_bottom: float | None = None
    curve_lead: float | None = None

    def check(self) -> Self:
        """Return this object. Raises ValueError, naming the field, if one is not 0..`MAX_OHM`."""
        for name, number in zip(WIRE_FIELDS, self, strict=True):
            if number is not None and not 0 <= number <= MAX_OHM:
                raise ValueError(f"{name} is {number:g}, it must be from 0 to {MAX_OHM:g}")
        if any(number is not None for number in self[6:]) and None in (*self[:2], *self[6:]):
            raise ValueError(f"{', '.join(WIRE_FIELDS[6:])} need each other, and both layers")
        return self

    def lead_or_usual(self, std_ohm: float) -> tuple[float, float]:
        """The lead and its deviation [ohm]; the usual lead and `std_ohm` where nobody has told it.

        A lead that was told without its deviation is known to the share `LEAD_STD`.
        """
        if self.lead is None:
            return UNKNOWN_LEAD_OHM, std_ohm
        return self.lead, self.lead_std_ohm or LEAD_STD * self.lead

    def or_surer(self, found: "WireOhm") -> "WireOhm":
        """These wires, but with the layers or the lead of `found` where it knows them more surely.

        A method expects that layers have changed by `LAYER_STD` since they were told. So what it
        has found counts only where its deviations are below half of those that were told, or of
        `LAYER_STD`. Where nobody has told layers, it counts from `LAYER_STD` on (`Estimate.wires`).
        """

        def surer(found_std: float | None, told_std: float) -> bool:
            return found_std is not None and found_std < told_std

        limit, better = LAYER_STD if self.both is None else 0.5 * LAYER_STD, self
        told_stds = (limit if std is None else 0.5 * std for std in self[3:5])
        if all(map(surer, found[3:5], told_stds)):
            better = found._replace(lead=self.lead, lead_std_ohm=self.lead_std_ohm)
        if surer(found.lead_std_ohm, 0.5 * self.lead_or_usual(USUAL_LEAD_STD_OHM)[1]):
            better = better._replace(lead=found.lead, lead_std_ohm=found.lead_std_ohm)
        return better.for_curves_of(self)

    @property
    def _variances(self) -> tuple[float, float, float]:
        """Variances of a top and a bottom segment together [ohm^2]: told, still and bent.

        told: of what they were told wrongly by. A skin is stretched as a whole, and presses that
        take too much for the lead take too little for both layers: so deviations add up over the
        layers. still, bent: of what they differ by now, if the skin has not been bent since, and if
        it has.
        """
        pairs = zip(self[:2], self[3:5], strict=True)
        parts = [(max(ohm or 0.0, LEAST_WIRE_OHM), std or 0.0) for ohm, std in pairs]
        told, path_ohm = sum(ohm * std for ohm, std in parts) ** 2, sum(ohm for ohm, _ in parts)
        return told, told + (STILL_STD * path_ohm) ** 2, told + (LAYER_STD * path_ohm) ** 2

    @property
    def told_share(self) -> float:
        """How much of what wires may differ from these by was so when they were told.

        It is one share for layers and lead, because frames show whole paths better than which part
        of a path is long. It is 0 if no layer has a deviation: no press measured them.
        """
        told, still, bent = self._variances
        return told * (1 + STILL_ODDS) / (STILL_ODDS * still + bent)

    def told_share_of(self, change_ohm: float) -> float:
        """The same, if both layers together have changed by so much [ohm].

        A small change of their sum was more likely told wrongly, and a large one is stretch: each
        of `still` and `bent` is as likely as a normal of its variance says. Between both, the share
        falls quickly.
        """
        told, still, bent = self._variances
        odds = STILL_ODDS * math.sqrt(bent / still)
        odds *= math.exp(0.5 * change_ohm**2 * (1 / bent - 1 / still))
        return told * (odds / still + 1 / bent) / (odds + 1)

    def of_curves(self, now: tuple[float, float, float]) -> tuple[float, float, float]:
        """The wires that levels are computed with, if top, bottom and lead are these now [ohm].

        A press alone shows a cell and the wires up to it as one. So what wires were told wrongly by
        is in the curves of cells. What the skin was stretched by since is not. A lead does not
        stretch, but frames take for lead some of what layers have changed by, or single segments
        differ by: no more than that, and in the same direction. Against that, a measured lead was
        told wrongly by its own deviation.
        """
        pairs = []
        for told, curve, ohm in zip(self[:2], self[6:8], now, strict=False):
            told_ohm = max(UNKNOWN_WIRE_OHM if told is None else told, LEAST_WIRE_OHM)
            curve_ohm = told_ohm if curve is None else max(curve, LEAST_WIRE_OHM)
            pairs.append((told_ohm, curve_ohm, max(ohm, LEAST_WIRE_OHM)))
        change_ohm = sum(ohm - told_ohm for told_ohm, _, ohm in pairs)
        left = 1.0 - self.told_share_of(change_ohm)
        top, bottom = (curve * (ohm / told_ohm) ** left for told_ohm, curve, ohm in pairs)
        told_ohm, _ = self.lead_or_usual(0.0)
        curve_ohm = told_ohm if self.curve_lead is None else self.curve_lead
        lead_left, lead_change_ohm = 1.0 - self.told_share, now[2] - told_ohm
        if self.both and self.lead_std_ohm:
            own_ohm = SEGMENT_STD * sum(self.both)
            of_layers = change_ohm**2 + own_ohm**2
            lead_left = left * of_layers / (of_layers + self.lead_std_ohm**2)
            lead_change_ohm = max(lead_change_ohm, min(change_ohm, 0.0) - own_ohm)
            lead_change_ohm = min(lead_change_ohm, max(change_ohm, 0.0) + own_ohm)
        return top, bottom, max(curve_ohm + lead_left * lead_change_ohm, 0.0)

    def for_curves_of(self, before: "WireOhm") -> "WireOhm":
        """These wires, which were learned later, for curves of presses that were told `before`."""
        if self is before or self.both is None or before.both is None:
            return self
        top, bottom, lead = before.of_curves((*self.both, self.lead_or_usual(0.0)[0]))
        return self._replace(curve_top=top, curve_bottom=bottom, curve_lead=lead)

    @property
    def both(self) -> tuple[float, float] | None:
        """Top and bottom; None unless both are known."""
        return None if self.top is None or self.bottom is None else (self.top, self.bottom)


NO_WIRES: Final = WireOhm()
# What the fields of `WireOhm` are called in files and errors, in their order.
WIRE_FIELDS: Final = (
    "nominal_top_wire_ohm",
    "nominal_bottom_wire_ohm",
    "nominal_lead_ohm",
    "top_wire_log_std",
    "bottom_wire_log_std",
    "lead_std_ohm",
    "curve_top_wire_ohm",
    "curve_bottom_wire_ohm",
    "curve_lead_ohm",
)


@dataclass(frozen=True, eq=False)
class SkinKnowledge:
    """What is known of a skin before a frame is read. Raises ValueError for a value that cannot be.

    rows, columns: the size of the skin, R and C.
    ref_top_ohm, ref_bottom_ohm: reference resistors at the sense nodes [ohm].
    adc_bits: resolution of the readings; None: they are exact.
    rest_ratio: readings of the untouched skin (R, C, 4) [V/Vdd]; None: not known.
    nominal_wire_ohm: what is known of the wires.
    reading_names: the names of the readings of each cell, in their order.
    may_be_bent: whether the skin may have been bent since its wires were measured.
    are_wires_sure: whether wires and leads are just as told. Else weak cells beside hard ones may
        look like longer wires, and `joint` takes care that they do not.
    own_lead_ohm: what the lead of each row, then of each column, has above the nominal one
        (R+C,) [ohm]; None: nothing that is known. At near ends, it is taken off all ports.
    ref_log_std: standard deviation of the log of the references, for an error that both have in
        common; 0: they are exact. All resistances then have this error, and no reading shows it,
        because readings are ratios.
    """

    rows: int
    columns: int
    ref_top_ohm: float = DEFAULT_REF_OHM
    ref_bottom_ohm: float = DEFAULT_REF_OHM
    adc_bits: int | None = None
    rest_ratio: Float | None = None
    nominal_wire_ohm: WireOhm = NO_WIRES
    reading_names: tuple[str, ...] = NEAR
    may_be_bent: bool = True
    are_wires_sure: bool = False
    ref_log_std: float = 0.0
    own_lead_ohm: Float | None = None

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"a skin has at least 1x1 cells, not {self.rows}x{self.columns}")
        check_references(self.ref_top_ohm, self.ref_bottom_ohm)
        if self.adc_bits is not None:
            check_adc_bits(self.adc_bits)
        if self.rest_ratio is not None:
            cells = self.rows, self.columns
            rest = check_ratio(self.rest_ratio, *cells, "rest_ratio", self.reading_names).copy()
            if np.any(np.isnan(rest).all(axis=-1)):
                raise ValueError("rest_ratio has cells without any reading")
            rest.setflags(write=False)
            object.__setattr__(self, "rest_ratio", rest)
        if not hasattr(self.nominal_wire_ohm, "check"):
            given = self.nominal_wire_ohm
            raise TypeError(f"wires are told as WireOhm(100, 200), not as {given!r}")
        self.nominal_wire_ohm.check()
        if not 0 <= self.ref_log_std <= 1:
            raise ValueError(f"ref_log_std is {self.ref_log_std:g}, it must be from 0 to 1")
        if self.own_lead_ohm is not None:
            check_own_leads(self.own_lead_ohm, self.rows, self.columns)

    @classmethod
    def of(
        cls,
        board: Hello,
        rest_ratio: Float | None = None,
        nominal_wire_ohm: WireOhm = NO_WIRES,
        ref_log_std: float = REF_LOG_STD,
        own_lead_ohm: Float | None = None,
    ) -> Self:
        """What is known of the skin at this board."""
        return cls(
            board.rows,
            board.columns,
            board.ref_top_ohm,
            board.ref_bottom_ohm,
            board.adc_bits,
            rest_ratio,
            nominal_wire_ohm,
            MODES[board.mode],
            ref_log_std=ref_log_std,
            own_lead_ohm=own_lead_ohm,
        )

    @property
    def own_lead_of_ports(self) -> Float | None:
        """What the leads of each port's two lines have above nominal ones, (R, C) [ohm], or None.

        Where far ends are read, each frame measures the leads, so nothing is taken off.
        """
        if self.own_lead_ohm is None or not is_near(self.reading_names):
            return None
        return np.add.outer(self.own_lead_ohm[: self.rows], self.own_lead_ohm[self.rows :])

    @property
    def checked_names(self) -> tuple[str, ...]:
        """The names of the readings that `check_ratio` returns: at near ends always a to d."""
        return NEAR if is_near(self.reading_names) else self.reading_names

    @cached_property
    def ratio_std(self) -> float:
        """Standard deviation of one reading, by its rounding alone [V/Vdd]."""
        return ratio_std(self.adc_bits)

    @property
    def current_std(self) -> float:
        """Standard deviation of a port's current per Vdd, by rounding alone [S]."""
        return current_std(self.ratio_std, self.ref_top_ohm, self.ref_bottom_ohm)

    @property
    def ref_ohm(self) -> float:
        """Both reference resistors in series [ohm]: all that limits a shorted port's current."""
        return self.ref_top_ohm + self.ref_bottom_ohm


def check_own_leads(ohm: Float, rows: int, columns: int) -> None:
    """Raise ValueError unless these are finite numbers for all lines, (R+C,), within `MAX_OHM`."""
    if np.shape(ohm) != (rows + columns,) or not np.all(np.abs(ohm) <= MAX_OHM):
        raise ValueError(f"own_lead_ohm must be {rows + columns} numbers within {MAX_OHM:g} ohm")


def check_ratio(
    ratio: ArrayLike, rows: int, columns: int, name: str = "ratio", of: Sequence[str] = NEAR
) -> Float:
    """Readings as float64 (R, C, n). Raises ValueError, naming the first bad cell.

    of: the names of the n readings.

    At near ends, the result has n = 4, and a reading that was not taken is NaN. A frame of mode
    half or quick may also be given as (R, C, 2) or (R, C, 1). At all crossings of the rows with the
    columns that were read, the same readings must have been taken.
    """
    readings = np.asarray(ratio, dtype=np.float64)
    of_near, width = is_near(of), readings.shape[-1] if readings.ndim else 0
    if of_near and len(of) == len(NEAR) and tuple(of) != NEAR:
        raise ValueError(f"{name}: four near ends come as {' '.join(NEAR)}, not {' '.join(of)}")
    if of_near and width not in (len(of), len(NEAR)):
        of = next((names for names in MODES.values() if len(names) == width), of)
    shapes = [(rows, columns, len(of)), *([(rows, columns, len(NEAR))] if of_near else [])]
    if readings.shape not in shapes:
        raise ValueError(f"{name} has shape {readings.shape}, this skin {shapes[0]}")
    if of_near and readings.shape[-1] < len(NEAR):
        some, readings = readings, np.full(shapes[1], np.nan)
        readings[..., [NEAR.index(each) for each in of]] = some
        of = NEAR
    # Written so that NaN fails too.
    good = (readings >= 0) & (readings <= 1)
    if of_near and not good.all():
        good |= np.isnan(readings) & ~_read_of_lines(readings)
    if not good.all():
        row, column, k = (int(index) for index in np.argwhere(~good)[0])
        read = readings[row, column, k]
        text = f"{name} of cell ({row}, {column}), reading {of[k].upper()}, is {read:g}"
        if np.isnan(read) and not of_near:
            raise ValueError(f"{text}: beside far ends, all is read: leave other modes out")
        raise ValueError(f"{text}, not in 0..1")
    return readings


def _read_of_lines(ratio: Float) -> Bool:
    """Which of the readings (R, C, n) must be there: those of lines and names that were read."""
    is_read = ~np.isnan(ratio)
    cells, kinds = np.any(is_read, axis=2), np.any(is_read, axis=(0, 1))
    if not kinds.any():
        return np.ones_like(is_read)
    of_lines = np.any(cells, axis=1)[:, None] & np.any(cells, axis=0)
    return np.asarray(of_lines[..., None] & kinds)
