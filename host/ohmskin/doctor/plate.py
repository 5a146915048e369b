# SPDX-License-Identifier: Apache-2.0
"""A board against a reference plate: known resistors soldered at its crossings, in place of a skin.

Symbols

====== ========= ===========================================================================
symbol shape     meaning
====== ========= ===========================================================================
p      (R, C)    plate: conductances of its resistors, 0 where it has none [S]
g      (R, C)    conductances that `joint` estimates from the mean readings [S]
s      (R, C, 4) shown: what each reading shows of its current, the reading or what it lacks to Vdd
                 [LSB]; corrected to what it would be if both lines had no leads
rho    (R, C)    port resistances of the plate [ohm]
====== ========= ===========================================================================

The rules, in this order; each one takes what those before it have found for known:

- Lines are swapped if g is like p with its lines in another order.
- The reference resistors are rho s / (1024 - s_top - s_bottom), the median over the plate's
  resistors. A wrong resistor does not move a median.
- With these references, g differs from p at an open joint, a bridge, a wrong resistor.
- From p, but for these cells, the circuit predicts s. A straight line is fitted to the readings of
  each configuration over their predictions. It shows gain, offset and bow of the converter.

A factor that is common to all resistances, references included, changes no reading. So it cannot be
known.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import (
    CONFIGURATIONS,
    READING_OFFSET,
    READING_SENSES_TOP,
    READING_SIGN,
    reference_ohm,
)
from ohmskin.circuit.skin import Skin, port_resistance_ohm, readings
from ohmskin.doctor.examine import Evidence
from ohmskin.doctor.findings import Diagnosis, Kind, Place, lines_of
from ohmskin.doctor.limits import DEAD_SHARE, NOISY_LSB, PRESSED_LSB
from ohmskin.doctor.signal import Look, examine_settling, find_hum, noise_variance, report_hum
from ohmskin.estimate.base import TOUCH_STDS, Estimate
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.protocol import ADC_BITS

# [LSB] A voltage of Vdd, in codes (adc_bits of frames.toml).
FULL_LSB: Final = 1 << ADC_BITS

# [S] Where the plate has no resistor, a bridge conducts more than this, and than TOUCH_STDS
# deviations. Chosen: 1 MOhm, far above what a plate's resistors are.
BRIDGE_SIEMENS: Final = 1e-6
# [1] Lines are swapped if, in another order, they differ from the plate by less than this share of
# what they differ now. Chosen: a wrong resistor stays wrong in any order.
SWAPPED_SHARE: Final = 0.5
# [1] A resistor tells the references if its share of the loop with them is between these. Chosen:
# else the references, or the resistor, have too few codes.
LOOP_SHARES: Final = (0.1, 0.95)
# [LSB] Readings that span less determine no straight line. Chosen: ten times the offset allowed.
LEAST_SPAN_LSB: Final = 50.0


@dataclass(frozen=True)
class Tolerance:
    """The most that a sound board has. ``ohmskin verify --help`` says why, of the first three.

    cell_percent: error of a resistor [%].
    reference_percent: error of a reference resistor [%].
    settling_lsb: change of a reading with a longer settle time [LSB].
    slope: slope of the straight line, less 1 [1]: a gain error of 2 LSB, and a bow of 1.5.
    offset_lsb: its offset [LSB]: 2 LSB, 2 of the gain, half a code, and noise.
    residual_lsb: distance of a reading from it [LSB]: a bow of 1.5 LSB, and rounding.
    noise_lsb: noise of a reading [LSB].
    """

    cell_percent: float = 3.0
    reference_percent: float = 1.5
    settling_lsb: float = PRESSED_LSB
    slope: float = 0.01
    offset_lsb: float = 5.0
    residual_lsb: float = 2.0
    noise_lsb: float = NOISY_LSB


@dataclass(eq=False)
class PlateExam:
    """What a board reads of a plate. `examine` is for `ohmskin.doctor.examine.examine`.

    plate: p, (R, C) [S].
    wire_ohm: wires of a segment of the plate, top and bottom, and leads; none where not told.
    tolerance: what a sound board may have.

    `examine` sets the others. Until then they are not known: NaN, or empty.

    cell_ohm: 1 / g, (R, C) [ohm].
    std_percent: its stated deviation, (R, C) [%].
    error_percent: its error, (R, C) [%], NaN where no resistor is.
    wrong: which cells have a finding, (R, C). open: which of them are open joints.
    shown_lsb: s as read, but for the leads, (R, C, 4) [LSB].
    predicted_lsb: s by the circuit, (R, C, 4) [LSB].
    lines: slope, offset and largest residual [LSB] of the straight line, by configuration.
    settling_lsb: largest change of a cell's readings with a longer settle time, (R, C) [LSB].
    noise_lsb: noise of a reading, by ADC clock [LSB].
    """

    plate: Float
    wire_ohm: WireOhm
    tolerance: Tolerance

    def __post_init__(self) -> None:
        unknown: Float = np.full(self.plate.shape, np.nan)
        self.cell_ohm = self.std_percent = self.error_percent = self.settling_lsb = unknown
        self.wrong = self.open = np.isfinite(unknown)
        self.shown_lsb: Float = np.full((*unknown.shape, 4), np.nan)
        self.predicted_lsb = self.shown_lsb
        self.lines: dict[str, dict[str, float]] = {}
        self.noise_lsb: dict[str, float] = {}

    def examine(self, evidence: Evidence, usual: Look, diagnosis: Diagnosis) -> None:
        """Add what the scans show of the plate. usual: the first look."""
        settled = evidence.settled
        self._examine_signal(evidence, usual, diagnosis)
        scans = usual
        if settled is not None:
            self.settling_lsb = np.abs(usual.mean - settled.mean).max(axis=2)
            if examine_settling(usual, settled, diagnosis, self.tolerance.settling_lsb):
                scans = settled
        knowledge = SkinKnowledge.of(
            scans.board, nominal_wire_ohm=self.wire_ohm._replace(lead=0.0), ref_log_std=0.0
        )
        shown = READING_SIGN * (scans.mean + 0.5 - FULL_LSB * READING_OFFSET)
        # 1 / I less the leads, with I = s / 1024 R.
        per_ohm = reference_ohm(knowledge.ref_top_ohm, knowledge.ref_bottom_ohm) * FULL_LSB
        shown /= 1 - 2 * (self.wire_ohm.lead or 0.0) * shown / per_ohm
        self.shown_lsb = self._in_order(shown, knowledge, diagnosis)
        knowledge = self._with_references(knowledge, diagnosis)
        as_is = self._examine_cells(_estimate(self.shown_lsb, knowledge), diagnosis)
        ratio = readings(self._skin(as_is, knowledge))
        self.predicted_lsb = FULL_LSB * READING_SIGN * (ratio - READING_OFFSET)
        self._examine_lines(diagnosis)

    def _examine_signal(self, evidence: Evidence, usual: Look, diagnosis: Diagnosis) -> None:
        """Add hum, and noise by ADC clock, of the readings that nothing clips."""
        report_hum(find_hum(usual), usual.board.rate_hz, diagnosis)
        for look in (usual, *evidence.clocks):
            if look is not None:
                # An offset may clip readings that are as near to Vdd or ground.
                lit = np.abs(look.mean - FULL_LSB / 2) < FULL_LSB / 2 - self.tolerance.offset_lsb
                variance = noise_variance(look.codes)[lit]
                noise_lsb = float(np.mean(variance)) ** 0.5 if lit.any() else 0.0
                self.noise_lsb.setdefault(look.board.accuracy, noise_lsb)
        most_lsb = self.tolerance.noise_lsb
        loud = {clock: lsb for clock, lsb in self.noise_lsb.items() if lsb > most_lsb}
        if loud:
            diagnosis.add(Kind.ADC_NOISE, clocks=loud, most_lsb=most_lsb)

    def _in_order(self, shown: Float, board: SkinKnowledge, diagnosis: Diagnosis) -> Float:
        """`shown`, with lines that are swapped put right: at most some rows and some columns."""
        # What is compared are shares of cells in the loop with the references, from 0 to 1. So an
        # open joint, whose resistance is without limit, does not count for more than a swap.
        siemens = (_estimate(shown, board).cell_siemens, self.plate)
        measured, plate = (cell / (cell + 1 / board.ref_ohm) for cell in siemens)
        for _ in range(2):
            rows, columns = _order(measured, plate), _order(measured.T, plate.T)
            axis = int(columns[1] < rows[1])
            order, off = (rows, columns)[axis]
            moved = lines_of(order != np.arange(len(order)))
            if not moved or off >= SWAPPED_SHARE * np.abs(measured - plate).sum():
                break
            diagnosis.add(Kind.SWAPPED_LINES, Place.of_lines(axis, moved))
            shown, measured = np.take(shown, order, axis), np.take(measured, order, axis)
        return shown

    def _with_references(self, board: SkinKnowledge, diagnosis: Diagnosis) -> SkinKnowledge:
        """`board` with the references that the plate shows. Adds a finding if they are wrong."""
        estimate = _estimate(self.shown_lsb, board)
        bad = np.logical_or(*self._open_and_bridged(estimate))
        siemens = np.where(bad, estimate.cell_siemens, self.plate)
        port_ohm = port_resistance_ohm(self._skin(siemens, board))
        share = self.shown_lsb / FULL_LSB
        top = share[..., READING_SENSES_TOP].mean(axis=2)
        bottom = share[..., ~READING_SENSES_TOP].mean(axis=2)
        of_plate = 1 - top - bottom
        tells = (self.plate > 0) & ~bad & (of_plate > LOOP_SHARES[0]) & (of_plate < LOOP_SHARES[1])
        if not tells.any():
            return board
        ohm = [float(np.median((port_ohm * side / of_plate)[tells])) for side in (top, bottom)]
        nominal_ohm = board.ref_top_ohm, board.ref_bottom_ohm
        off = [100 * (one / nominal - 1) for one, nominal in zip(ohm, nominal_ohm, strict=True)]
        diagnosis.measured["reference_ohm"] = [round(each) for each in ohm]
        most = self.tolerance.reference_percent
        if max(map(abs, off)) > most:
            values = {"ohm": ohm, "nominal_ohm": nominal_ohm, "off_percent": off}
            diagnosis.add(Kind.REFERENCE_VALUE, most_percent=most, **values)
        return replace(board, ref_top_ohm=ohm[0], ref_bottom_ohm=ohm[1])

    def _skin(self, siemens: Float, board: SkinKnowledge) -> Skin:
        """The plate with these cells, at this board."""
        top, bottom = (np.full(siemens.shape, ohm) for ohm in self.wire_ohm.both or (0.0, 0.0))
        return Skin(siemens, top, bottom, board.ref_top_ohm, board.ref_bottom_ohm)

    def _open_and_bridged(self, estimate: Estimate) -> tuple[Bool, Bool]:
        """Cells whose resistor does not conduct, and cells that conduct without a resistor."""
        siemens, std = estimate.cell_siemens, estimate.cell_siemens_std
        bridged = (self.plate == 0) & (siemens > BRIDGE_SIEMENS + TOUCH_STDS * std)
        return siemens < DEAD_SHARE * self.plate, bridged

    def _examine_cells(self, estimate: Estimate, diagnosis: Diagnosis) -> Float:
        """Add wrong cells. Returns the plate with these as they were measured, (R, C) [S]."""
        siemens, is_there = estimate.cell_siemens, self.plate > 0
        self.cell_ohm, self.std_percent = 1 / siemens, 100 * estimate.cell_siemens_std / siemens
        self.error_percent = np.where(is_there, 100 * (self.plate * self.cell_ohm - 1), np.nan)
        is_open, bridged = self._open_and_bridged(estimate)
        most = self.tolerance.cell_percent
        off = ~is_open & (np.abs(self.error_percent) > most + self.std_percent)
        self.wrong, self.open = is_open | bridged | off, is_open
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
        # Resistors that the readings do not tell: smaller ones in parallel hide them.
        hidden = is_there & ~is_open & (self.std_percent > most)
        diagnosis.measured["resistors_not_told"] = int(hidden.sum())
        errors = np.abs(self.error_percent[is_there & ~self.wrong])
        if errors.size:
            diagnosis.measured["worst_cell_percent"] = round(float(errors.max()), 2)
        return np.where(self.wrong, siemens, self.plate)

    def _examine_lines(self, diagnosis: Diagnosis) -> None:
        """Add configurations whose readings are no straight line over what the circuit predicts."""
        most, bad = self.tolerance, list[str]()
        for k, name in enumerate(CONFIGURATIONS):
            lit = self.predicted_lsb[..., k] > most.offset_lsb  # an offset may clip others
            x, y = self.predicted_lsb[lit, k], self.shown_lsb[lit, k]
            if x.size and np.ptp(x) > LEAST_SPAN_LSB:
                slope, offset = map(float, np.polyfit(x, y, 1))
                rest = float(np.abs(y - slope * x - offset).max())
                self.lines[name] = {"slope": slope, "offset_lsb": offset, "residual_lsb": rest}
                is_off = abs(slope - 1) > most.slope or abs(offset) > most.offset_lsb
                if is_off or rest > most.residual_lsb:
                    bad.append(name)
        if bad:
            diagnosis.add(Kind.LINEARITY, readings=bad, lines=self.lines, most=most)


def _estimate(shown_lsb: Float, knowledge: SkinKnowledge) -> Estimate:
    """What `joint` estimates from s."""
    ratio = np.clip(READING_OFFSET + READING_SIGN * shown_lsb / FULL_LSB, 0.0, 1.0)
    return make_estimator("joint", knowledge).estimate(ratio)


def _order(measured: Float, plate: Float) -> tuple[NDArray[np.intp], float]:
    """Which line of `measured` (lines, n) is like each line of `plate`, and how far off all are."""
    from scipy.optimize import linear_sum_assignment

    cost = np.abs(plate[:, None] - measured[None]).sum(axis=2)
    lines, order = linear_sum_assignment(cost)
    return np.asarray(order), float(cost[lines, order].sum())
