# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a skin board, from scans of the untouched skin and what the board says.

The parts: `signal` (hum, noise, movement, settling), `circuit` (lines, cells, references), `far`
(far ends, and wires by these), `wires` (by presses); here, what the board says of itself, what was
lost on the line, and the scan rate.

A skin that is touched is not at fault: touched cells are named and left out, and what movement
hides is not judged.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from ohmskin.arrays import Bool
from ohmskin.circuit.small import one_blas_thread
from ohmskin.doctor.circuit import examine_circuit, examine_leaks
from ohmskin.doctor.far import examine_far, near_ends
from ohmskin.doctor.findings import Diagnosis, Kind, Place, Severity, merged
from ohmskin.doctor.limits import ALL_STDS
from ohmskin.doctor.signal import MOVED_LSB, Look, Rest, examine_settling, examine_signal
from ohmskin.doctor.wires import CornerScans
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport
from ohmskin.version import VERSION

# [ms] The latency timer of a USB bridge cannot be set to less (FTDI, application note AN232B-04).
LEAST_TIMER_MS: Final = 1
# A sound board is not reset by these.
BAD_RESETS: Final = ("brown_out", "watchdog")


@dataclass
class Evidence:
    """What `examine` goes by. What could not be had is None or empty, and is not judged.

    board: what the board says of itself, as it is configured.
    scans: the first look, by this configuration.
    stats: counts of the connection.
    settled: a look with a longer settle time.
    again: a look as the first, after `settled`, if that showed other means.
    report: the board's self-test.
    told: what is told of wires and leads. Wires are at fault only if nominal ones are told.
    presses: scans while somebody pressed corners, after all other looks.
    latency: timer of the USB bridge [ms], and the file that sets it.
    lost: why the board went away meanwhile.
    clocks: a look by each ADC clock; None for one that has too few scans.
    loss: this share of missing scans is no fault [1].
    pressed: looks at pressed corners, by turns as configured and with a longer settle time; None
        for one that has too few scans.
    """

    board: Hello
    scans: list[Scan] = field(default_factory=list)
    stats: BoardStats = field(default_factory=BoardStats)
    settled: Look | None = None
    again: Look | None = None
    report: SelfTestReport | None = None
    told: WireOhm = NO_WIRES
    presses: CornerScans | None = None
    latency: tuple[int, str] | None = None
    lost: str = ""
    clocks: list[Look | None] = field(default_factory=list)
    loss: float = 0.0
    pressed: list[Look | None] = field(default_factory=list)

    def moved_meanwhile(self, later: Look | None) -> Bool:
        """Cells (R, C) whose means differ between the first look and a later one, as by a touch."""
        first = Look.of(self.board, self.scans)
        if first is None or later is None:
            return np.zeros((self.board.rows, self.board.columns), dtype=bool)
        noise_lsb = later.codes.std(axis=0) / len(later.codes) ** 0.5
        limit_lsb = MOVED_LSB + ALL_STDS * noise_lsb
        return np.asarray((np.abs(later.mean - first.mean) > limit_lsb).any(axis=2))


def examine_skin(evidence: Evidence, usual: Look, diagnosis: Diagnosis) -> None:
    """Add what the scans show of a skin: signal, lines, cells, far ends, and wires.

    usual: the first look.
    """
    settled, presses, far = evidence.settled, evidence.presses, usual.board.mode == "far"
    noise_lsb, moved = examine_signal(usual, diagnosis, settled)
    moved = moved | evidence.moved_meanwhile(evidence.again)
    moves, scans, is_too_short = bool(moved.any()), usual, False
    if settled is not None and not moves:
        is_too_short = examine_settling(usual, settled, diagnosis)
        # In mode far, wires change readings by few codes. So a part of a code counts, which the
        # usual settle time leaves even where it is not too short. A hum that stands still at the
        # usual rate is a part of the usual means.
        stands_still = bool(diagnosis.measured["hum_lsb"] and usual.hidden_hz)
        if is_too_short or far or stands_still:
            scans = settled
    if presses is not None:
        diagnosis.pressed = []  # until they are measured
        presses.examine_settling(evidence.pressed, diagnosis)
    told = evidence.told
    rest = Rest(scans.board, scans.mean, len(scans.codes), noise_lsb, moves=moves, told=told)
    at_near = near_ends(rest) if far else rest
    near = examine_circuit(at_near, diagnosis)
    if far and not moves and not near.wrong.all():
        examine_far(rest, near, diagnosis)
    # A cell that moves in all may conduct no more on average than one at rest.
    touched = near.touched if near.touched.any() else moved
    # Where even a longer settle time is too short, untouched cells look touched.
    if touched.any() and not is_too_short:
        diagnosis.add(Kind.TOUCHED, Place.of_cells(touched), moves=moves)
    # What else is wrong with a skin may look like leaks.
    is_faulty = any(one.kind.severity is Severity.FAULT for one in diagnosis.findings)
    if not (touched.any() or is_faulty):
        examine_leaks(at_near, diagnosis)
    if far or touched.any() or near.wrong.any():
        return  # far ends show the wires, or touches and faults hide them
    diagnosis.nominal_ohm, diagnosis.is_told = rest.wire_ohm, told.both is not None
    if presses is not None:
        diagnosis.pressed = presses.measure(rest)
    for share in diagnosis.pressed or ():
        if share.differs and diagnosis.is_told:
            diagnosis.add(Kind.WIRES, share.place, share=share, nominal_ohm=rest.wire_ohm)


def examine(
    evidence: Evidence, of_scans: Callable[[Evidence, Look, Diagnosis], None] = examine_skin
) -> Diagnosis:
    """All findings, and the figures behind them.

    of_scans: adds what the scans show, of a skin or of a plate. Each examiner adds its findings
    without regard to those of others; here they are merged.
    """
    board, stats = evidence.board, evidence.stats
    usual = Look.of(board, evidence.scans)
    diagnosis = Diagnosis()
    diagnosis.measured = {
        "board": board.board,
        "unit_id": board.unit_id,
        "rows": board.rows,
        "columns": board.columns,
        "scans": len(evidence.scans),
        "missed": stats.missed,
        "dropped_by_board": stats.dropped_by_board,
        "damaged": stats.line.damaged,
        "restarts": stats.restarts,
        "rate_hz": None if usual is None else _rate_hz(evidence.scans),
    }
    _examine_board(evidence, diagnosis)
    _examine_line(evidence, diagnosis)
    if usual is not None:
        with one_blas_thread:
            of_scans(evidence, usual, diagnosis)
    elif len(evidence.scans) > 1 and not (evidence.lost or stats.restarts):
        size = f"{board.rows}x{board.columns}"
        diagnosis.add(Kind.LOST, problem=f"it says {size} cells, and its scans have others", late=0)
    diagnosis.findings = merged(diagnosis.findings)
    return diagnosis


def measured_wires(diagnosis: Diagnosis) -> WireOhm | None:
    """A segment of each layer, as presses or far ends showed it; None if neither did."""
    if diagnosis.nominal_ohm and diagnosis.pressed and diagnosis.pressed[0].known:
        whole = diagnosis.pressed[0]
        top, bottom = (whole.share * ohm for ohm in diagnosis.nominal_ohm)
        log_std = whole.std / whole.share
        return WireOhm(top, bottom, top_log_std=log_std, bottom_log_std=log_std)
    return diagnosis.wires_by_far_ends


def _examine_board(evidence: Evidence, diagnosis: Diagnosis) -> None:
    """Add what the board, its self-test and its USB bridge say."""
    board, report, add = evidence.board, evidence.report, diagnosis.add
    if evidence.lost:
        late = board.late if not evidence.scans else 0
        add(Kind.LOST, problem=evidence.lost, late=late)
    if report is not None:
        for name in report.findings:
            add(Kind.SELF_TEST, name=name, code_min=report.code_min, code_max=report.code_max)
    for cause in board.reset_cause:
        if cause in BAD_RESETS:
            add(Kind.RESET_CAUSE, cause=cause)
    if board.version != VERSION:
        add(Kind.VERSION, firmware=board.version, host=VERSION)
    if evidence.latency is not None and evidence.latency[0] > LEAST_TIMER_MS:
        add(Kind.USB_LATENCY, timer_ms=evidence.latency[0], file=evidence.latency[1])


def _examine_line(evidence: Evidence, diagnosis: Diagnosis) -> None:
    """Add what the connection has counted."""
    board, stats, add = evidence.board, evidence.stats, diagnosis.add
    line, commands = stats.line, stats.board_rx_errors
    if stats.restarts:
        add(Kind.RESTARTED, restarts=stats.restarts, causes=board.reset_cause)
    made = stats.scans + stats.missed
    # Too few scans to look at are a loss, too, unless something says why they are few.
    few = len(evidence.scans) < 2 and not (stats.restarts or evidence.lost)
    if stats.missed > evidence.loss * made or few:
        add(
            Kind.LOSS,
            received=len(evidence.scans),
            missed=stats.missed,
            made=made,
            dropped_by_board=stats.dropped_by_board,
            rate_hz=board.rate_hz,
        )
    if line.damaged or commands:
        add(Kind.DAMAGED, damaged=line.damaged, crc_errors=line.crc_errors, commands=commands)


def _rate_hz(scans: list[Scan]) -> float:
    """Scan rate by the board's clock [Hz]. A restart sets number and clock back: it is left out."""
    step = np.diff([float(scan.number) for scan in scans])
    took_s = np.diff([1e-6 * scan.time_us for scan in scans])
    forward = (step > 0) & (took_s > 0)
    return round(float(step[forward].sum() / took_s[forward].sum()), 3) if forward.any() else 0.0
