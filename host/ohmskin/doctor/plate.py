# SPDX-License-Identifier: Apache-2.0
"""A board against a reference plate: known resistors soldered at its crossings, in place of a skin.

Symbols

====== ========= ===========================================================================
symbol shape     meaning
====== ========= ===========================================================================
p      (R, C)    conductances of the plate, 0 where it has no resistor [S]
g      (R, C)    what `joint` makes of the mean readings [S]
s      (R, C, 4) what a reading shows of its current: it, or what it lacks to Vdd [LSB]
rho    (R, C)    port resistances of the plate [ohm]
====== ========= ===========================================================================

In this order, and each leaves out what those before it have found:

- Lines are swapped if g is like p in another order than theirs.
- Reference resistors are rho s / (1024 - s_top - s_bottom): the median over the plate's resistors,
  which a wrong one does not move.
- With these references, g differs from p at an open joint, a bridge, a wrong resistor.
- With these as they are, the circuit predicts s. A line is fitted to the readings of each
  configuration over their predictions; its residual is what is left over.

A factor common to all resistances changes no reading and cannot be known.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.skin import (
    CONFIGURATIONS,
    READING_OFFSET,
    READING_SENSES_TOP,
    READING_SIGN,
    Skin,
    port_resistance_ohm,
    readings,
)
from ohmskin.doctor.examine import Evidence
from ohmskin.doctor.findings import Diagnosis, Kind, Place, lines_of
from ohmskin.doctor.signal import NOISY_LSB, RestScans, examine_settling, examine_signal
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import ADC_BITS

FULL: Final = 1 << ADC_BITS  # [LSB] Vdd

OPEN_SHARE: Final = 0.3  # [1] An open joint has less than this share of its resistor's conductance.
BRIDGE_SIEMENS: Final = 1e-6  # [S] Where no resistor is, what conducts more by 4 deviations is one.
BRIDGE_STDS: Final = 4.0
SWAPPED_SHARE: Final = 0.5  # [1] In the right order, lines differ from the plate by less than this.
LOOP_SHARES: Final = (0.1, 0.95)  # [1] Shares of the loop in which a resistor tells a reference.
CLIPPED_LSB: Final = 5.0  # [LSB] An offset, or noise, may clip the readings that show less.
LEAST_SPAN_LSB: Final = 50.0  # [LSB] Readings that span less tell no line.


@dataclass(frozen=True)
class Tolerance:
    """The most that a sound board has; ``ohmskin verify --help`` says where options are from."""

    cell_percent: float = 3.0
    reference_percent: float = 1.5
    settling_lsb: float = 4.0
    slope: float = 0.01  # a gain error of 2 LSB, a bow of 1.5
    offset_lsb: float = 5.0  # 2 LSB, and 2 of gain; half a code; noise
    residual_lsb: float = 2.0  # a bow of 1.5 LSB, rounding
    noise_lsb: float = NOISY_LSB


@dataclass(eq=False)
class PlateExam:
    """What a board reads of a plate p. `examine`, for `doctor.examine.examine`, sets the rest,
    which is not known (NaN, empty) until then.

    cell_ohm (R, C): 1 / g. std_percent (R, C): its stated deviation. error_percent (R, C): of
    cell_ohm, NaN where no resistor is. wrong (R, C): cells that have a finding. predicted_lsb,
    shown_lsb (R, C, 4): s by the circuit, and as read. lines: slope, offset and largest residual
    [LSB] by configuration, where they can be known. settling_lsb (R, C): largest change with a
    longer settle time, NaN if not known. noise_lsb: of a reading, by ADC clock.
    """

    plate: Float
    wire_ohm: WireOhm
    tolerance: Tolerance

    def __post_init__(self) -> None:
        unknown: Float = np.full(self.plate.shape, np.nan)
        self.cell_ohm = self.std_percent = self.error_percent = self.settling_lsb = unknown
        self.wrong = np.isfinite(unknown)
        self.shown_lsb: Float = np.full((*unknown.shape, 4), np.nan)
        self.predicted_lsb = self.shown_lsb
        self.lines: dict[str, dict[str, float]] = {}
        self.noise_lsb: dict[str, float] = {}

    def examine(self, evidence: Evidence, usual: RestScans, diagnosis: Diagnosis) -> None:
        """Add what the scans show of the plate."""
        settled = None if evidence.settled is None else RestScans.of(*evidence.settled)
        self._examine_signal(evidence, usual, diagnosis)
        scans = usual
        if settled is not None:
            self.settling_lsb = np.abs(usual.mean - settled.mean).max(axis=2)
            if examine_settling(usual, settled, diagnosis, self.tolerance.settling_lsb):
                scans = settled
        knowledge = SkinKnowledge.of(scans.board, nominal_wire_ohm=self.wire_ohm)
        shown = READING_SIGN * (scans.mean + 0.5 - FULL * READING_OFFSET)
        self.shown_lsb = self._in_order(shown, knowledge, diagnosis)
        knowledge = self._with_references(knowledge, diagnosis)
        as_is = self._examine_cells(_estimate(self.shown_lsb, knowledge), diagnosis)
        ratio = readings(self._skin(as_is, knowledge))
        self.predicted_lsb = FULL * READING_SIGN * (ratio - READING_OFFSET)
        self._examine_lines(diagnosis)

    def _examine_signal(self, evidence: Evidence, usual: RestScans, diagnosis: Diagnosis) -> None:
        """Adds hum, and noise by ADC clock, of the readings that nothing clips."""
        signal = Diagnosis()
        examine_signal(usual, signal)
        diagnosis.findings += [each for each in signal.findings if each.kind is Kind.HUM]
        diagnosis.measured["hum_lsb"] = signal.measured["hum_lsb"]
        for scans in (usual, *(RestScans.of(*each) for each in evidence.clocks)):
            if scans is not None:
                lit = np.abs(scans.mean - FULL / 2) < FULL / 2 - CLIPPED_LSB
                step = np.diff(scans.codes[:, lit], axis=0)
                noise_lsb = float(np.mean(step**2) / 2) ** 0.5 if step.size else 0.0
                self.noise_lsb.setdefault(scans.board.adc_prescaler, noise_lsb)
        most_lsb = self.tolerance.noise_lsb
        loud = {clock: lsb for clock, lsb in self.noise_lsb.items() if lsb > most_lsb}
        if loud:
            diagnosis.add(Kind.ADC_NOISE, clocks=loud, most_lsb=most_lsb)

    def _in_order(self, shown: Float, known: SkinKnowledge, diagnosis: Diagnosis) -> Float:
        """`shown`, with lines that are swapped put right."""
        # Shares of a loop with the references: an open joint is not infinitely far from a resistor.
        siemens = (_estimate(shown, known).cell_siemens, self.plate)
        found, plate = (each / (each + 1 / known.ref_ohm) for each in siemens)
        for _ in range(2):
            rows, columns = _order(found, plate), _order(found.T, plate.T)
            axis = int(columns[1] < rows[1])
            order, off = (rows, columns)[axis]
            moved = lines_of(order != np.arange(len(order)))
            if not moved or off >= SWAPPED_SHARE * np.abs(found - plate).sum():
                break
            diagnosis.add(Kind.SWAPPED_LINES, Place(columns=moved) if axis else Place(moved))
            shown, found = np.take(shown, order, axis), np.take(found, order, axis)
        return shown

    def _with_references(self, known: SkinKnowledge, diagnosis: Diagnosis) -> SkinKnowledge:
        """What is known, with the references that the plate shows."""
        found = _estimate(self.shown_lsb, known)
        bad = np.logical_or(*self._open_and_bridged(found))
        port_ohm = port_resistance_ohm(
            self._skin(np.where(bad, found.cell_siemens, self.plate), known)
        )
        share = self.shown_lsb / FULL
        top = share[..., READING_SENSES_TOP].mean(axis=2)
        bottom = share[..., ~READING_SENSES_TOP].mean(axis=2)
        of_plate = 1 - top - bottom
        tells = (self.plate > 0) & ~bad & (of_plate > LOOP_SHARES[0]) & (of_plate < LOOP_SHARES[1])
        if not tells.any():
            return known
        ohm = [float(np.median((port_ohm * side / of_plate)[tells])) for side in (top, bottom)]
        nominal_ohm = known.ref_top_ohm, known.ref_bottom_ohm
        off = [100 * (each / told - 1) for each, told in zip(ohm, nominal_ohm, strict=True)]
        diagnosis.measured["reference_ohm"] = [round(each) for each in ohm]
        most = self.tolerance.reference_percent
        if max(map(abs, off)) > most:
            values = {"ohm": ohm, "nominal_ohm": nominal_ohm, "off_percent": off}
            diagnosis.add(Kind.REFERENCE_VALUE, most_percent=most, **values)
        return replace(known, ref_top_ohm=ohm[0], ref_bottom_ohm=ohm[1])

    def _skin(self, siemens: Float, known: SkinKnowledge) -> Skin:
        top, bottom = (np.full(siemens.shape, ohm) for ohm in self.wire_ohm.both or (0.0, 0.0))
        return Skin(siemens, top, bottom, known.ref_top_ohm, known.ref_bottom_ohm)

    def _open_and_bridged(self, found: Estimate) -> tuple[Bool, Bool]:
        """Cells where a resistor does not conduct, and those where none is that do."""
        siemens, most = found.cell_siemens, BRIDGE_SIEMENS + BRIDGE_STDS * found.cell_siemens_std
        return siemens < OPEN_SHARE * self.plate, (self.plate == 0) & (siemens > most)

    def _examine_cells(self, found: Estimate, diagnosis: Diagnosis) -> Float:
        """Adds wrong cells. Returns the plate with these as they were measured, (R, C) [S]."""
        siemens, is_there = found.cell_siemens, self.plate > 0
        self.cell_ohm, self.std_percent = 1 / siemens, 100 * found.cell_siemens_std / siemens
        self.error_percent = np.where(is_there, 100 * (self.plate * self.cell_ohm - 1), np.nan)
        is_open, bridged = self._open_and_bridged(found)
        most = self.tolerance.cell_percent
        off = ~is_open & (np.abs(self.error_percent) > most + self.std_percent)
        self.wrong = is_open | bridged | off
        for kind, cells, worth in (
            (Kind.OPEN_JOINT, is_open, self.cell_ohm),
            (Kind.BRIDGE, bridged, siemens),
            (Kind.WRONG_RESISTOR, off, np.abs(self.error_percent)),
        ):
            if cells.any():
                worst = divmod(int(np.where(cells, worth, -1.0).argmax()), cells.shape[1])
                there = bool(is_there[worst])
                diagnosis.add(
                    kind,
                    Place.of_cells(cells),
                    worst=worst,
                    cell_ohm=float(self.cell_ohm[worst]),
                    plate_ohm=float(1 / self.plate[worst]) if there else None,
                    off_percent=float(self.error_percent[worst]) if there else None,
                    most_percent=most,
                )
        hidden = is_there & ~is_open & (self.std_percent > most)  # by others that lie parallel
        diagnosis.measured["resistors_not_told"] = int(hidden.sum())
        errors = np.abs(self.error_percent[is_there & ~self.wrong])
        if errors.size:
            diagnosis.measured["worst_cell_percent"] = round(float(errors.max()), 2)
        return np.where(self.wrong, siemens, self.plate)

    def _examine_lines(self, diagnosis: Diagnosis) -> None:
        """Adds readings that are no line of what the circuit predicts."""
        most = self.tolerance
        for k, name in enumerate(CONFIGURATIONS):
            lit = self.predicted_lsb[..., k] > CLIPPED_LSB
            x, y = self.predicted_lsb[lit, k], self.shown_lsb[lit, k]
            if x.size and np.ptp(x) > LEAST_SPAN_LSB:
                slope, offset = map(float, np.polyfit(x, y, 1))
                rest = float(np.abs(y - slope * x - offset).max())
                self.lines[name] = {"slope": slope, "offset_lsb": offset, "residual_lsb": rest}
        bad = [
            name
            for name, line in self.lines.items()
            if abs(line["slope"] - 1) > most.slope
            or abs(line["offset_lsb"]) > most.offset_lsb
            or line["residual_lsb"] > most.residual_lsb
        ]
        if bad:
            diagnosis.add(Kind.LINEARITY, readings=bad, lines=self.lines, most=most)


def _estimate(shown_lsb: Float, knowledge: SkinKnowledge) -> Estimate:
    """What `joint` makes of s."""
    ratio = np.clip(READING_OFFSET + READING_SIGN * shown_lsb / FULL, 0.0, 1.0)
    return make_estimator("joint", knowledge).estimate(ratio)


def _order(found: Float, plate: Float) -> tuple[NDArray[np.intp], float]:
    """Which line of `found` (lines, n) each of `plate` is, and how far off these are in all."""
    from scipy.optimize import linear_sum_assignment

    cost = np.abs(plate[:, None] - found[None]).sum(axis=2)
    lines, order = linear_sum_assignment(cost)
    return np.asarray(order), float(cost[lines, order].sum())
